"""Coverage of intervals for noise and time step, with one step per sample and with the chosen
number.

    python scripts study_step [--twins 20] [--first 0]

The bodies of `study_refinement` are simulated on the mesh of the fit by Newmark's scheme with a
sixteenth of the sampling interval, and with noise of 0.05, 0.2 or 1 mm.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
from coverage_runner import Intervals, count_coverage
from script_arguments import make_parser
from study_refinement import BODIES, NAMES, STEP_S, unmeasured_problem

from collocation_sysid.pipeline import run
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.runs.result_content import ReportedEstimate

# Standard deviations of each marker coordinate [m].
NOISES_M = (5e-5, 2e-4, 1e-3)


def twin(name: str, noise_m: float, seed: int) -> tuple[Problem, dict[str, float]]:
    """Return a problem with tracks of a much finer time step, and its true parameters."""
    rng = np.random.default_rng(seed)
    problem, truth = unmeasured_problem(name, rng)
    (experiment,) = problem.experiments
    markers = replace(experiment.markers, sigma_m=np.full(len(experiment.markers.names), noise_m))
    tracks = simulate(experiment, truth, timestep_s=STEP_S / 16).markers_m
    noise = rng.normal(scale=noise_m, size=tracks.shape)
    recording = with_markers(replace(experiment, markers=markers), tracks + noise)
    return replace(problem, experiments=[recording]), truth


def main(twins: int = 20, first: int = 0) -> None:
    """Print the coverage of the intervals, and how often each number of steps was chosen.

    `twins` is the number of twins of each body and noise, `first` the first seed.
    """
    for noise_m in NOISES_M:
        steps = Counter[int]()

        def intervals(problem: Problem, steps: Counter[int] = steps) -> Intervals:
            """Return the intervals with one step per sample, and with the chosen number."""
            one = run(replace(problem, substeps=1), seek_causes=False)
            chosen = run(problem, seek_causes=False)
            steps[chosen.solution.collocation.substeps] += 1
            found = {}
            for name in NAMES[:3]:
                found[f"{name}, one step, noise"] = one.optimum[name].statistical95
                corrected = one.estimates[name]
                found[f"{name}, one step, noise, estimate corrected"] = corrected.statistical95
                found[f"{name}, one step, noise and step"] = _interval_with_step(corrected)
                found[f"{name}, chosen steps"] = _interval_with_step(chosen.estimates[name])
            return found

        seeds = range(first, first + twins)
        every = (twin(name, noise_m, seed) for name in BODIES for seed in seeds)
        print(f"noise {1e3 * noise_m:g} mm: {count_coverage(every, intervals).table()}")
        print(f"\ntwins by chosen steps per sample: {dict(sorted(steps.items()))}\n", flush=True)


def _interval_with_step(estimate: ReportedEstimate) -> tuple[float, float] | None:
    """Return the interval for noise and time step; that for noise if the step changes nothing."""
    error = estimate.numerical_error
    return estimate.statistical95 if error is None else error.interval95


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("--twins", type=int, default=20, help="of each body and noise")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    options = parser.parse_args()
    main(options.twins, options.first)
