"""Commands about a run that was made."""

from __future__ import annotations

import shlex
import sys
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from ..files import write_whole
from ..folders import require_possible
from .common import (
    EXIT_INTERRUPTED,
    AllowCode,
    AsJson,
    OneExperiment,
    Out,
    Quiet,
    RunFolder,
    errors,
    examples,
    show,
)

commands = typer.Typer()


@commands.command(epilog=examples("refine runs/swing", "refine runs/swing --levels 3"))
def refine(
    run_folder: RunFolder,
    levels: Annotated[int, typer.Option(help="2, or 3 to observe the orders: much longer.")] = 2,
    allow_code: AllowCode = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Solve again with half the step and a finer mesh: the numerical error.

    Each starts from the run's answer. The folder gets refinement.json, and result.json the
    numerical error of each parameter, with an interval for noise and discretisation. What was
    solved before, as of a call that was interrupted, is not solved again.
    """
    from ..output.refined import refine_run
    from ..terminal import refinement_table
    from ..tree import as_json as json_text
    from ..tree import content

    def say(what: str) -> None:
        if not quiet:
            errors.print(Text(what, style="dim"), soft_wrap=True)

    try:
        found, result = refine_run(run_folder, levels, allow_code, say)
    except KeyboardInterrupt:
        again = shlex.join(["collocation-sysid", *sys.argv[1:]])
        said = f"interrupted: what was solved is kept in {run_folder}; go on with: {again}"
        errors.print(Text(said), soft_wrap=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None
    if as_json:
        typer.echo(json_text({**content(found), "trust": result.trust}))
    else:
        show(refinement_table(found))
        for reason in result.trust.reasons:
            show(f"{result.trust.verdict}: {reason}")


@commands.command(
    epilog=examples(
        "export runs/swing --to mujoco", "export runs/swing --to calculix --out deck --verify"
    )
)
def export(
    run_folder: RunFolder,
    to: Annotated[
        str,
        typer.Option(
            "--to", metavar="TARGET", help="mujoco, newton, sofa, febio, calculix or json."
        ),
    ],
    out: Out = None,
    experiment: OneExperiment = None,
    verify: Annotated[
        bool,
        typer.Option("--verify", help="Predict in the target what was exported, and compare."),
    ] = False,
    allow_code: AllowCode = False,
    as_json: AsJson = False,
) -> None:
    """Write the identified body for another simulator: mesh, material, damping, grasp.

    Says what the target cannot express. By default in a folder export-TARGET of the run.
    """
    from ..export import Identified, export_run, target_named, verify_export
    from ..terminal import comparison_table, export_notes
    from ..tree import as_json as json_text

    target, folder = target_named(to), out or run_folder / f"export-{to}"
    require_possible(folder)
    body = Identified.read(run_folder, experiment, allow_code)
    exported = export_run(body, to, folder)
    found = verify_export(body, to, folder) if verify else []
    if as_json:
        content = {
            "folder": str(folder),
            "warnings": body.warnings,
            "not_expressed": exported.limits,
            "verified": [{**asdict(each), "relative": each.relative} for each in found],
        }
        typer.echo(json_text(content))
        return
    show(export_notes(body.warnings, exported.limits))
    if verify:
        show(comparison_table(target.name, found))
    typer.echo(folder)


@commands.command(epilog=examples("plot runs/swing"))
def plot(
    run_folder: RunFolder,
    out: Out = None,
) -> None:
    """Draw the pictures of a run again, from its files."""
    from ..output.redraw import redraw

    require_possible(out or run_folder)
    for file in redraw(run_folder, out or run_folder):
        typer.echo(file)


@commands.command(epilog=examples("report runs/swing", "report runs/compare --to comparison.html"))
def report(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="A run folder, or one of compare or sweep.")
    ],
    to: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="An .html or .md; report.html in the folder by default."),
    ] = None,
) -> None:
    """Write one HTML page about a run or a study, or a Markdown file.

    Everything it found; of a page the pictures are inside, in Markdown they are links.
    """
    from ..output.report import as_file, comparison_report, run_report

    file = to or folder / "report.html"
    study = (folder / "summary.json").is_file()
    found = comparison_report(folder) if study else run_report(folder)
    require_possible(file.parent)
    write_whole(file, as_file(found, file))
    typer.echo(file)


@commands.command(
    epilog=examples("animate runs/swing --to swing.mp4", "animate runs/swing --slow 4")
)
def animate(
    run_folder: RunFolder,
    to: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A .gif, or an .mp4, which needs ffmpeg.")
    ] = None,
    fps: Annotated[float, typer.Option(help="Frames a second.")] = 25.0,
    slow: Annotated[float, typer.Option(help="How many times slower than it was.")] = 1.0,
    experiment: OneExperiment = None,
    quiet: Quiet = False,
) -> None:
    """Film a run: the body as fitted beside the body as rolled out."""
    from rich.progress import Progress

    from ..output.animation import animate as film

    require_possible(to.parent if to is not None else run_folder)
    bar = Progress(console=errors, transient=True)
    task = bar.add_task("filming", total=1.0)
    with bar if errors.is_terminal and not quiet else nullcontext():
        file = film(
            run_folder, to, fps, slow, experiment, lambda share: bar.update(task, completed=share)
        )
    typer.echo(file)


@commands.command(epilog=examples("view runs/swing", "view runs/swing --html swing.html"))
def view(
    run_folder: RunFolder,
    field: Annotated[
        str | None,
        typer.Option(
            help="Field of the frames that colours the body: von_mises_pa; on a page, strain."
        ),
    ] = None,
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a web page, open no window.")
    ] = None,
    experiment: OneExperiment = None,
) -> None:
    """Look at a run in 3-D.

    In a window (needs pyvista), or as a web page that needs nothing.
    """
    from ..output.view import FIELD, export_page
    from ..output.view import view as show

    if html is None:
        show(run_folder, field or FIELD, experiment)
        return
    require_possible(html.parent)
    typer.echo(export_page(run_folder, html, experiment, field))
