"""Node selections: which nodes of a mesh or body are grasped, loaded or observed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError

if TYPE_CHECKING:
    from .nodes import Nodes

# Of the body's diagonal: a node meant to lie on a box's face must not fall out by round-off.
ROUND_OFF = 1e-9


@dataclass(frozen=True)
class Box:
    """The nodes in an axis-aligned box, faces included; bounds may be infinite.

    Parameters
    ----------
    low_m, high_m : three numbers
        Lowest and highest coordinates in metres.
    """

    low_m: Sequence[float]
    high_m: Sequence[float]

    def __post_init__(self) -> None:
        low, high = _triple(self.low_m, "box: low_m"), _triple(self.high_m, "box: high_m")
        for axis, below, above in zip("xyz", low, high, strict=True):
            if below > above:
                raise InputError(
                    f"box: its low corner has {axis} = {below:g} m, above {above:g} m of its high "
                    "corner; give the lowest coordinates first, then the highest"
                )
        object.__setattr__(self, "low_m", low)
        object.__setattr__(self, "high_m", high)

    def resolve(self, nodes: Nodes) -> np.ndarray:
        """Return the selected nodes as sorted int64 indices into `nodes.points_m`."""
        slack = _round_off_m(nodes)
        above = nodes.points_m >= np.subtract(self.low_m, slack)
        below = nodes.points_m <= np.add(self.high_m, slack)
        low, high = (", ".join(f"{x:g}" for x in corner) for corner in (self.low_m, self.high_m))
        return _chosen(np.all(above & below, axis=1), nodes, f"the box from ({low}) to ({high}) m")


@dataclass(frozen=True)
class Ball:
    """The nodes at most `radius_m` away from `center_m`, both in metres."""

    center_m: Sequence[float]
    radius_m: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "center_m", _triple(self.center_m, "ball: center_m"))
        if not _is_number(self.radius_m) or not self.radius_m > 0:
            raise InputError(f"ball: radius_m must be a positive number, not {self.radius_m!r}")

    def resolve(self, nodes: Nodes) -> np.ndarray:
        """Return the selected nodes as sorted int64 indices into `nodes.points_m`."""
        distance = np.linalg.norm(nodes.points_m - np.array(self.center_m), axis=1)
        center = ", ".join(f"{x:g}" for x in self.center_m)
        what = f"the ball of radius {self.radius_m:g} m about ({center}) m"
        nearest = f"; the nearest node is {distance.min():.4g} m from its centre"
        return _chosen(distance <= self.radius_m + _round_off_m(nodes), nodes, what, nearest)


@dataclass(frozen=True)
class Indices:
    """Nodes by number, counted from 0, as the mesh file (or the given array) numbers them.

    These differ from the rows of `mesh.points_m` where nodes were dropped. Only corners can be
    given: a node on an edge is selected when both of the edge's ends are.
    """

    indices: Sequence[int]

    def __post_init__(self) -> None:
        given = np.atleast_1d(np.asarray(self.indices))
        if given.ndim != 1 or (given.size and given.dtype.kind not in "iu"):
            raise InputError(f"indices must be a list of whole node numbers, not {self.indices!r}")
        object.__setattr__(self, "indices", tuple(given.tolist()))

    def resolve(self, nodes: Nodes) -> np.ndarray:
        """Return the selected nodes as sorted int64 indices into `nodes.points_m`."""
        mesh = nodes.mesh
        wanted = np.unique(np.array(self.indices, dtype=np.int64))
        outside = wanted[(wanted < 0) | (wanted >= mesh.file_node_count)]
        if len(outside):
            raise InputError(
                f"indices: node {outside[0]} does not exist; the mesh has "
                f"{mesh.file_node_count} nodes, numbered 0 to {mesh.file_node_count - 1}"
            )
        dropped = np.setdiff1d(wanted, mesh.file_index)
        if len(dropped):
            raise InputError(
                f"indices: node {dropped[0]} was dropped from the mesh because it is no element's "
                "corner; leave it out (a node on an edge is selected when both of its ends are)"
            )
        chosen = nodes.with_mid_nodes(np.isin(mesh.file_index, wanted))
        return _chosen(chosen, nodes, "an empty list of indices")


@dataclass(frozen=True)
class Named:
    """The nodes where a point array of the mesh, of booleans or of zeros and ones, is true.

    A node on an edge is selected when both of the edge's ends are.
    """

    name: str

    def resolve(self, nodes: Nodes) -> np.ndarray:
        """Return the selected nodes as sorted int64 indices into `nodes.points_m`."""
        mesh = nodes.mesh
        if self.name not in mesh.point_arrays:
            names = ", ".join(f'"{name}"' for name in mesh.point_arrays)
            available = f"it has {names}" if names else "it has none"
            raise InputError(f'the mesh has no point array "{self.name}"; {available}')
        values = mesh.point_arrays[self.name]
        if values.size != len(mesh.points_m):
            raise InputError(
                f'point array "{self.name}" has {values.size // len(mesh.points_m)} values per '
                "node; a selection needs one, 0 or 1"
            )
        values = values.ravel()
        odd = values[~np.isin(values, (0, 1))]
        if len(odd):
            raise InputError(
                f'point array "{self.name}" holds {odd[0]}; a selection needs only 0 and 1'
            )
        chosen = nodes.with_mid_nodes(values.astype(bool))
        return _chosen(chosen, nodes, f'point array "{self.name}"')


Selection = Box | Ball | Indices | Named


def _chosen(mask: np.ndarray, nodes: Nodes, what: str, nearest: str = "") -> np.ndarray:
    if not mask.any():
        span = zip("xyz", *nodes.mesh.bounds_m, strict=True)  # no mid node lies beyond
        body = ", ".join(f"{axis} from {low:.4g} to {high:.4g} m" for axis, low, high in span)
        raise InputError(
            f"{what} selects none of the {len(mask)} nodes{nearest}; the body spans {body}"
        )
    return np.flatnonzero(mask).astype(np.int64)


def _round_off_m(nodes: Nodes) -> float:
    return ROUND_OFF * float(np.linalg.norm(np.ptp(nodes.points_m, axis=0)))


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float, np.number)) and not isinstance(value, bool)


def _triple(values: Iterable[float], what: str) -> tuple[float, float, float]:
    given = list(values) if isinstance(values, Iterable) and not isinstance(values, str) else []
    if len(given) != 3 or not all(_is_number(x) and not np.isnan(x) for x in given):
        raise InputError(f"{what} must be three numbers [x, y, z] in metres, not {values!r}")
    x, y, z = (float(value) for value in given)
    return x, y, z
