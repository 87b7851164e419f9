"""Commands that run many problems side by side."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from ..errors import InputError
from ..folders import require_possible, run_name
from .common import (
    EXIT_INTERRUPTED,
    AllowCode,
    AsJson,
    DryRun,
    Out,
    Overrides,
    ProblemPath,
    Quiet,
    Scheduler,
    TimeLimit,
    Workers,
    errors,
    examples,
    show,
)

if TYPE_CHECKING:
    from ..problem import Problem
    from ..study import Limits, PlannedRun
    from ..study.table import Yardstick

commands = typer.Typer()


@commands.command(
    epilog=examples(
        "compare problem.toml --methods reduced-space,shooting --starts 40",
        "compare problem.toml --methods penalty,shooting --truth truth.toml",
        "compare problem.toml --materials neo-hookean,yeoh",
    )
)
def compare(
    problem: ProblemPath,
    methods: Annotated[
        str | None,
        typer.Option(metavar="A,B,…", help="Methods, each with its options of the file."),
    ] = None,
    materials: Annotated[
        str | None, typer.Option(metavar="A,B,…", help="Materials, instead of the object's.")
    ] = None,
    prony: Annotated[
        str | None, typer.Option(metavar="0,1,…", help="Numbers of branches of memory.")
    ] = None,
    region: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Region that has them; by default all the body does."),
    ] = None,
    with_: Annotated[
        list[Path] | None,
        typer.Option("--with", metavar="FILE", help="Another problem of the same recordings."),
    ] = None,
    starts: Annotated[int, typer.Option(help="Starts; the first is the file's guess.")] = 1,
    spread: Annotated[float, typer.Option(help="Starts are within this factor.")] = 10.0,
    seed: Annotated[int, typer.Option(help="Seed of the starts.")] = 0,
    truth: Annotated[
        list[str] | None,
        typer.Option(metavar="FILE|NAME=VALUE", help="True parameters: a TOML file, or values."),
    ] = None,
    within: Annotated[float, typer.Option(help="Relative error of a success.")] = 0.01,
    workers: Workers = None,
    scheduler: Scheduler = None,
    time_limit: TimeLimit = None,
    set_: Overrides = None,
    allow_code: AllowCode = False,
    out: Out = None,
    dry_run: DryRun = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Run methods side by side from many starts, or fit several models and say which to use.

    With --materials, --prony or --with each model is fitted to all recordings, and to all but each
    of them, which it then predicts; of one recording the last third is held out. In a body with
    regions all of it has the model, or --region. --with takes other problem files as models, each
    with all of the materials and numbers of branches.

    Finished runs are kept in the output folder: the same command resumes.
    """
    from ..problem import Problem
    from ..study import Limits, plan_comparison
    from ..study.arguments import parse_methods, read_truth
    from ..study.table import Yardstick

    names = parse_methods(methods) if methods is not None else ()
    limits = Limits(workers, scheduler, time_limit)
    loaded = Problem.read(problem, set_ or (), allow_code)
    if with_ or materials is not None or prony is not None:
        choices = materials, prony, region
        planned = _planned_models(loaded, choices, with_ or (), names, set_ or (), allow_code)
        study = _Study("models", problem, planned, Yardstick(), out)
        _study(study, limits, dry_run, as_json, quiet)
        return
    if not names:
        raise InputError("nothing to compare; expected --methods, --materials, --prony or --with")
    free = [item.name for item in loaded.parameters.free]
    yardstick = Yardstick(read_truth(truth or (), loaded.parameters.names, free), within)
    options = starts, spread, seed, yardstick.truth, allow_code
    planned = plan_comparison(loaded, names, set_ or (), *options)
    study = _Study("compare", problem, planned, yardstick, out)
    _study(study, limits, dry_run, as_json, quiet)


