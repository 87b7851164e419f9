"""Simulation of the swung cylinder of `peer_case` by finite elements of scikit-fem."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
import skfem.helpers
from numpy.typing import NDArray
from peer_case import (
    GRAVITY_M_S2,
    NODE_MASS_KG,
    SAMPLE_COUNT,
    SAMPLE_S,
    STEPS_PER_SAMPLE,
    cylinder,
    grasped_nodes,
    grasped_positions,
    lame_constants,
)
from scipy.sparse import diags_array
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementTetP1, ElementVector, LinearForm, MeshTet

Array = NDArray[np.float64]
# Untyped: scikit-fem's annotations exclude what its helpers return.
tensors: Any = skfem.helpers

# Largest residual force of Newton's method; a node weighs 6 mN [N].
NEWTON_TOLERANCE_N = 1e-8
MOST_NEWTON_STEPS = 30


class ScikitFemCylinder:
    """The cylinder assembled by scikit-fem, integrated by the implicit midpoint rule."""

    def __init__(self) -> None:
        case = cylinder()
        self.rest_m = case.points_m
        mesh = MeshTet(case.points_m.T, np.asarray(case.tetrahedra).T)
        element = ElementVector(ElementTetP1())
        self.basis = Basis(mesh, element, intorder=1)
        self.mass_kg = np.full(self.rest_m.size, NODE_MASS_KG)
        nodes = grasped_nodes(case)
        self.prescribed = (3 * nodes[:, None] + np.arange(3)).ravel()
        self.free = np.setdiff1d(np.arange(self.rest_m.size), self.prescribed)
        self.step_s = SAMPLE_S / STEPS_PER_SAMPLE
        count = (SAMPLE_COUNT - 1) * STEPS_PER_SAMPLE + 1
        grasp_positions_m = grasped_positions(case, self.step_s * np.arange(count))
        self.prescribed_m = grasp_positions_m.reshape(count, -1)
        self.order = _node_major_order(self.basis, self.rest_m)

    def simulate(self, values: Mapping[str, float]) -> Array:
        """Return the node positions (T, n, 3) [m] at the samples, from equilibrium.

        Raises RuntimeError if Newton's method does not converge.
        """
        lame = lame_constants(values)
        x = self._equilibrium(lame)
        v = np.zeros_like(x)
        samples = [x]
        for step in range(1, len(self.prescribed_m)):
            middle_velocity = self._midpoint_velocity(
                x, v, self.prescribed_m[step], lame, values["gamma_r_s"]
            )
            x = x + self.step_s * middle_velocity
            v = 2 * middle_velocity - v
            if step % STEPS_PER_SAMPLE == 0:
                samples.append(x)
        return np.array(samples).reshape(len(samples), -1, 3)

    def _equilibrium(self, lame: tuple[float, float]) -> Array:
        """Return the static positions (3 n,) [m] under gravity, by Newton's method in load steps."""
        x = self.rest_m.ravel().copy()
        x[self.prescribed] = self.prescribed_m[0]
        weight = self.mass_kg * np.tile(GRAVITY_M_S2, len(self.rest_m))
        for share in (0.25, 0.5, 0.75, 1.0):
            for _ in range(MOST_NEWTON_STEPS):
                force = self._force(x, 0 * x, lame, damping_s=0.0)
                residual = (force - share * weight)[self.free]
                if np.abs(residual).max() < NEWTON_TOLERANCE_N:
                    break
                stiffness = self._tangent(x, 0 * x, lame, damping_s=0.0, position=1.0, velocity=0.0)
                x[self.free] -= self._solve(stiffness, residual)
        return x

    def _midpoint_velocity(
        self, x: Array, v: Array, end_m: Array, lame: tuple[float, float], damping_s: float
    ) -> Array:
        """Return the velocity (3 n,) at the middle of a step that ends at prescribed positions."""
        u = v.copy()
        u[self.prescribed] = (end_m - x[self.prescribed]) / self.step_s
        weight = self.mass_kg * np.tile(GRAVITY_M_S2, len(self.rest_m))
        for _ in range(MOST_NEWTON_STEPS):
            middle = x + 0.5 * self.step_s * u
            inertia = self.mass_kg * 2 * (u - v) / self.step_s
            force = self._force(middle, u, lame, damping_s)
            residual = (inertia + force - weight)[self.free]
            if np.abs(residual).max() < NEWTON_TOLERANCE_N:
                return u
            tangent = self._tangent(
                middle, u, lame, damping_s, position=0.5 * self.step_s, velocity=1.0
            ) + diags_array(2 * self.mass_kg / self.step_s)
            u[self.free] -= self._solve(tangent, residual)
        raise RuntimeError("Newton's method did not converge")

    def _solve(self, matrix: Any, residual: Array) -> Array:
        """Return the Newton step of the free unknowns."""
        free = self.free
        return splu(matrix.tocsc()[free][:, free]).solve(residual)

    def _force(self, x: Array, v: Array, lame: tuple[float, float], damping_s: float) -> Array:
        """Return the internal forces (3 n,) [N]."""
        fields = self._fields(x, v)
        vector = _internal_force().assemble(self.basis, **fields, lame=lame, damping_s=damping_s)
        return vector[self.order]

    def _tangent(
        self,
        x: Array,
        v: Array,
        lame: tuple[float, float],
        damping_s: float,
        *,
        position: float,
        velocity: float,
    ) -> Any:
        """Return the derivative of the forces where positions and velocities change by these."""
        fields = self._fields(x, v)
        matrix = _internal_tangent().assemble(
            self.basis,
            **fields,
            lame=lame,
            damping_s=damping_s,
            position=position,
            velocity=velocity,
        )
        return matrix.tocsr()[self.order][:, self.order]

    def _fields(self, x: Array, v: Array) -> dict[str, Any]:
        """Return displacement and velocity as fields of the basis."""
        displacement = np.empty_like(x)
        displacement[self.order] = x - self.rest_m.ravel()
        speed = np.empty_like(v)
        speed[self.order] = v
        return {
            "displacement": self.basis.interpolate(displacement),
            "speed": self.basis.interpolate(speed),
        }


