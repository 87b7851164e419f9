"""Command line of the package: results on stdout, progress and messages on stderr.

Each command is a function in one of the modules `FAMILIES`: `problem_commands` (solve, simulate,
check), `run_commands` (refine, export, plot, report, animate), `study_commands`
(compare-methods, compare-models), `plan_commands` (plan), `stream_commands` (live,
replay), `track_commands` (track), `installation_commands` (doctor) and `texts`
(methods, schema, explain, log, new). `command_options` makes command-line options from parameters,
`common` has exit codes and output, and `markdown` shows documentation on a terminal.

Exit codes: 0 converged, 1 not converged or, with ``solve --strict``, doubtful, 2 bad input,
130 interrupted by Ctrl-C (SIGINT), 143 by SIGTERM.
"""

from __future__ import annotations

import ast
import gc
import io
import logging
import os
import sys
import warnings
from collections.abc import Callable
from contextlib import chdir
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from rich.text import Text
from typer.core import TyperGroup
from typer.main import get_command, get_command_from_info

from ..common.files import reason
from ..common.installation import package_version
from ..common.limits import machine_memory_mb
from ..common.signal_handling import INTERRUPTS, heed_interrupts, ignore_interrupts, leave
from ..errors import ImplausibleMarkersError, InputError, SimulationError, hint_at
from .common import EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_NOT_CONVERGED, error_console

# Memory that libraries need to be loaded [MB]: 1200 suffice on two cores, with 800 some hang.
LEAST_MEMORY_MB = 1200
FAMILIES = (
    "problem_commands",
    "study_commands",
    "plan_commands",
    "run_commands",
    "stream_commands",
    "track_commands",
    "texts",
    "installation_commands",
)
# Groups of commands in the help, in the order in which a user needs them.
COMMAND_GROUPS = {
    "Identify parameters": ("new", "check", "solve", "refine", "live", "replay"),
    "Inspect a run": ("report", "plot", "animate"),
    "Extend a study": ("simulate", "compare-models", "compare-methods", "plan"),
    "Exchange data": ("log", "track", "export"),
    "Reference and installation": ("explain", "methods", "schema", "doctor"),
}
# Commands that were replaced, with the message to who types their old name.
REPLACED_COMMANDS = {
    "compare": "it was divided in two. compare-methods compares the methods that --methods names, "
    "and compare-models compares materials, laws of damping and branches by held-out data",
    "topics": "it was renamed. log LOG lists the topics in a robot's log",
}


@cache
def command_sources() -> dict[str, tuple[str, str]]:
    """Return the module and the first help line of each command by its name, in the order of
    `FAMILIES` and of the files; read from the source without importing.
    """
    commands = {}
    for family in FAMILIES:
        text = Path(__file__).with_name(f"{family}.py").read_text(encoding="utf-8")
        for each in ast.parse(text).body:
            if isinstance(each, ast.FunctionDef) and each.decorator_list:
                summary = (ast.get_docstring(each) or "").partition("\n")[0]
                commands[_command_name(each.name)] = (f"{__name__}.{family}", summary)
    return commands


def _command_name(function: str) -> str:
    return function.replace("_", "-")


class LazyCommands(TyperGroup):
    """Group of commands that imports only the module of the requested command.

    Importing all of them would take seconds.
    """

    def list_commands(self, ctx: Any) -> list[str]:
        return [*command_sources()]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in command_sources():
            return None
        gc.disable()  # nothing that modules define is ever garbage
        with error_console.status("starting"):  # on a terminal only; it takes a second
            family = import_module(command_sources()[cmd_name][0]).commands.registered_commands
        gc.freeze()
        gc.enable()
        info = next(each for each in family if _command_name(each.callback.__name__) == cmd_name)
        how = {"pretty_exceptions_short": False, "rich_markup_mode": None}
        return get_command_from_info(info, **how)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Name a similar command for an unknown one."""
        if args and (replacement := REPLACED_COMMANDS.get(args[0])):
            ctx.fail(f"No such command {args[0]!r}: {replacement}.")
        if args and args[0] not in command_sources() and not ctx.resilient_parsing:
            ctx.fail(f"No such command {args[0]!r}{hint_at(args[0], command_sources()) or '.'}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        sources = command_sources()
        for title, names in COMMAND_GROUPS.items():
            with formatter.section(title):
                formatter.write_dl([(name, sources[name][1]) for name in names])


app = typer.Typer(
    name="collocation-sysid",
    cls=LazyCommands,
    help="Identify the material parameters of a soft object from video, motion capture or bench "
    "tests, and plan motions with it.\n\n"
    "\b\nStart with\n"
    "  collocation-sysid new my_object --kind video       a problem file for a video\n"
    "  collocation-sysid new my_object --kind specimen    or for a bench test\n"
    "  collocation-sysid check my_object/problem.toml     find mistakes before a solve\n"
    "  collocation-sysid solve my_object/problem.toml     parameters with error bars\n"
    "  collocation-sysid report runs/my_object            all results as a web page\n"
    "  collocation-sysid plan runs/my_object task.toml    a motion of the hand for a task",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _print_version(is_requested: bool) -> None:
    if is_requested:
        typer.echo(package_version())
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Do nothing: the options of the program itself act by their callbacks."""
    pass


