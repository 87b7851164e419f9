"""Where a method starts: trajectories at the guess of the parameters."""

from __future__ import annotations

import numpy as np

from ..arrays import Array
from ..errors import SimulationError
from ..nlp.collocation import Collocation
from ..nlp.marching import march
from ..nlp.newton import Solver
from ..nlp.rest import start_state
from ..nlp.segment import Segment


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
    x[:, segment.held_dofs] = segment.held_positions
    if segment.dynamics.taken is not None:
        x[segment.dynamics.taken] = segment.taken_positions
    return x
