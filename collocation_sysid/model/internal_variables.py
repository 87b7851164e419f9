"""Internal (history) variables along a motion: those of the material's memory and those of forces.

A history holds the internal variables at all evaluations of a motion. It inserts them into the
forces, and provides their derivatives forward and backward in time. A previous state holds them at
one time and advances them step by step, in time-marching methods. Use `histories_of_trajectory` for
a whole motion; use `start_states` and `advance_states` for time marching.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ..common.array_types import Array
from .force_internal_variables import ForceHistory, ForcePreviousState
from .forces import Forces
from .viscoelasticity import MemoryHistory, MemoryState

AnyHistory = MemoryHistory | ForceHistory
PreviousState = MemoryState | ForcePreviousState


def histories_of_trajectory(
    forces: Forces,
    states: tuple[Array, Array],
    until_next_s: Array,
    loaded_s: float,
    previous_states: Mapping[int, Array],
) -> tuple[AnyHistory, ...]:
    """Return the internal variables along a motion: of the memory, if the body has one, then of
    each force with internal variables, in the order of the forces.

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
    previous_states : mapping
        Given internal variables of the previous evaluation, by the index of the history in the
        result; those that are not given are computed from the states.
    """
    collected = list[AnyHistory]()
    xi, nu = states
    since_s = np.append(0.0, until_next_s[:-1])
    if forces.body.has_memory:
        collected.append(
            MemoryHistory.from_states(
                forces.body,
                xi,
                theta=forces.theta,
                until_next_s=until_next_s,
                loaded_s=loaded_s,
                previous_variables=previous_states.get(0),
            )
        )
    for number in forces.terms_with_internal_variables:
        before = previous_states.get(len(collected))
        collected.append(
            ForceHistory.from_states(forces, number, xi=xi, nu=nu, since_s=since_s, before=before)
        )
    return tuple(collected)


def start_states(forces: Forces, x: Array, v: Array, loaded_s: float) -> tuple[PreviousState, ...]:
    """Return the internal variables in the start state: positions x [m] and velocities v [m/s],
    (3n,) each.

    The memory comes first, then each force with internal variables, in the order of the forces.
    Without any, the tuple is empty.

    Parameters
    ----------
    x, v : (3n,)
    loaded_s : float
        Time for which the body has been in its start shape; infinite if its memory has relaxed.
    """
    states: list[PreviousState] = [
        ForcePreviousState.from_state(forces, number, x=x, v=v)
        for number in forces.terms_with_internal_variables
    ]
    if forces.body.has_memory:
        states.insert(
            0, MemoryState.at_start(forces.body, x, theta=forces.theta, loaded_s=loaded_s)
        )
    return tuple(states)


def insert_previous_states(
    forces: Forces, previous_states: Sequence[PreviousState], interval_s: float
) -> Forces:
    """Return the forces in a state that follows the previous states after an interval; the argument
    itself if there are no previous states.

    Parameters
    ----------
    forces : Forces
        Forces at the later time alone; not modified.
    previous_states : sequence
        Internal variables at the previous time.
    interval_s : float
        Interval [s].
    """
    for each in previous_states:
        forces = each.insert_after_interval(forces, interval_s)
    return forces


def advance_states(
    forces: Forces, previous_states: Sequence[PreviousState], x: Array, v: Array, interval_s: float
) -> tuple[PreviousState, ...]:
    """Return the internal variables in a state that follows the previous states after an interval,
    in the order of `previous_states`; no argument is modified.

    Parameters
    ----------
    forces : Forces
        Forces at the later time alone.
    previous_states : sequence
        Internal variables at the previous time.
    x, v : (3n,)
        Positions [m] and velocities [m/s] at the later time.
    interval_s : float
        Interval [s].
    """
    return tuple(each.advance(forces, x, v=v, interval_s=interval_s) for each in previous_states)
