"""Motive CSV (OptiTrack): marker tracks below several rows of header.

Line 1 has keys and values (Export Frame Rate, Length Units …); then come rows Type, Name, ID, and
Rotation or Position above the columns; cells are blank where a marker is hidden. Columns of Type
"Marker" are measured. Those of "Rigid Body Marker" are predictions of Motive's rigid-body fit, so
they are taken only for markers without measured columns. Bodies, bones and their rotations are
skipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ...errors import InputError
from .raw_tracks import Header, LabelChooser, RawTracks, tracks_of_table
from .text import Row, separated_rows, table_of_rows
from .units import length_unit_of_text

BEGINNING = "Format Version"
_MEASURED = "Marker"
_RATES = ("Export Frame Rate", "Capture Frame Rate")


def read(text: str, choose: LabelChooser) -> RawTracks:
    """Read a Motive CSV file; `choose` returns the indices of the markers to read from their
    labels. A note names each marker that was not measured but fitted by Motive.

    Raises
    ------
    InputError
        If the text is no such file, a cell is not a number, or the number of frames differs from
        the header's.
    """
    rows = separated_rows(text, ",")
    first = rows[0]
    pairs = zip(first.cells[::2], first.cells[1::2], strict=False)
    header = Header({key: (text, first.line) for key, text in pairs})
    top = next((k for k, row in enumerate(rows) if row.cells[0] == "Frame"), None)
    if top is None or top < 4 or not "".join(rows[top].cells[1:2]).startswith("Time"):
        raise InputError(
            "this is not a Motive CSV file with markers; expected rows of Type, Name, ID and "
            "Position, then 'Frame,Time (Seconds),X,Y,Z,…'"
        )
    space, line = header.entries.get("Coordinate Space", ("", first.line))
    if space.lower() not in ("", "global"):
        raise InputError(
            f"Coordinate Space is '{space}'; expected Global: export the markers in the world frame",
            where=f"line {line}",
        )
    heads = _column_headings(rows[1:top], rows[top])
    columns = _marker_columns(heads, rows[top].line)
    labels = list(columns)
    chosen = choose(labels)
    titles = [f"{name} {quantity} {axis}".strip() for _, name, quantity, axis in heads]
    table = table_of_rows(titles, rows[top + 1 :])
    header.require_count("Total Exported Frames", len(table.cells), what="frames")
    rate_key = next((key for key in _RATES if header.number(key)), _RATES[0])
    (unit, _) = header.entries.get("Length Units", ("", 0))
    raw = tracks_of_table(
        table,
        labels,
        coordinate_columns=[places for _, places in columns.values()],
        chosen=chosen,
        time=1,
        unit=length_unit_of_text(unit, "line 1, Length Units"),
        unit_key="Length Units",
        rate_hz=header.number(rate_key),
        rate_key=rate_key,
    )
    solved = {label: columns[label][0] for label in raw.labels}
    notes = (
        f"marker {label} has no measured columns; those of Type '{kind}' were used, which Motive "
        "computes from a fitted rigid body"
        for label, kind in solved.items()
        if kind != _MEASURED
    )
    return replace(raw, notes=tuple(notes))


def _column_headings(above: Sequence[Row], axes: Row) -> list[tuple[str, str, str, str]]:
    """Return type, name, quantity and axis of every column."""
    # Older files do not label the rows of the header; the first two are then types and names.
    width = len(axes.cells)
    padded = [(row.cells + [""] * width)[:width] for row in above]
    labelled = {cells[1]: cells for cells in padded}
    types = labelled.get("Type", padded[0])
    names = labelled.get("Name", padded[1])
    return list(zip(types, names, padded[-1], axes.cells, strict=True))


def _marker_columns(
    heads: Sequence[tuple[str, str, str, str]], line: int
) -> dict[str, tuple[str, tuple[int, int, int]]]:
    """Return type and columns of x, y, z by marker; measured columns come before fitted ones."""
    by_kind: dict[tuple[str, str], dict[str, int]] = {}
    for column, (kind, name, quantity, axis) in enumerate(heads):
        if not kind.endswith(_MEASURED) or quantity != "Position":
            continue
        axes = by_kind.setdefault((name, kind), {})
        if axis in axes:
            message = f"two markers are named '{name}'; expected names that differ"
            raise InputError(message, where=f"line {line}")
        axes[axis] = column
    columns: dict[str, tuple[str, tuple[int, int, int]]] = {}
    for (name, kind), axes in by_kind.items():
        if sorted(axes) != ["X", "Y", "Z"]:
            message = f"marker '{name}' has the columns {', '.join(axes)}; expected X, Y and Z"
            raise InputError(message, where=f"line {line}")
        if kind == _MEASURED or name not in columns:
            columns[name] = kind, (axes["X"], axes["Y"], axes["Z"])
    return dict(sorted(columns.items(), key=lambda item: item[1][1]))
