"""Markdown on a terminal, with code blocks that can be copied."""

from __future__ import annotations

from typing import ClassVar

from rich.console import Console, ConsoleOptions, RenderResult
from rich.markdown import CodeBlock, Markdown
from rich.text import Text


class UnbrokenCode(CodeBlock):
    """A code block of Markdown whose lines are never broken."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the lines of the code, each indented by two spaces, whatever the width of the
        console.
        """
        for line in str(self.text).rstrip().splitlines():
            yield Text(f"  {line}", style="cyan", no_wrap=True, overflow="ignore")


class TerminalPage(Markdown):
    """Markdown document whose text is wrapped to the terminal and whose code is not."""

    elements: ClassVar = {**Markdown.elements, "fence": UnbrokenCode, "code_block": UnbrokenCode}
