"""The measured wrench of a grasp: the force and the torque that it gives the body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import Array
from ..errors import InputError
from .arrays import read_only_floats
from .clock import first_time_fault

Frame = Literal["world", "grasp"]

COMPONENTS = ("fx", "fy", "fz", "tx", "ty", "tz")
UNITS = ("N",) * 3 + ("N m",) * 3


@dataclass(frozen=True, eq=False)
class Wrench:
    """What a sensor says of the force and torque that a grasp gives the body.

    Parameters
    ----------
    t_s : (S,) array
        Times of its samples, at whatever rate, on the clock of the grasps.
    values : (S, 3) or (S, 6) array
        fx, fy, fz [N], and tx, ty, tz [N m]; NaN where missing.
    sigma_n, sigma_nm : float
        Standard deviations of the noise of each component; that of torques where there are any.
    frame : {"world", "grasp"}
        Axes of the components: those of the poses' world, or those of the undeformed body as the
        grasp carries it.
    point_m : (3,) array
        The torque's point: fixed in the world, or in the grasp's frame and moving along.

    Raises
    ------
    InputError
        If shapes disagree, time does not increase, nothing is measured, or a sigma is missing.
    """

    t_s: Array
    values: Array
    sigma_n: float
    sigma_nm: float | None
    frame: Frame
    point_m: Array

    def __init__(
        self,
        t_s: ArrayLike,
        values: ArrayLike,
        sigma_n: float,
        sigma_nm: float | None = None,
        frame: Frame = "world",
        point_m: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        times = read_only_floats(t_s, (None,), "t_s of the wrench")
        given = np.array(values, dtype=float)
        if given.ndim == 2 and given.shape[1] == 3:
            given = np.hstack([given, np.full_like(given, np.nan)])
        vars(self).update(
            t_s=times,
            values=read_only_floats(given, (len(times), 6), "values of the wrench", finite=False),
            sigma_n=sigma_n,
            sigma_nm=sigma_nm,
            frame=frame,
            point_m=read_only_floats(point_m, (3,), "point_m of the wrench"),
        )
        self._check()

    def _check(self) -> None:
        if not len(self.t_s):
            raise InputError("a wrench without samples; expected some")
        if fault := first_time_fault(self.t_s):
            raise InputError(fault[1], where=f"row {fault[0] + 1}")
        if self.frame not in get_args(Frame):
            expected = ", ".join(get_args(Frame))
            raise InputError(f"frame of a wrench is {self.frame!r}; expected one of {expected}")
        if np.isinf(self.values).any():
            raise InputError(
                "a wrench holds an infinite value; expected numbers, or NaN if missing"
            )
        if not self.measured.any():
            raise InputError("a wrench has no sample of any component")
        if self.sigma_nm is None and self.measured[3:].any():
            raise InputError(
                "a wrench with torques needs sigma_nm, the standard deviation of their noise [N m]"
            )
        for name, sigma in (("sigma_n", self.sigma_n), ("sigma_nm", self.sigma_nm)):
            if sigma is not None and not (sigma > 0 and np.isfinite(sigma)):
                raise InputError(f"{name} of a wrench is {sigma:g}; expected more than 0")

    def __repr__(self) -> str:
        names = ", ".join(self.names)
        return f"Wrench({len(self.t_s)} samples of {names} in the frame of the {self.frame})"

    @property
    def present(self) -> NDArray[np.bool_]:
        """(S, 6) components that are there."""
        return np.isfinite(self.values)

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(6,) components that are measured at some time."""
        return np.asarray(self.present.any(axis=0))

    @property
    def names(self) -> tuple[str, ...]:
        """Of the components that are measured."""
        return tuple(COMPONENTS[k] for k in np.flatnonzero(self.measured))

    @property
    def sigmas(self) -> Array:
        """(6,) standard deviations; those of what is not measured are one."""
        torque = 1.0 if self.sigma_nm is None else self.sigma_nm
        return np.repeat([self.sigma_n, torque], 3)
