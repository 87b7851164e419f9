"""The command line: results on stdout, progress and messages on stderr.

Exit codes: 0 converged, 1 not converged or, with ``solve --strict``, doubtful, 2 bad input,
130 interrupted.
"""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn, cast

import typer
from rich.console import Console, RenderableType
from rich.text import Text

from .errors import InputError, SimulationError
from .folders import require_possible, run_name
from .starting import heed_interrupts

if TYPE_CHECKING:
    from .design.criterion import Kind, Over
    from .live import Estimator
    from .problem import Problem
    from .study import Limits, PlannedRun
    from .study.table import Yardstick

app = typer.Typer(
    name="collocation-sysid",
    help="Identify the material parameters of a soft object from motion capture.\n\n"
    "\b\nStart with\n"
    "  collocation-sysid new my_object                    a commented problem file\n"
    "  collocation-sysid check my_object/problem.toml     what will go wrong\n"
    "  collocation-sysid solve my_object/problem.toml     parameters with error bars\n"
    "  collocation-sysid report runs/my_object            everything found, as a page",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
errors = Console(stderr=True, highlight=False)

ProblemPath = Annotated[Path, typer.Argument(metavar="PROBLEM.toml", help="The problem file.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Override a key, such as parameters.mu_pa.guess=200."
    ),
]
Out = Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Where to write.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="A line per iteration.")]
Workers = Annotated[
    int | None, typer.Option(help="Runs at once; as many as there are cores by default.")
]
Scheduler = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="A dask.distributed scheduler to run on.")
]
TimeLimit = Annotated[
    float | None,
    typer.Option(metavar="SECONDS", help="A run is ended after this; it counts as a failure."),
]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")]
OneExperiment = Annotated[
    str | None, typer.Option(metavar="NAME", help="Experiment; by default the first.")
]
AllowCode = Annotated[
    bool, typer.Option("--allow-code", help="Run Python files that the problem names.")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Only list the runs.")]

EXIT_NOT_CONVERGED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130
EXIT_DOUBTFUL = EXIT_NOT_CONVERGED


def _examples(*commands: str) -> str:
    """Lines below a command's help, kept as they are."""
    lines = "".join(f"\n  collocation-sysid {command}" for command in commands)
    return f"\b\nExamples:{lines}"


@app.command(
    epilog=_examples(
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

    Options of a method stand in its table of the file, [solver.reduced-space] and so on, or follow
    --set, as in --set solver.reduced-space.tolerance=1e-6; the command methods tells them.
    """
    from .methods.described import require_method
    from .methods.solution import Status
    from .output.record import as_json as json_text
    from .output.record import result
    from .output.writers import require_replaceable
    from .problem import Problem
    from .run import run
    from .terminal import Progress, summary

    if method is not None:
        require_method(method, "--method")
    folder = out or Path("runs") / run_name(problem)
    loaded = Problem.read(problem, set_ or (), allow_code)
    require_possible(folder)
    require_replaceable(folder)
    with Progress(errors, loaded, verbose=verbose, quiet=quiet) as progress:
        finished = run(loaded, method, progress.iteration, progress.say, start)
        progress.say("writing the run folder")
        finished.save(folder)
    if as_json:
        typer.echo(json_text(result(finished)))
    else:
        _show(summary(finished, folder))
    status = finished.solution.status
    if status is Status.INTERRUPTED:
        raise typer.Exit(EXIT_INTERRUPTED)
    if strict and finished.trust.verdict == "doubtful":
        raise typer.Exit(EXIT_DOUBTFUL)
    raise typer.Exit(0 if status.converged else EXIT_NOT_CONVERGED)


@app.command(
    epilog=_examples(
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
    from .problem import Problem
    from .synthesis import write_data
    from .terminal import Progress

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


@app.command(
    epilog=_examples(
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
    regions all of it has the model, or --region. --with takes other problem files as models.

    Finished runs are kept in the output folder: the same command resumes.
    """
    from .problem import Problem
    from .study import Limits, plan_comparison
    from .study.arguments import parse_methods, read_truth
    from .study.table import Yardstick

    names = parse_methods(methods) if methods is not None else ()
    limits = Limits(workers, scheduler, time_limit)
    loaded = Problem.read(problem, set_ or (), allow_code)
    if with_ and (materials is not None or prony is not None):
        raise InputError(
            "found --materials or --prony too; expected other files alone", None, "--with"
        )
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
    from .problem import Problem
    from .study import plan_models
    from .study.variants import file_variants, parse_branches, parse_materials, variants

    if len(methods) > 1:
        raise InputError(
            f"found {', '.join(methods)}; expected one method to compare models by, or methods "
            "without --materials and --prony",
            None,
            "--methods",
        )
    if files:
        problems = [problem, *(Problem.read(file, overrides, allow_code) for file in files)]
        found = file_variants(problems, overrides)
        return plan_models(problem, found, methods[0] if methods else None, allow_code)
    named = parse_materials(materials) if materials is not None else ()
    counts = parse_branches(prony) if prony is not None else ()
    fitted = [e for e in problem.experiments if not e.validation]
    times_s = min(e.timestep_s for e in fitted), max(e.duration_s for e in fitted)
    assert problem.path is not None  # it was read
    found = variants(problem.path, overrides, named, counts, times_s, region)
    for variant in found:  # a model that cannot be would fail every run
        Problem.read(problem.path, variant.overrides, allow_code)
    return plan_models(problem, found, methods[0] if methods else None, allow_code)


@app.command(
    epilog=_examples(
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
    from .problem import Problem
    from .study import Limits, plan_sweep
    from .study.arguments import parse_methods, parse_over
    from .study.table import Yardstick

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
    from .output.record import as_json as json_text
    from .study import RunStore, run_all
    from .study.display import StudyProgress, study_tables
    from .study.report import load_report, report_json, write_report

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
        _show(study_tables(report, folder))


def _dry_run(planned: Sequence[PlannedRun], finished: Sequence[str], as_json: bool) -> None:
    from .study.display import plan_table

    if as_json:
        listed = [{**run.as_dict(), "finished": run.key in finished} for run in planned]
        typer.echo(json.dumps(listed, indent=1, ensure_ascii=False))
    else:
        _show(plan_table(planned, finished))


@app.command(
    epilog=_examples(
        "check problem.toml", "check problem.toml --set transcription.scheme=backward-euler"
    )
)
def check(
    problem: ProblemPath,
    set_: Overrides = None,
    allow_code: AllowCode = False,
    as_json: AsJson = False,
) -> None:
    """Tell what is wrong with a problem before solving it."""
    from .check import check_problem
    from .problem import Problem
    from .terminal import check_table

    findings = check_problem(Problem.read(problem, set_ or (), allow_code))
    if as_json:
        typer.echo(json.dumps(findings.as_dict(), indent=1))
    else:
        _show(check_table(findings))
    good = findings.derivatives_agree and not findings.causes
    raise typer.Exit(0 if good else EXIT_NOT_CONVERGED)


@app.command(
    epilog=_examples(
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
    from .design import Criterion, DesignOptions, Limits
    from .design import design as designed
    from .design.display import DesignProgress, design_summary
    from .design.folder import DESIGN_FILE, as_dict, write_design
    from .output.record import as_json as json_text
    from .output.writers import require_replaceable
    from .problem import Problem

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
        _show(design_summary(found, folder))
    raise typer.Exit(EXIT_INTERRUPTED if found.found.interrupted else 0)


@app.command(epilog=_examples("refine runs/swing", "refine runs/swing --levels 3"))
def refine(
    run_folder: RunFolder,
    levels: Annotated[int, typer.Option(help="2, or 3 to observe the orders: much longer.")] = 2,
    allow_code: AllowCode = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Solve again with half the step and a finer mesh: the numerical error.

    Each starts from the run's answer. The folder gets refinement.json, and result.json the
    numerical error of each parameter, with an interval for noise and discretisation.
    """
    from .output.record import as_json as json_text
    from .output.refined import refine_run
    from .terminal import refinement_table

    def say(what: str) -> None:
        if not quiet:
            errors.print(Text(what, style="dim"), soft_wrap=True)

    found, result = refine_run(run_folder, levels, allow_code, say)
    if as_json:
        typer.echo(json_text({**found.as_dict(), "trust": result["trust"]}))
    else:
        _show(refinement_table(found))
        for reason in result["trust"]["reasons"]:
            _show(Text(f"{result['trust']['verdict']}: {reason}"))


@app.command(
    epilog=_examples(
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
    from dataclasses import asdict

    from .export import Identified, export_run, target_named, verify_export
    from .output.record import as_json as json_text
    from .terminal import comparison_table, export_notes

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
    _show(export_notes(body.warnings, exported.limits))
    if verify:
        _show(comparison_table(target.name, found))
    typer.echo(folder)


@app.command(epilog=_examples("plot runs/swing"))
def plot(
    run_folder: RunFolder,
    out: Out = None,
) -> None:
    """Draw the pictures of a run again, from its files."""
    from .output.redraw import redraw

    require_possible(out or run_folder)
    for file in redraw(run_folder, out or run_folder):
        typer.echo(file)


@app.command(epilog=_examples("report runs/swing", "report runs/compare --to comparison.html"))
def report(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="A run folder, or one of compare or sweep.")
    ],
    to: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Where to write; report.html in the folder.")
    ] = None,
) -> None:
    """Write one HTML page about a run or a study.

    Everything it found, pictures inside.
    """
    from .output.report import comparison_page, run_page

    file = to or folder / "report.html"
    study = (folder / "summary.json").is_file()
    page = comparison_page(folder) if study else run_page(folder)
    require_possible(file.parent)
    file.write_text(page, encoding="utf-8")
    typer.echo(file)


@app.command(epilog=_examples("animate runs/swing --to swing.mp4", "animate runs/swing --slow 4"))
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

    from .output.animation import animate as film

    require_possible(to.parent if to is not None else run_folder)
    with Progress(console=errors, transient=True, disable=quiet or not errors.is_terminal) as bar:
        task = bar.add_task("filming", total=1.0)
        file = film(
            run_folder, to, fps, slow, experiment, lambda share: bar.update(task, completed=share)
        )
    typer.echo(file)


@app.command(epilog=_examples("view runs/swing", "view runs/swing --html swing.html"))
def view(
    run_folder: RunFolder,
    field: Annotated[
        str, typer.Option(help="Field of the frames that colours the body.")
    ] = "von_mises_pa",
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a web page, open no window.")
    ] = None,
    experiment: OneExperiment = None,
) -> None:
    """Look at a run in 3-D.

    In a window (needs pyvista), or as a web page that needs nothing.
    """
    from .output.view import export_page
    from .output.view import view as show

    if html is None:
        show(run_folder, field, experiment)
        return
    require_possible(html.parent)
    typer.echo(export_page(run_folder, html, experiment))


@app.command(epilog=_examples("methods", "methods interior-point"))
def methods(
    name: Annotated[str | None, typer.Argument(help="Tell this method's options.")] = None,
    as_json: AsJson = False,
) -> None:
    """List the methods, or the options of one: defaults, values, and what they do."""
    from .method_tables import methods_table, options_table
    from .methods import METHODS
    from .methods.described import options_schema, require_method, summary

    if name is not None:
        require_method(name, "NAME")
    if as_json:
        listed = options_schema(name) if name else {each: summary(each) for each in METHODS}
        typer.echo(json.dumps(listed, indent=1, ensure_ascii=False))
    else:
        Console(highlight=False).print(options_table(name) if name else methods_table())


@app.command(
    epilog=_examples(
        "live problem.toml < frames.jsonl", "live problem.toml --udp 9870 > estimates.jsonl"
    )
)
def live(
    problem: ProblemPath,
    udp: Annotated[
        int | None, typer.Option(metavar="PORT", help="Read a UDP port of this machine instead.")
    ] = None,
    budget_ms: Annotated[
        float | None, typer.Option(help="Time a frame may take; 80 % of a sample by default.")
    ] = None,
    window_s: Annotated[float, typer.Option(help="Frames that are passed again.")] = 3.0,
    set_: Overrides = None,
    allow_code: AllowCode = False,
) -> None:
    """Identify while the recording is made: frames in, a line of JSON for each out.

    A frame is a line: {"t_s": 0.01, "pose": {"position_m": [x, y, z], "quaternion_xyzw": [x, y, z,
    w]}, "markers": {"tip": [x, y, z]}}, or a row of a table whose first line is t_s, x_m, y_m,
    z_m, qx, qy, qz, qw, tip_x, tip_y, tip_z and so on. A line that is no frame is told and left
    out, and the exit code is 2 then. An empty datagram ends.
    """
    from .live.frames import FrameReader
    from .live.sources import as_json, datagrams

    estimator = _estimator(problem, set_, allow_code, budget_ms, window_s)

    def opened(port: int) -> None:
        errors.print(f"listening on UDP port {port} of this machine")

    lines, source = (sys.stdin, "standard input")
    if udp is not None:
        lines, source = datagrams(udp, opened), f"UDP port {udp}"
    reader = FrameReader(estimator.model.moved_grasps + 1, estimator.names, source)
    bad = 0
    for line in lines:
        try:
            frame = reader.read(line)
        except InputError as error:
            bad += 1
            errors.print(Text(f"error: {error}"), soft_wrap=True)
            continue
        if frame is not None:
            typer.echo(as_json(estimator.take(frame)))
    if bad:
        raise typer.Exit(EXIT_BAD_INPUT)


@app.command(
    epilog=_examples(
        "replay problem.toml --rate 100",
        "replay runs/swing --film swing.gif",
        "replay problem.toml --json --rate 0",
    )
)
def replay(
    recording: Annotated[
        Path, typer.Argument(metavar="RUN_OR_PROBLEM", help="A problem file, or a run's folder.")
    ],
    rate: Annotated[
        float | None,
        typer.Option(metavar="HZ", help="Frames a second; as recorded by default, 0: at once."),
    ] = None,
    film: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the estimates as a .gif.")
    ] = None,
    budget_ms: Annotated[
        float | None, typer.Option(help="Time a frame may take; 80 % of a sample by default.")
    ] = None,
    window_s: Annotated[float, typer.Option(help="Frames that are passed again.")] = 3.0,
    set_: Overrides = None,
    allow_code: AllowCode = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Stream a recording as if it were made now, and estimate from it live."""
    from rich.live import Live

    from .live import view
    from .live.sources import as_json as json_line
    from .live.sources import paced, recorded

    if rate is not None and not 0 <= rate < float("inf"):
        raise InputError(f"found {rate:g}; expected a number, 0 or more", None, "--rate")
    if film is not None:
        require_possible(film.parent)
        view.require_film(film)
    estimator = _estimator(recording, set_, allow_code, budget_ms, window_s)
    experiment = estimator.model.experiment
    frames = recorded(experiment, estimator.model)
    pace = 1.0 / experiment.timestep_s if rate is None else rate
    updates = []
    watched = errors.is_terminal and not quiet and not as_json
    with Live(console=errors, auto_refresh=watched, refresh_per_second=10) as shown:
        for frame in paced(frames, pace) if pace else frames:
            updates.append(estimator.take(frame))
            if as_json:
                typer.echo(json_line(updates[-1]))
            elif watched:
                shown.update(view.picture(updates))
    if not as_json:
        _show(view.summary(updates))
    if film is not None:
        typer.echo(view.film(updates, film))


def _estimator(
    recording: Path,
    overrides: list[str] | None,
    allow_code: bool,
    budget_ms: float | None,
    window_s: float,
) -> Estimator:
    from .live import Estimator, LiveOptions
    from .live.sources import problem_in

    for name, value in (("--budget-ms", budget_ms), ("--window-s", window_s)):
        if value is not None and not 0 < value < float("inf"):
            raise InputError(f"found {value:g}; expected a number above 0", None, name)
    options = LiveOptions(None if budget_ms is None else 1e-3 * budget_ms, window_s)
    return Estimator(problem_in(recording, overrides or (), allow_code), options)


@app.command()
def schema() -> None:
    """Print the JSON schema of the problem file."""
    from .problem.schema import ProblemFile

    typer.echo(json.dumps(ProblemFile.model_json_schema(), indent=1))


@app.command(epilog=_examples("new my_object", "check my_object/problem.toml"))
def new(name: Annotated[str, typer.Argument(help="Name of the new folder.")]) -> None:
    """Write a commented problem file to start from."""
    from .problem.template import write_template

    typer.echo(write_template(Path(name)))


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(version("collocation-sysid"))
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print it.")
    ] = False,
) -> None:
    pass


def _show(content: RenderableType) -> None:
    """Print on stdout: on a terminal wrapped between words, in files with lines kept whole."""
    console = Console(highlight=False)
    console.print(content, soft_wrap=not console.is_terminal)


def main() -> None:
    """Entry point: turns errors into one message and an exit code."""
    restore = heed_interrupts()
    try:
        app(prog_name="collocation-sysid")
    except InputError as error:
        _refuse("error", error, EXIT_BAD_INPUT)
    except OSError as error:
        reason = InputError(error.strerror or str(error), error.filename)
        _refuse("error", reason, EXIT_BAD_INPUT)
    except SimulationError as error:
        _refuse("simulation failed", error, EXIT_NOT_CONVERGED)
    finally:
        restore()


def _refuse(kind: str, error: Exception, code: int) -> NoReturn:
    errors.print(Text(f"{kind}: ", style="red").append(str(error), style="default"), soft_wrap=True)
    sys.exit(code)
