"""Tracks of points in images from the files of trackers, recognised by their content.

| program | file | content |
|---|---|---|
| any | .csv, wide | `t_s` (`t_ms`, …) or `frame`; `NAME_u`, `NAME_v`, perhaps `NAME_likelihood`, `sigma_px` |
| any | .csv, long | `t_s` or `frame`, `point`, `u`, `v` and perhaps `likelihood` |
| SLEAP | analysis .csv | `track`, `frame_idx`; `NODE.x`, `NODE.y`, `NODE.score` of each node |
| DeepLabCut | .csv, .h5 | rows scorer, (individuals,) bodyparts, coords; frame, then x, y, likelihood |
| SLEAP | analysis .h5 | `tracks` (tracks, 2, nodes, frames), `node_names`, `point_scores` |
| SLEAP | .slp | `frames`, `instances`, `points`, `pred_points`, and names in `metadata` |
| CoTracker | .npz | `pred_tracks` (1, T, N, 2), `pred_visibility` (1, T, N) |
| TAPIR | .npz | `tracks` (N, T, 2), `visibles` (N, T) |

In tables, `x` and `y` are pixels, too, unless there is a `z`. Only tables with a column of times,
and archives with `t_s` or `fps`, state times.
"""

from __future__ import annotations

import io
import pickle
import re
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...common.array_files import load_arrays, require_plausible_size
from ...common.array_types import Array
from ...common.checked_arrays import float_array
from ...common.files import DAMAGE
from ...common.text_files import parse_json
from ...errors import InputError, listed
from ...recording.sources.columns import find_time
from ...recording.sources.source import open_source
from ...recording.sources.text import (
    Row,
    Table,
    decode,
    names_file_in_errors,
    numeric_cells,
    parse_table,
    separated_rows,
    table_of_rows,
    times_in_column,
)

# Names of the columns of long tables.
POINT_COLUMNS = ("point", "name", "bodypart", "track", "keypoint", "point_id", "track_id")
FRAME_COLUMNS = ("frame", "frame_index", "frame_idx")
# Other names of the coordinates in a table, and of the likelihood.
COORDINATES = {"x": "u", "y": "v"}
LIKELIHOODS = ("score", "confidence", "visibility", "visible")
# First bytes of an HDF5 file.
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
# Names of arrays in archives: tracks by time, tracks by point, visibility.
BY_TIME = ("pred_tracks",)
VISIBILITY = ("pred_visibility", "visibility", "pred_vis", "vis")
BY_POINT_VISIBILITY = ("visibles", "visible", "pred_occ", "occluded")
# Version of the labels of SLEAP from which the centre of the first pixel is (0, 0).
CENTRED_PIXELS = 1.1
POINTS = ("points", "pred_points")
EXPECTED = "a table with NAME_u and NAME_v, or a file of DeepLabCut, SLEAP, CoTracker or TAPIR"


@dataclass(frozen=True, eq=False)
class TrackFile:
    """Content of a file of tracks."""

    names: tuple[str, ...]  # names (N,) of the points
    pixels: Array  # (S, N, 2): pixels u and v; NaN where missing
    # (S, N) or None: confidence of the tracker, from 0 to 1; None if the file has none.
    likelihood: Array | None
    t_s: Array | None  # (S,) or None: times [s]; None if the file states none
    frames: Array  # (S,): numbers of the images
    sigma_px: float = 0.0  # standard error of a coordinate, in a wide table; 0 if unknown

    def confident(self, least: float) -> Array:
        """Return the pixels (S, N, 2), NaN where the likelihood is below `least`."""
        if self.likelihood is None:
            return self.pixels
        is_low = ~(self.likelihood >= least)
        return np.where(is_low[..., None], np.nan, self.pixels)


@names_file_in_errors
def read_tracks(path: str | Path) -> TrackFile:
    """Read the tracks of all points of a file.

    Raises
    ------
    InputError
        If the file is not recognised, or its content is inconsistent; file and key or line are
        named.
    """
    file = Path(path)
    source = open_source(file)
    if isinstance(source, Table):
        return _read_table(source)
    if source.startswith(HDF5_SIGNATURE):
        return _read_hdf5(file)
    if zipfile.is_zipfile(io.BytesIO(source)):
        return _read_archive(file)
    rows = separated_rows(text := decode(source))
    if rows[0].cells[0].lower() == "scorer":
        return _deeplabcut_table(rows)
    return _read_table(parse_table(text))


# Tables -------------------------------------------------------------------------------------------


