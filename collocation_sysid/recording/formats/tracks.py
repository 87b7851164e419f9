"""Tracks as a file has them, before units and names, and how tables of frames hold them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from ...arrays import Array
from ...errors import InputError
from .text import Grid, Row, grid, numbers, times_of, written_number


@dataclass(frozen=True, eq=False)
class RawTracks:
    """Marker tracks of a file, in its own unit and under its own labels.

    Parameters
    ----------
    labels : sequence of str
        Of the M markers chosen.
    coordinates : (T, M, 3) array
        In the file's unit, NaN where a cell is blank.
    unit : str or None
        The unit of length that the file states.
    unit_key : str
        Where it does, or would; for messages.
    t_s : (T,) array or None
        Times of a time column.
    rate_hz : float or None
        The frame rate that the file states.
    rate_key : str
        Where it does, or would; for messages.
    zeros_are_missing : bool
        Whether a sample at exactly (0, 0, 0) is how the format marks a lost one.
    default_unit : str or None
        The unit where neither file nor user states one: only for this project's own CSV.
    notes : tuple of str
        What was assumed.
    """

    labels: Sequence[str]
    coordinates: Array
    unit: str | None = None
    unit_key: str = ""
    t_s: Array | None = None
    rate_hz: float | None = None
    rate_key: str = ""
    zeros_are_missing: bool = True
    default_unit: str | None = None
    notes: tuple[str, ...] = ()


class Choose(Protocol):
    """Picks markers by the labels of a file, before any of their cells is read."""

    def __call__(self, labels: Sequence[str], aside: Collection[str] = ()) -> list[int]:
        """Return the indices of the labels wanted; those `aside` only if they are asked for."""
        ...


def tracks(
    table: Grid,
    labels: Sequence[str],
    places: Sequence[Sequence[int]],
    chosen: Sequence[int],
    time: int | None,
    **stated: Any,
) -> RawTracks:
    """Tracks of a table with a row for each frame.

    Parameters
    ----------
    table : Grid
    labels : sequence of str
    places : sequence of (int, int, int)
        The columns of x, y and z by marker.
    chosen : sequence of int
        Markers to take.
    time : int or None
        The column of the times, if there is one.
    **stated
        What else the file says, see `RawTracks`.
    """
    cells = numbers(table, [column for k in chosen for column in places[k]], blank_allowed=True)
    return RawTracks(
        labels=[labels[k] for k in chosen],
        coordinates=cells.reshape(-1, len(chosen), 3),
        t_s=None if time is None else times_of(table, time),
        **stated,
    )


@dataclass(frozen=True)
class Header:
    """What a file states above its frames.

    Attributes
    ----------
    stated : mapping of a key to its text and line
    """

    stated: Mapping[str, tuple[str, int]]

    def number(self, key: str) -> float | None:
        """The number that a key states; None where it is blank.

        Raises
        ------
        InputError
            If it is no number above 0.
        """
        text, line = self.stated.get(key, ("", 0))
        if not text:
            return None
        try:
            value = written_number(text)
        except ValueError:
            value = math.nan
        if not 0 < value < math.inf:
            message = f"{key} is '{text}'; expected a number above 0"
            raise InputError(message, where=f"line {line}")
        return value

    def compare(self, key: str, count: int, what: str, line: int | None = None) -> None:
        """Raise an `InputError` if it states another count than there is."""
        stated = self.number(key)
        if stated is not None and stated != count:
            message = f"{key} is {stated:g}, but {count} {what} are there; is the file cut short?"
            raise InputError(message, where=f"line {line or self.stated[key][1]}")


def framed(
    header: Header,
    counted: str,
    rate: str,
    leading: Sequence[str],
    labels: Sequence[str],
    frames: list[Row],
    choose: Choose,
    **stated: Any,
) -> RawTracks:
    """Tracks of a table of frames: some columns, then x, y and z of each marker.

    Parameters
    ----------
    header : Header
    counted, rate : str
        Keys of the number of frames, and of their rate.
    leading : sequence of str
        Columns before those of the markers.
    labels : sequence of str
    frames : list of Row
    choose : Choose
    **stated
        What else the file says, see `RawTracks`.
    """
    chosen = choose(labels)
    table = grid([*leading, *(f"{label} {axis}" for label in labels for axis in "XYZ")], frames)
    header.compare(counted, len(frames), "frames")
    places = [range(k, k + 3) for k in range(len(leading), len(table.columns), 3)]
    time = leading.index("Time") if "Time" in leading else None
    stated |= {"rate_hz": header.number(rate), "rate_key": rate}
    return tracks(table, labels, places, chosen, time, **stated)
