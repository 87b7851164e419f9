"""Output of the commands: exit codes, error console, results on stdout."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING

import typer
from rich.text import Text

from ..common.display import PlainConsole, Shown, on_terminal, plain_text

if TYPE_CHECKING:
    from ..problem import Problem
    from ..result.solve_progress import SolveProgress

error_console = PlainConsole(stderr=True)

# Exit code of a solve or simulation that ended without an answer.
EXIT_NOT_CONVERGED = 1
# Exit code of bad input, as of wrong usage in most command-line programs.
EXIT_BAD_INPUT = 2
# Exit code after Ctrl-C: 128 + SIGINT (2), as of shells; `main` changes it after SIGTERM to 143.
EXIT_INTERRUPTED = 130
# Width of the output in columns if it is not a terminal: no line is longer.
UNBROKEN_WIDTH = 100_000
EXIT_DOUBTFUL = EXIT_NOT_CONVERGED


def interruption_exit(saved_results: str, *, continues: bool = True) -> typer.Exit:
    """Print on stderr what is kept after an interrupt (`saved_results`) and, if that is continued
    (`continues`), the command for it; return the exit to raise, with `EXIT_INTERRUPTED`.
    """
    again = shlex.join(["collocation-sysid", *sys.argv[1:]])
    text = f"interrupted: {saved_results}"
    error_console.print(
        Text(f"{text}; continue with: {again}" if continues else text), soft_wrap=True
    )
    return typer.Exit(EXIT_INTERRUPTED)


def shown_progress(
    activity: str = "searching for an initial guess",
    problem: Problem | None = None,
    *,
    quiet: bool = False,
    verbose: bool = False,
) -> SolveProgress:
    """Return the display of the progress on stderr, see `SolveProgress`."""
    from ..result.solve_progress import SolveProgress  # which takes a while to import

    return SolveProgress(error_console, problem, verbose, quiet, activity)


def print_result(content: Shown | Iterable[Shown]) -> None:
    """Print on stdout: wrapped between words on a terminal, elsewhere each line and table row
    unbroken, and nothing at all for empty content.
    """
    console = PlainConsole()
    if console.is_terminal:
        console.print(on_terminal(content), crop=False)
    elif text := plain_text(content, width=UNBROKEN_WIDTH):
        console.print(Text(text), soft_wrap=True)
