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
    """Return an iterator of lines as text, decoded from UTF-8.

    Invalid bytes are replaced by a character that no number or name contains, without an error.
    Line breaks are kept.
    """
    return (line.decode("utf-8", errors="replace") for line in lines)


def receive_datagrams(port: int, opened: Callable[[int], None] | None = None) -> Iterator[str]:
    """Yield lines of text that arrive as UDP datagrams at a port of this machine, until an empty
    datagram.

    A datagram may contain several lines; a line does not continue in the next datagram. Datagrams
    longer than `DATAGRAM_BYTES` are cut. Lines have no line break; see `decode_lines` for invalid
    bytes. The port is opened when the first line is asked for, and closed at the end; waiting has
    no time limit.

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


def read_problem(recording: Path, overrides: Sequence[str], allow_code: bool) -> Problem:
    """Return the problem of a file, or that of the folder of a run.

    Parameters
    ----------
    recording : Path
        Problem file; or the folder of a run, whose copy of the problem is read, with data files
        relative to the folder of the original problem.
    overrides : sequence of str
        Changes of keys, as in the option ``--set``.
    allow_code : bool
        Whether Python code to which the problem refers may be executed.

    Raises
    ------
    InputError
        If the file or folder has no valid problem.
    """
    if not recording.is_dir():
        return Problem.read(recording, overrides, allow_code=allow_code)
    home = Result.read(recording).problem_folder(
        recording, "which a replay needs: replay its problem from a problem file"
    )
    return Problem.read(recording / "problem.toml", overrides, allow_code=allow_code, folder=home)


def frames_of_recording(experiment: Experiment, model: StreamingModel) -> Iterator[Frame]:
    """Yield the frames of an experiment's recording, one for each sample time of `experiment`.

    Each has the poses of the moving grasps and the markers of that time. Samples of instruments
    come with the first frame that is not earlier; those after the last frame are left out.

    Parameters
    ----------
    experiment : Experiment
        Experiment whose markers are measured at its sample times.
    model : StreamingModel
        Model of the experiment, which gives the moving grasps and the order of the instruments.
    """
    poses = [experiment.grasps[k].poses.at(experiment.t_s) for k in model.moving_grasps]
    quaternion_series = [Rotation.from_matrix(rotations).as_quat() for rotations, _ in poses]
    series = [(gauge.sample_times_s, gauge.measured_values) for gauge in experiment.readings]
    series += [(sensor.t_s, sensor.values) for sensor in model.experiment.sensors_by_grasp.values()]
    samples = [
        (number, float(at_s), values)
        for number, each in enumerate(series, 1)
        for at_s, values in zip(*each, strict=True)
    ]
    frame_of = np.searchsorted(experiment.t_s, [at_s - TIME_TOLERANCE_S for _, at_s, _ in samples])
    for k, t_s in enumerate(experiment.t_s):
        positions_m = np.array([translations[k] for _, translations in poses])
        quaternions = np.array([each[k] for each in quaternion_series])
        frame_samples = tuple(
            each for each, frame in zip(samples, frame_of, strict=True) if frame == k
        )
        tracks_m = experiment.markers.positions_at_samples_m[k]
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
    """Yield frames at a constant rate, whatever their own times; the first one immediately.

    Frame k is due k / `rate_hz` after the first; after a delay the overdue ones follow
    immediately.

    Parameters
    ----------
    frames : iterator of Frame
        Frames to pass on unchanged.
    rate_hz : float
        Frames per second, above zero.
    clock, wait : callable
        Function that returns a time [s], and a function that waits for a time [s].
    """
    began = clock()
    for number, frame in enumerate(frames):
        waiting_s = began + number / rate_hz - clock()
        if waiting_s > 0:
            wait(waiting_s)
        yield frame


@contextmanager
def without_garbage_of_startup() -> Iterator[None]:
    """Context within which all objects that exist at its beginning are excluded from garbage
    collection, after one collection.

    A collection of all objects takes longer than some frames.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def update_as_json(update: LiveUpdate) -> str:
    """Return an update as one line of JSON, without line break.

    The keys are "t_s", "parameters" (by name "value", "statistical_std_error" and
    "statistical95"), "trust" ("verdict" and "reasons"), "marker_rms_m", "pixel_rms", "latency_s"
    (rounded to microseconds) and "notes". Standard errors and intervals that are None, and errors
    that are NaN, are null; `relinearised` is left out.
    """
    parameters = {
        name: {
            "value": each.value,
            "statistical_std_error": each.statistical_std_error,
            "statistical95": each.statistical95,
        }
        for name, each in update.estimates.items()
    }
    rms_m, rms_px = update.marker_rms_m, update.pixel_rms
    return json.dumps(
        {
            "t_s": update.t_s,
            "parameters": parameters,
            "trust": {"verdict": update.trust.verdict, "reasons": update.trust.reasons},
            "marker_rms_m": rms_m if np.isfinite(rms_m) else None,
            "pixel_rms": rms_px if np.isfinite(rms_px) else None,
            "latency_s": round(update.latency_s, 6),
            "notes": update.notes,
        },
        ensure_ascii=False,
    )
