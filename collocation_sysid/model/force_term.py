"""Interface of a force in the equations of motion, beside the internal forces of the elements.

Derive a force from `ForceTerm`, or from `point_forces.Pointwise` if it acts point by point; use
`Potential` for a force with an energy c(u) S(x), i.e. −c ∂S/∂x, such as that of a tendon or of a
pressure. A term is F(ξ, ν; u) at T times. Its inputs (see `inputs`) follow the constants θ of the
body in u. Terms add their values and derivatives to shared arrays, on the sparsity pattern of all
couplings and with one column for every input. The chain rule from inputs to parameters is applied
in `equations_at_parameters`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import Protocol, Self

import numpy as np

from ..common.array_types import Array, Index
from ..common.time_dependence import over_time
from ..fem.body import Linearisation, SecondDerivatives
from ..fem.pattern import SymmetricPattern
from .local_force import LocalForce


@dataclass(frozen=True, eq=False)
class States:
    """States at which forces are evaluated."""

    xi: Array  # (T, 3n): positions ξ [m]
    # (T, 3n): velocities ν [m/s]; in a static experiment the displacements since the previous
    # sample [m].
    nu: Array
    theta: Array  # (k,): constants θ of the body


@dataclass(frozen=True, eq=False)
class AssemblyIndices:
    """Positions in the shared arrays to which a term adds its derivatives."""

    inputs: slice  # columns of the term's inputs
    entries: Index  # (m,): positions of the term's couplings in the shared sparsity pattern


class ForceTerm(ABC):
    """Force at T times, with first and second derivatives.

    A term marks its fields that depend on time and those that are loads (`common.time_dependence`);
    masses and internal variables are no loads.

    Attributes
    ----------
    size : int
        Number of the term's inputs.
    couplings : SymmetricPattern or None
        Pairs of dofs coupled by the force; None if the force does not depend on the state.
    uses_increments : bool
        Whether the force uses the displacement since the previous sample in place of the velocity
        in a static experiment, as friction does. Other terms get zero velocities there.
    is_nonlinear_in_velocity : bool
        Whether derivatives by the velocity may themselves depend on the velocity.
    has_skew_damping : bool
        Whether the derivatives by the velocity may be non-symmetric, as for gyroscopic forces.
    internal_variable_count : int
        Number of internal variables of each instance; nonzero only for a `Pointwise` term.
    is_local : bool
        Whether the force acts on few, changing points, to which time steps condense it.
    """

    size: int
    couplings: SymmetricPattern | None
    uses_increments: bool = False
    internal_variable_count: int = 0
    is_nonlinear_in_velocity: bool = False
    has_skew_damping: bool = False
    is_local: bool = False

    @abstractmethod
    def with_inputs(self, u: Array) -> Self:
        """Return this force at inputs u (T, size), of which it may keep views; self if it has no
        inputs. Self is not modified.
        """

    @abstractmethod
    def force(self, states: States) -> Array:
        """Return the forces F (T, 3n) [N]."""

    def local_force(self, theta: Array, pattern: SymmetricPattern) -> LocalForce:
        """Return this force in one time step, with forces on the body alone; only if `is_local`.

        Parameters
        ----------
        theta : (k,) array
            Constants of the body.
        pattern : SymmetricPattern
            Pattern of the matrices, which contains the couplings of the force.

        Raises
        ------
        NotImplementedError
            If the force is not local.
        """
        raise NotImplementedError

    def separate_bodies(self, places: Array, shape: Array) -> Array:
        """Return positions (n, 3) [m] with an obstacle, on which the force acts as well, moved out
        of the body by its deepest penetration; the given ones for other forces.

        Parameters
        ----------
        places : (n, 3) array
            Positions of the nodes [m]; not modified.
        shape : (n, 3) array
            Positions [m] at which the penetration is determined.
        """
        return places

    @abstractmethod
    def add_derivatives(
        self, linearisation: Linearisation, places: AssemblyIndices, states: States
    ) -> None:
        """Add the forces and their first derivatives to a linearisation, in place.

        Parameters
        ----------
        linearisation : Linearisation
            Shared arrays; modified.
        places : AssemblyIndices
            Columns and entries of this term in the arrays.
        """

    @abstractmethod
    def add_second_derivatives(
        self, curvature: SecondDerivatives, places: AssemblyIndices, states: States, weights: Array
    ) -> None:
        """Add the second derivatives of weightsᵀ F by positions, velocities and inputs to a
        curvature, in place, and its first ones by the inputs.

        Parameters
        ----------
        curvature : SecondDerivatives
            Shared arrays; modified.
        places : AssemblyIndices
            Columns and entries of this term in the arrays.
        weights : (T, 3n)
        """


class ShapeFunctional(Protocol):
    """Scalar function S of the node positions, such as the length of a tendon or the volume of a
    cavity.

    Attributes
    ----------
    couplings : SymmetricPattern
        Pairs of dofs with a nonzero second derivative of S.
    """

    couplings: SymmetricPattern

    def gradient(self, states: Array) -> Array:
        """Return ∂S/∂x (T, 3n) at positions (T, 3n)."""
        ...

    def hessian(self, states: Array) -> Array:
        """Return ∂²S/∂x² (T, m) on the couplings, at positions (T, 3n)."""
        ...

    def hessian_derivative(self, states: Array, ways: Array) -> Array:
        """Return Σ ways_i ∂³S/∂x_i∂x² (T, m) on the couplings: the derivative of the Hessian at
        positions (T, 3n) in the directions `ways` (T, 3n).
        """
        ...


@dataclass(frozen=True, eq=False)
class Potential(ForceTerm):
    """Force −c ∂S/∂x of an energy c S(x) at T times."""

    scalar: ShapeFunctional  # function S of the positions
    # (T, 1): factor c of the energy; the only input of the force.
    amplitude: Array = field(metadata=over_time(is_load=True))

    @property
    def size(self) -> int:  # type: ignore[override]
        """Number of inputs, which is 1."""
        return 1

    @property
    def couplings(self) -> SymmetricPattern:  # type: ignore[override]
        """Pairs of dofs coupled by S."""
        return self.scalar.couplings

    def with_inputs(self, u: Array) -> Self:
        return replace(self, amplitude=u)

    def force(self, states: States) -> Array:
        """Return the forces −c ∂S/∂x (T, 3n) [N]."""
        return -self.amplitude * self.scalar.gradient(states.xi)

    def add_derivatives(
        self, linearisation: Linearisation, places: AssemblyIndices, states: States
    ) -> None:
        gradient = self.scalar.gradient(states.xi)
        np.subtract(linearisation.force, self.amplitude * gradient, out=linearisation.force)
        linearisation.by_position[:, places.entries] -= self.amplitude * self.scalar.hessian(
            states.xi
        )
        linearisation.by_theta[:, :, places.inputs.start] -= gradient

    def add_second_derivatives(
        self, curvature: SecondDerivatives, places: AssemblyIndices, states: States, weights: Array
    ) -> None:
        xi = states.xi
        column = places.inputs.start
        third_derivatives = self.scalar.hessian_derivative(xi, weights)
        curvature.position_position[:, places.entries] -= self.amplitude * third_derivatives
        hessian_products = self.couplings.products(self.scalar.hessian(xi), weights)
        curvature.position_theta[:, :, column] -= hessian_products
        curvature.theta[:, column] -= np.einsum("ti,ti->t", weights, self.scalar.gradient(xi))
