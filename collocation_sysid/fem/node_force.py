"""A force on nodes or faces of a body that a user declares: f(x, v, at, constants) in CasADi.

Air drag, a foundation, a magnet: what acts at a point and depends on where that is, how fast it
moves and on time; or, at the middle of a face, on its area and normal as they are now, as a
pressure. Its constants stand in θ behind those of the body's parts, and are estimated like them.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, NamedTuple, get_args

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array, Index
from ..errors import InputError, hint_at
from ..files import reason
from .constants import Constant, constant_named
from .force_points import ForcePoints
from .mesh import Nodes
from .selection import Indices, Selection

Law = Callable[..., Any]
On = Literal["nodes", "faces"]
# A slope is symmetric when its skew part is this small beside it.
SYMMETRIC = 1e-9


class AtNode(NamedTuple):
    """What a law may know of its node or face, beside where it is and how it moves.

    Attributes
    ----------
    t_s : time
    rest_m : (3,) place on the undeformed body
    area_m2, volume_m3 : of a node, its share of the undeformed body's surface and volume
        The area of a face is that which it has now, and its volume zero.
    normal : (3,) outward, of length one; of a node undeformed, and zero inside
        That of a face is as it is now.
    since_s : time since the evaluation before
    began : one where there is none, which is the start, else zero
    """

    t_s: ca.SX
    rest_m: ca.SX
    area_m2: ca.SX
    volume_m3: ca.SX
    normal: ca.SX
    since_s: ca.SX
    began: ca.SX


# Where the numbers of an `AtNode` end, in its order.
ENDS = (0, 1, 4, 5, 6, 9, 10, 11)
DATA = ENDS[-1]
# The corners of a triangle for trying laws.
TRIANGLE_M = (0.1, 0.2, 0.3, 0.2, 0.2, 0.3, 0.1, 0.3, 0.3)


@dataclass(frozen=True, eq=False)
class NodeForce:
    """A force on every node of a body, on every face of its surface, or on some.

    Attributes
    ----------
    name : str
        For messages.
    law : callable
        ``law(x, v, at, **constants) -> (3,)`` force [N] on a node at x [m] with velocity v [m/s],
        ``at`` being an `AtNode`; or on a face, whose middle is at x.
    constants : tuple of Constant
    nodes : Selection, (k,) int array or None
    on : {"nodes", "faces"}
        On faces of the surface, all of whose nodes are chosen; quadratic ones are as if folded
        along their middles.
    carries : int
        So many numbers of a node or face are carried from evaluation to evaluation, such as how far
        a dashpot has crept: then ``law(x, v, before, at, **constants) -> (force, after)``, where
        `before` (carries,) are those of the evaluation before, zero at the start.
    compiled : bool
        Whether the law is compiled to native code, which must have all of its operations; for laws
        that are evaluated in every step of most problems.
    """

    name: str
    law: Law
    constants: tuple[Constant, ...]
    nodes: Selection | Index | None = None
    on: On = "nodes"
    carries: int = 0
    compiled: bool = False

    @classmethod
    def of(
        cls,
        law: Law,
        *constants: Constant,
        nodes: Selection | ArrayLike | None = None,
        name: str | None = None,
        on: On = "nodes",
        carries: int = 0,
    ) -> NodeForce:
        """A force by a law; its arguments after x, v and at name the constants, with their units.

        Parameters
        ----------
        law : see `NodeForce`
        *constants : Constant
            Bounds, symbols and scales where the names alone do not tell.
        nodes : Selection or (k,) int array, optional
            All by default.
        name : str, optional
        on : {"nodes", "faces"}
        carries : int

        Raises
        ------
        InputError
            If it cannot be evaluated.
        """
        name = name or str(getattr(law, "__name__", "force")).replace("_", "-")
        told = {constant.name: constant for constant in constants}
        arguments = list(inspect.signature(law).parameters)[4 if carries else 3 :]
        if "at" in arguments:
            raise InputError(
                f"force {name!r} takes something before at, as what carries numbers from step to "
                "step does; expected carries to say how many"
            )
        if unused := sorted(set(told) - set(arguments)):
            raise InputError(
                f"force {name!r} has no constant {unused[0]!r}{hint_at(unused[0], arguments)}"
            )
        known = tuple(told.get(a) or constant_named(a) for a in arguments)
        chosen = nodes if nodes is None or isinstance(nodes, Selection) else np.asarray(nodes)
        if on not in get_args(On):
            raise InputError(
                f"force {name!r} is on {on!r}; expected one of {', '.join(get_args(On))}"
            )
        found = cls(name, law, known, chosen, on, carries)
        found._check()
        return found

    def expression(self, u: ca.SX, data: ca.SX) -> ca.SX:
        """Forces (3k,) on k nodes and what they leave, of u = (x, v, constants, before) and data.

        These are the numbers of an `AtNode`.
        """
        dofs = (u.numel() - len(self.constants) - self.carries) // 2
        ends = [0, dofs, 2 * dofs, u.numel() - self.carries, u.numel()]
        x, v, values, before = ca.vertsplit(u, ends)
        at = AtNode(*ca.vertsplit(data, [*ENDS]))
        named = {c.name: values[k] for k, c in enumerate(self.constants)}
        if self.on == "nodes":
            return ca.vertcat(*self._valued(x, v, before, at, named))
        places = ca.horzsplit(ca.reshape(x, 3, dofs // 3))
        area = area_vector(places)
        size = ca.norm_2(area)
        at = at._replace(area_m2=size, normal=area / size)
        force, after = self._valued(middle(x), middle(v), before, at, named)
        return ca.vertcat(*[ca.SX.zeros(3)] * (len(places) - 3), *[force / 3] * 3, after)

    def _valued(
        self, x: ca.SX, v: ca.SX, before: ca.SX, at: AtNode, named: dict[str, ca.SX]
    ) -> tuple[ca.SX, ca.SX]:
        """The force, and what is left to the next evaluation."""
        if not self.carries:
            return _column(self.law(x, v, at, **named)), ca.SX.zeros(0)
        force, after = self.law(x, v, before, at, **named)
        return _column(force), _column(after)

    def inputs(self, dofs: int) -> int:
        """Length of u for so many dofs."""
        return 2 * dofs + len(self.constants) + self.carries

    @property
    def _dofs(self) -> int:
        """Those of a node, or of the simplest face."""
        return 3 if self.on == "nodes" else 9

    @cached_property
    def turns(self) -> bool:
        """Whether its derivative by x is not symmetric."""
        return self._skew[0] > SYMMETRIC

    @cached_property
    def spins(self) -> bool:
        """The same of its derivative by v, as of gyroscopic forces."""
        return self._skew[1] > SYMMETRIC

    @cached_property
    def _symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """u, data, and the force."""
        u, data = ca.SX.sym("u", self.inputs(self._dofs)), ca.SX.sym("data", DATA)
        return u, data, self.expression(u, data)

    @cached_property
    def _slopes(self) -> ca.Function:
        """The force and its slope by u."""
        u, data, y = self._symbols
        return ca.Function("slopes", [u, data], [y, ca.jacobian(y, u)])

    @cached_property
    def _skew(self) -> tuple[float, float]:
        """How far the derivatives by x and by v are from symmetric, at some points."""
        rng, found, dofs = np.random.default_rng(0), np.zeros(2), self._dofs
        for _ in range(3):
            some = [rng.uniform(0.5, 1.0, size) for size in (self.inputs(dofs), DATA)]
            values = self._slopes(*some)[1].full()
            values = values[:dofs]
            for k, part in enumerate((values[:, :dofs], values[:, dofs : 2 * dofs])):
                size = np.abs(part).max() or 1.0
                found[k] = max(found[k], np.abs(part - part.T).max() / size)
        return float(found[0]), float(found[1])

    def _check(self) -> None:
        dofs, named = self._dofs, {c.name: ca.SX.sym(c.name) for c in self.constants}
        x, v, before = (ca.SX.sym("u", size) for size in (3, 3, self.carries))
        at = AtNode(*ca.vertsplit(ca.SX.sym("data", DATA), [*ENDS]))
        try:
            force, after = self._valued(x, v, before, at, named)
            _ = self._symbols
        except (Exception, SystemExit) as error:
            carried = " and what is carried" if self.carries else ""
            raise InputError(
                f"force {self.name!r} cannot be evaluated ({reason(error)}); expected a function "
                "of x, v, at and named constants in CasADi operations that returns three forces"
                + carried
            ) from error
        if force.shape != (3, 1):
            raise InputError(f"force {self.name!r} has the shape {force.shape}; expected (3, 1)")
        if after.shape != (self.carries, 1):
            raise InputError(
                f"force {self.name!r} returns {after.numel()} numbers to carry; expected "
                f"{self.carries}, as carries says"
            )
        still = np.zeros(self.inputs(dofs))
        still[:dofs] = TRIANGLE_M[:dofs]
        still[2 * dofs : 2 * dofs + len(self.constants)] = 1.0
        if not all(np.isfinite(e.full()).all() for e in self._slopes(still, np.ones(DATA))):
            raise InputError(
                f"force {self.name!r} or its slope is not finite where the node is at rest; "
                "expected a smooth law, such as sqrt(v·v + 1e-12) in place of |v|"
            )

    def on_finer(self, nodes: Index | None) -> NodeForce:
        """The same on a finer body, whose nodes these are where no selection finds them."""
        finds = self.nodes is None or (
            isinstance(self.nodes, Selection) and not isinstance(self.nodes, Indices)
        )
        return self if finds else replace(self, nodes=nodes)


@dataclass(frozen=True, eq=False)
class PlacedForce:
    """A `NodeForce` on the nodes, or the faces, of a body.

    Attributes
    ----------
    force : NodeForce
    points : ForcePoints
        The nodes, or those of each face.
    data : (8, i) what an `AtNode` has behind the time and before the time since
    columns : (c,) places of its constants in θ
    """

    force: NodeForce
    points: ForcePoints
    data: Array
    columns: Index

    @classmethod
    def on(
        cls, force: NodeForce, mesh: Nodes, chosen: Index, volume_m3: Array, columns: Index
    ) -> PlacedForce:
        """A force on chosen nodes of a mesh, on a body whose nodes have these volumes (n,)."""
        area, normal = surface_of(mesh)
        data = np.vstack([mesh.points_m.T, area, volume_m3[: len(area)], normal.T])
        if force.on == "nodes":
            nodes, data = chosen[:, None], data[:, chosen]
        else:
            faces = mesh.on_faces(mesh.mesh.surface)
            nodes = faces[np.isin(faces, chosen).all(axis=1)]
            if not len(nodes):
                raise InputError(
                    f"force {force.name!r} is on faces, but none of the surface has all of its "
                    "nodes among those chosen"
                )
            data = data[:, nodes[:, -3:]].mean(axis=2)
            data[3:] = 0.0
        return cls(force, ForcePoints.of_nodes(nodes, len(volume_m3)), data, columns)


def _column(values: Any) -> ca.SX:
    return ca.SX(ca.vertcat(*values) if isinstance(values, (list, tuple)) else values)


def middle(values: ca.SX) -> ca.SX:
    """Of a face, as what acts there is shared: that of its last three nodes (3k,)."""
    return ca.sum2(ca.reshape(values, 3, values.numel() // 3)[:, -3:]) / 3


def area_vector(places: Sequence[ca.SX]) -> ca.SX:
    """Of a face with corners a, b, c, and nodes on ab, bc, ca if any, its normal times its area."""
    corners, middles = places[:3], places[3:]
    pairs = zip(corners, middles, strict=True) if middles else ((corner,) for corner in corners)
    ring = [place - places[0] for pair in pairs for place in pair]
    beside = pairwise(ring)
    return sum((ca.cross(a, b) for a, b in beside), start=ca.SX.zeros(3)) / 2


def surface_of(mesh: Nodes) -> tuple[Array, Array]:
    """(n,) area and (n, 3) normal of every node: corners', or of quadratic faces the mid nodes'."""
    faces = mesh.on_faces(mesh.mesh.surface)
    a, b, c = np.moveaxis(mesh.points_m[faces[:, :3]], 1, 0)
    share, normal = np.cross(b - a, c - a) / 6, np.zeros((len(mesh.points_m), 3))
    area = np.zeros(len(normal))
    for node in faces[:, -3:].T:
        np.add.at(normal, node, share)
        np.add.at(area, node, np.linalg.norm(share, axis=1))
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return area, np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
