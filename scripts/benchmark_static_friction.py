"""Static tests with friction, compared with an earlier revision: processor time, answers,
intervals.

Two cases are simulated and solved by the command `solve --no-pictures` in separate
processes on one thread, with the earlier revision and this one in turn, so that other work on the
machine slows both. The output has the ratio of the smallest processor times, and the largest
relative differences of the estimates and of the ends of their intervals.

    python scripts/benchmark_static_friction.py --baseline bbaeea20 [--only compression poked]

- compression: a silicone cylinder to a third of its height between platens of unknown friction, 41
  samples, of `problems/phantom_compression/whole_stroke.toml`. Its loads are simulated with noise.
- poked: the twelve places of `problems/poked_block`, with a friction of the tip of 0.3, although
  the
  forces are those of a tip without friction.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
# True constants: similar to those of the recordings, and different from the guesses of the problem.
TRUTH = {"c10_pa": 1.0e4, "c20_pa": -150.0, "c30_pa": 20.0, "platen_friction": 0.2}
# Time between rows of the machine's file, and of the last row at 20 mm [s].
ROW_S = 0.1
END_S = 120.0
# Speed of the machine, and height of the specimen.
SPEED_MM_S = 1 / 6
HEIGHT_MM = 30.0
# Standard deviation of the load, as in the recordings [N].
NOISE_N = 0.9


@dataclass(frozen=True)
class TimedSolve:
    """Processor time of one solve [s], and the content of its result.json."""

    processor_time_s: float
    result: dict


def main() -> None:
    """Run the benchmark with the options of the command line, and print its table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--baseline", default="bbaeea20", metavar="REVISION")
    parser.add_argument("--only", nargs="+", choices=("compression", "poked"))
    parser.add_argument("--rounds", type=int, default=2)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        baseline_tree = checkout(arguments.baseline, folder / "before")
        for case in arguments.only or ("compression", "poked"):
            problem = compression(folder / case) if case == "compression" else poked(folder / case)
            runs = {baseline_tree: [], ROOT: []}
            for _ in range(arguments.rounds):
                for tree, solves in runs.items():
                    solves.append(timed_solve(problem, tree))
            report(case, arguments.baseline, before=runs[baseline_tree], after=runs[ROOT])


def checkout(revision: str, folder: Path) -> Path:
    """Return a folder with the package at a revision."""
    folder.mkdir()
    archive = subprocess.run(
        ["git", "archive", revision, "collocation_sysid"], cwd=ROOT, check=True, capture_output=True
    ).stdout
    subprocess.run(["tar", "-x"], cwd=folder, input=archive, check=True)
    return folder


def compression(folder: Path) -> Path:
    """Return the path of a simulated compression of one specimen; its files are in `folder`."""
    source = ROOT / "problems" / "phantom_compression"
    folder.mkdir()
    shutil.copy(source / "eighth.vtu", folder)
    text = (source / "whole_stroke.toml").read_text()
    path = folder / "problem.toml"
    path.write_text(text[: text.index('[[experiment]]\nname = "A2"')])
    times_s = np.arange(0.0, END_S + ROW_S, ROW_S)
    compression_mm = SPEED_MM_S * times_s
    rows = np.column_stack([times_s, compression_mm, 0 * times_s, -compression_mm / HEIGHT_MM])
    header = "Time (s),Compression (mm),Load (N),Engineering Strain [-]"
    np.savetxt(
        folder / "EF30_0T_A1.csv", rows, fmt="%.6f", delimiter=",", header=header, comments=""
    )
    truth = [f"--set=parameters.{name}.guess={value}" for name, value in TRUTH.items()]
    twin = folder / "twin"
    collocation_sysid(
        ROOT, *("simulate", str(path), "--out", str(twin)), *("--noise-n", str(NOISE_N), *truth)
    )
    shutil.copy(path, twin)
    shutil.copy(folder / "eighth.vtu", twin)
    return twin / "problem.toml"


def poked(folder: Path) -> Path:
    """Return the path of a copy of the poked block in `folder`, with friction of the tip."""
    shutil.copytree(ROOT / "problems" / "poked_block", folder)
    path = folder / "problem.toml"
    displacement_line = "displacement = { sign = -1 }"
    path.write_text(
        path.read_text().replace(displacement_line, f"{displacement_line}\nfriction = 0.3")
    )
    return path


def collocation_sysid(tree: Path, *arguments: str) -> None:
    """Run the command line of a tree on one thread; its output is shown only if it fails."""
    environment = os.environ | {
        "PYTHONPATH": str(tree),
        "COLLOCATION_SYSID_THREADS": "1",
        "OMP_NUM_THREADS": "1",
    }
    done = subprocess.run(
        [sys.executable, "-m", "collocation_sysid", *arguments],
        env=environment,
        cwd=tree,
        capture_output=True,
        text=True,
    )
    if done.returncode not in (0, 1):
        sys.exit(done.stdout + done.stderr)


def timed_solve(problem: Path, tree: Path) -> TimedSolve:
    """Return the processor time and the result of a solve by a tree."""
    out = problem.parent / "run"
    began = resource.getrusage(resource.RUSAGE_CHILDREN)
    collocation_sysid(tree, "solve", str(problem), "--no-pictures", "--out", str(out))
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor_time_s = ended.ru_utime + ended.ru_stime - began.ru_utime - began.ru_stime
    result = json.loads((out / "result.json").read_text())
    shutil.rmtree(out)
    return TimedSolve(processor_time_s, result)


def numbers_with_paths(value: object, path: str = "") -> Iterator[tuple[str, float]]:
    """Yield the numbers of the estimates in a result, with their paths."""
    if isinstance(value, dict):
        for key, each in value.items():
            yield from numbers_with_paths(each, f"{path}.{key}")
    elif isinstance(value, list):
        for k, each in enumerate(value):
            yield from numbers_with_paths(each, f"{path}.{k}")
    elif isinstance(value, float):
        yield path, value


def report(case: str, baseline: str, before: list[TimedSolve], after: list[TimedSolve]) -> None:
    """Print the times and differences of a case."""
    baseline_s, current_s = (min(each.processor_time_s for each in s) for s in (before, after))
    baseline_numbers = dict(numbers_with_paths(before[0].result["parameters"]))
    current_numbers = dict(numbers_with_paths(after[0].result["parameters"]))
    assert baseline_numbers.keys() == current_numbers.keys()
    differences: dict[str, float] = {"estimates": 0.0, "intervals": 0.0}
    for path, value in baseline_numbers.items():
        scale = max(abs(value), abs(current_numbers[path]), 1e-300)
        kind = "estimates" if path.endswith(".value") else "intervals"
        difference = abs(value - current_numbers[path]) / scale
        differences[kind] = max(differences[kind], difference)
    shown = ", ".join(f"{k} {v:.1e}" for k, v in differences.items())
    print(
        f"{case}: {baseline_s:.1f} s with {baseline}, {current_s:.1f} s now, the former over the "
        f"latter {baseline_s / current_s:.2f}; largest relative differences: {shown}",
        flush=True,
    )


if __name__ == "__main__":
    main()
