"""Solution of a program by an NLP solver of CasADi's `nlpsol`, interruptible by Ctrl-C.

A callback of CasADi observes the iterations of a solver, with the history of a solve.
"""

from __future__ import annotations

import atexit
import io
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from contextvars import copy_context
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ..common.array_types import Array
from ..common.signal_handling import ABANDONED_THREAD, INTERRUPTS, raises_interrupt
from ..errors import InputError
from ..program.casadi_functions import HessianValues, NlpFunctions
from ..program.collocation import Collocation, convert_variables
from .condensed_program import complete_multipliers
from .solution import Solution, Status
from .solve_recorder import Recorder

# Of solvers that are written otherwise.
NAMES = {"ipopt": "IPOPT"}

Settings = Callable[[NlpFunctions], Mapping[str, Any]]

# Time in which a solver may end by itself after Ctrl-C or the limit of time [s].
GRACE_S = 2.0
# Interval at which that is checked [s].
LOOK_EVERY_S = 0.05
# Settings of every solver.
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
    judge: Callable[[Status, Array, Array], Status] = lambda status, *_: status,
    initial_multipliers: tuple[Array, Array] | None = None,
) -> Solution:
    """Solve the recorder's collocation, and return the solution; if the solver did not converge,
    its best iterate.

    Ctrl-C stops the solver after the iteration, or abandons it after 2 s; the status is then
    `INTERRUPTED`. If the recorder's time is over before convergence it is `TIME_LIMIT`, also where
    the solver had to be abandoned. This holds on the main thread; on others Ctrl-C is not handled.
    The recorder gets an entry of its history for each iteration, notes, and the times of its
    stopwatch.

    Parameters
    ----------
    recorder : Recorder
        Record of the solve, with the problem.
    program : Collocation
        The problem in the form for the solver, with lifted variables or condensed.
    start : (variables,) array, optional
        Initial variables of the problem; a simulation at the guess by default.
    plugin : str
        CasADi's name of the solver.
    hessian : callable
        Function that writes the second derivatives, see `NlpFunctions`.
    settings : callable
        Function of the `NlpFunctions` that returns the options of the plugin.
    statuses : mapping
        Status by the solver's return status; others mean a numerical failure.
    judge : callable
        Function of status, variables and multipliers of the problem that returns the final status.
    initial_multipliers : ((constraints,) array, (variables,) array), optional
        Initial multipliers of the program; zeros by default.

    Raises
    ------
    InputError
        If the solver does not know an option, with the solver's message.
    KeyboardInterrupt
        At a second Ctrl-C.
    Exception
        The first exception of a function of the program or of the recorder's `watch`, which ends
        the solver. Where no stress-free shape exists the solver takes a shorter step instead.
    """
    collocation = recorder.collocation
    watch = recorder.stopwatch
    errors: list[BaseException] = []
    previous_evaluations_s = watch.evaluations
    previous_linear_algebra_s = watch.linear_algebra
    unaccounted_s = (
        recorder.measure_elapsed_s()
        - watch.build
        - previous_evaluations_s
        - previous_linear_algebra_s
    )
    with watch.building():
        start = recorder.initial_variables(start)
        functions = NlpFunctions(program, hessian, errors=errors)
        monitor = IterationMonitor(recorder, program, errors=errors)
        options = {"iteration_callback": monitor, **settings(functions)}
        solver = create_solver(plugin, functions, settings=options)
    initial_variables = convert_variables(start, collocation, target=program)
    result = _run(
        solver,
        program.bounds(),
        start=initial_variables,
        monitor=monitor,
        multipliers=initial_multipliers,
    )
    z = result.variables
    multipliers = result.multipliers
    if errors and not isinstance(errors[0], _SolverAbandoned):
        raise errors[0]
    watch.evaluations = previous_evaluations_s + functions.sum_seconds()
    # What is neither set-up nor callback.
    accounted_s = watch.build + watch.evaluations + monitor.seconds + unaccounted_s
    watch.linear_algebra = max(
        previous_linear_algebra_s, recorder.measure_elapsed_s() - accounted_s
    )
    status = statuses.get(result.return_status, Status.NUMERICAL_FAILURE)
    if monitor.stop or (recorder.is_late() and not status.converged):
        status = Status.INTERRUPTED if monitor.stop else Status.TIME_LIMIT
    if not (status.converged and np.isfinite(z).all()):
        z, multipliers = monitor.best or (initial_variables, np.zeros(program.constraint_count))
    # A solver that never began leaves its count as memory had it.
    iterations = result.iterations or max(0, monitor.lines - 1)
    if status is Status.REFUSED:
        iterations = 0
    problem_multipliers = complete_multipliers(program, z, multipliers=multipliers)[
        : collocation.constraint_count
    ]
    problem_variables = convert_variables(z, program, target=collocation)
    status = judge(status, problem_variables, problem_multipliers)
    name = NAMES.get(plugin, plugin)
    # Solvers that have a limit call it max_iter, some with a prefix, as "ipopt.max_iter".
    limit = next(
        (value for option, value in options.items() if option.rpartition(".")[2] == "max_iter"),
        None,
    )
    sentence = status.explain(recorder.method, max_iterations=limit)
    message = f"{sentence} ({name}: {result.return_status})"
    return recorder.solution(
        status,
        message,
        z=problem_variables,
        multipliers=problem_multipliers,
        iterations=iterations,
        evaluations=functions.count_calls(),
    )


