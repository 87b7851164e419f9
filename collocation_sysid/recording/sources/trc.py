"""TRC: marker tracks in the tab-separated files of Cortex and OpenSim.

Line 1 PathFileType; lines 2 and 3 the header's keys and values (DataRate, NumFrames, NumMarkers,
Units …); line 4 Frame#, Time and the marker names, line 5 X1, Y1, Z1 …; then a row for each frame.
"""

from __future__ import annotations

from ...errors import InputError
from .raw_tracks import Header, LabelChooser, RawTracks, tracks_of_frames
from .text import tab_rows
from .units import length_unit_of_text

BEGINNING = "PathFileType"
_KEYS = ("DataRate", "NumFrames", "NumMarkers", "Units")


def read(text: str, choose: LabelChooser) -> RawTracks:
    """Read a TRC file; `choose` returns the indices of the markers to read from their labels.
    Samples at (0, 0, 0) count as missing.

    Raises
    ------
    InputError
        If the text is no such file, a cell is not a number, or numbers of frames or markers differ
        from the header's.
    """
    rows = [row for row in tab_rows(text) if any(row.cells)]
    if len(rows) < 5:
        raise InputError(
            "the file ends within its TRC header; expected five header rows and the frames: "
            "export it again",
            where=f"line {rows[-1].line}",
        )
    _, keys, values, names, axes, *frames = rows
    header_values = zip(values.cells, [values.line] * len(keys.cells), strict=False)
    header = Header(dict(zip(keys.cells, header_values, strict=False)))
    if missing := [key for key in _KEYS if key not in header.entries]:
        there = ", ".join(filter(None, keys.cells))
        message = (
            f"the header lacks {', '.join(missing)}; found {there}; expected a complete TRC header, "
            "separated by tabs: export the file again"
        )
        raise InputError(message, where=f"line {keys.line}")
    unit = length_unit_of_text(header.entries["Units"][0], f"line {values.line}")
    labels = [cell for cell in names.cells[2:] if cell]
    if names.cells[0] != "Frame#" or axes.cells[0]:
        raise InputError(
            f"found {', '.join(filter(None, names.cells[:3]))}; expected Frame#, Time and the "
            "names of the markers, and X1, Y1, Z1 … below them",
            where=f"line {names.line}",
        )
    header.require_count("NumMarkers", len(labels), what="marker names", line=names.line)
    return tracks_of_frames(
        header,
        "NumFrames",
        rate_key="DataRate",
        leading=["Frame#", "Time"],
        labels=labels,
        frames=frames,
        choose=choose,
        unit=unit,
        unit_key="Units",
    )
