"""TRC, the tab-separated track files of Cortex and OpenSim.

Line 1 PathFileType; lines 2 and 3 the header's keys and values (DataRate, NumFrames, NumMarkers,
Units …); line 4 Frame#, Time and the marker names, line 5 X1, Y1, Z1 …; then a row for each frame.
"""

from __future__ import annotations

from pathlib import Path

from ...errors import InputError
from . import Choose, RawTracks
from .text import (
    grid,
    header_number,
    listed,
    numbers,
    refuse_other_count,
    tab_rows,
    tracks,
)
from .units import stated_unit

BEGINNING = "PathFileType"
_KEYS = ("DataRate", "NumFrames", "NumMarkers", "Units")


def read(path: str | Path, text: str, choose: Choose) -> RawTracks:
    """Read a TRC file."""
    rows = [row for row in tab_rows(text) if any(row.cells)]
    if len(rows) < 5:
        raise InputError("ends within the header of a TRC file", path, f"line {rows[-1].line}")
    _, keys, values, names, axes, *frames = rows
    header = dict(zip(keys.cells, values.cells, strict=False))
    missing = [key for key in _KEYS if key not in header]
    if missing:
        raise InputError(
            f"the header lacks {listed(missing)}; found {listed(filter(None, keys.cells))}",
            path,
            f"line {keys.line}",
        )

    def number(key: str) -> float | None:
        return header_number(header[key], key, path, values.line)

    unit = stated_unit(header["Units"], path, f"line {values.line}")
    labels = [cell for cell in names.cells[2:] if cell]
    if names.cells[0] != "Frame#" or axes.cells[0]:
        raise InputError(
            f"found {listed(filter(None, names.cells[:3]))}; expected Frame#, Time and the names "
            "of the markers, and X1, Y1, Z1 … below them",
            path,
            f"line {names.line}",
        )
    refuse_other_count(
        number("NumMarkers"), len(labels), "NumMarkers", "marker names", path, names.line
    )
    chosen = choose(labels)
    titles = [f"{label} {axis}" for label in labels for axis in "XYZ"]
    table = grid(path, ["Frame#", "Time", *titles], frames)
    refuse_other_count(number("NumFrames"), len(frames), "NumFrames", "frames", path, values.line)
    return RawTracks(
        labels=[labels[k] for k in chosen],
        coordinates=tracks(table, [2 + 3 * k for k in chosen]),
        unit=unit,
        unit_key="Units",
        t_s=numbers(table, [1], blank_allowed=False)[:, 0],
        rate_hz=number("DataRate"),
        rate_key="DataRate",
        lines=table.lines,
    )
