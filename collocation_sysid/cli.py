"""The command line: results on stdout, progress and messages on stderr.

Exit codes: 0 converged, 1 not converged, 2 bad input, 130 interrupted.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.console import Console, RenderableType
from rich.text import Text

from .errors import InputError, SimulationError

app = typer.Typer(
    name="collocation-sysid",
    help="Identify the material parameters of a soft object from motion capture.\n\n"
    "Start with: collocation-sysid new my_object",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
errors = Console(stderr=True, highlight=False)

ProblemPath = Annotated[Path, typer.Argument(metavar="PROBLEM.toml", help="The problem file.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Override a key, such as parameters.mu_pa.guess=200."
    ),
]
Out = Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Where to write.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="A line per iteration.")]

EXIT_NOT_CONVERGED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130


@app.command()
def solve(
    problem: ProblemPath,
    method: Annotated[str | None, typer.Option(help="Method, instead of the problem's.")] = None,
    out: Out = None,
    set_: Overrides = None,
    as_json: AsJson = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Identify the parameters and write a run folder."""
    from .problem import load_problem
    from .record import as_json as json_text
    from .record import result, write_run
    from .results.solution import Status
    from .results.writers import require_replaceable
    from .run import run
    from .terminal import Progress, summary

    folder = out or Path("runs") / _run_name(problem)
    loaded = load_problem(problem, set_ or ())
    _require_possible(folder)
    require_replaceable(folder)
    with Progress(errors, loaded, verbose=verbose, quiet=quiet) as progress:
        finished = run(loaded, method, watch=progress.iteration, log=progress.say)
        progress.say("writing the run folder")
        write_run(finished, folder)
    if as_json:
        typer.echo(json_text(result(finished)))
    else:
        _show(summary(finished, folder))
    status = finished.solution.status
    if status is Status.INTERRUPTED:
        raise typer.Exit(EXIT_INTERRUPTED)
    raise typer.Exit(0 if status.converged else EXIT_NOT_CONVERGED)


@app.command()
def simulate(
    problem: ProblemPath,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where to write.")],
    set_: Overrides = None,
    integrator: Annotated[
        str, typer.Option(help="newmark, or a scheme: midpoint, backward-euler, bdf2.")
    ] = "newmark",
    timestep_s: Annotated[float | None, typer.Option(help="Newmark's step.")] = None,
    noise_m: Annotated[float, typer.Option(help="Standard deviation of the noise.")] = 0.0,
    seed: Annotated[int, typer.Option(help="Seed of the noise.")] = 0,
    frames: Annotated[bool, typer.Option(help="Also write frames for ParaView.")] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Simulate the experiments at the guesses and write markers and poses as CSV.

    The markers' places are their reference_m, or follow from their file. The parameters are the
    guesses or fixed values: set others with --set.
    """
    from .problem import load_problem
    from .synthesis import write_data
    from .terminal import Progress

    loaded = load_problem(problem, set_ or (), simulation=True)
    _require_possible(out)
    with Progress(errors, loaded, quiet=quiet) as progress:
        written = write_data(
            loaded, out, integrator, timestep_s, noise_m, seed, frames, progress.share
        )
    if as_json:
        typer.echo(json.dumps([str(file) for file in written]))
    else:
        for file in written:
            typer.echo(file)


@app.command()
def check(problem: ProblemPath, set_: Overrides = None, as_json: AsJson = False) -> None:
    """Validate a problem, print its sizes, and check the derivatives."""
    from .check import check_problem
    from .problem import load_problem
    from .terminal import check_table

    findings = check_problem(load_problem(problem, set_ or ()))
    if as_json:
        typer.echo(json.dumps(findings.as_dict(), indent=1))
    else:
        _show(check_table(findings))
    raise typer.Exit(0 if findings.derivatives_agree else EXIT_NOT_CONVERGED)


@app.command()
def plot(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")],
    out: Out = None,
) -> None:
    """Draw the plots of a run again, from its files."""
    from .results.redraw import redraw

    _require_possible(out or run_folder)
    for file in redraw(run_folder, out or run_folder):
        typer.echo(file)


@app.command()
def schema() -> None:
    """Print the JSON schema of the problem file."""
    from .problem import ProblemFile

    typer.echo(json.dumps(ProblemFile.model_json_schema(), indent=1))


@app.command()
def new(name: Annotated[str, typer.Argument(help="Name of the new folder.")]) -> None:
    """Write a commented problem file to start from."""
    from .problem.template import TEMPLATE

    folder = Path(name)
    file = folder / "problem.toml"
    _require_possible(folder)
    if file.exists():
        raise InputError("it is there already; choose another name", file)
    folder.mkdir(parents=True, exist_ok=True)
    title = json.dumps(folder.resolve().name, ensure_ascii=False)  # quoted as TOML quotes
    file.write_text(TEMPLATE.format(title=title), encoding="utf-8")
    typer.echo(file)


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


def _run_name(problem: Path) -> str:
    return problem.resolve().parent.name if problem.stem == "problem" else problem.stem


def _require_possible(folder: Path) -> None:
    """Refuse a folder that cannot be made, before any work is done for it."""
    for place in (folder, *folder.parents):
        if place.is_dir():
            if not os.access(place, os.W_OK):
                raise InputError("this folder cannot be written in; choose another", place)
            return
        if place.exists():
            raise InputError("this is a file; expected a folder to write in", place)


def _show(content: RenderableType) -> None:
    """Print on stdout; a terminal wraps long lines itself, and files keep them whole."""
    Console(highlight=False).print(content, soft_wrap=True)


def main() -> None:
    """Entry point: turns errors into one message and an exit code."""
    try:
        app(prog_name="collocation-sysid")
    except InputError as error:
        _refuse("error", error, EXIT_BAD_INPUT)
    except OSError as error:
        reason = InputError(error.strerror or str(error), error.filename)
        _refuse("error", reason, EXIT_BAD_INPUT)
    except SimulationError as error:
        _refuse("simulation failed", error, EXIT_NOT_CONVERGED)


def _refuse(kind: str, error: Exception, code: int) -> NoReturn:
    errors.print(Text(f"{kind}: ", style="red").append(str(error), style="default"), soft_wrap=True)
    sys.exit(code)