@cache
def _root_command() -> Callable[..., Any]:
    return get_command(app)


def main() -> None:
    """Run the command line and end the process: errors become one message on stderr and an exit
    code, see the module; it does not return.
    """
    # Libraries start Python themselves, which must not search the working folder for modules.
    os.environ["PYTHONSAFEPATH"] = "1"
    if isinstance(sys.stdout, io.TextIOWrapper):  # whose encoding may be ASCII
        sys.stdout.reconfigure(errors="backslashreplace")
    # Warnings and logs of libraries are for programmers; trial steps of a search overflow anyway.
    warnings.simplefilter("ignore")
    logging.basicConfig(handlers=[logging.NullHandler()])
    try:
        _run_command()
    except KeyboardInterrupt:  # before or after the command itself
        leave(128 + INTERRUPTS.number)
    except SystemExit as ended:
        leave(128 + INTERRUPTS.number if ended.code == EXIT_INTERRUPTED else ended.code or 0)


def _run_command() -> None:
    heed_interrupts()
    if Path("matplotlibrc").is_file():
        # matplotlib obeys the one in the working folder when it is imported.
        with chdir(Path(__file__).parent):
            import_module("matplotlib")
    try:
        _require_memory()
        _root_command()(prog_name="collocation-sysid")
    except InputError as error:
        _exit_with_error("error", error, code=EXIT_BAD_INPUT, end=_likely_cause(error))
    except (ImportError, MemoryError) as error:
        cause = "the installation is damaged, or this process has too little memory"
        _exit_with_error("error", InputError(f"{cause} ({reason(error)})"), code=EXIT_BAD_INPUT)
    except OSError as error:
        where = error.filename or "standard output, or a temporary file"
        _exit_with_error(
            "error", InputError(error.strerror or str(error), where), code=EXIT_BAD_INPUT
        )
    except SimulationError as error:
        _exit_with_error("simulation failed", error, code=EXIT_NOT_CONVERGED)
    finally:
        ignore_interrupts()


def _require_memory() -> None:
    """Refuse a limit of memory with which libraries crash or hang while they are loaded."""
    memory_mb = machine_memory_mb()
    if memory_mb is not None and memory_mb < LEAST_MEMORY_MB:
        raise InputError(
            f"this process may have {memory_mb:.0f} MB of memory (ulimit -v, or a container); expected "
            f"at least {LEAST_MEMORY_MB} MB"
        )


def _likely_cause(error: BaseException | None) -> str:
    """Return the likely cause of an `ImplausibleMarkersError`, or of an error that one caused, as an
    addition to its message; empty if none is known.
    """
    seen: set[int] = set()  # an error that is raised again may be its own cause
    while error is not None and not isinstance(error, ImplausibleMarkersError):
        seen.add(id(error))
        error = None if id(error.__cause__) in seen else error.__cause__
    if error is None:
        return ""
    from ..judge.modes import find_misspecifications_by_modes

    causes = find_misspecifications_by_modes(error.experiment, error.constants)
    return f"; likely {causes[0].message}" if causes else ""


def _exit_with_error(kind: str, error: Exception, code: int, end: str = "") -> NoReturn:
    error_console.print(
        Text(f"{kind}: ", style="red").append(f"{error}{end}", style="default"), soft_wrap=True
    )
    sys.exit(code)
