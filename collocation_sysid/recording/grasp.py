"""How the robot holds the body: grasped nodes, and the rigid motion that carries them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import Array, Index
from ..errors import InputError
from ..fem.selection import Selection
from .clock import TIME_TOLERANCE_S
from .poses import PoseSequence
from .selected import on_body, some_nodes
from .wrench import Wrench

if TYPE_CHECKING:
    from ..fem.body import Body


AXES = ("x", "y", "z", "xy", "xz", "yz", "xyz")


@dataclass(frozen=True, eq=False)
class Grasp:
    """Nodes held by the robot, and the motion that carries them.

    Parameters
    ----------
    nodes : (h,) int array or Selection
        Node numbers, kept sorted and without repeats; an experiment looks a selection up.
    poses : PoseSequence or (T, 4, 4) array
        Where they are held; an experiment takes matrices as the poses at its times.
    from_s, until_s : float
        First and last time at which they are held; throughout by default.
    sigma_m, sigma_rad : float, optional
        Standard deviations of the noise of each pose, which widen the error bars; judged by how
        rough the poses are where they are not given.
    selection : Selection, optional
        What selected the nodes, where something did: on a finer mesh it selects others.
    axes : str
        Along which axes of the world they are held, such as "z" for a platen on which the body
        slides; "xyz" by default.
    zero : str
        Along which axes the zero of the poses is known no better than the experiment's `nuisance`
        says, as that of a test bench's crosshead; along none by default.
    wrench : Wrench, optional
        What it was measured to give the body.
    """

    nodes: Index
    poses: PoseSequence
    from_s: float
    until_s: float
    sigma_m: float | None
    sigma_rad: float | None
    selection: Selection | None
    axes: str
    zero: str
    wrench: Wrench | None

    def __init__(
        self,
        nodes: ArrayLike | Selection,
        poses: PoseSequence | ArrayLike,
        from_s: float = -np.inf,
        until_s: float = np.inf,
        sigma_m: float | None = None,
        sigma_rad: float | None = None,
        selection: Selection | None = None,
        axes: str = "xyz",
        zero: str = "",
        wrench: Wrench | None = None,
    ) -> None:
        if not from_s <= until_s:
            raise InputError(
                f"a grasp holds from {from_s:g} s until {until_s:g} s; expected from_s <= until_s"
            )
        for name, given, known in (("axes", axes, AXES), ("zero", zero, ("", *AXES))):
            if given not in known:
                raise InputError(
                    f"{name} of a grasp is {given!r}; expected one of {', '.join(AXES)}"
                )
        held = some_nodes("the grasp")(nodes)
        for name, value in (("sigma_m", sigma_m), ("sigma_rad", sigma_rad)):
            if value is not None and not value >= 0:
                raise InputError(f"{name} of a grasp is {value:g}; expected 0 or more")
        vars(self).update(
            nodes=held,
            poses=poses,
            from_s=from_s,
            until_s=until_s,
            sigma_m=sigma_m,
            sigma_rad=sigma_rad,
            selection=held if isinstance(held, Selection) else selection,
            axes=axes,
            zero="".join(axis for axis in zero if axis in axes),
            wrench=wrench,
        )

    def on(self, body: Body, t_s: Array) -> Grasp:
        """The same grasp with the nodes of a body, and matrices as the poses at `t_s`."""
        nodes, poses = on_body(self.nodes, body), self.poses
        if not isinstance(poses, PoseSequence):
            poses = PoseSequence.from_matrices(t_s, poses)
        given = nodes is self.nodes and poses is self.poses
        return self if given else replace(self, nodes=nodes, poses=poses)

    @cached_property
    def columns(self) -> Index:
        """(a,) its axes as numbers."""
        return np.array(["xyz".index(axis) for axis in self.axes])

    @cached_property
    def dofs(self) -> Index:
        """(h a,) the dofs that it holds, ascending."""
        return (3 * self.nodes[:, None] + self.columns).ravel()

    def holds(self, t_s: ArrayLike) -> NDArray[np.bool_]:
        """Return whether the nodes are held at the times `t_s` (T,)."""
        times = np.asarray(t_s, dtype=np.float64)
        return (times >= self.from_s - TIME_TOLERANCE_S) & (
            times <= self.until_s + TIME_TOLERANCE_S
        )

    def carry(self, nodes_m: Array, t_s: ArrayLike) -> Array:
        """Return where the body's nodes (n, 3) that it holds are at `t_s` (T,), (T, h, 3)."""
        return self.poses.carry(nodes_m[self.nodes], t_s)


def held_nodes(grasps: Sequence[Grasp]) -> Index:
    """Return all nodes that are grasped at some time along some axis, sorted."""
    return np.unique(held_dofs(grasps) // 3)


def held_dofs(grasps: Sequence[Grasp]) -> Index:
    """Return all dofs, 3 node + axis, that are grasped at some time, sorted.

    Raises
    ------
    InputError
        If two grasps hold the same node at the same time along the same axis.
    """
    for (i, first), (j, second) in combinations(enumerate(grasps, start=1), 2):
        shared = np.intersect1d(first.dofs, second.dofs)
        if shared.size and max(first.from_s, second.from_s) <= min(first.until_s, second.until_s):
            node, axis = divmod(int(shared[0]), 3)
            along = "" if first.axes == second.axes == "xyz" else f" along {'xyz'[axis]}"
            raise InputError(
                f"node {node} is held by the grasps {i} and {j} at the same time{along}; "
                "select nodes so that each is held once"
            )
    return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(g.dofs for g in grasps)]))
