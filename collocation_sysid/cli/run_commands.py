"""Commands that take a run folder: refine, export, plot, report and animate."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..common.files import require_possible, write_text_file
from ..common.serialisation import as_json, content
from ..common.validated_classes import validated
from ..errors import InputError
from .command_options import (
    AllowCode,
    AsJson,
    OneExperiment,
    OutputFolder,
    OutputOptions,
    Quiet,
    RunFolderOptions,
    command,
)
from .common import error_console, interruption_exit, print_result

if TYPE_CHECKING:
    from ..extras.export import ExportDestination  # which takes a second to import

commands = typer.Typer()


@validated(kw_only=True)
class RefineCommand(RunFolderOptions, OutputOptions):
    """Options of `refine`.

    Attributes
    ----------
    levels : int
        Number of time steps and meshes to compare: 2, or 3 to measure the orders of convergence,
        which takes much longer.
    """

    levels: int = 2
    allow_code: AllowCode = False


@command(commands, "refine runs/swing", "refine runs/swing --levels 3")
def refine(options: RefineCommand) -> None:
    """Solve again with half the time step and on a finer mesh, to measure the discretisation error.

    Each solve starts from the result of the run. The errors are written to refinement.json in the
    run folder, and added to result.json with corrected values and combined intervals. After an
    interruption, the same command continues where it stopped.
    """
    from ..result.run_refinement import refine_run
    from ..result.run_sections import refinement_table, verdict_section
    from ..result.solve_progress import SolveProgress

    try:
        with SolveProgress(
            error_console, quiet=options.quiet, activity=f"reading {options.run_folder}"
        ) as progress:
            refinement, result = refine_run(
                options.run_folder,
                options.levels,
                allow_code=options.allow_code,
                say=progress.announce,
                watch=progress.iteration,
            )
    except KeyboardInterrupt:
        raise interruption_exit(
            f"the solves that were completed are kept in {options.run_folder}"
        ) from None
    report = {**content(refinement), "trust": result.trust}
    options.print_result(report, [refinement_table(result), verdict_section(result.trust)])


@dataclass(frozen=True, kw_only=True)
class ExportCommand(RunFolderOptions):
    """Options of `export`.

    Attributes
    ----------
    to : FILE|FORMAT
        Destination: a file .xml (MuJoCo), .usda, .py (Newton), .inp (CalculiX), .json or .rrd
        (Rerun); or a format: mujoco, usd, newton, calculix, json, rerun.
    out : DIR
        Folder for a format, instead of export-FORMAT in the run folder.
    verify : bool
        Simulate the exported body in the target, and compare the results.
    """

    to: str
    out: Path | None = None
    experiment: OneExperiment = None
    verify: bool = False
    allow_code: AllowCode = False
    as_json: AsJson = False
    quiet: Quiet = False


@command(
    commands,
    "export runs/swing --to body.inp",
    "export runs/swing --to mujoco",
    "export runs/swing --to calculix --out deck --verify",
)
def export(options: ExportCommand) -> None:
    """Write the identified body for another simulator: mesh, material, damping, grasp.

    Properties that the target cannot represent are printed. If --to names a file, the format
    follows from its suffix; the poses and identified.json are written beside it, with the name of
    the file as prefix. If --to names a format, a folder of files is written, by default export-
    FORMAT in the run folder. A folder whose name is a format, such as out/mujoco, is a destination
    too.

    The format rerun is a recording for the Rerun viewer: the motion of all experiments, or of the
    one that --experiment names.
    """
    from ..extras.export import MAIN_FILES, parse_destination
    from ..extras.export.rerun_recording import TARGET as RECORDING

    destination = parse_destination(
        options.to, MAIN_FILES, run_folder=options.run_folder, out=options.out
    )
    if destination.format_name == RECORDING:
        _export_recording(options, destination)
    else:
        _export_body(options, destination)


def _export_body(options: ExportCommand, destination: ExportDestination) -> None:
    """Write the body of a run for a simulator, and print warnings, what the simulator cannot
    express, the comparison if the export is verified, and the destination; or all of this as JSON.
    """
    from ..extras.export import (
        TARGETS,
        IdentifiedBody,
        comparison_table,
        verify_export,
        write_export,
    )
    from ..result.solve_progress import SolveProgress

    name = destination.format_name
    target = TARGETS[name]
    destination.require_possible()
    compared = []
    with SolveProgress(
        error_console, quiet=options.quiet, activity=f"reading {options.run_folder}"
    ) as progress:
        body = IdentifiedBody.read(
            options.run_folder, options.experiment, allow_code=options.allow_code
        )
        progress.say(f"writing the body for {target.name}")
        with destination.export_folder() as folder:
            exported = write_export(body, name, folder=folder)
            destination.place_files(folder, target.main_file)
            if options.verify:
                progress.say(f"comparing with predictions of {target.name}")
                compared = verify_export(body, name, folder=folder)
    if options.as_json:
        report = {
            "folder": str(destination.folder),
            "file": str(destination.main_file),
            "warnings": body.warnings,
            "not_expressed": exported.limitations,
            "verified": [
                {**asdict(each), "relative": each.compute_relative_difference()}
                for each in compared
            ],
        }
        typer.echo(as_json(report))
        return
    print_result(f"warning: {each}" for each in body.warnings)
    print_result(f"not expressed: {each}" for each in exported.limitations)
    if options.verify:
        print_result(comparison_table(target.name, compared))
    typer.echo(destination.folder if destination.is_folder else destination.main_file)


def _export_recording(options: ExportCommand, destination: ExportDestination) -> None:
    """Write the recording of a run for the Rerun viewer, and print what is missing in it and the
    file; or both as JSON.
    """
    from ..extras.export.rerun_recording import RECORDING_FILE, write_rerun
    from ..result.solve_progress import SolveProgress

    if options.verify:
        raise InputError(
            "a recording for a viewer has no predictions to verify; leave out --verify",
            None,
            where="--verify",
        )
    destination.require_possible()
    with (
        SolveProgress(error_console, quiet=options.quiet, activity="writing the recording"),
        destination.export_folder() as folder,
    ):
        missing = write_rerun(options.run_folder, folder, experiment=options.experiment)
        destination.place_files(folder, RECORDING_FILE)
    if options.as_json:
        report = {
            "folder": str(destination.folder),
            "file": str(destination.main_file),
            "not_expressed": missing,
        }
        typer.echo(as_json(report))
        return
    print_result(f"not expressed: {each}" for each in missing)
    typer.echo(destination.main_file)


@dataclass(frozen=True, kw_only=True)
class PlotCommand(RunFolderOptions):
    """Options of `plot`, all of which are shared."""

    out: OutputFolder = None
    quiet: Quiet = False


@command(commands, "plot runs/swing")
def plot(options: PlotCommand) -> None:
    """Draw the pictures of a run again, from its files.

    The new pictures replace those in the run folder, or are written into the folder of --out; their
    names are printed. The picture of the Jacobian is not drawn again.
    """
    from ..result.pictures.album import redraw_pictures
    from ..result.solve_progress import SolveProgress

    folder = options.out or options.run_folder
    require_possible(folder)
    with SolveProgress(error_console, quiet=options.quiet) as progress:
        files = redraw_pictures(options.run_folder, folder, say=progress.say)
    for file in files:
        typer.echo(file)


@dataclass(frozen=True, kw_only=True)
class ReportCommand:
    """Options of `report`.

    Attributes
    ----------
    folder : FOLDER
        A run folder, or the output folder of compare-methods, compare-models or sweep.
    to : FILE
        Output file, .html or .md; report.html in the folder by default.
    """

    folder: Annotated[Path, typer.Argument()]
    to: Path | None = None
    quiet: Quiet = False


@command(commands, "report runs/swing", "report runs/swing-sweep --to sweep.html")
def report(options: ReportCommand) -> None:
    """Write a report of a run or a study as one HTML page or a Markdown file.

    The report contains all results and the pictures; a Markdown file links to the pictures.
    """
    from ..result.report import comparison_report, report_text
    from ..result.run_sections import run_report
    from ..result.solve_progress import SolveProgress

    folder = options.folder
    file = options.to or options.folder / "report.html"
    study = (folder / "summary.json").is_file()
    with SolveProgress(error_console, quiet=options.quiet, activity="writing the report"):
        page = comparison_report(folder) if study else run_report(folder)
        require_possible(file.parent)
        write_text_file(file, report_text(page, file))
    typer.echo(file)


@dataclass(frozen=True, kw_only=True)
class AnimateCommand(RunFolderOptions):
    """Options of `animate`.

    Attributes
    ----------
    to : FILE
        Output file: .gif, or .mp4, which needs ffmpeg; EXPERIMENT.gif in the run folder by default.
    fps : float
        Frames per second.
    slow : float
        Slow-motion factor: how many times slower than in reality.
    """

    to: Path | None = None
    fps: float = 25.0
    slow: float = 1.0
    experiment: OneExperiment = None
    quiet: Quiet = False


@command(commands, "animate runs/swing --to swing.mp4", "animate runs/swing --slow 4")
def animate(options: AnimateCommand) -> None:
    """Make a film of a run: the fitted body beside its forward simulation."""
    from ..result.animation import animate as film
    from ..result.solve_progress import SolveProgress

    require_possible(options.run_folder if options.to is None else options.to.parent)
    with SolveProgress(error_console, quiet=options.quiet, activity="making the film"):
        file = film(
            options.run_folder,
            options.to,
            fps=options.fps,
            slowdown=options.slow,
            experiment=options.experiment,
        )
    typer.echo(file)
