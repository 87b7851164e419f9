"""A reading of one's own: what an instrument on the body says, as an expression."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import Array
from ..errors import InputError
from .arrays import read_only_floats
from .clock import first_time_fault


@dataclass(frozen=True)
class Look:
    """What a reading may look at, at the time of a sample, as expressions of CasADi.

    Attributes
    ----------
    t_s : of the sample
    position_m, velocity_m_s, acceleration_m_s2 : (3, P) of its points
    """

    t_s: Any
    position_m: Any
    velocity_m_s: Any
    acceleration_m_s2: Any


@dataclass(frozen=True, eq=False)
class Gauge:
    """An instrument whose reading is an expression of a few points of the body.

    Parameters
    ----------
    name : str
    expression : callable
        ``expression(at, **unknowns) -> numbers``, of `Look` and of the instrument's unknowns, in
        CasADi operations; one number, or a column of m.
    t_s : (S,) array
        Times of its samples, ascending, within those of the experiment, at whatever rate.
    values : (S,) or (S, m) array
        What it said; NaN where missing.
    sigma : float
        Standard deviation of the noise of each number.
    points_m : (P, 3) array
        Places on the undeformed body.
    unknowns : mapping of name to float
        What is not known of it, about zero, by the standard deviations of its priors.

    Raises
    ------
    InputError
        If shapes disagree, time does not increase, nothing is measured, or a deviation is not
        above zero.
    """

    name: str
    expression: Callable[..., Any]
    t_s: ArrayLike
    values: ArrayLike
    sigma: float
    points_m: ArrayLike
    unknowns: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        where = f"the reading '{self.name}'"
        times = read_only_floats(self.t_s, (None,), f"t_s of {where}")
        given = np.array(self.values, dtype=float)
        given = given[:, None] if given.ndim == 1 else given
        vars(self).update(
            t_s=times,
            values=read_only_floats(given, (len(times), None), f"values of {where}", finite=False),
            points_m=read_only_floats(self.points_m, (None, 3), f"points_m of {where}"),
            unknowns=dict(self.unknowns),
        )
        if fault := first_time_fault(times):
            raise InputError(f"{fault[1]}, of {where}", where=f"row {fault[0] + 1}")
        if np.isinf(given).any():
            raise InputError(f"{where} holds an infinite value; expected numbers, NaN if missing")
        if not np.isfinite(given).any():
            raise InputError(f"{where} has no sample; expected some, or to be left out")
        for what, sigma in {"sigma": self.sigma, **self.unknowns}.items():
            if not (sigma > 0 and np.isfinite(sigma)):
                raise InputError(f"{what} of {where} is {sigma:g}; expected more than 0")

    def __repr__(self) -> str:
        return f"Gauge({self.name!r}: {len(self.times)} samples of {self.measured.shape[1]})"

    @property
    def times(self) -> Array:
        """(S,)."""
        return np.asarray(self.t_s)

    @property
    def measured(self) -> Array:
        """(S, m)."""
        return np.asarray(self.values)

    @property
    def present(self) -> NDArray[np.bool_]:
        """(S, m) numbers that are there."""
        return np.isfinite(self.measured)
