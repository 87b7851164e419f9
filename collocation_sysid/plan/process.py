"""Runs side by side, each in a process of its own, and what became of them.

A process is started, watched, killed when it is late, and tried again (`execute`): a time limit or
a segmentation fault costs that run alone. A worker only does that, be it a thread on this machine
or a worker of a cluster through dask.distributed. Finished runs are on disk, one JSON file each,
there whole or not at all.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from ..apart import killed_by
from ..checked import AtLeastOne, Options, Positive
from ..cluster import connected, distributed
from ..errors import InputError
from ..fem.kernels import available_threads
from ..files import write_whole
from ..tree import as_json
from .study import PlannedRun

COMMAND = (sys.executable, "-m", "collocation_sysid.plan.worker")
# Runs side by side must not fight for cores, and compared times must mean the same.
ONE_THREAD = {
    name: "1"
    for name in (
        "COLLOCATION_SYSID_THREADS",
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "NUMEXPR_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
    )
}
LOOK_EVERY_S = 0.2
# What a run that is late has to write the best answer that it found.
GRACE_S = 10.0


def execute(
    planned: dict[str, Any],
    time_limit_s: float | None = None,
    stopped: Callable[[], bool] = lambda: False,
    retries: int = 1,
) -> Record:
    """Do a run in a process of its own and return its record, whatever happens to the process.

    Parameters
    ----------
    planned : dict
        A `PlannedRun` as a dict.
    time_limit_s : float, optional
        The process is asked to end after this, loading included, and killed if it does not; the
        record has the best answer that it found, where there is one.
    stopped : callable
        Asked now and then; the process is killed once it says so.
    retries : int
        Further tries when the process dies.
    """
    attempts, record = 0, {}
    while attempts <= retries:
        attempts += 1
        began = time.monotonic()
        record = _attempt(planned, time_limit_s, stopped)
        record["wall_s"] = time.monotonic() - began
        if record["outcome"] != CRASHED:
            break
    return {**planned, **record, "attempts": attempts, "time_limit_s": time_limit_s}


def _attempt(
    planned: dict[str, Any], time_limit_s: float | None, stopped: Callable[[], bool]
) -> Record:
    with tempfile.TemporaryDirectory(prefix="collocation-sysid-") as place:
        file = Path(place) / "record.json"
        with open(Path(place) / "stderr", "w+b") as said:
            process = subprocess.Popen(
                [*COMMAND, str(file)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=said,
                env={**os.environ, **ONE_THREAD},
                start_new_session=True,  # Ctrl-C is for the study, which decides
            )
            try:
                verdict = _watch(process, planned, time_limit_s, stopped)
            finally:
                process.kill()
                process.wait()
            if verdict is not None and verdict["outcome"] != TIMEOUT:
                return verdict
            try:
                record = json.loads(file.read_text(encoding="utf-8"))
            except (OSError, ValueError):
                return verdict or {
                    "outcome": CRASHED,
                    "message": _last_words(process.returncode, said),
                }
            return record if verdict is None or record["outcome"] == ERROR else record | verdict


def _watch(
    process: subprocess.Popen,
    planned: dict[str, Any],
    time_limit_s: float | None,
    stopped: Callable[[], bool],
) -> Record | None:
    """Wait for the process; None once it has ended by itself."""
    assert process.stdin is not None
    deadline = None if time_limit_s is None else time.monotonic() + time_limit_s
    with contextlib.suppress(BrokenPipeError):
        process.stdin.write(json.dumps(planned).encode() + b"\n")
        process.stdin.flush()
    try:
        while True:
            left = LOOK_EVERY_S if deadline is None else deadline - time.monotonic()
            if left <= 0:
                process.terminate()  # as Ctrl-C: it may write what it has
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(GRACE_S)
                message = f"ended after the time limit of {time_limit_s:g} s"
                return {"outcome": TIMEOUT, "message": message}
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(min(left, LOOK_EVERY_S))
                return None
            if stopped():
                return {"outcome": STOPPED, "message": "stopped with the study"}
    finally:
        with contextlib.suppress(OSError):
            process.stdin.close()


def _last_words(code: int, said: IO[bytes]) -> str:
    """How a process died, with the last line it wrote."""
    how = killed_by(code) or f"its process ended with code {code}"
    said.seek(0)
    lines = said.read()[-2000:].decode(errors="replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return f"{how}: {last}" if last else how


# What became of a run.
FINISHED, ERROR, TIMEOUT, CRASHED, STOPPED = "finished", "error", "timeout", "crashed", "stopped"

Record = dict[str, Any]


@dataclass(frozen=True)
class RunStore:
    """The folder ``runs/`` of a study."""

    folder: Path

    def save(self, record: Record) -> None:
        """Write a run's record."""
        write_whole(self._file(record["key"]), as_json(record) + "\n")

    def load(self, key: str) -> Record | None:
        """A run's record; None if there is none that can be read."""
        try:
            record = json.loads(self._file(key).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return record if isinstance(record, dict) and record.get("key") == key else None

    def finished(self, key: str, time_limit_s: float | None) -> Record | None:
        """A run's record unless it is worth another try.

        A run that crashed is, and one that ran out of less time than it has now.
        """
        record = self.load(key)
        if record is None or record["outcome"] == CRASHED:
            return None
        if record["outcome"] == TIMEOUT:
            had = record.get("time_limit_s") or 0.0
            return record if time_limit_s is not None and time_limit_s <= had else None
        return record

    def _file(self, key: str) -> Path:
        return self.folder / f"{key}.json"


@dataclass(frozen=True)
class RunOptions(Options):
    """How the runs of a study are done.

    Attributes
    ----------
    workers : int
        How many runs at once; by default as many as there are cores.
    scheduler : ADDRESS
        A dask.distributed scheduler to run on; its workers see the same files.
    time_limit_s : --time-limit SECONDS
        A run is stopped after this, loading included, and counts as a failure.
    """

    workers: AtLeastOne | None = None
    scheduler: str | None = None
    time_limit_s: Positive | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.workers is not None and self.scheduler is not None:
            raise InputError(
                "the scheduler has workers of its own; leave out one of the two",
                None,
                "workers",
            )


@dataclass(frozen=True)
class Pool:
    """Where runs are done.

    Attributes
    ----------
    submit : function of a planned run, gives the future of its record
    slots : int, runs at once
    stop : function that ends the runs that are going on
    """

    submit: Callable[[PlannedRun], Future]
    slots: int
    stop: Callable[[], Any]


def run_all(
    planned: Sequence[PlannedRun],
    store: RunStore,
    limits: RunOptions,
    done: Callable[[Record, int], None] = lambda record, slots: None,
) -> None:
    """Do the runs that are not in the store and put them there, each as soon as it has ended.

    Parameters
    ----------
    planned : sequence of PlannedRun, started in this order
    store : RunStore
    limits : RunOptions
    done : callable
        Called with every new record and the number of runs at once.

    Raises
    ------
    InputError
        If the scheduler cannot be had.
    KeyboardInterrupt
        After the runs that are going on were ended; finished ones are in the store.
    """
    if not planned:
        return
    with (_cluster if limits.scheduler else _threads)(limits) as pool:
        futures = {pool.submit(run): run for run in planned}
        try:
            for future in as_completed(futures):
                record = _record_of(future, futures[future], limits)
                if record["outcome"] != STOPPED:
                    store.save(record)
                    done(record, pool.slots)
        except BaseException:
            for future in futures:
                future.cancel()
            pool.stop()
            raise


def _record_of(future: Future, planned: PlannedRun, limits: RunOptions) -> Record:
    """A run's record, also when the worker that watched it is lost."""
    try:
        return future.result()
    except Exception as error:
        return {
            **planned.as_dict(),
            "outcome": CRASHED,
            "message": f"its worker was lost ({type(error).__name__}: {error})",
            "attempts": 1,
            "time_limit_s": limits.time_limit_s,
            "wall_s": None,
        }


@contextmanager
def _threads(limits: RunOptions) -> Iterator[Pool]:
    """Threads that wait for processes: all that one machine needs."""
    slots, stop = limits.workers or available_threads(), threading.Event()
    with ThreadPoolExecutor(slots) as executor:

        def submit(run: PlannedRun) -> Future:
            return executor.submit(execute, run.as_dict(), limits.time_limit_s, stop.is_set)

        yield Pool(submit, slots, stop.set)


@contextmanager
def _cluster(limits: RunOptions) -> Iterator[Pool]:
    """The workers of a scheduler that is there."""
    flag = f"collocation-sysid-stop-{secrets.token_hex(8)}"
    with connected(limits.scheduler) as client:
        stop = distributed().Event(flag, client=client)
        with client.get_executor(pure=False) as executor:

            def submit(run: PlannedRun) -> Future:
                return executor.submit(_on_worker, run.as_dict(), limits.time_limit_s, flag)

            yield Pool(submit, max(1, sum(client.nthreads().values())), stop.set)


def _on_worker(planned: dict[str, Any], time_limit_s: float | None, flag: str) -> Record:
    return execute(planned, time_limit_s, distributed().Event(flag).is_set)