def _read_table(grid: Table) -> TrackFile:
    grid = replace(grid, columns=_usual_columns(grid.columns))
    t_s, frames = _times_of(grid)
    ends = ("_u", "_v")
    wide = [*dict.fromkeys(name[:-2] for name in grid.columns if name.endswith(ends))]
    if wide:
        return _wide_table(grid, wide, t_s, frames)
    point = next((name for name in POINT_COLUMNS if name in grid.columns), None)
    if point is not None and {"u", "v"} <= set(grid.columns):
        return _long_table(grid, grid.columns.index(point), t_s, frames)
    shown = ", ".join(grid.columns[:8])
    raise grid.error_at(f"found the columns {shown}; expected {EXPECTED}")


def _usual_columns(columns: Sequence[str]) -> list[str]:
    usual = {name: "likelihood" for name in LIKELIHOODS}
    parts = [re.fullmatch(r"(?:(.+)[._])?([a-z]+)", name) for name in columns]
    if not any(part and part[2] == "z" for part in parts):
        usual |= COORDINATES
    names = []
    for name, part in zip(columns, parts, strict=True):
        other = usual.get(part[2]) if part else None
        names.append("_".join(filter(None, (part[1], other))) if part and other else name)
    # Where a table has both, the usual names count.
    return [old if new in columns else new for old, new in zip(columns, names, strict=True)]


def _times_of(grid: Table) -> tuple[Array | None, Array]:
    """Return the times of the rows, None without, and the numbers of their images."""
    frame = next((name for name in FRAME_COLUMNS if name in grid.columns), None)
    if frame is not None:
        column = grid.columns.index(frame)
        frames = np.asarray(numeric_cells(grid, [column], blank_allowed=False))[:, 0]
    else:
        frames = np.arange(float(len(grid.cells)))
    ends = ("_u", "_v", "_likelihood")
    time = find_time(grid, [k for k, name in enumerate(grid.columns) if name.endswith(ends)])
    if time is None:
        return None, frames
    if any(name in grid.columns for name in POINT_COLUMNS):
        column, factor = time
        return factor * numeric_cells(grid, [column], blank_allowed=False)[:, 0], frames
    return times_in_column(grid, *time), frames


def _numbers(grid: Table, names: Sequence[str]) -> Array:
    for name in names:
        if grid.columns.count(name) != 1:
            count = grid.columns.count(name)
            found = f"{count} columns are called" if count else "there is no column"
            raise grid.error_at(f"{found} {name!r}; expected one, as of the other points")
    columns = [grid.columns.index(name) for name in names]
    return np.asarray(numeric_cells(grid, columns, blank_allowed=True))


def _wide_table(grid: Table, names: list[str], t_s: Array | None, frames: Array) -> TrackFile:
    pixels = _numbers(grid, [f"{name}_{axis}" for name in names for axis in "uv"])
    scores = [f"{name}_likelihood" for name in names]
    likelihood = None
    if any(name in grid.columns for name in scores):
        likelihood = np.ones((len(pixels), len(names)))
        for k, name in enumerate(names):
            own = [each for each in grid.columns if each.rpartition("_")[0] == name]
            if len(own) > 2:  # a third column that is no likelihood is misspelt
                likelihood[:, k] = _numbers(grid, [scores[k]])[:, 0]
    pixels = pixels.reshape(len(pixels), -1, 2)
    if "track" not in grid.columns:
        sigma_px = float(_numbers(grid, ["sigma_px"]).max()) if "sigma_px" in grid.columns else 0.0
        return TrackFile(tuple(names), pixels, likelihood, t_s, frames, sigma_px)
    # A table of SLEAP has one row for each animal in an image.
    animals, numbers, pixels, likelihood = _by_label(
        grid, grid.columns.index("track"), "track {!r}", frames, pixels, likelihood
    )
    if len(animals) > 1:
        names = [f"{label or k + 1}_{name}" for k, label in enumerate(animals) for name in names]
    return TrackFile(tuple(names), pixels, likelihood, None, numbers)


def _long_table(grid: Table, point: int, t_s: Array | None, frames: Array) -> TrackFile:
    pixels = _numbers(grid, ["u", "v"])[:, None]
    likelihood = _numbers(grid, ["likelihood"]) if "likelihood" in grid.columns else None
    at = frames if t_s is None else t_s
    names, times, pixels, likelihood = _by_label(grid, point, "{}", at, pixels, likelihood)
    if t_s is None:
        return TrackFile(tuple(names), pixels, likelihood, None, times)
    return TrackFile(tuple(names), pixels, likelihood, times, np.arange(float(len(times))))


