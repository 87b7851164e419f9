"""A run's process, seen from outside, and what became of it.

It is started, watched, killed when it is late, and tried again. Finished runs are on disk, one JSON
file each, there whole or not at all.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from ..apart import killed_by
from ..files import write_whole
from ..tree import as_json

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