def _planned_models(
    problem: Problem,
    choices: tuple[str | None, str | None, str | None],
    files: Sequence[Path],
    methods: Sequence[str],
    overrides: Sequence[str],
    allow_code: bool,
) -> list[PlannedRun]:
    """The runs that compare models: materials and branches, of a region, or whole files."""
    materials, prony, region = choices
    from ..problem import Problem
    from ..study import plan_models
    from ..study.variants import models, parse_branches, parse_materials

    if len(methods) > 1:
        raise InputError(
            f"found {', '.join(methods)}; expected one method to compare models by, or methods "
            "without --materials and --prony",
            None,
            "--methods",
        )
    problems = [problem, *(Problem.read(file, overrides, allow_code) for file in files)]
    named = parse_materials(materials) if materials is not None else ()
    counts = parse_branches(prony) if prony is not None else ()
    found = models(problems, overrides, named, counts, region)
    for variant in found:  # a model that cannot be would fail every run
        Problem.read(variant.path, variant.overrides, allow_code)
    return plan_models(problem, found, methods[0] if methods else None, allow_code)


@commands.command(
    epilog=examples(
        "sweep problem.toml --over transcription.substeps=1,2,4",
        "sweep problem.toml --over parameters.mu_pa.guess=50:5000:log:9",
    )
)
def sweep(
    problem: ProblemPath,
    over: Annotated[
        list[str],
        typer.Option(
            metavar="KEY=VALUES",
            help="Key and its values: a,b,c or first:last:count or first:last:log:count.",
        ),
    ],
    method: Annotated[str | None, typer.Option(help="Method, instead of the problem's.")] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    time_limit: TimeLimit = None,
    set_: Overrides = None,
    allow_code: AllowCode = False,
    out: Out = None,
    dry_run: DryRun = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Solve for every combination of values of some keys."""
    from ..problem import Problem
    from ..study import Limits, plan_sweep
    from ..study.arguments import parse_methods, parse_over
    from ..study.table import Yardstick

    chosen = parse_methods(method, "--method")[0] if method else None
    limits = Limits(workers, scheduler, time_limit)
    planned = plan_sweep(problem, parse_over(over), set_ or (), chosen, allow_code)
    Problem.read(problem, planned[0].overrides, allow_code)  # a missing file would fail every run
    _study(_Study("sweep", problem, planned, Yardstick(), out), limits, dry_run, as_json, quiet)


@dataclass(frozen=True)
class _Study:
    """A study as the command line gives it."""

    kind: str
    problem: Path
    planned: Sequence[PlannedRun]
    yardstick: Yardstick
    out: Path | None

    @property
    def folder(self) -> Path:
        return self.out or Path("runs") / f"{run_name(self.problem)}-{self.kind}"


def _study(study: _Study, limits: Limits, dry_run: bool, as_json: bool, quiet: bool) -> None:
    """Do the runs that are left, write the tables and plots, and print them."""
    from ..study import RunStore, run_all
    from ..study.display import StudyProgress, study_tables
    from ..study.report import load_report, report_json, write_report
    from ..tree import as_json as json_text

    folder = study.folder
    store = RunStore(folder / "runs")
    finished = [r.key for r in study.planned if store.finished(r.key, limits.time_limit_s)]
    left = [run for run in study.planned if run.key not in finished]
    if dry_run:
        _dry_run(study.planned, finished, as_json)
        return
    require_possible(folder)
    interrupted = False
    try:
        with StudyProgress(errors, left, len(study.planned), quiet) as progress:
            run_all(left, store, limits, progress.done)
    except KeyboardInterrupt:
        interrupted = True
    title = f"{study.kind.capitalize()}: {run_name(study.problem)}"
    report = load_report(title, study.kind, study.planned, store, study.yardstick)
    if report.records:
        write_report(report, folder)
    if interrupted:
        kept = f"{len(report.records)} of {len(study.planned)} runs are kept in {folder}"
        again = shlex.join(["collocation-sysid", *sys.argv[1:]])
        errors.print(Text(f"interrupted: {kept}; resume with: {again}"), soft_wrap=True)
        raise typer.Exit(EXIT_INTERRUPTED)
    if as_json:
        typer.echo(json_text(report_json(report)))
    else:
        show(study_tables(report, folder))


def _dry_run(planned: Sequence[PlannedRun], finished: Sequence[str], as_json: bool) -> None:
    from ..study.display import plan_table

    if as_json:
        listed = [{**run.as_dict(), "finished": run.key in finished} for run in planned]
        typer.echo(json.dumps(listed, indent=1, ensure_ascii=False))
    else:
        show(plan_table(planned, finished))
