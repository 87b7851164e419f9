"""Sources of frames: lines of a stream, datagrams on this machine, or a recording."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Iterable, Iterator
from queue import SimpleQueue
from typing import TypeVar

import numpy as np

from ...common.array_types import Array
from ...common.signal_handling import ABANDONED_THREAD
from ...pipeline import Run
from ...recording.experiment import Experiment
from ...recording.sample_times import TIME_TOLERANCE_S
from .estimator import LiveUpdate
from .frames import Frame, moving_grasps

T = TypeVar("T")

# Largest accepted datagram [bytes].
DATAGRAM_BYTES = 65536


def receive_lines(receiver: socket.socket) -> Iterator[bytes]:
    """Yield the lines of datagrams until an empty one, and close the socket."""
    with receiver:
        while datagram := receiver.recv(DATAGRAM_BYTES):
            yield from datagram.splitlines()


def arrived(items: Iterable[T]) -> Iterator[list[T]]:
    """Yield lists of the items that have arrived since the previous list, at least one in each.

    A thread waits for the items, so that none is lost while the caller computes.
    """
    queue: SimpleQueue[T | None] = SimpleQueue()

    def read() -> None:
        try:
            for item in items:
                queue.put(item)
        finally:
            queue.put(None)

    threading.Thread(target=read, name=ABANDONED_THREAD, daemon=True).start()
    item: T | None
    while (item := queue.get()) is not None:
        batch = [item]
        while not queue.empty() and (item := queue.get()) is not None:
            batch.append(item)
        yield batch
        if item is None:
            return


def frames_of_recording(experiment: Experiment) -> Iterator[Frame]:
    """Yield the frames of an experiment's recording, one for each of its sample times.

    Samples of sensors come with the first frame that is not earlier; those after the last frame are
    left out.
    """
    markers = experiment.markers
    frames_s = experiment.t_s + (0 if markers.offsets_s is None else markers.offsets_s)
    numbers = moving_grasps(experiment)
    matrices = np.tile(np.eye(4), (len(numbers), len(frames_s), 1, 1))
    for motion, number in zip(matrices, numbers, strict=True):
        motion[:, :3, :3], motion[:, :3, 3] = experiment.grasps[number - 1].poses.at(frames_s)
    samples: list[list[tuple[str | int, float, Array]]] = [[] for _ in frames_s]
    sensors = {each.name: each for each in experiment.readings}
    for key, sensor in {**sensors, **experiment.sensors_by_grasp}.items():
        frame_of = np.searchsorted(frames_s, sensor.sample_times_s - TIME_TOLERANCE_S)
        values = sensor.measured_values
        for k, at_s, each in zip(frame_of, sensor.sample_times_s, values, strict=True):
            if k < len(samples):
                samples[k].append((key, float(at_s), each))
    for k, t_s in enumerate(frames_s):
        poses = dict(zip(numbers, matrices[:, k], strict=True))
        yield Frame(float(t_s), poses, markers.positions_m[k], tuple(samples[k]))


def paced_frames(frames: Iterable[Frame], rate_hz: float) -> Iterator[Frame]:
    """Yield frames at a constant rate, the first one immediately; overdue ones follow at once."""
    began_s = time.monotonic()
    for number, frame in enumerate(frames):
        time.sleep(max(0.0, began_s + number / rate_hz - time.monotonic()))
        yield frame


def as_json(answer: LiveUpdate | Run) -> str:
    """Return an answer, or the final result with its verdict, as one line of JSON."""
    keys = ("value", "statistical_std_error", "statistical95")
    parameters = {n: {key: getattr(e, key) for key in keys} for n, e in answer.estimates.items()}
    if isinstance(answer, LiveUpdate):
        known = {name: getattr(answer, name) for name in ("t_s", "misfit", "latency_s", "note")}
        known["misfit"] = answer.misfit if np.isfinite(answer.misfit) else None
    else:
        trust = answer.trust
        known = {"trust": {"verdict": trust.verdict, "reasons": trust.reasons}}
    return json.dumps({"parameters": parameters, **known})
