"""What solvers behind CasADi's `nlpsol` share: set-up, and Ctrl-C."""

from __future__ import annotations

import io
import re
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from typing import Any

import casadi as ca

from ..errors import InputError
from .callbacks import Monitor, NlpFunctions
from .solution import Timing


def build(
    plugin: str, functions: NlpFunctions, settings: Mapping[str, Any], name: str
) -> ca.Function:
    """The solver `plugin` for the NLP of the callbacks.

    Raises
    ------
    InputError
        If it does not know a setting, with its own words.
    """
    z = ca.MX.sym("z", functions.collocation.variables)
    value, rows = functions.nlp(z, ca.MX(0, 1))
    said = io.StringIO()
    try:
        with redirect_stdout(said):  # where IPOPT says which setting it refuses
            return ca.nlpsol("solver", plugin, {"x": z, "f": value, "g": rows}, dict(settings))
    except RuntimeError as error:
        lines = [line.strip() for line in str(error).strip().splitlines()]
        unknown = [line for line in lines if "Unknown option" in line]
        reason = (said.getvalue().strip() or [*unknown, lines[-1]][0]).splitlines()[0]
        reason = re.sub(r"^\S+:\d+: | Check the option documentation\.$", "", reason)
        raise InputError(f"{name} cannot be set up: {reason}", None, "solver") from error


def timing(functions: NlpFunctions, monitor: Monitor, began: float, built: float) -> Timing:
    """Where the time went since `began`; what is neither set-up nor callback is linear algebra."""
    total = time.perf_counter() - began
    spent = (built - began) + functions.seconds + monitor.seconds
    return Timing(built - began, functions.seconds, max(0.0, total - spent), total)


@contextmanager
def interruptible(monitor: Monitor) -> Iterator[None]:
    """Let Ctrl-C ask for a stop at the end of the iteration; a second one ends the program."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.getsignal(signal.SIGINT)

    def request(_number: int, _frame: object) -> None:
        monitor.stop = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    signal.signal(signal.SIGINT, request)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