def ipopt_settings(
    functions: NlpFunctions, linear_solver: str, tolerance: float, max_iterations: int
) -> dict[str, Any]:
    """Return settings of IPOPT without output and with exact derivatives, whose callbacks are added
    to `functions`.
    """
    return {
        "ipopt.linear_solver": linear_solver,
        "ipopt.tol": tolerance,
        "ipopt.max_iter": max_iterations,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.option_file_name": "",  # IPOPT reads ipopt.opt of the working folder otherwise
        **functions.derivatives("ipopt"),
    }


def create_solver(plugin: str, functions: NlpFunctions, settings: Mapping[str, Any]) -> ca.Function:
    """Return CasADi's solver of a program.

    Raises
    ------
    InputError
        If the solver does not know a setting.
    """
    z = ca.MX.sym("z", functions.collocation.variable_count)
    value, rows = functions.nlp(z, ca.MX(0, 1))
    output = io.StringIO()
    try:
        with redirect_stdout(output):  # where IPOPT says which setting it refuses
            program = {"x": z, "f": value, "g": rows}
            return ca.nlpsol("solver", plugin, program, {**_COMMON, **settings})
    except RuntimeError as error:
        lines = [line.strip() for line in str(error).strip().splitlines()]
        unknown = [line for line in lines if "Unknown option" in line]
        reason = (output.getvalue().strip() or [*unknown, lines[-1]][0]).splitlines()[0]
        reason = re.sub(r"^\S+:\d+: | Check the option documentation\.$", "", reason)
        name = NAMES.get(plugin, plugin)
        raise InputError(f"{name} cannot be set up: {reason}", None, where="solver") from error


class _SolverAbandoned(Exception):
    """Exception of the callbacks of a solver that was abandoned on its thread."""


class _NlpsolResult(NamedTuple):
    """Result of a solver of `nlpsol`."""

    variables: Array  # (variables,): last variables; NaN if the solver failed or was abandoned
    # (constraints,): multipliers of the constraints; empty if the solver failed or was abandoned.
    multipliers: Array
    # Status that the solver states; if it raised a `RuntimeError` the last line of the message, and
    # if it was abandoned "left behind".
    return_status: str
    # Number of iterations; 0 if the solver does not count them, failed or was abandoned.
    iterations: int

    @classmethod
    def failure(cls, count: int, return_status: str) -> _NlpsolResult:
        return cls(np.full(count, np.nan), np.zeros(0), return_status=return_status, iterations=0)


def _run(
    solver: ca.Function,
    bounds: tuple[Array, Array],
    start: Array,
    monitor: IterationMonitor,
    multipliers: tuple[Array, Array] | None,
) -> _NlpsolResult:
    """Run a solver, on a thread if this is the main one; failures are part of the result."""
    lower, upper = bounds
    arguments = {"x0": start, "lbx": lower, "ubx": upper, "lbg": 0, "ubg": 0}
    if multipliers is not None:
        arguments |= dict(zip(("lam_g0", "lam_x0"), multipliers, strict=True))
    results: list[_NlpsolResult] = []

    def search() -> None:
        try:
            answer = solver(**arguments)
            stats = solver.stats()
        except RuntimeError as error:  # of the solver or a failed callback
            message = str(error).strip().splitlines()[-1].split(": ", 1)[-1]
            results.append(_NlpsolResult.failure(len(start), message))
            return
        results.append(
            _NlpsolResult(
                answer["x"].full().ravel(),
                answer["lam_g"].full().ravel(),
                return_status=str(stats["return_status"]),
                iterations=int(stats.get("iter_count") or 0),
            )
        )

    if threading.current_thread() is threading.main_thread():
        _run_on_thread(search, monitor)
    else:
        search()
    if not results:
        return _NlpsolResult.failure(len(start), "interrupted before the solver returned a result")
    return results[0]


