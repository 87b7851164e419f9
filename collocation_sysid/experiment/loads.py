"""What acts on a body besides its own weight: point masses tied to it, and forces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array, Index
from ..errors import InputError
from ..fem.selection import Selection
from .arrays import on_body, read_only_floats, some_nodes
from .clock import TIME_TOLERANCE_S, first_time_fault

if TYPE_CHECKING:
    from ..fem.body import Body


@dataclass(frozen=True, eq=False)
class PointMass:
    """A rigid mass tied to nodes, in equal parts.

    It adds inertia and weight, and like all mass that moves it is damped by γ_m.

    Parameters
    ----------
    nodes : (k,) int array or Selection
        An experiment looks a selection up.
    mass_kg : float
        Of all nodes together.
    from_s : float
        When it joins the body; it then moves at the body's velocity. Always, by default.
    selection : Selection, optional
        What selected the nodes, where something did: on a finer mesh it selects others.
    """

    nodes: Index
    mass_kg: float
    from_s: float
    selection: Selection | None

    def __init__(
        self,
        nodes: ArrayLike | Selection,
        mass_kg: float,
        from_s: float = -np.inf,
        selection: Selection | None = None,
    ) -> None:
        if not (np.isfinite(mass_kg) and mass_kg > 0):
            raise InputError(f"mass_kg of a point mass is {mass_kg:g}; expected more than 0")
        tied = some_nodes(nodes, "the point mass")
        chosen = tied if isinstance(tied, Selection) else selection
        vars(self).update(nodes=tied, mass_kg=mass_kg, from_s=from_s, selection=chosen)

    def on(self, body: Body) -> PointMass:
        """The same mass on the nodes of a body that are selected."""
        nodes = on_body(self.nodes, body)
        return self if nodes is self.nodes else replace(self, nodes=nodes)

    def at_nodes(self, t_s: ArrayLike, node_count: int) -> Array:
        """Mass that each node carries at the times `t_s` (T,), (T, n) [kg]."""
        times = np.atleast_1d(np.asarray(t_s, dtype=float))
        mass = np.zeros((len(times), node_count))
        there = times >= self.from_s - TIME_TOLERANCE_S
        mass[np.ix_(there, self.nodes)] = self.mass_kg / len(self.nodes)
        return mass


@dataclass(frozen=True, eq=False)
class Force:
    """A force on nodes, in equal parts: constant, or linear between the rows of a table.

    Parameters
    ----------
    nodes : (k,) int array or Selection
        An experiment looks a selection up.
    force_n : (m, 3) array
        Total force [N], in the frame of the measurements.
    t_s : (m,) array, optional
        Times of the rows; the force is zero outside them. A single row without a time is constant.
    selection : Selection, optional
        What selected the nodes, where something did: on a finer mesh it selects others.
    """

    nodes: Index
    force_n: Array
    t_s: Array | None
    selection: Selection | None

    def __init__(
        self,
        nodes: ArrayLike | Selection,
        force_n: ArrayLike,
        t_s: ArrayLike | None = None,
        selection: Selection | None = None,
    ) -> None:
        pulled = some_nodes(nodes, "the force")
        rows = read_only_floats(np.atleast_2d(force_n), (None, 3), "force_n")
        if t_s is None and len(rows) != 1:
            raise InputError(f"{len(rows)} rows of force_n without times; expected t_s")
        if t_s is not None:
            t_s = read_only_floats(t_s, (len(rows),), "t_s of the force")
            if fault := first_time_fault(t_s):
                raise InputError(fault[1], where=f"row {fault[0] + 1}")
        chosen = pulled if isinstance(pulled, Selection) else selection
        vars(self).update(nodes=pulled, force_n=rows, t_s=t_s, selection=chosen)

    def on(self, body: Body) -> Force:
        """The same force on the nodes of a body that are selected."""
        nodes = on_body(self.nodes, body)
        return self if nodes is self.nodes else replace(self, nodes=nodes)

    def at_nodes(self, t_s: ArrayLike, node_count: int) -> Array:
        """Force on each node at the times `t_s` (T,), (T, n, 3) [N]."""
        times = np.atleast_1d(np.asarray(t_s, dtype=float))
        total = np.repeat(self.force_n[:1], len(times), axis=0)
        if self.t_s is not None:
            total = np.column_stack(
                [np.interp(times, self.t_s, f, left=0.0, right=0.0) for f in self.force_n.T]
            )
        force = np.zeros((len(times), node_count, 3))
        force[:, self.nodes] = total[:, None] / len(self.nodes)
        return force
