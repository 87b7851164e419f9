"""Terminal output that displays control characters of names and files instead of obeying them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Self

from rich.console import Console, ConsoleOptions, RenderableType
from rich.live import Live
from rich.segment import Segment
from rich.text import Text

from ..errors import printable


class PlainConsole(Console):
    """Rich console that shows texts as they are: no markup, no emoji codes, no highlighting, and
    visible marks in place of control characters (`printable`).

    Parameters
    ----------
    **options
        Further options of `rich.console.Console`.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Yield rich's segments with visible marks in place of control characters; rich's own
        control segments are unchanged.
        """
        for segment in super().render(renderable, options):
            yield (segment if segment.control else segment._replace(text=printable(segment.text)))


class Watched:
    """Progress display: updated in place on a terminal, one line per step elsewhere, none if
    `quiet`.

    Use it as a context manager: in-place updates are displayed within the block and removed at its
    end.

    Attributes
    ----------
    console : Console
        Where it is displayed.
    quiet : bool
        Whether nothing is displayed at all.

    Parameters
    ----------
    live : bool
        If false, do not update in place, also on a terminal.
    """

    def __init__(self, console: Console, quiet: bool = False, live: bool = True) -> None:
        self.console = console
        self.quiet = quiet
        shown = console.is_terminal and live and not quiet
        self._live = Live(console=console, refresh_per_second=8, transient=True) if shown else None

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def update(self, shown: RenderableType, line: str = "") -> None:
        """Display `shown` in place; without a live display, print `line` if it is not empty and the
        display is not quiet.
        """
        if self._live is not None:
            self._live.update(shown)
        elif line:
            self.line(line)

    def line(self, text: str) -> None:
        """Print a line that stays, without wrapping; nothing if the display is quiet."""
        if not self.quiet:
            self.console.print(Text(text), soft_wrap=True)
