"""The commands `design`, which finds the motion that makes the error bars smallest, and `plan`,
which finds the motion with which points of the body follow references.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, cast

import typer

from ..common.files import require_possible, run_name
from ..common.validated_classes import validated
from ..errors import InputError
from ..extras.design import DesignCriterion, DesignOptions, Limits
from ..extras.design import design_motion as designed
from ..extras.design.predicted_information import Kind, Over
from ..result.run_writers import require_replaceable
from .command_options import (
    AllowCode,
    OneExperiment,
    OutputFolder,
    OutputOptions,
    ProblemOptions,
    command,
)
from .common import EXIT_INTERRUPTED, EXIT_NOT_CONVERGED, error_console

commands = typer.Typer()


@validated(kw_only=True)
class DesignCommand(ProblemOptions, OutputOptions):
    """Options of `design_motion`.

    Attributes
    ----------
    duration : SECONDS
        Duration of the motion [s].
    limits : FILE
        TOML file with the limits of the robot and the views of the cameras.
    criterion : str
        Criterion that is minimised: worst, the largest error bar; A, the mean square of the error
        bars; D, the volume of the confidence ellipsoid.
    for_ : A,B,…
        Parameters and moduli whose error bars are minimised; all by default.
    over : str
        How the values of the criterion at the draws are combined: mean, their geometric mean, or
        worst, the largest.
    add : bool
        Design a motion in addition to the problem's recordings, which are fitted first.
    film : bool
        Make a film of the motion.
    """

    duration: float
    limits: Path
    criterion: str = "worst"
    for_: str | None = None
    over: str = "mean"
    search: DesignOptions
    add: bool = False
    experiment: OneExperiment = None
    out: OutputFolder = None
    film: bool = True


@command(
    commands,
    "design problem.toml --duration 2 --limits limits.toml",
    "design problem.toml --duration 2 --limits limits.toml --for poisson",
    "design problem.toml --duration 2 --limits limits.toml --add",
)
def design(options: DesignCommand) -> None:
    """Find the motion of the grasp that makes the error bars smallest.

    The motion begins and ends at rest in the first pose, respects the limits, and is optimised for
    parameters drawn from their priors. The output folder contains poses.csv, the error bars before
    and after, pictures, a film and a problem file that simulates the motion. Ctrl-C stops the
    search and keeps the best motion so far; the exit code is then 130.
    """
    from ..extras.design.design_folder import DESIGN_FILE, design_json, write_design
    from ..extras.design.design_page import design_summary
    from ..extras.studies.study_progress import DesignProgress

    folder = options.out or Path("runs") / f"{run_name(options.problem)}-design"
    names = () if options.for_ is None else tuple(n.strip() for n in options.for_.split(","))
    criterion = DesignCriterion(
        cast("Kind", options.criterion), names, over=cast("Over", options.over)
    )
    limits = Limits.read(options.limits)
    problem = options.read_problem(simulation=not options.add)
    require_possible(folder)
    require_replaceable(folder, marker_file=DESIGN_FILE, content_word="design")
    with DesignProgress(error_console, options.search.evaluations, quiet=options.quiet) as progress:
        try:
            answer = designed(
                problem,
                limits,
                duration_s=options.duration,
                criterion=criterion,
                options=options.search,
                experiment=options.experiment,
                add=options.add,
                watch=progress.show_best,
                say=progress.show_activity,
            )
        except InputError as error:
            key = error.where in Limits.model_fields and error.source is None
            raise (error.located(options.limits) if key else error) from error
        write_design(answer, folder, with_film=options.film, say=progress.show_activity)
    options.print_result(design_json(answer), design_summary(answer, folder))
    raise typer.Exit(EXIT_INTERRUPTED if answer.best.is_interrupted else 0)


@validated(kw_only=True)
class PlanCommand(OutputOptions):
    """Options of `plan`.

    Attributes
    ----------
    source : PROBLEM_OR_RUN
        A run folder, or a problem file, whose guesses are used.
    task : TASK
        TOML file with the references of points of the body.
    limits : FILE
        TOML file with the limits of the robot, as of design.
    solver : str
        reduced-space, or interior-point: IPOPT after it, with all positions as variables.
    rate : HZ
        Rate of the poses for the robot.
    film : bool
        Make a film of the motion.
    """

    source: Annotated[Path, typer.Argument(metavar="PROBLEM_OR_RUN", help="Run folder or problem.")]
    task: Annotated[Path, typer.Argument(metavar="TASK.toml", help="The task file.")]
    limits: Path
    solver: Literal["reduced-space", "interior-point"] = "reduced-space"
    rate: float | None = None
    experiment: OneExperiment = None
    allow_code: AllowCode = False
    out: OutputFolder = None
    film: bool = True


@command(
    commands,
    "plan runs/foam_cylinder task.toml --limits limits.toml",
    "plan problem.toml task.toml --limits limits.toml --rate 500 --out plan",
)
def plan(options: PlanCommand) -> None:
    """Plan the motion of the hand with which points of the body follow references (experimental).

    The motion begins at rest, ends at rest without residual vibration, and respects the limits. The
    output folder contains poses.csv for the robot, the predicted points, pictures, a film and
    plan.json. Ctrl-C stops the search and keeps the best plan so far; the exit code is then 130.
    """
    from ..extras.planning import Task, plan_motion
    from ..extras.planning.plan_folder import PLAN_FILE, plan_json, plan_summary, write_plan
    from ..result.solve_progress import SolveProgress

    if options.rate is not None and not 0 < options.rate < float("inf"):
        raise InputError(
            f"found {options.rate:g}; expected a number of hertz above 0", None, where="--rate"
        )
    folder = options.out or Path("runs") / f"{run_name(options.source)}-plan"
    task, limits = Task.read(options.task), Limits.read(options.limits)
    require_possible(folder)
    require_replaceable(folder, marker_file=PLAN_FILE, content_word="plan")
    with SolveProgress(error_console, quiet=options.quiet, activity="preparing") as progress:
        try:
            answer = plan_motion(
                options.source,
                task,
                limits,
                experiment=options.experiment,
                allow_code=options.allow_code,
                solver=options.solver,
                say=progress.announce,
                watch=lambda number, value: progress.announce(
                    f"iteration {number}, objective {value:.4g} (Ctrl-C keeps the best)"
                ),
            )
        except InputError as error:
            if error.source is not None:
                raise
            of_limits = error.where in Limits.model_fields
            of_options = (error.where or "").startswith("--")
            raise (
                error
                if of_options
                else error.located(options.limits if of_limits else options.task)
            ) from error
        write_plan(
            answer, folder, rate_hz=options.rate, with_film=options.film, say=progress.announce
        )
    options.print_result(plan_json(answer), plan_summary(answer, folder))
    if answer.interrupted:
        raise typer.Exit(EXIT_INTERRUPTED)
    if answer.answer.status not in ("converged", "flat"):
        raise typer.Exit(EXIT_NOT_CONVERGED)
