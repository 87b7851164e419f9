"""Interior point from the answer of reduced space, on shipped problems.

Prints processor time of the solve by reduced space, without error bars, its ratio to that of
interior point, and the largest difference of a parameter (most are logarithms).

    python scripts benchmark_shipped
    python scripts benchmark_shipped poked_block laid_block/problem.toml
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from script_arguments import make_parser

from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.pipeline import solve
from collocation_sysid.problem import Problem
from collocation_sysid.runs.warm_start import WarmStart

PROBLEMS = Path(__file__).parents[2] / "problems"
# Problems whose data are in the repository.
DEFAULT_PROBLEMS = (
    "foam_cylinder",
    "foam_cylinder/recording.toml",
    "wrist_sensor",
    "table1/problem_scheme.toml",
    "table1/problem.toml",
    "noisy_cylinder",
    "laid_block",
    "poked_block",
)


def main() -> None:
    """Measure the problems that the command line names, below the folder `problems`."""
    parser = make_parser(__doc__)
    parser.add_argument("problems", nargs="*", default=list(DEFAULT_PROBLEMS))
    for name in parser.parse_args().problems:
        path = PROBLEMS / name
        problem = Problem.read(path / "problem.toml" if path.is_dir() else path)
        began_s = time.process_time()
        reference = solve(problem, ReducedSpace())
        middle_s = time.process_time()
        solution = solve(problem, InteriorPoint(), start=WarmStart.of(reference))
        reference_s = middle_s - began_s
        ratio = (time.process_time() - middle_s) / reference_s
        difference = np.abs(solution.q - reference.q).max(initial=0.0)
        print(
            f"{name}: reduced space {reference.status.value}, {reference_s:.1f} s; interior point "
            f"{solution.status.value}, {solution.iterations} iterations, {ratio:.1f} times as long; "
            f"parameters differ by {difference:.1e}",
            flush=True,
        )


if __name__ == "__main__":
    main()
