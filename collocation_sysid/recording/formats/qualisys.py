"""Qualisys TSV: lines of a key and its values (NO_OF_FRAMES, FREQUENCY, MARKER_NAMES …), then
tab-separated frames, with or without Frame and Time columns and a line that names the columns.

The file does not state its unit of length.
"""

from __future__ import annotations

import re
from pathlib import Path

from ...errors import InputError
from . import Choose, RawTracks
from .text import (
    Row,
    grid,
    header_number,
    numbers,
    refuse_other_count,
    tab_rows,
    tracks,
)

BEGINNING = "NO_OF_"
_KEY = re.compile(r"(?!NAN$)[A-Z][A-Z0-9_]*")


def read(path: str | Path, text: str, choose: Choose) -> RawTracks:
    """Read a Qualisys TSV file."""
    rows = tab_rows(text)
    count = next((k for k, row in enumerate(rows) if not _KEY.fullmatch(row.cells[0])), len(rows))
    header = {row.cells[0]: row for row in rows[:count]}
    if "MARKER_NAMES" not in header:
        raise InputError(
            "the header lacks MARKER_NAMES; expected a Qualisys TSV file with 3D data", path
        )
    labels = [cell for cell in header["MARKER_NAMES"].cells[1:] if cell]

    def number(key: str) -> float | None:
        row = header.get(key)
        return row and header_number("".join(row.cells[1:2]), key, path, row.line)

    def compare(key: str, found: int, what: str) -> None:
        if key in header:
            refuse_other_count(number(key), found, key, what, path, header[key].line)

    compare("NO_OF_MARKERS", len(labels), "marker names")
    frames = rows[count:]
    leading = _leading_columns(path, frames, 3 * len(labels))
    if frames and _names_columns(frames[0]):
        del frames[0]
    chosen = choose(labels)
    titles = [f"{label} {axis}" for label in labels for axis in "XYZ"]
    table = grid(path, [*leading, *titles], frames)
    compare("NO_OF_FRAMES", len(frames), "frames")
    timed = "Time" in leading
    return RawTracks(
        labels=[labels[k] for k in chosen],
        coordinates=tracks(table, [len(leading) + 3 * k for k in chosen]),
        unit_key="a Qualisys TSV (QTM writes mm)",
        t_s=numbers(table, [leading.index("Time")], blank_allowed=False)[:, 0] if timed else None,
        rate_hz=number("FREQUENCY"),
        rate_key="FREQUENCY",
        lines=table.lines,
    )


def _names_columns(row: Row) -> bool:
    return any(re.match(r"[A-Za-z]", cell) and cell.lower() != "nan" for cell in row.cells[:3])


def _leading_columns(path: str | Path, frames: list[Row], coordinates: int) -> list[str]:
    """The columns before the first coordinate, by their names, else by their number."""
    if not frames:
        return []
    first = frames[0]
    if _names_columns(first):
        return [cell for cell in first.cells[:2] if cell in ("Frame", "Time")]
    extra = len(first.cells) - coordinates
    if extra > 0 and not any(first.cells[coordinates:]):
        extra = 0  # tabs at the end
    if extra == 3 and not first.cells[-1]:
        extra = 2
    if extra not in (0, 2):
        raise InputError(
            f"{len(first.cells)} cells; expected {coordinates} coordinates, or Frame and Time "
            "before them",
            path,
            f"line {first.line}",
        )
    return ["Frame", "Time"][:extra]
