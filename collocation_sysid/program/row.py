"""One row of the discrete equations: its coefficients, with the time step put in, and its block.

    c_t = Σ_j w_j F_{t−j} − M (Σ_i s_i x_{t−i} + r v_0),
    F_t = f(Σ_i p_i x_{t−i}, Σ_i q_i x_{t−i}; θ) + f_ext,

so that with G = ∂F/∂ξ and C = ∂F/∂ν at evaluation t (see `model.schemes`)

    −∂c_t/∂x_t = s_0 M − w_0 (p_0 G + q_0 C).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..arrays import Array
from ..fem.pattern import SymmetricPattern
from ..model.dynamics import Dynamics


@dataclass(frozen=True, eq=False)
class Row:
    """Row t of an experiment's equations of motion.

    Attributes
    ----------
    p, q, w, s : floats of the stencil, by lag
    r : float
    mass_kg : (3n,) of every dof
    """

    p: tuple[float, ...]
    q: tuple[float, ...]
    w: tuple[float, ...]
    s: tuple[float, ...]
    r: float
    mass_kg: Array

    @classmethod
    def of(cls, dynamics: Dynamics, t: int) -> Row:
        """Row t of the tables, with its mass."""
        tables, step_s = dynamics.tables, dynamics.step_s
        return cls(
            tuple(tables.p[t].tolist()),
            tuple((tables.q[t] / step_s).tolist()),
            tuple(tables.w[t].tolist()),
            tuple((tables.s[t] / step_s**2).tolist()),
            float(tables.r[t]) / step_s,
            dynamics.mass.own_kg + dynamics.mass.tied_kg[t],
        )

    @cached_property
    def lags(self) -> list[int]:
        """Lags from one on that the evaluation of the force depends on."""
        return [i for i in range(1, len(self.p)) if self.p[i] or self.q[i]]

    def block(self, by_position: Array, by_velocity: Array, pattern: SymmetricPattern) -> Array:
        """Lower triangle (m,) of −∂c_t/∂x_t from those of G and C."""
        values = -self.w[0] * self.p[0] * by_position
        values -= self.w[0] * self.q[0] * by_velocity
        values[pattern.diagonal] += self.s[0] * self.mass_kg
        return values

    def skew_block(self, by_position_skew: Array) -> Array:
        """Lower triangle, (m,) or (0,), of the skew part of −∂c_t/∂x_t from that of G."""
        return -self.w[0] * self.p[0] * by_position_skew


def weighted(coefficients: Sequence[float], past: Iterable[Array], shape: tuple[int, ...]) -> Array:
    """Σ_i coefficients[i] past[i] over the lags from one on; past holds the latest first."""
    terms = [c * item for c, item in zip(coefficients[1:], past, strict=False) if c]
    if not terms:
        return np.zeros(shape)
    for term in terms[1:]:
        terms[0] += term
    return terms[0]
