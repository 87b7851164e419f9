"""What one quadrature point of one element contributes, as CasADi SX functions.

Every kernel has the inputs it needs of

======== ============= ==============================================================
x        3·nodes       node positions, node-major xyz [m]
v        3·nodes       node velocities [m/s]
w        3·nodes       weights on the node forces (Lagrange multipliers)
geometry 3·nodes + 1   shape gradients ∂N_a/∂X_j at 3a + j, then the volume [m³]
theta    k             constants of the material, then of the damping law, then s
carried  6             H
======== ============= ==============================================================

and outputs that are summed over points and elements. Symmetric matrices are given by their
lower triangles, column after column.

All of them are derivatives of one scalar: with the energy and the potential of the damping law,
Θ(x, v) = Σ_q V_q (ψ + ψ_d), the internal force is −∂Θ/∂x, and its virtual power wᵀf is −D_wΘ. For
Rayleigh's law that force is −∂Ψ/∂x − γ_r K v. With memory, see `memory`, the point has the energy
V_q ((1 + s) ψ + ½ H : FᵀF), and the damping law that of ψ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca

from .damping import Damping
from .elements import Element
from .kernel import PointKernel
from .materials import Material
from .mean_dilatation import averaging_kernel
from .point import By, Pieces, Point, contraction_of


@dataclass(frozen=True, eq=False)
class Law:
    """What a quadrature point obeys: a material and a damping law, with or without memory.

    θ holds the material's constants, those of the damping law and, with memory, the stiffening s.
    """

    material: Material
    damping: Damping
    memory: bool = False

    @property
    def constants(self) -> int:
        """Length of θ."""
        return len(self.material.constants) + len(self.damping.constants) + self.memory

    @property
    def carried(self) -> int:
        """How many numbers a point brings from the past."""
        return 6 if self.memory else 0

    def psi(self, F: ca.SX, theta: ca.SX) -> ca.SX:
        """Energy density at F (3, 3)."""
        return self.material.psi(F, theta[: len(self.material.constants)])

    def damping_potential(self, psi: ca.SX, F: ca.SX, rate: ca.SX, theta: ca.SX) -> ca.SX:
        """The damping law's, from the energy as an expression in F."""
        own = theta[len(self.material.constants) :]
        named = {c.name: own[k] for k, c in enumerate(self.damping.constants)}
        return self.damping.potential(psi, F, rate, **named)


def kernel_of(name: str, point: Point, scalar: ca.SX, derivatives: dict[str, By]) -> PointKernel:
    """The kernel of derivatives of a scalar of a point."""
    if point.stretches:
        return averaging_kernel(name, point, scalar, derivatives)
    pieces: Pieces = {
        key: (contraction_of(by), point.derivative(scalar, by)) for key, by in derivatives.items()
    }
    last = point.phase(name, pieces)
    return PointKernel(last.pieces, tuple(point.fields), last.contractions)


def _energy(point: Point, law: Law) -> ca.SX:
    return point.volume * law.psi(point.felt, point.theta)


def _potential(point: Point, law: Law) -> ca.SX:
    """Θ of one point, whose slope is the internal force but for the sign."""
    energy = _energy(point, law)
    damped = energy + law.damping_potential(energy, point.strain, point.strain_rate, point.theta)
    if not law.memory:
        return damped
    return damped + point.theta[-1] * energy + carried_energy(point)


def carried_energy(point: Point) -> ca.SX:
    """½ V H : FᵀF, whose slope by F is V F H."""
    F = point.felt
    return point.volume * ca.trace(symmetric(point.carried) @ F.T @ F) / 2


def symmetric(six: ca.SX) -> ca.SX:
    """A symmetric matrix from its entries xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = ca.vertsplit(six)
    return ca.blockcat([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def energy_kernel(element: Element, law: Law) -> PointKernel:
    """Elastic energy Ψ of the point [J]."""
    point = Point.of(element, law.constants, "x")
    return kernel_of("energy", point, _energy(point, law), {"energy": ()})


def force_kernel(element: Element, law: Law) -> PointKernel:
    """Elastic and damping force on the nodes [N]."""
    point = Point.of(element, law.constants, "x", "v", carried=law.carried)
    return kernel_of("force", point, -_potential(point, law), {"force": ("x",)})


def linearisation_kernel(element: Element, law: Law) -> PointKernel:
    """Force with its derivatives by position, velocity and θ (Rayleigh: −K − γ_r D_vK, −γ_r K)."""
    point = Point.of(element, law.constants, "x", "v", carried=law.carried)
    derivatives = {
        "force": ("x",),
        "by_position": ("x", "x"),
        "by_velocity": ("x", "v"),
        "by_theta": ("x", "theta"),
    }
    return kernel_of("linearisation", point, -_potential(point, law), derivatives)


def curvature_kernel(element: Element, law: Law) -> PointKernel:
    """Second derivatives of φ = wᵀ f(x, v; θ), and ∂φ/∂θ, which the chain rule needs.

    ∂²φ/∂v² vanishes and ∂²φ/∂x∂v (Rayleigh: −γ_r D_wK) is symmetric, so two lower triangles hold
    the position–velocity part.
    """
    point = Point.of(element, law.constants, "x", "v", "w", carried=law.carried)
    derivatives = {
        "position_position": ("x", "x"),
        "position_velocity": ("x", "v"),
        "position_theta": ("x", "theta"),
        "velocity_theta": ("v", "theta"),
        "theta_theta": ("theta", "theta"),
        "gradient_theta": ("theta",),
    }
    return kernel_of("curvature", point, -point.along_w(_potential(point, law)), derivatives)


KERNELS: dict[str, Callable[[Element, Law], PointKernel]] = {
    "energy": energy_kernel,
    "force": force_kernel,
    "linearisation": linearisation_kernel,
    "curvature": curvature_kernel,
}
