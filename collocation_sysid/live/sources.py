"""Where frames come from: lines of a stream, datagrams on this machine, or a recording."""

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

from ..problem import Problem
from ..recording.clock import TIME_TOLERANCE_S
from ..recording.experiment import Experiment
from ..runs.result import Result
from .estimator import Update
from .frames import Frame
from .model import Model

# Largest datagram, and this machine's own address: nobody else is listened to.
DATAGRAM_BYTES, HERE = 65536, "127.0.0.1"


def as_text(lines: Iterable[bytes]) -> Iterator[str]:
    """Lines of UTF-8; what is none of it becomes a sign that no number and no name has."""
    return (line.decode("utf-8", errors="replace") for line in lines)


def datagrams(port: int, opened: Callable[[int], None] | None = None) -> Iterator[str]:
    """Lines that come as UDP datagrams to a port of this machine, until an empty one comes.

    Parameters
    ----------
    port : int
        Any free one where it is 0.
    opened : callable, optional
        Called with the port once it is open.

    Raises
    ------
    OSError
        Where the port is taken.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind((HERE, port))
        if opened is not None:
            opened(receiver.getsockname()[1])
        while datagram := receiver.recv(DATAGRAM_BYTES):
            yield from as_text(datagram.splitlines())


def problem_in(recording: Path, overrides: Sequence[str], allow_code: bool) -> Problem:
    """The problem of a file, or the one that a run's folder is of.

    Raises
    ------
    InputError
        Where there is none.
    """
    if not recording.is_dir():
        return Problem.read(recording, overrides, allow_code)
    home = Result.read(recording).home(recording, "which a replay needs")
    return Problem.read(recording / "problem.toml", overrides, allow_code, folder=home)


def recorded(experiment: Experiment, model: Model) -> Iterator[Frame]:
    """The frames of an experiment's recording."""
    moved = [experiment.grasps[k].poses.at(experiment.t_s) for k in model.moved_grasps]
    turns = [Rotation.from_matrix(rotations).as_quat() for rotations, _ in moved]
    series = [(gauge.times, gauge.measured) for gauge in experiment.readings]
    series += [(wrench.t_s, wrench.values) for wrench in model.wrenches.values()]
    told = [
        (number, float(at_s), values)
        for number, each in enumerate(series, 1)
        for at_s, values in zip(*each, strict=True)
    ]
    frame_of = np.searchsorted(experiment.t_s, [at_s - TIME_TOLERANCE_S for _, at_s, _ in told])
    for k, t_s in enumerate(experiment.t_s):
        positions_m = np.array([translations[k] for _, translations in moved])
        quaternions = np.array([each[k] for each in turns])
        own = tuple(each for each, frame in zip(told, frame_of, strict=True) if frame == k)
        seen_m = experiment.markers.positions_m[k]
        yield Frame(float(t_s), (positions_m, quaternions), seen_m, told=own)


def paced(
    frames: Iterator[Frame],
    rate_hz: float,
    clock: Callable[[], float] = time.monotonic,
    wait: Callable[[float], None] = time.sleep,
) -> Iterator[Frame]:
    """Frames at a rate; where they are taken too slowly, the next ones come at once."""
    began = clock()
    for number, frame in enumerate(frames):
        left_s = began + number / rate_hz - clock()
        if left_s > 0:
            wait(left_s)
        yield frame


@contextmanager
def collected_before() -> Iterator[None]:
    """Nothing that is there before frames come is looked through for garbage while they do.

    A collection of all objects takes longer than some frames.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def as_json(update: Update) -> str:
    """A line that tells an update; what is not known is null."""
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
            "trust": {"verdict": update.trust.verdict, "reasons": update.trust.reasons},
            "marker_rms_m": rms_m if np.isfinite(rms_m) else None,
            "latency_s": round(update.latency_s, 6),
            "notes": update.notes,
        },
        ensure_ascii=False,
    )
