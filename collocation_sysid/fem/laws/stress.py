"""Stresses at quadrature points and their derivatives, for the memory of a material.

Node fields are (T, 3n); values at points are rows (T, width), see `memory`. With the second
Piola–Kirchhoff stress S of the long-term energy and Green's strain E,

    dS = ∂S/∂x dx,   the force of H: f_H = −∂/∂x Σ V ½ H : FᵀF,   ∂f_H/∂H = −Vᵀ(∂E/∂x),

where S, H and E are given by their entries xx, yy, zz, xy, xz, yz.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from ...common.array_types import Array, Index
from ..discretisation import Discretisation
from ..elements import Element
from ..expressions import (
    PointLaw,
    first_piola,
    memory_energy,
    quadrature_point,
    second_piola,
    six_entries,
)
from ..kernel import Contraction, ElementKernel, QuadraturePoint
from ..kernels import COMPILING, Evaluator, KernelBatch
from ..pattern import dofs_of

Expression = Callable[[QuadraturePoint, PointLaw], ca.SX]


def _stress_by_theta(point: QuadraturePoint, law: PointLaw) -> ca.SX:
    """Return ∂S by the material's constants and the logarithm of a field, column after column."""
    slope = point.jacobian(second_piola(point, law), point.stack_differentiated_constants())
    of_field = slope[:, law.constant_count :]
    return ca.vec(ca.horzcat(slope[:, : len(law.material.constants)], of_field))


def _stress_derivative(point: QuadraturePoint, law: PointLaw) -> ca.SX:
    """Return dS (6,) along v, the second field: dS = F⁻¹ (dP − dF S)."""
    F = point.gradients["x"]
    piola = first_piola(point, law)
    rate = point.gradients["v"]
    inverse = ca.inv_minor(point.compute_material_gradient())
    stress = inverse @ ca.reshape(piola, 3, 3)
    piola_rate = point.directional_derivative(piola, F, direction=rate)
    change = ca.reshape(piola_rate, 3, 3) - ca.reshape(rate, 3, 3) @ stress
    return six_entries(inverse @ change)


def _stress_pullback(point: QuadraturePoint, law: PointLaw) -> ca.SX:
    """Return (∂S/∂x)ᵀ σ of a point (9,), with the weights σ (6,) as its internal variables."""
    return point.gradient(
        ca.dot(point.select_internal_variables(), second_piola(point, law)), point.gradients["x"]
    )


def _memory_force(point: QuadraturePoint, law: PointLaw) -> ca.SX:
    """Return f_H (9,), conjugate to F: −∂/∂F ½ V H : FᵀF, with H as data of the point."""
    return -ca.gradient(memory_energy(point), point.gradients["x"])


def _memory_force_pullback(point: QuadraturePoint, law: PointLaw) -> ca.SX:
    """Return (∂f_H/∂H)ᵀ v (6,) of a point, for velocities v as its second field."""
    power = ca.jtimes(-memory_energy(point), point.gradients["x"], point.gradients["v"])
    return ca.gradient(power, point.select_internal_variables())


def _stress_jacobian(point: QuadraturePoint, law: PointLaw) -> ca.SX:
    """Return (∂S/∂F)ᵀ (9, 6) of a point, to be contracted to nodes."""
    return point.jacobian(second_piola(point, law), point.gradients["x"]).T


def _memory_force_jacobian(point: QuadraturePoint, law: PointLaw) -> ca.SX:
    """Return ∂f_H/∂H (9, 6) of a point, to be contracted to nodes."""
    return ca.jacobian(_memory_force(point, law), point.select_internal_variables())


# Expression, node fields, number of data of a point, and contraction of each kernel.
KERNELS: dict[str, tuple[Expression, tuple[str, ...], int, Contraction]] = {
    "stress": (second_piola, ("x",), 0, "none"),
    "stress_by_theta": (_stress_by_theta, ("x",), 0, "none"),
    "stress_along": (_stress_derivative, ("x", "v"), 0, "none"),
    "pulled": (_stress_pullback, ("x",), 6, "nodes"),
    "carried_force": (_memory_force, ("x",), 6, "nodes"),
    "against": (_memory_force_pullback, ("x", "v"), 6, "none"),
    "stress_slope": (_stress_jacobian, ("x",), 0, "nodes"),
    "force_slope": (_memory_force_jacobian, ("x",), 6, "nodes"),
}


def stress_kernel(name: str, element: Element, law: PointLaw) -> ElementKernel:
    """Return the kernel that the line `name` of `KERNELS` states, for an element and a law."""
    expression, fields, has_internal_variables, contraction = KERNELS[name]
    point = quadrature_point(element, law, *fields, internal_variable_count=has_internal_variables)
    piece = expression(point, law)
    if not ca.depends_on(piece, point.point_data):  # H has gone from what is linear in it
        point = replace(point, stretches=(), point_data=ca.SX(0, 1), scaled_indices=())
    phase = point.make_phase(name, {name: (contraction, piece)})
    return ElementKernel(phase.pieces, fields, contractions=phase.contractions)


