"""Stresses of quadrature points, point by point: what the memory of a material works with.

Fields (T, 3n), and rows (T, width) of what points carry, see `memory`. With S the second
Piola–Kirchhoff stress of the long-term energy, and E Green's strain,

    dS = ∂S/∂x dx,   the force of H: f_H = −∂/∂x Σ V ½ H : FᵀF,   ∂f_H/∂H = −Vᵀ(∂E/∂x),

S, H and E by their entries xx, yy, zz, xy, xz, yz.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from ..arrays import Array, Index
from .discretisation import Discretisation
from .elements import Element
from .expressions import Law, carried_energy, first_piola, point_of, second_piola, six_of
from .kernel import Contraction, PointKernel, QuadraturePoint
from .kernels import COMPILING, Batch, Evaluator
from .pattern import dofs_of

Expression = Callable[[QuadraturePoint, Law], ca.SX]


def _stress_by_theta(point: QuadraturePoint, law: Law) -> ca.SX:
    """∂S by the material's constants and the logarithm of a field, column after column."""
    slope = ca.jacobian(second_piola(point, law), point.varied)
    of_field = slope[:, law.constants :]
    return ca.vec(ca.horzcat(slope[:, : len(law.material.constants)], of_field))


def _stress_along(point: QuadraturePoint, law: Law) -> ca.SX:
    """∂S/∂x v: dS = F⁻¹ (dP − dF S)."""
    F, first, rate = point.gradients["x"], first_piola(point, law), point.gradients["v"]
    inverse = ca.inv_minor(point.felt)
    stress = inverse @ ca.reshape(first, 3, 3)
    change = ca.reshape(ca.jtimes(first, F, rate), 3, 3) - ca.reshape(rate, 3, 3) @ stress
    return six_of(inverse @ change)


def _pulled(point: QuadraturePoint, law: Law) -> ca.SX:
    """(∂S/∂x)ᵀ σ of what the points carry."""
    return ca.gradient(ca.dot(point.brought, second_piola(point, law)), point.gradients["x"])


def _carried_force(point: QuadraturePoint, law: Law) -> ca.SX:
    """f_H of what the points carry."""
    return -ca.gradient(carried_energy(point), point.gradients["x"])


def _against(point: QuadraturePoint, law: Law) -> ca.SX:
    """(∂f_H/∂H)ᵀ v."""
    power = ca.jtimes(-carried_energy(point), point.gradients["x"], point.gradients["v"])
    return ca.gradient(power, point.brought)


def _stress_slope(point: QuadraturePoint, law: Law) -> ca.SX:
    """(∂S/∂x)ᵀ, column after column."""
    return ca.jacobian(second_piola(point, law), point.gradients["x"]).T


def _force_slope(point: QuadraturePoint, law: Law) -> ca.SX:
    """∂f_H/∂H, column after column."""
    return ca.jacobian(_carried_force(point, law), point.brought)


# Of each: its expression, fields, how many numbers the points carry, and its contraction.
KERNELS: dict[str, tuple[Expression, tuple[str, ...], int, Contraction]] = {
    "stress": (second_piola, ("x",), 0, "none"),
    "stress_by_theta": (_stress_by_theta, ("x",), 0, "none"),
    "stress_along": (_stress_along, ("x", "v"), 0, "none"),
    "pulled": (_pulled, ("x",), 6, "nodes"),
    "carried_force": (_carried_force, ("x",), 6, "nodes"),
    "against": (_against, ("x", "v"), 6, "none"),
    "stress_slope": (_stress_slope, ("x",), 0, "nodes"),
    "force_slope": (_force_slope, ("x",), 6, "nodes"),
}


def stress_kernel(name: str, element: Element, law: Law) -> PointKernel:
    """That of a line of the table."""
    expression, fields, carried, contraction = KERNELS[name]
    point = point_of(element, law, *fields, carried=carried)
    piece = expression(point, law)
    if not ca.depends_on(piece, point.carried):  # H has gone from what is linear in it
        point = replace(point, stretches=(), carried=ca.SX(0, 1), scaled=())
    last = point.phase(name, {name: (contraction, piece)})
    return PointKernel(last.pieces, fields, last.contractions)


@dataclass(frozen=True, eq=False)
class SlopeEntries:
    """Which number of a row of slopes is the derivative of, or by, what.

    Attributes
    ----------
    points : (K,) place in what the points carry
    dofs : (K,) degree of freedom
    """

    points: Index
    dofs: Index


