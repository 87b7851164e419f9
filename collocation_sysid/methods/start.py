"""Where a method starts: trajectories simulated at its parameters, as far as they go."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..arrays import Array
from ..errors import SimulationError
from ..nlp.collocation import Collocation
from ..nlp.marching import march, march_on
from ..nlp.newton import NewtonOptions, Solver
from ..nlp.rest import start_state
from ..nlp.segment import Segment
from ..nlp.stopwatch import Stopwatch


def initial_variables(collocation: Collocation) -> tuple[Array, list[str]]:
    """Variables z at the guess, and notes on how they were found.

    Each experiment is simulated at the guess with the collocation scheme. Where that fails, the
    rest shape carried rigidly by the grasp takes its place: collocation needs no feasible start.
    """
    q = collocation.parameters.guess_q
    positions, notes = [], []
    for segment in collocation.segments:
        theta = segment.constants.theta(q)
        try:
            positions.append(march(segment.experiment, segment.dynamics, theta))
        except SimulationError as error:
            positions.append(carried_rigidly(segment, theta))
            notes.append(
                f"experiment '{segment.experiment.name}': the simulation at the guess failed "
                f"({error}); started from the rest shape carried rigidly by the grasp"
            )
    return collocation.pack(q, positions), notes


def marched(
    collocation: Collocation,
    p: Array,
    known: Sequence[Array] | None = None,
    rows: Sequence[int] | None = None,
    options: NewtonOptions | None = None,
    stopwatch: Stopwatch | None = None,
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
    """
    _, own = collocation.split(p)
    found, first_failure = [], None
    parts = zip(collocation.segments, collocation.settings(p), own, strict=True)
    for k, (segment, setting, phi) in enumerate(parts):
        dynamics = setting.dynamics if rows is None else setting.dynamics.first_rows(rows[k])
        x = known[k] if known is not None and len(known[k]) else None
        experiment = segment.corrected(phi)
        x, failure = march_on(experiment, dynamics, setting.theta, x, options, stopwatch=stopwatch)
        found.append(x)
        first_failure = first_failure or failure
    return found, first_failure


def completed(collocation: Collocation, p: Array, known: Sequence[Array] | None = None) -> Array:
    """Variables z from p and the first rows of every trajectory, the rest carried rigidly."""
    q, own = collocation.split(p)
    whole = []
    for k, segment in enumerate(collocation.segments):
        x = known[k] if known is not None else np.zeros((0, segment.dofs))
        if len(x) < segment.grid_rows:
            x = np.concatenate([x, carried_rigidly(segment, segment.constants.theta(q))[len(x) :]])
        whole.append(x)
    return collocation.pack(q, whole, own)


def carried_rigidly(segment: Segment, theta: Array) -> Array:
    """(N, 3n) start shape moved with the first grasp, held nodes where their grasps are."""
    experiment, t_s = segment.experiment, segment.dynamics.t_s
    try:
        x0, _ = start_state(experiment, theta, Solver(experiment))
    except SimulationError:
        x0 = experiment.rigid_positions(t_s[:1]).ravel()
    x = np.tile(x0, (len(t_s), 1))
    if experiment.grasps:
        rotations, translations = experiment.grasps[0].poses.at(t_s)
        shape = (x0.reshape(-1, 3) - translations[0]) @ rotations[0]  # in the grasp's frame
        carried = np.einsum("tij,nj->tni", rotations, shape) + translations[:, None]
        x = carried.reshape(len(t_s), -1)
    return segment.grasped(x)
