"""Work of libraries that may crash, hang or litter, in an isolated process and folder."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .installation import python_command

_WRAPPER = """
import sys, numpy
with numpy.load("given.npz") as given:
    given = dict(given)
{limit}
{code}
numpy.savez("found.npz", allow_pickle=False, **found)
"""
# Sets the limits of the process itself; memory is counted beyond what numpy has mapped already.
_LIMIT = """
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CPU, ({time_s}, {time_s} + 5))
    with open("/proc/self/statm") as mapped:
        already = int(mapped.read().split()[0]) * resource.getpagesize()
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = already + {memory_bytes}
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(resource.RLIMIT_AS, (most, hard))
except (ImportError, OSError, ValueError):
    pass  # not on every system
"""


class Failed(RuntimeError):
    """Failure of an isolated process; the message is the last line that it wrote to stderr, how it
    was killed, or the limit that it reached.
    """


@dataclass(frozen=True)
class ProcessLimits:
    """Limits of an isolated process."""

    # Processor time after which the process is killed [s], rounded up to whole seconds; enforced on
    # POSIX systems only.
    time_s: float
    memory_mb: float  # memory beyond that of Python and numpy [MB]; enforced on Linux only

    @classmethod
    def for_file(cls, path: str | Path) -> ProcessLimits:
        """Return limits for reading a file, in proportion to its size: some tens of times what
        readers mostly need.

        Raises
        ------
        OSError
            If there is no such file.
        """
        size_mb = os.stat(path).st_size / 1e6
        return cls(
            time_s=READING_S + READING_S_PER_MB * size_mb,
            memory_mb=READING_MB + READING_MB_PER_MB * size_mb,
        )


# A busy machine may give a process this part of a processor, or less.
WAITING_FACTOR = 10.0
# Limits of a process that reads a file. meshio takes 0.2 s or less for imports, reads 2 to 20 MB of
# text a second, and takes up to 20 times the memory of a text file.
# Time for a file of any size [s].
READING_S = 10.0
# Further time for each megabyte of the file [s/MB].
READING_S_PER_MB = 5.0
# Memory for a file of any size [MB].
READING_MB = 1000.0
# Further memory for each megabyte of the file [MB/MB].
READING_MB_PER_MB = 60.0


def run_isolated(
    code: str, *words: str, limits: ProcessLimits | None = None, **arrays: ArrayLike
) -> dict[str, NDArray]:
    """Run Python code in another process, in a temporary folder, and return the arrays that it
    makes.

    Parameters
    ----------
    code : str
        Finds the `arrays` in the dictionary `given` and the words in `sys.argv[1:]`, and leaves a
        dictionary `found` of arrays by name (without objects). numpy is imported as `numpy`.
    *words : str
        Arguments of the process.
    limits : ProcessLimits, optional
        Memory and time of the process; without limits by default.
    **arrays : array_like
        Arrays that the code reads, by name; no objects.

    Returns
    -------
    dict of arrays
        The content of `found`. Output of the process is discarded.

    Raises
    ------
    Failed
        If the process ends with an error, is killed, or reaches a limit.
    """
    limit = (
        ""
        if limits is None
        else _LIMIT.format(
            memory_bytes=int(1e6 * limits.memory_mb), time_s=math.ceil(limits.time_s)
        )
    )
    with tempfile.TemporaryDirectory(prefix="collocation-sysid-") as place:
        folder = Path(place)
        np.savez(folder / "given.npz", allow_pickle=False, **arrays)
        try:
            done = subprocess.run(
                python_command(_WRAPPER.format(limit=limit, code=code), *words),
                cwd=folder,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=None if limits is None else (WAITING_FACTOR * limits.time_s),
            )
        except subprocess.TimeoutExpired as late:
            raise Failed(f"the process was not finished after {late.timeout:.3g} s") from None
        if done.returncode:
            if limits is not None and done.returncode == -getattr(signal, "SIGXCPU", 0):
                raise Failed(
                    f"the process was not finished after {limits.time_s:.3g} s of processor time"
                )
            last_line = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise Failed(killed_by(done.returncode) or last_line)
        with np.load(folder / "found.npz") as stored:
            return dict(stored)


def killed_by(code: int) -> str:
    """Return "the process was killed by SIGNAL" from the exit code of a process; "" if it ended by
    itself (a code of 0 or more) or the signal is unknown.
    """
    if code < 0:
        with contextlib.suppress(ValueError):
            return f"the process was killed by {signal.Signals(-code).name}"
    return ""
