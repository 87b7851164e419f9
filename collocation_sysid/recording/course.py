"""A quantity over time as stated: a constant, or linear between the rows of a table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array
from ..errors import InputError
from .arrays import read_only_floats
from .clock import TIME_TOLERANCE_S, first_time_fault


@dataclass(frozen=True, eq=False)
class Course:
    """Values (m, ...) at times (m,), or one without times.

    Parameters
    ----------
    values : (...) or (m, ...) array
    t_s : (m,) array, optional
    what : str
        The key and whose it is, for messages.
    shape : tuple of int
        Of a value.
    """

    values: Array
    t_s: Array | None

    def __init__(
        self, values: ArrayLike, t_s: ArrayLike | None, what: str, shape: tuple[int, ...] = ()
    ) -> None:
        rows = np.reshape(values, (-1, *shape)) if np.ndim(values) <= len(shape) else values
        rows = read_only_floats(rows, (None, *shape), what)
        if t_s is None and len(rows) != 1:
            raise InputError(f"{len(rows)} rows of {what} without times; expected t_s")
        if t_s is not None:
            t_s = read_only_floats(t_s, (len(rows),), f"t_s of {what}")
            if fault := first_time_fault(t_s):
                raise InputError(f"{what}: {fault[1]}", where=f"row {fault[0] + 1}")
        vars(self).update(values=rows, t_s=t_s)

    def at(self, t_s: ArrayLike) -> Array:
        """(T,) values at times (T,)."""
        wanted = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        if self.t_s is None:
            return np.full(len(wanted), self.values[0])
        return np.interp(wanted, self.t_s, self.values)

    def refuse_short(self, t_s: Array, name: str) -> None:
        """Refuse a table that does not reach over the times of a recording.

        Raises
        ------
        InputError
            Naming what the table is of.
        """
        if self.t_s is None:
            return
        (first, last), (start, end) = self.t_s[[0, -1]], t_s[[0, -1]]
        if first > start + TIME_TOLERANCE_S or last < end - TIME_TOLERANCE_S:
            raise InputError(
                f"{name} is given from {first:.6g} s to {last:.6g} s, the recording lasts from "
                f"{start:.6g} s to {end:.6g} s; expected rows over all of it, on the same clock: "
                "add rows or narrow window_s"
            )
