"""Work of libraries that may crash, litter or ignore Ctrl-C, in a process and folder apart."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

_AROUND = """
import sys, numpy
with numpy.load("given.npz") as given:
    given = dict(given)
{code}
numpy.savez("found.npz", **found)
"""


class Failed(RuntimeError):
    """The process left nothing; the message is its last line, or how it was killed."""


def computed_apart(code: str, *words: str, **given: ArrayLike) -> dict[str, NDArray]:
    """Arrays that Python code makes in another process.

    Parameters
    ----------
    code : str
        Reads the arrays `given` by name and the words in `sys.argv`, and leaves arrays in `found`.
    words : str
    given : arrays by name

    Raises
    ------
    Failed
        If the process does not get to its end.
    """
    with tempfile.TemporaryDirectory(prefix="collocation-sysid-") as place:
        folder = Path(place)
        np.savez(folder / "given.npz", allow_pickle=False, **given)
        done = subprocess.run(
            [sys.executable, "-c", _AROUND.format(code=code), *words],
            cwd=folder,
            capture_output=True,
            text=True,
            errors="replace",
        )
        if done.returncode:
            said = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise Failed(killed_by(done.returncode) or said)
        with np.load(folder / "found.npz") as found:
            return dict(found)


def killed_by(code: int) -> str:
    """How a process was killed that ended with this code; nothing where it ended by itself."""
    if code < 0:
        with contextlib.suppress(ValueError):
            return f"its process was killed by {signal.Signals(-code).name}"
    return ""
