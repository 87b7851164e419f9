"""What a solve shows while it runs: its iterations on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from rich.console import Console, Group
from rich.text import Text

from ..console import Watched
from ..display import Shown, Table, on_terminal
from ..fem.constants import symbol_of
from ..methods.solution import Iteration
from ..problem import Problem

SHOWN_ITERATIONS = 12
# The first line comes after this time, the next ones when it has grown by this share.
FIRST_S, SHARE = 10.0, 0.5


class Heartbeat:
    """Tells what is being done, from a thread of its own: also while one call takes minutes.

    Parameters
    ----------
    doing : callable that returns what is being done now
    tell : callable that shows a line
    first_s : float, optional
        When the first line comes.
    """

    NAME = "heartbeat"

    def __init__(
        self, doing: Callable[[], str], tell: Callable[[str], None], first_s: float | None = None
    ) -> None:
        self._doing, self._tell = doing, tell
        self._first_s = FIRST_S if first_s is None else first_s
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat, name=self.NAME, daemon=True)

    def start(self) -> None:
        """Begin to count."""
        self._thread.start()

    def stop(self) -> None:
        """No line comes after this."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _beat(self) -> None:
        began, passed_s = time.monotonic(), 0.0
        while not self._ended.wait(max(self._first_s, SHARE * passed_s)):
            passed_s = time.monotonic() - began
            self._tell(f"{self._doing()} ({passed_s:.3g} s so far)")


class Progress(Watched):
    """A live table of iterations on a terminal; elsewhere a line now and then, or all if asked."""

    def __init__(
        self,
        console: Console,
        problem: Problem | None = None,
        verbose: bool = False,
        quiet: bool = False,
    ) -> None:
        super().__init__(console, quiet, live=not verbose)
        self.verbose = verbose
        self._notes = problem.notes if problem else ()
        self._lines: list[Iteration] = []
        self._doing = "finding a start"
        silent = not (console.is_terminal or quiet)
        self._heartbeat = Heartbeat(self._state, self.line) if silent else None

    def __enter__(self) -> Progress:
        for note in self._notes:
            self.line(f"note: {note}")
        super().__enter__()
        if self._heartbeat is not None:
            self._heartbeat.start()
        return self

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        if self._heartbeat is not None:
            self._heartbeat.stop()

    def iteration(self, line: Iteration) -> None:
        """Show an iterate."""
        self._lines.append(line)
        self._told("solving", "  ".join(_cells(line)))

    def say(self, what: str) -> None:
        """Show what is being done now."""
        self._told(what, what)

    def share(self, done: float) -> None:
        """Show the share of a simulation that is done."""
        self._told(f"simulating: {done:.0%}")

    def _told(self, doing: str, line: str = "") -> None:
        self._doing = doing
        if self.verbose and line:
            self.console.print(Text(line), soft_wrap=True)
        table = on_terminal(_iterations(self._lines))
        self.update(Group(table, Text(self._doing, style="dim")))

    def _state(self) -> str:
        done = f", {len(self._lines)} iterations" if self._lines else ""
        return f"{self._doing}{done}"


def _iterations(lines: list[Iteration]) -> Shown:
    if not lines:
        return ""
    heads = ("", "RMS mm", "violation N", *map(symbol_of, lines[-1].parameters), "s")
    return Table("", heads, tuple(map(_cells, lines[-SHOWN_ITERATIONS:])), names=0)


def _cells(line: Iteration) -> tuple[str, ...]:
    values = (f"{value:.4g}" for value in line.parameters.values())
    rms_mm, violation = f"{line.rms_m * 1e3:.4f}", f"{line.violation_n:.1e}"
    return str(line.number), rms_mm, violation, *values, f"{line.time_s:.1f}"
