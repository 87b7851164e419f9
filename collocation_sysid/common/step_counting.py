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
# Called with the name of what a search does now.
ActivityListener = Callable[[str], None]
# Name of a search that is no part of another activity.
SEARCH = "solving"
# Called with a function that describes the state of an iteration in words, "" for none.
StateListener = Callable[[Callable[[], str]], None]


class StepUnit(StrEnum):
    """Units in which the work of a phase is counted."""

    TIME_STEP = auto()
    STIFFNESS = auto()
    SIMULATION = auto()
    PICTURE = auto()
    RECORDING = auto()
    PROBLEM = auto()
    ASSUMPTION = auto()
    FRAME = auto()


@dataclass
class _Phase:
    """Phase with a known number of steps."""

    unit: StepUnit
    total: int  # number of steps
    # Number of steps that are completed; threads that add at the same time may lose some, which
    # only delays the display.
    completed: float = 0.0


_listener: ContextVar[ShareListener | None] = ContextVar("share_listener", default=None)
_state_listener: ContextVar[StateListener | None] = ContextVar("state_listener", default=None)
_activity_listener: ContextVar[ActivityListener | None] = ContextVar(
    "activity_listener", default=None
)
_activity: ContextVar[str] = ContextVar("activity", default=SEARCH)
_phase: ContextVar[_Phase | None] = ContextVar("phase", default=None)


@contextmanager
def listen_to_shares(listener: ShareListener) -> Iterator[None]:
    """Call `listener` with the completed share of each phase that is counted in the block; the
    previous listener returns afterwards.

    Parameters
    ----------
    listener : ShareListener
        Called in the thread that completes steps: with 0 when a phase begins, with a share of at
        most 1 at each report, and with None when it ends, also by an exception.
    """
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


@contextmanager
def listen_to_activities(listener: ActivityListener) -> Iterator[None]:
    """Call `listener` with the name of each search activity that begins or resumes in the block."""
    token = _activity_listener.set(listener)
    try:
        yield
    finally:
        _activity_listener.reset(token)


@contextmanager
def search_activity(name: str) -> Iterator[None]:
    """Name the searches in the block, such as "coarse start", for displays of progress; afterwards
    the name is the previous one, `SEARCH` at the outermost.
    """
    token = _activity.set(name)
    _report_activity()
    try:
        yield
    finally:
        _activity.reset(token)
        _report_activity()


def _report_activity() -> None:
    listener = _activity_listener.get()
    if listener is not None:
        listener(_activity.get())


def report_state(describe: Callable[[], str]) -> None:
    """Report the state of an iteration; `describe` is called only if the state is displayed, and
    returns "" if there is nothing to display any more.
    """
    listener = _state_listener.get()
    if listener is not None:
        listener(describe)


@contextmanager
def counted_phase(unit: StepUnit, total: int) -> Iterator[None]:
    """Count the steps that are completed within the block, and report their share to the listener.

    Parameters
    ----------
    unit : StepUnit
        Unit of the steps; only `complete_steps` of this unit counts.
    total : int
        Expected number of steps. Where more are completed, the share stays 1; if it is 0, no step
        is reported.

    Notes
    -----
    Within another phase the block has no effect, whatever its unit: the share is that of the outer
    phase.
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
    """Report that `count` further steps are completed; no effect
    outside of a phase of this unit.
    """
    phase = _phase.get()
    if phase is None or phase.unit is not unit or phase.total <= 0:
        return
    phase.completed += count
    _report(min(phase.completed / phase.total, 1.0))


def _report(share: float | None) -> None:
    """Call the listener, if there is one, with the share of the phase (None at its end)."""
    listener = _listener.get()
    if listener is not None:
        listener(share)
