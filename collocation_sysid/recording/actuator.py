"""Actuators inside a body: energies c(t) S(x) of an amplitude c and a scalar S of the body's
shape.

The calibration of an actuator is three numbers: the factor on the stated tension or pressure, its
offset (the part that is lost), and the logarithm of the ratio of its lag to the stated lag.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Generic, NamedTuple, Self, TypeVar

import casadi as ca

from ..common.array_types import Array
from ..errors import InputError
from ..fem.shape import EnclosedVolume, PolylineLength
from .loads import TimeSeries

if TYPE_CHECKING:
    from ..fem.body import Body

S = TypeVar("S", PolylineLength, EnclosedVolume)


class Calibration(NamedTuple):
    """Calibration of an actuator."""

    factor: float  # factor on the stated tension or pressure
    offset: float  # part of the tension [N] or pressure [Pa] that is lost
    log_lag_ratio: float  # logarithm of the ratio of its lag to the stated lag


@dataclass(frozen=True, eq=False)
class BodyMeasure(Generic[S]):
    """A scalar S of the shape of a given body: the length of a tendon, or a volume."""

    body: Body
    measure: S  # the scalar S of that body


class Actuator(ABC, Generic[S]):
    """A tendon or a pressure, whose stated amplitude may be wrong by a factor and an offset.

    Attributes
    ----------
    name : str
        For messages and reports.
    t_s : (m,) or None
        Times of the stated tension or pressure; None if it is constant.
    declared_values : TimeSeries
        The tension or pressure as stated.
    factor : float
        Factor on the stated tension or pressure.
    body_measure : BodyMeasure, optional
        The scalar S of a body; None before the actuator belongs to an experiment.
    """

    name: str
    t_s: Array | None
    factor: float
    body_measure: BodyMeasure[S] | None
    declared_values: TimeSeries
    __dataclass_fields__: ClassVar[dict[str, Any]]

    unit: ClassVar[str]  # unit of the tension or pressure
    offset_field: ClassVar[str]  # field of the lost part

    def on_body(self, body: Body) -> Self:
        """Return the actuator with its scalar S evaluated for a body.

        Raises
        ------
        InputError
            If the actuator does not fit this body.
        """
        if self.body_measure is not None and self.body_measure.body is body:
            return self
        return replace(self, body_measure=BodyMeasure(body, self._measure_on(body)))

    @abstractmethod
    def _measure_on(self, body: Body) -> S:
        """Return the scalar S of a body."""

    def require_measure(self) -> S:
        """Return the scalar S of the body's shape; an `InputError` if the actuator is on no body
        yet.
        """
        if self.body_measure is None:
            raise InputError(
                f"{self.name} has not been placed on a body; use the one in the tendons or "
                "pressures of an Experiment, which places it"
            )
        return self.body_measure.measure

    def make_calibration(self) -> Calibration:
        """Return the stated calibration: factor and offset of the actuator, and zero for the
        logarithm of the ratio of its lag to the stated one.
        """
        return Calibration(self.factor, offset=getattr(self, self.offset_field), log_lag_ratio=0.0)

    def with_calibration(self, factor: float, offset: float, log_lag_ratio: float) -> Self:
        """Return a copy of the actuator with another factor and offset; `log_lag_ratio` has no
        effect on an actuator without a lag.
        """
        return replace(self, factor=factor, **{self.offset_field: offset})

    def input_data(self, t_s: Array) -> Array:
        """Return the data (d, T) of which `calibrated_amplitude` is a function at the times `t_s`
        (T,): here the stated tension or pressure, d = 1.
        """
        return self.declared_values.values_at(t_s)[None]

    def calibrated_amplitude(
        self, data: ca.SX, factor: Any, offset: Any, log_lag_ratio: Any
    ) -> ca.SX:
        """Return the amplitude c for a calibration, as an expression of `input_data` (d,) at one
        time; without a lag `log_lag_ratio` is ignored. Factor and offset are as of `Calibration`,
        numbers or expressions.
        """
        return self.energy_amplitude(data, factor, offset=offset)

    @abstractmethod
    def energy_amplitude(self, declared_value: Any, factor: Any, offset: Any) -> Any:
        """Return the amplitude c for a stated tension or pressure `declared_value`, a factor on it
        and an offset that is lost: numbers, arrays or CasADi expressions.
        """

    def energy_amplitude_at(self, t_s: Array) -> Array:
        """Return the amplitude c at the times `t_s` (T,), as (T,), with the actuator's own
        calibration.
        """
        calibration = self.make_calibration()
        return self.energy_amplitude(
            self.declared_values.values_at(t_s), calibration.factor, offset=calibration.offset
        )
