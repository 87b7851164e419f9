"""Motion-capture files, one format per module; what their readers return stands here.

Tracks are as the file has them, before units and names.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol

from ...arrays import Array


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
    lines : sequence of int or None
        The line of each frame, for messages.
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
    lines: Sequence[int] | None = None
    zeros_are_missing: bool = True
    default_unit: str | None = None
    notes: tuple[str, ...] = ()


class Choose(Protocol):
    """Picks markers by the labels of a file, before any of their cells is read."""

    def __call__(self, labels: Sequence[str], aside: Collection[str] = ()) -> list[int]:
        """Return the indices of the labels wanted; those `aside` only if they are asked for."""
        ...
