"""Progress of a solve: a live table of iterations on a terminal, occasional lines elsewhere.

The remaining time is shown for phases whose work can be counted, see `step_counting`, and the
elapsed time for all others, such as a search: the number of its iterations is not known. A search
for an equilibrium that takes seconds shows its load step and residual.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Self

from rich.console import Console, Group
from rich.text import Text

from ..common.display import Shown, Table, Watched, on_terminal
from ..common.step_counting import SEARCH, listen_to_activities, listen_to_shares, listen_to_states
from ..fem.laws.constants import symbol_of, unit_of
from ..methods.solution import Iteration
from ..problem import Problem

# Number of latest iterations on the terminal: half of its 24 lines.
SHOWN_ITERATIONS = 12
# Time until the first line [s].
FIRST_LINE_S = 10.0
# Growth of the elapsed time until each further line.
ELAPSED_GROWTH = 0.5
# Time after which a phase has a remaining time [s]; an estimate from less is too rough.
FIRST_REMAINING_S = 1.0
# Time after which a phase without a share has an elapsed time [s].
FIRST_ELAPSED_S = 2.0
# Least time between two updates by completed shares [s]; a sweep completes thousands of steps.
SHARE_INTERVAL_S = 0.1


class Heartbeat:
    """Thread that reports the current activity from time to time, also while one call takes
    minutes.

    The first line comes after `first_s`; each further line when the elapsed time has grown by half.

    Parameters
    ----------
    current_activity : callable
        Returns the current activity as text.
    first_s : float, optional
        Time of the first line [s]; `FIRST_LINE_S` by default.
    """

    NAME = "heartbeat"

    def __init__(
        self,
        current_activity: Callable[[], str],
        show_line: Callable[[str], None],
        first_s: float | None = None,
    ) -> None:
        self._doing = current_activity
        self._tell = show_line
        self._first_s = FIRST_LINE_S if first_s is None else first_s
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=self.NAME, daemon=True)

    def start(self) -> None:
        """Start the thread and its clock; call it once."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread, and wait until it has ended; no line is shown afterwards."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        began = time.monotonic()
        passed_s = 0.0
        while not self._ended.wait(max(self._first_s, ELAPSED_GROWTH * passed_s)):
            passed_s = time.monotonic() - began
            self._tell(f"{self._doing()} ({passed_s:.3g} s so far)")


