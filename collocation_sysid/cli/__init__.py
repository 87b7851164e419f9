"""The command line: results on stdout, progress and messages on stderr.

Exit codes: 0 converged, 1 not converged or, with ``solve --strict``, doubtful, 2 bad input,
130 interrupted.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from functools import cache
from typing import Annotated, Any, NoReturn

import typer
from rich.text import Text
from typer.main import get_command

from ..errors import InputError, SimulationError
from ..starting import heed_interrupts, leave
from . import designs, problems, runs, streams, studies, texts
from .common import EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_NOT_CONVERGED, errors

app = typer.Typer(
    name="collocation-sysid",
    help="Identify the material parameters of a soft object from motion capture.\n\n"
    "\b\nStart with\n"
    "  collocation-sysid new my_object                    a commented problem file\n"
    "  collocation-sysid check my_object/problem.toml     what will go wrong\n"
    "  collocation-sysid solve my_object/problem.toml     parameters with error bars\n"
    "  collocation-sysid report runs/my_object            everything found, as a page",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

for family in (problems, studies, designs, runs, streams, texts):
    app.registered_commands += family.commands.registered_commands


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(version("collocation-sysid"))
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print it.")
    ] = False,
) -> None:
    pass


@cache
def _commands() -> Callable[..., Any]:
    """The commands; to read their options takes longer than a refusal."""
    return get_command(app)


def main() -> None:
    """Entry point: turns errors into one message and an exit code."""
    try:
        _run()
    except KeyboardInterrupt:  # before or after the command itself
        leave(EXIT_INTERRUPTED)
    except SystemExit as ended:
        leave(ended.code or 0)


def _run() -> None:
    restore = heed_interrupts()
    # That it builds its cache of fonts, or where, is no news to who solves a problem.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    try:
        _commands()(prog_name="collocation-sysid")
    except InputError as error:
        _refuse("error", error, EXIT_BAD_INPUT)
    except OSError as error:
        where = error.filename or "standard output, or a temporary file"
        _refuse("error", InputError(error.strerror or str(error), where), EXIT_BAD_INPUT)
    except SimulationError as error:
        _refuse("simulation failed", error, EXIT_NOT_CONVERGED)
    finally:
        restore()


def _refuse(kind: str, error: Exception, code: int) -> NoReturn:
    errors.print(Text(f"{kind}: ", style="red").append(str(error), style="default"), soft_wrap=True)
    sys.exit(code)
