"""Interior point beside reduced space on shipped problems, from the default start and warm.

For each problem: reduced space, interior point from the default start, and interior point from the
run folder of reduced space (`--start`). Prints processor time of the complete runs, sweeps and
iterations of IPOPT, and the largest difference of a parameter's logarithm from reduced space's.

    python scripts/benchmark_shipped.py
    python scripts/benchmark_shipped.py poked_block laid_block/problem.toml --cases warm
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from collocation_sysid import pipeline
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.pipeline import Run
from collocation_sysid.problem import Problem

PROBLEMS = Path(__file__).parents[1] / "problems"
# Problems whose data are in the repository and that interior point solves within minutes.
DEFAULT = (
    "foam_cylinder",
    "noisy_cylinder",
    "table1/problem_scheme.toml",
    "laid_block",
    "poked_block",
    "wrist_sensor",
)
# "default": from the start that interior point chooses; "warm": from the run of reduced space.
CASES = ("default", "warm")


def problem_file(name: str) -> Path:
    """Return the problem file of a name below `problems`, `problem.toml` of a folder."""
    path = PROBLEMS / name
    return path / "problem.toml" if path.is_dir() else path


def measure(name: str, cases: tuple[str, ...]) -> None:
    """Solve a shipped problem by reduced space and in each of the cases, and print the results."""
    problem = Problem.read(problem_file(name))
    began_s = time.process_time()
    reference = pipeline.run(problem, ReducedSpace(), seek_causes=False)
    reference_s = time.process_time() - began_s
    print(
        f"{name}: reduced space {reference.solution.iterations} sweeps, {reference_s:.1f} s",
        flush=True,
    )
    with tempfile.TemporaryDirectory() as folder:
        start = reference.save(Path(folder) / "reduced-space", pictures=False)
        for case in cases:
            began_s = time.process_time()
            solved = pipeline.run(
                problem,
                InteriorPoint(),
                start=start if case == "warm" else None,
                seek_causes=False,
            )
            print_case(case, time.process_time() - began_s, solved, reference)


def print_case(case: str, time_s: float, solved: Run, reference: Run) -> None:
    """Print status, iterations, time and distance from the reference of one run."""
    solution = solved.solution
    values = np.array(list(solution.parameters.values()))
    expected = np.array(list(reference.solution.parameters.values()))
    differ = values != expected
    apart = np.abs(np.log(np.abs(values[differ] / expected[differ])))
    print(
        f"    {case}: {solution.status.value}, {solution.iterations} iterations, {time_s:.1f} s; "
        f"log parameters differ by {apart.max(initial=0.0):.1e}",
        flush=True,
    )
    for note in solution.notes:
        print(f"        {note}", flush=True)


def main() -> None:
    """Measure the problems that the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("problems", nargs="*", default=list(DEFAULT))
    parser.add_argument("--cases", nargs="*", default=CASES, choices=CASES)
    options = parser.parse_args()
    for name in options.problems:
        measure(name, tuple(options.cases))


if __name__ == "__main__":
    main()
