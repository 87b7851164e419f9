"""The command that designs a motion."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from ..errors import InputError
from ..folders import require_possible, run_name
from .common import (
    EXIT_INTERRUPTED,
    AllowCode,
    AsJson,
    OneExperiment,
    Out,
    Overrides,
    ProblemPath,
    Quiet,
    errors,
    examples,
    show,
)

if TYPE_CHECKING:
    from ..design.criterion import Kind, Over

commands = typer.Typer()


@commands.command(
    epilog=examples(
        "design problem.toml --duration 2 --limits limits.toml",
        "design problem.toml --duration 2 --limits limits.toml --for poisson",
        "design problem.toml --duration 2 --limits limits.toml --add",
    )
)
def design(
    problem: ProblemPath,
    duration: Annotated[float, typer.Option(metavar="SECONDS", help="How long it takes.")],
    limits: Annotated[
        Path, typer.Option(metavar="FILE", help="What the robot may do and cameras see (TOML).")
    ],
    criterion: Annotated[
        str,
        typer.Option(
            help="worst: the largest error bar; A: their mean square; D: their ellipsoid."
        ),
    ] = "worst",
    for_: Annotated[
        str | None,
        typer.Option("--for", metavar="A,B,…", help="Parameters and moduli that count; else all."),
    ] = None,
    over: Annotated[str, typer.Option(help="mean or worst over the draws of the prior.")] = "mean",
    evaluations: Annotated[int, typer.Option(help="Motions that are simulated.")] = 300,
    pairs: Annotated[
        int, typer.Option(help="Pairs of draws from the prior, about the guesses.")
    ] = 1,
    spread: Annotated[
        float, typer.Option(help="By what factor guesses may be wrong, without a prior.")
    ] = 1.5,
    waves: Annotated[int, typer.Option(help="Waves of each of the six coordinates.")] = 1,
    seed: Annotated[int, typer.Option(help="Seed of the search and of the draws.")] = 0,
    add: Annotated[
        bool,
        typer.Option("--add", help="Complete the recordings there are; they are fitted first."),
    ] = False,
    experiment: OneExperiment = None,
    out: Out = None,
    film: Annotated[bool, typer.Option(help="Film the motion.")] = True,
    set_: Overrides = None,
    allow_code: AllowCode = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Find the motion of the grasp that makes the error bars smallest.

    It begins and ends at rest in the first pose, keeps to the limits, and is judged over a prior
    of the parameters. The folder gets poses.csv, error bars before and after, pictures, a film and
    a problem that simulates it. Ctrl-C keeps the best motion so far.
    """
    from ..design import Criterion, DesignOptions, Limits
    from ..design import design as designed
    from ..design.display import DesignProgress, design_summary
    from ..design.folder import DESIGN_FILE, as_dict, write_design
    from ..output.writers import require_replaceable
    from ..problem import Problem
    from ..tree import as_json as json_text

    folder = out or Path("runs") / f"{run_name(problem)}-design"
    names = tuple(name.strip() for name in for_.split(",")) if for_ is not None else ()
    wanted = Criterion(cast("Kind", criterion), names, cast("Over", over))
    options = DesignOptions(evaluations, pairs, spread, waves, seed)
    given = Limits.read(limits)
    loaded = Problem.read(problem, set_ or (), allow_code, simulation=not add)
    require_possible(folder)
    require_replaceable(folder, mark=DESIGN_FILE, what="design")
    with DesignProgress(errors, options.evaluations, quiet) as progress:
        try:
            found = designed(
                loaded,
                given,
                duration,
                wanted,
                options,
                experiment=experiment,
                add=add,
                watch=progress.tried,
                say=progress.say,
            )
        except InputError as error:
            key = error.where in Limits.model_fields and error.source is None
            raise (error.located(limits) if key else error) from error
        write_design(found, folder, film, progress.say)
    if as_json:
        typer.echo(json_text(as_dict(found)))
    else:
        show(design_summary(found, folder))
    raise typer.Exit(EXIT_INTERRUPTED if found.found.interrupted else 0)
