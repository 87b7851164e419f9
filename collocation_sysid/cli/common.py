"""How the commands speak: exit codes, errors, results."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterable

import typer
from rich.text import Text

from ..console import PlainConsole
from ..display import Shown, on_terminal

errors = PlainConsole(stderr=True)

EXIT_NOT_CONVERGED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130
EXIT_DOUBTFUL = EXIT_NOT_CONVERGED


def interrupted(kept: str) -> typer.Exit:
    """Say what is kept and how to go on; the exit to raise."""
    again = shlex.join(["collocation-sysid", *sys.argv[1:]])
    errors.print(Text(f"interrupted: {kept}; go on with: {again}"), soft_wrap=True)
    return typer.Exit(EXIT_INTERRUPTED)


def show(content: Shown | Iterable[Shown]) -> None:
    """Print on stdout: on a terminal wrapped between words, in files with lines kept whole."""
    console = PlainConsole()
    console.print(on_terminal(content), soft_wrap=not console.is_terminal)
