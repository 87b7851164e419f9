"""Vicon Nexus CSV: blocks of Devices, Model Outputs, Trajectories …, of which the last are markers.

A block begins with its name and its rate; then come a row of the names of its markers or channels,
a row of Frame, Sub Frame and axes, and a row of units. Cells are blank where a marker is lost.
"""

from __future__ import annotations

from itertools import zip_longest

from ...errors import InputError
from .raw_tracks import Header, LabelChooser, RawTracks, tracks_of_table
from .text import Row, separated_rows, table_of_rows
from .units import length_unit_of_text

# First cells of blocks; files begin with one of them.
BLOCKS = ("Trajectories", "Devices", "Model Outputs", "Joints", "Segments", "Events")
MARKERS = "Trajectories"


def read(text: str, choose: LabelChooser) -> RawTracks:
    """Read the markers of a CSV file of Vicon Nexus; `choose` returns the indices of the markers to
    read from their labels. A note names the other blocks.

    Raises
    ------
    InputError
        If the file has no block of trajectories, its units differ, or a cell is not a number.
    """
    rows = separated_rows(text)
    starts = [k for k, row in enumerate(rows) if _is_beginning(row)]
    blocks = [rows[k].cells[0] for k in starts]
    if MARKERS not in blocks:
        raise InputError(
            f"found the blocks {', '.join(blocks)} of Vicon Nexus, but no Trajectories; expected the "
            "trajectories of the markers"
        )
    start = starts[blocks.index(MARKERS)]
    end = next((k for k in starts if k > start), len(rows))
    rate, names, axes, units, *frames = [*rows[start + 1 : end], *[Row(0, [])] * 4]
    frames = frames[:-4]
    if axes.cells[:2] != ["Frame", "Sub Frame"] or not frames:
        raise InputError(
            "expected below Trajectories rows of the rate, of names, of Frame, Sub Frame, X, Y, Z …, "
            "and of units, then frames",
            where=f"line {rows[start].line}",
        )
    width = len(axes.cells)
    stated = {unit for unit in units.cells[2:width] if unit}
    if len(stated) > 1:
        raise InputError(
            f"the units are {', '.join(sorted(stated))}; expected one unit of length",
            where=f"line {units.line}",
        )
    labels, places = _marker_columns(names, axes)
    blanks = [""] * width
    table = table_of_rows(
        [f"{axis} ({k})" for k, axis in enumerate(axes.cells)],
        [Row(row.line, (row.cells + blanks)[:width]) for row in frames],
    )
    chosen = choose(labels)
    others = dict.fromkeys(block for block in blocks if block != MARKERS)
    rate_hz = Header({"rate": (rate.cells[0], rate.line)}).number("rate")
    return tracks_of_table(
        table,
        labels,
        coordinate_columns=places,
        chosen=chosen,
        time=None,
        unit=length_unit_of_text("".join(stated), f"line {units.line}"),
        unit_key=f"line {units.line}",
        rate_hz=rate_hz,
        rate_key=f"line {rate.line}",
        notes=(f"not read: {', '.join(others)}",) if others else (),
    )


def _is_beginning(row: Row) -> bool:
    return row.cells[0] in BLOCKS and not any(row.cells[1:])


def _marker_columns(names: Row, axes: Row) -> tuple[list[str], list[list[int]]]:
    """Return labels, and columns of x, y and z; a label, or none, stands above the first of them."""
    labels, places = [], []
    for k, (name, axis) in enumerate(zip_longest(names.cells, axes.cells, fillvalue="")):
        if not name and axis != "X":
            continue
        if axes.cells[k : k + 3] != ["X", "Y", "Z"]:
            raise InputError(
                f"below {name} are {', '.join(axes.cells[k : k + 3]) or 'no axes'}; expected X, Y, Z",
                where=f"line {axes.line}",
            )
        labels.append(name)
        places.append([k, k + 1, k + 2])
    return labels, places
