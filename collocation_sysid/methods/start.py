"""Initial trajectories: simulations at given parameters, as far as they succeed.

Use `initial_variables` for a method that needs variables at the guess, and `marched` for
simulations at any parameters. Where a simulation fails, `completed` appends the initial shape moved
rigidly with the grasp.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..arrays import Array
from ..errors import SimulationError
from ..fem.kernels import side_by_side
from ..model.forces import Forces
from ..program.collocation import Collocation, Part
from ..program.marching import march, march_on
from ..program.newton import NewtonOptions, Solver
from ..program.rest import start_state
from ..program.segment import Segment
from ..program.stopwatch import Stopwatch


def placed_at_guess(collocation: Collocation) -> Collocation:
    """Associate markers and cameras of unknown position with the body's initial shape at the guess.

    The initial shape is the initial equilibrium or, if that fails, the undeformed shape moved with
    the grasp. The collocation is returned unchanged if all positions are known.
    """
    if not any(segment.rows_to_place for segment in collocation.segments):
        return collocation
    p = collocation.guess_p
    positions = []
    for segment in collocation.segments:
        experiment = segment.experiment
        theta = segment.constants.theta(p[: segment.nq])
        try:
            first = Forces.of(experiment, experiment.t_s[:1], theta)
            x, _ = start_state(experiment, first, Solver(experiment))
        except SimulationError:
            x = experiment.rigid_positions(experiment.t_s[:1]).ravel()
        positions.append(x[None])
    return collocation.placed(p, positions)[0]


def initial_variables(collocation: Collocation) -> tuple[Array, list[str]]:
    """Return variables z (variables,) at the guess, and notes for the user.

    Each experiment is simulated at the guess with the collocation scheme. If that fails, the
    initial shape is moved rigidly with the grasp and a note is added: collocation needs no feasible
    start.
    """
    p = collocation.guess_p
    positions = []
    notes = []
    for segment in collocation.segments:
        theta = segment.constants.theta(p[: segment.nq])
        try:
            positions.append(march(segment.experiment, segment.dynamics.with_theta(theta)))
        except SimulationError as error:
            positions.append(carried_rigidly(segment, theta))
            notes.append(
                f"experiment '{segment.experiment.name}': the simulation at the guess failed "
                f"({error}); started from the rest shape carried rigidly by the grasp"
            )
    return collocation.pack(p, positions), notes


def marched(
    collocation: Collocation,
    p: Array,
    known: Sequence[Array] | None = None,
    rows: Sequence[int] | None = None,
    options: NewtonOptions | None = None,
    stopwatch: Stopwatch | None = None,
    near: Sequence[Array] | None = None,
) -> tuple[list[Array], SimulationError | None]:
    """Simulate all experiments with the collocation scheme, as far as the simulations succeed.

    Parameters
    ----------
    collocation : Collocation
        Problem.
    p : (np,) array
        Shared and nuisance parameters (q, φ).
    known : sequence of (k, 3n) array, optional
        First rows of every trajectory [m], which are continued; by default simulations begin at the
        experiments' starts.
    rows : sequence of int, optional
        Number of grid rows of each trajectory; all by default.
    options : NewtonOptions, optional
        Tolerances of Newton's method.
    stopwatch : Stopwatch, optional
        Stopwatch that measures the simulations.
    near : sequence of (N, 3n) array, optional
        Trajectories at other parameters [m], from which Newton's method starts to search for
        equilibria.

    Returns
    -------
    tuple of list of (m, 3n) array and SimulationError or None
        Trajectories, which are shorter than requested where the simulation failed, and the first
        failure; None if there was none.
    """
    parts = collocation.parts_at(p, known or _nothing(collocation))

    def on(k: int) -> tuple[Array, SimulationError | None]:
        """Simulate experiment number k, from 0."""
        count = parts[k].segment.grid_rows if rows is None else rows[k]
        guess = None if near is None else near[k]
        return continued(parts[k], count, options, stopwatch, guess)

    reached = side_by_side(on, range(len(parts)), collocation.threads)
    failures = [failure for _, failure in reached if failure is not None]
    return [x for x, _ in reached], failures[0] if failures else None


def continued(
    part: Part,
    rows: int,
    options: NewtonOptions | None = None,
    stopwatch: Stopwatch | None = None,
    near: Array | None = None,
) -> tuple[Array, SimulationError | None]:
    """Continue the trajectory of one experiment, as far as the simulation succeeds.

    Parameters
    ----------
    part : Part
        Experiment at its parameters, with its known first rows.
    rows : int
        Number of grid rows of the result.
    options : NewtonOptions, optional
        Tolerances of Newton's method.
    stopwatch : Stopwatch, optional
        Stopwatch that measures the simulation.
    near : (N, 3n) array, optional
        Trajectory at other parameters [m], see `marched`.

    Returns
    -------
    tuple of (m, 3n) array and SimulationError or None
        Trajectory with the known rows [m], and the failure; None if the trajectory is complete.
    """
    return march_on(
        part.segment.experiment,
        part.setting.dynamics.first_rows(rows),
        part.x if len(part.x) else None,
        options,
        stopwatch=stopwatch,
        near=near,
    )


def completed(collocation: Collocation, p: Array, known: Sequence[Array] | None = None) -> Array:
    """Return variables z from parameters and the first rows of every trajectory.

    Missing rows are those of `carried_rigidly`.

    Parameters
    ----------
    collocation : Collocation
        Problem.
    p : (np,) array
        Shared and nuisance parameters (q, φ).
    known : sequence of (k, 3n) array, optional
        First rows of every trajectory [m]; none by default.
    """
    trajectories = []
    for part in collocation.parts_at(p, known or _nothing(collocation)):
        x = part.x
        if len(x) < part.segment.grid_rows:
            rigid_positions = carried_rigidly(part.segment, part.setting.theta)
            x = np.concatenate([x, rigid_positions[len(x) :]])
        trajectories.append(x)
    return collocation.pack(p, trajectories)


def _nothing(collocation: Collocation) -> list[Array]:
    """Return an empty trajectory (0, 3n) of each experiment."""
    return [np.zeros((0, segment.dofs)) for segment in collocation.segments]


def carried_rigidly(segment: Segment, theta: Array) -> Array:
    """Return a trajectory (N, 3n) in which the initial shape moves rigidly with the grasp [m].

    Grasped nodes have their prescribed positions. The initial shape is the initial equilibrium at
    constants `theta` (k,) or, if that fails, the undeformed shape.
    """
    experiment = segment.experiment
    t_s = segment.dynamics.t_s
    try:
        first = Forces.of(experiment, t_s[:1], theta)
        x0, _ = start_state(experiment, first, Solver(experiment))
    except SimulationError:
        x0 = experiment.rigid_positions(t_s[:1]).ravel()
    rotations, translations = experiment.rigid_motion(t_s)
    shape = (x0.reshape(-1, 3) - translations[0]) @ rotations[0]  # in the grasp's frame
    carried = np.einsum("tij,nj->tni", rotations, shape) + translations[:, None]
    return segment.grasped(carried.reshape(len(t_s), -1), segment.guess_phi)
