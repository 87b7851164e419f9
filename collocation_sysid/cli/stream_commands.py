"""Commands that estimate while frames arrive: live and replay."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.text import Text

from ..common.files import require_possible
from ..common.validated_classes import validated
from ..common.validated_types import NotNegative, Positive
from ..errors import InputError
from ..extras.live import LiveEstimator, LiveOptions, LiveUpdate
from ..extras.live.sources import read_problem
from .command_options import AllowCode, OutputOptions, Overrides, ProblemPath, command, option
from .common import EXIT_BAD_INPUT, error_console, print_result, shown_progress

if TYPE_CHECKING:
    from ..extras.live.frames import Frame
    from ..extras.live.recording import LiveRecording

commands = typer.Typer()


@validated(kw_only=True)
class LiveEstimationOptions:
    """Options of commands that estimate from frames as they come.

    Attributes
    ----------
    budget_ms : float
        Computing time per frame [ms]; by default 80 % of the time between samples.
    window_s : float
        Time span before the present frame in which earlier frames are recomputed [s].
    rerun : FILE
        File .rrd for the Rerun viewer, to which estimates, mesh and residuals are written as they
        arrive.
    """

    budget_ms: Positive | None = None
    window_s: Positive = 3.0
    rerun: Path | None = None
    set_: Overrides = None
    allow_code: AllowCode = False

    def make_estimator(self, recording: Path, quiet: bool = False) -> LiveEstimator:
        """Return the estimator for a problem file or a run folder, with these options.

        Raises
        ------
        InputError
            If the problem is not usable, or not for a live estimate, or if the file of --rerun
            cannot be written.
        """
        if self.rerun is not None:
            from ..extras.live.recording import require_recordable

            require_recordable(self.rerun)

        budget_s = None if self.budget_ms is None else 1e-3 * self.budget_ms
        with shown_progress(f"reading {recording}", quiet=quiet) as progress:
            problem = read_problem(recording, self.set_ or (), allow_code=self.allow_code)
            progress.say("preparing the estimator")
            return LiveEstimator(problem, LiveOptions(budget_s, self.window_s))

    @contextmanager
    def open_recording(self, estimator: LiveEstimator) -> Iterator[LiveRecording | None]:
        """Give the recording of --rerun, which is closed at the end; None without the option."""
        if self.rerun is None:
            yield None
            return
        from ..extras.live.recording import LiveRecording

        written = LiveRecording(self.rerun, estimator.model.experiment)
        try:
            yield written
        finally:
            written.close()


def processed(
    estimator: LiveEstimator, frame: Frame, recording: LiveRecording | None
) -> LiveUpdate:
    """Return the update of a frame, and add it to the recording if there is one."""
    update = estimator.process_frame(frame)
    if recording is not None:
        recording.write(frame, update, positions_m=estimator.node_positions_m)
    return update


def settled_update(estimator: LiveEstimator, recording: LiveRecording | None) -> LiveUpdate | None:
    """Return the final update, None without frames, and add it to the recording if there is one."""
    settled = estimator.finish()
    if recording is not None and settled is not None:
        recording.write_estimates(settled)
    return settled


@command(
    commands,
    "live problem.toml < frames.jsonl",
    "live problem.toml --udp 9870 > estimates.jsonl",
    "live problem.toml --rerun swing.rrd < frames.jsonl",
)
def live(
    *,
    problem: ProblemPath,
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
    estimation: LiveEstimationOptions,
) -> None:
    """Estimate the parameters while a recording is made.

    The command reads frames. It prints a line of JSON for each frame, and one with the final
    result. A frame is a line: {"t_s": 0.01, "pose": {"position_m": [x, y, z], "quaternion_xyzw":
    [x, y, z, w]}, "markers": {"tip": [x, y, z]}}, or a row of a table whose first line is t_s, x_m,
    y_m, z_m, qx, qy, qz, qw, tip_x, tip_y, tip_z and so on. A line that is not a frame is reported
    and ignored, and the exit code is then 2. An empty datagram ends the recording.
    """
    from ..extras.live.frames import FrameReader
    from ..extras.live.sources import (
        decode_lines,
        receive_datagrams,
        update_as_json,
        without_garbage_of_startup,
    )

    if udp is None and sys.stdin is None:  # closed by whoever started the process
        raise InputError(
            "is closed; expected frames, as in live problem.toml < frames.jsonl, or --udp PORT",
            "standard input",
        )
    estimator = estimation.make_estimator(problem)

    def opened(port: int) -> None:
        """Print on stderr that the port is open."""
        error_console.print(f"listening on UDP port {port} of this machine")

    if udp is None:
        lines = decode_lines(sys.stdin.buffer)
        source = "standard input"
    else:
        lines = receive_datagrams(udp, opened)
        source = f"UDP port {udp}"
    reader = FrameReader.from_model(estimator.model, estimator.problem, source=source)
    bad = 0
    with estimation.open_recording(estimator) as recording:
        with without_garbage_of_startup():
            for line in lines:
                try:
                    frame = reader.read(line)
                except InputError as error:
                    bad += 1
                    error_console.print(Text(f"error: {error}"), soft_wrap=True)
                    continue
                if frame is not None:
                    update = processed(estimator, frame, recording=recording)
                    typer.echo(update_as_json(update))
        settled = settled_update(estimator, recording)
    if settled is not None:
        typer.echo(update_as_json(settled))
    if bad:
        raise typer.Exit(EXIT_BAD_INPUT)


@command(
    commands,
    "replay problem.toml --rate 100",
    "replay runs/swing --film swing.gif",
    "replay problem.toml --json --rate 0",
)
def replay(
    *,
    recording: Annotated[
        Path, typer.Argument(metavar="RUN_OR_PROBLEM", help="A problem file, or a run folder.")
    ],
    rate: Annotated[
        NotNegative | None,
        option("Frames per second; by default as recorded, 0 for as fast as possible.", "HZ"),
    ] = None,
    film: Annotated[
        Path | None, option("File .gif to which a film of the estimates is written.", "FILE")
    ] = None,
    estimation: LiveEstimationOptions,
    output: OutputOptions,
) -> None:
    """Stream a recording as if it were being made, and estimate the parameters live."""
    from rich.live import Live

    from ..common.display import on_terminal
    from ..extras.live import display
    from ..extras.live.sources import frames_of_recording, paced_frames, without_garbage_of_startup
    from ..extras.live.sources import update_as_json as json_line

    if film is not None:
        require_possible(film.parent)
        display.require_gif(film)
    estimator = estimation.make_estimator(recording, output.quiet)
    experiment = estimator.model.experiment
    frames = frames_of_recording(experiment, estimator.model)
    pace = 1.0 / experiment.timestep_s if rate is None else rate
    updates = []
    watched = error_console.is_terminal and not output.quiet and not output.as_json
    shown = Live(console=error_console, refresh_per_second=10)
    with estimation.open_recording(estimator) as written:
        with without_garbage_of_startup(), shown if watched else nullcontext():
            for frame in paced_frames(frames, pace) if pace else frames:
                updates.append(processed(estimator, frame, recording=written))
                if output.as_json:
                    typer.echo(json_line(updates[-1]))
                elif watched:
                    shown.update(on_terminal(display.display_of(updates)))
        settled = settled_update(estimator, written) or updates[-1]
    if output.as_json:
        typer.echo(json_line(settled))
    else:
        print_result(display.final_display(updates, settled))
    if film is not None:
        with shown_progress("making the film", quiet=output.quiet):
            display.write_film(updates, film)
        typer.echo(film)
