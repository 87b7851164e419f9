"""Measured wrench of a grasp, the force and the torque that the grasp exerts on the body, and its
files.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..common.array_types import Array
from ..common.checked_arrays import (
    as_array_or_none,
    float_array,
    float_converter,
    read_only_floats,
    unconverted_sigma_or_none,
)
from ..common.declarations import declaration, key
from ..common.schema_tables import Noise, Vector
from ..common.time_dependence import at_times, over_time
from ..common.validated_types import AtLeastOne, PositivePerSample
from ..errors import InputError
from .measurement import Measurement, checked_ratios, split_sigma
from .poses import Frame
from .sample_times import first_unordered_time
from .sources.columns import FORCE, FORCES, STRESS, TORQUE, TORQUES, read_columns
from .time_tables import axis_components, other_axes, without_rounding
from .writers import write_columns_csv

COMPONENTS = ("fx", "fy", "fz", "tx", "ty", "tz")
# Units of the components: three forces and three torques.
UNITS = ("N",) * 3 + ("N m",) * 3
WRENCH_COLUMNS = tuple(quantity.column for quantity in (*FORCES, *TORQUES))


def _with_torques(values: ArrayLike) -> Array:
    """Append three columns of NaN for torques to forces (S, 3)."""
    rows = float_array(values, "values of the wrench", ((None, 3), (None, 6)), finite=False)
    forces_alone = rows.ndim == 2 and rows.shape[1] == 3
    return np.hstack([rows, np.full_like(rows, np.nan)]) if forces_alone else rows


@declaration
class Wrench(Measurement):
    """Force and torque that a grasp exerts on the body, as measured by a sensor.

    Parameters
    ----------
    t_s : (S,) array
        Sample times, at any rate, on the clock of the grasps.
    values : (S, 3) or (S, 6) array
        fx, fy, fz [N], and tx, ty, tz [N m]; NaN where missing.
    sigma_n : float, (S,) or (S, 3) array, optional
        Standard deviation of the noise of each force [N]: one for all, one for each sample, or one
        for each component; needed if forces are measured. An array is stored as its median, and as
        ratios, `sigma_ratios`.
    sigma_nm : float, (S,) or (S, 3) array, optional
        Standard deviation of the noise of each torque [N m]; needed if torques are measured.
    frame : {"world", "grasp"}
        Axes of the components. "world": those of the world frame of the poses. "grasp": those of
        the undeformed body, which move with the grasp.
    point_m : (3,) array
        Point [x, y, z] about which the torque is measured; it is fixed in the frame "world", and in
        the frame "grasp" it is stated on the undeformed body and moves with the grasp.
    symmetry : int
        Number of equal parts of the specimen that share the load, 4 where a quarter is modelled.
        Values and sigmas are those of the modelled part; results are reported for the specimen.

    Raises
    ------
    InputError
        If shapes disagree, time does not increase, nothing is measured, or a sigma is missing.
    """

    measurement_text: ClassVar[str] = "measured forces"
    other_text: ClassVar[str] = "wrenches"
    noise_key: ClassVar[str] = "sigma_n"
    sigma_text: ClassVar[str] = "sigma_n"
    precedence: ClassVar[int] = 2
    unit: ClassVar[str] = "N"
    title: ClassVar[str] = "the wrench"

    t_s: Array = key(converter=float_converter((None,), "t_s of the wrench"), metadata=over_time())
    values: Array = key(converter=_with_torques, metadata=over_time())
    sigma_n: float | None = key(
        Noise | None,
        converter=unconverted_sigma_or_none,
        accepted=PositivePerSample | None,
        default=None,
    )
    sigma_nm: float | None = key(
        Noise | None,
        converter=unconverted_sigma_or_none,
        accepted=PositivePerSample | None,
        default=None,
    )
    frame: Frame = key(Frame, default="world")
    point_m: Array = key(
        Vector, converter=float_converter((3,), "point_m of the wrench"), default=(0.0,) * 3
    )
    symmetry: int = key(AtLeastOne, default=1)
    sigma_ratios: Array | None = key(converter=as_array_or_none, default=None, metadata=over_time())

    def __post_init__(self) -> None:
        if not len(self.t_s):
            raise InputError("the measured wrench has no samples; expected at least one")
        shape = len(self.t_s), 6
        values = read_only_floats(self.values, shape, name="values of the wrench", finite=False)
        vars(self)["values"] = values
        if fault := first_unordered_time(self.t_s):
            raise InputError(fault[1], where=f"row {fault[0] + 1}")
        if np.isinf(self.values).any():
            raise InputError(
                "the measured wrench contains an infinite value; expected numbers, or NaN if missing"
            )
        if not self.measured_components.any():
            raise InputError(
                "all values of the measured wrench are missing; expected at least one component with "
                "a number"
            )
        for name, what, unit, part in (
            ("sigma_n", "forces", "N", slice(3)),
            ("sigma_nm", "torques", "N m", slice(3, 6)),
        ):
            if getattr(self, name) is None and self.measured_components[part].any():
                raise InputError(
                    f"the measured wrench contains {what}, but {name} is missing; expected the "
                    f"standard deviation of the noise of the {what} [{unit}]"
                )
        self._split_sigmas()

    def _split_sigmas(self) -> None:
        """Store σ of each sample as medians and ratios, in place."""
        shape = self.values.shape
        ratios = np.ones(shape) if self.sigma_ratios is None else np.array(self.sigma_ratios)
        own = checked_ratios(ratios, shape, "the wrench").copy()
        for name, part in (("sigma_n", slice(3)), ("sigma_nm", slice(3, 6))):
            if not np.ndim(getattr(self, name)):
                continue
            sigma, each = split_sigma(getattr(self, name), self.is_measured[:, part], name)
            vars(self)[name] = sigma
            own[:, part] = each
        if self.sigma_ratios is not None or (own != 1).any():
            vars(self)["sigma_ratios"] = checked_ratios(own, shape, "the wrench")

    def __repr__(self) -> str:
        names = ", ".join(self.component_names)
        return f"Wrench({len(self.t_s)} samples of {names} in the frame of the {self.frame})"

    def with_samples(self, t_s: ArrayLike, values: ArrayLike) -> Wrench:
        """Return a copy with other forces [N] and torques [N m], (S, 3) or (S, 6), NaN where missing."""
        return replace(self, t_s=t_s, values=values, sigma_ratios=self._ratios_for(t_s))

    def with_zeros_at(self, t_s: ArrayLike) -> Wrench:
        """Return a copy with zeros at the times `t_s` (S,) [s], as placeholders; NaN for components
        that are not measured.
        """
        values = np.where(self.measured_components, np.zeros((np.size(t_s), 1)), np.nan)
        return self.with_samples(t_s, values)

    def within(self, t_s: Array, fewest: int) -> Wrench | None:
        here = (self.t_s >= t_s[0]) & (self.t_s <= t_s[-1])
        if here.sum() < fewest or not self.is_measured[here].any():
            return None
        return at_times(self, here)

    @property
    def sample_times_s(self) -> Array:
        return self.t_s

    @property
    def measured_values(self) -> Array:
        """(S, 6) measured components [N, N m], NaN where missing."""
        return self.values

    @property
    def value_sigmas(self) -> Array:
        """(6,) standard deviations of the components [N, N m]; 1 where none is stated, as no such
        component is measured then.
        """
        stated = (self.sigma_n, self.sigma_nm)
        return np.repeat([1.0 if sigma is None else sigma for sigma in stated], 3)

    @property
    def number_names(self) -> tuple[str, ...]:
        return COMPONENTS

    @property
    def presence(self) -> dict[str, NDArray[np.bool_]]:
        masks = super().presence
        return {name: masks[name] for name in self.component_names}

    def vectors(self, values: Array) -> Array:
        """Return the forces (S, 1, 3) of the whole specimen among numbers (S, 6)."""
        return self.symmetry * values[:, None, :3]

    def rms_text(self, difference: Array) -> str:
        return super().rms_text(self.vectors(difference))

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
        """Names of the components that are measured at any sample, such as "fz", in the
        order of `COMPONENTS`.
        """
        return tuple(COMPONENTS[k] for k in np.flatnonzero(self.measured_components))

    def component_noises(self) -> list[tuple[int, str, str, float]]:
        """Return index, name, unit and σ of each component that is measured at any sample."""
        return [
            (k, COMPONENTS[k], UNITS[k], float(self.value_sigmas[k]))
            for k in np.flatnonzero(self.measured_components).tolist()
        ]


def read_wrench(
    path: str | Path,
    columns: Mapping[str, str] | None = None,
    axis: str = "z",
    sign: int = 1,
    area_m2: float | None = None,
    symmetry: int = 1,
    timed: bool = True,
    noise_columns: Mapping[str, str] | None = None,
    other_columns: Collection[str] = (),
    header_line: int | None = None,
    notes: list[str] | None = None,
) -> tuple[Array, Array, dict[str, Array]]:
    """Read force and torque of a grasp over time, columns in any order; blank cells are missing.

    Parameters
    ----------
    columns : mapping, optional
        Names of the columns of fx, fy, fz, tx, ty, tz, or of a machine's force, torque or stress,
        and of t, if their names are not recognised.
    axis : {"x", "y", "z"}
        Axis of a machine's force, torque or stress.
    sign : {1, -1}
        Factor on the file's values: -1 if a positive value pulls the body against the axis.
    area_m2 : float, optional
        Undeformed area that an engineering stress multiplies; given if the file holds a stress.
    symmetry : int
        Number of equal parts of the specimen, of which the body is one; loads are divided by it.
    timed : bool
        Whether times are required; otherwise rows are numbered in seconds if there are no times.
    noise_columns : mapping, optional
        Column by the key, "sigma_n" or "sigma_nm", of the standard deviations that it holds.
    other_columns : collection of str
        Columns of the file that hold something else, such as the noise of another sensor.
    header_line : int, optional
        Line of the column names, see `read_columns`.
    notes : list of str, optional
        Words of column names that are not understood are added to it.

    Returns
    -------
    t_s : (S,) array
    values : (S, 6) array
        fx, fy, fz [N], tx, ty, tz [N m]; NaN where missing.
    sigmas : dict
        Standard deviations (S,) by the keys of `noise_columns` [N, N m].

    Raises
    ------
    InputError
        If a column names no unit or a wrong one, is unknown or repeated, a cell is not a number, or
        time does not increase; the line is named.
    """
    quantities = (*FORCES, *TORQUES, FORCE, TORQUE) if area_m2 is None else (STRESS,)
    table = read_columns(
        path,
        quantities,
        column_names=columns,
        blank_allowed=True,
        requires_times=timed,
        noise_columns=noise_columns,
        other_columns=other_columns,
        header_line=header_line,
        other_kinds={**other_axes(axis), "volume": "the stress along the axis"},
    )
    if notes is not None:
        notes += table.notes
    factor = sign * (area_m2 or 1.0) / symmetry
    values = factor * axis_components(table, (*FORCES, *TORQUES), axis=axis)
    sigmas = {key: column / symmetry for key, column in table.noises.items()}
    return without_rounding(table.t_s), values, sigmas


def write_wrench_csv(path: str | Path, t_s: ArrayLike, values: ArrayLike) -> None:
    """Write wrenches (S, 3) or (S, 6) [N, N m] at times (S,) [s] as `read_wrench` reads them; NaN
    becomes a blank cell.

    Components without any finite value are left out.
    """
    rows = np.asarray(values, dtype=float)
    there = np.flatnonzero(np.isfinite(rows).any(axis=0))
    columns = {WRENCH_COLUMNS[k]: rows[:, k] for k in there}
    write_columns_csv(path, {"t_s": np.asarray(t_s), **columns})
