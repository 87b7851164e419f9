"""Grasps: nodes with prescribed displacements, and the rigid motion that prescribes them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, Any, Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..common.array_types import Array, Index
from ..common.checked_arrays import float_array
from ..common.declarations import declaration, key
from ..common.validated_types import Finite, NotNegative
from ..errors import InputError
from ..fem.meshes.selection import Selection
from .measured_wrench import Wrench
from .node_selection import Nodes, node_converter, select_on_body, selection_from_section
from .poses import PoseSequence
from .sample_times import TIME_TOLERANCE_S

if TYPE_CHECKING:
    from ..fem.body import Body


# Smallest singular value of a constrained rigid motion, relative to the largest: less is rounding.
SMALLEST_SINGULAR_VALUE = 1e-6
Axes = Literal["x", "y", "z", "xy", "xz", "yz", "xyz"]


def unconverted_poses(poses: PoseSequence | ArrayLike) -> Any:
    """Return poses unchanged, and matrices (T, 4, 4) as an array: they are converted when their
    times are known.
    """
    if isinstance(poses, PoseSequence):
        return poses
    return float_array(poses, "poses of a grasp", (None, 4, 4), finite=False)


@declaration
class Grasp:
    """Nodes held by the robot, and the rigid motion that carries them.

    Node numbers are stored sorted and without repeats. An experiment replaces a selection by the
    nodes of its body, and matrices by poses at its times.

    Parameters
    ----------
    nodes : (h,) int array or Selection
        Selection: a table of box_m, ball_m, face or indices, or the name of a point array or
        physical group.
    poses : PoseSequence or (T, 4, 4) array
        Rigid motion that carries the nodes.
    from_s : float
        First time [s] at which the grasp or obstacle acts; the start of the recording by default.
    until_s : float
        Last time [s] at which the grasp or obstacle acts; the end of the recording by default. If a
        grasp ends at the first sample, the body is released from its equilibrium in this grasp.
    sigma_m : float, optional
        Standard deviation of the noise in each position of the poses [m]; by default it is
        estimated from the roughness of the poses. With `displacements`, it is required, and the
        budget contains an error of this size in addition, see `measured_face`.
    sigma_rad : float, optional
        Standard deviation of the noise in each rotation, about each axis [rad]; by default it is
        estimated from the roughness of the poses.
    selection : Selection, optional
        The selection that the nodes come from; None for node indices. On a finer mesh it is
        evaluated again.
    axes : str
        Axes of the world along which the nodes are held; along the other axes they slide freely.
    zero : str
        Axes along which the zero of the poses is uncertain, as that of a test bench's crosshead,
        with the standard deviation in the experiment's `nuisance`; none by default.
    wrench : Wrench, optional
        Measured force and torque that it exerts on the body.
    displacement_scale : float
        Share of the displacement of a test bench that the poses contain, such as 0.5 if half the
        height of the specimen is modelled; the deformation of the bench counts by this share.
    """

    nodes: Index = key(Nodes, converter=node_converter("the grasp"), read=selection_from_section)
    poses: PoseSequence = key(converter=unconverted_poses)
    from_s: float = key(Finite | None, default=-np.inf)
    until_s: float = key(Finite | None, default=np.inf)
    sigma_m: float | None = key(NotNegative | None, default=None)
    sigma_rad: float | None = key(NotNegative | None, default=None)
    selection: Selection | None = None
    axes: Axes = key(Axes, default="xyz")
    zero: str = ""
    wrench: Wrench | None = None
    displacement_scale: float = 1.0

    def __post_init__(self) -> None:
        self._check_times_and_axes()

    def _check_times_and_axes(self) -> None:
        """In place: `zero` loses axes that are not held; selected nodes are `selection`, too."""
        if not self.from_s <= self.until_s:
            raise InputError(
                f"a grasp holds from {self.from_s:g} s until {self.until_s:g} s; expected "
                "from_s <= until_s"
            )
        if self.zero not in ("", *get_args(Axes)):
            expected = ", ".join(get_args(Axes))
            raise InputError(f"zero of a grasp is {self.zero!r}; expected one of {expected}")
        vars(self)["zero"] = "".join(axis for axis in self.zero if axis in self.axes)
        if isinstance(self.nodes, Selection):
            vars(self)["selection"] = self.nodes

    def on_body(self, body: Body, t_s: Array) -> Grasp:
        """Return the grasp with the selected nodes of a body, and matrices as poses at `t_s` (T,);
        self if nothing changes.

        Raises
        ------
        InputError
            If the selection has no nodes on this body, matrices are no rigid motions, or a node is
            far from the places whose displacements were measured.
        """
        placed = self._with_nodes(select_on_body(self.nodes, body), t_s)
        if (measured := placed.poses.deformation) is not None:
            edges_m = np.diff(body.nodes_m[body.cells][:, [0, 1, 2, 3, 0]], axis=1)
            edge_m = float(np.linalg.norm(edges_m, axis=2).max())
            measured.require_near(body.nodes_m[placed.nodes], edge_m)
        return placed

    def _with_nodes(self, nodes: Index, t_s: Array) -> Self:
        """Poses that are matrices (T, 4, 4) become a `PoseSequence` at the times `t_s` (T,)."""
        poses = self.poses
        if not isinstance(poses, PoseSequence):
            poses = PoseSequence.from_matrices(t_s, poses)
        placed = nodes is self.nodes and poses is self.poses
        return self if placed else replace(self, nodes=nodes, poses=poses)

    @cached_property
    def axis_indices(self) -> Index:
        """(a,) indices of the prescribed axes: 0, 1, 2 for x, y, z."""
        return np.array(["xyz".index(axis) for axis in self.axes])

    @cached_property
    def prescribed_dofs(self) -> Index:
        """(h a,) dofs (3 · node + axis) with prescribed displacements, ascending."""
        return (3 * self.nodes[:, None] + self.axis_indices).ravel()

    def is_active(self, t_s: ArrayLike) -> NDArray[np.bool_]:
        """Return whether the nodes are held at the times `t_s` (T,), as (T,) bool: from `from_s` to
        `until_s`, both included within `TIME_TOLERANCE_S`.
        """
        times = np.asarray(t_s, dtype=np.float64)
        return (times >= self.from_s - TIME_TOLERANCE_S) & (
            times <= self.until_s + TIME_TOLERANCE_S
        )

    def positions_at(self, nodes_m: Array, t_s: ArrayLike) -> Array:
        """Return the positions (T, h, 3) [m] of the h grasped nodes at the times `t_s` (T,) if the
        poses carry them, along all axes and also while the grasp does not hold.

        Parameters
        ----------
        nodes_m : (n, 3) array
            All nodes of the undeformed body.
        t_s : (T,) array

        Raises
        ------
        InputError
            If the poses do not cover a time, see `PoseSequence.at`.
        """
        return self.poses.moved_positions(nodes_m[self.nodes], t_s)


def prescribed_nodes(grasps: Sequence[Grasp]) -> Index:
    """Return all nodes that are held at some time along some axis, sorted without repeats; errors
    as of `prescribed_dofs`.
    """
    return np.unique(prescribed_dofs(grasps) // 3)


def prescribed_dofs(grasps: Sequence[Grasp]) -> Index:
    """Return all dofs (3 · node + axis) that are held at some time, sorted without repeats; empty
    without grasps.

    Raises
    ------
    InputError
        If two grasps hold the same node along the same axis and their time windows share an
        instant.
    """
    for (i, first), (j, second) in combinations(enumerate(grasps, start=1), 2):
        shared = np.intersect1d(first.prescribed_dofs, second.prescribed_dofs)
        if shared.size and max(first.from_s, second.from_s) <= min(first.until_s, second.until_s):
            node, axis = divmod(int(shared[0]), 3)
            on_axis = "" if first.axes == second.axes == "xyz" else f" along {'xyz'[axis]}"
            raise InputError(
                f"node {node} is held by the grasps {i} and {j} at the same time{on_axis}; select "
                "the nodes so that each is held by one grasp, or the axes so that each axis of a node "
                'is (axes = "z" for both platens, if the body slides on them)'
            )
    return np.unique(
        np.concatenate([np.zeros(0, dtype=np.int64), *(g.prescribed_dofs for g in grasps)])
    )


# Free rigid motions -------------------------------------------------------------------------------


def free_rigid_motions(points_m: Array, is_prescribed: NDArray[np.bool_]) -> list[str]:
    """Return the rigid motions that these prescribed coordinates leave free, in words; empty if
    none, and one entry for all motions together if nothing is prescribed.

    Translations come first, then rotations, each along coordinate axes where possible.

    Parameters
    ----------
    points_m : (n, 3)
        Node positions.
    is_prescribed : (n, 3) bool
        Whether each coordinate is prescribed.
    """
    if not is_prescribed.any():
        return ["translate and rotate as a rigid body"]
    free, _ = free_rigid_modes(points_m, is_prescribed)
    if not len(free):
        return []
    # Free motions without rotation, and the axes of the free rotations.
    shifts = _null_space(free[:, 3:].T) @ free[:, :3]
    rotations = free[:, 3:]
    return [
        *(f"translate along {_direction_text(d)}" for d in _axis_aligned_basis(shifts)),
        *(f"rotate about {_direction_text(d)}" for d in _axis_aligned_basis(rotations)),
    ]


def free_rigid_modes(points_m: Array, is_prescribed: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the rigid motions that prescribed coordinates leave free, to first order.

    Parameters
    ----------
    points_m : (n, 3) array
        Node positions [m].
    is_prescribed : (n, 3) array of bool
        Whether each coordinate is prescribed; at least one is.

    Returns
    -------
    coordinates : (k, 6) array
        Orthonormal basis of the free motions: translations along the axes, then rotations about
        them, those over the distance of the farthest held node from the centre of the held nodes.
    displacements : (n, 3, k) array
        Displacements of all nodes in these motions.
    """
    held = is_prescribed.any(axis=1)
    arms_m = points_m - points_m[held].mean(axis=0)
    size_m = float(np.linalg.norm(arms_m[held], axis=1).max()) or 1.0
    rotations = np.stack([np.cross(axis, arms_m / size_m) for axis in np.eye(3)], axis=2)
    translations = np.broadcast_to(np.eye(3), rotations.shape)
    modes = np.concatenate([translations, rotations], axis=2).astype(float)
    # The triangular factor has the same singular values and at most six rows.
    factor = np.linalg.qr(modes[is_prescribed], mode="r")
    _, values, directions = np.linalg.svd(factor)
    rank = int((values > SMALLEST_SINGULAR_VALUE * values[0]).sum())
    free = directions[rank:]
    return free, modes @ free.T


def _null_space(matrix: Array) -> Array:
    """Return an orthonormal basis (k, n) for a matrix (m, n) with entries of the order of one."""
    _, values, directions = np.linalg.svd(matrix)
    return directions[int((values > SMALLEST_SINGULAR_VALUE).sum()) :]


def _axis_aligned_basis(vectors: Array) -> Iterator[Array]:
    """Yield an orthonormal basis of the span of vectors, along axes where possible."""
    _, values, directions = np.linalg.svd(vectors.reshape(-1, 3), full_matrices=False)
    space = directions[values > SMALLEST_SINGULAR_VALUE]
    while len(space):
        projected = space.T @ space
        best = int(np.argmax(np.diag(projected).round(9)))
        direction = projected[best] / np.linalg.norm(projected[best])
        yield direction
        space = _null_space(np.vstack([direction, _null_space(space)]))


def _direction_text(direction: Array) -> str:
    axis = int(np.abs(direction).argmax())
    if abs(direction[axis]) > 1 - 1e-6:
        return "xyz"[axis]
    return f"({', '.join(f'{x:.3g}' for x in direction)})"
