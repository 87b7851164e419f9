"""What one quadrature point of one element contributes, as CasADi SX functions.

Every kernel has the inputs it needs of

======== ============= ==============================================================
x        3·nodes       node positions, node-major xyz [m]
v        3·nodes       node velocities [m/s]
w        3·nodes       weights on the node forces (Lagrange multipliers)
geometry 3·nodes + 1   shape gradients ∂N_a/∂X_j at 3a + j, then the volume [m³]
theta    k             constants of the material, then of the damping law
======== ============= ==============================================================

and outputs that are summed over points and elements. Symmetric matrices are given by their
lower triangles, column after column. With S = −V (∂ψ/∂F + P_d), P_d the stress of the damping law,
the force on node a is S ∇N_a; for Rayleigh's f = −∂Ψ/∂x − γ_r K v.

Up to that last product a kernel knows only F, Ḟ and the like: 9 or 9 × 9 numbers whatever the
element, its *pieces*. How they meet the shape gradients is told by a `Contraction`, which an
evaluator may do in loops: written out for ten nodes it is most of the instructions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import casadi as ca

from .damping import Damping
from .elements import Element
from .materials import Material

# What becomes of a piece: nothing; (9, k), conjugate to F, to (3·nodes, k); or a symmetric (9, 9)
# to the lower triangle of (3·nodes, 3·nodes).
Contraction = Literal["none", "nodes", "pairs"]


@dataclass(frozen=True, eq=False)
class PointKernel:
    """What one quadrature point contributes.

    Attributes
    ----------
    pieces : casadi.Function
        Of the fields, geometry and θ; one output for each piece.
    fields : tuple of str
        Names of the inputs that come first, each 3·nodes long.
    contractions : dict of str to Contraction
        For each output.
    """

    pieces: ca.Function
    fields: tuple[str, ...]
    contractions: dict[str, Contraction]

    @property
    def nodes(self) -> int:
        """Nodes per element."""
        return self.pieces.nnz_in(0) // 3

    @cached_property
    def function(self) -> ca.Function:
        """The whole kernel, contractions written out."""
        sx = self.pieces
        names = sx.name_in()
        inputs = [ca.SX.sym(name, sx.size1_in(k)) for k, name in enumerate(names)]
        gradients = _gradients(inputs[-2], self.nodes)
        outputs = [
            _contracted(piece, how, gradients)
            for piece, how in zip(sx.call(inputs), self.contractions.values(), strict=True)
        ]
        dense = [ca.densify(ca.vec(output)) for output in outputs]
        return ca.Function(sx.name(), inputs, dense, names, sx.name_out(), {"cse": True})


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


def _point(nodes: int, constants: int) -> _Point:
    geometry = ca.SX.sym("geometry", 3 * nodes + 1)
    return _Point(
        nodes=nodes,
        x=ca.SX.sym("x", 3 * nodes),
        v=ca.SX.sym("v", 3 * nodes),
        w=ca.SX.sym("w", 3 * nodes),
        geometry=geometry,
        theta=ca.SX.sym("theta", constants),
        gradients=_gradients(geometry, nodes),
        volume=geometry[3 * nodes],
    )


def _gradients(geometry: ca.SX, nodes: int) -> ca.SX:
    return ca.reshape(geometry[: 3 * nodes], 3, nodes).T


def _material_gradient(point: _Point, field: ca.SX) -> ca.SX:
    """Σ_a field_a ⊗ ∇N_a, stacked column after column (9)."""
    return ca.vec(ca.reshape(field, 3, point.nodes) @ point.gradients)


def _contracted(piece: ca.SX, how: Contraction, gradients: ca.SX) -> ca.SX:
    if how == "none":
        return piece
    nodes = gradients.shape[0]
    half = ca.vertcat(*[_at_node(piece, gradients[a, :]) for a in range(nodes)])
    if how == "nodes":
        return half
    # By symmetry the (3·nodes, 9) just found, read along its rows, has the columns contracted.
    columns = []
    for b in range(nodes):
        rows = half[3 * b : 3 * b + 3, :].T
        blocks = [_at_node(rows, gradients[a, :]) for a in range(b, nodes)]
        whole = ca.vertcat(*blocks)
        columns += [whole[j:, j] for j in range(3)]
    return ca.vertcat(*columns)


def _at_node(stress: ca.SX, gradient: ca.SX) -> ca.SX:
    """Columns of (9, k), conjugate to F, times one node's shape gradient: (3, k)."""
    columns = [ca.reshape(stress[:, k], 3, 3) @ gradient.T for k in range(stress.shape[1])]
    return ca.horzcat(*columns)


def _kernel(
    name: str,
    point: _Point,
    fields: tuple[str, ...],
    outputs: dict[str, tuple[Contraction, ca.SX]],
) -> PointKernel:
    inputs = {field: getattr(point, field) for field in fields}
    inputs |= {"geometry": point.geometry, "theta": point.theta}
    pieces = [ca.densify(piece) for _, piece in outputs.values()]
    function = ca.Function(
        name, list(inputs.values()), pieces, list(inputs), list(outputs), {"cse": True}
    )
    return PointKernel(function, fields, {key: how for key, (how, _) in outputs.items()})


