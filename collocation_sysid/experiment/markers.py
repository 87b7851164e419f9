"""Tracked points on the body: what was measured, and how it follows from the node positions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from ..arrays import Array, Index
from ..errors import InputError
from .arrays import read_only_floats, read_only_tracks
from .placement import Placement, place_markers

__all__ = ["Markers", "Placement", "place_markers"]


@dataclass(frozen=True, eq=False)
class Markers:
    """Marker tracks and the markers' places on the body.

    Parameters
    ----------
    names : tuple of str
        M distinct names.
    t_s : (T,) array
        Sample times.
    positions_m : (T, M, 3) array
        Measured positions; NaN where missing. A sample with one coordinate missing is missing.
    sigma_m : (M,) array or float
        Standard deviation of each marker's coordinates.
    placement : Placement
        Weights of the nodes, one row per marker.

    Raises
    ------
    InputError
        If shapes disagree, names repeat or a sigma is not positive.
    """

    names: tuple[str, ...]
    t_s: Array
    positions_m: Array
    sigma_m: Array
    placement: Placement

    def __post_init__(self) -> None:
        names = tuple(self.names)
        m = len(names)
        if len(set(names)) != m:
            repeated = next(name for name in names if names.count(name) > 1)
            raise InputError(f"the marker name '{repeated}' is given more than once")
        t_s = read_only_floats(self.t_s, (None,), "t_s of the markers")
        shape = (len(t_s), m, 3)
        positions = read_only_tracks(self.positions_m, shape, "marker positions")
        sigma = read_only_floats(
            np.broadcast_to(self.sigma_m, (m,)) if np.ndim(self.sigma_m) == 0 else self.sigma_m,
            (m,),
            "sigma_m",
        )
        if not (sigma > 0.0).all():
            worst = int(np.argmin(sigma))
            raise InputError(
                f"sigma_m of marker '{names[worst]}' is {sigma[worst]:g}; expected > 0"
            )
        if len(self.placement.nodes) != m:
            raise InputError(f"{len(self.placement.nodes)} places on the body for {m} markers")
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "t_s", t_s)
        object.__setattr__(self, "positions_m", positions)
        object.__setattr__(self, "sigma_m", sigma)

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """(T, M) mask of samples with all three coordinates."""
        return np.asarray(np.isfinite(self.positions_m[:, :, 0]))

    @property
    def missing(self) -> Index:
        """(M,) number of missing samples of each marker."""
        return (~self.present).sum(axis=0)

    @property
    def samples(self) -> int:
        """Number of present samples over all markers."""
        return int(self.present.sum())

    def observe(self, node_positions_m: ArrayLike) -> Array:
        """Return marker positions (..., M, 3) for node positions (..., n, 3)."""
        nodes_m = np.asarray(node_positions_m, dtype=np.float64)
        around = nodes_m[..., self.placement.nodes, :]
        return np.einsum("mk,...mkd->...md", self.placement.weights, around)

    @cached_property
    def operator(self) -> sparse.csr_array:
        """`observe` at one timestep as a (3M, 3n) matrix.

        Row 3 m + axis is a coordinate of marker m, column 3 node + axis one of a node.
        """
        m, npe = self.placement.nodes.shape
        marker = np.repeat(np.arange(m), npe)
        per_node = sparse.csr_array(
            (self.placement.weights.ravel(), (marker, self.placement.nodes.ravel())),
            shape=(m, self.placement.node_count),
        )
        per_node.eliminate_zeros()
        return sparse.csr_array(sparse.kron(per_node, sparse.eye_array(3), format="csr"))
