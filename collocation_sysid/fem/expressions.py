"""Contribution of one quadrature point of one element, as CasADi SX functions.

A kernel has the inputs it needs of

======== ============= ==============================================================
x        3·nodes       node positions, node-major xyz [m]
v        3·nodes       node velocities [m/s]
w        3·nodes       weights on the node forces (Lagrange multipliers)
geometry 3·nodes + 1   shape gradients ∂N_a/∂X_j at 3a + j, then the volume [m³]
theta    k             constants of the material, then of the damping law, then s
carried  6             H; for second derivatives 12, H and the weights σ of S; then, if there
                       is a field, its logarithm; for a stress-free shape see `rest_point_layout`
======== ============= ==============================================================

Its outputs are summed over points and elements. Matrices are given by the lower triangles of their
symmetric part and, if they have one, of their skew part, column after column.

All kernels are derivatives of two scalars: an energy Θ(x, v) = Σ_q V_q (ψ + ψ_d), with the
potential ψ_d of a damping law that has one, and half the power dissipated by a damping law that is
a stress, D(x, v) = ½ Σ_q V_q P_v:Ḟ. The internal force is −∂Θ/∂x − ∂D/∂v. For Rayleigh's law that
is −∂Ψ/∂x − γ_r K v, for Kelvin and Voigt's −∂Ψ/∂x − Σ_q V_q F S_v ∇N. With memory, see `memory`,
the energy of the point is V_q ((1 + s) ψ + ½ H : FᵀF), and the damping law uses ψ alone. Second
derivatives then include those of σ·S, with the second Piola–Kirchhoff stress S of ψ by its entries
xx, yy, zz, xy, xz, yz.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca

from .elements import Element
from .kernel import Derivative, ElementKernel, Outputs, Pieces, QuadraturePoint
from .laws.materials import DampingLaw, Material, StrainMaterial, damped_psi
from .laws.mean_dilatation import averaging_kernel
from .rest_point_layout import RestPointLayout

# Number of kernels of each kind kept in memory, shared by bodies of the same law and element.
CACHED_KERNELS = 64


@dataclass(frozen=True)
class PointLaw:
    """Law of a quadrature point: a material and a damping law, with or without memory.

    The constants θ are those of the material, those of the damping law and, with memory, the
    stiffening s. With a stress-free shape that is not the mesh, changes of the shape's inputs
    follow.
    """

    material: Material
    damping: DampingLaw
    has_memory: bool = False  # whether the point has a memory
    scaled_indices: tuple[int, ...] = ()  # indices in θ of the constants that a field multiplies
    # Layout of the data of the stress-free shape; None if the mesh is stress-free.
    rest: RestPointLayout | None = None

    @property
    def constant_count(self) -> int:
        """Number of entries of θ at a point: constants of material and damping law, the
        stiffening by memory, and changes of the inputs of the stress-free shape.
        """
        count = len(self.material.constants) + len(self.damping.constants) + self.has_memory
        return count + (self.rest.input_count if self.rest else 0)

    def psi(self, F: ca.SX, theta: ca.SX) -> ca.SX:
        """Return the energy density [J/m³] at the deformation gradient F (3, 3), from the constants
        `theta` of the law, which begin with those of the material.
        """
        return self.material.psi(F, theta[: len(self.material.constants)])

    def damping_potential(self, psi: ca.SX, F: ca.SX, rate: ca.SX, theta: ca.SX) -> ca.SX:
        """Return the density ψ_d of the potential of the damping law; 0 if it has none.

        Parameters
        ----------
        psi : SX
            Energy density as an expression in F.
        F, rate : SX
            Stacked deformation gradient, with m if the dilatation is averaged, and its rate;
            further symbols of `psi` and their rates may follow if the law accepts them.
        theta : (k,) SX
            Constants of the law.
        """
        potential = self.damping.potential
        return potential(psi, F, rate, **self._damping_constants(theta)) if potential else ca.SX(0)

    def damping_stress(
        self, F: ca.SX, rate: ca.SX, theta: ca.SX, rest_values: ca.SX
    ) -> tuple[ca.SX, ca.SX] | None:
        """Return P_v (g,) and ∂P_v/∂F (g, g) of the damping law.

        None if it has a potential instead.

        Parameters
        ----------
        F, rate : (g,) SX
            Stacked deformation gradient and its rate.
        theta : (k,) SX
        rest_values : SX
            See `QuadraturePoint.rest_values`.
        """
        if not self.damping.stress:
            return None
        if isinstance(self.material, StrainMaterial):
            values = ca.vertcat(theta[: len(self.material.constants)], rest_values)
            gradient = ca.SX.sym("G", F.numel())
            stress, slope = self.material.viscous_stress(
                gradient, rate, values, **self._damping_constants(theta)
            )
            stress, slope = ca.substitute([stress, slope], [gradient], [F])
            return stress, slope
        F_symbol = ca.SX.sym("F", 9)
        rate_symbol = ca.SX.sym("rate", 9)
        psi = damped_psi(self.damping, self.material, ca.reshape(F_symbol, 3, 3), theta)
        expressions = self.damping.stress(
            psi, F_symbol, rate_symbol, **self._damping_constants(theta)
        )
        symbols = ca.vertcat(F_symbol, rate_symbol)
        values = ca.vertcat(F, rate)
        stress, slope = ca.substitute(list(expressions), [symbols], [values])
        return stress, slope

    def _damping_constants(self, theta: ca.SX) -> dict[str, ca.SX]:
        constants = theta[len(self.material.constants) :]
        return {c.name: constants[k] for k, c in enumerate(self.damping.constants)}


def quadrature_point(
    element: Element, law: PointLaw, *fields: str, internal_variable_count: int | None = None
) -> QuadraturePoint:
    """Return the symbols of a quadrature point of an element that obeys a law.

    Parameters
    ----------
    *fields : str
        Node fields: "x", and if needed "v" and "w".
    internal_variable_count : int, optional
        Number of internal variables; by default that of the law.
    """
    count = (
        (6 if law.has_memory else 0) if internal_variable_count is None else internal_variable_count
    )
    point = QuadraturePoint.from_element(
        element,
        law.constant_count,
        *fields,
        internal_variable_count=count,
        scaled=law.scaled_indices,
        rest=law.rest,
    )
    rule = law.material.chain_rule(
        point.compute_material_gradient(), _material_constants(point, law)
    )
    return replace(point, rule=rule)


def kernel_from_outputs(name: str, point: QuadraturePoint, outputs: Outputs) -> ElementKernel:
    """Return the kernel of a name whose outputs are sums of derivatives of scalars of a quadrature
    point.

    With mean dilatation (`point.stretches`) it is an averaging kernel, see `mean_dilatation`.
    """
    if point.stretches:
        return averaging_kernel(name, point, outputs=outputs)
    pieces: Pieces = {}
    for key, terms in outputs.items():
        summands = [
            # Known derivatives are by the material's deformation gradient; with a stress-free
            # shape that differs from the gradient with respect to the mesh.
            term.select_part(
                point.derivative(term.scalar, term.by)
                if term.known is None or point.rest is not None
                else term.known
            )
            for term in terms
        ]
        pieces[key] = (terms[0].choose_contraction(), sum(summands[1:], summands[0]))
    last = point.make_phase(name, pieces)
    return ElementKernel(last.pieces, tuple(point.fields), contractions=last.contractions)


def _energy(point: QuadraturePoint, law: PointLaw) -> ca.SX:
    """Return the elastic energy V ψ of a point."""
    return point.compute_volume() * _energy_density(point, law)


def _energy_density(point: QuadraturePoint, law: PointLaw) -> ca.SX:
    """Return ψ: a symbol of `point.rule` if the material provides one, else an expression."""
    constants = _material_constants(point, law)
    return law.material.psi_in(point.rule, point.compute_material_gradient(), values=constants)


def _material_constants(point: QuadraturePoint, law: PointLaw) -> ca.SX:
    return ca.vertcat(point.scale_constants()[: len(law.material.constants)], point.rest_values)


def _potential(point: QuadraturePoint, law: PointLaw) -> ca.SX:
    """Return Θ [J] of a point: elastic energy, damping potential, energy of the overstress."""
    energy = _energy(point, law)
    damped = energy + _damping_potential(point, law, energy=energy)
    if not law.has_memory:
        return damped
    return damped + point.theta[-1] * energy + memory_energy(point)


def _damping_potential(point: QuadraturePoint, law: PointLaw, energy: ca.SX) -> ca.SX:
    """Return the damping potential V ψ_d of a point from its elastic energy V ψ; zero without one."""
    strain = point.stack_strain_symbols()
    rate = ca.vertcat(point.gradients["v"], *point.stretches[1:2])
    if law.damping.accepts_symbols:
        symbols, rates = point.rule.rates(strain, rate)
        strain = ca.vertcat(strain, symbols)
        rate = ca.vertcat(rate, rates)
    elif law.damping.potential:
        (energy,) = point.rule.eliminate([energy])
    return law.damping_potential(energy, strain, rate=rate, theta=point.scale_constants())


def memory_energy(point: QuadraturePoint) -> ca.SX:
    """Return ½ V H : FᵀF, the energy of the overstress, whose derivative by F is V F H."""
    F = point.compute_material_gradient()
    return point.compute_volume() * ca.trace(symmetric_matrix(point.point_data[:6]) @ F.T @ F) / 2


def symmetric_matrix(six: ca.SX) -> ca.SX:
    """Return a symmetric matrix from its entries xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = ca.vertsplit(six)
    return ca.blockcat([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


# Rows and columns of the entries xx, yy, zz, xy, xz, yz of a symmetric matrix.
UPPER = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def six_entries(matrix: ca.SX) -> ca.SX:
    """Return the entries xx, yy, zz, xy, xz, yz (6,) of a symmetric matrix (3, 3); entries below
    the diagonal are not read.
    """
    return ca.vertcat(*[matrix[a, b] for a, b in UPPER])


def first_piola(point: QuadraturePoint, law: PointLaw) -> ca.SX:
    """Return the first Piola–Kirchhoff stress P = ∂ψ/∂F of the elastic law at a point, stacked
    column after column (9,), by the gradient F of the positions. It contains symbols of
    `point.rule`.
    """
    return point.gradient(_energy_density(point, law), point.gradients["x"])


def second_piola(point: QuadraturePoint, law: PointLaw) -> ca.SX:
    """Return the second Piola–Kirchhoff stress S = F⁻¹ P of the elastic law at a point by its
    entries xx, yy, zz, xy, xz, yz (6,), without overstress and damping. It contains symbols of
    `point.rule`.
    """
    return six_entries(
        ca.inv_minor(point.compute_material_gradient()) @ ca.reshape(first_piola(point, law), 3, 3)
    )


def _damping(point: QuadraturePoint, law: PointLaw) -> tuple[ca.SX, ca.SX] | None:
    """Return V P_v (9,) and its derivative (9, 9) by F; None if the law has a potential."""
    stress_and_slope = law.damping_stress(
        ca.vec(point.compute_material_gradient()),
        point.compute_material_gradient_rate(),
        theta=point.scale_constants(),
        rest_values=point.rest_values,
    )
    return (
        None
        if stress_and_slope is None
        else (
            point.compute_volume() * stress_and_slope[0],
            point.compute_volume() * stress_and_slope[1],
        )
    )


@lru_cache(CACHED_KERNELS)
def energy_kernel(element: Element, law: PointLaw) -> ElementKernel:
    """Return the kernel of the elastic energy Ψ [J] of an element with the long-term law, without
    damping and memory; the latest kernels are cached.
    """
    point = quadrature_point(element, law, "x", internal_variable_count=0)
    return kernel_from_outputs(
        "energy", point, outputs={"energy": (Derivative(_energy(point, law), ()),)}
    )


@lru_cache(CACHED_KERNELS)
def force_kernel(element: Element, law: PointLaw) -> ElementKernel:
    """Return the kernel of the forces on the nodes [N] of an element: those of the elastic law, of
    the damping law and of the memory. Its output is "force"; the latest kernels are cached.
    """
    point = quadrature_point(element, law, "x", "v")
    force = (Derivative(-_potential(point, law), ("x",)),)
    if damping := _damping(point, law):
        stress = -damping[0]
        force += (
            Derivative(
                ca.dot(stress, point.compute_material_gradient_rate()) / 2, ("v",), known=stress
            ),
        )
    return kernel_from_outputs("force", point, outputs={"force": force})


@lru_cache(CACHED_KERNELS)
def linearisation_kernel(element: Element, law: PointLaw) -> ElementKernel:
    """Return the kernel of the force and its derivatives by position, velocity and θ.

    With Rayleigh damping the derivatives by position and velocity are −K − γ_r D_vK and −γ_r K. A
    damping law with a stress also has the skew part of the derivative by position.
    """
    point = quadrature_point(element, law, "x", "v")
    potential = -_potential(point, law)
    outputs: Outputs = {
        "force": (Derivative(potential, ("x",)),),
        "by_position": (Derivative(potential, ("x", "x")),),
        "by_velocity": (Derivative(potential, ("x", "v")),),
        "by_theta": (Derivative(potential, ("x", "theta")),),
    }
    if damping := _damping(point, law):
        stress = -damping[0]
        slope = -damping[1]
        # Half the dissipated power is quadratic in the rate; its derivative by it is the stress.
        half_power = ca.dot(stress, point.compute_material_gradient_rate()) / 2
        by_rate = ca.jacobian(stress, point.gradients["v"])
        by_theta = ca.jacobian(stress, point.stack_differentiated_constants())
        outputs["force"] += (Derivative(half_power, ("v",), known=stress),)
        outputs["by_position"] += (
            Derivative(half_power, ("v", "x"), part="symmetric", known=slope),
        )
        outputs["by_velocity"] += (Derivative(half_power, ("v", "v"), known=by_rate),)
        outputs["by_theta"] += (Derivative(half_power, ("v", "theta"), known=by_theta),)
        outputs["by_position_skew"] = (
            Derivative(half_power, ("v", "x"), part="skew", known=slope),
        )
    return kernel_from_outputs("linearisation", point, outputs=outputs)


@lru_cache(CACHED_KERNELS)
def curvature_kernel(element: Element, law: PointLaw) -> ElementKernel:
    """Return the kernel of the second derivatives of φ = wᵀ f(x, v; θ) + σ·S, and of ∂φ/∂θ.

    ∂²φ/∂v² vanishes. ∂²φ/∂x∂v is symmetric if the force follows from a potential (Rayleigh: −γ_r
    D_wK).
    """
    point = quadrature_point(
        element, law, "x", "v", "w", internal_variable_count=2 * (6 if law.has_memory else 0)
    )
    power = -point.weighted_derivative(_potential(point, law))
    if law.has_memory:
        power += ca.dot(point.select_internal_variables()[6:], second_piola(point, law))
    if damping := _damping(point, law):
        power -= ca.dot(damping[0], point.weigh_material_gradient())
    mixed = Derivative(power, ("x", "v"), part="symmetric" if damping else "whole")
    outputs: Outputs = {
        "position_position": (Derivative(power, ("x", "x")),),
        "position_velocity": (mixed,),
        "position_theta": (Derivative(power, ("x", "theta")),),
        "velocity_theta": (Derivative(power, ("v", "theta")),),
        "theta_theta": (Derivative(power, ("theta", "theta")),),
        "gradient_theta": (Derivative(power, ("theta",)),),
    }
    if damping:
        outputs["position_velocity_skew"] = (replace(mixed, part="skew"),)
    return kernel_from_outputs("curvature", point, outputs=outputs)


def _resultants(point: QuadraturePoint, law: PointLaw) -> tuple[ca.SX, ca.SX]:
    """Return the strains and stresses per volume, see `StrainMaterial.resultants`."""
    assert isinstance(law.material, StrainMaterial)
    rate = (
        point.gradients["v"] if "v" in point.gradients else ca.SX(point.gradients["x"].numel(), 1)
    )
    gamma_r_s = point.theta[len(law.material.constants)] if law.damping.stress else ca.SX(0)
    return law.material.resultants(
        point.compute_material_gradient(), rate, _material_constants(point, law), gamma_r_s
    )


@lru_cache(CACHED_KERNELS)
def resultants_kernel(element: Element, law: PointLaw) -> ElementKernel:
    """Return the kernel of the stresses times volume [J] of an element whose law has strains of its own."""
    point = quadrature_point(element, law, "x", "v")
    _, stress = _resultants(point, law)
    outputs: Outputs = {"resultants": (Derivative(point.compute_volume() * stress, ()),)}
    return kernel_from_outputs("resultants", point, outputs)


@lru_cache(CACHED_KERNELS)
def resultant_stiffness_kernel(element: Element, law: PointLaw) -> ElementKernel:
    """Return the kernel of Σ s ∂²ε/∂x² of such an element, with stresses times volume s that
    are data of its point.
    """
    point = quadrature_point(element, law, "x", internal_variable_count=element.stresses)
    strain, _ = _resultants(point, law)
    outputs: Outputs = {"by_position": (Derivative(ca.dot(point.point_data, strain), ("x", "x")),)}
    return kernel_from_outputs("resultant_stiffness", point, outputs)


KERNELS: dict[str, Callable[[Element, PointLaw], ElementKernel]] = {
    "energy": energy_kernel,
    "force": force_kernel,
    "linearisation": linearisation_kernel,
    "curvature": curvature_kernel,
    "resultants": resultants_kernel,
    "resultant_stiffness": resultant_stiffness_kernel,
}
