"""A force with an energy c(u) S(x): −c ∂S/∂x, such as those of tendons and pressures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np

from ..arrays import Array
from ..fem.body import Curvature, Linearisation
from ..fem.pattern import SymmetricPattern
from .force_term import ForceTerm, Places, States


class Scalar(Protocol):
    """A scalar S of the shape of a body, of positions (T, 3n)."""

    couplings: SymmetricPattern

    def gradient(self, states: Array) -> Array:
        """∂S/∂x (T, 3n)."""
        ...

    def hessian(self, states: Array) -> Array:
        """∂²S/∂x² (T, m) on the couplings."""
        ...

    def hessian_along(self, states: Array, ways: Array) -> Array:
        """Its derivative (T, m) along ways (T, 3n)."""
        ...


@dataclass(frozen=True, eq=False)
class Potential(ForceTerm):
    """The force of an energy at T times.

    Attributes
    ----------
    scalar : S
    amplitude : (T, 1) c, its own input
    """

    scalar: Scalar
    amplitude: Array

    @property
    def size(self) -> int:  # type: ignore[override]
        """One."""
        return 1

    @property
    def couplings(self) -> SymmetricPattern:  # type: ignore[override]
        """Those of S."""
        return self.scalar.couplings

    def at(self, u: Array) -> Self:
        """The same with another amplitude."""
        return replace(self, amplitude=u)

    def rows(self, rows: slice) -> Self:
        """The same at some of the times."""
        return self.at(self.amplitude[rows])

    def scaled(self, share: float) -> Self:
        """A share of it."""
        return self.at(share * self.amplitude)

    def towards(self, other: Self, share: float) -> Self:
        """With a share of the way to another time."""
        return self.at(self.amplitude + share * (other.amplitude - self.amplitude))

    def force(self, states: States) -> Array:
        """(T, 3n) [N]."""
        return -self.amplitude * self.scalar.gradient(states.xi)

    def add_slopes(self, at: Linearisation, places: Places, states: States) -> None:
        """Add F and its slopes."""
        gradient = self.scalar.gradient(states.xi)
        np.subtract(at.force, self.amplitude * gradient, out=at.force)
        at.by_position[:, places.entries] -= self.amplitude * self.scalar.hessian(states.xi)
        at.by_theta[:, :, places.inputs.start] -= gradient

    def add_curvature(self, at: Curvature, places: Places, states: States, weights: Array) -> None:
        """Add the derivatives of weightsᵀ F."""
        xi, own = states.xi, places.inputs.start
        along = self.scalar.hessian_along(xi, weights)
        at.position_position[:, places.entries] -= self.amplitude * along
        turned = self.couplings.products(self.scalar.hessian(xi), weights)
        at.position_theta[:, :, own] -= turned
        at.theta[:, own] -= np.einsum("ti,ti->t", weights, self.scalar.gradient(xi))