def _by_label(
    grid: Table, column: int, called: str, at: Array, pixels: Array, likelihood: Array | None
) -> tuple[list[str], Array, Array, Array | None]:
    """Return each label and time once, with pixels (S, N, 2) and likelihoods (S, N)."""
    of_row = [str(label) for label in grid.cells[:, column]]
    number = {label: k for k, label in enumerate(dict.fromkeys(of_row))}
    label = np.array([number[each] for each in of_row])
    times, sample = np.unique(at, return_inverse=True)
    _, first = np.unique(sample * len(number) + label, return_index=True)
    if len(first) < len(label):
        k = int(np.setdiff1d(np.arange(len(label)), first)[0])
        raise grid.error_at(
            f"{called.format(of_row[k])} appears twice in this image; expected once", k
        )
    placed = np.full((len(times), len(number), *pixels.shape[1:]), np.nan)
    placed[sample, label] = pixels
    flat = len(times), -1
    if likelihood is not None:
        scores = np.zeros(placed.shape[:-1])
        scores[sample, label] = likelihood
        likelihood = scores.reshape(flat)
    return list(number), times, placed.reshape(*flat, 2), likelihood


def _deeplabcut_table(rows: list[Row]) -> TrackFile:
    """Return the tracks of a table of DeepLabCut, whose names are in three or four header rows."""
    heads: dict[str, list[str]] = {}
    while rows and rows[0].cells[0].lower() in ("scorer", "individuals", "bodyparts", "coords"):
        row = rows.pop(0)
        heads[row.cells[0].lower()] = row.cells[1:]
    if not {"bodyparts", "coords"} <= heads.keys():
        raise InputError(
            f"found the header rows {listed(heads)}; expected those of DeepLabCut: scorer, "
            "bodyparts, coords"
        )
    individuals = heads.setdefault("individuals", [""] * len(heads["bodyparts"]))
    if len({len(heads[name]) for name in ("individuals", "bodyparts", "coords")}) > 1:
        raise InputError("the header rows have different lengths; expected one name in each column")
    columns = list(zip(individuals, heads["bodyparts"], heads["coords"], strict=True))
    grid = table_of_rows(["frame", *map(str, range(len(columns)))], rows)
    values = np.asarray(numeric_cells(grid, range(1, 1 + len(columns)), blank_allowed=True))
    try:
        frames = np.asarray(numeric_cells(grid, [0], blank_allowed=False))[:, 0]
    except InputError:  # names of the images of a folder
        frames = np.arange(float(len(rows)))
    return _by_columns(columns, values, frames)


def _by_columns(columns: Sequence[tuple[str, str, str]], values: Array, frames: Array) -> TrackFile:
    """Return tracks from values (S, c) with individual, body part and coordinate of each column."""
    several = len({individual for individual, _, _ in columns}) > 1
    labels = [f"{i}_{part}" if several else part for i, part, _ in columns]
    names = tuple(dict.fromkeys(labels))
    number = {name: k for k, name in enumerate(names)}
    parts = {"x": np.full((len(values), len(names)), np.nan)}
    parts["y"], parts["likelihood"] = parts["x"].copy(), np.ones_like(parts["x"])
    for k, (label, (_, _, coordinate)) in enumerate(zip(labels, columns, strict=True)):
        if coordinate not in parts:
            raise InputError(f"found the coordinate {coordinate!r}; expected x, y or likelihood")
        parts[coordinate][:, number[label]] = values[:, k]
    has_score = any(coordinate == "likelihood" for _, _, coordinate in columns)
    pixels = np.stack([parts["x"], parts["y"]], axis=2)
    return TrackFile(names, pixels, parts["likelihood"] if has_score else None, None, frames)


# Archives and HDF5 --------------------------------------------------------------------------------


def _read_archive(file: Path) -> TrackFile:
    try:
        arrays = load_arrays(file)
    except InputError:
        raise
    except (*DAMAGE, OSError) as error:
        raise InputError(f"this archive cannot be read ({error}); expected arrays") from error
    return tracks_of_arrays(arrays)


