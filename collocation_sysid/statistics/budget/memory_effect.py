"""Forces of viscoelastic memory that the model of a body does not have.

One Prony branch with the overstress Q of `fem.laws.memory` is added to a material without memory.
To first order in its share g, the force of the branch along the answer is g times that of a branch
with the share one, because Q is proportional to g while the motion stays the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...common.array_types import Array
from ...fem.body import Body
from ...fem.laws.materials import Prony
from ...model.dynamics import Dynamics
from ...model.viscoelasticity import MemoryState

# Relaxation times of the branches that are considered [s].
RELAXATION_TIMES_S = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
# Beginning of the name of the component of each of them, such as "τ=0.3s".
RELAXATION_TIME = "τ="


def supports_memory(body: Body, is_static: bool) -> bool:
    """Return whether a branch of memory can be added: the experiment is dynamic, no part of the
    body has memory, its elements do not average the volume change.
    """
    return not (is_static or body.has_memory or body.element.mean_dilatation)


def is_distinguishable(tau_s: float, sampling_s: float, duration_s: float) -> bool:
    """Return whether a recording can distinguish the relaxation time `tau_s` from other effects.

    Memory that is faster than one sampling interval acts as damping by γ_r, memory that is slower
    than the recording as a stiffer material.
    """
    return sampling_s <= tau_s <= duration_s


def memory_forces_n(
    body: Body, dynamics: Dynamics, x: Array, relaxation_times_s: Sequence[float]
) -> Array:
    """Return the forces (B, N, 3n) [N] of B branches of memory with the share one, each alone, at
    the evaluations of a motion.

    Parameters
    ----------
    body : Body
        Body for which `supports_memory` is true, with its stress-free shape.
    dynamics : Dynamics
        Equations of motion of the body, with its constants θ.
    x : (N, 3n) array
        Positions at all grid times [m].
    relaxation_times_s : sequence of float
        Relaxation times τ of the branches [s].

    Notes
    -----
    Each row of time is evaluated alone, so that the memory needed does not grow with the product of
    time steps and elements.
    """
    count = len(relaxation_times_s)
    forces_n = np.zeros((count, *x.shape))
    if not count:
        return forces_n
    remembering, theta = _with_unit_branches(
        body, dynamics.theta, relaxation_times_s=relaxation_times_s
    )
    positions, velocities = dynamics.all_evaluation_states(x)
    intervals_s = dynamics.intervals_to_next_s
    state = MemoryState.at_start(remembering, positions[0], theta, loaded_s=dynamics.loaded_since_s)
    for row, position in enumerate(positions):
        if row:
            state = state.advance(
                dynamics.forces, position, velocities[row], interval_s=intervals_s[row - 1]
            )
        forces_n[:, row] = remembering.stresses.memory_force(
            np.repeat(position[None], count, axis=0), _overstress_by_time(state, count), theta
        )
    return forces_n


def _with_unit_branches(
    body: Body, theta: Array, relaxation_times_s: Sequence[float]
) -> tuple[Body, Array]:
    """Return the body with a branch for each relaxation time in each part, and θ with shares 1."""
    count = len(relaxation_times_s)
    branches = tuple(Prony(f"memory_{k}") for k in range(count))
    parts = tuple(replace(part, prony=branches) for part in body.parts)
    ends = [
        start + part.law_constant_count
        for start, part in zip(body.starts, body.parts, strict=False)
    ]
    constants = np.column_stack([np.ones(count), relaxation_times_s]).ravel()
    return body.with_parts(parts), np.insert(
        theta, np.repeat(ends, 2 * count), np.tile(constants, len(parts))
    )


def _overstress_by_time(state: MemoryState, count: int) -> Array:
    """Return the overstress (count, width) [Pa] of each relaxation time alone."""
    memory = state.body.memory
    overstress = np.zeros((count, memory.width))
    for number, branch in enumerate(memory.branches):
        overstress[number % count, branch.points] = state.overstress[branch.columns]
    return overstress
