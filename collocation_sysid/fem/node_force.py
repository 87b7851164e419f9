"""Custom forces on nodes or faces of a body: laws f(x, v, at, constants) in CasADi.

Use `NodeForce.from_law` for a force that depends on position, velocity and time of a node, such as
air drag, a foundation or a magnet; or, on faces of the surface, on their current area and normal,
such as a pressure. Its constants follow those of the body's parts in θ and are estimated like them.

Air of density ρ_a at rest exerts three forces on a body of volume V:

- buoyancy −ρ_a V g, exactly;
- the inertia of the air that moves with the body, c_m ρ_a V a, where c_m is ½ for a sphere;
- drag −½ ρ_a c_d A |v| v on each surface element, where A is the area that faces the motion. For a
  convex body A is a quarter of its surface on average over directions (Cauchy).

V is the volume of the undeformed body, lumped at its nodes like the mass. The coefficients c_m and
c_d depend on shape and motion; they are accurate to some 40 %, see
`statistics.budget.systematic_effects`. Here are the constants and the drag; `model.weight` applies
buoyancy and added mass.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from itertools import pairwise
from typing import Annotated, Any, Literal, NamedTuple, cast

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from ..common.array_types import Array, Index
from ..common.files import reason
from ..common.validated_classes import validated
from ..common.validated_types import Count, Text
from ..errors import InputError, hint_at
from .force_points import ForcePoints
from .laws.constants import Constant, constant_named
from .meshes.mesh import ElementNodes
from .meshes.selection import Indices, Selection

# Force or internal variables as a law returns them: a column, or its components.
Column = ca.SX | Sequence[ca.SX | float]
Law = Callable[..., Column | tuple[Column, Column]]
On = Literal["nodes", "faces", "elements"]
# A derivative counts as symmetric if its skew part is at most this fraction of its largest entry.
SYMMETRY_TOLERANCE = 1e-9


class ForceContext(NamedTuple):
    """Further quantities on which a law may depend, beside position and velocity."""

    t_s: ca.SX  # time
    rest_m: ca.SX  # (3,) SX: position on the undeformed body
    # Share of a node in the surface and volume of the undeformed body; for a face its current area,
    # and zero volume.
    area_m2: ca.SX
    volume_m3: ca.SX
    # (3,) SX: outward unit normal: of a node that of the undeformed surface, zero inside; of a face
    # the current one.
    normal: ca.SX
    interval_s: ca.SX  # time since the previous evaluation
    is_start: ca.SX  # 1 at the start, where there is no previous evaluation, else 0


# Offsets of the attributes of a `ForceContext` in the data of a law, in their order.
CONTEXT_OFFSETS = (0, 1, 4, 5, 6, 9, 10, 11)
CONTEXT_SIZE = CONTEXT_OFFSETS[-1]
# Corners of a triangle on which laws are tested.
TRIANGLE_M = (0.1, 0.2, 0.3, 0.2, 0.2, 0.3, 0.1, 0.3, 0.3)


@validated
@dataclass(frozen=True, eq=False)
class NodeForce:
    """Force on every node of a body, on every face of its surface, or on some of them.

    Attributes
    ----------
    name : str
        Name for messages.
    law : callable
        ``law(x, v, at, **constants) -> (3,)`` force [N] on a node at x [m] with velocity v [m/s],
        where ``at`` is an `ForceContext`; or on a face whose middle is at x.
    constants : tuple of Constant
    nodes : Selection, (k,) int array or None
        Nodes on which the force acts; None for all.
    on : {"nodes", "faces", "elements"}
        "faces": on faces of the surface whose nodes are all selected; quadratic faces are treated
        as folded along their mid nodes. "elements": on elements of a rod, where x is the gradient
        G (15,), column by column, and `at.volume_m3` the length.
    internal_variable_count : int
        Number of internal variables of a node or face, such as the creep of a dashpot. If it is
        nonzero: ``law(x, v, before, at, **constants) -> (force, after)``, where `before` (carries,)
        are the variables of the previous evaluation, zero at the start.
    is_compiled : bool
        Whether the law is compiled to native code, which must support all of its operations;
        worthwhile for laws that are evaluated in every step of most problems.
    """

    name: Text
    law: Law
    constants: tuple[Constant, ...]
    nodes: Selection | Index | None = None
    on: On = "nodes"
    internal_variable_count: Annotated[Count, Field(le=100)] = 0
    is_compiled: bool = False

    @classmethod
    @validated
    def from_law(
        cls,
        law: Law,
        *constants: Constant,
        nodes: Selection | ArrayLike | None = None,
        name: str | None = None,
        on: Literal["nodes", "faces"] = "nodes",
        carries: int = 0,
    ) -> NodeForce:
        """Return a force from a law, after evaluating it once as a check.

        Arguments of the law after x, v and at are its constants; their names end with their units.

        Parameters
        ----------
        law : callable
            See `NodeForce`.
        *constants : Constant
            Definitions of constants whose bounds, symbols or scales do not follow from the names.
        nodes : Selection or (k,) int array, optional
            None for all.
        name : str, optional
            Name for messages; that of the function by default.
        on : {"nodes", "faces"}
        carries : int
            Number of internal variables of a node or face.

        Raises
        ------
        InputError
            If the law cannot be evaluated, has the wrong shape, or is not finite at rest; if a
            definition is of no argument, or `on` is unknown.
        """
        name = name or str(getattr(law, "__name__", "force")).replace("_", "-")
        definitions = {constant.name: constant for constant in constants}
        arguments = list(inspect.signature(law).parameters)[4 if carries else 3 :]
        if "at" in arguments:
            raise InputError(
                f"force {name!r}: the function has an argument between v and `at`; expected the "
                "arguments x, v, at and then named constants. For a force with internal variables, "
                "whose arguments are x, v, before, at, state carries = the number of internal "
                "variables"
            )
        if unused := sorted(set(definitions) - set(arguments)):
            raise InputError(
                f"force {name!r}: the function has no argument for the given constant {unused[0]!r}; "
                "expected its name among the arguments "
                f"{', '.join(arguments)}{hint_at(unused[0], arguments)}"
            )
        known = tuple(definitions.get(a) or constant_named(a) for a in arguments)
        chosen = nodes if nodes is None or isinstance(nodes, Selection) else np.asarray(nodes)
        force = cls(
            name, law, constants=known, nodes=chosen, on=on, internal_variable_count=carries
        )
        force._check()
        return force

    def __getstate__(self) -> dict[str, Any]:
        # CasADi's symbols cannot be pickled; cached properties are computed again.
        return {each.name: getattr(self, each.name) for each in fields(self)}

    def expression(self, u: ca.SX, data: ca.SX) -> ca.SX:
        """Return forces (3k,) on k nodes, followed by the internal variables after the evaluation,
        as an expression.

        A force on a face is shared by its last three nodes: the corners, or the mid nodes of a
        quadratic face, whose corners get zero.

        Parameters
        ----------
        u : SX
            Stacked (x, v, constants, before), with 3k entries of x and v each.
        data : (11,) SX
            Entries of a `ForceContext`.
        """
        dofs = (u.numel() - len(self.constants) - self.internal_variable_count) // 2
        ends = [0, dofs, 2 * dofs, u.numel() - self.internal_variable_count, u.numel()]
        x, v, values, before = ca.vertsplit(u, ends)
        at = ForceContext(*ca.vertsplit(data, [*CONTEXT_OFFSETS]))
        named = {c.name: values[k] for k, c in enumerate(self.constants)}
        if self.on != "faces":
            return ca.vertcat(*self._evaluate_law(x, v, before=before, at=at, named=named))
        places = ca.horzsplit(ca.reshape(x, 3, dofs // 3))
        area = area_vector(places)
        size = ca.norm_2(area)
        at = at._replace(area_m2=size, normal=area / size)
        force, after = self._evaluate_law(
            face_middle(x), face_middle(v), before=before, at=at, named=named
        )
        return ca.vertcat(*[ca.SX.zeros(3)] * (len(places) - 3), *[force / 3] * 3, after)

    def _evaluate_law(
        self, x: ca.SX, v: ca.SX, before: ca.SX, at: ForceContext, named: dict[str, ca.SX]
    ) -> tuple[ca.SX, ca.SX]:
        """Return the force (3,) and the new internal variables (h,), empty without."""
        if not self.internal_variable_count:
            force = cast(Column, self.law(x, v, at, **named))
            return _as_column(force), ca.SX.zeros(0)
        force, after = cast(tuple[Column, Column], self.law(x, v, before, at, **named))
        return _as_column(force), _as_column(after)

    def input_size(self, dofs: int) -> int:
        """Return the length of u of `expression` for a number of position dofs: 3 of a node, 9 or
        18 of a face.
        """
        return 2 * dofs + len(self.constants) + self.internal_variable_count

    @property
    def _smallest_dofs(self) -> int:
        return {"nodes": 3, "faces": 9, "elements": 15}[self.on]

    @cached_property
    def has_skew_stiffness(self) -> bool:
        """Whether the derivative of the force by x is not symmetric at one of three random
        points.
        """
        return self._relative_skew_parts[0] > SYMMETRY_TOLERANCE

    @cached_property
    def has_skew_damping(self) -> bool:
        """Whether the derivative of the force by v is not symmetric at one of three random points,
        as for gyroscopic forces.
        """
        return self._relative_skew_parts[1] > SYMMETRY_TOLERANCE

    @cached_property
    def _symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        u = ca.SX.sym("u", self.input_size(self._smallest_dofs))
        data = ca.SX.sym("data", CONTEXT_SIZE)
        return u, data, self.expression(u, data)

    @cached_property
    def _force_and_jacobian(self) -> ca.Function:
        u, data, output = self._symbols
        slopes = ca.jacobian(output, u)
        return ca.Function("slopes", [u, data], [output, slopes])

    @cached_property
    def _relative_skew_parts(self) -> tuple[float, float]:
        """Largest relative skew parts of ∂f/∂x and ∂f/∂v at three random points."""
        rng = np.random.default_rng(0)
        largest = np.zeros(2)
        dofs = self._smallest_dofs
        for _ in range(3):
            sample = [rng.uniform(0.5, 1.0, size) for size in (self.input_size(dofs), CONTEXT_SIZE)]
            values = self._force_and_jacobian(*sample)[1].full()
            values = values[:dofs]
            for k, part in enumerate((values[:, :dofs], values[:, dofs : 2 * dofs])):
                size = np.abs(part).max() or 1.0
                largest[k] = max(largest[k], np.abs(part - part.T).max() / size)
        return float(largest[0]), float(largest[1])

    def _check(self) -> None:
        dofs = self._smallest_dofs
        named = {c.name: ca.SX.sym(c.name) for c in self.constants}
        x, v, before = (ca.SX.sym("u", size) for size in (3, 3, self.internal_variable_count))
        at = ForceContext(*ca.vertsplit(ca.SX.sym("data", CONTEXT_SIZE), [*CONTEXT_OFFSETS]))
        try:
            force, after = self._evaluate_law(x, v, before=before, at=at, named=named)
            _ = self._symbols
        except (Exception, SystemExit) as error:
            internal_text = (
                ", and of the new internal variables" if self.internal_variable_count else ""
            )
            raise InputError(
                f"force {self.name!r} cannot be evaluated ({reason(error)}); expected a function of x, "
                "v, at and named constants in CasADi operations that returns the three components of "
                f"a force{internal_text}"
            ) from error
        if force.shape != (3, 1):
            raise InputError(
                f"force {self.name!r} returns an expression of the shape {force.shape}; expected (3, "
                "1): the force in x, y and z"
            )
        if after.shape != (self.internal_variable_count, 1):
            raise InputError(
                f"force {self.name!r} returns {after.numel()} internal variables; expected "
                f"{self.internal_variable_count}, as stated by carries"
            )
        at_rest = np.zeros(self.input_size(dofs))
        at_rest[:dofs] = TRIANGLE_M[:dofs]
        at_rest[2 * dofs : 2 * dofs + len(self.constants)] = 1.0
        if not all(
            np.isfinite(e.full()).all()
            for e in self._force_and_jacobian(at_rest, np.ones(CONTEXT_SIZE))
        ):
            raise InputError(
                f"force {self.name!r} or its derivative is not finite for a node at rest; expected a "
                "smooth law: a norm |v|, whose derivative is not finite at zero, can be replaced by "
                "sqrt(v·v + 1e-12)"
            )

    def on_refined_body(self, nodes: Index | None) -> NodeForce:
        """Return this force for a refined body.

        It is the force itself if it acts on all nodes or on a geometric selection, which selects
        anew.

        Parameters
        ----------
        nodes : (k,) int or None
            Nodes of the refined body, used in place of indices of nodes of the coarse body.
        """
        finds = self.nodes is None or (
            isinstance(self.nodes, Selection) and not isinstance(self.nodes, Indices)
        )
        return self if finds else replace(self, nodes=nodes)


@dataclass(frozen=True, eq=False)
class LocatedForce:
    """Custom force on the nodes or faces of a body."""

    force: NodeForce
    points: ForcePoints  # the nodes, or those of each face
    # (8, i): entries of an `ForceContext` between `t_s` and `interval_s`, for each instance.
    data: Array
    columns: Index  # (c,): indices in θ of its constants

    @classmethod
    def on_mesh(
        cls, force: NodeForce, mesh: ElementNodes, chosen: Index, volume_m3: Array, columns: Index
    ) -> LocatedForce:
        """Place a force on selected nodes of a mesh.

        Parameters
        ----------
        chosen : (k,) int
            Indices of the selected nodes.
        volume_m3 : (n,)
            Lumped volumes of all nodes of the body.
        columns : (c,) int
            Indices in θ of the constants.

        Raises
        ------
        InputError
            If the force is on faces and no face has all of its nodes selected.
        """
        if force.on == "elements":
            nodes = mesh.cells[np.isin(mesh.cells, chosen).all(axis=1)]
            weights, lengths_m = mesh.mesh.gradients(mesh.points_m, nodes)
            data = np.zeros((CONTEXT_SIZE - 3, len(nodes)))
            data[4] = lengths_m
            return cls(force, ForcePoints(nodes, weights, len(volume_m3)), data, columns)
        area, normal = mesh.surface_shares
        data = np.vstack([mesh.points_m.T, area, volume_m3[: len(area)], normal.T])
        if force.on == "nodes":
            nodes = chosen[:, None]
            data = data[:, chosen]
        else:
            faces = mesh.nodes_of_faces(mesh.mesh.surface)
            nodes = faces[np.isin(faces, chosen).all(axis=1)]
            if not len(nodes):
                raise InputError(
                    f"force {force.name!r} acts on faces of the surface, but no face has all of its nodes "
                    "among the chosen nodes; expected all nodes of the faces on which it acts"
                )
            data = data[:, nodes[:, -3:]].mean(axis=2)
            data[3:] = 0.0
        return cls(force, ForcePoints.at_nodes(nodes, len(volume_m3)), data=data, columns=columns)


def _as_column(values: Column) -> ca.SX:
    if isinstance(values, (list, tuple)):
        return ca.SX(ca.vertcat(*values))
    return ca.SX(cast(ca.SX, values))


def face_middle(values: ca.SX) -> ca.SX:
    """Return the mean (3,) over the last three nodes of a face of a nodal vector (3k,), k = 3 or 6.

    These nodes share the force on the face: the corners, or the mid nodes of a quadratic face.
    """
    return ca.sum2(ca.reshape(values, 3, values.numel() // 3)[:, -3:]) / 3


def area_vector(places: Sequence[ca.SX]) -> ca.SX:
    """Return the normal of a face times its area (3,).

    Parameters
    ----------
    places : sequence of (3,) SX
        Corners a, b, c, and the nodes on ab, bc, ca of a quadratic face.
    """
    corners = places[:3]
    middles = places[3:]
    pairs = zip(corners, middles, strict=True) if middles else ((corner,) for corner in corners)
    ring = [place - places[0] for pair in pairs for place in pair]
    neighbours = pairwise(ring)
    return sum((ca.cross(a, b) for a, b in neighbours), start=ca.SX.zeros(3)) / 2


# Air at 20 °C and sea level, half humid [kg/m³].
AIR_KG_M3 = 1.2
# Share of the displaced air that moves with a body: that of a sphere in an ideal fluid.
ADDED_MASS_SHARE = 0.5
# Drag coefficient c_d of a bluff body at Reynolds numbers of 10³ to 10⁵.
DRAG_COEFFICIENT = 1.0
# Share of the surface of a convex body that faces a direction, on average over directions.
FACING_SHARE = 0.25
# Below this speed [m/s] drag becomes linear in the velocity, so that it is smooth at rest. There it
# is less than 1e-8 of the weight of a foam cube of 0.1 m.
SMOOTH_BELOW_M_S = 1e-4


@cache
def unit_drag() -> NodeForce:
    """Return the drag on surface nodes in a fluid at rest of density 1 kg/m³, the same object at
    every call.

    The force on a node with the share A of the surface [m²] is −½ c_d ¼ A √(|v|² + v₀²) v, with v₀
    =
    `SMOOTH_BELOW_M_S`; the caller multiplies it by the density.
    """

    def air_drag(x: ca.SX, v: ca.SX, at: ForceContext) -> ca.SX:
        """Return the drag (3,) on a node, in a fluid of density 1 kg/m³."""
        speed = ca.sqrt(ca.sumsqr(v) + SMOOTH_BELOW_M_S**2)
        return -0.5 * DRAG_COEFFICIENT * FACING_SHARE * at.area_m2 * speed * v

    return replace(NodeForce.from_law(air_drag, name="air drag"), is_compiled=True)


def placed_unit_drag(nodes: ElementNodes, volume_m3: Array) -> LocatedForce:
    """Return `unit_drag` on the nodes of a body that have a share of its surface; it has no
    constants.

    Parameters
    ----------
    nodes : ElementNodes
        Nodes of the elements, without those of obstacle frames.
    volume_m3 : (n,)
        Lumped volume of every node of the body [m³], including nodes of obstacle frames.
    """
    on_surface = np.flatnonzero(nodes.surface_shares[0] > 0)
    no_constants = np.zeros(0, dtype=np.int64)
    return LocatedForce.on_mesh(
        unit_drag(), nodes, chosen=on_surface, volume_m3=volume_m3, columns=no_constants
    )