def tracks_of_arrays(arrays: Mapping[str, Any]) -> TrackFile:
    """Return the tracks of CoTracker or TAPIR from their arrays by name."""
    by_time = next((name for name in BY_TIME if name in arrays), None)
    key = by_time or ("tracks" if "tracks" in arrays else None)
    if key is None:
        raise InputError(f"found the arrays {listed(arrays)}; expected pred_tracks or tracks")
    tracks = float_array(arrays[key], key, finite=False)
    if tracks.ndim == 4 and len(tracks) == 1:
        tracks = tracks[0]
    if tracks.ndim != 3 or tracks.shape[2] != 2 or not tracks.size:
        raise InputError(
            f"{key} has the shape {tracks.shape}; expected (T, N, 2), (1, T, N, 2) or, for TAPIR, "
            "(N, T, 2)"
        )
    of_points = next((name for name in BY_POINT_VISIBILITY if name in arrays), None)
    if by_time is None and of_points is not None:
        tracks = tracks.transpose(1, 0, 2)
    likelihood = None
    name = of_points if by_time is None and of_points else None
    name = name or next((each for each in VISIBILITY if each in arrays), None)
    if name is not None:
        stated = np.asarray(arrays[name])
        is_truth = stated.dtype.kind == "b"
        seen = float_array(stated.astype(int) if is_truth else stated, name, finite=False)
        seen = seen[0] if seen.ndim == 3 and len(seen) == 1 else seen
        seen = seen[..., 0] if seen.ndim == 3 and seen.shape[2] == 1 else seen
        seen = seen.T if name == of_points else seen
        if seen.shape != tracks.shape[:2]:
            raise InputError(
                f"{name} has the shape {np.shape(arrays[name])}; expected one value for each of the "
                f"{tracks.shape[0]} images and {tracks.shape[1]} points"
            )
        likelihood = 1.0 - seen if "occ" in name else seen
    names = tuple(f"p{k + 1}" for k in range(tracks.shape[1]))
    if "names" in arrays:
        names = tuple(map(str, np.ravel(arrays["names"])))
    if len(names) != tracks.shape[1]:
        raise InputError(f"names has {len(names)} names for {tracks.shape[1]} points")
    frames = np.arange(float(len(tracks)))
    t_s = None
    if "t_s" in arrays:
        t_s = float_array(arrays["t_s"], "t_s", (len(tracks),))
    elif "fps" in arrays:
        rates = float_array(arrays["fps"], "fps").ravel()
        if len(rates) != 1 or not rates[0] > 0:
            raise InputError(f"fps is {rates.tolist()}; expected one number above 0")
        t_s = frames / rates[0]
    return _with_distinct_names(TrackFile(names, tracks, likelihood, t_s, frames))


def _with_distinct_names(tracks: TrackFile) -> TrackFile:
    counts = Counter(tracks.names)
    if twice := [name for name, count in counts.items() if count > 1]:
        raise InputError(f"{counts[twice[0]]} points are called {twice[0]!r}; expected one")
    return tracks


class _PlainUnpickler(pickle.Unpickler):
    """Reads lists, tuples, texts and numbers; refuses everything that could execute code."""

    def find_class(self, module: str, name: str) -> Any:
        raise pickle.UnpicklingError(f"{module}.{name} is not allowed")


def _read_hdf5(file: Path) -> TrackFile:
    try:
        import h5py
    except ImportError as error:
        raise InputError(
            "this is an HDF5 file, for which the library h5py is missing; expected pip install "
            "'collocation-sysid[tracks]', or the tracks as .csv"
        ) from error
    try:
        with h5py.File(file) as content:
            if "tracks" in content and "node_names" in content:
                return _with_distinct_names(_sleap_tracks(content))
            if {"frames", "instances", "metadata"} <= set(content):
                return _with_distinct_names(_sleap_labels(content))
            for name, group in content.items():
                if isinstance(group, h5py.Group) and "table" in group:
                    return _deeplabcut_hdf5(name, group)
            found = listed(content)
    except InputError:
        raise
    except (*DAMAGE, OSError) as error:
        raise InputError(
            f"this HDF5 file cannot be read ({error}); expected a complete file: it may be damaged"
        ) from error
    raise InputError(
        f"found the groups {found}; expected those of DeepLabCut (in table format) or of SLEAP (.slp, "
        "or an analysis file)"
    )


def _dataset(content: Any, name: str) -> Any:
    """Return an array of plausible size."""
    stored = content[name]
    size = stored.size * stored.dtype.itemsize
    require_plausible_size(name, stored.shape, size, stored.id.get_storage_size())
    return stored[()]


