"""Custom sensors: instruments whose reading is an expression of body points or of a grasp's
force.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any, ClassVar, Self

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..common.array_types import Array
from ..common.checked_arrays import (
    float_array,
    read_only_floats,
    unconverted,
    unconverted_or_none,
    unconverted_sigma,
)
from ..common.declarations import declaration, identity, key
from ..common.files import reason
from ..common.schema_tables import Noise, Vector
from ..common.validated_types import AtLeastOne, Positive, PositivePerSample, Text
from ..errors import InputError
from ..fem.body import Body
from ..fem.laws.constants import unit_of, without_unit
from .deviation import Deviation
from .measurement import Measurement, checked_ratios, split_sigma
from .nuisance import GAUGE, SPECIMEN_FACTORS
from .poses import Frame
from .sample_times import first_unordered_time

# Values of a custom sensor as its function returns them.
SensorValues = ca.SX | ca.DM | float | Sequence[ca.SX | ca.DM | float]


@dataclass(frozen=True)
class PointQuantities:
    """Motion of the points of a custom sensor at the time of a sample, for its prediction.

    They are CasADi expressions, or numbers where a sensor is checked.

    Attributes
    ----------
    t_s : expression
        Time of the sample.
    position_m, velocity_m_s, acceleration_m_s2 : (3, P) expressions
        Motion of the P points in the world, one column per point.
    """

    t_s: ca.SX
    position_m: ca.SX
    velocity_m_s: ca.SX
    acceleration_m_s2: ca.SX


@dataclass(frozen=True)
class GraspQuantities:
    """Force and torque of the grasp of a custom sensor at the time of a sample, for its prediction.

    They are CasADi expressions, or numbers where a sensor is checked.

    Attributes
    ----------
    t_s : expression
        Time of the sample.
    force_n, torque_nm : (3,) expressions
        Force and torque that the grasp exerts on the body, in the sensor's frame and about its
        origin.
    """

    t_s: ca.SX
    force_n: ca.SX
    torque_nm: ca.SX


def stack_values(values: SensorValues) -> ca.SX:
    """Return the values of a custom sensor as a column; a matrix column after column."""
    stacked = ca.vertcat(*values) if isinstance(values, Sequence) else values
    return ca.vec(ca.SX(stacked))


class CustomSensor(Measurement):
    """Sensor of a few points of the body, or of a grasp: base class of `Gauge` and of sensors of
    other packages.

    A subclass is a frozen dataclass with keyword arguments, compared by identity, with the
    attributes below as fields or class attributes.

    Attributes
    ----------
    name, t_s, values, sigma, points_m, unknowns, grasp, frame, columns, unit
        See `Gauge`; all but the first four have a default.
    predict : callable
        ``predict(at, **unknowns) -> numbers``, the `expression` of `Gauge` as a method.
    """

    description_name: ClassVar[str] = "reading"
    measurement_text: ClassVar[str] = "readings"
    other_text: ClassVar[str] = "sensor readings"
    noise_key: ClassVar[str] = "sigma of the readings"
    # Ending of the files that a simulation writes.
    suffix: ClassVar[str] = ".csv"

    name: str
    t_s: Array
    values: Array | None
    sigma: float
    points_m: ArrayLike = ()
    unknowns: Mapping[str, float] = MappingProxyType({})
    grasp: int | None = None
    frame: Frame = "grasp"
    columns: Sequence[str] = ()
    predict: Callable[..., SensorValues]

    def __post_init__(self) -> None:
        """Store `values` (S, m) and `columns`: the name, with _1, _2, … if m > 1."""
        where = f"the reading '{self.name}'"
        vars(self)["unknowns"] = self.unknowns or {}
        times = read_only_floats(self.t_s, (None,), name=f"t_s of {where}")
        points = float_array(self.points_m, f"points_m of {where}", ((0,), (None, 3)))
        points = read_only_floats(points.reshape(-1, 3), (None, 3), name=f"points_m of {where}")
        if not len(times):
            raise InputError(f"t_s of {where} is empty; expected at least one time")
        vars(self).update(t_s=times, points_m=points)
        if fault := first_unordered_time(times):
            raise InputError(f"{fault[1]} in t_s of {where}", where=f"row {fault[0] + 1}")
        if (self.grasp is None) == (not len(points)):
            both = "both points_m and grasp" if len(points) else "neither points_m nor grasp"
            raise InputError(
                f"{where} has {both}; expected exactly one of them, as the measured quantity"
            )
        count = self._count_of_values()
        names = [f"{self.name}_{k + 1}" for k in range(count)] if count > 1 else [self.name]
        vars(self).update(
            values=None if self.values is None else self._checked_values(self.values, count),
            columns=tuple(self.columns or names),
            _value_count=count,
        )

    def _checked_values(self, measured: ArrayLike, count: int) -> Array:
        """Return the measured values as a read-only array (S, m), NaN where missing."""
        where = f"the reading '{self.name}'"
        samples = len(self.sample_times_s)
        columns = float_array(
            measured, f"values of {where}", ((samples,), (samples, None)), finite=False
        )
        columns = columns[:, None] if columns.ndim == 1 else columns
        values = read_only_floats(columns, (samples, None), name=f"values of {where}", finite=False)
        if np.isinf(values).any():
            raise InputError(f"{where} holds an infinite value; expected numbers, NaN if missing")
        if not np.isfinite(values).any():
            raise InputError(f"all values of {where} are missing; remove it, or check its file")
        if values.shape[1] != count:
            raise InputError(
                f"the expression of {where} gives {count} numbers; expected {values.shape[1]}, as "
                "many as its values have columns"
            )
        return values

    def __repr__(self) -> str:
        samples = len(self.sample_times_s)
        count = self.measured_values.shape[1]
        return f"{type(self).__name__}({self.name!r}: {samples} samples of {count})"

    @property
    def sample_times_s(self) -> Array:
        return np.asarray(self.t_s)

    @property
    def measured_values(self) -> Array:
        """(S, m) measured values, NaN where missing; zeros if none were given."""
        if self.values is None:
            return np.zeros((len(self.sample_times_s), vars(self)["_value_count"]))
        return np.asarray(self.values)

    @property
    def title(self) -> str:
        return self.name

    @property
    def samples_text(self) -> str:
        return f"'{self.name}'"

    @property
    def value_sigmas(self) -> Array:
        return np.full(self.measured_values.shape[1], self.sigma)

    @property
    def is_measured(self) -> NDArray[np.bool_]:
        """(S, m) whether each value is measured."""
        return np.isfinite(self.measured_values)

    def with_samples(self, t_s: ArrayLike, values: ArrayLike | None) -> Self:
        changes = {} if self.sigma_ratios is None else {"sigma_ratios": self._ratios_for(t_s)}
        return replace(self, t_s=t_s, values=values, **changes)

    def simulated_text(self, experiment: Any, positions_m: Array) -> str | None:
        """Return the content of the file that a simulation with the motion (T, n, 3) [m] of an
        experiment writes; None for a table of the simulated numbers.
        """
        return None

    # Its unknowns -----------------------------------------------------------------------------

    def unknown_label(self, name: str) -> str:
        """Return the label of an unknown, with its unit."""
        return f"{without_unit(name)} of {self.name} [{unit_of(name) or '1'}]"

    def unknown_rows(self, experiment: Any) -> Iterator[tuple[Deviation, str, float]]:
        """Yield row, label and prior standard deviation of each unknown in an experiment. Unknowns
        with the same label are shared by all sensors of the experiment that have them.
        """
        for name, sigma in self.unknowns.items():
            yield SPECIMEN_FACTORS.get(name, GAUGE), self.unknown_label(name), sigma

    def other_views(self, experiment: Any) -> Iterator[tuple[str, Self]]:
        """Yield sensors of the same kind at other places that a check compares, each after a
        phrase; a sensor that is attached to the body has none.
        """
        return iter(())

    # The expression ---------------------------------------------------------------------------

    @property
    def quantities(self) -> type[PointQuantities | GraspQuantities]:
        """Class of the quantities of which the expression is a function."""
        return PointQuantities if self.grasp is None else GraspQuantities

    def read(self, t_s: ca.SX, inputs: Sequence[ca.SX], unknowns: Sequence[ca.SX]) -> ca.SX:
        """Evaluate the expression of the sensor.

        Parameters
        ----------
        t_s : SX
            Time of the sample.
        inputs : sequence of SX
            Position, velocity and acceleration (3, P) of its points, or force and torque (3,) of
            its grasp.
        unknowns : sequence of SX
            Values of the sensor's unknowns, in the order of `unknowns`.

        Returns
        -------
        (m,) SX
            Predicted numbers.
        """
        named = dict(zip(self.unknowns, unknowns, strict=True))
        read = self.predict(self.quantities(t_s, *inputs), **named)
        if read is None:
            raise TypeError("the function returns None")
        return stack_values(read)

    def _count_of_values(self) -> int:
        """Return the number m of values, at rest or with force and torque of ones."""
        points = np.asarray(self.points_m).T
        zero_rates = np.zeros_like(points)
        of_points = [points, zero_rates, zero_rates]
        rest = of_points if self.grasp is None else [np.ones(3), np.ones(3)]
        observables = [ca.SX.sym("c", *np.atleast_2d(np.transpose(each)).T.shape) for each in rest]
        t_s = ca.SX.sym("t_s")
        own = ca.SX.sym("own", len(self.unknowns))
        names = [each.name for each in fields(self.quantities)]
        try:
            read = self.read(t_s, observables, unknowns=ca.vertsplit(own) if self.unknowns else [])
        except (Exception, SystemExit) as error:
            raise InputError(
                f"the reading '{self.name}' cannot be evaluated ({reason(error)}); expected a "
                f"function of an argument `at` with the attributes {', '.join(names)}, and "
                f"of its unknowns {', '.join(self.unknowns) or '(none)'}, in CasADi operations, such "
                "as ca.if_else in place of if"
            ) from error
        u = ca.veccat(*observables, own)
        slopes = ca.Function("slopes", [t_s, u], [read, ca.jacobian(read, u)])
        at_rest = np.concatenate([*(each.ravel("F") for each in rest), np.zeros(own.numel())])
        if not all(np.isfinite(e.full()).all() for e in slopes(self.sample_times_s[0], at_rest)):
            raise InputError(
                f"the reading '{self.name}' or its derivative is not finite for the body at rest; "
                "expected a smooth expression, such as sqrt(v·v + 1e-12) in place of |v|"
            )
        return read.numel()


class FollowingSensor(CustomSensor):
    """Custom sensor whose samples refer to different nodes of the body, which follow the estimates,
    such as the face that a fixed laser beam hits: base class of such sensors of other packages.

    `predict` is a function of the motion of P nodes, and smooth as long as they are the same;
    `points_m` are P points with which it is checked before there is a body.
    """

    @abstractmethod
    def nodes_of_samples(self, body: Body, positions_m: Array) -> NDArray[np.integer]:
        """Return the nodes (s, P) to which the first s samples refer.

        Parameters
        ----------
        body : Body
            Has the boundary triangles as `body.mesh.surface`.
        positions_m : (s, n, 3) array
            Nodes at the times of the samples [m].
        """


@declaration
class Gauge(CustomSensor):
    """A custom sensor: its reading is an expression of a few points of the body, or of a grasp.

    Parameters
    ----------
    name : str
    expression : callable
        ``expression(at, **unknowns) -> numbers``, of `PointQuantities` or, for a sensor at a grasp,
        `GraspQuantities`, and of the sensor's unknowns, in CasADi operations; one number, or a
        column of m. It must be smooth, as ``ca.tanh`` is in contrast to ``ca.fmin``.
    t_s : (S,) array
        Sample times, ascending, at any rate; samples outside the times of the experiment are
        ignored, and their predictions are NaN.
    values : (S,) or (S, m) array, or None
        Measured values; NaN where missing. None before they are measured or simulated: such a
        sensor can be simulated, but a problem that contains it cannot be solved.
    sigma : float, (S,) or (S, m) array
        Standard deviation of the noise of each measured number, in the unit of that number: one for
        all, one for each sample, or one for each number. An array is stored as its median, and as
        the ratios to it, `sigma_ratios`.
    points_m : (P, 3) array, optional
        Points [x, y, z] on the undeformed body whose motion the sensor measures.
    unknowns : mapping of name to float
        Prior standard deviation of each unknown of the sensor, by the name of the argument of the
        function; no unknowns by default. The prior mean is zero: write an unknown factor as ``1 +
        gain``. In a simulation all unknowns are zero.
    grasp : int, optional
        In place of points: the number of the grasp, counted from 1, whose force and torque the
        sensor measures; obstacles count after the grasps.
    frame : {"grasp", "world"}
        Axes and origin of force and torque. "grasp": those of the undeformed body, which move with
        the grasp. "world": those of the world frame of the poses.
    columns : sequence of str, optional
        Columns of the file with the measured numbers, in the order in which the function returns
        them; by default all except t_s.
    unit : str
        Unit of the numbers, for the terminal, reports and figures.

    Raises
    ------
    InputError
        If shapes disagree, time does not increase, nothing is measured, a standard deviation is not
        above zero, or the expression cannot be evaluated or is not smooth at rest.
    """

    name: str
    expression: Callable[..., SensorValues]
    t_s: Array = key(converter=unconverted)
    values: Array | None = key(converter=unconverted_or_none)
    sigma: float = key(Noise, converter=unconverted_sigma, accepted=PositivePerSample)
    points_m: Array = key(list[Vector], converter=unconverted, default=())
    unknowns: Mapping[str, float] = key(dict[str, Positive], default_factory=dict)
    grasp: int | None = key(AtLeastOne | None, converter=identity, default=None)
    frame: Frame = key(Frame, default="grasp")
    columns: Sequence[str] = key(list[Text], converter=identity, default=())
    unit: str = key(str, default="")
    sigma_ratios: Array | None = key(converter=unconverted_or_none, default=None)

    def __post_init__(self) -> None:
        super().__post_init__()
        where = f"the reading '{self.name}'"
        shape = self.measured_values.shape
        if np.ndim(self.sigma):
            known = np.ones(shape, bool) if self.values is None else self.is_measured
            sigma, ratios = split_sigma(self.sigma, known, f"sigma of {where}")
            vars(self).update(sigma=sigma, sigma_ratios=ratios)
        if self.sigma_ratios is not None:
            vars(self)["sigma_ratios"] = checked_ratios(self.sigma_ratios, shape, where)

    def predict(
        self, at: PointQuantities | GraspQuantities, **unknowns: ca.SX | float
    ) -> SensorValues:
        """Return the value of the function."""
        return self.expression(at, **unknowns)
