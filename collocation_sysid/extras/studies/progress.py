"""Progress display of a study in the terminal."""

from __future__ import annotations

from typing import Self

from rich.console import Console

from ...result.solve_progress import SolveProgress
from .planning import PlannedRun
from .run_execution import Record


class StudyProgress(SolveProgress):
    """Progress of a study: one updated line on a terminal, else a line per run and from time to
    time.

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
        super().__init__(console, quiet=quiet, activity=f"0/{total} runs")

    def __enter__(self) -> Self:
        super().__enter__()
        self.say(f"0/{self.total} runs")
        if self._live is not None:
            self._live.refresh()  # the first run may take less time than a frame
        return self

    def count_run(self, run: PlannedRun, record: Record) -> None:
        """Count a finished run and update the display."""
        self._done += 1
        status = (record.get("result") or record).get("status", record["outcome"])
        self.announce(
            f"{self._done}/{self.total} runs: {run.label} {status} in {record['wall_s']:.1f} s"
        )
