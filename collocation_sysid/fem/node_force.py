"""A force on the nodes of a body that a user declares: f(x, v, at, constants) in CasADi operations.

Air drag, a foundation, a magnet: what acts at a point and depends on where that is, how fast it
moves and on time. Its constants stand in θ behind those of the body's parts, and are estimated like
them.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array, Index
from ..errors import InputError, hint_at
from ..files import reason
from .constants import Constant, constant_named
from .mesh import Nodes
from .pattern import SymmetricPattern, dofs_of
from .selection import Indices, Selection

Law = Callable[..., ca.SX]
# A slope is symmetric when its skew part is this small beside it.
SYMMETRIC = 1e-9


class AtNode(NamedTuple):
    """What a law may know of its node, beside where it is and how it moves.

    Attributes
    ----------
    t_s : time
    rest_m : (3,) place on the undeformed body
    area_m2, volume_m3 : its share of the undeformed body's surface and volume
    normal : (3,) outward, undeformed, of length one; zero inside
    """

    t_s: ca.SX
    rest_m: ca.SX
    area_m2: ca.SX
    volume_m3: ca.SX
    normal: ca.SX


# Of the numbers of an `AtNode`, in its order.
DATA = 9


@dataclass(frozen=True, eq=False)
class NodeForce:
    """A force on every node of a body, or on some.

    Attributes
    ----------
    name : str
        For messages.
    law : callable
        ``law(x, v, at, **constants) -> (3,)`` force [N] on a node at x [m] with velocity v [m/s],
        ``at`` being an `AtNode`. Its derivative by v must be symmetric.
    constants : tuple of Constant
    nodes : Selection, (k,) int array or None
    """

    name: str
    law: Law
    constants: tuple[Constant, ...]
    nodes: Selection | Index | None = None

    @classmethod
    def of(
        cls,
        law: Law,
        *constants: Constant,
        nodes: Selection | ArrayLike | None = None,
        name: str | None = None,
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

        Raises
        ------
        InputError
            If it cannot be evaluated, or its derivative by v is not symmetric.
        """
        name = name or str(getattr(law, "__name__", "force")).replace("_", "-")
        told = {constant.name: constant for constant in constants}
        arguments = list(inspect.signature(law).parameters)[3:]
        if unused := sorted(set(told) - set(arguments)):
            raise InputError(
                f"force {name!r} has no constant {unused[0]!r}{hint_at(unused[0], arguments)}"
            )
        known = tuple(told.get(a) or constant_named(a) for a in arguments)
        chosen = nodes if nodes is None or isinstance(nodes, Selection) else np.asarray(nodes)
        found = cls(name, law, known, chosen)
        found._check()
        return found

    def expression(self, u: ca.SX, data: ca.SX) -> ca.SX:
        """The force (3,) of u = (x, v, constants) and the data of an `AtNode`."""
        x, v, values = ca.vertsplit(u, [0, 3, 6, 6 + len(self.constants)])
        at = AtNode(data[0], data[1:4], data[4], data[5], data[6:9])
        named = {c.name: values[k] for k, c in enumerate(self.constants)}
        found = self.law(x, v, at, **named)
        return ca.SX(ca.vertcat(*found) if isinstance(found, (list, tuple)) else found)

    @property
    def inputs(self) -> int:
        """Length of u."""
        return 6 + len(self.constants)

    @cached_property
    def turns(self) -> bool:
        """Whether its derivative by x is not symmetric."""
        return self._skew[0] > SYMMETRIC

    @cached_property
    def _symbols(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """u, data, and the force."""
        u, data = ca.SX.sym("u", self.inputs), ca.SX.sym("data", DATA)
        return u, data, self.expression(u, data)

    @cached_property
    def _slopes(self) -> ca.Function:
        """The force and its slope by u."""
        u, data, y = self._symbols
        return ca.Function("slopes", [u, data], [y, ca.jacobian(y, u)])

    @cached_property
    def _skew(self) -> tuple[float, float]:
        """How far the derivatives by x and by v are from symmetric, at some points."""
        rng, found = np.random.default_rng(0), np.zeros(2)
        for _ in range(3):
            some = [rng.uniform(0.5, 1.0, size) for size in (self.inputs, DATA)]
            values = self._slopes(*some)[1].full()
            for k, part in enumerate((values[:, :3], values[:, 3:6])):
                size = np.abs(part).max() or 1.0
                found[k] = max(found[k], np.abs(part - part.T).max() / size)
        return float(found[0]), float(found[1])

    def _check(self) -> None:
        try:
            shape = self._symbols[2].shape
        except (Exception, SystemExit) as error:
            raise InputError(
                f"force {self.name!r} cannot be evaluated ({reason(error)}); expected a function "
                "of x, v, at and named constants in CasADi operations that returns three forces"
            ) from error
        if shape != (3, 1):
            raise InputError(f"force {self.name!r} has the shape {shape}; expected (3, 1)")
        still = np.concatenate([[0.1, 0.2, 0.3], np.zeros(3), np.ones(len(self.constants))])
        if not all(np.isfinite(e.full()).all() for e in self._slopes(still, np.ones(DATA))):
            raise InputError(
                f"force {self.name!r} or its slope is not finite where the node is at rest; "
                "expected a smooth law, such as sqrt(v·v + 1e-12) in place of |v|"
            )
        if self._skew[1] > SYMMETRIC:
            raise InputError(
                f"the derivative of force {self.name!r} by the velocity is not symmetric; "
                "expected a force that a potential of the velocity has, such as a drag along it"
            )

    def on_finer(self, nodes: Index | None) -> NodeForce:
        """The same on a finer body, whose nodes these are where no selection finds them."""
        finds = self.nodes is None or (
            isinstance(self.nodes, Selection) and not isinstance(self.nodes, Indices)
        )
        return self if finds else replace(self, nodes=nodes)


@dataclass(frozen=True, eq=False)
class PlacedForce:
    """A `NodeForce` on the nodes of a body.

    Attributes
    ----------
    force : NodeForce
    nodes : (k,)
    data : (8, k) what an `AtNode` has behind the time
    columns : (c,) places of its constants in θ
    couplings : SymmetricPattern of the nodes' own dofs
    """

    force: NodeForce
    nodes: Index
    data: Array
    columns: Index
    couplings: SymmetricPattern

    @classmethod
    def on(
        cls, force: NodeForce, mesh: Nodes, chosen: Index, volume_m3: Array, columns: Index
    ) -> PlacedForce:
        """A force on chosen nodes of a mesh whose nodes have these volumes (n,)."""
        count = len(mesh.points_m)
        area, normal = _surface_of(mesh)
        data = np.vstack([mesh.points_m.T, area, volume_m3, normal.T])[:, chosen]
        dofs = dofs_of(chosen[:, None])
        rows, places = np.tril_indices(3)
        couplings = SymmetricPattern.of_entries(
            dofs[:, rows].ravel(), dofs[:, places].ravel(), count
        )
        return cls(force, chosen, data, columns, couplings)


def _surface_of(mesh: Nodes) -> tuple[Array, Array]:
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
