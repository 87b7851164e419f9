"""A solve by one of the NLP solvers behind CasADi's `nlpsol`."""

from __future__ import annotations

import io
import re
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from contextvars import copy_context
from typing import Any

import casadi as ca
import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..program.collocation import Collocation, carried_over
from ..starting import LEFT, raises_interrupt
from .callbacks import HessianValues, Monitor, NlpFunctions
from .condensed import whole_multipliers
from .initial_point import Multipliers
from .recorder import Recorder
from .solution import Solution, Status

# Of solvers that are written otherwise.
NAMES = {"ipopt": "IPOPT"}

Settings = Callable[[NlpFunctions], Mapping[str, Any]]

# How long a solver may take to end by itself, and how often that is looked at.
GRACE_S, LOOK_EVERY_S = 2.0, 0.05
_COMMON = {
    "print_time": False,
    "error_on_fail": False,
    "show_eval_warnings": False,  # a trial step that inverts an element is cut back
    "no_nlp_grad": True,
}


def solve(
    recorder: Recorder,
    program: Collocation,
    start: Array | None,
    plugin: str,
    hessian: HessianValues,
    settings: Settings,
    statuses: Mapping[str, Status],
    judged: Callable[[Status, Array, Array], Status] = lambda status, *_: status,
    initial_multipliers: Multipliers | None = None,
) -> Solution:
    """Solve the recorder's collocation; Ctrl-C ends it after the iteration, or after 2 s.

    Parameters
    ----------
    recorder : Recorder
    program : Collocation
        The recorder's as the solver gets it, see `explicit` and `condensed`.
    start : (variables,) ndarray, optional
    plugin : str
    hessian : callable
        Writes second derivatives of the program, see `NlpFunctions`.
    settings : callable
        The plugin's settings, given the functions.
    statuses : mapping
        Its words for how it ended in ours; a failure where one is not among them.
    judged : callable
        What to say of the status, variables and multipliers of the recorder's collocation.
    initial_multipliers : Multipliers, optional
        Initial multipliers of the program; zeros by default.

    Raises
    ------
    InputError
        If it does not know a setting, with its own words.
    """
    collocation, watch = recorder.collocation, recorder.stopwatch
    errors: list[BaseException] = []
    earlier_evaluations_s = watch.evaluations
    earlier_linear_algebra_s = watch.linear_algebra
    unaccounted_s = (
        recorder.elapsed_s - watch.build - earlier_evaluations_s - earlier_linear_algebra_s
    )
    with watch.building():
        start = recorder.start(start)
        functions = NlpFunctions(program, hessian, errors)
        monitor = Monitor(recorder, program, errors)
        given = {**_COMMON, "iteration_callback": monitor, **settings(functions)}
        solver = _nlpsol(plugin, functions, given)
    began = carried_over(start, collocation, program)
    z, multipliers, said, count = _run(
        solver, program.bounds(), began, monitor, initial_multipliers
    )
    if errors and not isinstance(errors[0], _LeftBehind):
        raise errors[0]
    watch.evaluations = earlier_evaluations_s + functions.seconds
    # What is neither set-up nor callback.
    others_s = watch.build + watch.evaluations + monitor.seconds + unaccounted_s
    watch.linear_algebra = max(earlier_linear_algebra_s, recorder.elapsed_s - others_s)
    status = statuses.get(said, Status.NUMERICAL_FAILURE)
    if monitor.stop or (recorder.late and not status.converged):
        status = Status.INTERRUPTED if monitor.stop else Status.TIME_LIMIT
    if not (status.converged and np.isfinite(z).all()):
        z, multipliers = monitor.best or (began, np.zeros(program.constraints))
    # A solver that never began leaves its count as memory had it.
    iterations = 0 if status is Status.REFUSED else count or max(0, monitor.lines - 1)
    of_rows = whole_multipliers(program, z, multipliers)[: collocation.constraints]
    at = carried_over(z, program, collocation)
    status = judged(status, at, of_rows)
    message = f"{status.sentence} ({NAMES.get(plugin, plugin)}: {said})"
    return recorder.solution(status, message, at, of_rows, iterations, functions.calls)