@dataclass(frozen=True, eq=False)
class JacobianEntries:
    """Point value and dof of each entry of `stress_jacobian` and `memory_force_jacobian`; entries
    of the same place add up.
    """

    points: Index  # (K,): column in the row of values at points
    dofs: Index  # (K,): degree of freedom


class StressEvaluator:
    """Stresses of a body with memory, and their derivatives and transposed derivatives.

    Stresses are those of the long-term energy, without overstress and damping. Entries of parts
    without memory do not occur. Kernels are compiled when they are first needed.

    Parameters
    ----------
    body : Discretisation
        Body of which at least one part has a memory.

    Attributes
    ----------
    width : int
        Length of a row of values at points, see `MemoryLayout`.
    """

    def __init__(self, body: Discretisation) -> None:
        self.body = body
        self.width = body.memory.width
        self._evaluators: dict[tuple[str, int], Evaluator] = {}

    def stress(self, x: Array, theta: Array) -> Array:
        """Return S (T, width) [Pa] at positions x (T, 3n) and constants θ."""
        return self._evaluate_at_points("stress", [x], theta=theta)

    def stress_theta_derivatives(self, x: Array, theta: Array, theta_q: Array) -> Array:
        """Return the derivatives of S along directions in θ, ∂S/∂θ θ_q (T, q, width), at positions
        x (T, 3n) and θ (k,), for q directions θ_q (k, q).
        """
        body = self.body
        derivatives = np.zeros((len(x), theta_q.shape[1], self.width))
        for number, part in enumerate(body.parts):
            if part.prony:
                count = len(part.material.constants)
                places = body.memory.part_columns(number)
                field = part.stress_field
                out = np.zeros((len(x), (count + bool(field)) * places.size))
                self._evaluate_part(
                    "stress_by_theta", number, fields=[x], theta=theta, out=out, add=False
                )
                first = body.starts[number]
                part_columns = slice(places[0, 0, 0], places[0, 0, 0] + places.size)
                by_constant = out.reshape(len(x), -1, places.size)
                for k, j in zip(*np.nonzero(theta_q[first : first + count]), strict=True):
                    derivatives[:, j, part_columns] += theta_q[first + k, j] * by_constant[:, k]
                if field:
                    field_columns = body.field_slices[number]
                    logs = field.shapes @ theta_q[field_columns]
                    for j in np.flatnonzero(logs.any(axis=0)):
                        point_values = np.tile(np.repeat(logs[:, j], body.geometry.shape[1]), 6)
                        derivatives[:, j, part_columns] += point_values * by_constant[:, count]
        return derivatives

    def stress_jvp(
        self, x: Array, direction: Array, theta: Array, out: Array | None = None
    ) -> Array:
        """Return ∂S/∂x along a direction (T, 3n) as (T, width), at positions x (T, 3n) and θ (k,).

        With `out` (T, width) the result is added to it in place, and `out` is returned.
        """
        return self._evaluate_at_points("stress_along", [x, direction], theta=theta, out=out)

    def stress_vjp(self, x: Array, weights: Array, theta: Array) -> Array:
        """Return (∂S/∂x)ᵀ weights (T, 3n), for weights (T, width) of the entries of S, at positions
        x (T, 3n) and θ (k,).
        """
        return self._evaluate_at_nodes("pulled", [x], theta=theta, point_data=weights)

    def memory_force(self, x: Array, overstress: Array, theta: Array) -> Array:
        """Return f_H (T, 3n) [N] at positions x (T, 3n): linear in H (`overstress`, (T, width)
        [Pa]).
        """
        return self._evaluate_at_nodes("carried_force", [x], theta=theta, point_data=overstress)

    def memory_force_vjp(self, x: Array, direction: Array, theta: Array) -> Array:
        """Return (∂f_H/∂H)ᵀ direction (T, width), for a direction (T, 3n) in the space of forces,
        at positions x (T, 3n).
        """
        return self._evaluate_at_points("against", [x, direction], theta=theta)

    @cached_property
    def jacobian_entries(self) -> JacobianEntries:
        """Row and column of each entry of `stress_jacobian` and `memory_force_jacobian`."""
        points = []
        dofs = []
        for number, part in enumerate(self.body.parts):
            if part.prony:
                part_columns = self.body.memory.part_columns(number)
                of_cells = dofs_of(self.body.cells[part.cells])
                shape = (*part_columns.shape, of_cells.shape[1])
                points.append(np.broadcast_to(part_columns[..., None], shape).ravel())
                dofs.append(np.broadcast_to(of_cells[:, None, None], shape).ravel())
        return JacobianEntries(np.concatenate(points), np.concatenate(dofs))

    def stress_jacobian(self, x: Array, theta: Array) -> Array:
        """Return the entries (T, K) of ∂S/∂x at positions x (T, 3n) and θ (k,), at
        `jacobian_entries`.
        """
        return self._slopes("stress_slope", x, theta=theta)

    def memory_force_jacobian(self, x: Array, theta: Array) -> Array:
        """Return the entries (T, K) of ∂f_H/∂H at positions x (T, 3n) and θ (k,), in which it is
        linear in x, at `jacobian_entries`.
        """
        return self._slopes("force_slope", x, theta=theta)

    def _slopes(self, name: str, x: Array, theta: Array) -> Array:
        out = np.zeros((len(x), len(self.jacobian_entries.points)))
        return self._evaluate_all_parts(name, [x], theta=theta, out=out)

    def _evaluate_at_points(
        self, name: str, fields: list[Array], theta: Array, out: Array | None = None
    ) -> Array:
        """Return values at points (T, width) of a kernel, added to `out` in place if it is given."""
        out = np.zeros((len(fields[0]), self.width)) if out is None else out
        return self._evaluate_all_parts(name, fields, theta=theta, out=out)

    def _evaluate_at_nodes(
        self, name: str, fields: list[Array], theta: Array, point_data: Array
    ) -> Array:
        """Return node values (T, 3n) of a kernel."""
        return self._evaluate_all_parts(
            name, fields, theta=theta, out=np.zeros_like(fields[0]), point_data=point_data
        )

    def _evaluate_all_parts(
        self,
        name: str,
        fields: list[Array],
        theta: Array,
        out: Array,
        point_data: Array | None = None,
    ) -> Array:
        """Add the results of a kernel for all parts with memory to `out`, in place, and return it."""
        for number, part in enumerate(self.body.parts):
            if part.prony:
                self._evaluate_part(
                    name,
                    number,
                    fields=fields,
                    theta=theta,
                    out=out,
                    add=True,
                    point_data=point_data,
                )
        return out

    def _evaluate_part(
        self,
        name: str,
        number: int,
        fields: list[Array],
        theta: Array,
        out: Array,
        add: bool,
        point_data: Array | None = None,
    ) -> None:
        """Evaluate a kernel for one part; few states run on one thread."""
        body = self.body
        key = (name, number)
        with COMPILING:
            if key not in self._evaluators:
                self._evaluators[key] = body.make_evaluator(self._batch(name, number))
        first = body.starts[number]
        values = np.array(theta[first : first + body.parts[number].law_constant_count], dtype=float)
        part_point_data = body.point_data(number, theta, internal_variables=point_data)
        # One thread is faster than several for few states.
        threads = body.threads if len(out) > 16 else 1
        self._evaluators[key](
            [np.ascontiguousarray(field) for field in fields],
            values,
            out=out,
            threads=threads,
            add=add,
            data_of_points=None
            if part_point_data is None
            else np.ascontiguousarray(part_point_data),
        )

    def _batch(self, name: str, number: int) -> KernelBatch:
        """Return a batch in which every quadrature point is an element of its own."""
        body = self.body
        part = body.parts[number]
        places = body.memory.part_columns(number)
        kernel = stress_kernel(name, body.element, law=body.law(number))
        points = body.geometry.shape[1]
        cells = np.repeat(body.cells[part.cells], points, axis=0)
        geometry = body.material_geometry(part).reshape(len(cells), 1, -1)
        point_columns = places.reshape(len(cells), 1, 6)
        if name.endswith("_slope"):
            # 3n for each of what the points carry, part after part.
            per_number = dofs_of(cells).shape[1]
            length = len(self.jacobian_entries.points)
            point_offsets = np.arange(per_number * places.size).reshape(len(cells), -1)
            destinations = per_number * places[0, 0, 0] + point_offsets
        elif "nodes" in kernel.contractions.values():
            destinations = dofs_of(cells)
            length = body.pattern.size
        elif name == "stress_by_theta":
            count = len(part.material.constants) + bool(part.stress_field)
            columns = places.size * np.arange(count)
            destinations = (columns[:, None] + point_columns - places[0, 0, 0]).reshape(
                len(cells), -1
            )
            length = places.size * len(columns)
        else:
            destinations = point_columns.reshape(len(cells), 6)
            length = self.width
        internal_columns = point_columns if KERNELS[name][2] else point_columns[..., :0]
        if part.stress_field:
            width = self.width if KERNELS[name][2] else 0
            logs = width + np.repeat(np.arange(len(part.cells)), points)
            internal_columns = np.concatenate([internal_columns, logs[:, None, None]], axis=-1)
        internal_columns = (
            internal_columns[..., : kernel.point_data_count] if kernel.point_data_count else None
        )
        return KernelBatch(
            kernel,
            cells,
            geometry=geometry,
            destinations=destinations,
            width=length,
            data_columns=internal_columns,
        )
