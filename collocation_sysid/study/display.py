"""A study in the terminal: progress with the time left, the tables, the list of what would run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from .plan import PlannedRun
from .report import SHOWN_FAILURES, Report, View
from .store import Record

# With more columns than these long heads are parted.
MANY = 5


class StudyProgress:
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
        self.console = console
        self.quiet = quiet
        self.total = total
        self._methods = {run.key: run.method for run in remaining}
        self._waiting = dict(self._methods)
        self._walls: dict[str, list[float]] = {}
        live = console.is_terminal and not quiet
        self._live = Live(console=console, refresh_per_second=4, transient=True) if live else None

    def __enter__(self) -> StudyProgress:
        skipped = self.total - len(self._waiting)
        if skipped and not self.quiet:
            self.console.print(Text(f"{skipped} of {self.total} runs are finished already"))
        if self._live is not None:
            self._live.start()
            self._live.update(Text(f"{skipped}/{self.total} runs", style="dim"), refresh=True)
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def done(self, record: Record, slots: int) -> None:
        """Count a finished run."""
        method = self._waiting.pop(record["key"])
        if record.get("wall_s") is not None:
            self._walls.setdefault(method, []).append(record["wall_s"])
        status = (record.get("result") or record).get("status", record["outcome"])
        count = f"{self.total - len(self._waiting)}/{self.total} runs"
        wall = record.get("wall_s") or 0.0
        line = f"{count}: {label_of(record)} {status} in {wall:.1f} s{self._left(slots)}"
        if self._live is not None:
            self._live.update(Text(line, style="dim"), refresh=True)
        elif not self.quiet:
            self.console.print(Text(line), soft_wrap=True)

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


def study_tables(report: Report, folder: Path) -> RenderableType:
    """The tables of a study within 80 columns, and what went wrong."""
    parts: list[RenderableType] = []
    if report.kind == "models":  # what no line of the tables says
        parts += [*map(Text, report.headline), Text("")]
    for view in report.views:
        parts += [Text(view.title, style="bold"), _table(view), Text("")]
    parts += [Text(note) for note in report.notes]
    failures = report.failures
    parts += [Text(failure, style="red") for failure in failures[:SHOWN_FAILURES]]
    if len(failures) > SHOWN_FAILURES:
        parts.append(Text(f"and {len(failures) - SHOWN_FAILURES} more in summary.md", style="red"))
    parts.append(Text(f"written to {folder}"))
    return Group(*parts)


def plan_table(planned: Sequence[PlannedRun], finished: Sequence[str]) -> RenderableType:
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
    return _table(View("", ("", "run", "guess", ""), rows, names=4))


def _table(view: View) -> Table:
    table = Table(box=None, pad_edge=False, show_edge=False)
    for place, head in enumerate(view.heads):
        if place < view.names:  # dotted keys may take two lines
            table.add_column(head.replace(".", ".\n", 1), overflow="fold")
        else:
            # Names of materials in many columns are parted where they have a hyphen.
            parted = head.replace("-", "-\n") if len(view.heads) > MANY else head
            table.add_column(parted, justify="right", overflow="fold")
    for row in view.rows:
        table.add_row(*map(Text, row))
    return table