def _node_major_order(basis: Basis, nodes_m: Array) -> NDArray[np.intp]:
    """Return the unknown of the basis for each coordinate of each node."""
    dofs: Any = basis.nodal_dofs
    return dofs.T.ravel()[: nodes_m.size]


def _isotropic(strain: Array, lame: tuple[float, float]) -> Array:
    """Return λ tr(strain) I + 2 μ strain."""
    unit = tensors.identity(strain)
    return lame[0] * tensors.trace(strain) * unit + 2 * lame[1] * strain


def _symmetric(tensor: Array) -> Array:
    """Return the symmetric part of a tensor field."""
    return 0.5 * (tensor + tensors.transpose(tensor))


def _state(w: Any) -> tuple[Array, Array]:
    """Return F and the second Piola–Kirchhoff stress of elasticity and damping."""
    F = tensors.grad(w["displacement"]) + tensors.identity(tensors.grad(w["displacement"]))
    rate = tensors.grad(w["speed"])
    strain = 0.5 * (tensors.mul(tensors.transpose(F), F) - tensors.identity(F))
    strain_rate = _symmetric(tensors.mul(tensors.transpose(F), rate))
    stress = _isotropic(strain + w["damping_s"] * strain_rate, w["lame"])
    return F, stress


@functools.cache
def _internal_force() -> LinearForm:
    """Return the form of the virtual work P : ∇v."""

    @LinearForm
    def work(v, w):
        F, stress = _state(w)
        return tensors.ddot(tensors.mul(F, stress), tensors.grad(v))

    return work


@functools.cache
def _internal_tangent() -> BilinearForm:
    """Return the derivative of the virtual work along u."""

    @BilinearForm
    def work(u, v, w):
        F, stress = _state(w)
        dF = w["position"] * tensors.grad(u)
        d_rate = w["velocity"] * tensors.grad(u)
        d_strain = _symmetric(tensors.mul(tensors.transpose(F), dF))
        d_strain_rate = _symmetric(
            tensors.mul(tensors.transpose(dF), tensors.grad(w["speed"]))
            + tensors.mul(tensors.transpose(F), d_rate)
        )
        d_stress = _isotropic(d_strain + w["damping_s"] * d_strain_rate, w["lame"])
        return tensors.ddot(tensors.mul(dF, stress) + tensors.mul(F, d_stress), tensors.grad(v))

    return work
