"""Commands that take a problem: solve, simulate and check."""

from __future__ import annotations

import json
import shlex
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from ..common.files import replaced_file, require_possible, run_name
from ..common.serialisation import as_json
from ..common.signal_handling import INTERRUPTS
from ..errors import InputError, SimulationError
from ..methods import require_method
from ..methods.solution import Status
from ..pipeline import run
from ..result.run_record import draw_run, listed_result, write_run
from ..result.run_writers import require_replaceable
from ..result.synthesis import Recipe, write_data
from ..runs.check import check_problem, quick_check
from ..runs.facts import facts, sentences
from .command_options import OneMethod, OutputFolder, OutputOptions, ProblemOptions, command, option
from .common import (
    EXIT_DOUBTFUL,
    EXIT_INTERRUPTED,
    EXIT_NOT_CONVERGED,
    error_console,
    interruption_exit,
    print_result,
    shown_progress,
)

if TYPE_CHECKING:
    from ..problem import Problem

commands = typer.Typer()


@command(
    commands,
    "solve problem.toml",
    "solve problem.toml --method interior-point --out runs/ip",
    "solve problem.toml --set parameters.mu_pa.guess=200",
    "solve finer.toml --start runs/coarse",
)
def solve(
    *,
    method: OneMethod = None,
    out: OutputFolder = None,
    start: Annotated[
        Path | None, option("Start from the result in this run folder.", "RUN")
    ] = None,
    scheduler: Annotated[
        str | None,
        option(
            "Address of a dask.distributed scheduler whose workers compute the experiments.",
            "ADDRESS",
        ),
    ] = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Print a line per iteration.")
    ] = False,
    strict: Annotated[bool, option("Exit code 1 if the verdict is doubtful.")] = False,
    details: Annotated[
        bool, option("Show everything: statistical parts, corrections, notes, residuals, times.")
    ] = False,
    budget: Annotated[
        bool,
        option(
            "Show the contributions to the variance of each estimate, and the effects of the budget."
        ),
    ] = False,
    pictures: Annotated[
        bool, option("Draw pictures into the run folder; the command plot can draw them later.")
    ] = True,
    source: ProblemOptions,
    output: OutputOptions,
) -> None:
    """Identify the parameters and write a run folder, runs/NAME by default.

    Parameters need no guess: a scan over the stiffness finds initial values. --start begins with
    the result of an earlier run instead, which may have another mesh or time step.

    --scheduler distributes the experiments to the workers of a cluster.

    Options of a method are set in its table of the problem file, such as [solver.reduced-space], or
    with --set, as in --set solver.reduced-space.tolerance=1e-6. The command methods lists them.

    The exit code is 0 if the search converged, 1 if it did not, or if the verdict is doubtful with
    --strict, 2 for bad input, 130 after Ctrl-C, and 143 after SIGTERM.
    """
    from ..result.run_summary import next_step, run_summary

    if method is not None:
        require_method(method, "--method")
    folder = out or Path("runs") / run_name(source.problem)
    problem = source.read_problem(output.quiet)
    require_possible(folder)
    require_replaceable(folder)
    problem = replace(problem, notes=(*problem.notes, *sentences(facts(problem))))
    replaced = listed_result(folder)
    no_output = None
    with ExitStack() as until_saved:
        with shown_progress(problem=problem, quiet=output.quiet, verbose=verbose) as progress:
            try:
                finished = run(
                    problem,
                    method,
                    watch=progress.iteration,
                    log=progress.say,
                    start=start,
                    scheduler=scheduler,
                )
            except KeyboardInterrupt:
                raise interruption_exit(
                    f"no result could be kept; nothing was written to {folder}", continues=False
                ) from None
            until_saved.enter_context(INTERRUPTS.deferred())
        if not output.as_json:
            try:
                print_result(run_summary(finished.result, details=details, budget=budget))
            except OSError as error:  # a standard output that is closed or full loses no run
                no_output = error
        # Notes of the problem were shown before.
        with shown_progress("writing the run folder", quiet=output.quiet, verbose=verbose):
            try:
                write_run(finished, finished.result, folder, pictures=False, replaced=replaced)
            except InputError:
                if output.as_json:
                    typer.echo(as_json(finished.result))
                raise
        if no_output is not None:
            raise no_output
        if not output.as_json:
            print_result(f"written to {folder}")
        drawn = finished.result
        try:
            until_saved.close()
            if pictures:
                with shown_progress(quiet=output.quiet, verbose=verbose) as progress:
                    drawn = draw_run(finished, drawn, folder, report=progress.say)
        except KeyboardInterrupt:
            drawn = None
            again = shlex.join(["collocation-sysid", "plot", str(folder)])
            message = f"interrupted: the result is kept in {folder}, but some pictures are missing"
            error_console.print(Text(f"{message}; draw them with: {again}"), soft_wrap=True)
    result = drawn or finished.result
    if output.as_json:
        typer.echo(as_json(result))
    else:
        if details and result.elapsed_s.pictures is not None:
            print_result(f"pictures drawn in {result.elapsed_s.pictures:.1f} s")
        print_result(f"next: {next_step(result, folder)}")
    status = finished.solution.status
    if drawn is None or status is Status.INTERRUPTED or finished.omitted_checks:
        raise typer.Exit(EXIT_INTERRUPTED)
    if strict and finished.trust.verdict == "doubtful":
        raise typer.Exit(EXIT_DOUBTFUL)
    raise typer.Exit(0 if status.converged else EXIT_NOT_CONVERGED)


