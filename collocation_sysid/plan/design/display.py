"""What people see of a design in a terminal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console
from rich.text import Text

from ...console import Watched
from ...display import Line, Shown, Table
from ...fem.constants import with_unit
from .designing import FORBIDDEN, Design

EVERY = 20


class DesignProgress(Watched):
    """The search, live on a terminal; a line now and then elsewhere."""

    def __init__(self, console: Console, evaluations: int, quiet: bool = False) -> None:
        super().__init__(console, quiet)
        self.evaluations = evaluations

    def tried(self, number: int, log_size: float) -> None:
        """Show the smallest error bar so far."""
        best = "none possible yet" if log_size >= FORBIDDEN else f"{100 * np.exp(log_size):.3g} %"
        line = f"{number} of {self.evaluations} motions tried, smallest error bar: {best}"
        seldom = number % EVERY == 0 or number == self.evaluations
        self.update(Text(f"{line} (Ctrl-C keeps it)", style="dim"), line if seldom else "")

    def say(self, what: str) -> None:
        """Show what is being done now."""
        self.update(Text(f"{what} (Ctrl-C keeps the best)", style="dim"), what)


def design_summary(design: Design, folder: Path) -> list[Shown]:
    """A design on one screen."""
    tried = len(design.best.history)
    interrupted = Line(f"interrupted: the best of {tried} motions", "check")
    return [
        *[interrupted] * design.best.interrupted,
        _table(design),
        _meaning(design),
        f"limits reached: {', '.join(design.reached) or 'none'}",
        f"written to {folder}",
    ]


def _table(design: Design) -> Table:
    heads = ("", "value", "error before", "error after", "over the draws", "smaller by")
    before, after, rows = design.before, design.after, []
    for name, relative in after.relative.items():
        earlier = before.relative[name] if before is not None else np.nan
        rows.append(
            (
                with_unit(name),
                f"{after.values[name]:.4g}",
                _percent(earlier),
                _percent(relative),
                f"{_percent(after.lowest[name])} … {_percent(after.highest[name])}",
                f"{earlier / relative:.2g}" if np.isfinite(earlier) else "",
            )
        )
    return Table("", heads, tuple(rows))


def _percent(share: float) -> str:
    if np.isnan(share):
        return ""
    return f"{100 * share:.3g} %" if share < 10 else "not told"


def _meaning(design: Design) -> str:
    """What the columns are."""
    duration = f"{design.experiment.duration_s:.4g} s"
    after = f"after: the designed motion of {duration}"
    if design.added:
        return f"before: the recordings there are; {after} besides them"
    if design.before is None:
        return after
    shipped = f"{design.recording.template.duration_s:.4g} s"
    return f"before: the problem's own motion of {shipped}; {after}, alone"
