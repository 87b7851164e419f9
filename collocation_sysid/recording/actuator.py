"""What drives a body from within: an energy c(t) S(x), S being a scalar of its shape."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Self, TypeVar

from ..arrays import Array
from ..errors import InputError
from ..fem.shape import Length, Volume
from .loads import Course

if TYPE_CHECKING:
    from ..fem.body import Body

S = TypeVar("S", Length, Volume)


@dataclass(frozen=True, eq=False)
class Placed(Generic[S]):
    """A scalar of the shape of a body."""

    body: Body
    measure: S


class Actuator(ABC, Generic[S]):
    """A tendon or a pressure; what is stated of it may be off by a factor and an amount.

    Attributes
    ----------
    name : str
        For messages and reports.
    t_s : (m,) or None
    course : Course
        The tension or pressure as stated.
    factor : float
    placed : Placed, optional
        S, on a body.
    """

    name: str
    t_s: Array | None
    factor: float
    placed: Placed[S] | None
    course: Course
    __dataclass_fields__: ClassVar[dict[str, Any]]

    unit: ClassVar[str]  # of the tension or pressure
    lost: ClassVar[str]  # the field of what is lost

    def on(self, body: Body) -> Self:
        """The same on a body.

        Raises
        ------
        InputError
            If it does not fit there.
        """
        if self.placed is not None and self.placed.body is body:
            return self
        return replace(self, placed=Placed(body, self._measure_on(body)))

    @abstractmethod
    def _measure_on(self, body: Body) -> S:
        """S of a body."""

    @property
    def measure(self) -> S:
        """S, on a body."""
        if self.placed is None:
            raise InputError(f"{self.name} is not on a body yet; expected one of an experiment")
        return self.placed.measure

    @property
    def off(self) -> tuple[float, float]:
        """Factor, and what is lost."""
        return self.factor, getattr(self, self.lost)

    def off_by(self, factor: float, lost: float) -> Self:
        """The same with other ones."""
        return replace(self, factor=factor, **{self.lost: lost})

    @abstractmethod
    def driven(self, stated: Any, factor: Any, lost: Any) -> Any:
        """C of a tension or pressure as stated, of numbers, arrays or CasADi's expressions."""

    def amplitude(self, t_s: Array) -> Array:
        """C at the times `t_s` (T,)."""
        return self.driven(self.course.at(t_s), *self.off)
