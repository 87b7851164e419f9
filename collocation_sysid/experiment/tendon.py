"""A tendon: the energy T(t) L(x) of a tension T and the length L of its polyline in the body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array
from ..errors import InputError
from ..fem.length import Length
from .actuator import Actuator, Placed
from .arrays import read_only_floats
from .course import Course
from .placement import Shape

if TYPE_CHECKING:
    from ..fem.body import Body

# Points of a tendon may be this far outside the body, in mean edge lengths.
FARTHEST = 1.0


@dataclass(frozen=True, eq=False)
class Tendon(Actuator[Length]):
    """A thread through points of a body, straight between them, under a tension.

    It slides through its points without friction. A sheath has as many points as it needs to
    follow the body; what a few rings guide has those of the rings.

    Parameters
    ----------
    points_m : (P, 3) array
        On the undeformed body, from base to end; P > 1. They may lie a little outside.
    tension_n : float or (m,) array
        Constant, or linear between the rows of a table. Not negative.
    t_s : (m,) array, optional
        Times of the rows, which must reach over the recording.
    name : str
    factor, lost_n : float
        How the tension at the body differs: max(0, factor · tension − lost).
    """

    points_m: Array
    tension_n: Array
    lost_n: float

    unit: ClassVar[str] = "N"
    lost: ClassVar[str] = "lost_n"

    def __init__(
        self,
        points_m: ArrayLike,
        tension_n: ArrayLike,
        t_s: ArrayLike | None = None,
        name: str = "tendon",
        *,
        factor: float = 1.0,
        lost_n: float = 0.0,
        placed: Placed[Length] | None = None,
    ) -> None:
        points = read_only_floats(points_m, (None, 3), f"points_m of {name}")
        if len(points) < 2:
            raise InputError(
                f"{name} has {len(points)} points_m; expected at least two, from base to end"
            )
        same = np.flatnonzero((np.diff(points, axis=0) == 0).all(axis=1))
        if same.size:
            raise InputError(
                f"{name}: the points {same[0] + 1} and {same[0] + 2} are at the same place; "
                "expected different ones, in their order from base to end"
            )
        tension = Course(tension_n, t_s, f"tension_n of {name}")
        if (tension.values < 0).any():
            row = int(np.argmax(tension.values < 0))
            raise InputError(
                f"{name}: tension_n is {tension.values[row]:g} N in row {row + 1}; expected 0 or "
                "more: a tendon only pulls"
            )
        vars(self).update(
            points_m=points,
            tension_n=tension.values,
            t_s=tension.t_s,
            course=tension,
            name=name,
            factor=factor,
            lost_n=lost_n,
            placed=placed,
        )

    def _measure_on(self, body: Body) -> Length:
        shape = Shape(body.nodes_m, body)
        found = [shape.embed(point) for point in self.points_m]
        nodes, weights, distances = (np.array(part) for part in zip(*found, strict=True))
        worst = int(distances.argmax())
        if distances[worst] > FARTHEST * shape.mean_edge_m:
            raise InputError(
                f"{self.name}: point {worst + 1} at {_triple(self.points_m[worst])} m is "
                f"{distances[worst]:.4g} m outside the body, more than the mean edge length of "
                f"{shape.mean_edge_m:.4g} m; expected points_m on the undeformed body, in metres"
            )
        return Length(nodes, weights, len(body.nodes_m))

    def driven(self, stated: Any, factor: Any, lost: Any) -> Any:
        """The tension at the body: a tendon only pulls."""
        pull = factor * stated - lost
        return (stated > 0) * (pull > 0) * pull


def _triple(point: Array) -> str:
    return f"({', '.join(f'{x:.4g}' for x in point)})"
