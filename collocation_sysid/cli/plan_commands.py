"""The command `plan`, which finds the motion of the hand for a task."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from ..common.files import require_possible, run_name
from ..errors import InputError
from ..extras.planning.hand_limits import Limits
from ..result.run_writers import require_replaceable
from .command_options import AllowCode, OneExperiment, OutputFolder, OutputOptions, command, option
from .common import EXIT_INTERRUPTED, EXIT_NOT_CONVERGED, interruption_exit, shown_progress

commands = typer.Typer()


@command(
    commands,
    "plan runs/foam_cylinder task.toml --limits limits.toml",
    "plan problem.toml task.toml --limits limits.toml --rate 500 --out plan",
)
def plan(
    *,
    source: Annotated[
        Path, typer.Argument(metavar="PROBLEM_OR_RUN", help="Run folder or problem.")
    ],
    task: Annotated[Path, typer.Argument(metavar="TASK.toml", help="The task file.")],
    limits: Annotated[
        Path | None, option("TOML file with the limits of the robot, if the hand moves.", "FILE")
    ] = None,
    solver: Annotated[
        Literal["reduced-space", "interior-point"],
        option(
            "reduced-space, or interior-point: IPOPT after it, with all positions as variables."
        ),
    ] = "reduced-space",
    robust: Annotated[
        bool, option("Minimise the mean over the noise of a run's constants.")
    ] = False,
    rate: Annotated[float | None, option("Rate of the poses for the robot.", "HZ")] = None,
    mcap: Annotated[bool, option("Write trajectory.mcap, a trajectory of ROS, too.")] = False,
    experiment: OneExperiment = None,
    allow_code: AllowCode = False,
    out: OutputFolder = None,
    film: Annotated[bool, option("Make a film of the motion.")] = True,
    output: OutputOptions,
) -> None:
    """Plan a motion of the hand by which points follow references, or constants are determined.

    Planning is experimental.

    The motion begins at rest, ends at rest without residual vibration, and respects the limits. The
    output folder contains poses.csv for the robot, the predicted points, pictures, a film and
    plan.json. Ctrl-C stops the search, or the pictures, and keeps the best plan so far; the exit code
    is then 130 (143 after SIGTERM). It is 1 if the search did not converge, or the plan misses what
    is wanted.
    """
    from ..extras.planning import Task, plan_motion
    from ..extras.planning.folder import (
        FILM_FILE,
        PLAN_FILE,
        REPORT_FILE,
        plan_json,
        plan_summary,
        write_plan,
    )
    from ..extras.planning.trajectory_log import require_trajectory_packages

    if rate is not None and not 0 < rate < float("inf"):
        raise InputError(
            f"found {rate:g}; expected a number of hertz above 0", None, where="--rate"
        )
    folder = out or Path("runs") / f"{run_name(source)}-plan"
    if mcap:
        require_trajectory_packages()
    followed, allowed = Task.read(task), None if limits is None else Limits.read(limits)
    require_possible(folder)
    require_replaceable(folder, marker_file=PLAN_FILE, content_word="plan")
    with shown_progress("preparing", quiet=output.quiet) as progress:
        try:
            answer = plan_motion(
                source,
                followed,
                allowed,
                experiment=experiment,
                allow_code=allow_code,
                solver=solver,
                robust=robust,
                say=progress.say,
                watch=lambda number, value: progress.announce(
                    f"iteration {number}, objective {value:.4g} (Ctrl-C keeps the best)"
                ),
            )
        except KeyboardInterrupt:
            raise interruption_exit(
                f"nothing was written to {folder}, because no plan was found, or it was not simulated "
                "to its end",
                continues=False,
            ) from None
        except InputError as error:
            if error.source is not None:
                raise
            of_limits = error.where in Limits.model_fields
            of_options = (error.where or "").startswith("--")
            file = limits if of_limits and limits is not None else task
            raise (error if of_options else error.located(file)) from error
        write_plan(
            answer, folder, rate_hz=rate, with_film=film, with_mcap=mcap, say=progress.announce
        )
    output.print_result(plan_json(answer), plan_summary(answer, folder))
    wanted = (REPORT_FILE, FILM_FILE) if film else (REPORT_FILE,)
    if missing := [name for name in wanted if not (folder / name).is_file()]:
        raise interruption_exit(
            f"the plan is kept in {folder}, without {' and '.join(missing)}", continues=False
        )
    if answer.interrupted:
        raise typer.Exit(EXIT_INTERRUPTED)
    exceeds = answer.exceeds_error or answer.exceeds_width or answer.exceeds_body_limits
    exceeds = exceeds or answer.fine.branch_change is not None
    if not answer.is_complete or exceeds:
        raise typer.Exit(EXIT_NOT_CONVERGED)
