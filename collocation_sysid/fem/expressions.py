"""What one quadrature point of one element contributes, as CasADi SX functions.

Every kernel has the inputs it needs of

======== ============= ==============================================================
x        3·nodes       node positions, node-major xyz [m]
v        3·nodes       node velocities [m/s]
w        3·nodes       weights on the node forces (Lagrange multipliers)
geometry 3·nodes + 1   shape gradients ∂N_a/∂X_j at 3a + j, then the volume [m³]
theta    k             constants of the material, then of the damping law, then s
carried  6             H; for second derivatives 12, H and the weights σ of S; then, where there
                       is a field, its logarithm; of a stress-free shape see `rest_point`
======== ============= ==============================================================

and outputs that are summed over points and elements. Matrices are given by the lower triangles of
their symmetric part and, where they have one, of their skew part, column after column.

All of them are derivatives of two scalars: an energy Θ(x, v) = Σ_q V_q (ψ + ψ_d), with the
potential of a damping law that has one, and half the power that one with a stress dissipates,
D(x, v) = ½ Σ_q V_q P_v:Ḟ. The internal force is −∂Θ/∂x − ∂D/∂v. For Rayleigh's law that is
−∂Ψ/∂x − γ_r K v, for Kelvin and Voigt's −∂Ψ/∂x − Σ_q V_q F S_v ∇N. With memory, see `memory`,
the point has the energy V_q ((1 + s) ψ + ½ H : FᵀF), and the damping law that of ψ. Second
derivatives are then of σ·S besides, S being the second Piola–Kirchhoff stress of ψ by its entries
xx, yy, zz, xy, xz, yz.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca

from .elements import Element
from .kernel import Derivative, Outputs, Pieces, PointKernel, QuadraturePoint
from .materials import Damping, Material
from .mean_dilatation import averaging_kernel
from .rest_point import RestPoint

# Bodies of the same law and element share their kernels: so many of these are kept.
KEPT = 64


@dataclass(frozen=True)
class Law:
    """What a quadrature point obeys: a material and a damping law, with or without memory.

    θ holds the material's constants, those of the damping law and, with memory, the stiffening s.
    Those at the places `scaled` are multiplied by a field. With a stress-free shape `rest` that is
    not the mesh, the changes of the inputs of that follow.
    """

    material: Material
    damping: Damping
    memory: bool = False
    scaled: tuple[int, ...] = ()
    rest: RestPoint | None = None

    @property
    def constants(self) -> int:
        """Length of θ."""
        own = len(self.material.constants) + len(self.damping.constants) + self.memory
        return own + (self.rest.inputs if self.rest else 0)

    @property
    def carried(self) -> int:
        """How many numbers a point brings from the past."""
        return 6 if self.memory else 0

    def psi(self, F: ca.SX, theta: ca.SX) -> ca.SX:
        """Energy density at F (3, 3)."""
        return self.material.psi(F, theta[: len(self.material.constants)])

    def damping_potential(self, psi: ca.SX, F: ca.SX, rate: ca.SX, theta: ca.SX) -> ca.SX:
        """That of the damping law, from the energy as an expression in F; 0 where it has none."""
        potential = self.damping.potential
        return potential(psi, F, rate, **self._of_damping(theta)) if potential else ca.SX(0)

    def damping_stress(self, F: ca.SX, rate: ca.SX, theta: ca.SX) -> tuple[ca.SX, ca.SX] | None:
        """P_v and ∂P_v/∂F of the damping law at F and Ḟ, stacked (9,); none, where it has none."""
        if not self.damping.stress:
            return None
        own_F, own_rate = ca.SX.sym("F", 9), ca.SX.sym("rate", 9)
        psi = self.psi(ca.reshape(own_F, 3, 3), theta)
        found = self.damping.stress(psi, own_F, own_rate, **self._of_damping(theta))
        own, given = ca.vertcat(own_F, own_rate), ca.vertcat(F, rate)
        stress, slope = ca.substitute(list(found), [own], [given])
        return stress, slope

    def _of_damping(self, theta: ca.SX) -> dict[str, ca.SX]:
        own = theta[len(self.material.constants) :]
        return {c.name: own[k] for k, c in enumerate(self.damping.constants)}


def point_of(
    element: Element, law: Law, *fields: str, carried: int | None = None
) -> QuadraturePoint:
    """A point of an element that obeys a law."""
    brought = law.carried if carried is None else carried
    return QuadraturePoint.of(
        element, law.constants, *fields, carried=brought, scaled=law.scaled, rest=law.rest
    )


def kernel_of(name: str, point: QuadraturePoint, outputs: Outputs) -> PointKernel:
    """The kernel of derivatives of scalars of a point."""
    if point.stretches:
        return averaging_kernel(name, point, outputs)
    pieces: Pieces = {}
    for key, terms in outputs.items():
        found = [
            # What is known is by the material's own gradient, which that of the mesh is not.
            term.of(
                point.derivative(term.scalar, term.by)
                if term.known is None or point.rest is not None
                else term.known
            )
            for term in terms
        ]
        pieces[key] = terms[0].contraction, sum(found[1:], found[0])
    last = point.phase(name, pieces)
    return PointKernel(last.pieces, tuple(point.fields), last.contractions)


def _energy(point: QuadraturePoint, law: Law) -> ca.SX:
    return point.volume * law.psi(point.felt, point.constants)


def _potential(point: QuadraturePoint, law: Law) -> ca.SX:
    """Θ of one point, whose slope by x is an internal force but for the sign."""
    energy = _energy(point, law)
    drag = law.damping_potential(energy, point.strain, point.strain_rate, point.constants)
    damped = energy + drag
    if not law.memory:
        return damped
    return damped + point.theta[-1] * energy + carried_energy(point)


def carried_energy(point: QuadraturePoint) -> ca.SX:
    """½ V H : FᵀF, whose slope by F is V F H."""
    F = point.felt
    return point.volume * ca.trace(symmetric(point.carried[:6]) @ F.T @ F) / 2


def symmetric(six: ca.SX) -> ca.SX:
    """A symmetric matrix from its entries xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = ca.vertsplit(six)
    return ca.blockcat([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


UPPER = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def six_of(matrix: ca.SX) -> ca.SX:
    """Those entries of a symmetric matrix."""
    return ca.vertcat(*[matrix[a, b] for a, b in UPPER])


def first_piola(point: QuadraturePoint, law: Law) -> ca.SX:
    """P (9,) = ∂ψ/∂F."""
    return ca.gradient(law.psi(point.felt, point.constants), point.gradients["x"])


def second_piola(point: QuadraturePoint, law: Law) -> ca.SX:
    """S (6,) = F⁻¹ P."""
    return six_of(ca.inv_minor(point.felt) @ ca.reshape(first_piola(point, law), 3, 3))


def _damping(point: QuadraturePoint, law: Law) -> tuple[ca.SX, ca.SX] | None:
    """V P_v of one point, and its slope by F."""
    found = law.damping_stress(ca.vec(point.felt), point.felt_rate, point.constants)
    return None if found is None else (point.volume * found[0], point.volume * found[1])


@lru_cache(KEPT)
def energy_kernel(element: Element, law: Law) -> PointKernel:
    """Elastic energy Ψ of the point [J]."""
    point = point_of(element, law, "x", carried=0)
    return kernel_of("energy", point, {"energy": (Derivative(_energy(point, law), ()),)})


@lru_cache(KEPT)
def force_kernel(element: Element, law: Law) -> PointKernel:
    """Elastic and damping force on the nodes [N]."""
    point = point_of(element, law, "x", "v")
    force = (Derivative(-_potential(point, law), ("x",)),)
    if found := _damping(point, law):
        stress = -found[0]
        force += (Derivative(ca.dot(stress, point.felt_rate) / 2, ("v",), known=stress),)
    return kernel_of("force", point, {"force": force})


@lru_cache(KEPT)
def linearisation_kernel(element: Element, law: Law) -> PointKernel:
    """Force with its derivatives by position, velocity and θ (Rayleigh: −K − γ_r D_vK, −γ_r K)."""
    point = point_of(element, law, "x", "v")
    potential = -_potential(point, law)
    outputs: Outputs = {
        "force": (Derivative(potential, ("x",)),),
        "by_position": (Derivative(potential, ("x", "x")),),
        "by_velocity": (Derivative(potential, ("x", "v")),),
        "by_theta": (Derivative(potential, ("x", "theta")),),
    }
    if found := _damping(point, law):
        stress, slope = -found[0], -found[1]
        # Half the power lost, which is quadratic in the rate: its slope by that is the stress.
        lost = ca.dot(stress, point.felt_rate) / 2
        by_rate = ca.jacobian(stress, point.gradients["v"])
        by_theta = ca.jacobian(stress, point.varied)
        outputs["force"] += (Derivative(lost, ("v",), known=stress),)
        outputs["by_position"] += (Derivative(lost, ("v", "x"), "symmetric", slope),)
        outputs["by_velocity"] += (Derivative(lost, ("v", "v"), known=by_rate),)
        outputs["by_theta"] += (Derivative(lost, ("v", "theta"), known=by_theta),)
        outputs["by_position_skew"] = (Derivative(lost, ("v", "x"), "skew", slope),)
    return kernel_of("linearisation", point, outputs)


@lru_cache(KEPT)
def curvature_kernel(element: Element, law: Law) -> PointKernel:
    """Second derivatives of φ = wᵀ f(x, v; θ) + σ·S, and ∂φ/∂θ, which the chain rule needs.

    ∂²φ/∂v² vanishes. ∂²φ/∂x∂v is symmetric where the force follows from a potential (Rayleigh:
    −γ_r D_wK).
    """
    point = point_of(element, law, "x", "v", "w", carried=2 * law.carried)
    power = -point.along_w(_potential(point, law))
    if law.memory:
        power += ca.dot(point.brought[6:], second_piola(point, law))
    if found := _damping(point, law):
        power -= ca.dot(found[0], point.felt_weight)
    mixed = Derivative(power, ("x", "v"), "symmetric" if found else "whole")
    outputs: Outputs = {
        "position_position": (Derivative(power, ("x", "x")),),
        "position_velocity": (mixed,),
        "position_theta": (Derivative(power, ("x", "theta")),),
        "velocity_theta": (Derivative(power, ("v", "theta")),),
        "theta_theta": (Derivative(power, ("theta", "theta")),),
        "gradient_theta": (Derivative(power, ("theta",)),),
    }
    if found:
        outputs["position_velocity_skew"] = (replace(mixed, part="skew"),)
    return kernel_of("curvature", point, outputs)


KERNELS: dict[str, Callable[[Element, Law], PointKernel]] = {
    "energy": energy_kernel,
    "force": force_kernel,
    "linearisation": linearisation_kernel,
    "curvature": curvature_kernel,
}
