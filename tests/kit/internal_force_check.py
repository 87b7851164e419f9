"""Compiled internal forces of a body against the plain formula of its laws.

The plain formula is the sum over elements and quadrature points of V P ∇N, with the stresses from
the functions of the material and the damping law, and CasADi's automatic derivatives of this sum
by node positions, velocities and constants. The compiled programs differentiate by the
deformation gradient at a point and contract afterwards.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import scipy.sparse as sp
from scipy.spatial.transform import Rotation

from collocation_sysid.common.array_types import Array, Index
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.laws.materials import (
    DampingLaw,
    Energy,
    Material,
    as_damping,
    as_material,
)
from collocation_sysid.fem.pattern import SymmetricPattern
from collocation_sysid.program.linear_algebra.block_band import full_skew_values
from collocation_sysid.testing.damping_check import damping_stress
from collocation_sysid.testing.property_check import EXACT, PropertyCheck
from collocation_sysid.testing.small_problems import DENSITY_KG_M3, usual_constants
from kit.problems import uneven_box
from kit.program_derivatives import require_product

# Size of random displacements of nodes [m] and their velocities [m/s]; edges are about 0.1 m long.
DISPLACEMENT_M = 4e-3
VELOCITY_M_S = 1.0
# Size of the angular velocity of a superposed rotation: the velocities of its ends are then larger
# than those of the deformation [rad/s].
SPIN_RAD_S = 20.0
# Largest relative difference of compiled second derivatives from automatic ones: they contain third
# derivatives of powers of the stretches, with errors of some 1e-9.
SECOND_DERIVATIVES = 1e-8
# Size of a large change of a position [m], for differences.
LARGE_CHANGE_M = 0.03


def full_matrix(pattern: SymmetricPattern, lower: Array, skew: Array) -> sp.csc_array:
    """Return the sparse matrix (3n, 3n) of the symmetric part with lower triangle `lower` (m,) and
    the skew part with lower triangle `skew`, (m,) or (0,) for none.
    """
    matrix = pattern.matrix(lower)
    if skew.size:
        matrix.data += full_skew_values(pattern, skew)
    return matrix


@dataclass(frozen=True, eq=False)
class PlainInternalForce:
    """Internal force of a body by the plain formula, with automatic derivatives."""

    # Body of one part, without memory or field, whose elements do not average the dilatation.
    body: Body

    @cached_property
    def _symbols(self) -> list[ca.SX]:
        """Symbols of one element: x, v and weights w (3·nodes,), geometry (columns: points; rows:
        shape gradients, then the volume), and the constants of material and damping law.
        """
        _, points, width = self.body.geometry.shape
        size = 3 * self.body.element.nodes
        part = self.body.parts[0]
        constants = len(part.material.constants) + len(part.damping.constants)
        node_fields = [ca.SX.sym(name, size) for name in "xvw"]
        return [*node_fields, ca.SX.sym("geometry", width, points), ca.SX.sym("c", constants)]

    def _build_element_force(self) -> ca.SX:
        """Force (3·nodes,) of an element, without γ_m."""
        x, v, _, geometry, constants = self._symbols
        part = self.body.parts[0]
        nodes = self.body.element.nodes
        force = ca.SX(3 * nodes, 1)
        for point in ca.horzsplit(geometry):
            gradients = ca.reshape(point[:-1], 3, nodes).T
            F, rate = (ca.vec(ca.reshape(field, 3, nodes) @ gradients) for field in (x, v))
            stress = self._stress(
                F, rate, constants=ca.vertsplit(constants, self._split(part.material))
            )
            force -= point[-1] * ca.vec(ca.reshape(stress, 3, 3) @ gradients.T)
        return force

    def _split(self, material: Material) -> list[int]:
        """Offsets of the material's and the law's constants, and their number."""
        count = len(material.constants)
        return [0, count, self._symbols[-1].numel()]

    def _stress(self, F: ca.SX, rate: ca.SX, constants: list[ca.SX]) -> ca.SX:
        """Return P (9,) of material and damping law at F and its rate."""
        part = self.body.parts[0]
        symbols = [ca.SX.sym("F", 9), ca.SX.sym("rate", 9)]
        psi = part.material.psi(ca.reshape(symbols[0], 3, 3), constants[0])
        viscous, _ = damping_stress(part.damping, part.material, symbols=[*symbols, *constants])
        total = ca.gradient(psi, symbols[0]) + viscous
        return ca.substitute(total, ca.vertcat(*symbols), ca.vertcat(F, rate))

    @cached_property
    def _functions(self) -> tuple[ca.Function, ca.Function]:
        """Two functions of the symbols of an element: force and its first derivatives by u = (x, v,
        constants); second derivatives of wᵀ f by u.
        """
        x, v, w, _, constants = self._symbols
        u = ca.vertcat(x, v, constants)
        force = self._build_element_force()
        second, _ = ca.hessian(ca.dot(w, force), u)
        inputs = self._symbols
        return (
            ca.Function("first", inputs, [force, ca.densify(ca.jacobian(force, u))]),
            ca.Function("second", inputs, [ca.densify(second)]),
        )

    def evaluate(self, x: Array, v: Array, w: Array, theta: Array) -> tuple[Array, Array, Array]:
        """Return the force f (3n,) [N] of one state with mass-proportional damping, and by U numbers
        u = (x, v, θ) the derivatives ∂f/∂u (3n, U) and ∂²(wᵀf)/∂u² (U, U).

        Parameters
        ----------
        x, v, w : (3n,) arrays
            Positions, velocities, and weights of the forces.
        theta : (k,) array
            Constants of the body; γ_m is the last one.
        """
        size = len(x)
        laws = self._symbols[-1].numel()
        count = 2 * size + len(theta)
        force = np.zeros(size)
        jacobian = np.zeros((size, count))
        hessian = np.zeros((count, count))
        for cell, geometry in zip(*self.body.part_elements(self.body.parts[0]), strict=True):
            dofs: Index = (3 * cell[:, None] + np.arange(3)).ravel()
            state = [x[dofs], v[dofs], w[dofs], geometry.T, theta[:laws]]
            columns = np.concatenate([dofs, size + dofs, 2 * size + np.arange(laws)])
            element_force, element_jacobian = (o.full() for o in self._functions[0].call(state))
            force[dofs] += element_force.ravel()
            jacobian[np.ix_(dofs, columns)] += element_jacobian
            hessian[np.ix_(columns, columns)] += self._functions[1].call(state)[0].full()
        drag = theta[-1] * self.body.dof_mass
        force -= drag * v
        jacobian[:, size : 2 * size] -= np.diag(drag)
        jacobian[:, -1] -= self.body.dof_mass * v
        hessian[size : 2 * size, -1] -= self.body.dof_mass * w
        hessian[-1, size : 2 * size] -= self.body.dof_mass * w
        return force, jacobian, hessian


def check_compiled_forces(
    material: str | Energy | Material,
    element: str = "tet4",
    damping: str | DampingLaw = "kelvin-voigt",
    constants: Mapping[str, float] | None = None,
    *,
    is_objective: bool = True,
    is_dissipative: bool = True,
) -> None:
    """Check the compiled forces of a small body with stated constants, or those of a soft foam."""
    made = as_material(material)
    law = as_damping(damping)
    values = usual_constants((*made.constants, *law.constants), constants)
    check_internal_forces(
        PropertyCheck(f"material {made.name!r} with damping {law.name!r}"),
        made,
        law,
        values,
        element,
        is_objective=is_objective,
        is_dissipative=is_dissipative,
    )


def check_internal_forces(
    check: PropertyCheck,
    material: Material,
    damping: DampingLaw,
    values: dict[str, float],
    element: str,
    *,
    is_objective: bool = False,
    is_dissipative: bool = False,
) -> None:
    """Compare the compiled forces of a small body and all their derivatives with the plain formula.

    Derivatives are compared with central differences, too; for elements that average the dilatation
    with these alone. They are compared in a deformed shape with random velocities and in the
    undeformed shape at rest, where principal stretches coincide and forces vanish.

    Parameters
    ----------
    values : dict of str to float
        Values of constants by name; others are those of a soft foam.
    element : str
        Name of the elements of the body.
    is_objective : bool
        Whether a superposed rotation that spins only rotates the force.
    is_dissipative : bool
        Whether the derivative of the force by the velocities has no positive eigenvalue.

    Raises
    ------
    AssertionError
        If a force or derivative differs.

    Notes
    -----
    The body is one box of six elements without grasps, memory or field; that the compiled force
    without velocities is minus the gradient of the compiled energy is required too.
    """
    body = Body(
        uneven_box(1), material, density_kg_m3=DENSITY_KG_M3, element=element, damping=damping
    )
    check_forces_of_body(
        check, body, values, is_objective=is_objective, is_dissipative=is_dissipative
    )


def check_forces_of_body(
    check: PropertyCheck,
    body: Body,
    values: dict[str, float],
    displacement_m: float = DISPLACEMENT_M,
    *,
    is_objective: bool = False,
    is_dissipative: bool = False,
) -> None:
    """Check the forces of a body of one part as `check_internal_forces` does.

    Parameters
    ----------
    displacement_m : float
        Size of random displacements of nodes [m].
    """
    theta = np.array([*usual_constants(tuple(body.constants.values()), values).values()])
    x = body.nodes_m.ravel() + check.rng.uniform(-displacement_m, displacement_m, body.nodes_m.size)
    v = VELOCITY_M_S * check.rng.standard_normal(x.size)
    w = check.rng.standard_normal(x.size)
    has_plain_formula = body.element.columns == 3 and not body.element.mean_dilatation
    plain = PlainInternalForce(body) if has_plain_formula else None
    first = _check_derivatives(check, body, state=[x, v, w], theta=theta, plain=plain, where="")
    at_rest = [body.nodes_m.ravel(), np.zeros_like(v), w]
    _check_derivatives(check, body, state=at_rest, theta=theta, plain=plain, where=" undeformed")
    _check_energy(check, body, x=x, theta=theta)
    if is_objective:
        _check_objectivity(check, body, x=x, v=v, theta=theta)
    if is_dissipative:
        _check_dissipation(check, body, by_velocity=first[:, x.size : 2 * x.size])


def _check_derivatives(
    check: PropertyCheck,
    body: Body,
    state: list[Array],
    theta: Array,
    *,
    plain: PlainInternalForce | None,
    where: str,
) -> Array:
    """Compare force and derivatives at a state x, v, w with the plain formula and differences."""
    x, v, w = state
    elements = f"{where} {body.element.name} elements".strip()
    force = body.force(x, v, theta)[0]
    first = _first_derivatives(body, x, v=v, theta=theta)
    second = _second_derivatives(body, state, theta=theta)
    # Forces of an undeformed body are zero; what counts is their change by a large change of x.
    size = max(float(np.abs(force).max()), LARGE_CHANGE_M * float(np.abs(first[:, : x.size]).max()))
    check.require_equal(
        body.second_derivatives(x, v, w, theta).theta[0],
        w @ first[:, 2 * x.size :],
        statement=f"∂(wᵀf)/∂θ of {elements} differs from the first derivatives",
        scale=size,
    )
    if plain is not None:
        plain_force, plain_first, plain_second = plain.evaluate(x, v, w, theta)
        difference = f"of {elements} differs from the plain formula with automatic derivatives"
        check.require_equal(
            force, plain_force, statement=f"the compiled force {difference}", scale=size
        )
        check.require_equal(
            first, plain_first, statement=f"the compiled first derivative of the force {difference}"
        )
        check.require_equal(
            second,
            plain_second,
            statement=f"the compiled second derivative of the force {difference}",
            tolerance=SECOND_DERIVATIVES,
        )
    _check_differences(check, body, state=state, theta=theta, derivatives=(first, second))
    return first


def _check_energy(check: PropertyCheck, body: Body, x: Array, theta: Array) -> None:
    """Require that the force at rest is minus the gradient of the compiled energy."""
    named = dict(zip(body.constants, theta, strict=True))
    constants = {c.name: named[c.name] for c in body.parts[0].material.constants}
    direction = LARGE_CHANGE_M * check.rng.standard_normal(x.size)
    force = body.force(x, np.zeros_like(x), theta)[0]
    require_product(
        check,
        lambda at: np.atleast_1d(body.energy(at, **constants)),
        np.atleast_1d(-force @ direction),
        point=x,
        direction=direction,
        statement=f"the compiled force of {body.element.name} elements is not minus the gradient "
        "of the compiled energy",
    )


def _check_objectivity(check: PropertyCheck, body: Body, x: Array, v: Array, theta: Array) -> None:
    """Require f(Qx, Q(v + ω × x)) = Q f(x, v) for a random Q and ω, without γ_m."""
    constants = theta.copy()
    constants[-1] = 0.0
    Q = Rotation.from_quat(check.rng.standard_normal(4)).as_matrix()
    spin = SPIN_RAD_S * check.rng.standard_normal(3)
    places, velocities = (field.reshape(-1, 3) for field in (x, v))
    spinning = velocities + np.cross(spin, places)
    rotated = body.force(places @ Q.T, spinning @ Q.T, constants)[0]
    expected = body.force(places, velocities, constants)[0].reshape(-1, 3) @ Q.T
    check.require_equal(
        rotated,
        expected.ravel(),
        statement=f"a spinning rotation changes the force of {body.element.name} elements in the "
        "body's axes",
        tolerance=1e-8,
    )


def _check_dissipation(check: PropertyCheck, body: Body, by_velocity: Array) -> None:
    """Require that no velocity increases the energy beyond rounding."""
    powers = np.linalg.eigvalsh((by_velocity + by_velocity.T) / 2)
    if not powers[-1] <= EXACT * np.abs(powers).max():
        check.fail(
            f"the damping of {body.element.name} elements adds energy: the largest eigenvalue of "
            "∂f/∂v is positive",
            powers[-1],
            expected="at most 0 N s/m",
        )


def _check_differences(
    check: PropertyCheck,
    body: Body,
    *,
    state: list[Array],
    theta: Array,
    derivatives: tuple[Array, Array],
) -> None:
    """Compare first and second derivatives of compiled forces with differences in one direction."""
    x, v, w = state
    size = len(x)
    point = np.concatenate([x, v, theta])
    scale = np.concatenate([np.full(size, LARGE_CHANGE_M), np.ones(size), theta])
    direction = scale * check.rng.standard_normal(len(point))

    def force_at(u: Array) -> Array:
        """Return the compiled force at (x, v, θ)."""
        return body.force(u[:size], u[size : 2 * size], u[2 * size :])[0]

    def weighted_derivative_at(u: Array) -> Array:
        """Return the compiled first derivative of wᵀ f at (x, v, θ)."""
        return w @ _first_derivatives(body, u[:size], v=u[size : 2 * size], theta=u[2 * size :])

    where = f"of the compiled force of {body.element.name} elements is wrong"
    require_product(
        check,
        force_at,
        derivatives[0] @ direction,
        point=point,
        direction=direction,
        statement=f"the first derivative {where}",
    )
    require_product(
        check,
        weighted_derivative_at,
        derivatives[1] @ direction,
        point=point,
        direction=direction,
        statement=f"the second derivative {where}",
    )


def _first_derivatives(body: Body, x: Array, v: Array, theta: Array) -> Array:
    """Return the compiled ∂f/∂(x, v, θ) at one state as a full matrix (3n, 6n + k)."""
    at = body.linearise(x, v, theta)
    by_x = full_matrix(body.pattern, at.by_position[0], skew=at.by_position_skew[0])
    by_v = full_matrix(body.pattern, at.by_velocity[0], skew=np.zeros(0))
    return np.hstack([by_x.toarray(), by_v.toarray(), at.by_theta[0]])


def _second_derivatives(body: Body, state: list[Array], theta: Array) -> Array:
    """Return the compiled second derivatives of wᵀ f by (x, v, θ) at a state [x, v, w], as a full
    symmetric matrix (6n + k, 6n + k); those by v twice are zero.
    """
    x, v, w = state
    at = body.second_derivatives(x, v, w, theta)
    none = np.zeros(0)
    by_xx = full_matrix(body.pattern, at.position_position[0], skew=none).toarray()
    by_xv = full_matrix(
        body.pattern, at.position_velocity[0], skew=at.position_velocity_skew[0]
    ).toarray()
    by_x_theta = at.position_theta[0]
    by_v_theta = at.velocity_theta[0]
    return np.block(
        [
            [by_xx, by_xv, by_x_theta],
            [by_xv.T, np.zeros_like(by_xx), by_v_theta],
            [by_x_theta.T, by_v_theta.T, at.theta_theta[0]],
        ]
    )
