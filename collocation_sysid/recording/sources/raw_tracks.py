"""Marker tracks as they are in a file, before units and names are converted, and tables of
frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ...common.array_types import Array
from ...errors import InputError
from .text import Row, Table, number_from_text, numeric_cells, table_of_rows, times_in_column


@dataclass(frozen=True, eq=False)
class RawTracks:
    """Marker tracks of a file, in its own unit and under its own labels.

    Parameters
    ----------
    labels : sequence of str
        Labels of the M chosen markers.
    coordinates : (T, M, 3) array
        In the file's unit, NaN where a cell is blank.
    unit : str or None
        Unit of length that the file states.
    unit_key : str
        Place in the file where the unit is stated, or would be; for messages.
    t_s : (T,) array or None
        Times of a time column.
    frames : (T,) array or None
        Numbers of the frames, by which they have times if there is no time column.
    rate_hz : float or None
        Frame rate that the file states.
    rate_key : str
        Place in the file where the rate is stated, or would be; for messages.
    zeros_are_missing : bool
        Whether the format marks a lost sample by (0, 0, 0).
    default_unit : str or None
        Unit if neither file nor user states one: only for this project's own CSV.
    notes : tuple of str
        Assumptions that were made.
    sigmas : (T, M) array or None
        Standard deviations of the samples in the file's unit, NaN for markers without any.
    """

    labels: Sequence[str]
    coordinates: Array
    unit: str | None = None
    unit_key: str = ""
    t_s: Array | None = None
    frames: Array | None = None
    rate_hz: float | None = None
    rate_key: str = ""
    zeros_are_missing: bool = True
    default_unit: str | None = None
    notes: tuple[str, ...] = ()
    sigmas: Array | None = None


# Picks markers: returns the indices of the chosen labels of a file, before any of their cells is
# read.
LabelChooser = Callable[[Sequence[str]], list[int]]


def tracks_of_table(
    table: Table,
    labels: Sequence[str],
    coordinate_columns: Sequence[Sequence[int]],
    chosen: Sequence[int],
    time: int | None,
    **fields: Any,
) -> RawTracks:
    """Return the tracks of a table with a row for each frame.

    Parameters
    ----------
    labels : sequence of str
        Labels of all markers of the table.
    coordinate_columns : sequence of (int, int, int)
        Indices of the columns of x, y and z, by marker.
    chosen : sequence of int
        Indices of the markers to read; cells of others are not read.
    time : int or None
        Index of the column of times [s], if there is one; otherwise the first column, if it is none
        of a marker, has the numbers of the frames.
    **fields
        Further fields of `RawTracks`.

    Raises
    ------
    InputError
        If a cell of a chosen marker is neither blank nor a number, or time does not increase.
    """
    cells = numeric_cells(
        table, [column for k in chosen for column in coordinate_columns[k]], blank_allowed=True
    )
    is_numbered = time is None and coordinate_columns[0][0] > 0
    return RawTracks(
        labels=[labels[k] for k in chosen],
        coordinates=cells.reshape(-1, len(chosen), 3),
        t_s=None if time is None else times_in_column(table, time),
        frames=numeric_cells(table, [0], blank_allowed=False)[:, 0] if is_numbered else None,
        **fields,
    )


@dataclass(frozen=True)
class Header:
    """Statements of a file above its frames."""

    entries: Mapping[str, tuple[str, int]]  # mapping of a key to its text and line

    def number(self, key: str) -> float | None:
        """Return the number that a key states; None if it is blank or missing.

        Raises
        ------
        InputError
            If it is no finite number above 0.
        """
        text, line = self.entries.get(key, ("", 0))
        if not text:
            return None
        try:
            value = number_from_text(text)
        except ValueError:
            value = math.nan
        if not 0 < value < math.inf:
            message = f"{key} is '{text}'; expected a number above 0"
            raise InputError(message, where=f"line {line}")
        return value

    def require_count(self, key: str, count: int, what: str, line: int | None = None) -> None:
        """Raise an `InputError` if the number stated by a key differs from `count`.

        A key that is blank or missing passes; a statement that is no number above 0 does not.

        Parameters
        ----------
        what : str
            What is counted, for the message.
        line : int, optional
            Line for the message; that of the key by default.
        """
        declared = self.number(key)
        if declared is not None and declared != count:
            message = (
                f"{key} is {declared:g}, but the file contains {count} {what}; expected equal numbers: "
                "the file may be truncated"
            )
            raise InputError(message, where=f"line {line or self.entries[key][1]}")


def tracks_of_frames(
    header: Header,
    count_key: str,
    rate_key: str,
    leading: Sequence[str],
    labels: Sequence[str],
    frames: list[Row],
    choose: LabelChooser,
    **fields: Any,
) -> RawTracks:
    """Return the tracks of a table of frames: leading columns, then x, y and z of each marker.

    Parameters
    ----------
    count_key, rate_key : str
        Keys of the number of frames, and of their rate.
    leading : sequence of str
        Names of the columns before those of the markers; "Time" is the time.
    **fields
        Further fields of `RawTracks`.

    Raises
    ------
    InputError
        If the header's counts or a row disagree with the table.
    """
    chosen = choose(labels)
    table = table_of_rows(
        [*leading, *(f"{label} {axis}" for label in labels for axis in "XYZ")],
        frames,
        remedy=", separated by tabs",
    )
    header.require_count(count_key, len(frames), what="frames")
    places = [range(k, k + 3) for k in range(len(leading), len(table.columns), 3)]
    time = leading.index("Time") if "Time" in leading else None
    fields |= {"rate_hz": header.number(rate_key), "rate_key": rate_key}
    return tracks_of_table(
        table, labels, coordinate_columns=places, chosen=chosen, time=time, **fields
    )