@command(
    commands,
    "simulate problem.toml --out data --noise-m 0.001 --seed 1",
    "simulate problem.toml --out data --set parameters.mu_pa.guess=300",
)
def simulate(
    *,
    out: Annotated[Path, option("Output folder.", "DIR")],
    recipe: Recipe,
    source: ProblemOptions,
    output: OutputOptions,
) -> None:
    """Simulate at the guesses and write the measurements and poses as CSV.

    The positions of the markers are their reference_m, or follow from their file. The parameters
    are the guesses or fixed values; set other values with --set. Tables of force sensors, custom
    sensors, test benches and specimens are written, too. The names of the files are printed.

    Files of an earlier simulation are replaced. If the folder contains other files, nothing is
    written, unless it is the folder of the problem; data files of the problem are never replaced.
    If the body loses its stability, instability.png shows how.
    """
    problem = source.read_problem(output.quiet, simulation=True)
    require_possible(out)
    notes: list[str] = []
    with shown_progress("simulating", problem, quiet=output.quiet) as progress:
        try:
            written = write_data(
                problem, out, recipe=recipe, progress=progress.share, report=notes.append
            )
        except SimulationError as error:
            if error.stability_loss is not None:
                _draw_instability(error, out)
            raise
    for note in notes:
        error_console.print(Text(f"note: {note}"), soft_wrap=True)
    if output.as_json:
        typer.echo(json.dumps([str(file) for file in written]))
    else:
        for file in written:
            typer.echo(file)


def _draw_instability(error: SimulationError, folder: Path) -> None:
    from ..result.figure_style import RESOLUTION_DPI
    from ..result.pictures.instability import instability_picture

    file = folder / "instability.png"
    folder.mkdir(parents=True, exist_ok=True)
    with replaced_file(file) as draft:
        instability_picture(error.stability_loss).savefig(draft, dpi=RESOLUTION_DPI)
    error_console.print(f"the mode is drawn in {file}")


@command(
    commands,
    "check problem.toml",
    "check problem.toml --full",
    "check problem.toml --out pictures",
    "check problem.toml --set transcription.scheme=backward-euler",
)
def check(
    *,
    full: Annotated[
        bool,
        option(
            "Simulate the complete recordings and make all comparisons, however long this takes."
        ),
    ] = False,
    details: Annotated[
        bool,
        option("Show everything: quality of the elements, modes, all grasps and methods, notes."),
    ] = False,
    out: Annotated[
        Path | None,
        option(
            "Folder for pictures of the images of depth cameras; runs/<problem>_check by default.",
            "DIR",
        ),
    ] = None,
    source: ProblemOptions,
    output: OutputOptions,
) -> None:
    """Check a problem before solving it, and report probable mistakes.

    The bodies, recordings and grasps are shown immediately. The check of the derivatives, the cost
    of a solve and a simulation at the guess follow. If a simulation of the complete recordings
    would take more than ten seconds, only their first samples are simulated.

    For each depth camera, a picture shows the first image and the undeformed body. The pictures are
    written into runs/NAME_check by default; with --json no pictures are written.

    The exit code is 0, and 1 if derivatives disagree or the description is probably wrong, 2 for
    bad input.
    """
    from ..result.check_sections import full_check_tables, quick_check_tables

    problem = source.read_problem(output.quiet)
    if not output.as_json:
        with shown_progress("checking bodies, recordings and grasps", quiet=output.quiet):
            findings_at_once = quick_check(problem)
        print_result(quick_check_tables(findings_at_once, details))
        _write_camera_overlays(
            problem, out or Path("runs") / f"{run_name(source.problem)}_check", quiet=output.quiet
        )
    with shown_progress("preparing the complete program", quiet=output.quiet) as progress:
        findings = check_problem(problem, progress.say, full=full)
    output.print_result(findings.as_dict(), full_check_tables(findings, details))
    good = not (findings.derivative_fault or findings.causes)
    raise typer.Exit(0 if good else EXIT_NOT_CONVERGED)


def _write_camera_overlays(problem: Problem, folder: Path, quiet: bool) -> None:
    if not any(each.camera_names for each in problem.experiments):
        return
    from ..result.camera_overlays import OVERLAY_TEXT, save_overlays

    require_possible(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with shown_progress("drawing the views of the cameras", quiet=quiet):
        files = save_overlays(problem.experiments, folder)
    for file in files:
        typer.echo(f"{OVERLAY_TEXT}: {file}")
