"""All that is carried along a motion: by the material, where it remembers, and by forces.

What each of them does there is a history: it puts what evaluations bring onto their forces, and has
its columns forward and backward. At one time it is what is left, which goes on from there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..arrays import Array
from .force_history import ForceHistory, Left
from .forces import Forces
from .viscoelasticity import History, Remembered

AnyHistory = History | ForceHistory
AnyLeft = Remembered | Left


def histories(
    forces: Forces,
    states: tuple[Array, Array],
    until_next_s: Array,
    loaded_s: float,
    brought: Mapping[int, Array],
) -> tuple[AnyHistory, ...]:
    """Those of states (N, 3n), the first of which is the start.

    Parameters
    ----------
    forces : at the evaluations
    states : ξ and ν
    until_next_s : (N,) from each evaluation to the next
    loaded_s : how long the body has been in its start shape
    brought : what some of them bring, by number, where that does not follow
    """
    found, (xi, nu), since_s = list[AnyHistory](), states, np.append(0.0, until_next_s[:-1])
    if forces.body.remembers:
        known = until_next_s, loaded_s, brought.get(0)
        found.append(History.of(forces.body, xi, forces.theta, *known))
    for number in forces.carrying:
        before = brought.get(len(found))
        found.append(ForceHistory.of(forces, number, xi, nu, since_s, before))
    return tuple(found)


def onto(forces: Forces, along: Sequence[AnyHistory], rows: slice) -> Forces:
    """Forces of some evaluations with what they bring."""
    for history in along:
        forces = history.onto(forces, rows)
    return forces


def left_at_start(forces: Forces, x: Array, v: Array, loaded_s: float) -> tuple[AnyLeft, ...]:
    """What the start leaves, at x and v (3n,)."""
    found: list[AnyLeft] = [Left.of(forces, number, x, v) for number in forces.carrying]
    if forces.body.remembers:
        found.insert(0, Remembered.at_start(forces.body, x, forces.theta, loaded_s))
    return tuple(found)


def ahead(forces: Forces, left: Sequence[AnyLeft], interval_s: float) -> Forces:
    """Forces in a state an interval after what is left."""
    for each in left:
        forces = each.ahead(forces, interval_s)
    return forces


def following(
    forces: Forces, left: Sequence[AnyLeft], x: Array, v: Array, interval_s: float
) -> tuple[AnyLeft, ...]:
    """What is left in a state (3n,) an interval later."""
    return tuple(each.following(forces, x, v, interval_s) for each in left)
