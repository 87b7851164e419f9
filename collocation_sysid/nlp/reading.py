"""What an instrument reads: one expression of a few channels and its own φ, compared with data.

The residual of a sample is r = (y(u, data) − ŷ) / σ, in groups of three, its loss Σ ρ(‖r‖) over
the groups. Their derivatives are generated.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from ..arrays import Array
from .generated import Expression, Generated

GROUP = 3


@dataclass(frozen=True, eq=False)
class Reading:
    """The samples of an instrument.

    Attributes
    ----------
    expression : callable
        ``expression(u, data) -> y``, as `Generated` takes it.
    inputs, data : int
        Lengths of u and data. Behind these, data have ŷ and 1/σ, which is zero where nothing is
        measured; both of the length of y, a multiple of three.
    measured : int
        Length of y.
    huber : float or None
        Huber's loss: ρ(d) = d² up to this many standard deviations, linear beyond; d² without it.
    """

    expression: Expression
    inputs: int
    data: int
    measured: int
    huber: float | None = None

    @cached_property
    def residual(self) -> Generated:
        """R of a sample."""
        return Generated(self._residual, self.inputs, self._data)

    @cached_property
    def loss(self) -> Generated:
        """Σ ρ of a sample."""
        return Generated(self._loss, self.inputs, self._data)

    @cached_property
    def _robust(self) -> Generated:
        """Σ ρ of residuals."""
        return Generated(self._rhos, self.measured, 0)

    def curvature(self, u: Array, data: Array, bent: bool = True) -> Array:
        """Second derivatives (k, k, …) of the loss by u.

        Unless readings are bent, they count as linear: Gauss–Newton's, which is convex.
        """
        if bent:
            return self.loss.curvature(u, data)
        residual, slopes = self.residual.slopes(u, data)
        bending = self._robust.curvature(residual, data[:0])
        return np.einsum("ai...,ab...,bj...->ij...", slopes, bending, slopes, optimize=True)

    @property
    def _data(self) -> int:
        return self.data + 2 * self.measured

    def _residual(self, u: ca.SX, data: ca.SX) -> ca.SX:
        ends = [0, self.data, self.data + self.measured, self._data]
        own, measured, weight = ca.vertsplit(data, ends)
        return weight * (self.expression(u, own) - measured)

    def _loss(self, u: ca.SX, data: ca.SX) -> ca.SX:
        return self._rhos(self._residual(u, data), data)

    def _rhos(self, residual: ca.SX, _: ca.SX) -> ca.SX:
        groups = ca.vertsplit(residual, GROUP)
        return sum((self._rho(ca.sumsqr(group)) for group in groups), start=ca.SX(0))

    def _rho(self, square: ca.SX) -> ca.SX:
        if self.huber is None:
            return square
        limit = self.huber**2
        beyond = 2 * self.huber * ca.sqrt(ca.fmax(square, limit)) - limit
        return ca.if_else(square > limit, beyond, square)


def lagrange_weights(at: ca.SX, places: list[ca.SX]) -> ca.SX:
    """Weights of samples at some places, for the value between them."""
    weights = []
    for i, own in enumerate(places):
        weight = ca.SX(1)
        for j, other in enumerate(places):
            if j != i:
                weight *= (at - other) / (own - other)
        weights.append(weight)
    return ca.vertcat(*weights)