def _run_on_thread(search: Callable[[], None], monitor: IterationMonitor) -> None:
    """Wait on the main thread, which can handle signals during long factorisations."""
    # After a request to stop, the search is abandoned if it does not end within `GRACE_S`.
    thread = threading.Thread(target=copy_context().run, args=(search,), daemon=True)
    with _interruptible(monitor):
        thread.start()
        try:
            remaining_s = GRACE_S
            while thread.is_alive() and remaining_s > 0:
                thread.join(LOOK_EVERY_S)
                is_over = monitor.stop or monitor.recorder.is_late()
                remaining_s -= LOOK_EVERY_S if is_over else 0.0
        finally:
            if thread.is_alive():
                thread.name = ABANDONED_THREAD
                monitor.errors.append(_SolverAbandoned())
                # Its callbacks must not be freed before the solver calls them once more and ends.
                atexit.register(thread.join)


@contextmanager
def _interruptible(monitor: IterationMonitor) -> Iterator[None]:
    """Context in which Ctrl-C asks the monitor to stop; a second one interrupts."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    if not raises_interrupt(handlers[signal.SIGTERM]):
        del handlers[signal.SIGTERM]

    def request(number: int, _frame: object) -> None:
        monitor.stop = True
        INTERRUPTS.number = number
        signal.signal(number, signal.default_int_handler)

    for number in handlers:
        signal.signal(number, request)
    try:
        yield
    finally:
        for number, previous in handlers.items():
            signal.signal(number, previous)


class IterationMonitor(ca.Callback):
    """CasADi callback that is called after each iteration: history, best iterate, and requests to
    stop.

    Attributes
    ----------
    stop : bool
        Set it to true to stop the solver after the iteration.
    best : tuple of two arrays or None
        Variables and multipliers with the least merit (objective plus largest constraint); None
        before the first iteration.
    seconds : float
        Time of the calls [s].
    lines : int
        Number of calls.

    Parameters
    ----------
    recorder : Recorder
        Record of the solve; an entry is added to its history per call.
    program : Collocation
        Program that is solved, which may be condensed or have lifted variables.
    errors : list
        Exceptions; the solver is stopped once it contains one.
    """

    def __init__(
        self, recorder: Recorder, program: Collocation, errors: list[BaseException]
    ) -> None:
        ca.Callback.__init__(self)
        self.recorder = recorder
        self.program = program
        self.errors = errors
        self.stop = False
        self.best: tuple[Array, Array] | None = None
        self.seconds = 0.0
        self.lines = 0
        self._best_merit = np.inf
        self.construct("monitor")

    def get_n_in(self) -> int:
        return ca.nlpsol_n_out()

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        program = self.program
        sizes = {
            "x": program.variable_count,
            "f": 1,
            "g": program.constraint_count,
            "lam_x": program.variable_count,
            "lam_g": program.constraint_count,
        }
        return ca.Sparsity.dense(sizes.get(ca.nlpsol_out(i), 0), 1)

    def eval(self, arguments):
        """Record an iteration; return [1] if the solver should stop, else [0] (CasADi's interface).

        It should stop on request, at the limit of time, and after an exception, which is stored in
        `errors` instead of being raised.
        """
        began = time.perf_counter()
        if self.errors:
            return [1]
        try:
            self._record(arguments)
        except BaseException as error:
            self.errors.append(error)
        self.seconds += time.perf_counter() - began
        return [1 if self.stop or self.recorder.is_late() or self.errors else 0]

    def _record(self, arguments) -> None:
        """Add an entry, and store the iterate of least objective plus largest violation."""
        z, value, rows, _, multipliers, *_ = (argument.full().ravel() for argument in arguments)
        # Objective and constraints are both of order one.
        merit = float(value[0] + np.abs(rows).max(initial=0.0))
        if merit < self._best_merit:
            self._best_merit = merit
            self.best = (z, multipliers)
        recorder = self.recorder
        loss = float(value[0]) / self.program.loss_scale
        variables = convert_variables(z, self.program, target=recorder.collocation)
        number = recorder.history[-1].number + 1 if recorder.history else 0
        self.lines += 1
        recorder.add_variables(number, variables, loss=loss)
