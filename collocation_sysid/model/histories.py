"""Internal (history) variables along a motion: those of the material's memory and those of forces.

A history holds the internal variables at all evaluations of a motion. It inserts them into the
forces, and provides their derivatives forward and backward in time. A previous state holds them at
one time and advances them step by step, in time-marching methods. Use `histories` for a whole
motion; use `left_at_start` and `following` for time marching.
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
    """Return the internal variables along a motion: of the memory, then of each force.

    Parameters
    ----------
    forces : Forces
        Forces at the N evaluations.
    states : (xi, nu), (N, 3n) each
        Positions [m] and velocities [m/s] at the evaluations, the first of which is the start.
    until_next_s : (N,)
        Time from each evaluation to the next.
    loaded_s : float
        Time for which the body has been in its start shape; infinite if its memory has relaxed.
    brought : mapping
        Given internal variables of the previous evaluation, by the index of the history in the
        result; those that are not given are computed from the states.
    """
    collected = list[AnyHistory]()
    xi, nu = states
    since_s = np.append(0.0, until_next_s[:-1])
    if forces.body.remembers:
        collected.append(
            History.of(forces.body, xi, forces.theta, until_next_s, loaded_s, brought.get(0))
        )
    for number in forces.carrying:
        before = brought.get(len(collected))
        collected.append(ForceHistory.of(forces, number, xi, nu, since_s, before))
    return tuple(collected)


def onto(forces: Forces, along: Sequence[AnyHistory], rows: slice) -> Forces:
    """Return the forces of some evaluations with the internal variables of the histories.

    Parameters
    ----------
    forces : Forces
        Forces at the evaluations `rows`.
    along : sequence of histories
    rows : slice
        Indices of the evaluations.
    """
    for history in along:
        forces = history.onto(forces, rows)
    return forces


def left_at_start(forces: Forces, x: Array, v: Array, loaded_s: float) -> tuple[AnyLeft, ...]:
    """Return the internal variables in the start state: positions x and velocities v, (3n,) each.

    The memory comes first, then each force with internal variables, in the order of the forces.
    """
    states: list[AnyLeft] = [Left.of(forces, number, x, v) for number in forces.carrying]
    if forces.body.remembers:
        states.insert(0, Remembered.at_start(forces.body, x, forces.theta, loaded_s))
    return tuple(states)


def ahead(forces: Forces, left: Sequence[AnyLeft], interval_s: float) -> Forces:
    """Return the forces in a state that follows the previous states after an interval [s].

    Parameters
    ----------
    forces : Forces
        Forces at one time.
    left : sequence
        Internal variables at the previous time.
    interval_s : float
    """
    for each in left:
        forces = each.ahead(forces, interval_s)
    return forces


def following(
    forces: Forces, left: Sequence[AnyLeft], x: Array, v: Array, interval_s: float
) -> tuple[AnyLeft, ...]:
    """Return the internal variables in a state (x, v), (3n,) each, one interval later."""
    return tuple(each.following(forces, x, v, interval_s) for each in left)