class Stresses:
    """The stresses of a body, and their transposed derivatives.

    Kernels are compiled when they are first needed.
    """

    def __init__(self, body: Discretisation) -> None:
        self.body = body
        self.width = body.memory.width
        self._evaluators: dict[tuple[str, int], Evaluator] = {}

    def stress(self, x: Array, theta: Array) -> Array:
        """S, (T, width) [Pa]."""
        return self._of_points("stress", [x], theta)

    def stress_by(self, x: Array, theta: Array, theta_q: Array) -> Array:
        """∂S/∂θ θ_q, (T, q, width), for θ_q (k, q)."""
        body, found = self.body, np.zeros((len(x), theta_q.shape[1], self.width))
        for number, part in enumerate(body.parts):
            if part.prony:
                count, places = len(part.material.constants), body.memory.of_part(number)
                field = part.stress_field
                out = np.zeros((len(x), (count + bool(field)) * places.size))
                self._run("stress_by_theta", number, [x], theta, out, add=False)
                first = body.starts[number]
                here = slice(places[0, 0, 0], places[0, 0, 0] + places.size)
                by_constant = out.reshape(len(x), -1, places.size)
                for k, j in zip(*np.nonzero(theta_q[first : first + count]), strict=True):
                    found[:, j, here] += theta_q[first + k, j] * by_constant[:, k]
                if field:
                    own = body.mode_places[number]
                    logs = field.slopes(theta[own]) @ theta_q[own]
                    for j in np.flatnonzero(logs.any(axis=0)):
                        of_points = np.tile(np.repeat(logs[:, j], body.geometry.shape[1]), 6)
                        found[:, j, here] += of_points * by_constant[:, count]
        return found

    def along(self, x: Array, direction: Array, theta: Array, out: Array | None = None) -> Array:
        """∂S/∂x along a direction, (T, width), added to `out` where it is given."""
        return self._of_points("stress_along", [x, direction], theta, out)

    def pulled(self, x: Array, weights: Array, theta: Array) -> Array:
        """(∂S/∂x)ᵀ weights, (T, 3n)."""
        return self._of_nodes("pulled", [x], theta, weights)

    def force(self, x: Array, overstress: Array, theta: Array) -> Array:
        """f_H, (T, 3n) [N]; it is linear in H."""
        return self._of_nodes("carried_force", [x], theta, overstress)

    def against(self, x: Array, direction: Array, theta: Array) -> Array:
        """(∂f_H/∂H)ᵀ direction, (T, width)."""
        return self._of_points("against", [x, direction], theta)

    @cached_property
    def slope_entries(self) -> SlopeEntries:
        """Those of `stress_slopes` and `force_slopes`."""
        points, dofs = [], []
        for number, part in enumerate(self.body.parts):
            if part.prony:
                own = self.body.memory.of_part(number)
                of_cells = dofs_of(self.body.cells[part.cells])
                shape = (*own.shape, of_cells.shape[1])
                points.append(np.broadcast_to(own[..., None], shape).ravel())
                dofs.append(np.broadcast_to(of_cells[:, None, None], shape).ravel())
        return SlopeEntries(np.concatenate(points), np.concatenate(dofs))

    def stress_slopes(self, x: Array, theta: Array) -> Array:
        """∂S/∂x, (T, K)."""
        return self._slopes("stress_slope", x, theta)

    def force_slopes(self, x: Array, theta: Array) -> Array:
        """∂f_H/∂H, (T, K); it is linear in x."""
        return self._slopes("force_slope", x, theta)

    def _slopes(self, name: str, x: Array, theta: Array) -> Array:
        out = np.zeros((len(x), len(self.slope_entries.points)))
        return self._summed(name, [x], theta, out)

    def _of_points(
        self, name: str, fields: list[Array], theta: Array, out: Array | None = None
    ) -> Array:
        out = np.zeros((len(fields[0]), self.width)) if out is None else out
        return self._summed(name, fields, theta, out)

    def _of_nodes(self, name: str, fields: list[Array], theta: Array, carried: Array) -> Array:
        return self._summed(name, fields, theta, np.zeros_like(fields[0]), carried)

    def _summed(
        self, name: str, fields: list[Array], theta: Array, out: Array, carried: Array | None = None
    ) -> Array:
        for number, part in enumerate(self.body.parts):
            if part.prony:
                self._run(name, number, fields, theta, out, True, carried)
        return out

    def _run(
        self,
        name: str,
        number: int,
        fields: list[Array],
        theta: Array,
        out: Array,
        add: bool,
        carried: Array | None = None,
    ) -> None:
        body, key = self.body, (name, number)
        with COMPILING:
            if key not in self._evaluators:
                self._evaluators[key] = body.make_evaluator(self._batch(name, number))
        first = body.starts[number]
        values = np.array(theta[first : first + body.parts[number].of_law], dtype=float)
        brought = body.brought(number, theta, carried)
        threads = body.threads if len(out) > FEW else 1
        self._evaluators[key](
            [np.ascontiguousarray(field) for field in fields],
            values,
            out,
            threads,
            add,
            None if brought is None else np.ascontiguousarray(brought),
        )

    def _batch(self, name: str, number: int) -> Batch:
        """Every point as an element of its own."""
        body = self.body
        part, places = body.parts[number], body.memory.of_part(number)
        kernel = stress_kernel(name, body.element, body.law(number))
        points = body.geometry.shape[1]
        cells = np.repeat(body.cells[part.cells], points, axis=0)
        geometry = body.geometry[part.cells].reshape(len(cells), 1, -1)
        own = places.reshape(len(cells), 1, 6)
        if name.endswith("_slope"):
            # 3n for each of what the points carry, part after part.
            per_number, length = dofs_of(cells).shape[1], len(self.slope_entries.points)
            numbers = np.arange(per_number * places.size).reshape(len(cells), -1)
            destinations = per_number * places[0, 0, 0] + numbers
        elif "nodes" in kernel.contractions.values():
            destinations, length = dofs_of(cells), body.pattern.size
        elif name == "stress_by_theta":
            count = len(part.material.constants) + bool(part.stress_field)
            columns = places.size * np.arange(count)
            destinations = (columns[:, None] + own - places[0, 0, 0]).reshape(len(cells), -1)
            length = places.size * len(columns)
        else:
            destinations, length = own.reshape(len(cells), 6), self.width
        carried = own if KERNELS[name][2] else own[..., :0]
        if part.stress_field:
            width = self.width if KERNELS[name][2] else 0
            logs = width + np.repeat(np.arange(len(part.cells)), points)
            carried = np.concatenate([carried, logs[:, None, None]], axis=-1)
        carried = carried[..., : kernel.carried] if kernel.carried else None
        return Batch(kernel, cells, geometry, destinations, length, carried)


# Fewer states than this are not worth a second thread.
FEW = 16
