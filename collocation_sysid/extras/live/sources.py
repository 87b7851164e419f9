"""Sources of frames: lines of a stream, datagrams on this machine, or a recording."""

from __future__ import annotations

import gc
import json
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ...problem import Problem
from ...program.streaming import StreamingModel
from ...recording.experiment import Experiment
from ...recording.sample_times import TIME_TOLERANCE_S
from ...runs.result_content import Result
from .estimator import LiveUpdate
from .frames import Frame

# Largest accepted datagram [bytes].
DATAGRAM_BYTES = 65536
# Address of this machine; datagrams from others are not received.
LOCALHOST = "127.0.0.1"


def decode_lines(lines: Iterable[bytes]) -> Iterator[str]:
    """Decode lines of UTF-8.

    Invalid bytes are replaced by a character that no number or name contains.
    """
    return (line.decode("utf-8", errors="replace") for line in lines)


def receive_datagrams(
    port: int, opened: Callable[[int], None] | None = None
) -> Iterator[str]:
    """Yield lines that arrive as UDP datagrams at a port of this machine, until an empty datagram.

    Parameters
    ----------
    port : int
        Port; 0 for any free one.
    opened : callable, optional
        Called with the port once it is open.

    Raises
    ------
    OSError
        If the port is in use.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind((LOCALHOST, port))
        if opened is not None:
            opened(receiver.getsockname()[1])
        while datagram := receiver.recv(DATAGRAM_BYTES):
            yield from decode_lines(datagram.splitlines())


def read_problem(
    recording: Path, overrides: Sequence[str], allow_code: bool
) -> Problem:
    """Return the problem of a file, or that of the folder of a run.

    Raises
    ------
    InputError
        If there is none.
    """
    if not recording.is_dir():
        return Problem.read(recording, overrides, allow_code)
    home = Result.read(recording).problem_folder(
        recording, "which a replay needs"
    )
    return Problem.read(
        recording / "problem.toml", overrides, allow_code, folder=home
    )


def frames_of_recording(
    experiment: Experiment, model: StreamingModel
) -> Iterator[Frame]:
    """Yield the frames of an experiment's recording in the order of time; samples of instruments
    come with the first frame that is not earlier.
    """
    poses = [
        experiment.grasps[k].poses.at(experiment.t_s)
        for k in model.moving_grasps
    ]
    quaternion_series = [
        Rotation.from_matrix(rotations).as_quat() for rotations, _ in poses
    ]
    series = [
        (gauge.sample_times_s, gauge.measured_values)
        for gauge in experiment.readings
    ]
    series += [
        (wrench.t_s, wrench.values) for wrench in model.wrenches.values()
    ]
    samples = [
        (number, float(at_s), values)
        for number, each in enumerate(series, 1)
        for at_s, values in zip(*each, strict=True)
    ]
    frame_of = np.searchsorted(
        experiment.t_s, [at_s - TIME_TOLERANCE_S for _, at_s, _ in samples]
    )
    for k, t_s in enumerate(experiment.t_s):
        positions_m = np.array([translations[k] for _, translations in poses])
        quaternions = np.array([each[k] for each in quaternion_series])
        frame_samples = tuple(
            each
            for each, frame in zip(samples, frame_of, strict=True)
            if frame == k
        )
        tracks_m = experiment.markers.positions_m[k]
        yield Frame(
            float(t_s),
            (positions_m, quaternions),
            tracks_m=tracks_m,
            instrument_samples=frame_samples,
        )


def paced_frames(
    frames: Iterator[Frame],
    rate_hz: float,
    clock: Callable[[], float] = time.monotonic,
    wait: Callable[[float], None] = time.sleep,
) -> Iterator[Frame]:
    """Yield frames at a rate; after a delay the next ones follow immediately.

    Parameters
    ----------
    frames : iterator of Frame
    rate_hz : float
    clock, wait : callable
        Time in seconds, and a function that waits.
    """
    began = clock()
    for number, frame in enumerate(frames):
        waiting_s = began + number / rate_hz - clock()
        if waiting_s > 0:
            wait(waiting_s)
        yield frame


@contextmanager
def without_garbage_of_startup() -> Iterator[None]:
    """Exclude all existing objects from garbage collection within this context.

    A collection of all objects takes longer than some frames.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def update_as_json(update: LiveUpdate) -> str:
    """Return an update as a line of JSON; unknown values are null."""
    parameters = {
        name: {
            "value": each.value,
            "statistical_std_error": each.statistical_std_error,
            "statistical95": each.statistical95,
        }
        for name, each in update.estimates.items()
    }
    rms_m = update.marker_rms_m
    return json.dumps(
        {
            "t_s": update.t_s,
            "parameters": parameters,
            "trust": {
                "verdict": update.trust.verdict,
                "reasons": update.trust.reasons,
            },
            "marker_rms_m": rms_m if np.isfinite(rms_m) else None,
            "latency_s": round(update.latency_s, 6),
            "notes": update.notes,
        },
        ensure_ascii=False,
    )
