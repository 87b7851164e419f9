"""Effect of 1 mm of marker noise on the estimates of each method: bias and spread over many seeds.

The body is the swung cylinder of study_coverage.py, simulated with the scheme of the fit, so that
noise is the only error. Every method has the same noise and the same guess. Bias and standard
deviation are those of the logarithms in per cent, the bias with its standard error; the column
"predicted" has the standard error at the true values.

    python scripts study_noise
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from studies import PARAMETER_SYMBOLS, TRUTH, markdown, save
from study_coverage import SCHEME, reference
from study_starts import BOUNDS

from collocation_sysid.methods import METHODS
from collocation_sysid.model.parameters import Parameter, Parameters
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.simulation import with_markers
from collocation_sysid.statistics.curved_intervals import uncertainty_at
from collocation_sysid.statistics.uncertainty import ErrorModel

Array = NDArray[np.float64]

# Initial guesses of λ [Pa], μ [Pa], γ_r [s] and γ_m [1/s].
GUESS = (400.0, 150.0, 0.02, 0.5)
# Options of methods: inner Levenberg–Marquardt solver.
LM = {"inner": "levenberg-marquardt"}


@dataclass(frozen=True)
class MethodCase:
    """Method with options, and the share of the seeds for which it is run."""

    name: str
    method: str
    options: Mapping[str, Any]
    share: float = 1.0


CASES = (
    MethodCase("reduced-space", "reduced-space", {}),
    MethodCase("shooting", "shooting", {}),
    MethodCase(
        "augmented-lagrangian, LM", "augmented-lagrangian", {"rho": 1e2, "max_time_s": 60.0}, 0.1
    ),
    MethodCase("penalty, LM", "penalty", {**LM, "max_time_s": 60.0}, 0.1),
)


@dataclass(frozen=True, eq=False)
class NoiseOutcome:
    """Identification of one twin: errors (4,) of the logarithms, and time [s]."""

    converged: bool
    errors: Array
    time_s: float


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--sigma-m", type=float, default=1e-3)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--out", type=Path, default=Path("results/study_noise"))
    arguments = parser.parse_args()
    # Worker processes read these variables when they start: one thread each.
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "COLLOCATION_SYSID_THREADS": "1"}
    start = multiprocessing.get_context("spawn")
    outcomes = {}
    with ProcessPoolExecutor(arguments.workers, mp_context=start) as pool:
        for case in CASES:
            count = max(2, round(case.share * arguments.seeds))
            jobs = [(case, arguments.sigma_m, seed) for seed in range(count)]
            outcomes[case.name] = list(pool.map(run, *zip(*jobs, strict=True)))
    text = table(outcomes, predicted(arguments.sigma_m))
    save(arguments.out, "study_noise", text)


def run(case: MethodCase, sigma_m: float, seed: int) -> NoiseOutcome:
    """Identify the noisy twin of a seed with one method, starting from the guess."""
    collocation = noisy_twin(sigma_m, seed, GUESS)
    method = METHODS[case.method](**case.options)
    began = time.perf_counter()
    solution = method(collocation)
    return NoiseOutcome(
        solution.status.converged,
        np.log(solution.theta / list(TRUTH.values())),
        time.perf_counter() - began,
    )


def noisy_twin(sigma_m: float, seed: int | None, guess: Sequence[float]) -> Collocation:
    """Return the program of a twin with the noise of a seed; without noise if the seed is None."""
    experiment, x = reference(sigma_m)
    tracks = experiment.markers.predict_positions(x.reshape(len(x), -1, 3))
    if seed is not None:
        tracks = tracks + sigma_m * np.random.default_rng(seed).standard_normal(tracks.shape)
    parameters = Parameters(
        tuple(Parameter(n, g, *BOUNDS[n]) for n, g in zip(TRUTH, guess, strict=True))
    )
    return Collocation([with_markers(experiment, tracks)], parameters, SCHEME)


@cache
def predicted(sigma_m: float) -> tuple[float, ...]:
    """Return the standard errors of the logarithms of the four parameters at the truth."""
    truth = tuple(TRUTH.values())
    collocation = noisy_twin(sigma_m, None, truth)
    _, x = reference(sigma_m)
    z = collocation.pack(np.log(truth), [x])
    variances = uncertainty_at(
        collocation, z, ErrorModel(errors="independent")
    ).covariance.diagonal()
    return tuple(np.sqrt(variances).tolist())


def table(outcomes: Mapping[str, Sequence[NoiseOutcome]], expected: Sequence[float]) -> str:
    """Return a Markdown table of bias and spread of every method.

    `expected` are the predicted standard errors (4,) of the logarithms.
    """
    heads = (
        *("method", "number of twins", "converged"),
        *(f"{name} {what} [%]" for name in PARAMETER_SYMBOLS for what in ("bias", "spread")),
        "median time [s]",
    )
    spreads = [cell for each in expected for cell in ("0", f"{100 * each:.3g}")]
    lines = [("predicted", "–", "–", *spreads, "–")]
    for name, each in outcomes.items():
        converged = [outcome.errors for outcome in each if outcome.converged]
        time_s = float(np.median([outcome.time_s for outcome in each]))
        lines.append(
            (
                name,
                str(len(each)),
                str(len(converged)),
                *bias_and_spread(converged),
                f"{time_s:.2g}",
            )
        )
    return markdown(heads, lines)


def bias_and_spread(errors: Sequence[Array]) -> list[str]:
    """Return bias and standard deviation of each of the four parameters in per cent, as text.

    The errors (4,) of the logarithms are those of the twins that converged; without two of them
    there are dashes.
    """
    if len(errors) < 2:
        return ["–"] * (2 * len(PARAMETER_SYMBOLS))
    percent = 100 * np.array(errors)
    cells = []
    for bias, spread in zip(percent.mean(axis=0), percent.std(axis=0, ddof=1), strict=True):
        standard_error_bias = spread / np.sqrt(len(percent))
        cells += [f"{bias:+.2g} ± {standard_error_bias:.1g}", f"{spread:.3g}"]
    return cells


if __name__ == "__main__":
    main()
