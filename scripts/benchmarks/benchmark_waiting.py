"""Waiting times at the terminal: start-up, check, solve and report, as complete commands.

Each command is run with compiled kernels, and `solve` also with an empty cache, as on a new
installation. The table has wall time, processor time, and the time to the first text.

    python scripts benchmark_waiting --problem problems/foam_cylinder/recording.toml
"""

from __future__ import annotations

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

from script_arguments import make_parser

PROBLEM = Path(__file__).parents[2] / "problems" / "foam_cylinder" / "recording.toml"
# Program that runs the command line.
PROGRAM = "from collocation_sysid.cli import main; main()"


@dataclass(frozen=True)
class WaitingTimes:
    """Times of a command: to the first text, to its end, and of the processor [s]."""

    first_s: float
    wall_s: float
    processor_s: float


def main() -> None:
    """Time the commands several times, and print a table of the medians."""
    parser = make_parser(__doc__)
    parser.add_argument("--problem", type=Path, default=PROBLEM)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    problem = str(options.problem)
    with tempfile.TemporaryDirectory() as folder:
        run, warm, cold = (str(Path(folder) / name) for name in ("run", "warm", "cold"))
        solve = ["solve", problem, "--out", run]
        commands = {
            "--help": (["--help"], warm),
            "first solve of an installation": (solve, cold),
            "check": (["check", problem], warm),
            "solve": (solve, warm),
            "report": (["report", run], warm),
        }
        time_command(solve, warm)
        print(
            "| command | time to first text, s | wall time, s | processor time, s |\n|---|---|---|---|"
        )
        for name, (arguments, cache) in commands.items():
            times = []
            for _ in range(options.repeats):
                shutil.rmtree(cold, ignore_errors=True)
                times.append(time_command(arguments, cache))
            columns = ("first_s", "wall_s", "processor_s")
            medians = [statistics.median(getattr(t, c) for t in times) for c in columns]
            print(f"| {name} | " + " | ".join(f"{value:.2f}" for value in medians) + " |")


def time_command(arguments: list[str], cache: str) -> WaitingTimes:
    """Run a command on a pseudo-terminal, and return its times."""
    own_terminal, command_terminal = pty.openpty()
    environment = {**os.environ, "XDG_CACHE_HOME": cache, "TERM": "xterm"}
    before = os.times()
    began = time.perf_counter()
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *arguments],
        stdout=command_terminal,
        stderr=command_terminal,
        env=environment,
    ) as process:
        os.close(command_terminal)
        first_s = _time_of_first_text(own_terminal, began)
        process.wait()
    after = os.times()
    os.close(own_terminal)
    if process.returncode not in (0, 1):
        raise SystemExit(f"{' '.join(arguments)} ended with {process.returncode}")
    processor_s = after.children_user + after.children_system
    processor_s -= before.children_user + before.children_system
    return WaitingTimes(first_s, time.perf_counter() - began, processor_s)


def _time_of_first_text(terminal: int, began: float) -> float:
    """Read the output to its end, and return the time of the first letter since `began` [s]; NaN if
    none.
    """
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
