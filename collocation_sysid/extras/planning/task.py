"""Task of a planned motion (task.toml): what points of the body do, and how the hand may help.

The tables describe what is wanted; `sampled_references` turns them into references of points of a
given body.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, Field, InstanceOf, model_validator
from pydantic.json_schema import SkipJsonSchema
from scipy.interpolate import PchipInterpolator

from ...common.array_types import Array, Index
from ...common.schema_tables import Section, Vector, require_one
from ...common.text_files import HAND_WRITTEN_BYTES, parse_toml, read_text
from ...common.validated_classes import validated
from ...common.validated_types import (
    AboveOne,
    AtLeastOne,
    Boundless,
    Finite,
    Flag,
    NotNegative,
    Positive,
    Text,
)
from ...errors import InputError, hint_at, listed, located
from ...problem.schema import CodeSection
from ...problem.validation_messages import StatedSection
from ...recording.sources.columns import find_time
from ...recording.sources.source import read_table
from ...recording.sources.text import numeric_cells, times_in_column
from .path_terms import PathCost, PathLimit

HandAxis = Literal["x", "y", "z", "rx", "ry", "rz"]
AXES: tuple[HandAxis, ...] = ("x", "y", "z", "rx", "ry", "rz")
POSITION_COLUMNS = ("x_m", "y_m", "z_m")
VELOCITY_COLUMNS = ("vx_m_s", "vy_m_s", "vz_m_s")


def _not_infinite(value: float) -> float:
    if np.isinf(value):
        raise ValueError(
            f"found {value:g}; expected a finite number, or nan where nothing is required"
        )
    return value


Coordinate = Annotated[Boundless, AfterValidator(_not_infinite)]
Row = tuple[Coordinate, Coordinate, Coordinate]
# Keys of a task that a motion for information does not have.
OF_REFERENCES = ("reference", "end", "largest_error_m")
# Distance of a reference from the body in sizes of the body beyond which it has another unit.
MOST_BODIES = 20.0


class ReferenceSection(Section):
    """What a point of the body shall do.

    Attributes
    ----------
    point : str, optional
        Name of a marker of the problem.
    point_m : (3,) list, optional
        Place [x, y, z] of the point on the undeformed body, in place of a marker.
    name : str
        Name of the point in files and pictures, for a point given by its place.
    file : str, optional
        CSV with t_s and some of x_m, y_m, z_m, vx_m_s, vy_m_s, vz_m_s; an empty cell or a missing
        column leaves a coordinate free.
    t_s : list of float, optional
        Times of the reference, in place of a file; the motion begins at 0.
    position_m : list of (3,) lists, optional
        Position [x, y, z] at each of `t_s`; nan leaves a coordinate free.
    velocity_m_s : list of (3,) lists, optional
        Velocity [x, y, z] at each of `t_s`; nan leaves a component free.
    hold : bool
        Whether the point stays where it is before the motion, from `from_s` until `until_s`.
    relative : bool
        Whether positions are relative to the place of the point before the motion.
    from_s, until_s : float
        First and last time at which the reference counts; all its times by default.
    interpolation : "smooth", "linear" or "none"
        Between the times of the reference: a smooth curve that does not leave the values before and
        after, straight lines, or none, so that the reference counts at its times alone.
    sigma_m : float
        Deviation of a coordinate that is acceptable: deviations count in units of it.
    sigma_m_s : float
        The same for a component of the velocity.
    """

    point: Text | None = None
    point_m: Vector | None = None
    name: Text | None = None
    file: Text | None = None
    t_s: list[Finite] | None = None
    position_m: list[Row] | None = None
    velocity_m_s: list[Row] | None = None
    hold: Flag = False
    relative: Flag = False
    from_s: NotNegative = 0.0
    until_s: Positive | None = None
    interpolation: Literal["smooth", "linear", "none"] = "smooth"
    sigma_m: Positive = 1e-3
    sigma_m_s: Positive = 1e-2

    @model_validator(mode="after")
    def _require_one_description(self) -> ReferenceSection:
        require_one(self, "point", "point_m")
        if self.point is not None and self.name is not None:
            raise ValueError("name is of a point given by point_m; a marker has its own name")
        stated = [
            key for key, given in (("file", self.file), ("t_s", self.t_s), ("hold", self.hold))
            if given
        ]  # fmt: skip
        if len(stated) != 1:
            raise ValueError(
                f"found {' and '.join(stated) or 'no reference'}; expected exactly one of file, "
                "t_s with position_m or velocity_m_s, and hold = true"
            )
        for key in ("position_m", "velocity_m_s"):
            rows = getattr(self, key)
            if rows is not None and self.t_s is None:
                raise ValueError(f"{key} has no times; expected t_s with as many entries")
            if rows is not None and self.t_s is not None and len(rows) != len(self.t_s):
                raise ValueError(
                    f"{key} has {len(rows)} entries and t_s {len(self.t_s)}; expected as many"
                )
        if self.t_s is not None:
            if self.position_m is None and self.velocity_m_s is None:
                raise ValueError("t_s has no values; expected position_m or velocity_m_s")
            if not (np.diff(self.t_s) > 0).all():
                raise ValueError("t_s does not increase; expected ascending times")
        if self.until_s is not None and self.until_s <= self.from_s:
            raise ValueError(
                f"until_s = {self.until_s:g} is not after from_s = {self.from_s:g}; expected a "
                "later time"
            )
        return self


class EndSection(Section):
    """State of the body after the motion of the hand.

    Attributes
    ----------
    at_rest : bool
        Whether the body is at rest from the end of the motion on, without residual vibration.
    window_s : float, optional
        Time after the motion over which the body is at rest; by default half a period of its lowest
        natural frequency.
    sigma_m : float
        Amplitude of the residual vibration that is acceptable.
    """

    at_rest: Flag = True
    window_s: Positive | None = None
    sigma_m: Positive = 1e-4


class HandSection(Section):
    """Motion of the hand.

    Attributes
    ----------
    free : list of str
        Coordinates that may move: x, y, z of the middle of the grasped nodes (the default), and rx,
        ry, rz of the rotation vector, relative to the initial pose in world axes; none, [], beside
        a tendon or pressure.
    intervals : int
        Number of equal time intervals of the cubic spline of each coordinate.
    end_m : (3,) list, optional
        Displacement [x, y, z] of the hand at the end; nan, the default, leaves a component free.
    end_rotation_deg : (3,) list, optional
        Rotation vector [x, y, z] of the hand at the end; nan, the default, leaves a component free.
    jerk_weight : float
        Weight of the mean square jerk of the hand, in units of ten times the limit of the
        acceleration over the duration.
    joint_limits : table, optional
        Python function of position (3,) [m] and rotation (3, 3) of the hand, in CasADi operations,
        that returns expressions which must not be positive.
    """

    free: list[HandAxis] = Field(default_factory=lambda: [*AXES[:3]])
    intervals: Annotated[AtLeastOne, Field(ge=6, le=200)] = 16
    end_m: Row | None = None
    end_rotation_deg: Row | None = None
    jerk_weight: Positive = 1e-3
    joint_limits: CodeSection | None = None

    @model_validator(mode="after")
    def _require_consistent(self) -> HandSection:
        if len({*self.free}) < len(self.free):
            raise ValueError(f"free names a coordinate twice: {', '.join(self.free)}")
        for key, axes in (("end_m", AXES[:3]), ("end_rotation_deg", AXES[3:])):
            values = getattr(self, key)
            for axis, value in zip(axes, values or (), strict=False):
                if value and not np.isnan(value) and axis not in self.free:
                    raise ValueError(
                        f"{key} moves {axis}, which is not free; expected {axis} in free, or 0"
                    )
        return self


class SignalSection(Section):
    """A tension or pressure that the plan chooses."""

    name: Text
    jerk_weight: Positive = 1e-3
    range_key: ClassVar[str]
    rate_key: ClassVar[str]
    end_key: ClassVar[str]

    @property
    def range(self) -> tuple[float, float]:
        """Lowest and highest value [N, Pa]."""
        return getattr(self, self.range_key)

    @property
    def rate(self) -> float:
        """Largest rate of change [N/s, Pa/s]."""
        return getattr(self, self.rate_key)

    @property
    def end(self) -> float | None:
        """Given value at the end [N, Pa]."""
        return getattr(self, self.end_key)

    @model_validator(mode="after")
    def _require_range(self) -> SignalSection:
        low, high = self.range
        if not low < high:
            raise ValueError(
                f"{self.range_key} is [{low:g}, {high:g}]; expected the lowest value, and a higher one"
            )
        if self.end is not None and not low <= self.end <= high:
            raise ValueError(
                f"{self.end_key} = {self.end:g} is outside {self.range_key}; expected a value from "
                f"{low:g} to {high:g}"
            )
        return self


class TendonSection(SignalSection):
    """Tension of a tendon that the plan chooses.

    Attributes
    ----------
    name : str
        Name of the tendon of the recording.
    tension_n : (2,) list
        Lowest and highest tension, at least 0.
    rate_n_s : float
        Largest rate at which the tension changes.
    end_n : float, optional
        Tension at the end of the motion; free by default.
    jerk_weight : float
        Weight of the mean square third derivative of the tension, in units of 60 times the range over
        the cube of the duration: of the smoothest change over the whole range.
    """

    tension_n: tuple[NotNegative, NotNegative]
    rate_n_s: Positive
    end_n: NotNegative | None = None
    range_key, rate_key, end_key = "tension_n", "rate_n_s", "end_n"


class PressureSection(SignalSection):
    """Pressure that the plan chooses, before a lag of the recording.

    Attributes
    ----------
    name : str
        Name of the pressure of the recording.
    pressure_pa : (2,) list
        Lowest and highest pressure; negative for suction.
    rate_pa_s : float
        Largest rate at which the pressure changes.
    end_pa : float, optional
        Pressure at the end of the motion; free by default.
    jerk_weight : float
        Weight of the mean square third derivative of the pressure, in units of 60 times the range
        over the cube of the duration: of the smoothest change over the whole range.
    """

    pressure_pa: tuple[Finite, Finite]
    rate_pa_s: Positive
    end_pa: Finite | None = None
    range_key, rate_key, end_key = "pressure_pa", "rate_pa_s", "end_pa"


class AvoidSection(Section):
    """Limits of the body at the samples.

    Attributes
    ----------
    largest_stretch : float, optional
        Largest principal stretch of an element.
    clearance_m : float, optional
        Smallest distance of the body from the obstacles of the problem.
    """

    largest_stretch: AboveOne | None = None
    clearance_m: Positive | None = None


class InformationSection(Section):
    """Constants that a recording of the motion shall determine.

    Attributes
    ----------
    constants : list of str
        Estimated constants of the problem, or moduli that follow from these.
    half_width : float
        Wanted half width of the 95 % interval of each, relative to its value: 0.05 for ± 5 %.
    """

    constants: Annotated[list[Text], Field(min_length=1)]
    half_width: Positive


class Task(StatedSection):
    """task.toml: a motion to be planned.

    Attributes
    ----------
    duration_s : float
        Duration of the motion of the hand [s].
    largest_error_m : float, optional
        Largest distance of a point from its reference, and of a node from rest at the end, that is
        acceptable. If the plan exceeds it, the duration that would suffice is computed.
    shortest : bool
        Whether the duration is the shortest with which `largest_error_m`, or the half width of
        `information`, is not exceeded; all times of the references are stretched with it.
    sample_s : float, optional
        Time between the samples of the plan; that of the recording by default.
    reference : list of tables
        [[reference]] tables: what points of the body shall do.
    end : table
        State of the body at the end.
    hand : table
        Motion of the hand.
    tendon, pressure : list of tables
        [[tendon]] and [[pressure]] tables: tensions and pressures that the plan chooses; the others
        keep their values before the motion.
    avoid : table
        Limits of the body.
    information : table, optional
        Constants that a recording of the motion shall determine, in place of references; the search
        ends when their intervals are as narrow as wanted.
    costs : sequence of PathCost
        Costs that are functions of the motion, from Python alone.
    limits : sequence of PathLimit
        Limits that are functions of the motion, from Python alone.
    """

    duration_s: Positive
    largest_error_m: Positive | None = None
    shortest: Flag = False
    sample_s: Positive | None = None
    reference: list[ReferenceSection] = Field(default_factory=list)
    end: EndSection = Field(default_factory=EndSection)
    hand: HandSection = Field(default_factory=HandSection)
    tendon: list[TendonSection] = Field(default_factory=list)
    pressure: list[PressureSection] = Field(default_factory=list)
    avoid: AvoidSection = Field(default_factory=AvoidSection)
    information: InformationSection | None = None
    costs: SkipJsonSchema[tuple[InstanceOf[PathCost], ...]] = ()
    limits: SkipJsonSchema[tuple[InstanceOf[PathLimit], ...]] = ()

    @property
    def signals(self) -> list[tuple[str, int, SignalSection]]:
        """Kind, number from one, and table of each tension and pressure that the plan chooses."""
        return [
            (kind, number, each)
            for kind, tables in (("tendon", self.tendon), ("pressure", self.pressure))
            for number, each in enumerate(tables, 1)
        ]

    @model_validator(mode="after")
    def _require_purpose(self) -> Task:
        hand = self.hand
        signals = [each for _, _, each in self.signals]
        if not hand.free and not signals:
            raise InputError(
                "found []; expected coordinates that may move, or a [[tendon]] or [[pressure]] table",
                None,
                where="hand.free",
            )
        names = [each.name for each in signals]
        if twice := [name for k, name in enumerate(names) if name in names[:k]]:
            raise InputError(
                f"two tables have the name {twice[0]!r}; expected one for each tendon or pressure",
                None,
                where="tendon" if self.tendon else "pressure",
            )
        if self.information is not None:
            beside = [key for key in OF_REFERENCES if key in self.model_fields_set]
            if beside:
                raise InputError(
                    f"found {listed(beside)} beside it; expected either, because the motion is chosen "
                    "for its information alone",
                    None,
                    where="information",
                )
        if self.shortest and self.largest_error_m is None and self.information is None:
            raise InputError(
                "the shortest duration needs the error that is acceptable; expected "
                "largest_error_m",
                None,
                where="shortest",
            )
        ends = [hand.end_m, hand.end_rotation_deg, *(each.end for each in signals)]
        has_purpose = self.reference or self.information is not None or self.costs
        if not has_purpose and all(end is None for end in ends):
            raise InputError(
                "nothing to do; expected a [[reference]] table, end_m in [hand], or [information]",
                None,
                where="reference",
            )
        for number, each in enumerate(self.reference, 1):
            if each.from_s >= self.duration_s and self.end.window_s is None:
                raise InputError(
                    f"found from_s = {each.from_s:g}, but the motion ends at "
                    f"{self.duration_s:g} s; expected an earlier time",
                    None,
                    where=f"reference {number}: from_s",
                )
        return self

    @property
    def without_rest(self) -> Task:
        """The task of a body that is in equilibrium throughout."""
        return self.model_copy(update={"end": self.end.model_copy(update={"at_rest": False})})

    def stretched(self, duration_s: float) -> Task:
        """Return the task with another duration [s]: all times of its references are multiplied by
        the ratio of the durations, and velocities divided by it.
        """
        ratio = duration_s / self.duration_s

        def of_reference(each: ReferenceSection) -> ReferenceSection:
            update: dict[str, Any] = {"from_s": ratio * each.from_s}
            if each.until_s is not None:
                update["until_s"] = ratio * each.until_s
            if each.t_s is not None:
                update["t_s"] = [ratio * t for t in each.t_s]
            if each.velocity_m_s is not None:
                rows = np.array(each.velocity_m_s) / ratio
                update["velocity_m_s"] = [tuple(row) for row in rows.tolist()]
            return each.model_copy(update=update)

        references = [of_reference(each) for each in self.reference]
        return self.model_copy(update={"duration_s": duration_s, "reference": references})

    @classmethod
    @validated
    def read(cls, path: str | Path) -> Task:
        """Read task.toml and the files of its references; the file of `joint_limits` is not run.

        Raises
        ------
        InputError
            If a file is missing or has a key, column or value that is not allowed; the message
            names the file, the key or line, what was found and what was expected.
        """
        file = Path(path)
        text = read_text(file, "a task of a planned motion (TOML)", HAND_WRITTEN_BYTES)
        content = parse_toml(text, file)
        with located(file):
            task = cls(**content)
        update: dict[str, Any] = {
            "reference": [_with_values_of_file(each, file) for each in task.reference]
        }
        if task.hand.joint_limits is not None:
            code = task.hand.joint_limits
            absolute = code.model_copy(update={"file": str(file.resolve().parent / code.file)})
            update["hand"] = task.hand.model_copy(update={"joint_limits": absolute})
        return task.model_copy(update=update)


def _with_values_of_file(section: ReferenceSection, task: Path) -> ReferenceSection:
    """Return the reference with times and values of its file in place of the file."""
    if section.file is None:
        return section
    with located(path := task.parent / section.file):
        table = read_table(path)
        time = find_time(table)
        names = [name for k, name in enumerate(table.columns) if time is None or k != time[0]]
        known = (*POSITION_COLUMNS, *VELOCITY_COLUMNS)
        if unknown := [name for name in names if name not in known]:
            raise InputError(
                f"unknown column {unknown[0]}{hint_at(unknown[0], known)}; expected t_s and some of "
                f"{', '.join(known)}"
            )
        if time is None or not names:
            raise InputError(
                f"the columns are {', '.join(table.columns)}; expected t_s and some of "
                f"{', '.join(known)}"
            )
        t_s = times_in_column(table, *time)
        columns = [table.columns.index(name) for name in names]
        by_name = dict(zip(names, numeric_cells(table, columns, blank_allowed=True).T, strict=True))
    missing = np.full(len(t_s), np.nan)
    update: dict[str, Any] = {"file": None, "t_s": t_s.tolist()}
    for key, names in (("position_m", POSITION_COLUMNS), ("velocity_m_s", VELOCITY_COLUMNS)):
        if any(name in by_name for name in names):
            rows = np.column_stack([by_name.get(name, missing) for name in names])
            update[key] = [tuple(row) for row in rows.tolist()]
    return section.model_copy(update=update)


@dataclass(frozen=True, eq=False)
class Reference:
    """Reference of one point at the samples of a plan."""

    name: str  # name of the point
    place_m: Array  # (3,): place on the undeformed body [m]
    position_m: Array  # (T, 3): wanted positions; NaN where a coordinate is free
    velocity_m_s: Array  # (T, 3): wanted velocities; NaN where a component is free
    # Units of the deviations.
    sigma_m: float
    sigma_m_s: float
    waypoints: Index  # (m,): samples nearest to the stated times; all of a held point
    from_lines_m: float  # largest distance of the path from the lines between the waypoints


def point_names(task: Task) -> list[str]:
    """Return the name of the point of each reference."""
    return [
        each.point or each.name or f"point_{number}"
        for number, each in enumerate(task.reference, 1)
    ]


def point_places(task: Task, markers: Mapping[str, Array]) -> list[Array]:
    """Return the place (3,) [m] of the point of each reference on the undeformed body.

    Raises
    ------
    InputError
        For a name that is no marker, or a marker without a known place.
    """
    places = []
    for number, each in enumerate(task.reference, 1):
        where = f"reference {number}: point"
        if each.point_m is not None:
            places.append(np.array(each.point_m))
            continue
        assert each.point is not None
        if each.point not in markers:
            known = f"one of the markers {listed(markers)}" if markers else "point_m: no markers"
            hint = hint_at(each.point, markers)
            raise InputError(f"no marker {each.point!r}{hint}; expected {known}", None, where=where)
        if not np.isfinite(markers[each.point]).all():
            raise InputError(
                f"the place of the marker {each.point!r} on the body is not known; expected a run "
                "that estimated it, or point_m",
                None,
                where=where,
            )
        places.append(markers[each.point])
    return places


def sampled_references(
    task: Task, t_s: Array, places_m: list[Array], start_m: Array
) -> list[Reference]:
    """Return the references at the samples `t_s` (T,) of a plan, from 0 on.

    Parameters
    ----------
    task : Task
        Task whose references have values, see `Task.read`.
    t_s : (T,) array
        Times of the samples since the start [s].
    places_m : list of (3,) arrays
        Place of each point on the undeformed body.
    start_m : (P, 3) array
        Positions of the points before the motion [m].

    Raises
    ------
    InputError
        If the times of a reference are outside those of the plan.
    """
    references = []
    pairs = zip(task.reference, point_names(task), places_m, start_m, strict=True)
    for number, (each, name, place_m, first_m) in enumerate(pairs, 1):
        position, velocity = (np.full((len(t_s), 3), np.nan) for _ in range(2))
        until_s = np.inf if each.until_s is None else each.until_s
        counts = (t_s >= each.from_s - 1e-9) & (t_s <= until_s + 1e-9)
        waypoints, from_lines_m = np.arange(len(t_s)), 0.0
        if each.hold:
            position[counts] = first_m
        else:
            assert each.t_s is not None
            times = np.array(each.t_s)
            if times[0] < -1e-9 or times[-1] > t_s[-1] + 1e-9:
                raise InputError(
                    f"the reference runs from {times[0]:g} s to {times[-1]:g} s, but the plan from "
                    f"0 to {t_s[-1]:g} s (duration_s = {task.duration_s:g}, and a window of rest if the "
                    "end is at rest); expected times within, or a longer duration_s",
                    None,
                    where=f"reference {number}: t_s",
                )
            for rows, target in ((each.position_m, position), (each.velocity_m_s, velocity)):
                if rows is not None:
                    target[:] = _interpolated(np.array(rows), times, t_s, each.interpolation)
            waypoints = _nearest(times, t_s)
            if each.position_m and len(times) > 1:
                from_lines_m = _distance_m(position, np.array(each.position_m), times, t_s)
            if each.relative:
                position += first_m
            position[~counts] = velocity[~counts] = np.nan
        if not np.isfinite(position).any() and not np.isfinite(velocity).any():
            raise InputError(
                "no coordinate of the reference counts at any sample of the plan; expected values "
                f"at times from {t_s[0]:g} s to {t_s[-1]:g} s, from_s and until_s included",
                None,
                where=f"reference {number}",
            )
        references.append(
            Reference(
                name,
                place_m,
                position,
                velocity,
                each.sigma_m,
                each.sigma_m_s,
                waypoints,
                from_lines_m,
            )
        )
    return references


def require_reachable_starts(
    task: Task, references: list[Reference], start_m: Array, size_m: float
) -> None:
    """Raise an `InputError` for a reference that no plan can follow: it begins farther from the
    resting point than the task's largest error, or is many bodies away.

    Parameters
    ----------
    start_m : (P, 3) array
        Positions of the points before the motion [m].
    size_m : float
        Largest extent of the body [m].
    """
    for number, (each, first_m) in enumerate(zip(references, start_m, strict=True), 1):
        away_m = np.linalg.norm(np.nan_to_num(each.position_m - first_m), axis=1)
        resting = f"the point rests at {np.round(first_m, 4).tolist()} m"
        if away_m.max(initial=0.0) > MOST_BODIES * size_m:
            raise InputError(
                f"found positions {away_m.max():.4g} m away from where {resting}, of a body of "
                f"{size_m:.2g} m; expected metres: are these millimetres?",
                None,
                where=f"reference {number}: position_m",
            )
        if task.largest_error_m is not None and away_m[0] > task.largest_error_m:
            raise InputError(
                f"the reference begins {away_m[0]:.4g} m away, but {resting}, and the largest error "
                f"is to be {task.largest_error_m:g} m; expected a path that begins there, relative = "
                "true for positions relative to that, or a later from_s",
                None,
                where=f"reference {number}: position_m",
            )


def _interpolated(values: Array, times: Array, t_s: Array, kind: str) -> Array:
    """Return values (m, 3) at `times` (m,) at the samples `t_s` (T,), NaN outside the times and
    next to missing values; with the kind "none" at the samples nearest to the times alone.
    """
    result = np.full((len(t_s), 3), np.nan)
    if kind == "none" or len(times) == 1:
        result[_nearest(times, t_s)] = values
        return result
    inside = np.flatnonzero((t_s >= times[0] - 1e-9) & (t_s <= times[-1] + 1e-9))
    for axis in range(3):
        known = np.isfinite(values[:, axis])
        if not known.any():
            continue
        at, stated, x = times[known], values[known, axis], t_s[inside]
        result[inside, axis] = (
            PchipInterpolator(at, stated)(x)
            if kind == "smooth" and len(at) > 1
            else np.interp(x, at, stated)
        )
        # A coordinate is free between two times of which one has no value.
        left = np.clip(np.searchsorted(times, t_s[inside] + 1e-9) - 1, 0, len(times) - 1)
        right = np.minimum(left + (t_s[inside] > times[left] + 1e-9), len(times) - 1)
        result[inside[~(known[left] & known[right])], axis] = np.nan
    return result


def _nearest(times: Array, t_s: Array) -> Index:
    return np.abs(t_s[:, None] - times).argmin(axis=0)


def _distance_m(path_m: Array, waypoints_m: Array, times: Array, t_s: Array) -> float:
    """Return the largest distance of a path (T, 3) from the lines between its waypoints (m, 3)."""
    after = np.clip(np.searchsorted(times, t_s), 1, len(times) - 1)
    begins_m = waypoints_m[after - 1]
    off_m, way_m = np.nan_to_num(path_m - begins_m), np.nan_to_num(waypoints_m[after] - begins_m)
    share = np.sum(off_m * way_m, axis=1) / np.maximum(np.sum(way_m**2, axis=1), 1e-300)
    return float(np.linalg.norm(off_m - np.clip(share, 0, 1)[:, None] * way_m, axis=1).max())
