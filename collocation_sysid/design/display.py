"""What people see of a design in a terminal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from ..fem.constants import symbol_of, unit_of
from .designing import FORBIDDEN, Design

EVERY = 20


class DesignProgress:
    """The search, live on a terminal; a line now and then elsewhere."""

    def __init__(self, console: Console, evaluations: int, quiet: bool = False) -> None:
        self.console, self.evaluations, self.quiet = console, evaluations, quiet
        live = console.is_terminal and not quiet
        self._live = Live(console=console, refresh_per_second=4, transient=True) if live else None

    def __enter__(self) -> DesignProgress:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def tried(self, number: int, log_size: float) -> None:
        """Show the smallest error bar so far."""
        best = "none possible yet" if log_size >= FORBIDDEN else f"{100 * np.exp(log_size):.3g} %"
        line = f"{number} of {self.evaluations} motions tried, smallest error bar: {best}"
        if self._live is not None:
            self._live.update(Text(f"{line} (Ctrl-C keeps it)", style="dim"))
        elif not self.quiet and (number % EVERY == 0 or number == self.evaluations):
            self.console.print(line)

    def say(self, what: str) -> None:
        """Show what is being done now."""
        if self._live is not None:
            self._live.update(Text(f"{what} (Ctrl-C keeps the best)", style="dim"))
        elif not self.quiet:
            self.console.print(what)


def design_summary(found: Design, folder: Path) -> RenderableType:
    """A design on one screen."""
    parts: list[RenderableType] = []
    tried = len(found.found.history)
    if found.found.interrupted:
        parts.append(Text(f"interrupted: the best of {tried} motions", style="yellow"))
    parts += [_table(found), Text(_meaning(found))]
    reached = ", ".join(found.reached) or "none"
    parts.append(Text(f"limits reached: {reached}"))
    parts.append(Text(f"written to {folder}"))
    return Group(*parts)


def _table(found: Design) -> Table:
    heads = ("", "value", "error before", "error after", "over the draws", "smaller by")
    table = Table(*heads, box=None, pad_edge=False)
    for column in table.columns[1:]:
        column.justify = "right"
    before, after = found.before, found.after
    for name, relative in after.relative.items():
        earlier = before.relative[name] if before is not None else np.nan
        table.add_row(
            f"{symbol_of(name)} {unit_of(name)}".strip(),
            f"{after.values[name]:.4g}",
            _percent(earlier),
            _percent(relative),
            f"{_percent(after.lowest[name])} … {_percent(after.highest[name])}",
            f"{earlier / relative:.2g}" if np.isfinite(earlier) else "",
        )
    return table


def _percent(share: float) -> str:
    if np.isnan(share):
        return ""
    return f"{100 * share:.3g} %" if share < 10 else "not told"


def _meaning(found: Design) -> str:
    """What the columns are."""
    duration = f"{found.experiment.duration_s:.4g} s"
    after = f"after: the designed motion of {duration}"
    if found.added:
        return f"before: the recordings there are; {after} besides them"
    if found.before is None:
        return after
    shipped = f"{found.recording.template.duration_s:.4g} s"
    return f"before: the problem's own motion of {shipped}; {after}, alone"
