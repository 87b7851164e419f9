"""Commands that take a problem: solve it, simulate it, check it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from ..folders import require_possible, run_name
from .common import (
    EXIT_DOUBTFUL,
    EXIT_INTERRUPTED,
    EXIT_NOT_CONVERGED,
    AllowCode,
    AsJson,
    Out,
    Overrides,
    ProblemPath,
    Quiet,
    Scheduler,
    Verbose,
    errors,
    examples,
    show,
)

commands = typer.Typer()


@commands.command(
    epilog=examples(
        "solve problem.toml",
        "solve problem.toml --method interior-point --out runs/ip",
        "solve problem.toml --set parameters.mu_pa.guess=200",
        "solve finer.toml --start runs/coarse",
    )
)
def solve(
    problem: ProblemPath,
    method: Annotated[str | None, typer.Option(help="Method, instead of the problem's.")] = None,
    out: Out = None,
    start: Annotated[
        Path | None,
        typer.Option(metavar="RUN", help="Start from the answer in this run folder."),
    ] = None,
    scheduler: Scheduler = None,
    set_: Overrides = None,
    allow_code: AllowCode = False,
    as_json: AsJson = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
    strict: Annotated[
        bool, typer.Option("--strict", help="Exit code 1 if the verdict is doubtful.")
    ] = False,
) -> None:
    """Identify the parameters and write a run folder.

    Parameters need no guess: a scan of the stiffness finds where to start. --start takes an earlier
    answer instead, also of another mesh or timestep.

    --scheduler shares the experiments among the workers of a cluster.

    Options of a method stand in its table of the file, [solver.reduced-space] and so on, or follow
    --set, as in --set solver.reduced-space.tolerance=1e-6; the command methods tells them.
    """
    from ..methods.described import require_method
    from ..methods.solution import Status
    from ..output.record import result
    from ..output.writers import require_replaceable
    from ..problem import Problem
    from ..run import run
    from ..terminal import Progress, summary
    from ..tree import as_json as json_text

    if method is not None:
        require_method(method, "--method")
    folder = out or Path("runs") / run_name(problem)
    loaded = Problem.read(problem, set_ or (), allow_code)
    require_possible(folder)
    require_replaceable(folder)
    with Progress(errors, loaded, verbose=verbose, quiet=quiet) as progress:
        finished = run(loaded, method, progress.iteration, progress.say, start, scheduler=scheduler)
        progress.say("writing the run folder")
        finished.save(folder)
    if as_json:
        typer.echo(json_text(result(finished)))
    else:
        show(summary(finished, folder))
    status = finished.solution.status
    if status is Status.INTERRUPTED or finished.missing:
        raise typer.Exit(EXIT_INTERRUPTED)
    if strict and finished.trust.verdict == "doubtful":
        raise typer.Exit(EXIT_DOUBTFUL)
    raise typer.Exit(0 if status.converged else EXIT_NOT_CONVERGED)


@commands.command(
    epilog=examples(
        "simulate problem.toml --out data --noise-m 0.001 --seed 1",
        "simulate problem.toml --out data --set parameters.mu_pa.guess=300",
    )
)
def simulate(
    problem: ProblemPath,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Where to write.")],
    set_: Overrides = None,
    allow_code: AllowCode = False,
    integrator: Annotated[
        str, typer.Option(help="newmark, or a scheme: midpoint, backward-euler, bdf2.")
    ] = "newmark",
    timestep_s: Annotated[float | None, typer.Option(help="Newmark's step.")] = None,
    noise_m: Annotated[float, typer.Option(help="Standard deviation of the noise.")] = 0.0,
    noise_n: Annotated[float, typer.Option(help="The same of measured forces.")] = 0.0,
    noise_nm: Annotated[float, typer.Option(help="The same of measured torques.")] = 0.0,
    seed: Annotated[int, typer.Option(help="Seed of the noise.")] = 0,
    frames: Annotated[bool, typer.Option(help="Also write frames for ParaView.")] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Simulate at the guesses and write markers and poses as CSV.

    The markers' places are their reference_m, or follow from their file. The parameters are the
    guesses or fixed values: set others with --set.
    """
    from ..problem import Problem
    from ..synthesis import write_data
    from ..terminal import Progress

    loaded = Problem.read(problem, set_ or (), allow_code, simulation=True)
    require_possible(out)
    with Progress(errors, loaded, quiet=quiet) as progress:
        written = write_data(
            loaded,
            out,
            integrator,
            timestep_s,
            noise_m,
            seed,
            frames,
            progress.share,
            noise_n,
            noise_nm,
        )
    if as_json:
        typer.echo(json.dumps([str(file) for file in written]))
    else:
        for file in written:
            typer.echo(file)


@commands.command(
    epilog=examples(
        "check problem.toml",
        "check problem.toml --full",
        "check problem.toml --set transcription.scheme=backward-euler",
    )
)
def check(
    problem: ProblemPath,
    set_: Overrides = None,
    allow_code: AllowCode = False,
    full: Annotated[
        bool, typer.Option("--full", help="Simulate all samples, however long that takes.")
    ] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Tell what is wrong with a problem before solving it.

    Bodies, recordings and grasps are shown at once; derivatives, costs and the simulation at the
    guess follow, of the first samples where the whole takes more than some ten seconds.
    """
    from ..check import check_problem, glance
    from ..problem import Problem
    from ..terminal import Progress, closer_table, glance_table

    loaded = Problem.read(problem, set_ or (), allow_code)
    if not as_json:
        show(glance_table(glance(loaded)))
    with Progress(errors, quiet=quiet) as progress:
        findings = check_problem(loaded, progress.say, full)
    if as_json:
        typer.echo(json.dumps(findings.as_dict(), indent=1))
    else:
        show(closer_table(findings))
    good = findings.derivatives_agree and not findings.causes
    raise typer.Exit(0 if good else EXIT_NOT_CONVERGED)
