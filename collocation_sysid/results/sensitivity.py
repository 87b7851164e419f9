"""How the trajectory follows the parameters: Z = dx/dq with the equations of motion kept.

From the linearised constraints c_x Z + c_q = 0, solved forward in time. With G = ∂F/∂ξ and
C = ∂F/∂ν at evaluation t, see `nlp.schemes`, one step is the tangent of one step of the scheme:

    −A Z_t = w_0 F' + Σ_{j≥1} w_j dF_{t−j} − M Σ_{i≥1} s_i Z_{t−i} / Δt²,
    F' = F_q + G Σ_{i≥1} p_i Z_{t−i} + C Σ_{i≥1} q_i Z_{t−i} / Δt,
    −A = −∂c_t/∂x_t = −w_0 (p_0 G + q_0 C / Δt) + s_0 M / Δt²,
    dF_t = F' + (p_0 G + q_0 C / Δt) Z_t.

One factorisation per step; nothing but the last few steps is kept.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from ..errors import SimulationError
from ..nlp.collocation import Collocation
from ..nlp.factorisation import Factoriser
from ..nlp.segment import Segment

Array = NDArray[np.float64]


def sensitivities(collocation: Collocation, z: Array) -> list[Array]:
    """dx/dq of each experiment, (N, 3n, nq) in metres per unit of q.

    Held dofs have zeros, and so has x_0 unless it is found in equilibrium.

    Raises
    ------
    SimulationError
        Where the equations of a step are singular.
    """
    return [np.stack(list(steps)) for steps in _all_steps(collocation, z)]


def marker_sensitivities(collocation: Collocation, z: Array) -> list[Array]:
    """d(markers)/dq of each experiment at its samples, (T, 3M, nq); column 3 m + axis.

    Needs no more memory than the result.

    Raises
    ------
    SimulationError
        Where the equations of a step are singular.
    """
    found = []
    for segment, steps in zip(collocation.segments, _all_steps(collocation, z), strict=True):
        sampled = set(segment.observation.grid_rows.tolist())
        operator = segment.experiment.markers.operator
        found.append(np.stack([operator @ step for t, step in enumerate(steps) if t in sampled]))
    return found


def _all_steps(collocation: Collocation, z: Array) -> Iterator[Iterator[Array]]:
    q, positions = collocation.unpack(z)
    theta = collocation.parameters.theta(q)
    theta_q, _ = collocation.parameters.theta_derivatives(q)
    for segment, x in zip(collocation.segments, positions, strict=True):
        yield _steps(segment, x, theta, theta_q)


def _steps(segment: Segment, x: Array, theta: Sequence[float], theta_q: Array) -> Iterator[Array]:
    """Z_t (3n, nq) for t = 0 … N − 1."""
    dynamics, body = segment.dynamics, segment.body
    pattern, mass = body.pattern, body.dof_mass
    tables, step_s = dynamics.tables, dynamics.step_s
    factoriser = Factoriser(pattern, segment.free_dofs)
    xi, nu = dynamics.evaluation_states(x)
    zero = np.zeros((segment.dofs, theta_q.shape[1]))
    past_z: deque[Array] = deque([zero] * dynamics.reach, maxlen=dynamics.reach)
    past_force = past_z.copy()
    if dynamics.first_row == 1:
        yield zero
    for t, xi_t, nu_t in zip(range(dynamics.first_row, dynamics.rows), xi, nu, strict=True):
        p, q = tables.p[t], tables.q[t] / step_s
        w, s = tables.w[t], tables.s[t] / step_s**2
        at = body.linearise(xi_t, nu_t, theta)
        g, c = at.by_position[0], at.by_velocity[0]
        by_position, by_velocity = pattern.matrix(g), pattern.matrix(c)
        force = at.by_theta[0] @ theta_q
        force += by_position @ _weighted(p, past_z) + by_velocity @ _weighted(q, past_z)
        right = w[0] * force + _weighted(w, past_force) - mass[:, None] * _weighted(s, past_z)
        matrix = -w[0] * (p[0] * g + q[0] * c)
        matrix[pattern.diagonal] += s[0] * mass
        z_t = zero.copy()
        try:
            z_t[segment.free_dofs] = factoriser.factorise(matrix).solve(right[segment.free_dofs])
        except np.linalg.LinAlgError as error:
            raise SimulationError(
                f"experiment '{segment.experiment.name}': the sensitivity to the parameters "
                f"cannot be found, the equations are singular: {error}",
                float(dynamics.t_s[t]),
                None,
            ) from error
        past_force.appendleft(force + by_position @ (p[0] * z_t) + by_velocity @ (q[0] * z_t))
        past_z.appendleft(z_t)
        yield z_t


def _weighted(weights: Array, past: Sequence[Array] | deque[Array]) -> Array:
    """Σ_{i≥1} weights[i] past[i − 1], most recent first."""
    return sum((a * b for a, b in zip(weights[1:], past, strict=True) if a), np.zeros_like(past[0]))
