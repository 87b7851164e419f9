"""Time of a run without an initial guess and without marker positions, at the paper's size.

The same recording is identified in turn with both (a guess that is wrong by a factor of two,
positions known to 1 mm) and without either, each time with the default nuisance parameters. The
ratio of the median times is printed. A run is complete: initialisation, solve, forward simulation,
intervals and verdict. Kernels are compiled before the first run.
"""

from __future__ import annotations

import argparse
import statistics
import time

import numpy as np
from study_starts import CASES, problem_of, with_description, with_noise

from collocation_sysid import run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--body", default="cylinder", choices=list(CASES))
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    body = CASES[arguments.body]()
    described_body, undescribed_body = (
        with_noise(with_description(body, unplaced, ideal=False), body.noise_m, 0)
        for unplaced in (False, True)
    )
    truth = np.array(list(described_body.truth.values()))
    problems = {
        "with guess and places": problem_of(described_body, 2 * truth),
        "with neither": problem_of(undescribed_body, np.full(len(truth), np.nan)),
    }
    times_s: dict[str, list[float]] = {name: [] for name in problems}
    run(problems["with guess and places"])
    for _ in range(arguments.repeats):
        for name, problem in problems.items():
            began = time.perf_counter()
            answer = run(problem)
            times_s[name].append(time.perf_counter() - began)
            if not answer.solution.status.converged:
                raise SystemExit(f"{name}: {answer.solution.message}")
    medians = {name: statistics.median(each) for name, each in times_s.items()}
    for name, median_s in medians.items():
        print(f"{name}: {median_s:.2f} s (median of {arguments.repeats})")
    time_with_both_s, time_with_neither_s = medians.values()
    print(f"time with neither over time with both: {time_with_neither_s / time_with_both_s:.2f}")


if __name__ == "__main__":
    main()
