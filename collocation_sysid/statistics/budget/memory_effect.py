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

# Relaxation times of the branches that are considered [s].
RELAXATION_TIMES_S = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
# Beginning of the name of the component of each of them, such as "τ=0.3s".
RELAXATION_TIME = "τ="


def supports_memory(body: Body, is_static: bool) -> bool:
    """Return whether a branch of memory can be added: the experiment is dynamic, no part of the body
    has memory, and its elements do not average the volume change.
    """
    return not (is_static or body.has_memory or body.element.mean_dilatation)


def is_distinguishable(
    tau_s: float, sampling_s: float, duration_s: float
) -> bool:
    """Return whether a recording can distinguish the relaxation time `tau_s` from other effects.

    Memory that is faster than one sampling interval acts as damping by γ_r, memory that is slower
    than the recording as a stiffer material.
    """
    return sampling_s <= tau_s <= duration_s


def memory_forces_n(
    body: Body,
    dynamics: Dynamics,
    x: Array,
    relaxation_times_s: Sequence[float],
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
    tau_s = np.asarray(relaxation_times_s, dtype=float)[:, None]
    remembering, theta = _with_unit_branch(body, dynamics.theta)
    stresses = remembering.stresses
    positions, _ = dynamics.all_evaluation_states(x)
    intervals_s = dynamics.compute_intervals_to_next_s()
    loaded_s = dynamics.loaded_since_s
    forces = np.zeros((len(tau_s), *x.shape))
    stress = stresses.stress(positions[:1], theta)
    overstress = np.exp(-loaded_s / tau_s) * stress
    forces[:, 0] = stresses.memory_force(
        np.repeat(positions[:1], len(tau_s), axis=0), overstress, theta
    )
    for row in range(1, len(x)):
        ratio = intervals_s[row - 1] / tau_s
        now = stresses.stress(positions[row : row + 1], theta)
        overstress = np.exp(-ratio) * overstress - np.expm1(-ratio) / ratio * (
            now - stress
        )
        forces[:, row] = stresses.memory_force(
            np.repeat(positions[row : row + 1], len(tau_s), axis=0),
            overstress,
            theta,
        )
        stress = now
    return forces


def _with_unit_branch(body: Body, theta: Array) -> tuple[Body, Array]:
    """Return the body with one branch of memory in each part, and its constants, in which share and
    relaxation time of the branches are one.
    """
    parts = tuple(
        replace(part, prony=(Prony("memory"),)) for part in body.parts
    )
    ends = [
        start + part.law_constant_count
        for start, part in zip(body.starts, body.parts, strict=False)
    ]
    return body.with_parts(parts), np.insert(theta, np.repeat(ends, 2), 1.0)
