"""Tracked markers: their measured positions, and their prediction from node positions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..common.array_types import Array, Index
from ..common.checked_arrays import (
    as_array,
    as_array_or_none,
    float_array,
    float_converter,
    read_only_coordinates,
    read_only_floats,
)
from ..common.declarations import Key, declaration, identity_or_none, key
from ..common.time_dependence import over_time
from ..common.validated_classes import validated
from ..common.validated_types import Positive
from ..errors import InputError
from .measurement import Measurement, checked_ratios, root_mean, split_sigma
from .placement import AttachmentRule, LocatedBody, Placement, place_markers

if TYPE_CHECKING:
    from ..fem.body import Body

__all__ = ["Markers", "Placement", "place_markers"]

# Largest number of marker names in the text of an object; others are replaced by an ellipsis.
MOST_NAMES_SHOWN = 4

UndeformedPlaces = Callable[[Array, Array], Array]


Places = Literal["free", "surface"]
_PLACES = Key("places", Places, read=lambda word: word == "surface")

# Smallest standard deviation of a measured position [m]: a misspelt exponent is smaller.
SMALLEST_SIGMA_M = 1e-12


@declaration
class Markers(Measurement):
    """Marker tracks and the markers' places on the body.

    Parameters
    ----------
    t_s : (T,) array
        Sample times.
    positions_m : (T, M, 3) array
        Measured positions; NaN where missing, which may be one coordinate of a sample.
    sigma_m : (M,) array, (T, M) array or float
        Standard deviation of each marker's coordinates, also of each sample. Those of samples are
        stored as the median of each marker, and as ratios to it, `sigma_ratios`.
    names : sequence of str, optional
        M distinct names; m1, m2, … by default.
    places_m : (M, 3) array, optional
        Places of the markers on the undeformed body, from which the experiment makes the placement.
        NaN where a place is not known: the estimate then starts from the first sample, with a prior
        as wide as the body. The same holds for all markers without places and placement.
    placement : Placement, optional
        Weights of the nodes, one row per marker, in place of `places_m`.
    places_sigma_m : (M,) array or float, optional
        Standard deviation of the given places, zero for exact ones; that of the experiment's
        nuisance by default.
    on_surface : bool
        Whether estimated places stay on the surface: two coordinates in place of three.
    located : (M,) bool array, optional
        Whether a place is given; derived from `places_m` by default.
    attach : {"auto", "vertex", "embedded"}
        Nodes that carry a marker. "vertex": the nearest node. "embedded": the nodes of the
        tetrahedron that contains the marker or is nearest to it. "auto": the nearest node if it
        lies within 5 % of the mean edge length, otherwise "embedded".
    max_distance_m : float, optional
        Largest distance of a marker from the body; the mean edge length by default.
    offsets_s : (T,) array, optional
        Time at which each sample was measured less its time in `t_s` [s], for unevenly recorded
        frames; the body is predicted at the sum. None: zero.

    Raises
    ------
    InputError
        If shapes disagree, names repeat, a sigma is not positive, or both places and placement are
        given.
    """

    measurement_text: ClassVar[str] = "markers"
    other_text: ClassVar[str] = "markers"
    noise_key: ClassVar[str] = "sigma_m"
    sigma_text: ClassVar[str] = "sigma_m"
    precedence: ClassVar[int] = 0
    unit: ClassVar[str] = "m"
    title: ClassVar[str] = "the markers"
    instrument_text: ClassVar[str] = ""

    t_s: Array = key(converter=float_converter((None,), "t_s of the markers"), metadata=over_time())
    positions_m: Array = key(converter=as_array, metadata=over_time())
    sigma_m: Array = key(converter=as_array)
    names: tuple[str, ...] = key(converter=tuple[str, ...], default=None)
    places_m: Array | None = key(converter=as_array_or_none, default=None)
    placement: Placement = key(converter=identity_or_none, default=None)
    places_sigma_m: Array | None = key(converter=as_array_or_none, default=None)
    on_surface: bool = key(_PLACES, default=False)
    located: NDArray[np.bool_] = key(converter=np.asarray, default=None)
    attach: AttachmentRule = key(AttachmentRule, default="auto")
    max_distance_m: float | None = key(Positive | None, default=None)
    offsets_s: Array | None = key(converter=as_array_or_none, default=None, metadata=over_time())
    sigma_ratios: Array | None = key(converter=as_array_or_none, default=None, metadata=over_time())

    def __post_init__(self) -> None:
        shape = len(self.t_s), None, 3
        tracks = read_only_coordinates(self.positions_m, shape)
        m = tracks.shape[1]
        if self.names is None:
            vars(self)["names"] = tuple(f"m{k}" for k in range(1, m + 1))
        if len(self.names) != m:
            message = f"{len(self.names)} marker names for {m} tracks; expected one for each"
            raise InputError(message)
        if repeated := [name for name, count in Counter(self.names).items() if count > 1]:
            raise InputError(
                f"the marker name '{repeated[0]}' is given more than once; expected different names"
            )
        sigma_m = self.sigma_m
        if np.ndim(sigma_m) == 2:
            sigma_m = self._split_sigma(tracks)
        if self.sigma_ratios is not None:
            ratios = checked_ratios(self.sigma_ratios, (len(self.t_s), 3 * m), "the markers")
            vars(self)["sigma_ratios"] = ratios
        sigma_m = float_array(sigma_m, "sigma_m", ((), (m,)))
        sigma_m = read_only_floats(np.broadcast_to(sigma_m, m), (m,), name="sigma_m")
        for name, sigma in zip(self.names, sigma_m, strict=True):
            if not sigma >= SMALLEST_SIGMA_M:
                raise InputError(
                    f"sigma_m of marker '{name}' is {sigma:g} m; expected > 0, and at least "
                    f"{SMALLEST_SIGMA_M:g} m"
                )
        vars(self).update(positions_m=tracks, sigma_m=sigma_m)
        if self.offsets_s is not None:
            offsets_s = read_only_floats(self.offsets_s, (len(self.t_s),), name="offsets_s")
            vars(self)["offsets_s"] = offsets_s
        self._check_places(m)

    def _split_sigma(self, tracks: Array) -> Array:
        """Return the median σ (M,) [m] of each marker, and store the ratios to it, in place."""
        t, m, _ = tracks.shape
        given = float_array(self.sigma_m, "sigma_m", (t, m), finite=False)
        is_seen: NDArray[np.bool_] = np.asarray(np.isfinite(tracks).any(axis=2))
        sigma_m, ratios = np.ones(m), np.ones((t, m))
        for k, name in enumerate(self.names):
            seen = is_seen[:, k : k + 1]
            what = f"sigma_m of marker '{name}'"
            sigma_m[k], ratios[:, k : k + 1] = split_sigma(given[:, k], seen, what)
        vars(self)["sigma_ratios"] = np.repeat(ratios, 3, axis=1)
        return sigma_m

    def _check_places(self, m: int) -> None:
        """Store `places_m` (m, 3), NaN if unknown, `located` and `places_sigma_m` (m,)."""
        places_m = self.places_m
        placement = self.placement
        known = self.located
        if places_m is not None and placement is not None:
            raise InputError(
                "the markers have places_m and a placement; expected one of them, or neither if "
                "the positions are to be estimated"
            )
        if placement is not None and len(placement.nodes) != m:
            raise InputError(
                f"placement has {len(placement.nodes)} positions on the body for {m} markers; expected "
                "one for each marker"
            )
        if placement is None:
            places_m = np.full((m, 3), np.nan) if places_m is None else places_m
            places_m = read_only_floats(places_m, (m, 3), name="places_m", finite=False)
            known = np.isfinite(places_m).all(axis=1)
        known = np.ones(m, bool) if known is None else known
        if known.shape != (m,) or known.dtype != bool:
            raise InputError(f"located has the shape {known.shape}; expected ({m}) truth values")
        vars(self).update(places_m=places_m, located=known)
        if self.places_sigma_m is not None:
            each = self.places_sigma_m
            each = np.broadcast_to(each, m) if each.ndim == 0 else each
            sigma_m = read_only_floats(each, (m,), name="places_sigma_m", finite=False)
            if (sigma_m < 0).any() or np.isinf(sigma_m).any():
                raise InputError("places_sigma_m has negative or infinite values; expected none")
            vars(self)["places_sigma_m"] = sigma_m

    def __repr__(self) -> str:
        if not self.names:
            return "no markers"
        shown = (
            self.names
            if len(self.names) <= MOST_NAMES_SHOWN
            else (*self.names[:MOST_NAMES_SHOWN], "…")
        )
        missing = int(self.missing_count.sum())
        gaps = f", {missing} missing" if missing else ""
        return f"Markers({', '.join(shown)}: {self.sample_count} samples{gaps})"

    def place_dimension(self, body: Body) -> int:
        """Return the number of coordinates of an estimated place: 3 in a solid, less 1 on its surface;
        those of the kind of another body.
        """
        return body.kind.place_dimension - (self.on_surface and body.is_solid)

    def on_body(self, body: Body, undeformed_places: UndeformedPlaces | None = None) -> Markers:
        """Return the markers with their placement on a body, without `places_m`; self if they have
        a placement already.

        A marker without a place is put on the point of the body nearest to its first present
        sample.

        Parameters
        ----------
        undeformed_places : callable, optional
            Maps points (M, 3) at times (M,) to their places on the undeformed body if a grasp
            carried it rigidly. Estimates of unknown places start there; without it, at the first
            sample.

        Raises
        ------
        InputError
            If a marker is too far from the body, or was never seen and has no place.
        """
        if self.places_m is None:
            return self
        known = self.located
        places = self.places_m.copy()
        if not known.all():
            points_m, times_s = self.first_samples
            back = points_m if undeformed_places is None else undeformed_places(points_m, times_s)
            for m in np.flatnonzero(~known).tolist():
                if not self.is_complete[:, m].any():
                    raise InputError(
                        f"marker '{self.names[m]}' is never visible with all three coordinates and "
                        "has no position on the body; give its reference_m, or remove it"
                    )
            located_body = LocatedBody(body.nodes_m, body)
            places[~known] = located_body.places_of_points(back[~known])
        nodes_m = body.nodes.points_m
        placement = place_markers(
            places,
            nodes_m,
            body=body,
            attach=self.attach,
            max_distance_m=self.max_distance_m,
            names=self.names,
        )
        return replace(self, places_m=None, placement=placement)

    def with_samples(self, t_s: ArrayLike, values: ArrayLike) -> Markers:
        """Return the markers with other tracks [m], (T, M, 3) or (T, 3M), measured at exactly the
        times `t_s` (T,) [s].
        """
        positions_m = np.reshape(values, (len(np.atleast_1d(t_s)), len(self.names), 3))
        ratios = self._ratios_for(t_s)
        return replace(self, t_s=t_s, positions_m=positions_m, offsets_s=None, sigma_ratios=ratios)

    def without_later_values(self, end_s: float) -> Markers:
        is_later = (self.t_s > end_s)[:, None, None]
        return replace(self, positions_m=np.where(is_later, np.nan, self.positions_m))

    @classmethod
    @validated
    def none(cls, t_s: ArrayLike) -> Markers:
        """Return an empty set of markers at the times `t_s` (T,), for an experiment without
        markers.
        """
        return cls(t_s, np.zeros((len(np.atleast_1d(t_s)), 0, 3)), sigma_m=1.0)

    @property
    def sample_times_s(self) -> Array:
        return self.t_s

    @property
    def measured_values(self) -> Array:
        """(T, 3M) measured coordinates [m], NaN where missing."""
        return self.positions_m.reshape(len(self.t_s), -1)

    @property
    def value_sigmas(self) -> Array:
        return np.repeat(self.sigma_m, 3)

    @property
    def identity(self) -> frozenset[str]:
        return frozenset(self.names)

    def series(self) -> Iterator[tuple[str, Array]]:
        for k, name in enumerate(self.names):
            yield f"marker {name}", np.ascontiguousarray(self.positions_m[:, k])

    def values_of(self, other: Markers) -> Array:
        order = [other.names.index(name) for name in self.names]
        return other.positions_m[:, order].reshape(len(other.t_s), -1)

    def vectors(self, values: Array) -> Array:
        return values.reshape(len(values), -1, 3)

    def rms_text(self, difference: Array) -> str:
        known = self.distances_m(difference)
        return f"{1e3 * root_mean(known**2):.3g} mm RMS" if known.size else ""

    def distances_m(self, difference: Array) -> Array:
        """Return the lengths (P,) [m] of those of differences (T, 3M) [m] that have a finite
        coordinate, along the finite ones.
        """
        vectors_m = self.vectors(difference)
        known_m = vectors_m[np.isfinite(vectors_m).any(axis=2)]
        return np.sqrt(np.nansum(known_m**2, axis=1))

    @property
    def number_names(self) -> list[str]:
        return [f"{name} {axis}" for name in self.names for axis in "xyz"]

    @property
    def first_visible_sample(self) -> int:
        """Index, from 0, of the first sample in which a marker is present; 0 if none is."""
        return int(self.is_present.any(axis=1).argmax())

    @cached_property
    def first_samples(self) -> tuple[Array, Array]:
        """First complete sample (M, 3) of every marker [m], NaN if there is none, and its time (M,)
        [s], then that of the first sample.
        """
        rows = self.is_complete.argmax(axis=0)
        return self.positions_m[rows, np.arange(len(self.names))], self.t_s[rows]

    @cached_property
    def is_present(self) -> NDArray[np.bool_]:
        """(T, M) mask of samples with at least one coordinate."""
        return np.asarray(self.is_measured.any(axis=2))

    @cached_property
    def is_complete(self) -> NDArray[np.bool_]:
        """(T, M) mask of samples with all three coordinates."""
        return np.asarray(self.is_measured.all(axis=2))

    @cached_property
    def is_measured(self) -> NDArray[np.bool_]:
        """(T, M, 3) mask of measured coordinates."""
        return np.isfinite(self.positions_m)

    @property
    def missing_count(self) -> Index:
        """(M,) number of missing samples of each marker."""
        return (~self.is_present).sum(axis=0)

    @property
    def sample_count(self) -> int:
        """Number of present samples over all markers."""
        return int(self.is_present.sum())

    @cached_property
    def positions_at_samples_m(self) -> Array:
        """(T, M, 3) positions interpolated from the measured times to `t_s` [m], for descriptions
        of a motion; NaN where a coordinate is missing.

        A position is moved by the mean velocity to the samples before and after it, that to one of
        them if the other is missing, and stays if both are. Estimates use `positions_m` instead.
        """
        positions_m = np.where(self.is_complete[..., None], self.positions_m, np.nan)
        if self.offsets_s is None or len(self.t_s) < 2:
            return positions_m
        steps_s = np.diff(self.t_s + self.offsets_s)[:, None, None]
        velocities_m_s = np.diff(positions_m, axis=0) / steps_s
        unknown = np.full_like(velocities_m_s[:1], np.nan)
        before = np.concatenate([unknown, velocities_m_s])
        after = np.concatenate([velocities_m_s, unknown])
        before = np.where(np.isnan(before), after, before)
        after = np.where(np.isnan(after), before, after)
        mean_m_s = np.nan_to_num((before + after) / 2)
        return positions_m - self.offsets_s[:, None, None] * mean_m_s

    def squared_distances_m2(self, positions_m: ArrayLike) -> Array:
        """Return the squared distances (T, M) [m²] of positions (T, M, 3) [m] from the measured
        ones, along the measured coordinates; zero where nothing is measured.
        """
        squares = (np.asarray(positions_m) - self.positions_m) ** 2
        return np.sum(np.where(self.is_measured, squares, 0.0), axis=2)

    def predict_positions(self, node_positions_m: ArrayLike) -> Array:
        """Return predicted marker positions (..., M, 3) from node positions (..., n, 3), by the
        weights of `placement`, which must be set.
        """
        nodes_m = np.asarray(node_positions_m, dtype=np.float64)
        element_nodes_m = nodes_m[..., self.placement.nodes, :]
        return np.einsum("mk,...mkd->...md", self.placement.weights, element_nodes_m)
