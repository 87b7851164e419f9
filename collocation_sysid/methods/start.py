"""Where a method starts: trajectories simulated at its parameters, as far as they go."""

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
    """The problem with unknown places started from the shape that the guess gives the body."""
    if not any(segment.rows_to_place for segment in collocation.segments):
        return collocation
    p, positions = collocation.guess_p, []
    for segment in collocation.segments:
        experiment, theta = segment.experiment, segment.constants.theta(p[: segment.nq])
        try:
            first = Forces.of(experiment, experiment.t_s[:1], theta)
            x, _ = start_state(experiment, first, Solver(experiment))
        except SimulationError:
            x = experiment.rigid_positions(experiment.t_s[:1]).ravel()
        positions.append(x[None])
    return collocation.placed(p, positions)[0]


def initial_variables(collocation: Collocation) -> tuple[Array, list[str]]:
    """Variables z at the guess, and notes on how they were found.

    Each experiment is simulated at the guess with the collocation scheme. Where that fails, the
    rest shape carried rigidly by the grasp takes its place: collocation needs no feasible start.
    """
    p = collocation.guess_p
    positions, notes = [], []
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
    """Trajectories at p as far as they go, continuing those known; and why the first stopped.

    Parameters
    ----------
    collocation : Collocation
    p : (np,) ndarray
    known : sequence of (k, 3n) ndarray, optional
        First rows of every trajectory; the experiments' starts by default.
    rows : sequence of int, optional
        How many are wanted; all by default.
    options : NewtonOptions, optional
    stopwatch : Stopwatch, optional
    near : sequence of (N, 3n) ndarray, optional
        Trajectories at other parameters: where equilibria are looked for first.
    """
    parts = collocation.parts_at(p, known or _nothing(collocation))

    def on(k: int) -> tuple[Array, SimulationError | None]:
        count = parts[k].segment.grid_rows if rows is None else rows[k]
        beside = None if near is None else near[k]
        return continued(parts[k], count, options, stopwatch, beside)

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
    """A part's trajectory up to so many rows, as far as it goes, see `marched`."""
    return march_on(
        part.segment.experiment,
        part.setting.dynamics.first_rows(rows),
        part.x if len(part.x) else None,
        options,
        stopwatch=stopwatch,
        near=near,
    )


def completed(collocation: Collocation, p: Array, known: Sequence[Array] | None = None) -> Array:
    """Variables z from p and the first rows of every trajectory, the rest carried rigidly."""
    whole = []
    for part in collocation.parts_at(p, known or _nothing(collocation)):
        x = part.x
        if len(x) < part.segment.grid_rows:
            carried = carried_rigidly(part.segment, part.setting.theta)
            x = np.concatenate([x, carried[len(x) :]])
        whole.append(x)
    return collocation.pack(p, whole)


def _nothing(collocation: Collocation) -> list[Array]:
    return [np.zeros((0, segment.dofs)) for segment in collocation.segments]


def carried_rigidly(segment: Segment, theta: Array) -> Array:
    """(N, 3n) start shape carried rigidly, held nodes where their grasps are."""
    experiment, t_s = segment.experiment, segment.dynamics.t_s
    try:
        first = Forces.of(experiment, t_s[:1], theta)
        x0, _ = start_state(experiment, first, Solver(experiment))
    except SimulationError:
        x0 = experiment.rigid_positions(t_s[:1]).ravel()
    rotations, translations = experiment.rigid_motion(t_s)
    shape = (x0.reshape(-1, 3) - translations[0]) @ rotations[0]  # in the grasp's frame
    carried = np.einsum("tij,nj->tni", rotations, shape) + translations[:, None]
    return segment.grasped(carried.reshape(len(t_s), -1), segment.guess_phi)
