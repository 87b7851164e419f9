"""Loads besides the body's own weight: point masses and forces, and their course over time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from ..common.array_types import Array, Index
from ..common.checked_arrays import as_array, float_array, read_only_floats
from ..common.declarations import Key, declaration, key
from ..common.schema_tables import Vector
from ..common.validated_types import Finite, Positive, Text
from ..errors import InputError
from ..fem.meshes.selection import Selection
from .node_selection import Nodes, node_converter, select_on_body, selection_from_section
from .sample_times import TIME_TOLERANCE_S, first_unordered_time
from .time_tables import read_forces

if TYPE_CHECKING:
    from ..fem.body import Body

# The times of a load that can be estimated.
LoadTime = Literal["from_s", "until_s"]


@dataclass(frozen=True, eq=False)
class TimeSeries:
    """Values that change over time, linearly between samples, or a constant value.

    Parameters
    ----------
    values : (...) or (m, ...) array
        One value, or a row for each time. Stored as (m, ...), with m = 1 for one value.
    t_s : (m,) array, optional
        Sample times, ascending; None for a constant.
    what : str
        Key and owner of the values, for messages.
    shape : tuple of int
        Shape of a value.

    Raises
    ------
    InputError
        If shapes disagree, a value is not finite, time does not increase, or several rows have no
        times.
    """

    values: Array
    t_s: Array | None

    def __init__(
        self, values: ArrayLike, t_s: ArrayLike | None, what: str, shape: tuple[int, ...] = ()
    ) -> None:
        rows = float_array(values, what, (shape, (None, *shape)))
        rows = read_only_floats(rows.reshape(-1, *shape), (None, *shape), name=what)
        if t_s is None and len(rows) != 1:
            raise InputError(f"{len(rows)} rows of {what} without times; expected t_s")
        if t_s is not None:
            t_s = read_only_floats(t_s, (len(rows),), name=f"t_s of {what}")
            if fault := first_unordered_time(t_s):
                raise InputError(f"{what}: {fault[1]}", where=f"row {fault[0] + 1}")
        vars(self).update(values=rows, t_s=t_s)

    def values_at(self, t_s: ArrayLike) -> Array:
        """Return scalar values (T,) at the times (T,) [s], linear between samples; outside the
        samples the value of the first or last one. The values must be scalars.
        """
        times = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        if self.t_s is None:
            return np.full(len(times), self.values[0])
        return np.interp(times, self.t_s, self.values)

    def require_covered(self, t_s: Array, name: str) -> None:
        """Raise an `InputError` if the samples do not cover the times `t_s` (T,) of a recording, up
        to `TIME_TOLERANCE_S`; a constant covers all.

        Parameters
        ----------
        t_s : (T,) array
            Ascending; only the first and the last are compared.
        name : str
            What the values belong to, for the message.
        """
        if self.t_s is None:
            return
        (first, last) = self.t_s[[0, -1]]
        (start, end) = t_s[[0, -1]]
        if first > start + TIME_TOLERANCE_S or last < end - TIME_TOLERANCE_S:
            raise InputError(
                f"{name} is given from {first:.6g} s to {last:.6g} s, but the recording lasts "
                f"from {start:.6g} s to {end:.6g} s; expected rows over all of it, on the same "
                "clock: add rows or narrow window_s"
            )


def smooth_ramp(time_steps: Any) -> Any:
    """Return a smooth ramp from 0 at u ≤ −1 to 1 at u ≥ 1, with a continuous derivative, for u =
    `time_steps`: an array or a CasADi expression.

    The derivative is a hat function, so that the sum over an even grid with unit spacing is the
    remaining length after u = 0, wherever u = 0 lies between grid points.
    """
    return (abs(time_steps) < 1) * (0.5 + time_steps - 0.5 * time_steps * abs(time_steps)) + (
        time_steps >= 1
    )


class Load:
    """Something that acts on nodes of a body during a time window: base class of `PointMass` and
    `Force`.

    Attributes
    ----------
    nodes : (k,) int array or Selection
    from_s, until_s : float
        First and last time [s]; infinite where unlimited.
    description_name : str
        Kind of the load, for messages.
    """

    nodes: Index
    from_s: float
    until_s: float
    description_name: ClassVar[str]
    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __post_init__(self) -> None:
        if not self.from_s < self.until_s:
            raise InputError(
                f"a {self.description_name} acts from {self.from_s:g} s until {self.until_s:g} s; "
                "expected from_s < until_s"
            )
        if isinstance(self.nodes, Selection):
            vars(self)["selection"] = self.nodes

    def on_body(self, body: Body) -> Self:
        """Return the load with its selection replaced by the selected nodes of a body; self if it
        has node indices already.
        """
        nodes = select_on_body(self.nodes, body)
        return self if nodes is self.nodes else replace(self, nodes=nodes)


@declaration
class PointMass(Load):
    """A rigid point mass tied to nodes: inertia and weight.

    Like all moving mass it is subject to mass-proportional damping γ_m.

    Parameters
    ----------
    nodes : (k,) int array or Selection
        Nodes that carry the mass in equal parts, selected as in a grasp.
    mass_kg : float
    from_s : float
        Time at which the mass is attached to the body [s], with the uncertainty nuisance.joining;
        by default it is attached before the recording.
    until_s : float
        Time at which the mass is removed from the body [s], with the same uncertainty; by default
        it is removed after the recording.
    selection : Selection, optional
        The selection that the nodes come from; None for node indices. On a finer mesh it is
        evaluated again.
    """

    nodes: Index = key(
        Nodes, converter=node_converter("the point mass"), read=selection_from_section
    )
    mass_kg: float = key(Positive)
    from_s: float = key(Finite | None, default=-np.inf)
    selection: Selection | None = None
    until_s: float = key(Finite | None, default=np.inf)

    description_name: ClassVar[str] = "point mass"

    def node_mass_kg(self, node_count: int) -> Array:
        """Return the mass at each of the body's n = `node_count` nodes, (n,) [kg], at full share;
        the time window is not applied, see `Experiment.share`.
        """
        mass = np.zeros(node_count)
        mass[self.nodes] = self.mass_kg / len(self.nodes)
        return mass


_TABLE = Key(
    "file",
    Text | None,
    read=read_forces,
    constant="force_n",
    description="CSV with the columns t_s, fx_n, fy_n, fz_n.",
)


def _as_rows(values: ArrayLike) -> Array:
    """Return a force (3,), or forces (T, 3), as rows."""
    return np.atleast_2d(as_array(values))


@declaration
class Force(Load):
    """A force on nodes besides gravity.

    It is constant, or linear between the rows of a table.

    Parameters
    ----------
    nodes : (k,) int array or Selection
        Nodes on which the force acts in equal parts, selected as in a grasp.
    force_n : (3,) or (m, 3) array
        Constant force [x, y, z].
    t_s : (m,) array, optional
        Times of the rows of `force_n`, where it is not constant; it is zero outside them.
    selection : Selection, optional
        The selection that the nodes come from; None for node indices. On a finer mesh it is
        evaluated again.
    from_s : float
        Time at which the force begins [s], with the uncertainty nuisance.joining; by default it
        begins before the recording.
    until_s : float
        Time at which the force ends [s], with the same uncertainty; by default it ends after the
        recording.
    """

    nodes: Index = key(Nodes, converter=node_converter("the force"), read=selection_from_section)
    force_n: Array = key(Vector | None, converter=_as_rows)
    t_s: Array | None = key(_TABLE, converter=as_array, default=None)
    selection: Selection | None = None
    from_s: float = key(Finite | None, default=-np.inf)
    until_s: float = key(Finite | None, default=np.inf)

    description_name: ClassVar[str] = "force"

    def __post_init__(self) -> None:
        super().__post_init__()
        course = TimeSeries(self.force_n, self.t_s, what="force_n", shape=(3,))
        vars(self).update(force_n=course.values, t_s=course.t_s)

    def node_forces_n(self, t_s: ArrayLike, node_count: int) -> Array:
        """Return the force on each node at the times `t_s` (T,), (T, n, 3) [N], distributed equally
        over its nodes; zero outside the samples of a force that varies.

        The window from `from_s` to `until_s` is not applied, see `Experiment.share`.
        """
        times = np.atleast_1d(np.asarray(t_s, dtype=float))
        total = np.repeat(self.force_n[:1], len(times), axis=0)
        if self.t_s is not None:
            total = np.column_stack(
                [np.interp(times, self.t_s, f, left=0.0, right=0.0) for f in self.force_n.T]
            )
        force = np.zeros((len(times), node_count, 3))
        force[:, self.nodes] = total[:, None] / len(self.nodes)
        return force
