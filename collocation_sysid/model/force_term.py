"""What a force beside those of the elements is to the equations of motion: F(ξ, ν; u) at T times.

A term has inputs of its own, see `inputs`, beside the constants θ of the body. What it adds goes
into arrays that all terms share: on the pattern of all couplings, with columns for all inputs. The
chain rule from inputs to parameters is no term's, see `setting`. A force with an energy c(u) S(x)
is −c ∂S/∂x, such as those of tendons and pressures.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np

from ..arrays import Array, Index
from ..fem.body import Curvature, Linearisation
from ..fem.pattern import SymmetricPattern


@dataclass(frozen=True, eq=False)
class States:
    """Where forces are evaluated.

    Attributes
    ----------
    xi, nu : (T, 3n) positions [m] and velocities [m/s]
    theta : (k,) constants of the body
    """

    xi: Array
    nu: Array
    theta: Array


@dataclass(frozen=True, eq=False)
class Slots:
    """Where what a term adds goes.

    Attributes
    ----------
    inputs : slice of the columns of its own inputs
    entries : (m,) places of its couplings in the pattern
    """

    inputs: slice
    entries: Index


class ForceTerm(ABC):
    """A force at T times.

    Attributes
    ----------
    size : int
        Number of its own inputs.
    couplings : SymmetricPattern or None
        Which dofs it joins; None where no slope by the state is anything but zero.
    slides : bool
        Whether its velocities are, in a static experiment, ways since the sample before; others'
        are none.
    by_velocity : bool
        Whether its slopes by velocities may change with these.
    spins : bool
        Whether these slopes are not symmetric, as of gyroscopic forces.
    carries : int
        How many numbers each of its instances carries; only one that is `Pointwise` carries any.
    """

    size: int
    couplings: SymmetricPattern | None
    slides: bool = False
    carries: int = 0
    by_velocity: bool = False
    spins: bool = False

    @abstractmethod
    def at(self, u: Array) -> Self:
        """The same at own inputs (T, size)."""

    @abstractmethod
    def rows(self, rows: slice) -> Self:
        """The same at some of the times."""

    @abstractmethod
    def scaled(self, share: float) -> Self:
        """A share of the force."""

    @abstractmethod
    def towards(self, other: Self, share: float) -> Self:
        """The same with a share of the way to another time."""

    @abstractmethod
    def force(self, states: States) -> Array:
        """F (T, 3n) [N]."""

    @abstractmethod
    def add_slopes(self, at: Linearisation, places: Slots, states: States) -> None:
        """Add F and its slopes, in place."""

    @abstractmethod
    def add_curvature(self, at: Curvature, places: Slots, states: States, weights: Array) -> None:
        """Add the derivatives of weightsᵀ F, for weights (T, 3n), in place."""


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

    def add_slopes(self, at: Linearisation, places: Slots, states: States) -> None:
        """Add F and its slopes."""
        gradient = self.scalar.gradient(states.xi)
        np.subtract(at.force, self.amplitude * gradient, out=at.force)
        at.by_position[:, places.entries] -= self.amplitude * self.scalar.hessian(states.xi)
        at.by_theta[:, :, places.inputs.start] -= gradient

    def add_curvature(self, at: Curvature, places: Slots, states: States, weights: Array) -> None:
        """Add the derivatives of weightsᵀ F."""
        xi, own = states.xi, places.inputs.start
        along = self.scalar.hessian_along(xi, weights)
        at.position_position[:, places.entries] -= self.amplitude * along
        turned = self.couplings.products(self.scalar.hessian(xi), weights)
        at.position_theta[:, :, own] -= turned
        at.theta[:, own] -= np.einsum("ti,ti->t", weights, self.scalar.gradient(xi))
