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
from .expressions import Law, carried_energy, first_piola, second_piola, six_of
from .kernel import Pieces, PointKernel, QuadraturePoint
from .kernels import COMPILING, Batch, Evaluator
from .pattern import dofs_of


def _kernel(name: str, point: QuadraturePoint, pieces: Pieces) -> PointKernel:
    last = point.phase(name, pieces)
    return PointKernel(last.pieces, tuple(point.fields), last.contractions)


def stress_kernel(element: Element, law: Law) -> PointKernel:
    """S."""
    point = QuadraturePoint.of(element, law.constants, "x")
    return _kernel("stress", point, {"stress": ("none", second_piola(point, law))})


def stress_by_theta_kernel(element: Element, law: Law) -> PointKernel:
    """∂S/∂θ by the material's constants, column after column."""
    point = QuadraturePoint.of(element, law.constants, "x")
    by_theta = ca.jacobian(second_piola(point, law), point.theta)[:, : len(law.material.constants)]
    return _kernel("stress_by_theta", point, {"stress_by_theta": ("none", ca.vec(by_theta))})


def stress_along_kernel(element: Element, law: Law) -> PointKernel:
    """∂S/∂x v: dS = F⁻¹ (dP − dF S)."""
    point = QuadraturePoint.of(element, law.constants, "x", "v")
    F, first, rate = point.gradients["x"], first_piola(point, law), point.gradients["v"]
    inverse = ca.inv_minor(point.felt)
    stress = inverse @ ca.reshape(first, 3, 3)
    change = ca.reshape(ca.jtimes(first, F, rate), 3, 3) - ca.reshape(rate, 3, 3) @ stress
    return _kernel("stress_along", point, {"stress_along": ("none", six_of(inverse @ change))})


def pulled_kernel(element: Element, law: Law) -> PointKernel:
    """(∂S/∂x)ᵀ σ of what the points carry."""
    point = QuadraturePoint.of(element, law.constants, "x", carried=6)
    slope = ca.gradient(ca.dot(point.carried, second_piola(point, law)), point.gradients["x"])
    return _kernel("pulled", point, {"pulled": ("nodes", slope)})


def carried_force_kernel(element: Element, law: Law) -> PointKernel:
    """f_H of what the points carry."""
    point = QuadraturePoint.of(element, law.constants, "x", carried=6)
    slope = -ca.gradient(carried_energy(point), point.gradients["x"])
    return _kernel("carried_force", point, {"carried_force": ("nodes", slope)})


def against_kernel(element: Element, law: Law) -> PointKernel:
    """(∂f_H/∂H)ᵀ v."""
    point = QuadraturePoint.of(element, law.constants, "x", "v", carried=6)
    power = ca.jtimes(-carried_energy(point), point.gradients["x"], point.gradients["v"])
    by_carried = ca.gradient(power, point.carried)
    return _kernel("against", _bare(point), {"against": ("none", by_carried)})


def stress_slope_kernel(element: Element, law: Law) -> PointKernel:
    """(∂S/∂x)ᵀ, column after column."""
    point = QuadraturePoint.of(element, law.constants, "x")
    slope = ca.jacobian(second_piola(point, law), point.gradients["x"]).T
    return _kernel("stress_slope", point, {"stress_slope": ("nodes", slope)})


def force_slope_kernel(element: Element, law: Law) -> PointKernel:
    """∂f_H/∂H, column after column."""
    point = QuadraturePoint.of(element, law.constants, "x", carried=6)
    force = -ca.gradient(carried_energy(point), point.gradients["x"])
    by_carried = ca.jacobian(force, point.carried)
    return _kernel("force_slope", _bare(point), {"force_slope": ("nodes", by_carried)})


def _bare(point: QuadraturePoint) -> QuadraturePoint:
    """The same, for what H has gone from."""
    return replace(point, stretches=(), carried=ca.SX(0, 1))


KERNELS: dict[str, Callable[[Element, Law], PointKernel]] = {
    "stress": stress_kernel,
    "stress_by_theta": stress_by_theta_kernel,
    "stress_along": stress_along_kernel,
    "pulled": pulled_kernel,
    "carried_force": carried_force_kernel,
    "against": against_kernel,
    "stress_slope": stress_slope_kernel,
    "force_slope": force_slope_kernel,
}


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
                out = np.zeros((len(x), count * places.size))
                self._run("stress_by_theta", number, [x], theta, out, add=False)
                first = body.starts[number]
                here = slice(places[0, 0, 0], places[0, 0, 0] + places.size)
                by_constant = out.reshape(len(x), count, places.size)
                for k, j in zip(*np.nonzero(theta_q[first : first + count]), strict=True):
                    found[:, j, here] += theta_q[first + k, j] * by_constant[:, k]
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
        for number, part in enumerate(self.body.parts):
            if part.prony:
                self._run(name, number, [x], theta, out, add=True)
        return out

    def _of_points(
        self, name: str, fields: list[Array], theta: Array, out: Array | None = None
    ) -> Array:
        if out is None:
            out = np.zeros((len(fields[0]), self.width))
        for number, part in enumerate(self.body.parts):
            if part.prony:
                self._run(name, number, fields, theta, out, add=True)
        return out

    def _of_nodes(self, name: str, fields: list[Array], theta: Array, carried: Array) -> Array:
        out = np.zeros_like(fields[0])
        for number, part in enumerate(self.body.parts):
            if part.prony:
                self._run(name, number, fields, theta, out, add=True, carried=carried)
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
        threads = body.threads if len(out) > FEW else 1
        self._evaluators[key](
            [np.ascontiguousarray(field) for field in fields],
            values,
            out,
            threads,
            add,
            None if carried is None else np.ascontiguousarray(carried),
        )

    def _batch(self, name: str, number: int) -> Batch:
        """Every point as an element of its own."""
        body = self.body
        part, places = body.parts[number], body.memory.of_part(number)
        kernel = KERNELS[name](body.element, Law(part.material, part.damping))
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
            columns = places.size * np.arange(len(part.material.constants))
            destinations = (columns[:, None] + own - places[0, 0, 0]).reshape(len(cells), -1)
            length = places.size * len(columns)
        else:
            destinations, length = own.reshape(len(cells), 6), self.width
        carried = own if kernel.carried else None
        return Batch(kernel, cells, geometry, destinations, length, carried)


# Fewer states than this are not worth a second thread.
FEW = 16
