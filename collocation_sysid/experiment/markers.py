"""Tracked points on the body: what was measured, and how it follows from the node positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from ..arrays import Array, Index
from ..errors import InputError
from .arrays import read_only_floats, read_only_tracks
from .placement import Placement, place_markers

if TYPE_CHECKING:
    from ..fem.body import Body

__all__ = ["Markers", "Placement", "place_markers"]

SHOWN = 4


@dataclass(frozen=True, eq=False)
class Markers:
    """Marker tracks and the markers' places on the body.

    Parameters
    ----------
    t_s : (T,) array
        Sample times.
    positions_m : (T, M, 3) array
        Measured positions; NaN where missing. A sample with one coordinate missing is missing.
    sigma_m : (M,) array or float
        Standard deviation of each marker's coordinates.
    names : sequence of str, optional
        M distinct names; m1, m2, … by default.
    places_m : (M, 3) array, optional
        Where the markers sit on the undeformed body; the experiment makes the placement of it.
    placement : Placement, optional
        Weights of the nodes, one row per marker, in place of `places_m`.

    Raises
    ------
    InputError
        If shapes disagree, names repeat, a sigma is not positive, or not exactly one of places
        and placement is given.
    """

    t_s: Array
    positions_m: Array
    sigma_m: Array
    names: tuple[str, ...]
    places_m: Array | None
    placement: Placement

    def __init__(
        self,
        t_s: ArrayLike,
        positions_m: ArrayLike,
        sigma_m: ArrayLike,
        names: Sequence[str] | None = None,
        places_m: ArrayLike | None = None,
        placement: Placement | None = None,
    ) -> None:
        times = read_only_floats(t_s, (None,), "t_s of the markers")
        tracks = read_only_tracks(positions_m, (len(times), None, 3), "marker positions")
        m = tracks.shape[1]
        if (places_m is None) == (placement is None):
            found = "neither places_m nor" if placement is None else "places_m and"
            raise InputError(
                f"the markers have {found} a placement; expected places_m, where they sit on the "
                "undeformed body in metres, or a placement that place_markers made"
            )
        if places_m is not None:
            places_m = read_only_floats(places_m, (m, 3), "places_m", finite=False)
        elif placement is not None and len(placement.nodes) != m:
            raise InputError(f"{len(placement.nodes)} places on the body for {m} markers")
        labels = tuple(f"m{k}" for k in range(1, m + 1)) if names is None else tuple(names)
        vars(self).update(
            t_s=times,
            positions_m=tracks,
            sigma_m=_deviations(sigma_m, _distinct(labels, m)),
            names=labels,
            places_m=places_m,
            placement=placement,
        )

    def __repr__(self) -> str:
        shown = self.names if len(self.names) <= SHOWN else (*self.names[:SHOWN], "…")
        missing = int(self.missing.sum())
        gaps = f", {missing} missing" if missing else ""
        return f"Markers({', '.join(shown)}: {self.samples} samples{gaps})"

    def on(self, body: Body) -> Markers:
        """The same markers with their placement on a body."""
        if self.places_m is None:
            return self
        placement = place_markers(self.places_m, body.nodes_m, body, names=self.names)
        return replace(self, places_m=None, placement=placement)

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


def _distinct(names: tuple[str, ...], count: int) -> tuple[str, ...]:
    if len(names) != count:
        raise InputError(f"{len(names)} marker names for {count} tracks; expected one for each")
    repeated = [name for name in names if names.count(name) > 1]
    if repeated:
        raise InputError(f"the marker name '{repeated[0]}' is given more than once")
    return names


def _deviations(sigma_m: ArrayLike, names: tuple[str, ...]) -> Array:
    each = np.broadcast_to(sigma_m, len(names)) if np.ndim(sigma_m) == 0 else sigma_m
    sigma = read_only_floats(each, (len(names),), "sigma_m")
    if not (sigma > 0.0).all():
        worst = int(np.argmin(sigma))
        raise InputError(f"sigma_m of marker '{names[worst]}' is {sigma[worst]:g}; expected > 0")
    return sigma
