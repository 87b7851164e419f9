"""Commands that take a run folder: refine, export, plot, report and animate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..common.display import Table
from ..common.files import require_possible, write_text_file
from ..common.serialisation import as_json as json_text
from ..common.serialisation import content
from ..common.validated_types import AtLeastOne, Count
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
    option,
)
from .common import interruption_exit, print_result, shown_progress

if TYPE_CHECKING:
    from ..extras.export import ExportDestination  # which takes a second to import

commands = typer.Typer()


@command(commands, "refine runs/swing", "refine runs/swing --levels 3")
def refine(
    *,
    levels: Annotated[
        int,
        option(
            "Number of time steps and meshes to compare: 2, or 3 to measure the orders of "
            "convergence, which takes much longer."
        ),
    ] = 2,
    allow_code: AllowCode = False,
    run: RunFolderOptions,
    output: OutputOptions,
) -> None:
    """Solve again with half the time step and on a finer mesh, to measure the discretisation error.

    Each solve starts from the result of the run. The errors are written to refinement.json in the
    run folder, and added to result.json with corrected values and combined intervals. After an
    interruption, the same command continues where it stopped.
    """
    from ..result.run_refinement import refine_run
    from ..result.run_sections import refinement_table, verdict_section

    require_possible(run.run_folder)
    try:
        with shown_progress(f"reading {run.run_folder}", quiet=output.quiet) as progress:
            refinement, result = refine_run(
                run.run_folder,
                levels,
                allow_code=allow_code,
                say=progress.announce,
                watch=progress.iteration,
            )
    except KeyboardInterrupt:
        raise interruption_exit(
            f"the solves that were completed are kept in {run.run_folder}"
        ) from None
    report = {**content(refinement), "trust": result.trust}
    output.print_result(report, [refinement_table(result), verdict_section(result.trust)])


@command(
    commands,
    "export runs/swing --to body.inp",
    "export runs/swing --to mujoco",
    "export runs/swing --to calculix --out deck --verify",
    "export runs/swing --to usd --out bodies --samples 100",
)
def export(
    *,
    to: Annotated[
        str,
        option(
            "Destination: a file .xml (MuJoCo), .usda, .py (Newton), .inp (CalculiX), .inc (Abaqus), .feb "
            "(FEBio), .json or .rrd (Rerun); or a format: mujoco, usd, newton, calculix, abaqus, "
            "febio, json, rerun.",
            "FILE|FORMAT",
        ),
    ],
    out: Annotated[
        Path | None,
        option("Folder for a format, instead of export-FORMAT in the run folder.", "DIR"),
    ] = None,
    experiment: OneExperiment = None,
    samples: Annotated[
        AtLeastOne | None,
        option(
            "Write this number of bodies, with constants drawn from their combined distribution, into "
            "sample_001, sample_002, … of a folder, and samples.csv with their constants.",
            "N",
        ),
    ] = None,
    seed: Annotated[Count, option("Seed of the draws of --samples.", "N")] = 0,
    verify: Annotated[
        bool, option("Simulate the exported body in the target, and compare the results.")
    ] = False,
    allow_code: AllowCode = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    run: RunFolderOptions,
) -> None:
    """Write the identified body for another simulator: mesh, material, damping, grasp.

    Properties that the target cannot represent are printed. If --to names a file, the format
    follows from its suffix; the poses and identified.json are written beside it, with the name of
    the file as prefix. If --to names a format, a folder of files is written, by default export-
    FORMAT in the run folder. A folder whose name is a format, such as out/mujoco, is a destination
    too.

    The format rerun is a recording for the Rerun viewer: the motion of all experiments, or of the
    one that --experiment names.
    """
    from ..extras.export import (
        MAIN_FILES,
        TARGETS,
        IdentifiedBody,
        comparison_table,
        parse_destination,
        read_draws,
        verify_export,
        write_draws,
        write_export,
    )
    from ..extras.export.rerun_recording import TARGET as RECORDING

    destination = parse_destination(to, MAIN_FILES, run_folder=run.run_folder, out=out)
    name = destination.format_name
    if samples is not None and (verify or name == RECORDING or not destination.is_folder):
        raise InputError(
            f"found --samples with {'--verify' if verify else f'--to {to}'}; expected a format of "
            "bodies, such as mujoco or usd, and a folder as --out",
            None,
            where="--samples",
        )
    if name == RECORDING:
        if verify:
            raise InputError(
                "a recording for a viewer has no predictions to verify; leave out --verify",
                None,
                where="--verify",
            )
        missing = _export_recording(run.run_folder, destination, experiment, quiet=quiet)
        _print_export(destination, {"not_expressed": missing}, as_json)
        return
    target = TARGETS[name]
    destination.require_possible()
    compared = []
    with shown_progress(f"reading {run.run_folder}", quiet=quiet) as progress:
        body = IdentifiedBody.read(run.run_folder, experiment, allow_code=allow_code)
        progress.say(f"writing the body for {target.name}")
        with destination.export_folder() as folder:
            if samples is None:
                exported = write_export(body, name, folder=folder)
            else:
                draws = read_draws(run.run_folder, samples, seed, allow_code)
                exported = write_draws(body, draws, name, folder)
            destination.place_files(folder, target.main_file)
            if verify:
                progress.say(f"comparing with predictions of {target.name}")
                compared = verify_export(body, name, folder=folder)
    verified = [{**asdict(each), "relative": each.relative_difference} for each in compared]
    report = {"warnings": body.warnings, "not_expressed": exported.limitations}
    table = [comparison_table(target.name, compared)] if verify else []
    _print_export(destination, {**report, "verified": verified}, as_json, table)


def _print_export(
    destination: ExportDestination,
    report: Mapping[str, Any],
    as_json: bool,
    tables: Sequence[Table] = (),
) -> None:
    if as_json:
        places = {"folder": str(destination.folder), "file": str(destination.main_file)}
        typer.echo(json_text({**places, **report}))
        return
    print_result(f"warning: {each}" for each in report.get("warnings", ()))
    print_result(f"not expressed: {each}" for each in report["not_expressed"])
    print_result(tables)
    typer.echo(destination.folder if destination.is_folder else destination.main_file)


def _export_recording(
    run_folder: Path, destination: ExportDestination, experiment: str | None, quiet: bool
) -> Sequence[str]:
    from ..extras.export.rerun_recording import RECORDING_FILE, write_rerun

    destination.require_possible()
    with (
        shown_progress("writing the recording", quiet=quiet),
        destination.export_folder() as folder,
    ):
        missing = write_rerun(run_folder, folder, experiment=experiment)
        destination.place_files(folder, RECORDING_FILE)
    return missing


@command(commands, "plot runs/swing")
def plot(*, out: OutputFolder = None, quiet: Quiet = False, run: RunFolderOptions) -> None:
    """Draw the pictures of a run again, from its files.

    The new pictures replace those in the run folder, or are written into the folder of --out; their
    names are printed. The picture of the Jacobian is not drawn again.
    """
    from ..result.pictures.album import redraw_pictures

    folder = out or run.run_folder
    require_possible(folder)
    with shown_progress("drawing pictures", quiet=quiet) as progress:
        files = redraw_pictures(run.run_folder, folder, say=progress.say)
    for file in files:
        typer.echo(file)


@command(commands, "report runs/swing", "report runs/swing --to swing.html")
def report(
    *,
    to: Annotated[
        Path | None,
        option("Output file, .html or .md; report.html in the run folder by default.", "FILE"),
    ] = None,
    quiet: Quiet = False,
    run: RunFolderOptions,
) -> None:
    """Write a report of a run as one HTML page or a Markdown file.

    The report contains all results and the pictures; a Markdown file links to the pictures.
    """
    from ..result.report import report_text
    from ..result.run_sections import run_report

    file = to or run.run_folder / "report.html"
    with shown_progress("writing the report", quiet=quiet):
        page = run_report(run.run_folder)
        require_possible(file.parent)
        write_text_file(file, report_text(page, file))
    typer.echo(file)


@command(commands, "animate runs/swing --to swing.mp4", "animate runs/swing --slow 4")
def animate(
    *,
    to: Annotated[
        Path | None,
        option(
            "Output file: .gif, or .mp4, which needs ffmpeg; EXPERIMENT.gif in the run folder by "
            "default.",
            "FILE",
        ),
    ] = None,
    fps: Annotated[float, option("Frames per second.")] = 25.0,
    slow: Annotated[
        float, option("Slow-motion factor: how many times slower than in reality.")
    ] = 1.0,
    experiment: OneExperiment = None,
    quiet: Quiet = False,
    run: RunFolderOptions,
) -> None:
    """Make a film of a run: the fitted body beside its forward simulation."""
    from ..result.animation import animate as film

    require_possible(run.run_folder if to is None else to.parent)
    with shown_progress("making the film", quiet=quiet):
        file = film(run.run_folder, to, fps=fps, slowdown=slow, experiment=experiment)
    typer.echo(file)
