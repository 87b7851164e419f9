"""What a force beside those of the elements is to the equations of motion: F(ξ, ν; u) at T times.

A term has inputs of its own, see `inputs`, beside the constants θ of the body. What it adds goes
into arrays that all terms share: on the pattern of all couplings, with columns for all inputs. The
chain rule from inputs to parameters is no term's, see `setting`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Self

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
class Places:
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
    """

    size: int
    couplings: SymmetricPattern | None

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
    def add_slopes(self, at: Linearisation, places: Places, states: States) -> None:
        """Add F and its slopes, in place."""

    @abstractmethod
    def add_curvature(self, at: Curvature, places: Places, states: States, weights: Array) -> None:
        """Add the derivatives of weightsᵀ F, for weights (T, 3n), in place."""