class SolveProgress(Watched):
    """Display of the progress of a solve, used as a context.

    On a terminal it is a live table of the last iterations. Elsewhere, or if `verbose`, lines are
    printed.

    Parameters
    ----------
    problem : Problem, optional
        Its notes are shown at the beginning.
    verbose : bool
        Print a line for every iteration.
    quiet : bool
        Show nothing but notes.
    activity : str
        The first activity.
    """

    def __init__(
        self,
        console: Console,
        problem: Problem | None = None,
        verbose: bool = False,
        quiet: bool = False,
        activity: str = "searching for an initial guess",
    ) -> None:
        super().__init__(console, quiet, live=not verbose)
        self.verbose = verbose
        self._notes = problem.notes if problem else ()
        self._lines: list[Iteration] = []
        self._doing = activity
        self._search = SEARCH
        self._said = ""
        self._remaining = ""
        self._state: Callable[[], str] | None = None
        self._activity_began_s = time.monotonic()
        self._phase_began_s = self._activity_began_s
        self._last_share = 0.0
        self._share_shown_s = 0.0
        self._contexts = ExitStack()
        silent = not (console.is_terminal or quiet)
        self._heartbeat = Heartbeat(self._activity_with_iterations, self.line) if silent else None

    def __enter__(self) -> Self:
        for note in self._notes:
            self.line(f"note: {note}")
        super().__enter__()
        self._contexts.enter_context(listen_to_shares(self.share))
        self._contexts.enter_context(listen_to_states(self.state))
        self._contexts.enter_context(listen_to_activities(self.activity))
        self._activity_began_s = time.monotonic()
        self._phase_began_s = self._activity_began_s
        self._redraw()
        if self._heartbeat is not None:
            self._heartbeat.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._contexts.close()
        super().__exit__(*error)
        if self._heartbeat is not None:
            self._heartbeat.stop()

    def iteration(self, line: Iteration) -> None:
        """Show an iteration as the last line of the table, and print it if verbose; the callback of
        a method.

        Parameters
        ----------
        line : Iteration
            Numbers of the iteration, stored for the table.
        """
        self._lines.append(line)
        self._update_activity(self._search, _iteration_text(line))

    def activity(self, name: str) -> None:
        """Show the name of the search that begins or resumes, such as that of a coarse start; its
        iterations are shown under this name. After a search that is a part of something else, that
        is shown again, see `say`.
        """
        self._search = name
        shown = self._said if name == SEARCH and self._said else name
        self._update_activity(shown, shown)

    def say(self, what: str) -> None:
        """Show what is being done now, as a sentence."""
        self._said = what
        self._update_activity(what, what)

    def announce(self, what: str) -> None:
        """Show what is being done now, like `say`; without a live display, print it as a line."""
        self.say(what)
        if self._live is None and not self.verbose:
            self.line(what)

    def share(self, done: float | None) -> None:
        """Show the completed share of the current phase, with the remaining time, at most every
        `SHARE_INTERVAL_S`; the state of an iteration (see `state`) is no longer shown once the
        share grows.

        Parameters
        ----------
        done : float or None
            Share from 0 to 1; a smaller one than before begins a phase, and None ends it. The
            elapsed time is shown instead after the end, and as long as nothing is completed.
        """
        now_s = time.monotonic()
        if done is None:
            self._remaining = ""
            self._redraw()
            return
        if done == 0 or done < self._last_share:
            self._phase_began_s = now_s
        if done > self._last_share:
            self._state = None
        self._last_share = done
        if now_s - self._share_shown_s < SHARE_INTERVAL_S:
            return
        self._share_shown_s = now_s
        elapsed_s = now_s - self._phase_began_s
        self._remaining = f": {done:.0%}{_remaining_time(elapsed_s, done)}" if done else ""
        self._redraw()

    def state(self, describe: Callable[[], str]) -> None:
        """Store the state of an iteration, which is shown while the current activity lasts.

        Parameters
        ----------
        describe : callable
            Returns the state in words, "" for none.
        """
        self._state = describe

    def _update_activity(self, activity: str, line: str = "") -> None:
        if activity != self._doing:
            self._activity_began_s = time.monotonic()
        self._doing = activity
        self._state = None
        if self.verbose and line:
            self.console.print(Text(line), soft_wrap=True)
        self._redraw()

    def _redraw(self) -> None:
        table = on_terminal(_iteration_table(self._lines))
        self.update(Group(table, RefreshedText(self._activity_with_time)))

    def _activity_with_time(self) -> str:
        """Return the current activity with its share and remaining time, or its elapsed time."""
        elapsed_s = time.monotonic() - self._activity_began_s
        is_long = elapsed_s >= FIRST_ELAPSED_S
        state = self._state_in_words() if is_long else ""
        if self._remaining:
            return f"{self._doing}{self._remaining}{state}"
        elapsed = f" ({elapsed_s:.0f} s so far)" if is_long else ""
        return f"{self._doing}{state}{elapsed}"

    def _activity_with_iterations(self) -> str:
        """Return the current activity with the last iteration, for the `Heartbeat`."""
        done = f", {_iteration_text(self._lines[-1])}" if self._lines else ""
        return f"{self._doing}{self._remaining}{done}{self._state_in_words()}"

    def _state_in_words(self) -> str:
        """Return the state of the current iteration after a comma; "" if there is none."""
        state = "" if self._state is None else self._state()
        return f", {state}" if state else ""


@dataclass(frozen=True)
class RefreshedText:
    """Text of a live display that is computed whenever the display is refreshed."""

    text: Callable[[], str]  # returns the text

    def __rich__(self) -> Text:
        return Text(self.text(), style="dim")


def _remaining_time(elapsed_s: float, share: float) -> str:
    if elapsed_s < FIRST_REMAINING_S or share <= 0:
        return ""
    remaining_s = elapsed_s * (1 - share) / share
    if remaining_s < 90:
        return f", about {remaining_s:.0f} s left"
    return f", about {remaining_s / 60:.0f} min left"


def _iteration_table(lines: list[Iteration]) -> Shown:
    if not lines:
        return ""
    heads = ("", "misfit σ", "violation N", *map(symbol_of, lines[-1].parameters), "s")
    return Table("", heads, rows=tuple(map(_iteration_row, lines[-SHOWN_ITERATIONS:])), names=0)


def _iteration_row(line: Iteration) -> tuple[str, ...]:
    """Return number, misfit, violation [N], parameters and time [s]."""
    values = (f"{value:.4g}" for value in line.parameters.values())
    violation = f"{line.violation_n:.1e}"
    return str(line.number), f"{line.misfit:.4g}", violation, *values, f"{line.time_s:.1f}"


def _iteration_text(line: Iteration) -> str:
    values = (
        f"{symbol_of(name)} = {value:.4g} {unit_of(name)}".rstrip()
        for name, value in line.parameters.items()
    )
    part = "" if line.share == 1 else f" of the first {line.share:.0%}"
    return ", ".join((f"iteration {line.number}: misfit {line.misfit:.3g} σ{part}", *values))
