"""What acts on a body besides its own weight: point masses tied to it, and forces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array, Index
from ..errors import InputError
from ..fem.selection import Selection
from .arrays import on_body, read_only_floats, some_nodes
from .clock import first_time_fault

if TYPE_CHECKING:
    from ..fem.body import Body

# The times of a load that can be estimated.
Change = Literal["from_s", "until_s"]


def ramp(u: Any) -> Any:
    """What joins around u = 0: none before −1, all after 1, with a continuous slope between.

    Its slope is a hat: whatever the time between two steps of an even grid at which it joins, the
    shares add up to the steps that are left. Of an array, or of CasADi's expressions.
    """
    return (abs(u) < 1) * (0.5 + u - 0.5 * u * abs(u)) + (u >= 1)


def _refuse_times(from_s: float, until_s: float, what: str) -> None:
    if not from_s < until_s:
        raise InputError(
            f"a {what} is there from {from_s:g} s until {until_s:g} s; expected from_s < until_s"
        )


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
    from_s, until_s : float
        When it joins the body, at the body's velocity, and leaves it; always there by default. See
        `Experiment.share`.
    selection : Selection, optional
        What selected the nodes, where something did: on a finer mesh it selects others.
    """

    nodes: Index
    mass_kg: float
    from_s: float
    until_s: float
    selection: Selection | None

    def __init__(
        self,
        nodes: ArrayLike | Selection,
        mass_kg: float,
        from_s: float = -np.inf,
        selection: Selection | None = None,
        until_s: float = np.inf,
    ) -> None:
        if not (np.isfinite(mass_kg) and mass_kg > 0):
            raise InputError(f"mass_kg of a point mass is {mass_kg:g}; expected more than 0")
        _refuse_times(from_s, until_s, "point mass")
        tied = some_nodes(nodes, "the point mass")
        chosen = tied if isinstance(tied, Selection) else selection
        vars(self).update(
            nodes=tied, mass_kg=mass_kg, from_s=from_s, until_s=until_s, selection=chosen
        )

    def on(self, body: Body) -> PointMass:
        """The same mass on the nodes of a body that are selected."""
        nodes = on_body(self.nodes, body)
        return self if nodes is self.nodes else replace(self, nodes=nodes)

    def at_nodes(self, node_count: int) -> Array:
        """Mass that each node carries, (n,) [kg]."""
        mass = np.zeros(node_count)
        mass[self.nodes] = self.mass_kg / len(self.nodes)
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
    from_s, until_s : float
        When it begins and ends to act; always by default. See `Experiment.share`.
    """

    nodes: Index
    force_n: Array
    t_s: Array | None
    selection: Selection | None
    from_s: float
    until_s: float

    def __init__(
        self,
        nodes: ArrayLike | Selection,
        force_n: ArrayLike,
        t_s: ArrayLike | None = None,
        selection: Selection | None = None,
        from_s: float = -np.inf,
        until_s: float = np.inf,
    ) -> None:
        _refuse_times(from_s, until_s, "force")
        pulled = some_nodes(nodes, "the force")
        rows = read_only_floats(np.atleast_2d(force_n), (None, 3), "force_n")
        if t_s is None and len(rows) != 1:
            raise InputError(f"{len(rows)} rows of force_n without times; expected t_s")
        if t_s is not None:
            t_s = read_only_floats(t_s, (len(rows),), "t_s of the force")
            if fault := first_time_fault(t_s):
                raise InputError(fault[1], where=f"row {fault[0] + 1}")
        chosen = pulled if isinstance(pulled, Selection) else selection
        vars(self).update(
            nodes=pulled,
            force_n=rows,
            t_s=t_s,
            selection=chosen,
            from_s=from_s,
            until_s=until_s,
        )

    def on(self, body: Body) -> Force:
        """The same force on the nodes of a body that are selected."""
        nodes = on_body(self.nodes, body)
        return self if nodes is self.nodes else replace(self, nodes=nodes)

    def at_nodes(self, t_s: ArrayLike, node_count: int) -> Array:
        """Force on each node at the times `t_s` (T,) while it acts, (T, n, 3) [N]."""
        times = np.atleast_1d(np.asarray(t_s, dtype=float))
        total = np.repeat(self.force_n[:1], len(times), axis=0)
        if self.t_s is not None:
            total = np.column_stack(
                [np.interp(times, self.t_s, f, left=0.0, right=0.0) for f in self.force_n.T]
            )
        force = np.zeros((len(times), node_count, 3))
        force[:, self.nodes] = total[:, None] / len(self.nodes)
        return force
