"""Execution of runs, each in its own process.

`execute` starts a process, watches it, and stops it after the time limit: a time limit or a
segmentation fault affects only that run. Use `run_all` for all runs of a study.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import IO, Any

from ...common.installation import python_command
from ...common.isolated_process import killed_by
from ...common.validated_classes import validated
from ...common.validated_types import AtLeastOne, Positive
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
Record = dict[str, Any]
# Called with a run and its last `Iteration` as a dictionary.
OnIteration = Callable[[PlannedRun, Record], None]
# Interval at which a process is checked [s], too short for a person to notice.
LOOK_EVERY_S = 0.2
# Time after the time limit in which a run may still write the best iterate [s].
GRACE_S = 10.0


def execute(
    planned: PlannedRun,
    time_limit_s: float | None = None,
    is_stopped: Callable[[], bool] = lambda: False,
    on_iteration: OnIteration = lambda *_: None,
) -> Record:
    """Execute a run in its own process and return its record, whatever happens to the process.

    Parameters
    ----------
    time_limit_s : float, optional
        Time after which the process is asked to end, loading included [s]; it is killed if it does
        not. The record then contains the best iterate, if there is one. No limit by default.
    is_stopped : callable
        Function that is called now and then; the process is killed once it returns true.
    on_iteration : callable
        Function that is called now and then with the last iteration.

    Returns
    -------
    dict
        The record of `run_worker.record_of_run` (of a process that was stopped, crashed or exceeded
        the limit at least "outcome" and "message"), its "wall_s" [s], and its last "iteration".
    """
    began = time.monotonic()
    iteration: Record = {}

    def note(file: Path) -> None:
        with contextlib.suppress(OSError, ValueError):
            latest = json.loads(iteration_file(file).read_text(encoding="utf-8"))
            if latest != iteration:
                iteration.update(latest)
                on_iteration(planned, latest)

    record = _record(planned.as_dict(), time_limit_s, is_stopped, note)
    return {**record, "wall_s": time.monotonic() - began, "iteration": iteration}


def iteration_file(record: Path) -> Path:
    """Return the file of the last iteration of the run that writes its record to a file."""
    return record.with_name("iteration.json")


def _record(
    planned: dict[str, Any],
    time_limit_s: float | None,
    is_stopped: Callable[[], bool],
    note_iteration: Callable[[Path], None],
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
                    process, planned, time_limit_s, is_stopped, lambda: note_iteration(file)
                )
            finally:
                process.kill()
                process.wait()
                note_iteration(file)
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
    note_iteration: Callable[[], None],
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
            note_iteration()
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


@validated
class RunOptions:
    """Execution of the runs of a study.

    Attributes
    ----------
    workers : int
        Number of runs computed in parallel; by default the number of cores.
    time_limit_s : --time-limit SECONDS
        Time after which a run is stopped, including the time for loading [s]; a stopped run counts
        as a failure. By default a minute in a comparison of methods, and no limit in one of models.
    """

    workers: AtLeastOne | None = None
    time_limit_s: Positive | None = None


def run_all(
    planned: Sequence[PlannedRun],
    options: RunOptions,
    on_record: Callable[[PlannedRun, Record], None],
    on_iteration: OnIteration = lambda *_: None,
) -> None:
    """Execute the runs of a study, and return when all have ended.

    Parameters
    ----------
    planned : sequence of PlannedRun
        Runs, started in this order.
    options : RunOptions
        Number of runs at once, by default one for each available thread, and their time limit.
    on_record : callable
        Function that is called with every run and its record, in the order in which runs end; also
        for runs that fail, crash or exceed the time limit.
    on_iteration : callable
        Function that threads call now and then with a running run and its last iteration.

    Raises
    ------
    KeyboardInterrupt
        After the running runs have been told to end.
    """
    stop = threading.Event()
    with ThreadPoolExecutor(options.workers or available_threads()) as executor:
        futures = {
            executor.submit(execute, run, options.time_limit_s, stop.is_set, on_iteration): run
            for run in planned
        }
        try:
            for future in as_completed(futures):
                on_record(futures[future], future.result())
        except BaseException:
            stop.set()
            executor.shutdown(cancel_futures=True)
            raise
