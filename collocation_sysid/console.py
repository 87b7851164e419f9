"""Terminals that show what names and files say, and obey none of it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Self

from rich.console import Console, ConsoleOptions, RenderableType
from rich.live import Live
from rich.segment import Segment
from rich.text import Text

from .errors import printable


class PlainConsole(Console):
    """A console on which no text is obeyed or taken for markup; its own styles are."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Segments as rich makes them, with marks for what a terminal would obey."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=printable(segment.text))


class Watched:
    """What is being done: shown live on a terminal, in lines elsewhere, and not if `quiet`."""

    def __init__(self, console: Console, quiet: bool = False, live: bool = True) -> None:
        self.console, self.quiet = console, quiet
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
        """Show this live; elsewhere a line, if there is one."""
        if self._live is not None:
            self._live.update(shown)
        elif line:
            self.line(line)

    def line(self, said: str) -> None:
        """Print a line that stays."""
        if not self.quiet:
            self.console.print(Text(said), soft_wrap=True)
