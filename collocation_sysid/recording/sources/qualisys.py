"""Qualisys TSV: marker tracks as tab-separated frames below lines of keys and values.

The keys are NO_OF_FRAMES, FREQUENCY, MARKER_NAMES …; frames come with or without Frame and Time
columns and a line of column names. The file does not state its unit of length.
"""

from __future__ import annotations

import re

from ...errors import InputError
from .raw_tracks import Header, LabelChooser, RawTracks, tracks_of_frames
from .text import Row, tab_rows

BEGINNING = "NO_OF_"
_KEY = re.compile(r"(?!NAN$)[A-Z][A-Z0-9_]*")


def read(text: str, choose: LabelChooser) -> RawTracks:
    """Read a Qualisys TSV file; `choose` returns the indices of the markers to read from their
    labels. The result has no unit, and times only if the file has them.

    Raises
    ------
    InputError
        If the text is no such file, a cell is not a number, or numbers of frames or markers differ
        from the header's.
    """
    rows = tab_rows(text)
    count = next((k for k, row in enumerate(rows) if not _KEY.fullmatch(row.cells[0])), len(rows))
    above = {row.cells[0]: row for row in rows[:count]}
    if "MARKER_NAMES" not in above:
        raise InputError(
            "the header lacks MARKER_NAMES; expected a Qualisys TSV file with 3D data, "
            "separated by tabs"
        )
    labels = [cell for cell in above["MARKER_NAMES"].cells[1:] if cell]
    header_values = {key: ("".join(row.cells[1:2]), row.line) for key, row in above.items()}
    header = Header(header_values)
    header.require_count("NO_OF_MARKERS", len(labels), what="marker names")
    frames = rows[count:]
    leading = _leading_columns(frames, 3 * len(labels))
    if frames and _has_column_names(frames[0]):
        del frames[0]
    return tracks_of_frames(
        header,
        "NO_OF_FRAMES",
        rate_key="FREQUENCY",
        leading=leading,
        labels=labels,
        frames=frames,
        choose=choose,
        unit_key="a Qualisys TSV (QTM writes mm)",
    )


def _has_column_names(row: Row) -> bool:
    """Return whether one of the first three cells begins with a letter, and is not "nan"."""
    return any(re.match(r"[A-Za-z]", cell) and cell.lower() != "nan" for cell in row.cells[:3])


def _leading_columns(frames: list[Row], coordinates: int) -> list[str]:
    """Return the names of the columns before the first coordinate: Frame and Time, or none."""
    if not frames:
        return []
    first = frames[0]
    if _has_column_names(first):
        return [cell for cell in first.cells[:2] if cell in ("Frame", "Time")]
    extra = len(first.cells) - coordinates
    if extra > 0 and not any(first.cells[coordinates:]):
        extra = 0  # tabs at the end
    if extra == 3 and not first.cells[-1]:
        extra = 2
    if extra not in (0, 2):
        raise InputError(
            f"the line has {len(first.cells)} cells; expected {coordinates} coordinates, or Frame "
            "and Time and then these",
            where=f"line {first.line}",
        )
    return ["Frame", "Time"][:extra]
