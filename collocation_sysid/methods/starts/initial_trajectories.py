"""Initial trajectories: simulations at given parameters, as far as they succeed.

Use `initial_variables` for a method that needs variables at the guess, and `simulate_trajectories`
for simulations at any parameters. Where a simulation fails, `complete_variables` appends the
initial shape moved rigidly with the grasp.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...common.array_types import Array
from ...errors import SimulationError
from ...fem.kernels import map_experiments
from ...model.forces import Forces
from ...program.collocation import Collocation
from ...program.forward.initial_equilibrium import initial_state
from ...program.forward.loss_of_stability import explain_failure
from ...program.forward.newton_solver import NewtonOptions, NewtonSolver
from ...program.forward.scheme_simulation import continue_simulation, simulate_scheme
from ...program.stopwatch import Stopwatch
from ...program.transcription import Transcription


def associated_at_guess(collocation: Collocation) -> Collocation:
    """Return the problem with markers and cameras of unknown position associated with the body's
    initial shape at the guess.

    The initial shape is the initial equilibrium or, if that fails, the undeformed shape moved with
    the grasp. The given problem is not modified; it is returned itself if all positions are known.
    Every parameter must have a guess.
    """
    if not any(transcription.rows_to_place for transcription in collocation.transcriptions):
        return collocation
    p = collocation.guess_p
    positions = []
    for transcription in collocation.transcriptions:
        experiment = transcription.experiment
        theta = transcription.constants.theta(p[: transcription.nq])
        try:
            first = Forces.from_experiment(experiment, experiment.t_s[:1], theta=theta)
            x, _ = initial_state(experiment, first, solver=NewtonSolver(experiment))
        except SimulationError:
            x = experiment.rigid_positions(experiment.t_s[:1]).ravel()
        positions.append(x[None])
    return collocation.place_unknown_markers(p, positions)[0]


def initial_variables(collocation: Collocation) -> tuple[Array, list[str]]:
    """Return variables z (variables,) at the guess, and notes for the user, one for each simulation
    that failed.

    Each experiment is simulated at the guess with the collocation scheme. If that fails, the
    initial shape is moved rigidly with the grasp instead and a note is added, because collocation
    needs no feasible start. Every parameter must have a guess.
    """
    p = collocation.guess_p
    positions = []
    notes = []
    for transcription in collocation.transcriptions:
        theta = transcription.constants.theta(p[: transcription.nq])
        try:
            positions.append(
                simulate_scheme(transcription.experiment, transcription.dynamics.with_theta(theta))
            )
        except SimulationError as error:
            positions.append(rigid_trajectory(transcription, theta))
            reason = explain_failure(transcription.experiment, theta, error=error)
            picture = (
                "" if reason.stability_loss is None else "; the command simulate draws the mode"
            )
            notes.append(
                f"experiment '{transcription.experiment.name}': the simulation at the guess failed "
                f"({reason}){picture}; the initial trajectory is the rest shape moving rigidly "
                "with the grasp"
            )
    return collocation.pack(p, positions), notes


def simulate_trajectories(
    collocation: Collocation,
    p: Array,
    rows: Sequence[int] | None = None,
    options: NewtonOptions | None = None,
    stopwatch: Stopwatch | None = None,
    guess: Sequence[Array] | None = None,
) -> tuple[list[Array], SimulationError | None]:
    """Simulate all experiments with the collocation scheme, as far as the simulations succeed.

    Parameters
    ----------
    p : (np,) array
        Shared and nuisance parameters (q, φ).
    rows : sequence of int, optional
        Number of grid rows of each trajectory; all by default.
    options : NewtonOptions, optional
        Tolerances of Newton's method.
    guess : sequence of (N, 3n) array, optional
        Trajectories at other parameters [m], from which Newton's method starts to search for
        equilibria.

    Returns
    -------
    tuple of list of (m, 3n) array and SimulationError or None
        Trajectories, which are shorter than requested where the simulation failed, and the first
        failure; None if there was none.
    """
    parts = collocation.iterates_at(p, _empty_trajectories(collocation))

    def simulate_one(k: int) -> tuple[Array, SimulationError | None]:
        """Return the trajectory as far as it succeeded, and the failure or None."""
        part = parts[k]
        count = part.transcription.grid_times if rows is None else rows[k]
        x, failure = continue_simulation(
            part.transcription.experiment,
            part.equations.dynamics.truncated_to(count),
            options=options,
            stopwatch=stopwatch,
            approximate_solution=None if guess is None else guess[k],
        )
        if failure is not None:
            failure = explain_failure(
                part.transcription.experiment, part.equations.dynamics.theta, error=failure
            )
        return x, failure

    reached = map_experiments(simulate_one, range(len(parts)), threads=collocation.threads)
    failures = [failure for _, failure in reached if failure is not None]
    return [x for x, _ in reached], failures[0] if failures else None


def complete_variables(
    collocation: Collocation, p: Array, known_rows: Sequence[Array] | None = None
) -> Array:
    """Return variables z (variables,) from parameters and the first rows of every trajectory.

    Missing rows are those of `rigid_trajectory`.

    Parameters
    ----------
    p : (np,) array
        Shared and nuisance parameters (q, φ).
    known_rows : sequence of (k, 3n) array, optional
        First rows of every trajectory [m]; none by default, as for None.
    """
    trajectories = []
    for part in collocation.iterates_at(p, known_rows or _empty_trajectories(collocation)):
        x = part.x
        if len(x) < part.transcription.grid_times:
            rigid_positions = rigid_trajectory(part.transcription, part.equations.dynamics.theta)
            x = np.concatenate([x, rigid_positions[len(x) :]])
        trajectories.append(x)
    return collocation.pack(p, trajectories)


def _empty_trajectories(collocation: Collocation) -> list[Array]:
    return [np.zeros((0, transcription.dof_count)) for transcription in collocation.transcriptions]


def rigid_trajectory(transcription: Transcription, theta: Array) -> Array:
    """Return a trajectory (N, 3n) in which the initial shape moves rigidly with the grasp [m], on
    all times of the grid.

    Grasped nodes have their prescribed positions at the guess of φ. The initial shape is the
    initial equilibrium at constants `theta` (k,) or, if that fails, the undeformed shape.
    """
    experiment = transcription.experiment
    t_s = transcription.dynamics.t_s
    try:
        first = Forces.from_experiment(experiment, t_s[:1], theta=theta)
        x0, _ = initial_state(experiment, first, solver=NewtonSolver(experiment))
    except SimulationError:
        x0 = experiment.rigid_positions(t_s[:1]).ravel()
    rotations, translations = experiment.rigid_motion(t_s)
    shape = (x0.reshape(-1, 3) - translations[0]) @ rotations[0]  # in the grasp's frame
    positions = np.einsum("tij,nj->tni", rotations, shape) + translations[:, None]
    return transcription.with_prescribed_positions(
        positions.reshape(len(t_s), -1), transcription.guess_phi
    )
