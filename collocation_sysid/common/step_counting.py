"""Completed share of the current phase of a computation, and its state, for progress displays.

A phase states how many steps of which unit it consists of, loops report the steps that they
complete, and a display listens. Reports outside of a phase, or in a phase of another unit, have no
effect. Threads take part if they run in a copy of the context (`contextvars.copy_context`).
Iterations whose number is not known in advance report a state instead, such as their residual.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from enum import StrEnum, auto

# Called with the completed share of a phase: 0 when it begins, at most 1, and None when it ended.
ShareListener = Callable[[float | None], None]
# Called with a function that describes the state of an iteration in words.
StateListener = Callable[[Callable[[], str]], None]


class StepUnit(StrEnum):
    """Units in which the work of a phase is counted."""

    TIME_STEP = auto()
    STIFFNESS = auto()
    SIMULATION = auto()
    PICTURE = auto()


@dataclass
class _Phase:
    """Phase with a known number of steps.

    Attributes
    ----------
    unit : StepUnit
    total : int
        Number of steps.
    completed : float
        Number of steps that are completed; threads that add at the same time may lose some, which
        only delays the display.
    """

    unit: StepUnit
    total: int
    completed: float = 0.0


_listener: ContextVar[ShareListener | None] = ContextVar(
    "share_listener", default=None
)
_state_listener: ContextVar[StateListener | None] = ContextVar(
    "state_listener", default=None
)
_phase: ContextVar[_Phase | None] = ContextVar("phase", default=None)


@contextmanager
def listen_to_shares(listener: ShareListener) -> Iterator[None]:
    """Call `listener`, a `ShareListener`, with the completed share of each phase in the block."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


@contextmanager
def listen_to_states(listener: StateListener) -> Iterator[None]:
    """Call `listener`, a `StateListener`, with each state that is reported in the block."""
    token = _state_listener.set(listener)
    try:
        yield
    finally:
        _state_listener.reset(token)


def report_state(describe: Callable[[], str]) -> None:
    """Report the state of an iteration; `describe` is called only if the state is displayed."""
    listener = _state_listener.get()
    if listener is not None:
        listener(describe)


@contextmanager
def counted_phase(unit: StepUnit, total: int) -> Iterator[None]:
    """Count the steps that are completed within the block.

    Parameters
    ----------
    unit : StepUnit
        Unit of the steps.
    total : int
        Expected number of steps. Where more are completed, the share stays 1.

    Notes
    -----
    Within another phase the block has no effect: its share is that of the outer phase.
    """
    if _phase.get() is not None:
        yield
        return
    token = _phase.set(_Phase(unit, total))
    _report(0.0)
    try:
        yield
    finally:
        _phase.reset(token)
        _report(None)


def complete_steps(unit: StepUnit, count: float = 1) -> None:
    """Report that `count` steps were completed; no effect outside of a phase of this unit."""
    phase = _phase.get()
    if phase is None or phase.unit is not unit or phase.total <= 0:
        return
    phase.completed += count
    _report(min(phase.completed / phase.total, 1.0))


def _report(share: float | None) -> None:
    listener = _listener.get()
    if listener is not None:
        listener(share)
