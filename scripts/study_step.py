"""Do intervals for noise and step hold the truth, with one step a sample and as many as chosen?

    python scripts/study_step.py [twins of each body and noise] [first seed]

The bodies of `study_refinement`, simulated on their own mesh by Newmark's rule at a sixteenth of
the samples' distance, and 0.05, 0.2 or 1 mm of noise.
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import replace

import numpy as np
from study_refinement import BODIES, NAMES, STEP_S, still

from collocation_sysid.pipeline import run
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.runs.result_content import ReportedEstimate

NOISES_M = (5e-5, 2e-4, 1e-3)


def twin(
    name: str, noise_m: float, seed: int
) -> tuple[Problem, dict[str, float]]:
    """A problem with data of a far finer step, and what is true."""
    rng = np.random.default_rng(seed)
    problem, truth = still(name, rng)
    (moved,) = problem.experiments
    markers = replace(
        moved.markers, sigma_m=np.full(len(moved.markers.names), noise_m)
    )
    tracks = simulate(moved, truth, timestep_s=STEP_S / 16).markers_m
    noise = rng.normal(scale=noise_m, size=tracks.shape)
    seen = with_markers(replace(moved, markers=markers), tracks + noise)
    return replace(problem, experiments=[seen]), truth


def main(twins: int = 20, first: int = 0) -> None:
    """Print how many intervals hold the truth."""
    for noise_m in NOISES_M:
        held = Counter()
        steps = Counter()
        all_of_them = 0
        for name in BODIES:
            for seed in range(first, first + twins):
                problem, truth = twin(name, noise_m, seed)
                one = run(replace(problem, substeps=1), seek_causes=False)
                chosen = run(problem, seek_causes=False)
                steps[chosen.solution.collocation.substeps] += 1
                for key in NAMES[:3]:
                    ends = {
                        "noise": one.optimum[key].statistical95,
                        "noise, corrected": one.estimates[key].statistical95,
                        "noise and step": _with_step(one.estimates[key]),
                        "chosen": _with_step(chosen.estimates[key]),
                    }
                    if all(ends.values()):
                        all_of_them += 1
                        held.update(
                            k
                            for k, e in ends.items()
                            if e and e[0] <= truth[key] <= e[1]
                        )
        shares = ", ".join(
            f"{kind} {100 * n / all_of_them:.0f} %" for kind, n in held.items()
        )
        print(
            f"{1e3 * noise_m:g} mm, {all_of_them} intervals held: {shares}",
            flush=True,
        )
        print(f"    steps a sample: {dict(sorted(steps.items()))}", flush=True)


def _with_step(estimate: ReportedEstimate) -> tuple[float, float] | None:
    """Return the interval for noise and time step; that for noise if the step changes nothing."""
    error = estimate.numerical_error
    return estimate.statistical95 if error is None else error.interval95


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
