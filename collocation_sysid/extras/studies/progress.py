"""Progress display of a study in the terminal."""

from __future__ import annotations

from typing import Self

from rich.console import Console, Group
from rich.text import Text

from ...result.solve_progress import RefreshedText, SolveProgress
from .planning import PlannedRun
from .run_execution import TIMEOUT, Record


class StudyProgress(SolveProgress):
    """Progress of a study: updated lines on a terminal, with the last iteration of each running
    run, else a line per run and from time to time.

    Parameters
    ----------
    console : Console
        Terminal.
    total : int
        Number of all runs.
    quiet : bool
        Whether to show nothing.
    """

    def __init__(self, console: Console, total: int, quiet: bool = False) -> None:
        self.total = total
        self._done = 0
        self._running: dict[str, str] = {}
        super().__init__(console, quiet=quiet, activity=f"0/{total} runs")

    def __enter__(self) -> Self:
        super().__enter__()
        self.say(f"0/{self.total} runs")
        if self._live is not None:
            self._live.refresh()  # the first run may take less time than a frame
        return self

    def show_iteration(self, run: PlannedRun, iteration: Record) -> None:
        """Show the last iteration of a running run."""
        text = f"{run.label}: iteration {iteration['number']}, {_numbers(iteration)}"
        self._running = {**self._running, run.label: text}
        self._redraw()

    def count_run(self, run: PlannedRun, record: Record) -> None:
        """Count a finished run and update the display."""
        self._done += 1
        self._running = {label: text for label, text in self._running.items() if label != run.label}
        fit = record.get("fit") or {}
        status = "timeout" if record["outcome"] == TIMEOUT else fit.get("status", record["outcome"])
        reached = {**(record.get("iteration") or {}), **fit}
        numbers = f": {_numbers(reached)}" if reached else ""
        self.announce(
            f"{self._done}/{self.total} runs: {run.label} {status} in {record['wall_s']:.1f} s"
            f"{numbers}"
        )

    def _redraw(self) -> None:
        running = [Text(text) for text in self._running.values()]
        self.update(Group(*running, RefreshedText(self._activity_with_time)))

    def _activity_with_iterations(self) -> str:
        return "; ".join([f"{self._done}/{self.total} runs", *self._running.values()])


def _numbers(reached: Record) -> str:
    return f"loss {reached['loss']:.3g}, violation {reached['violation_n']:.2g} N"