def _sleap_tracks(content: Any) -> TrackFile:
    tracks = float_array(_dataset(content, "tracks"), "tracks", finite=False)
    nodes = [_text(each) for each in _dataset(content, "node_names")]
    if tracks.ndim != 4 or tracks.shape[1] != 2 or tracks.shape[2] != len(nodes):
        raise InputError(
            f"tracks has the shape {tracks.shape}; expected (tracks, 2, {len(nodes)} nodes, frames)"
        )
    of = []
    if "track_names" in content:
        of = [_text(each) for each in _dataset(content, "track_names")]
    of = of if len(of) == len(tracks) else [f"track_{k + 1}" for k in range(len(tracks))]
    names = [f"{track}_{node}" if len(tracks) > 1 else node for track in of for node in nodes]
    pixels = tracks.transpose(3, 0, 2, 1).reshape(tracks.shape[3], -1, 2)
    likelihood = None
    if "point_scores" in content:
        scores = float_array(_dataset(content, "point_scores"), "point_scores", finite=False)
        if scores.shape == (len(tracks), len(nodes), tracks.shape[3]):
            likelihood = scores.transpose(2, 0, 1).reshape(len(pixels), -1)
    return TrackFile(tuple(names), pixels, likelihood, None, np.arange(float(len(pixels))))


def _sleap_labels(content: Any) -> TrackFile:
    """Points that a person placed have the likelihood one, and precede predicted ones."""
    try:
        stated = parse_json(_text(content["metadata"].attrs["json"]))
        nodes = [each["name"] for each in stated["nodes"]]
        order = [each["id"] for each in stated["skeletons"][0]["nodes"]]
        frames, instances = _dataset(content, "frames"), _dataset(content, "instances")
        # Points that a person placed, and predicted ones, by the type of an instance.
        points_of: list[Any] = [
            _dataset(content, name) if name in content else () for name in POINTS
        ]
        # Until version 1.1 the centre of the first pixel was (0.5, 0.5).
        version = float(content["metadata"].attrs.get("format_id", 1.0))
        videos = np.unique(frames["video"])
        numbers = frames["frame_idx"]
        of_track = instances["track"]
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise InputError(
            f"this file of labels cannot be read ({error}); expected the .slp of SLEAP, or its "
            "analysis file"
        ) from error
    if len(videos) != 1:
        raise InputError(
            f"found labels of {len(videos)} videos; expected one: export each video as an analysis "
            "file of SLEAP"
        )
    tracks = sorted(set(of_track.tolist()))
    first, last = int(numbers.min()), int(numbers.max())
    shape = (last - first + 1, len(tracks), len(order))
    pixels, likelihood = np.full((*shape, 2), np.nan), np.zeros(shape)
    offset = 0.5 if version < CENTRED_PIXELS else 0.0
    for frame in frames:
        rows = instances[frame["instance_id_start"] : frame["instance_id_end"]]
        for row in sorted(rows, key=lambda each: -int(each["instance_type"])):
            is_predicted = bool(row["instance_type"])
            points = points_of[is_predicted][row["point_id_start"] : row["point_id_end"]]
            at = int(frame["frame_idx"]) - first, tracks.index(int(row["track"]))
            is_visible = points["visible"].astype(bool)
            xy = np.column_stack([points["x"], points["y"]]) - offset
            pixels[at] = np.where(is_visible[:, None], xy, np.nan)
            likelihood[at] = points["score"] if is_predicted else 1.0
    parts = [nodes[k] for k in order]
    names = parts
    if len(tracks) > 1:
        names = [f"track_{k + 1}_{part}" for k in range(len(tracks)) for part in parts]
    flat = len(pixels), -1
    return TrackFile(
        tuple(names),
        pixels.reshape(*flat, 2),
        likelihood.reshape(flat),
        None,
        np.arange(first, last + 1.0),
    )


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def _deeplabcut_hdf5(name: str, group: Any) -> TrackFile:
    """Return the tracks of a table of pandas, whose column names are pickled lists of texts."""
    table = _dataset(group, "table")
    values = np.concatenate(
        [
            np.asarray(table[block], dtype=float).reshape(len(table), -1)
            for block in sorted(b for b in table.dtype.names if b.startswith("values_block"))
        ],
        axis=1,
    )
    try:
        axes = _PlainUnpickler(io.BytesIO(bytes(group.attrs["non_index_axes"]))).load()
        columns = [tuple(map(str, each)) for each in axes[0][1]]
    except (pickle.UnpicklingError, KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(
            f"the column names of {name} cannot be read ({error}); expected the tracks as .csv"
        ) from error
    if len(columns) != values.shape[1] or any(len(each) not in (3, 4) for each in columns):
        raise InputError(
            f"{name} has {values.shape[1]} columns and {len(columns)} names; expected scorer, body "
            "part and coordinate of each: write the tracks as .csv"
        )
    triples = [(each[1] if len(each) == 4 else "", each[-2], each[-1]) for each in columns]
    return _by_columns(triples, values, np.asarray(table["index"], dtype=float))
