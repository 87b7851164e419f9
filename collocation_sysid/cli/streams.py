"""Commands that identify while frames arrive."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from ..errors import InputError
from ..folders import require_possible
from .common import (
    EXIT_BAD_INPUT,
    AllowCode,
    AsJson,
    Overrides,
    ProblemPath,
    Quiet,
    errors,
    examples,
    show,
)

if TYPE_CHECKING:
    from ..live import Estimator

commands = typer.Typer()


@commands.command(
    epilog=examples(
        "live problem.toml < frames.jsonl", "live problem.toml --udp 9870 > estimates.jsonl"
    )
)
def live(
    problem: ProblemPath,
    udp: Annotated[
        int | None,
        typer.Option(
            metavar="PORT", min=0, max=65535, help="Read a UDP port of this machine instead."
        ),
    ] = None,
    budget_ms: Annotated[
        float | None, typer.Option(help="Time a frame may take; 80 % of a sample by default.")
    ] = None,
    window_s: Annotated[float, typer.Option(help="Frames that are passed again.")] = 3.0,
    set_: Overrides = None,
    allow_code: AllowCode = False,
) -> None:
    """Identify while the recording is made: frames in, a line of JSON for each out, one at the end.

    A frame is a line: {"t_s": 0.01, "pose": {"position_m": [x, y, z], "quaternion_xyzw": [x, y, z,
    w]}, "markers": {"tip": [x, y, z]}}, or a row of a table whose first line is t_s, x_m, y_m,
    z_m, qx, qy, qz, qw, tip_x, tip_y, tip_z and so on. A line that is no frame is told and left
    out, and the exit code is 2 then. An empty datagram ends.
    """
    from ..live.frames import FrameReader
    from ..live.sources import as_json, as_text, collected_before, datagrams

    estimator = _estimator(problem, set_, allow_code, budget_ms, window_s)

    def opened(port: int) -> None:
        errors.print(f"listening on UDP port {port} of this machine")

    lines, source = as_text(sys.stdin.buffer), "standard input"
    if udp is not None:
        lines, source = datagrams(udp, opened), f"UDP port {udp}"
    reader = FrameReader(estimator.model.moved_grasps + 1, estimator.names, source)
    bad = 0
    with collected_before():
        for line in lines:
            try:
                frame = reader.read(line)
            except InputError as error:
                bad += 1
                errors.print(Text(f"error: {error}"), soft_wrap=True)
                continue
            if frame is not None:
                typer.echo(as_json(estimator.take(frame)))
    if (settled := estimator.settle()) is not None:
        typer.echo(as_json(settled))
    if bad:
        raise typer.Exit(EXIT_BAD_INPUT)


@commands.command(
    epilog=examples(
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

    from ..display import on_terminal
    from ..live import view
    from ..live.sources import as_json as json_line
    from ..live.sources import collected_before, paced, recorded

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
    shown = Live(console=errors, refresh_per_second=10)
    with collected_before(), shown if watched else nullcontext():
        for frame in paced(frames, pace) if pace else frames:
            updates.append(estimator.take(frame))
            if as_json:
                typer.echo(json_line(updates[-1]))
            elif watched:
                shown.update(on_terminal(view.picture(updates)))
    settled = estimator.settle() or updates[-1]
    if as_json:
        typer.echo(json_line(settled))
    else:
        show(view.summary(updates, settled))
    if film is not None:
        typer.echo(view.film(updates, film))


def _estimator(
    recording: Path,
    overrides: list[str] | None,
    allow_code: bool,
    budget_ms: float | None,
    window_s: float,
) -> Estimator:
    from ..live import Estimator, LiveOptions
    from ..live.sources import problem_in

    for name, value in (("--budget-ms", budget_ms), ("--window-s", window_s)):
        if value is not None and not 0 < value < float("inf"):
            raise InputError(f"found {value:g}; expected a number above 0", None, name)
    options = LiveOptions(None if budget_ms is None else 1e-3 * budget_ms, window_s)
    return Estimator(problem_in(recording, overrides or (), allow_code), options)
