"""Interior point compared with reduced space on shipped problems, from the default start and warm.

For each problem: reduced space, interior point from the default start, and interior point from the
answer of reduced space, as with `--start`. Prints processor time of the solves, without error bars,
and its ratio to that of reduced space, sweeps and iterations of IPOPT, and the largest difference
of a parameter (most are logarithms).

    python scripts benchmark_shipped
    python scripts benchmark_shipped poked_block laid_block/problem.toml --cases warm
    python scripts benchmark_shipped --max-time-s 480
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
# Problems whose data are in the repository and that interior point solves within minutes.
DEFAULT_PROBLEMS = (
    "foam_cylinder",
    "noisy_cylinder",
    "table1/problem_scheme.toml",
    "laid_block",
    "poked_block",
    "wrist_sensor",
)
# "default": from the start that interior point chooses; "warm": from the answer of reduced space.
CASES = ("default", "warm")


def problem_file(name: str) -> Path:
    """Return the problem file of a name below `problems`, `problem.toml` of a folder."""
    path = PROBLEMS / name
    return path / "problem.toml" if path.is_dir() else path


def measure(name: str, cases: tuple[str, ...], max_time_s: float) -> None:
    """Solve a shipped problem by reduced space and in each of the cases, and print the results."""
    problem = Problem.read(problem_file(name))
    began_s = time.process_time()
    reference = solve(problem, ReducedSpace())
    reference_s = time.process_time() - began_s
    print(
        f"{name}: reduced space {reference.status.value}, {reference.iterations} sweeps, "
        f"{reference_s:.1f} s",
        flush=True,
    )
    for case in cases:
        start = WarmStart.of(reference) if case == "warm" else None
        began_s = time.process_time()
        solution = solve(problem, InteriorPoint(max_time_s=max_time_s), start=start)
        solution_s = time.process_time() - began_s
        largest_difference = np.abs(solution.q - reference.q).max(initial=0.0)
        print(
            f"    {case}: {solution.status.value}, {solution.iterations} iterations, "
            f"{solution_s:.1f} s, {solution_s / reference_s:.1f} times reduced space, linear "
            f"algebra {solution.timing.linear_algebra / solution.timing.total:.0%}; "
            f"parameters differ by {largest_difference:.1e} of the solver's unit",
            flush=True,
        )
        for note in solution.notes:
            print(f"        {note}", flush=True)


def main() -> None:
    """Measure the problems that the command line names."""
    parser = make_parser(__doc__)
    parser.add_argument("problems", nargs="*", default=list(DEFAULT_PROBLEMS))
    parser.add_argument("--cases", nargs="*", default=CASES, choices=CASES)
    parser.add_argument("--max-time-s", type=float, default=1e6)
    options = parser.parse_args()
    for name in options.problems:
        measure(name, tuple(options.cases), options.max_time_s)


if __name__ == "__main__":
    main()