@dataclass(frozen=True, eq=False)
class _Stress:
    """S(F, Ḟ) and its pieces at symbolic F and Ḟ."""

    F: ca.SX
    rate: ca.SX
    stress: ca.SX


@dataclass(frozen=True, eq=False)
class Law:
    """What a quadrature point obeys: a material and a damping law.

    θ holds the material's constants, then those of the damping law.
    """

    material: Material
    damping: Damping

    @property
    def constants(self) -> int:
        """Length of θ."""
        return len(self.material.constants) + len(self.damping.constants)

    def psi(self, F: ca.SX, theta: ca.SX) -> ca.SX:
        """Energy density at F (9)."""
        return self.material.psi(ca.reshape(F, 3, 3), theta[: len(self.material.constants)])

    def viscous(self, elastic: ca.SX, F: ca.SX, rate: ca.SX, theta: ca.SX) -> ca.SX:
        """Damping stress (9), from the elastic one as an expression in F."""
        own = theta[len(self.material.constants) :]
        named = {c.name: own[k] for k, c in enumerate(self.damping.constants)}
        return self.damping.stress(elastic, F, rate, **named)


def _stress(point: _Point, law: Law) -> _Stress:
    F, rate = ca.SX.sym("F", 9), ca.SX.sym("rate", 9)
    elastic = ca.gradient(point.volume * law.psi(F, point.theta), F)
    return _Stress(F, rate, -elastic - law.viscous(elastic, F, rate, point.theta))


def energy_kernel(element: Element, law: Law) -> PointKernel:
    """Elastic energy Ψ of the point [J]."""
    point = _point(element.nodes, law.constants)
    psi = point.volume * law.psi(_material_gradient(point, point.x), point.theta)
    return _kernel("energy", point, ("x",), {"energy": ("none", psi)})


def force_kernel(element: Element, law: Law) -> PointKernel:
    """Elastic and damping force on the nodes [N]."""
    point = _point(element.nodes, law.constants)
    at = _stress(point, law)
    force = _at(point, at, at.stress)
    return _kernel("force", point, ("x", "v"), {"force": ("nodes", force)})


def linearisation_kernel(element: Element, law: Law) -> PointKernel:
    """Force with its derivatives by position, velocity and θ (Rayleigh: −K − γ_r D_vK, −γ_r K)."""
    point = _point(element.nodes, law.constants)
    at = _stress(point, law)
    pieces = [
        at.stress,
        ca.jacobian(at.stress, at.F),
        ca.jacobian(at.stress, at.rate),
        ca.jacobian(at.stress, point.theta),
    ]
    stress, by_f, by_rate, by_theta = (_at(point, at, piece) for piece in pieces)
    outputs: dict[str, tuple[Contraction, ca.SX]] = {
        "force": ("nodes", stress),
        "by_position": ("pairs", by_f),
        "by_velocity": ("pairs", by_rate),
        "by_theta": ("nodes", by_theta),
    }
    return _kernel("linearisation", point, ("x", "v"), outputs)


def curvature_kernel(element: Element, law: Law) -> PointKernel:
    """Second derivatives of φ = wᵀ f(x, v; θ), and ∂φ/∂θ, which the chain rule needs.

    ∂²φ/∂v² vanishes and ∂²φ/∂x∂v (Rayleigh: −γ_r D_wK) is symmetric, so two lower triangles hold
    the position–velocity part.
    """
    point = _point(element.nodes, law.constants)
    at = _stress(point, law)
    W = ca.SX.sym("W", 9)
    power = ca.dot(at.stress, W)
    by_f, by_rate, by_theta = (ca.gradient(power, z) for z in (at.F, at.rate, point.theta))
    pieces = [
        ca.jacobian(by_f, at.F),
        ca.jacobian(by_f, at.rate),
        ca.jacobian(by_f, point.theta),
        ca.jacobian(by_rate, point.theta),
        ca.jacobian(by_theta, point.theta),
        by_theta,
    ]
    w_gradient = _material_gradient(point, point.w)
    xx, xv, x_theta, v_theta, theta_theta, first = (
        ca.substitute(_at(point, at, piece), W, w_gradient) for piece in pieces
    )
    outputs: dict[str, tuple[Contraction, ca.SX]] = {
        "position_position": ("pairs", xx),
        "position_velocity": ("pairs", xv),
        "position_theta": ("nodes", x_theta),
        "velocity_theta": ("nodes", v_theta),
        "theta_theta": ("none", theta_theta),
        "gradient_theta": ("none", first),
    }
    return _kernel("curvature", point, ("x", "v", "w"), outputs)


def _at(point: _Point, at: _Stress, expression: ca.SX) -> ca.SX:
    """Evaluate an expression in (F, Ḟ) at the point's node positions and velocities."""
    return ca.substitute(
        expression,
        ca.vertcat(at.F, at.rate),
        ca.vertcat(_material_gradient(point, point.x), _material_gradient(point, point.v)),
    )


KERNELS: dict[str, Callable[[Element, Law], PointKernel]] = {
    "energy": energy_kernel,
    "force": force_kernel,
    "linearisation": linearisation_kernel,
    "curvature": curvature_kernel,
}
