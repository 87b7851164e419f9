"""Waiting times at the terminal: start-up, check, solve and report, as complete commands.

Each command is run with compiled kernels, and `solve` also with an empty cache, as on a new
installation. The table has wall time, processor time, and the time to the first text.

    python scripts/benchmark_waiting.py --problem problems/foam_cylinder/recording.toml
"""

from __future__ import annotations

import argparse
import os
import pty
import select
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

PROBLEM = (
    Path(__file__).parents[1] / "problems" / "foam_cylinder" / "recording.toml"
)
MAIN = "from collocation_sysid.cli import main; main()"


@dataclass(frozen=True)
class Waited:
    """Seconds to the first text, to the end, and of processor time."""

    first_s: float
    wall_s: float
    processor_s: float


def main() -> None:
    """Time the commands several times, and print a table of the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problem", type=Path, default=PROBLEM)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    problem = str(arguments.problem)
    with tempfile.TemporaryDirectory() as place:
        run, warm, cold = (
            str(Path(place) / name) for name in ("run", "warm", "cold")
        )
        solve = ["solve", problem, "--out", run]
        commands = {
            "--help": (["--help"], warm),
            "first solve of an installation": (solve, cold),
            "check": (["check", problem], warm),
            "solve": (solve, warm),
            "report": (["report", run], warm),
        }
        waited(solve, warm)
        print("| | first text s | wall s | processor s |\n|---|---|---|---|")
        for name, (words, cache) in commands.items():
            times = []
            for _ in range(arguments.repeats):
                shutil.rmtree(cold, ignore_errors=True)
                times.append(waited(words, cache))
            columns = ("first_s", "wall_s", "processor_s")
            medians = [
                statistics.median(getattr(t, c) for t in times) for c in columns
            ]
            print(
                f"| {name} | "
                + " | ".join(f"{value:.2f}" for value in medians)
                + " |"
            )


def waited(words: list[str], cache: str) -> Waited:
    """Run a command of the command line on a terminal of its own."""
    ours, theirs = pty.openpty()
    environment = {**os.environ, "XDG_CACHE_HOME": cache, "TERM": "xterm"}
    before = os.times()
    began = time.perf_counter()
    with subprocess.Popen(
        [sys.executable, "-c", MAIN, *words],
        stdout=theirs,
        stderr=theirs,
        env=environment,
    ) as process:
        os.close(theirs)
        first_s = _drained(ours, began)
        process.wait()
    after = os.times()
    os.close(ours)
    if process.returncode not in (0, 1):
        raise SystemExit(f"{' '.join(words)} ended with {process.returncode}")
    spent = after.children_user + after.children_system
    spent -= before.children_user + before.children_system
    return Waited(first_s, time.perf_counter() - began, spent)


def _drained(terminal: int, began: float) -> float:
    """Read all that is written; when the first visible text came."""
    first_s = float("nan")
    while select.select([terminal], [], [], 600.0)[0]:
        try:
            text = os.read(terminal, 65536)
        except OSError:  # the other end is closed
            break
        if not text:
            break
        if first_s != first_s and any(chr(byte).isalpha() for byte in text):
            first_s = time.perf_counter() - began
    return first_s


if __name__ == "__main__":
    main()
