"""What drives a body from within: an energy c(t) S(x), S being a scalar of its shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Generic, Protocol, Self, TypeVar

from ..arrays import Array
from ..errors import InputError
from ..fem.length import Length
from ..fem.volume import Volume
from .course import Course

if TYPE_CHECKING:
    from ..fem.body import Body

S = TypeVar("S", Length, Volume)


@dataclass(frozen=True, eq=False)
class Placed(Generic[S]):
    """A scalar of the shape of a body."""

    body: Body
    measure: S


def measured(placed: Placed[S] | None, name: str) -> S:
    """The scalar of what has been placed on a body."""
    if placed is None:
        raise InputError(f"{name} is not on a body yet; expected one of an experiment")
    return placed.measure


class Actuator(Protocol):
    """A tendon or a pressure; what is stated of it may be off by a factor and an amount."""

    @property
    def name(self) -> str:
        """For messages and reports."""
        ...

    unit: ClassVar[str]  # of the tension or pressure

    @property
    def course(self) -> Course:
        """The tension or pressure as stated."""
        ...

    @property
    def measure(self) -> Length | Volume:
        """S, on a body."""
        ...

    @property
    def off(self) -> tuple[float, float]:
        """Factor, and what is lost."""
        ...

    def on(self, body: Body) -> Self:
        """The same on a body."""
        ...

    def off_by(self, factor: float, lost: float) -> Self:
        """The same with other ones."""
        ...

    def amplitude(self, t_s: Array) -> Array:
        """C at the times `t_s` (T,)."""
        ...

    def slopes(self, t_s: Array) -> Array:
        """Its derivatives (T, 2) by the factor and by what is lost."""
        ...
