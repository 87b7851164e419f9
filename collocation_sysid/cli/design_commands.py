"""The command `design_motion`, which finds the motion that makes the error bars smallest."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import typer

from ..common.files import require_possible, run_name
from ..common.validated_classes import validated
from ..errors import InputError
from ..extras.design import DesignCriterion, DesignOptions, Limits
from ..extras.design import design_motion as designed
from ..extras.design.predicted_information import Kind, Over
from ..result.run_writers import require_replaceable
from .command_options import OneExperiment, OutputFolder, OutputOptions, ProblemOptions, command
from .common import EXIT_INTERRUPTED, error_console

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
