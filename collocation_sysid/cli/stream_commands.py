"""Commands that estimate while frames arrive: live and replay."""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated

import typer
from rich.text import Text

from ..common.validated_types import NotNegative, Positive
from ..errors import InputError
from ..extras.live import Frame, FrameReader, LiveEstimator, LiveUpdate
from ..extras.live.sources import arrived, as_json, frames_of_recording, paced_frames, receive_lines
from ..recording.sample_times import TIME_TOLERANCE_S
from .command_options import OutputOptions, ProblemOptions, command, option
from .common import EXIT_BAD_INPUT, error_console, interruption_exit, print_result, shown_progress

commands = typer.Typer()

EveryS = Annotated[Positive, option("Seconds of new frames before each solve.", "SECONDS")]


def _updates(
    estimator: LiveEstimator, batches: Iterable[list[Frame]], every_s: float
) -> Iterator[LiveUpdate]:
    """Yield answers, each after `every_s` of frames; report once that nothing can be solved yet."""
    solved_s, newest_s, reported = None, -float("inf"), ""
    for batch in batches:
        for frame in batch:
            estimator.add_frame(frame)
            newest_s = max(newest_s, frame.t_s)
            solved_s = newest_s if solved_s is None else solved_s
        if solved_s is None or newest_s < solved_s + every_s - TIME_TOLERANCE_S:
            continue
        solved_s = newest_s
        try:
            yield estimator.solve()
        except InputError as error:
            if str(error) != reported:
                error_console.print(Text(f"not solved yet: {error}"), soft_wrap=True)
            reported = str(error)


def _follow(
    estimator: LiveEstimator,
    batches: Iterable[list[Frame]],
    *,
    every_s: float,
    has_json: bool,
    quiet: bool = False,
) -> None:
    from ..result.run_summary import run_summary

    last = None
    try:
        for last in _updates(estimator, batches, every_s):
            typer.echo(as_json(last) if has_json else last)
        with shown_progress("solving the complete recording", quiet=quiet):
            finished = estimator.finish()
    except KeyboardInterrupt:
        kept = "there is no answer" if last is None else f"the last answer is that at {last}"
        raise interruption_exit(kept, continues=False) from None
    if has_json:
        typer.echo(as_json(finished))
    else:
        print_result(run_summary(finished.result))


def _ignored(bad: Sequence[InputError]) -> str:
    others = f"; this line and {len(bad) - 1} others are ignored" if len(bad) > 1 else ""
    return f"{bad[0]}{others or '; this line is ignored'}"


@command(
    commands, "live problem.toml < frames.jsonl", "live problem.toml --udp 9870 > estimates.jsonl"
)
def live(
    *,
    udp: Annotated[
        int | None,
        typer.Option(
            "--udp",
            min=0,
            max=65535,
            metavar="PORT",
            help="Read frames from this UDP port instead of standard input.",
        ),
    ] = None,
    every_s: EveryS = 1.0,
    source: ProblemOptions,
) -> None:
    """Estimate the parameters while a recording is made.

    The command reads frames, and solves the recording so far about once a second. It prints a line
    of JSON for each solve, and one with the final result. A frame is a line: {"t_s": 0.01, "pose":
    {"position_m": [x, y, z], "quaternion_xyzw": [x, y, z, w]}, "markers": {"tip": [x, y, z]}}.
    Lines that are not frames are ignored; the first one is reported, and the exit code is then 2.
    An empty datagram ends the recording. After Ctrl-C the last answer is kept.
    """
    if udp is None and sys.stdin is None:  # closed by whoever started the process
        raise InputError(
            "is closed; expected frames, as in live problem.toml < frames.jsonl, or --udp PORT",
            "standard input",
        )
    problem = source.read_problem()
    estimator = LiveEstimator(problem)
    lines: Iterable[bytes]
    if udp is None:
        lines, name = sys.stdin.buffer, "standard input"
    else:
        receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        receiver.bind(("127.0.0.1", udp))
        lines, name = receive_lines(receiver), f"UDP port {receiver.getsockname()[1]}"
        error_console.print(f"listening on {name} of this machine")
    reader = FrameReader(estimator.experiment, problem, name)
    bad: list[InputError] = []
    found_s, is_reported = 0.0, False

    def batches() -> Iterator[list[Frame]]:
        nonlocal found_s, is_reported
        for batch in arrived(lines):
            # At once would be beside the reason why the end of a short recording is not solved.
            if bad and not is_reported and time.monotonic() > found_s + every_s:
                error_console.print(Text(f"error: {_ignored(bad)}"), soft_wrap=True)
                is_reported = True
            frames = []
            for line in batch:
                try:
                    frames.append(reader.read(line))
                except InputError as error:
                    found_s = found_s if bad else time.monotonic()
                    bad.append(error)
            yield [frame for frame in frames if frame is not None]

    try:
        _follow(estimator, batches(), every_s=every_s, has_json=True)
    except InputError as error:
        if not bad or is_reported:
            raise
        raise InputError(f"{_ignored(bad)}; without them: {error}") from error
    if bad and not is_reported:
        raise InputError(_ignored(bad))
    if bad:
        raise typer.Exit(EXIT_BAD_INPUT)


@command(
    commands,
    "replay problem.toml --every-s 0.1",
    "replay problem.toml --rate 100",
    "replay problem.toml --json --rate 0",
)
def replay(
    *,
    rate: Annotated[
        NotNegative | None,
        option("Frames per second; by default as recorded, 0 for as fast as possible.", "HZ"),
    ] = None,
    every_s: EveryS = 1.0,
    source: ProblemOptions,
    output: OutputOptions,
) -> None:
    """Stream the recording of a problem as if it were being made, and estimate the parameters."""
    estimator = LiveEstimator(source.read_problem(output.quiet))
    frames = frames_of_recording(estimator.experiment)
    pace = 1.0 / estimator.experiment.timestep_s if rate is None else rate
    batches = arrived(paced_frames(frames, pace)) if pace else ([frame] for frame in frames)
    _follow(estimator, batches, every_s=every_s, has_json=output.as_json, quiet=output.quiet)