def _nlpsol(plugin: str, functions: NlpFunctions, settings: dict[str, Any]) -> ca.Function:
    z = ca.MX.sym("z", functions.collocation.variables)
    value, rows = functions.nlp(z, ca.MX(0, 1))
    said = io.StringIO()
    try:
        with redirect_stdout(said):  # where IPOPT says which setting it refuses
            return ca.nlpsol("solver", plugin, {"x": z, "f": value, "g": rows}, settings)
    except RuntimeError as error:
        lines = [line.strip() for line in str(error).strip().splitlines()]
        unknown = [line for line in lines if "Unknown option" in line]
        reason = (said.getvalue().strip() or [*unknown, lines[-1]][0]).splitlines()[0]
        reason = re.sub(r"^\S+:\d+: | Check the option documentation\.$", "", reason)
        name = NAMES.get(plugin, plugin)
        raise InputError(f"{name} cannot be set up: {reason}", None, "solver") from error


class _LeftBehind(Exception):
    """The solver was given up; from now on its callbacks fail."""


def _run(
    solver: ca.Function,
    bounds: tuple[Array, Array],
    start: Array,
    monitor: Monitor,
    multipliers: Multipliers | None,
) -> tuple[Array, Array, str, int]:
    """Variables, multipliers, what the solver said, and its iterations."""
    lower, upper = bounds
    given = {"x0": start, "lbx": lower, "ubx": upper, "lbg": 0, "ubg": 0}
    if multipliers is not None:
        given |= {"lam_g0": multipliers.constraints, "lam_x0": multipliers.bounds}
    found: list[tuple[Array, Array, str, int]] = []

    def search() -> None:
        try:
            answer = solver(**given)
            stats = solver.stats()
        except RuntimeError as error:  # of its own, or what a callback's failure makes of it
            said = str(error).strip().splitlines()[-1].split(": ", 1)[-1]
            found.append((np.full(len(start), np.nan), np.zeros(0), said, 0))
            return
        z, multipliers = answer["x"].full().ravel(), answer["lam_g"].full().ravel()
        count = int(stats.get("iter_count") or 0)
        found.append((z, multipliers, str(stats["return_status"]), count))

    if threading.current_thread() is threading.main_thread():
        _on_a_thread(search, monitor)
    else:
        search()
    return found[0] if found else (np.full(len(start), np.nan), np.zeros(0), "left behind", 0)


def _on_a_thread(search: Callable[[], None], monitor: Monitor) -> None:
    """Let the main thread hear signals, which it does not within a factorisation of minutes."""
    thread = threading.Thread(target=copy_context().run, args=(search,), daemon=True)
    with _interruptible(monitor):
        thread.start()
        try:
            left_s = GRACE_S
            while thread.is_alive() and left_s > 0:
                thread.join(LOOK_EVERY_S)
                left_s -= LOOK_EVERY_S if monitor.stop else 0.0
        finally:
            if thread.is_alive():
                thread.name = LEFT
                monitor.errors.append(_LeftBehind())


@contextmanager
def _interruptible(monitor: Monitor) -> Iterator[None]:
    """Let Ctrl-C ask for a stop at the end of the iteration; a second one ends the program.

    So does SIGTERM where it is heeded as Ctrl-C is.
    """
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    if not raises_interrupt(handlers[signal.SIGTERM]):
        del handlers[signal.SIGTERM]

    def request(number: int, _frame: object) -> None:
        monitor.stop = True
        signal.signal(number, signal.default_int_handler)

    for number in handlers:
        signal.signal(number, request)
    try:
        yield
    finally:
        for number, previous in handlers.items():
            signal.signal(number, previous)
