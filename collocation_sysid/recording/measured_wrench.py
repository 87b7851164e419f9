"""Measured wrench of a grasp: the force and the torque that the grasp exerts on the body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..common.array_types import Array
from ..common.declarations import declaration, key
from ..common.schema_tables import Vector
from ..common.time_dependence import over_time
from ..common.validated_types import AtLeastOne, Positive
from ..errors import InputError
from .checked_arrays import float_converter, read_only_floats
from .poses import Frame
from .sample_times import first_unordered_time

COMPONENTS = ("fx", "fy", "fz", "tx", "ty", "tz")
# Units of the components: three forces and three torques.
UNITS = ("N",) * 3 + ("N m",) * 3


def _with_torques(values: ArrayLike) -> Array:
    """Return values (S, 3) of forces with three more columns of NaN for torques; others
    unchanged.
    """
    rows = np.array(values, dtype=float)
    forces_alone = rows.ndim == 2 and rows.shape[1] == 3
    return (
        np.hstack([rows, np.full_like(rows, np.nan)]) if forces_alone else rows
    )


@declaration
class Wrench:
    """Force and torque that a grasp exerts on the body, as measured by a sensor.

    Parameters
    ----------
    t_s : (S,) array
        Sample times, at any rate, on the clock of the grasps.
    values : (S, 3) or (S, 6) array
        fx, fy, fz [N], and tx, ty, tz [N m]; NaN where missing.
    sigma_n : float
        Standard deviation of the noise of each force [N].
    sigma_nm : float, optional
        Standard deviation of the noise of each torque [N m]; needed if torques are measured.
    frame : {"world", "grasp"}
        Axes of the components: those of the poses' world, or "grasp" for those of the undeformed
        body as the grasp carries it.
    point_m : (3,) array
        Point [x, y, z] of the torque: fixed in the world, or, in the frame "grasp", on the
        undeformed body and carried by the grasp.
    symmetry : int
        Number of equal parts of the specimen that share the load, 4 where a quarter is modelled.
        Values and sigmas are those of the modelled part; results are reported for the specimen.

    Raises
    ------
    InputError
        If shapes disagree, time does not increase, nothing is measured, or a sigma is missing.
    """

    t_s: Array = key(
        converter=float_converter((None,), "t_s of the wrench"),
        metadata=over_time(),
    )
    values: Array = key(converter=_with_torques, metadata=over_time())
    sigma_n: float = key(Positive)
    sigma_nm: float | None = key(Positive | None, default=None)
    frame: Frame = key(Frame, default="world")
    point_m: Array = key(
        Vector,
        converter=float_converter((3,), "point_m of the wrench"),
        default=(0.0,) * 3,
    )
    symmetry: int = key(AtLeastOne, default=1)

    def __post_init__(self) -> None:
        """Check the measurements and store them as read-only floats (S, 6), in place."""
        if not len(self.t_s):
            raise InputError("a wrench without samples; expected at least one")
        shape = len(self.t_s), 6
        values = read_only_floats(
            self.values, shape, name="values of the wrench", finite=False
        )
        vars(self)["values"] = values
        if fault := first_unordered_time(self.t_s):
            raise InputError(fault[1], where=f"row {fault[0] + 1}")
        if np.isinf(self.values).any():
            raise InputError(
                "a wrench holds an infinite value; expected numbers, or NaN if missing"
            )
        if not self.measured_components.any():
            raise InputError("a wrench has no sample of any component")
        if self.sigma_nm is None and self.measured_components[3:].any():
            raise InputError(
                "a wrench with torques needs sigma_nm, the standard deviation of their noise [N m]"
            )

    def __repr__(self) -> str:
        names = ", ".join(self.component_names)
        return f"Wrench({len(self.t_s)} samples of {names} in the frame of the {self.frame})"

    def with_zeros_at(self, t_s: Array) -> Wrench:
        """Return a copy with zeros at the times `t_s` (S,) [s], as placeholders; NaN for components
        that are not measured.
        """
        values = np.where(
            self.measured_components, np.zeros((len(t_s), 1)), np.nan
        )
        return replace(self, t_s=t_s, values=values)

    @property
    def is_measured(self) -> NDArray[np.bool_]:
        """(S, 6) whether each component is measured at each sample."""
        return np.isfinite(self.values)

    @property
    def measured_components(self) -> NDArray[np.bool_]:
        """(6,) whether each component is measured at any sample."""
        return np.asarray(self.is_measured.any(axis=0))

    @property
    def component_names(self) -> tuple[str, ...]:
        """Names of the components that are measured at any sample, such as "fz", in the order of
        `COMPONENTS`.
        """
        return tuple(
            COMPONENTS[k] for k in np.flatnonzero(self.measured_components)
        )

    @property
    def sigmas(self) -> Array:
        """(6,) standard deviations of the components [N, N m]; those of torques are 1 if `sigma_nm`
        is None, as no torque is measured then.
        """
        torque = 1.0 if self.sigma_nm is None else self.sigma_nm
        return np.repeat([self.sigma_n, torque], 3)
