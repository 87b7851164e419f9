"""Residual of nonlinear equations and its derivative at a state, for Newton's method.

In a nearly incompressible body the pressures that follow from an iterate's volumes are those of the
solution only near the solution: after a step ε the volumes are wrong by about ε², and with a bulk
modulus of a thousand shear moduli these errors are the largest stresses. They belong to the
residual, where the next step removes them, but in the derivative they make geometric stiffness that
has nothing to do with the solution: steps are shortened a thousandfold.

`LaggedStress` therefore states the derivative as if each element's mean stress σ were an unknown of
its own, beside the positions, with the equation σ = σ(x) (perturbed Lagrangian; Simo, Taylor and
Pister 1985). Eliminating σ from the linearised equations leaves the residual of the positions
alone, and the derivative with σ(x) + σ'(x) δ, the stress to which the last step δ led to first
order, in place of the stress after the step. Both have the same limit, so the solution is the same
and convergence remains quadratic (Magisano, Leonetti and Garcea, Comput. Methods Appl. Mech. Engrg.
313, 2017, for all stresses).

Searches for equilibria use it only while the loads grow in steps (`load_steps`): after a long step
under the complete load the stiffness is indefinite at stresses that the iterates really have.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ...common.array_types import Array
from ...model.forces import Forces

# Part of a step over which stresses are differentiated, over the body's size.
DIFFERENCE = 1e-6


class NewtonLinearisation(NamedTuple):
    """Residual r and its derivative at a state x."""

    residual: Array  # (3n,): residual [N]
    symmetric: Array  # (m,): lower triangle of the symmetric part of −∂r/∂x [N/m]
    # (m,) or (0,): lower triangle of the skew part of −∂r/∂x; empty for a symmetric derivative.
    skew: Array


@dataclass(frozen=True, eq=False)
class LaggedStress:
    """Mean stresses of the elements as functions of the positions of Newton's method; of a rod all
    resultants, with which the same holds for stretch and shear, and the rigidity of sections.
    """

    forces: Forces  # forces in the residual
    # Positions ξ [m] and velocities ν [m/s], (1, 3n) each, at which they are evaluated, of the
    # positions x (3n,).
    states: Callable[[Array], tuple[Array, Array]]
    weight: float = 1.0  # derivative of ξ by x times the factor of the forces in the residual
    velocity_slope: float = 0.0  # derivative of ν by ξ [1/s]

    def at(self, x: Array) -> Array:
        """Return the mean stresses (E,) [Pa] at x (3n,) [m]; of another body the resultants [J] (T, any) in
        each of T states.
        """
        if self.forces.body.is_solid:
            return self.forces.mean_stresses(*self.states(x), self.velocity_slope)
        return self.forces.resultants(*self.states(x), self.velocity_slope)

    def after(self, x: Array, step: Array) -> Array:
        """Return the mean stresses (E,) [Pa] to which a step (3n,) from x (3n,) [m] leads to first
        order.
        """
        size_m = float(np.linalg.norm(np.ptp(self.forces.body.nodes_m, axis=0)))
        part = DIFFERENCE * size_m / max(float(np.abs(step).max()), DIFFERENCE * size_m)
        change = self.at(x + part * step) - self.at(x - part * step)
        return self.at(x) + change / (2 * part)

    def expecting(
        self, stress_pa: Array, linearise: Callable[[Array], NewtonLinearisation]
    ) -> Callable[[Array], NewtonLinearisation]:
        """Return `linearise` with the mean stresses `stress_pa` (E,), see `replace_stress`."""
        return lambda x: self.replace_stress(linearise(x), x, stress_pa)

    def replace_stress(
        self, at: NewtonLinearisation, x: Array, stress_pa: Array
    ) -> NewtonLinearisation:
        """Return the linearisation at x (3n,) [m] with the mean stresses `stress_pa` (E,) in place
        of those of x in its derivative; for another body with its resultants.
        """
        stiffness = self.weight * self.stiffness(x, stress_pa - self.at(x))
        return at._replace(symmetric=at.symmetric + stiffness)

    def stiffness(self, x: Array, stress_pa: Array) -> Array:
        """Return the lower triangle (m,) [N/m] of the part of the stiffness by ξ that mean stresses
        (E,) [Pa], or resultants (1, any) [J], have at x (3n,) [m].
        """
        xi, _ = self.states(x)
        body = self.forces.body
        own = (
            body.volume_stiffness(xi[0], stress_pa)[None]
            if body.is_solid
            else body.resultant_stiffness(xi, stress_pa, self.forces.theta)
        )
        return self.forces.joint_pattern.expand(own).reshape(*x.shape[:-1], -1)
