"""Marker tracks from files of any known format, through one function."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from ..common.array_types import Array
from ..common.checked_arrays import float_converter, read_only_coordinates
from ..common.declarations import declaration, key
from ..common.time_dependence import over_time
from ..errors import InputError, hint_at, listed
from .sample_times import first_unordered_time
from .sources import c3d, motive, plain_csv, qualisys, trc, vicon
from .sources.raw_tracks import LabelChooser, RawTracks
from .sources.source import as_table, open_source
from .sources.text import decode, names_file_in_errors
from .sources.units import METRES_PER_UNIT, require_length_unit

# A frame rate and a column of times agree within this part.
_RATE_TOLERANCE = 0.01
# Labels of points that no marker of the motion-capture system's model was assigned to: "*12" of
# Vicon, "Unlabeled 7" of Motive, or none, behind the name of a subject.
_UNLABELLED = re.compile(r"(.*:)?(\*\d*|unlabell?ed.*)|", re.IGNORECASE)
# What the first line begins with.
_TEXT_FORMATS = {
    trc.BEGINNING: trc.read,
    qualisys.BEGINNING: qualisys.read,
    motive.BEGINNING: motive.read,
    **{f"{block}\n": vicon.read for block in vicon.BLOCKS},
}


@declaration
class MarkerTable:
    """Marker tracks as measured, before they are tied to a body.

    Parameters
    ----------
    t_s : (T,) array
        Sample times, strictly increasing.
    names : tuple of str
        M marker names.
    positions_m : (T, M, 3) array
        NaN where missing, which may be one coordinate of a sample.
    notes : tuple of str
        What was missing or assumed in the file, a sentence each.
    offsets_s : (T,) array, optional
        Time of each measured frame less `t_s` [s]; None if they are the same.
    sigma_m : (T, M) array, optional
        Standard deviation of each sample, NaN for markers without a column of them.
    """

    t_s: Array = key(converter=float_converter((None,), "t_s of the markers"), metadata=over_time())
    names: tuple[str, ...] = key(converter=tuple[str, ...])
    positions_m: Array = key(converter=np.asarray, metadata=over_time())
    notes: tuple[str, ...] = key(converter=tuple[str, ...], default=())
    offsets_s: Array | None = key(converter=np.asarray, default=None, metadata=over_time())
    sigma_m: Array | None = key(converter=np.asarray, default=None, metadata=over_time())

    def __post_init__(self) -> None:
        if fault := first_unordered_time(self.t_s):
            raise InputError(fault[1], where=f"row {fault[0] + 1}")
        shape = (len(self.t_s), len(self.names), 3)
        tracks = read_only_coordinates(self.positions_m, shape)
        vars(self)["positions_m"] = tracks


@names_file_in_errors
def read_markers(
    path: str | Path,
    *,
    names: Sequence[str] | None = None,
    labels: Mapping[str, str] | None = None,
    length_unit: str | None = None,
    rate_hz: float | None = None,
) -> MarkerTable:
    """Read marker tracks; the format is recognised by the file's content.

    Known are C3D (with the extra ``collocation-sysid[c3d]``), TRC, Qualisys TSV, Motive CSV, Vicon
    Nexus CSV, and plain CSV, wide (t_s, <name>_x, <name>_y, <name>_z …, in metres, and optionally
    <name>_sigma, the standard deviation of each sample) or long (t_s, marker, x_m, y_m, z_m).
    Without a column of times, frame 1 is at 0 s, or frame 0 if the file begins with it. A
    blank cell or NaN is a missing sample; in motion-capture formats, though not in plain CSV, so is
    one at exactly (0, 0, 0).

    Parameters
    ----------
    names : sequence of str, optional
        Markers to take, in this order; by default all, in the file's order, except unlabelled ones
        that are not in `labels`.
    labels : mapping of str to str, optional
        From labels in the file to names here; other markers keep their labels as names.
    length_unit : {"m", "cm", "mm", "in"}, optional
        Unit of the coordinates, where the file does not state it.
    rate_hz : float, optional
        Frame rate, where the file states neither it nor times.

    Raises
    ------
    InputError
        Naming the file and the line or key: where the file is damaged or contradicts itself or
        what is given here, a unit or rate is neither in the file nor given, or a marker is not
        there.
    """
    require_length_unit(length_unit)
    if rate_hz is not None and not 0 < rate_hz < np.inf:
        raise InputError(f"rate_hz is {rate_hz:g}; expected a rate above 0")
    labels = dict(labels or {})
    notes: list[str] = []
    raw = _read_tracks(path, _label_chooser(names, labels, notes))
    metres = METRES_PER_UNIT[_length_unit(raw, length_unit)]
    t_s = _times_s(raw, rate_hz)
    used_names = [labels.get(label, label) for label in raw.labels]
    coordinates, losses = _mark_missing(raw, used_names)
    return MarkerTable(
        t_s,
        tuple(used_names),
        positions_m=coordinates * metres,
        notes=(*raw.notes, *notes, *losses),
        sigma_m=None if raw.sigmas is None else raw.sigmas * metres,
    )


def _read_tracks(path: str | Path, choose: LabelChooser) -> RawTracks:
    source = open_source(path)
    if isinstance(source, bytes):
        if source[1:2] == b"\x50" and b"\0" in source[:512]:  # is no text
            return c3d.read(path, source, choose=choose)
        text = decode(source)
        start = text.lstrip().lstrip('"')
        first_cell = re.split("[,;\t\r\n]", start, maxsplit=1)[0] + "\n"
        for beginning, read in _TEXT_FORMATS.items():
            if start.startswith(beginning) or first_cell == beginning:
                return read(text, choose)
    return plain_csv.read(as_table(source), choose)


def _label_chooser(
    names: Sequence[str] | None, renamed: Mapping[str, str], notes: list[str]
) -> LabelChooser:
    """Unlabelled markers are picked only if renamed or requested; a note is added otherwise."""

    def choose(labels: Sequence[str]) -> list[int]:
        requested = {*renamed, *(names or ())}
        unlabelled = [
            label for label in labels if _UNLABELLED.fullmatch(label) and label not in requested
        ]
        places = [k for k, label in enumerate(labels) if label not in unlabelled]
        _require_distinct([labels[k] for k in places], "two markers are labelled")
        for label in renamed:
            _require_one_of(label, labels, what="label")
        known = [renamed.get(labels[k], labels[k]) for k in places]
        _require_distinct(known, "after renaming two markers are named")
        if names is None:
            if not labels:
                raise InputError("the file contains no markers; expected at least one")
            if not places:
                remedy = f"label them, or rename with labels: {', '.join(labels)}"
                raise InputError(f"all markers of the file are unlabelled; {remedy}")
            if unlabelled:
                notes.append(
                    "unlabelled markers are left out, unless names or labels state them: "
                    f"{len(unlabelled)}, such as {unlabelled[0]!r}"
                )
            return places
        if not names:
            raise InputError("no markers are requested; omit the names to use all markers")
        for name in names:
            _require_one_of(name, known, what="marker")
        _require_distinct(names, "requested more than once: marker")
        index_of = dict(zip(known, places, strict=True))
        return [index_of[name] for name in names]

    return choose


def _require_distinct(names: Sequence[str], message: str) -> None:
    for name, count in Counter(names).items():
        if count > 1:
            raise InputError(f"{message} '{name}'; expected names that differ")


def _require_one_of(name: str, known: Sequence[str], what: str) -> None:
    if name not in known:
        hint = hint_at(name, known)
        raise InputError(f"no {what} '{name}'; the file has {', '.join(known)}{hint}")


def _length_unit(raw: RawTracks, length_unit: str | None) -> str:
    """Return the unit by the user or the file, else the default of the format."""
    if length_unit and raw.unit and length_unit != raw.unit:
        raise InputError(
            f"length_unit is '{length_unit}', but {raw.unit_key} says '{raw.unit}'; expected the "
            "same, or no length_unit"
        )
    unit = length_unit or raw.unit or raw.default_unit
    if unit is None:
        raise InputError(
            f"no unit of length is stated by {raw.unit_key}; expected length_unit, one of "
            f"{', '.join(METRES_PER_UNIT)}"
        )
    return unit


def _times_s(raw: RawTracks, rate_hz: float | None) -> Array:
    """Return the times (T,) [s] of the file, else from the frame rate of user or file."""
    t_s = raw.t_s
    rates = {raw.rate_key: raw.rate_hz, "rate_hz": rate_hz}
    declared_rates = {key: rate for key, rate in rates.items() if rate}
    if t_s is not None:
        for key, rate in declared_rates.items():
            _require_rate(t_s, key, rate_hz=rate)
        return t_s
    if not declared_rates:
        raise InputError(
            f"neither {raw.rate_key} nor a column of times states when the frames were taken; "
            "expected rate_hz"
        )
    first, *others = declared_rates.values()
    if not all(math.isclose(first, other, rel_tol=1e-6) for other in others):
        raise InputError(
            f"rate_hz is {rate_hz:g}, but {raw.rate_key} says {first:g}; expected the same, or no "
            "rate_hz"
        )
    frames = np.arange(len(raw.coordinates)) if raw.frames is None else raw.frames
    return (frames - min(frames[0], 1)) / first


def _require_rate(t_s: Array, key: str, rate_hz: float) -> None:
    """Require that the mean or the median step agrees with the rate stated in `key`."""
    # Lost frames change the mean step, and coarsely printed times the median.
    if len(t_s) < 2:
        return
    steps = np.diff(t_s)
    mean_hz = 1 / steps.mean()
    median_hz = 1 / np.median(steps)
    if min(abs(mean_hz / rate_hz - 1), abs(median_hz / rate_hz - 1)) > _RATE_TOLERANCE:
        raise InputError(
            f"{key} is {rate_hz:g} Hz, but the times are {1 / mean_hz:.6g} s apart, "
            f"{mean_hz:.6g} Hz; expected the same rate: correct {key} or the times"
        )


def _mark_missing(raw: RawTracks, names: Iterable[str]) -> tuple[Array, list[str]]:
    """Return coordinates (T, M, 3) with NaN for missing ones, and a note on them."""
    x = raw.coordinates
    blank = np.asarray(np.isnan(x).all(axis=2))
    zero = np.asarray((np.nan_to_num(x) == 0.0).all(axis=2)) & ~blank & raw.zeros_are_missing
    incomplete = np.isnan(x).any(axis=2) & ~blank & ~zero
    markers_by_loss: dict[str, list[str]] = {}
    for k, name in enumerate(names):
        counts = {"blank": blank[:, k].sum(), "zeros": zero[:, k].sum()}
        losses_of_marker = []
        if missing := sum(counts.values()):
            kinds = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)
            losses_of_marker.append(f"{missing} of {len(x)} samples missing ({kinds})")
        if partial := int(incomplete[:, k].sum()):
            losses_of_marker.append(f"{partial} of {len(x)} samples without all three coordinates")
        if losses_of_marker:
            markers_by_loss.setdefault(", ".join(losses_of_marker), []).append(name)
    losses = [
        f"{listed(markers)}: {'each ' * (len(markers) > 1)}{loss}"
        for loss, markers in markers_by_loss.items()
    ]
    notes = ["; ".join(losses)] if losses else []
    return np.where(zero[:, :, None], np.nan, x), notes
