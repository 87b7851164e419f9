"""Execution of runs, each in its own process, and storage of their records.

`execute` starts a process, watches it, stops it after the time limit, and repeats it if it crashes:
a time limit or a segmentation fault affects only that run. Workers are threads of this process, or
workers of a Dask cluster. Records of finished runs are stored as one JSON file each, written
atomically. Use `run_all` for all runs of a study.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from ...common.cluster import connected, distributed
from ...common.files import write_text_file
from ...common.installation import python_command
from ...common.isolated_process import killed_by
from ...common.serialisation import as_json
from ...common.validated_classes import validated
from ...common.validated_types import AtLeastOne, Positive
from ...errors import InputError
from ...fem.kernels import available_threads
from .planning import PlannedRun

COMMAND = python_command(
    "from collocation_sysid.extras.studies.run_worker import main; main()", with_package=True
)
# Environment of a run: one thread, since runs share the cores and their times are compared.
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
# Interval at which a process is checked [s], too short for a person to notice.
LOOK_EVERY_S = 0.2
# Time after the time limit in which a run may still write the best iterate [s].
GRACE_S = 10.0


def execute(
    planned: dict[str, Any],
    time_limit_s: float | None = None,
    is_stopped: Callable[[], bool] = lambda: False,
    retries: int = 1,
) -> Record:
    """Execute a run in its own process and return its record, whatever happens to the process.

    Parameters
    ----------
    planned : dict
        A `PlannedRun` as a dictionary.
    time_limit_s : float, optional
        Time after which the process is asked to end, loading included [s]; it is killed if it does
        not. The record then contains the best iterate, if there is one. No limit by default.
    is_stopped : callable
        Function that is called now and then; the process is killed once it returns true.
    retries : int
        Further attempts if the process crashes.

    Returns
    -------
    dict
        The fields of `planned`, those of `run_worker.record_of_run` for the last attempt (of a
        process that was stopped, crashed or exceeded the limit at least "outcome" and "message"),
        its "wall_s" [s], the number of "attempts" and "time_limit_s".
    """
    attempts = 0
    record = {}
    while attempts <= retries:
        attempts += 1
        began = time.monotonic()
        record = _attempt(planned, time_limit_s, stopped=is_stopped)
        record["wall_s"] = time.monotonic() - began
        if record["outcome"] != CRASHED:
            break
    return {**planned, **record, "attempts": attempts, "time_limit_s": time_limit_s}


def _attempt(
    planned: dict[str, Any], time_limit_s: float | None, stopped: Callable[[], bool]
) -> Record:
    """Execute a run once, in a process with one thread."""
    with tempfile.TemporaryDirectory(prefix="collocation-sysid-") as place:
        file = Path(place) / "record.json"
        with open(Path(place) / "stderr", "w+b") as stderr:
            process = subprocess.Popen(
                [*COMMAND, str(file)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                env={**os.environ, **ONE_THREAD},
                start_new_session=True,  # Ctrl-C is for the study, which decides
            )
            try:
                interruption = _watch(
                    process, planned, time_limit_s=time_limit_s, is_stopped=stopped
                )
            finally:
                process.kill()
                process.wait()
            if interruption is not None and interruption["outcome"] != TIMEOUT:
                return interruption
            try:
                record = json.loads(file.read_text(encoding="utf-8"))
            except (OSError, ValueError):
                return interruption or {
                    "outcome": CRASHED,
                    "message": _crash_message(process.returncode, stderr),
                }
            return (
                record
                if interruption is None or record["outcome"] == ERROR
                else record | interruption
            )


def _watch(
    process: subprocess.Popen,
    planned: dict[str, Any],
    time_limit_s: float | None,
    is_stopped: Callable[[], bool],
) -> Record | None:
    """Send the run to the process and wait for its end, the time limit, or a stop."""
    assert process.stdin is not None
    deadline = None if time_limit_s is None else time.monotonic() + time_limit_s
    with contextlib.suppress(BrokenPipeError):
        process.stdin.write(json.dumps(planned).encode() + b"\n")
        process.stdin.flush()
    try:
        while True:
            remaining_s = LOOK_EVERY_S if deadline is None else deadline - time.monotonic()
            if remaining_s <= 0:
                process.terminate()  # as Ctrl-C: it may write what it has
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(GRACE_S)
                message = f"ended at the time limit of {time_limit_s:g} s"
                return {"outcome": TIMEOUT, "message": message}
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(min(remaining_s, LOOK_EVERY_S))
                return None
            if is_stopped():
                return {"outcome": STOPPED, "message": "stopped when the study was stopped"}
    finally:
        with contextlib.suppress(OSError):
            process.stdin.close()


def _crash_message(code: int, stderr: IO[bytes]) -> str:
    """Return how a process ended, with the last line of its error output."""
    cause = killed_by(code) or f"the process ended with code {code}"
    stderr.seek(0)
    lines = stderr.read()[-2000:].decode(errors="replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "")
    return f"{cause}: {last}" if last else cause


# Outcomes of a run.
FINISHED = "finished"
ERROR = "error"
TIMEOUT = "timeout"
CRASHED = "crashed"
STOPPED = "stopped"

Record = dict[str, Any]


@dataclass(frozen=True)
class RunStore:
    """Records in the folder ``runs/`` of a study."""

    folder: Path  # folder of the records

    def save(self, record: Record) -> None:
        """Write the record of a run, atomically, to the file of its "key"; an earlier record is
        replaced, and missing folders are made.

        Raises
        ------
        InputError
            If the file cannot be written.
        KeyError
            If the record has no "key".
        """
        write_text_file(self._file(record["key"]), as_json(record) + "\n")

    def load(self, key: str) -> Record | None:
        """Return the record of a run; None if it does not exist, cannot be read, or has another
        key.
        """
        try:
            record = json.loads(self._file(key).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return record if isinstance(record, dict) and record.get("key") == key else None

    def load_finished(self, key: str, time_limit_s: float | None) -> Record | None:
        """Return the record of a run; None if the run should be executed again.

        A run is repeated if it crashed, or if it exceeded a time limit below the present one. A run
        that ended with an error is not repeated.

        Parameters
        ----------
        time_limit_s : float or None
            Present time limit [s]; None for no limit.
        """
        record = self.load(key)
        if record is None or record["outcome"] == CRASHED:
            return None
        if record["outcome"] == TIMEOUT:
            previous_limit_s = record.get("time_limit_s") or 0.0
            return record if time_limit_s is not None and time_limit_s <= previous_limit_s else None
        return record

    def _file(self, key: str) -> Path:
        return self.folder / f"{key}.json"


@validated
class RunOptions:
    """Execution of the runs of a study.

    Attributes
    ----------
    workers : int
        Number of runs computed in parallel; by default the number of cores.
    scheduler : ADDRESS
        Address of a dask.distributed scheduler; its workers need the same files.
    time_limit_s : --time-limit SECONDS
        Time after which a run is stopped, including the time for loading [s]; a stopped run counts
        as a failure.
    """

    workers: AtLeastOne | None = None
    scheduler: str | None = None
    time_limit_s: Positive | None = None

    def __post_init__(self) -> None:
        if self.workers is not None and self.scheduler is not None:
            raise InputError(
                "the scheduler has workers of its own; state either a scheduler or a number of "
                "workers",
                None,
                where="workers",
            )


# Start of a run, which returns the future of its record; number of workers; end of all runs.
Executor = tuple[Callable[[PlannedRun], Future], int, Callable[[], Any]]


def run_all(
    planned: Sequence[PlannedRun],
    store: RunStore,
    options: RunOptions,
    on_record: Callable[[Record, int], None] = lambda record, worker_count: None,
) -> None:
    """Execute the runs of a study and store their records, each as soon as it has ended; return
    when all have ended.

    Runs that fail, crash or exceed the time limit are stored like others. Runs that were stopped
    are neither stored nor reported. Without runs nothing happens.

    Parameters
    ----------
    planned : sequence of PlannedRun
        Runs, started in this order; the caller has removed finished ones.
    store : RunStore
        Storage of the records.
    options : RunOptions
        Options of the execution: threads of this process, or the workers of a scheduler.
    on_record : callable
        Function that is called with every new record, in the order in which runs end, and the
        number of runs at once.

    Raises
    ------
    InputError
        If the scheduler cannot be reached, or a record cannot be written.
    KeyboardInterrupt
        After the running runs have been told to end; finished ones are in the store.
    """
    if not planned:
        return
    executor = _cluster_executor if options.scheduler else _thread_executor
    with executor(options) as (submit, worker_count, stop):
        futures = {submit(run): run for run in planned}
        try:
            for future in as_completed(futures):
                record = _result_record(future, futures[future], limits=options)
                if record["outcome"] != STOPPED:
                    store.save(record)
                    on_record(record, worker_count)
        except BaseException:
            for future in futures:
                future.cancel()
            stop()
            raise


def _result_record(future: Future, planned: PlannedRun, limits: RunOptions) -> Record:
    """A lost worker is a crash."""
    try:
        return future.result()
    except Exception as error:
        return {
            **planned.as_dict(),
            "outcome": CRASHED,
            "message": f"the worker was lost ({type(error).__name__}: {error})",
            "attempts": 1,
            "time_limit_s": limits.time_limit_s,
            "wall_s": None,
        }


@contextmanager
def _thread_executor(limits: RunOptions) -> Iterator[Executor]:
    """The end waits for submitted runs; only `stop` ends running ones."""
    worker_count = limits.workers or available_threads()
    stop = threading.Event()
    with ThreadPoolExecutor(worker_count) as executor:

        def submit(run: PlannedRun) -> Future:
            return executor.submit(execute, run.as_dict(), limits.time_limit_s, stop.is_set)

        yield submit, worker_count, stop.set


@contextmanager
def _cluster_executor(limits: RunOptions) -> Iterator[Executor]:
    """The end waits for submitted runs; `stop` ends them through an event of the cluster."""
    flag = f"collocation-sysid-stop-{secrets.token_hex(8)}"
    with connected(limits.scheduler) as client:
        stop = distributed().Event(flag, client=client)
        with client.get_executor(pure=False) as executor:

            def submit(run: PlannedRun) -> Future:
                return executor.submit(_execute_on_worker, run.as_dict(), limits.time_limit_s, flag)

            yield submit, max(1, sum(client.nthreads().values())), stop.set


def _execute_on_worker(planned: dict[str, Any], time_limit_s: float | None, flag: str) -> Record:
    """Execute a run in a process of its own on a worker."""
    return execute(planned, time_limit_s, is_stopped=distributed().Event(flag).is_set)
