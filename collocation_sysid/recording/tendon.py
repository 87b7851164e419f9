"""Tendons: energies T(t) L(x) of a tension T and the length L of a polyline in the body."""

from __future__ import annotations

from dataclasses import KW_ONLY
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from ..common.array_types import Array
from ..common.checked_arrays import as_array, float_converter, point_text
from ..common.declarations import Key, declaration, key
from ..common.schema_tables import Vector
from ..common.validated_types import NotNegative, Text
from ..errors import InputError
from ..fem.shape import PolylineLength
from .actuator import Actuator, BodyMeasure
from .loads import TimeSeries
from .placement import LocatedBody
from .time_tables import read_tension

if TYPE_CHECKING:
    from ..fem.body import Body

# Largest distance of a tendon's point from the body, in mean edge lengths: coarse meshes cut arcs.
FARTHEST_POINT_EDGES = 1.0


_TABLE = Key(
    "tension",
    Text | None,
    read=read_tension,
    constant="tension_n",
    description="CSV with the columns t_s and tension_n, which covers the complete recording.",
)


@declaration
class Tendon(Actuator[PolylineLength]):
    """A cable under tension through points of the body, straight from each point to the next.

    It slides through its points without friction. A sheath needs as many points as it takes to
    follow the body; for guide rings, use the places of the rings.

    Parameters
    ----------
    points_m : (P, 3) array
        List of points [x, y, z] on the undeformed body, from base to end.
    tension_n : float or (m,) array
        Constant tension.
    t_s : (m,) array, optional
        Times of the rows of `tension_n`, between which it is linear; they cover the whole
        recording.
    name : str
        Name; tendon_1, tendon_2 and so on by default.
    factor, loss_n : float
        Tension at the body: max(0, factor · stated tension − loss_n).
    """

    points_m: Array = key(
        Annotated[list[Vector], Field(min_length=2)],
        converter=float_converter((None, 3), "points_m of the tendon"),
    )
    tension_n: Array = key(NotNegative | None, converter=as_array)
    t_s: Array | None = key(_TABLE, converter=as_array, default=None)
    name: str = key(Text | None, default="tendon")
    _: KW_ONLY
    factor: float = 1.0
    loss_n: float = 0.0
    body_measure: BodyMeasure[PolylineLength] | None = None

    unit: ClassVar[str] = "N"
    offset_field: ClassVar[str] = "loss_n"

    def __post_init__(self) -> None:
        points = self.points_m
        name = self.name
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
        tension = TimeSeries(self.tension_n, self.t_s, what=f"tension_n of {name}")
        if (tension.values < 0).any():
            row = int(np.argmax(tension.values < 0))
            raise InputError(
                f"{name}: tension_n is {tension.values[row]:g} N in row {row + 1}; expected 0 or "
                "more: a tendon only pulls"
            )
        vars(self).update(tension_n=tension.values, t_s=tension.t_s, declared_values=tension)

    def _measure_on(self, body: Body) -> PolylineLength:
        shape = LocatedBody(body.nodes_m, body)
        embedded = [shape.weights_at_point(point) for point in self.points_m]
        nodes, weights, distances = map(np.array, zip(*embedded, strict=True))
        worst = int(distances.argmax())
        if distances[worst] > FARTHEST_POINT_EDGES * shape.mean_edge_m:
            raise InputError(
                f"{self.name}: point {worst + 1} at {point_text(self.points_m[worst])} m is "
                f"{distances[worst]:.4g} m outside the body, more than the mean edge length of "
                f"{shape.mean_edge_m:.4g} m; expected points_m on the undeformed body, in metres"
            )
        return PolylineLength(nodes, weights, node_count=len(body.nodes_m))

    def energy_amplitude(self, declared_value: Any, factor: Any, offset: Any) -> Any:
        """Return the tension at the body, max(0, factor · stated − lost) [N]; 0 if 0 is stated."""
        pull = factor * declared_value - offset
        return (declared_value > 0) * (pull > 0) * pull
