"""A study in the terminal: progress with the time left, the tables, the list of what would run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.text import Text

from ..console import Watched
from ..display import Line, Shown, Table
from .store import Record
from .study import PlannedRun
from .study_page import SHOWN_FAILURES, Report


class StudyProgress(Watched):
    """One live line on a terminal, a line for each run elsewhere.

    Parameters
    ----------
    console : Console
    remaining : sequence of PlannedRun
        The runs that are to be done.
    total : int
        With those that are done already.
    """

    def __init__(
        self, console: Console, remaining: Sequence[PlannedRun], total: int, quiet: bool = False
    ) -> None:
        super().__init__(console, quiet)
        self.total = total
        self._waiting = {run.key: run.method for run in remaining}
        self._walls: dict[str, list[float]] = {}

    def __enter__(self) -> StudyProgress:
        skipped = self.total - len(self._waiting)
        if skipped:
            self.line(f"{skipped} of {self.total} runs are finished already")
        super().__enter__()
        self.update(Text(f"{skipped}/{self.total} runs", style="dim"))
        if self._live is not None:
            self._live.refresh()  # the first run may take less time than a frame
        return self

    def done(self, record: Record, slots: int) -> None:
        """Count a finished run."""
        method = self._waiting.pop(record["key"])
        if record.get("wall_s") is not None:
            self._walls.setdefault(method, []).append(record["wall_s"])
        status = (record.get("result") or record).get("status", record["outcome"])
        count = f"{self.total - len(self._waiting)}/{self.total} runs"
        wall = record.get("wall_s") or 0.0
        line = f"{count}: {label_of(record)} {status} in {wall:.1f} s{self._left(slots)}"
        self.update(Text(line, style="dim"), line)

    def _left(self, slots: int) -> str:
        left_s = time_left_s(list(self._waiting.values()), self._walls, slots)
        return "" if left_s is None else f"; about {duration(left_s)} left"


def label_of(record: Record) -> str:
    """A record's run in a few words."""
    names = PlannedRun.__dataclass_fields__
    return PlannedRun(**{name: record[name] for name in names if name in record}).label


def time_left_s(
    waiting: Sequence[str], walls: Mapping[str, Sequence[float]], slots: int
) -> float | None:
    """Time for the waiting runs from their methods' mean so far; None when nothing is known."""
    every = [wall for of_method in walls.values() for wall in of_method]
    if not waiting or not every:
        return None
    overall = sum(every) / len(every)
    means = {method: sum(of_method) / len(of_method) for method, of_method in walls.items()}
    expected = [means.get(method, overall) for method in waiting]
    return max(sum(expected) / slots, max(expected))


def duration(time_s: float) -> str:
    """A rounded length of time."""
    for unit, seconds in (("h", 3600), ("min", 60)):
        if time_s >= 2 * seconds:
            return f"{time_s / seconds:.2g} {unit}"
    return f"{time_s:.0f} s"


def study_tables(report: Report, folder: Path) -> list[Shown]:
    """The tables of a study within 80 columns, and what went wrong."""
    # What no line of the tables says.
    parts: list[Shown] = [*report.headline, ""] if report.kind == "models" else []
    for table in report.views:
        parts += [table, ""]
    failures = report.failures
    parts += [*report.notes, *(Line(each, "doubtful") for each in failures[:SHOWN_FAILURES])]
    if len(failures) > SHOWN_FAILURES:
        more = f"and {len(failures) - SHOWN_FAILURES} more in summary.md"
        parts.append(Line(more, "doubtful"))
    return [*parts, f"written to {folder}"]


def plan_table(planned: Sequence[PlannedRun], finished: Sequence[str]) -> Table:
    """The runs of a study, and which of them are done."""
    rows = tuple(
        (
            str(number),
            run.label,
            " ".join("–" if g is None else f"{g:.4g}" for g in run.guess.values()),
            "finished" if run.key in finished else "to do",
        )
        for number, run in enumerate(planned, start=1)
    )
    return Table("", ("", "run", "guess", ""), rows, names=4)
