"""Equations of motion of one experiment at given parameters, with the chain rule to parameters.

Every force provides derivatives by the inputs u; this module turns them into derivatives by the
parameters p. Methods and statistics use `EquationsAtParameters` wherever derivatives by parameters
are needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..common.array_types import Array, Index
from ..fem.body import SecondDerivatives
from .dynamics import Dynamics
from .grasp_constraint import PrescribedDisplacements
from .inputs import Inputs


@dataclass(frozen=True, eq=False)
class EquationsAtParameters:
    """Equations of motion at parameters p = (q, φ of the motion), with the derivatives of the
    inputs.
    """

    inputs: Inputs  # inputs u as a function of p
    p: Array  # (m,): shared coordinates q, then the nuisance parameters that affect the motion
    nq: int  # length of q
    input_derivatives: Array  # (N, U, m): derivatives of the inputs by p at the N evaluations
    dynamics: Dynamics  # equations of motion at these inputs
    prescribed: PrescribedDisplacements  # prescribed displacements of the grasped dofs

    @cached_property
    def theta_p(self) -> Array:
        """Derivatives ∂θ/∂p of the constants (k, m); zero for the nuisance parameters among p."""
        return np.array(self.input_derivatives[0, : len(self.dynamics.theta)])

    def force_derivatives(self, rows: int | slice, input_slopes: Array) -> Array:
        """Return the derivatives ∂F/∂p (…, 3n, m) of the total forces at some evaluations, at fixed
        states: ∂F/∂u ∂u/∂p.

        Parameters
        ----------
        rows : int or slice
            Indices of the evaluations; … is empty for an int.
        input_slopes : (…, 3n, U)
            Derivatives of the forces by the inputs at these evaluations.
        """
        return input_slopes @ (
            self.input_derivatives[0] if self._is_constant_in_time else self.input_derivatives[rows]
        )

    @property
    def _is_constant_in_time(self) -> bool:
        """Whether ∂u/∂p is the same at all times."""
        return self.input_derivatives.strides[0] == 0

    @property
    def mass_depends_on_parameters(self) -> bool:
        """Whether the mass M depends on p: on densities, or on times at which masses join."""
        return bool(self.dynamics.forces.mass_derivatives)

    @cached_property
    def _row_input_derivatives(self) -> Array:
        """Derivatives ∂u/∂p averaged over the evaluations of each row (N, U, m)."""
        return (
            self.input_derivatives
            if self._is_constant_in_time
            else self.dynamics.evaluations_to_rows(self.input_derivatives)
        )

    def inertia_derivatives(
        self, rows: int | slice, acceleration: Array, dofs: Index | slice
    ) -> Array | float:
        """Return ∂(M a)/∂p (…, k, m) of rows at given accelerations; the number 0.0 if M is
        independent of p.

        Parameters
        ----------
        rows : int or slice
            Indices of the rows; … is empty for an int.
        acceleration : (…, k)
            Accelerations of the selected dofs [m/s²].
        dofs : (k,) or slice
            Indices of the selected dofs.
        """
        if not self.mass_depends_on_parameters:
            return 0.0
        masses = self.dynamics.forces.mass_derivatives
        by_p = self._row_input_derivatives[0 if self._is_constant_in_time else rows][
            ..., [*masses], :
        ]
        mass = np.array([*masses.values()])[:, dofs]
        return acceleration[..., None] * (mass.T @ by_p)

    def weighted_second_derivatives(
        self, x: Array, force_curvature: SecondDerivatives, row_weights: Array
    ) -> tuple[Array, Array]:
        """Return the second derivatives of Σ weights · c by (x, p), (N, 3n, m), and by p, (m, m).

        Those through prescribed positions are not included.

        Parameters
        ----------
        x : (N, 3n)
            Positions [m].
        force_curvature : SecondDerivatives
            Second derivatives of the forces at all N evaluations, by x, v and u, with the weights
            that the stencils give the forces.
        row_weights : (N, 3n)
            Weights of the residuals c.
        """
        dynamics = self.dynamics
        step_s = self.dynamics.step_s
        by_xi = force_curvature.position_theta @ self.input_derivatives
        by_nu = force_curvature.velocity_theta @ self.input_derivatives / step_s
        by_x = dynamics.combine_transposed(dynamics.state_weights, by_xi)
        by_x += dynamics.combine_transposed(dynamics.tables.q, by_nu)
        by_u = force_curvature.theta
        inertia = np.zeros_like(force_curvature.theta)
        if self.mass_depends_on_parameters:
            acceleration = dynamics.acceleration(x)
            masses = dynamics.forces.mass_derivatives
            mass = np.array([*masses.values()])
            places = [*masses]
            mass_derivatives = row_weights[..., None] * (
                mass.T @ self._row_input_derivatives[:, places]
            )
            by_x -= dynamics.combine_transposed(dynamics.tables.s, mass_derivatives) / step_s**2
            inertia[:, places] = (row_weights * acceleration) @ mass.T
            by_u = by_u - dynamics.rows_to_evaluations(inertia)
        second_order = (
            self.input_derivatives.swapaxes(1, 2)
            @ force_curvature.theta_theta
            @ self.input_derivatives
        )
        return by_x, second_order.sum(axis=0) + self.inputs.weighted_hessian(self.p, by_u)
