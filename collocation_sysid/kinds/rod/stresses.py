"""Stresses of a rod that are given, as variables of a program.

With stresses s, in place of the strains ε of an element, the force (∂ε/∂x)ᵀ (C (ε + γ_r ε̇) − s) is
added to those of its energy and damping, at the guess of the stiffness C and of γ_r. It is zero at
s = C (ε + γ_r ε̇); the derivative of both by x contains s alone, and not the stretch of second order
that a rotation adds to a linear step, times the stiffness or the viscosity. This is the mixed form of
Newton's method (Magisano, Leonetti & Garcea 2017).

The equations C⁻¹ s = ε + γ_r ε̇ are scaled, and s by the same factors, such that the factor of s is at
most one; the matrix then stays bounded however stiff the rod is along itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Self

import casadi as ca
import numpy as np

from ...common.array_types import Array, Index
from ...fem.body import Body
from ...fem.elements import ROD
from ...fem.force_points import ForcePoints
from ...fem.pattern import JointPattern
from ...model.force_term import AssemblyIndices, States
from ...model.forces import Forces
from ...model.generated_functions import GeneratedFunction
from ...model.point_forces import ComplementarityForce, PreviousState
from .element import RESULTANTS, STRAINS, RodMaterial, RodMesh, strains_with_sections

DOFS = 3 * ROD.nodes
# Data of an element: those of its rest shape, then the stiffnesses by the unit of energy, this, and
# γ_r of the guess.
REST = ROD.nodes * ROD.columns + ROD.rest_values


@dataclass(frozen=True, eq=False)
class GivenStresses(ComplementarityForce):
    """Force of the given stresses b, scaled, less those of the strains.

    What `ComplementarityForce` calls the residuals of a condition are the scaled equations of b.
    """

    points: ForcePoints  # elements, with their nodes
    element_data: Array  # (d, 1, E)
    factor: float = 1.0
    previous_state: PreviousState | None = None  # given stresses; without any there is no force
    variable_weights: Array | None = None
    size = 0
    is_complementarity = True
    pressure_unit_m = 1.0

    @classmethod
    def from_body(cls, body: Body, theta: Array, energy_j: float) -> GivenStresses:
        """Return the force with the stiffness at constants θ (k,), and a unit of energy."""
        geometry = body.geometry[:, 0]
        assert isinstance(body.mesh, RodMesh)
        lengths_m = geometry[:, -1:] / body.mesh.section.area_m2
        stiffness = stiffnesses(body, theta) * lengths_m / energy_j
        # The section that two elements have in common has one stress, that of the first element.
        stiffness[:-1, STRAINS + 3 :] += stiffness[1:, STRAINS : STRAINS + 3]
        stiffness[1:, STRAINS : STRAINS + 3] = 0.0
        others = np.empty((len(stiffness), 2))
        for part, values in zip(body.parts, body.split_theta(theta), strict=True):
            viscous_s = values[len(part.material.constants)] if part.damping.stress else 0.0
            others[part.cells] = energy_j, viscous_s
        data = np.hstack([geometry[:, :REST], stiffness, others])
        points = ForcePoints.at_nodes(body.cells, len(body.nodes_m))
        return cls(points, data.T[:, None])

    def added_to(self, forces: Forces) -> Forces:
        """Return forces on the body with this one, the last of the external terms."""
        couplings = [each.couplings for each in (*forces.terms, self)]
        pattern = JointPattern.from_patterns(
            (forces.body.pattern, *(each for each in couplings if each is not None))
        )
        return replace(forces, external_terms=(*forces.external_terms, self), joint_pattern=pattern)

    @property
    def internal_variable_count(self) -> int:  # type: ignore[override]
        return 0 if self.previous_state is None else RESULTANTS

    @property
    def law(self) -> GeneratedFunction:
        return _law(self.previous_state is not None)

    def with_inputs(self, u: Array) -> Self:
        return self

    def constants(self, states: States) -> Array:
        return np.zeros((0, 1))

    def constant_columns(self, places: AssemblyIndices) -> Index:
        return np.zeros(0, dtype=np.int64)

    def data(self, chosen: Index | None) -> Array:
        return self.element_data

    @staticmethod
    def unit_moment_n_m(body: Body, theta: Array) -> float:
        """Return the moment that bends a rod by 1 rad, from end to end."""
        assert isinstance(body.mesh, RodMesh)
        return float(stiffnesses(body, theta)[:, 3:5].mean()) / float(body.mesh.s_m[-1])

    def scaled_pressures(self, xi: Array, nu: Array | None = None) -> Array:
        """Return the stresses b (12, T, E) at positions ξ (T, 3n) [m] and velocities ν."""
        y = self.points.vectors(xi)
        rate = self.points.vectors(np.zeros_like(xi) if nu is None else nu)
        data = np.broadcast_to(self.element_data, (len(self.element_data), *y.shape[1:]))
        nothing = np.zeros((RESULTANTS, *y.shape[1:]))
        strains = -_law(True).evaluate(np.concatenate([y, rate, nothing]), data)[DOFS:]
        return np.maximum(data[REST:-2], 1.0) * strains


def stiffnesses(body: Body, theta: Array) -> Array:
    """Return the stiffnesses (E, 12) of `RodMaterial.all_stiffnesses` of each element."""
    stiffness = np.empty((len(body.cells), RESULTANTS))
    for part, values in zip(body.parts, body.split_theta(theta), strict=True):
        assert isinstance(part.material, RodMaterial)
        stiffness[part.cells] = part.material.all_stiffnesses(
            values[: len(part.material.constants)]
        )
    return stiffness


@cache
def _law(is_given: bool) -> GeneratedFunction:
    """Return the law (F, scaled equations) of an element at (y, ẏ, b); F = 0 at (y, ẏ) alone."""
    size, data_size = 2 * DOFS, REST + RESULTANTS + 2
    if not is_given:
        return GeneratedFunction(lambda u, data: ca.SX(DOFS, 1), size, data_size)

    def law(u: ca.SX, data: ca.SX) -> ca.SX:
        y, rate, given = ca.vertsplit(u, [0, DOFS, size, size + RESULTANTS])
        own = REST - ROD.rest_values
        slopes = ca.reshape(data[:own], ROD.columns, ROD.nodes)
        strain = strains_with_sections(ca.reshape(y, 3, ROD.nodes) @ slopes.T, data[own])
        weights = ca.SX.sym("weights", RESULTANTS)
        force = -data[-2] * ca.jtimes(strain, y, weights, True)
        damped = data[-1] * ca.jtimes(strain[:STRAINS], y, rate)
        strain[:STRAINS] += damped - data[REST - STRAINS : REST]
        stiffness = data[REST:-2]
        scale = ca.sqrt(ca.fmin(stiffness, 1))
        force = ca.substitute(force, weights, scale * given - stiffness * strain)
        return ca.vertcat(force, given / ca.fmax(stiffness, 1) - scale * strain)

    return GeneratedFunction(law, size + RESULTANTS, data_size, is_compiled=True)
