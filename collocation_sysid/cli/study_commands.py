"""Commands that run many problems: compare-methods and compare-models."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from ..common.display import Line
from ..common.files import require_possible, run_name
from ..common.step_counting import StepUnit, complete_steps, counted_phase
from ..common.validated_classes import validated
from ..common.validated_types import Positive
from ..errors import InputError
from ..extras.studies import PlannedRun, RunOptions, Starts, plan_comparison, plan_models, run_all
from ..extras.studies.arguments import parse_methods, read_truth
from ..extras.studies.model_variants import models, parse_branches, parse_dampings, parse_materials
from ..extras.studies.planning import COMPARED_METHODS, METHOD_STUDY, MODEL_STUDY, STUDY_TITLES
from ..extras.studies.rows import SuccessCriterion
from ..extras.studies.run_execution import Record
from ..problem import Problem
from .command_options import OneMethod, OutputFolder, OutputOptions, ProblemOptions, command, option
from .common import error_console, interruption_exit, print_result, shown_progress

commands = typer.Typer()

# Time limit of each run of a comparison of methods [s].
METHOD_TIME_LIMIT_S = 60.0
# Largest number of failures on the terminal; summary.md lists all.
SHOWN_FAILURES = 8


@validated(kw_only=True)
class StudyOptions:
    """Options of commands with many runs.

    Attributes
    ----------
    dry_run : bool
        List the runs without computing them.
    """

    limits: RunOptions
    out: OutputFolder = None
    dry_run: bool = False


@command(
    commands,
    "compare-methods problem.toml --truth truth.toml",
    "compare-methods problem.toml --methods reduced-space,shooting --starts 40",
    "compare-methods problem.toml --methods 'penalty rho=1e4,penalty rho=1e6'",
)
def compare_methods(
    *,
    methods: Annotated[
        str,
        option(
            "Methods to compare, with their options in the problem file, or KEY=VALUE after the "
            "name; by default the penalty method of the paper and six others.",
            "A,B,…",
        ),
    ] = COMPARED_METHODS,
    starts: Starts,
    truth: Annotated[
        list[str] | None, option("True parameters: a TOML file, or values.", "FILE|NAME=VALUE")
    ] = None,
    within: Annotated[
        Positive,
        option("Largest relative error of the parameters with which a run counts as successful."),
    ] = 0.01,
    study: StudyOptions,
    source: ProblemOptions,
    output: OutputOptions,
) -> None:
    """Compare methods by success, violation of the equations of motion, and time.

    All methods solve the same problem from the same guesses. The picture shows the violations over
    time, and the error of a forward simulation with the estimates of each method. To compare the
    materials, damping laws or branches of a body, use the command compare-models.
    """
    named = parse_methods(methods)
    problem = source.read_problem(output.quiet)
    free = [item.name for item in problem.parameters.free]
    known = read_truth(truth or (), problem.parameters.names, needed=free)
    planned = plan_comparison(
        problem,
        named,
        overrides=source.set_ or (),
        starts=starts,
        truth=known,
        allow_code=source.allow_code,
    )
    limit_s = study.limits.time_limit_s or METHOD_TIME_LIMIT_S
    study = replace(study, limits=replace(study.limits, time_limit_s=limit_s))
    _run_study(
        METHOD_STUDY, planned, study, source, output, yardstick=SuccessCriterion(known, within)
    )


@command(
    commands,
    "compare-models problem.toml --materials neo-hookean,yeoh",
    "compare-models problem.toml --damping kelvin-voigt,material,rayleigh",
    "compare-models problem.toml --prony 0,1 --region tip",
)
def compare_models(
    *,
    materials: Annotated[
        str | None, option("Materials to compare, instead of that of the object.", "A,B,…")
    ] = None,
    damping: Annotated[
        str | None, option("Damping laws to compare, instead of that of the object.", "A,B,…")
    ] = None,
    prony: Annotated[
        str | None, option("Numbers of viscoelastic branches to compare.", "0,1,…")
    ] = None,
    region: Annotated[
        str | None,
        option(
            "Region whose materials, damping laws and branches are compared; by default the "
            "complete body.",
            "NAME",
        ),
    ] = None,
    with_: Annotated[
        list[Path] | None,
        option(
            "Another problem file with the same recordings, which is compared as a model.", "FILE"
        ),
    ] = None,
    method: OneMethod = None,
    study: StudyOptions,
    source: ProblemOptions,
    output: OutputOptions,
) -> None:
    """Fit models of material and damping, and recommend the one that best predicts held-out data.

    Each model is fitted to all recordings. It is then fitted to all recordings except one, in turn,
    and predicts the omitted recording; if there is only one recording, its last third is held out.
    A model applies to the complete body, or to the region named by --region. --with adds other
    problem files as models; each of them is combined with all stated materials, damping laws and
    numbers of branches.
    """
    if not with_ and {materials, damping, prony} == {None}:
        raise InputError("no models to compare; expected --materials, --damping, --prony or --with")
    chosen = _single_method(method)
    problem = source.read_problem(output.quiet)
    others = [replace(source, problem=file).read_problem(output.quiet) for file in with_ or ()]
    variants = models(
        [problem, *others],
        source.set_ or (),
        materials=parse_materials(materials) if materials is not None else (),
        branches=parse_branches(prony) if prony is not None else (),
        region=region,
        dampings=parse_dampings(damping) if damping is not None else (),
    )
    with (
        shown_progress("reading the models", quiet=output.quiet),
        counted_phase(StepUnit.PROBLEM, len(variants)),
    ):
        for variant in variants:  # an impossible model would fail every run
            Problem.read(variant.path, variant.overrides, allow_code=source.allow_code)
            complete_steps(StepUnit.PROBLEM)
    planned = plan_models(problem, variants, method=chosen, allow_code=source.allow_code)
    _run_study(MODEL_STUDY, planned, study, source, output, yardstick=SuccessCriterion())


def _single_method(text: str | None) -> str | None:
    if text is None:
        return None
    method, *others = parse_methods(text, "--method")
    if others:
        raise InputError(f"found {text}; expected one method", None, where="--method")
    return method


def _run_study(
    kind: str,
    planned: Sequence[PlannedRun],
    study: StudyOptions,
    source: ProblemOptions,
    output: OutputOptions,
    yardstick: SuccessCriterion,
) -> None:
    """Failed runs are in the tables; without any record no tables are written."""
    from ..extras.studies.progress import StudyProgress
    from ..extras.studies.tables import StudyReport, plan_table

    if study.dry_run:
        if output.as_json:
            listed = [run.as_dict() for run in planned]
            typer.echo(json.dumps(listed, indent=1))
        else:
            print_result(plan_table(planned))
        return
    name = run_name(source.problem)
    folder = study.out or Path("runs") / f"{name}-{kind}"
    require_possible(folder)
    report = StudyReport(f"{STUDY_TITLES[kind]}: {name}", kind, tuple(planned), yardstick)
    is_complete = True
    try:
        with StudyProgress(error_console, len(planned), quiet=output.quiet) as progress:

            def count(run: PlannedRun, record: Record) -> None:
                report.records[run.label] = record
                progress.count_run(run, record)

            run_all(planned, study.limits, count, progress.show_iteration)
    except KeyboardInterrupt:
        is_complete = False
    if report.records:
        report.write(folder)
    if not is_complete:
        raise interruption_exit(
            f"the tables of {len(report.records)} of {len(planned)} runs are in {folder}"
            if report.records
            else "no run has ended",
            continues=False,
        )
    failures = [Line(each, "doubtful") for each in report.failures]
    if (hidden := len(failures) - SHOWN_FAILURES) > 0:
        failures[SHOWN_FAILURES:] = [Line(f"and {hidden} more in summary.md", "doubtful")]
    output.print_result(
        report.as_dict(), [*report.build_parts(), *failures, f"written to {folder}"]
    )
