"""What one quadrature point of one element contributes, as CasADi SX functions.

Every kernel has the inputs it needs of

======== ============= ==============================================================
x        3·nodes       node positions, node-major xyz [m]
v        3·nodes       node velocities [m/s]
w        3·nodes       weights on the node forces (Lagrange multipliers)
geometry 3·nodes + 1   shape gradients ∂N_a/∂X_j at 3a + j, then the volume [m³]
theta    3             λ [Pa], μ [Pa], γ_r [s]
======== ============= ==============================================================

and outputs that are summed over points and elements. Symmetric matrices are given by their
lower triangles, column after column. With S = −V ∂ψ/∂F − γ_r V (∂²ψ/∂F²):Ḟ the force on node a
is S ∇N_a, so that f = −∂Ψ/∂x − γ_r K v.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca

from .elements import Element
from .materials import Energy

THETA = ("lambda_pa", "mu_pa", "gamma_r_s")


@dataclass(frozen=True, eq=False)
class PointKernel:
    """One SX function of a quadrature point, with the names of its inputs and outputs."""

    function: ca.Function
    fields: tuple[str, ...]
    outputs: dict[str, int]


@dataclass(frozen=True, eq=False)
class _Point:
    """Symbols of one quadrature point and the quantities every kernel starts from."""

    nodes: int
    x: ca.SX
    v: ca.SX
    w: ca.SX
    geometry: ca.SX
    theta: ca.SX
    gradients: ca.SX  # (nodes, 3)
    volume: ca.SX


def _point(nodes: int) -> _Point:
    geometry = ca.SX.sym("geometry", 3 * nodes + 1)
    return _Point(
        nodes=nodes,
        x=ca.SX.sym("x", 3 * nodes),
        v=ca.SX.sym("v", 3 * nodes),
        w=ca.SX.sym("w", 3 * nodes),
        geometry=geometry,
        theta=ca.SX.sym("theta", len(THETA)),
        gradients=ca.reshape(geometry[: 3 * nodes], 3, nodes).T,
        volume=geometry[3 * nodes],
    )


def _material_gradient(point: _Point, field: ca.SX) -> ca.SX:
    """Σ_a field_a ⊗ ∇N_a, stacked column after column (9)."""
    return ca.vec(ca.reshape(field, 3, point.nodes) @ point.gradients)


def _to_nodes(point: _Point, stress: ca.SX) -> ca.SX:
    """Contract columns of (9, k), conjugate to F, with the shape gradients: (3·nodes, k)."""
    columns = [
        ca.vec(ca.reshape(stress[:, k], 3, 3) @ point.gradients.T) for k in range(stress.shape[1])
    ]
    return ca.horzcat(*columns)


def _lower_to_nodes(point: _Point, tangent: ca.SX) -> ca.SX:
    """Lower triangle of Bᵀ A B for a symmetric (9, 9) tangent A, column after column."""
    half = _to_nodes(point, tangent)  # (3·nodes, 9): rows contracted
    size = 3 * point.nodes
    entries = []
    for b in range(point.nodes):
        gradient = point.gradients[b, :]
        for j in range(3):
            column = 3 * b + j
            rows = half[column:size, :]
            entries.append(sum(rows[:, j + 3 * k] * gradient[k] for k in range(3)))
    return ca.vertcat(*entries)


def _function(
    name: str, point: _Point, fields: tuple[str, ...], outputs: dict[str, ca.SX]
) -> PointKernel:
    inputs = {field: getattr(point, field) for field in fields}
    inputs |= {"geometry": point.geometry, "theta": point.theta}
    dense = {key: ca.densify(ca.vec(value)) for key, value in outputs.items()}
    function = ca.Function(
        name, list(inputs.values()), list(dense.values()), list(inputs), list(dense), {"cse": True}
    )
    return PointKernel(function, fields, {key: value.numel() for key, value in dense.items()})


@dataclass(frozen=True, eq=False)
class _Stress:
    """S(F, Ḟ) and its pieces at symbolic F and Ḟ."""

    F: ca.SX
    rate: ca.SX
    stress: ca.SX


def _stress(point: _Point, energy: Energy) -> _Stress:
    lambda_pa, mu_pa, gamma_r = point.theta[0], point.theta[1], point.theta[2]
    F, rate = ca.SX.sym("F", 9), ca.SX.sym("rate", 9)
    psi = point.volume * energy(ca.reshape(F, 3, 3), lambda_pa, mu_pa)
    elastic = ca.gradient(psi, F)
    viscous = gamma_r * ca.jtimes(elastic, F, rate)
    return _Stress(F, rate, -elastic - viscous)


def energy_kernel(element: Element, energy: Energy) -> PointKernel:
    """Elastic energy Ψ of the point [J]."""
    point = _point(element.nodes)
    F = ca.reshape(_material_gradient(point, point.x), 3, 3)
    psi = point.volume * energy(F, point.theta[0], point.theta[1])
    return _function("energy", point, ("x",), {"energy": psi})


def force_kernel(element: Element, energy: Energy) -> PointKernel:
    """Elastic and stiffness-proportional damping force on the nodes [N]."""
    point = _point(element.nodes)
    law = _stress(point, energy)
    force = _at(point, law, law.stress)
    return _function("force", point, ("x", "v"), {"force": _to_nodes(point, force)})


def linearisation_kernel(element: Element, energy: Energy) -> PointKernel:
    """Force with its derivatives by position (−K − γ_r D_vK), velocity (−γ_r K) and θ."""
    point = _point(element.nodes)
    law = _stress(point, energy)
    pieces = [
        law.stress,
        ca.jacobian(law.stress, law.F),
        ca.jacobian(law.stress, law.rate),
        ca.jacobian(law.stress, point.theta),
    ]
    stress, by_f, by_rate, by_theta = (_at(point, law, piece) for piece in pieces)
    outputs = {
        "force": _to_nodes(point, stress),
        "by_position": _lower_to_nodes(point, by_f),
        "by_velocity": _lower_to_nodes(point, by_rate),
        "by_theta": _to_nodes(point, by_theta),
    }
    return _function("linearisation", point, ("x", "v"), outputs)


def curvature_kernel(element: Element, energy: Energy) -> PointKernel:
    """Second derivatives of φ = wᵀ f(x, v; θ), and ∂φ/∂θ, which the chain rule needs.

    ∂²φ/∂v² vanishes and ∂²φ/∂x∂v = −γ_r D_wK is symmetric, so two lower triangles hold the
    position–velocity part.
    """
    point = _point(element.nodes)
    law = _stress(point, energy)
    W = ca.SX.sym("W", 9)
    power = ca.dot(law.stress, W)
    by_f, by_rate, by_theta = (ca.gradient(power, z) for z in (law.F, law.rate, point.theta))
    pieces = [
        ca.jacobian(by_f, law.F),
        ca.jacobian(by_f, law.rate),
        ca.jacobian(by_f, point.theta),
        ca.jacobian(by_rate, point.theta),
        ca.jacobian(by_theta, point.theta),
        by_theta,
    ]
    w_gradient = _material_gradient(point, point.w)
    xx, xv, x_theta, v_theta, theta_theta, first = (
        ca.substitute(_at(point, law, piece), W, w_gradient) for piece in pieces
    )
    outputs = {
        "position_position": _lower_to_nodes(point, xx),
        "position_velocity": _lower_to_nodes(point, xv),
        "position_theta": _to_nodes(point, x_theta),
        "velocity_theta": _to_nodes(point, v_theta),
        "theta_theta": theta_theta,
        "gradient_theta": first,
    }
    return _function("curvature", point, ("x", "v", "w"), outputs)


def _at(point: _Point, law: _Stress, expression: ca.SX) -> ca.SX:
    """Evaluate an expression in (F, Ḟ) at the point's node positions and velocities."""
    return ca.substitute(
        expression,
        ca.vertcat(law.F, law.rate),
        ca.vertcat(_material_gradient(point, point.x), _material_gradient(point, point.v)),
    )


KERNELS: dict[str, Callable[[Element, Energy], PointKernel]] = {
    "energy": energy_kernel,
    "force": force_kernel,
    "linearisation": linearisation_kernel,
    "curvature": curvature_kernel,
}
