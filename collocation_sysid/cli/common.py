"""How the commands speak: exit codes, errors, results."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterable

import typer
from rich.text import Text

from ..console import PlainConsole
from ..display import Shown, on_terminal, plain_text

errors = PlainConsole(stderr=True)

EXIT_NOT_CONVERGED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130
# Width of what others read, in columns: more than any line has.
UNBROKEN = 100_000
EXIT_DOUBTFUL = EXIT_NOT_CONVERGED


def interrupted(kept: str) -> typer.Exit:
    """Say what is kept and how to go on; the exit to raise."""
    again = shlex.join(["collocation-sysid", *sys.argv[1:]])
    errors.print(Text(f"interrupted: {kept}; go on with: {again}"), soft_wrap=True)
    return typer.Exit(EXIT_INTERRUPTED)


def show(content: Shown | Iterable[Shown]) -> None:
    """Print on stdout: on a terminal wrapped between words, elsewhere each line and row whole."""
    console = PlainConsole()
    if console.is_terminal:
        console.print(on_terminal(content), crop=False)
    elif text := plain_text(content, width=UNBROKEN):
        console.print(Text(text), soft_wrap=True)
