"""Actuators inside a body: energies c(t) S(x) of an amplitude c and a scalar S of the body's
shape.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Self, TypeVar

from ..array_types import Array
from ..errors import InputError
from ..fem.shape import EnclosedVolume, PolylineLength
from .loads import TimeSeries

if TYPE_CHECKING:
    from ..fem.body import Body

S = TypeVar("S", PolylineLength, EnclosedVolume)


@dataclass(frozen=True, eq=False)
class BodyMeasure(Generic[S]):
    """A scalar S of the shape of a given body: the length of a tendon, or a volume."""

    body: Body
    measure: S


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

    unit: ClassVar[str]  # of the tension or pressure
    offset_field: ClassVar[str]  # the field of what is lost

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

    @property
    def measure(self) -> S:
        """Scalar S of the body's shape; an `InputError` if the actuator is on no body yet."""
        if self.body_measure is None:
            raise InputError(
                f"{self.name} has not been placed on a body; use the one in the tendons or "
                "pressures of an Experiment, which places it"
            )
        return self.body_measure.measure

    @property
    def factor_and_offset(self) -> tuple[float, float]:
        """Factor on the stated tension or pressure, and its offset (the part that is lost)."""
        return self.factor, getattr(self, self.offset_field)

    def with_factor_and_offset(self, factor: float, offset: float) -> Self:
        """Return the actuator with another factor and another offset."""
        return replace(self, factor=factor, **{self.offset_field: offset})

    @abstractmethod
    def energy_amplitude(self, declared_value: Any, factor: Any, offset: Any) -> Any:
        """Return the amplitude c for a stated tension or pressure: numbers, arrays or CasADi
        expressions.
        """

    def energy_amplitude_at(self, t_s: Array) -> Array:
        """Return the amplitude c at the times `t_s` (T,), as (T,)."""
        return self.energy_amplitude(self.declared_values.values_at(t_s), *self.factor_and_offset)
