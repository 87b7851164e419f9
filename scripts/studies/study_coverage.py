"""Coverage of the 95 % intervals of complete identifications, for twins with different noise.

A cylinder hangs from a swung hand. The tracks are simulated with the scheme of the fit, so that
noise is the only error. Each twin has its own noise and, if nuisance parameters are estimated
(offsets of the markers, a delay of their clock), values of these drawn from their priors. It is
solved by reduced space, starting from the true values. The coverage is the share of intervals that
contain the true value: for the four parameters, for Young's modulus and Poisson's ratio, and for
all nuisance parameters together. A coverage outside 91–98 % is marked with a star. The noise is
white, or autoregressive with a coefficient of 0.85 and the same standard deviation, for which
intervals of independent errors must fail. The second table has mean ± standard deviation of the
errors of the logarithms, divided by their standard errors: 0 ± 1 if the standard errors are
correct.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
from scipy.stats import binom, norm
from study_starts import TRUTH, hanging_cylinder, parameters
from synthetic import swing

from collocation_sysid.fem.laws.moduli import engineering_constants
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Grasp, Nuisance
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.uncertainty import ErrorModel, Uncertainty, uncertainty_from_fit

Array = NDArray[np.float64]

SCHEME = "midpoint"
# Layers of elements of the cylinder, and time steps of the recording: small, for thousands of
# solves.
LAYERS = 5
STEPS = 60
# Standard deviations of the priors of the marker offsets [m] and of the clock delay [s].
MARKER_OFFSET_M = 0.002
CLOCK_DELAY_S = 0.003
# Correlation of the autoregressive noise from one sample to the next.
AR_COEFFICIENT = 0.85
QUANTITIES = (*TRUTH, "young_pa", "poisson")
# Heads of the table: the four constants, E, ν, and all nuisance parameters together.
COLUMNS = ("λ", "μ", "γ_r", "γ_m", "E", "ν", "nuisance")
ERROR_MODELS = (
    ErrorModel("given"),
    ErrorModel("estimated"),
    ErrorModel("given", "independent"),
    ErrorModel("estimated", "independent"),
    ErrorModel(),
)
# A coverage outside this range is marked with a star.
ACCEPTED_COVERAGE = (0.91, 0.98)


@dataclass(frozen=True)
class TwinKind:
    """Kind of twins: coefficient `phi` of autoregressive noise, and the estimated nuisance
    parameters.
    """

    name: str
    phi: float
    nuisance: Nuisance


NUISANCE = Nuisance.none(marker_offset_m=MARKER_OFFSET_M, time_shift_s=CLOCK_DELAY_S)
CASES = (
    TwinKind("white", 0.0, Nuisance.none()),
    TwinKind("white, nuisance parameters", 0.0, NUISANCE),
    TwinKind(f"AR(1) {AR_COEFFICIENT}", AR_COEFFICIENT, Nuisance.none()),
    TwinKind(f"AR(1) {AR_COEFFICIENT}, nuisance parameters", AR_COEFFICIENT, NUISANCE),
)


@dataclass(frozen=True, eq=False)
class CoverageOutcome:
    """Results of one twin, by error model (K of `ERROR_MODELS`).

    Attributes
    ----------
    converged : bool
        Whether the solve converged.
    contains_truth : (K, 7)
        Share of the intervals that contain the true value, by `COLUMNS`; NaN without interval.
    scores : (K, 4)
        Errors of the logarithms, divided by their standard errors.
    correlated : (K,) bool
        Whether the standard errors are those of correlated errors.
    identified : (K, 6) bool
        Whether there is a standard error.
    """

    converged: bool
    contains_truth: Array
    scores: Array
    correlated: Array
    identified: Array


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--twins", type=int, default=200, help="of each case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--sigma-m", type=float, default=1e-3, help="deviation of the noise")
    arguments = parser.parse_args()
    began = time.perf_counter()
    # Worker processes read these variables when they start: one thread each.
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "COLLOCATION_SYSID_THREADS": "1"}
    jobs = [
        (case, arguments.sigma_m, (arguments.seed, number, twin))
        for number, case in enumerate(CASES)
        for twin in range(arguments.twins)
    ]
    start = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(arguments.workers, mp_context=start) as pool:
        outcomes = list(pool.map(run, *zip(*jobs, strict=True), chunksize=10))
    by_case = [outcomes[k * arguments.twins : (k + 1) * arguments.twins] for k in range(len(CASES))]
    print(header(arguments.sigma_m, arguments.twins), coverage_table(by_case), sep="\n\n")
    print(f"\n{score_table(by_case)}\n\n{time.perf_counter() - began:.0f} s")


# One twin -------------------------------------------------------------------------------------


def run(case: TwinKind, sigma_m: float, seed: Sequence[int]) -> CoverageOutcome:
    """Draw a twin, identify it, and compare the answer with the truth.

    Parameters
    ----------
    case : TwinKind
    sigma_m : float
        Standard deviation of the noise [m].
    seed : sequence of int
        Seed of the noise and of the nuisance parameters.
    """
    experiment, x = reference(sigma_m)
    rng = np.random.default_rng(seed)
    collocation, phi = twin(experiment, x, case, sigma_m, rng)
    solution = ReducedSpace(tolerance=1e-6, ladder=(1.0,))(collocation)
    collocation = solution.collocation
    q = solution.z[: collocation.nq]
    fit = linearise_fit(collocation, solution.z)
    uncertainties = [
        uncertainty_from_fit(fit, collocation.parameters, q, kind) for kind in ERROR_MODELS
    ]
    nuisance_errors = collocation.parameters_from(solution.z)[collocation.nq :] - phi
    return CoverageOutcome(
        solution.status.converged,
        np.array(
            [
                [*intervals_with_truth(each), nuisance_coverage(each, nuisance_errors)]
                for each in uncertainties
            ]
        ),
        np.array([scores(each, q) for each in uncertainties]),
        np.array([each.errors == "autocorrelated" for each in uncertainties]),
        np.array([has_standard_errors(each) for each in uncertainties]),
    )


@cache
def reference(sigma_m: float) -> tuple[Experiment, Array]:
    """Return the experiment without markers measured yet, and its exact node positions (T, 3n) [m]."""
    experiment = hanging_cylinder(LAYERS, STEPS, SCHEME)
    (grasp,) = experiment.grasps
    # Faster than in `study_starts`: the standard error of λ is five times smaller, so that errors
    # stay proportional to the noise.
    poses = swing(
        experiment.t_s,
        amplitude_m=(0.05, 0.04, 0.03),
        amplitude_rad=(0.3, 0.3, 1.2),
        frequency_hz=(2.0, 2.5, 3.0),
        rise_s=0.15,
        start=Rotation.from_rotvec([np.pi, 0, 0]),
    )
    sigmas_m = np.full(len(experiment.markers.names), sigma_m)
    experiment = replace(
        experiment,
        grasps=(Grasp(grasp.nodes, poses),),
        markers=replace(experiment.markers, sigma_m=sigmas_m),
    )
    positions_m = simulate(experiment, TRUTH, SCHEME, substeps=1).positions_m
    return experiment, positions_m.reshape(len(positions_m), -1)


def twin(
    experiment: Experiment, x: Array, case: TwinKind, sigma_m: float, rng: np.random.Generator
) -> tuple[Collocation, Array]:
    """Return the program of one twin, which starts from the truth, and its true nuisance parameters
    φ.

    `x` are the exact node positions (T, 3n) [m] from `reference`.
    """
    experiment = replace(experiment, nuisance=case.nuisance)
    collocation = collocation_of(experiment)
    drawn_phi = rng.standard_normal(collocation.nphi)
    simulated, p = collocation.follow_estimates(
        np.append(collocation.parameters.guess_q, drawn_phi)
    )
    (transcription,) = simulated.transcriptions
    phi = p[collocation.nq :]
    tracks = transcription.markers.predict_positions(x, phi)
    noise = sigma_m * noise_of(rng, tracks.shape, case.phi)
    return collocation_of(with_markers(experiment, tracks + noise)), phi


def collocation_of(experiment: Experiment) -> Collocation:
    """Return the program of an experiment whose guesses are the true parameters."""
    return Collocation([experiment], parameters(np.array(list(TRUTH.values()))), SCHEME)


def noise_of(rng: np.random.Generator, shape: tuple[int, ...], phi: float) -> Array:
    """Return stationary noise of unit variance, autoregressive (coefficient `phi`) along the first
    axis.
    """
    white = rng.standard_normal(shape)
    white[1:] *= np.sqrt(1 - phi**2)
    return np.asarray(lfilter([1.0], [1.0, -phi], white, axis=0))


def truth() -> dict[str, float]:
    """Return the true values of the four constants, E [Pa] and ν."""
    young_pa, poisson = engineering_constants(TRUTH["lambda_pa"], TRUTH["mu_pa"])
    return {**TRUTH, "young_pa": young_pa, "poisson": poisson}


def intervals_with_truth(uncertainty: Uncertainty) -> list[float]:
    """Return for each quantity 1 if the interval contains the truth, 0 if not, NaN without
    interval.
    """
    estimates = {**uncertainty.estimates, **uncertainty.derived}
    contained = []
    for name, value in truth().items():
        interval = estimates[name].statistical95
        contained.append(np.nan if interval is None else float(interval[0] <= value <= interval[1]))
    return contained


def nuisance_coverage(uncertainty: Uncertainty, nuisance_errors: Array) -> float:
    """Return the share of nuisance parameters whose errors are within their intervals; NaN without
    any.
    """
    if not len(nuisance_errors):
        return np.nan
    half = norm.ppf(0.975) * np.array(list(uncertainty.nuisance.values()))
    return float(np.mean(np.abs(nuisance_errors) <= half))


def scores(uncertainty: Uncertainty, q: Array) -> Array:
    """Return the errors (4,) of the logarithms `q`, divided by their standard errors."""
    return (q - np.log(list(TRUTH.values()))) / np.sqrt(np.diag(uncertainty.covariance))


def has_standard_errors(uncertainty: Uncertainty) -> list[bool]:
    """Return for each quantity whether it has a standard error."""
    estimates = {**uncertainty.estimates, **uncertainty.derived}
    return [estimates[name].statistical_std_error is not None for name in QUANTITIES]


# Tables ---------------------------------------------------------------------------------------


def header(sigma_m: float, twins: int) -> str:
    """Return the size of the problem, and the range of coverages of exact intervals, as text."""
    experiment, _ = reference(sigma_m)
    low, high = binom.interval(0.95, twins, 0.95)
    return (
        f"{len(experiment.body.nodes_m)} nodes x {len(experiment.t_s)} steps, "
        f"{len(experiment.markers.names)} markers, sigma {1e3 * sigma_m:g} mm; {twins} twins of "
        f"each case; the coverage of exact intervals is {100 * low / twins:.1f}-"
        f"{100 * high / twins:.1f} % with a probability of 95 %"
    )


def coverage_table(by_case: list[list[CoverageOutcome]]) -> str:
    """Return the table of the percentages of intervals that contain the truth, by case and error
    model.
    """
    lines = [_line("coverage [%]", COLUMNS, 9) + "  correlated errors"]
    for k, kind in enumerate(ERROR_MODELS):
        for case, outcomes in zip(CASES, by_case, strict=True):
            share = shares(outcomes, k)
            correlated_share = np.mean([outcome.correlated[k] for outcome in outcomes])
            name = f"{case.name}: {kind.noise}, {kind.errors}"
            lines.append(
                _line(name, [_starred(s) for s in share], 9) + f"{100 * correlated_share:10.0f} %"
            )
    lines.append("")
    for case, outcomes in zip(CASES, by_case, strict=True):
        failures = sum(not outcome.converged for outcome in outcomes)
        missing_intervals = int(
            np.isnan([outcome.contains_truth[0, :-1] for outcome in outcomes]).sum()
        )
        not_identified_shares = 1 - np.mean([outcome.identified[0] for outcome in outcomes], axis=0)
        lines.append(
            f"{case.name}: {failures} solves did not converge, {missing_intervals} intervals missing; "
            "without standard error: "
            + ", ".join(
                f"{c} {100 * v:.0f} %" for c, v in zip(COLUMNS, not_identified_shares, strict=False)
            )
        )
    return "\n".join(lines)


def shares(outcomes: list[CoverageOutcome], kind: int) -> Array:
    """Return the shares (7,) of intervals that contain the truth, by `COLUMNS`; NaN without
    intervals.

    `kind` is an index of `ERROR_MODELS`.
    """
    rows = np.array([outcome.contains_truth[kind] for outcome in outcomes])
    has_interval = np.isfinite(rows)
    counts = has_interval.sum(axis=0)
    return np.where(
        counts > 0, np.where(has_interval, rows, 0).sum(axis=0) / np.maximum(counts, 1), np.nan
    )


def score_table(by_case: list[list[CoverageOutcome]]) -> str:
    """Return the table of mean ± standard deviation of the scores, by case and error model."""
    lines = [_line("error / standard error", COLUMNS[:4], 14)]
    for k, kind in enumerate(ERROR_MODELS):
        for case, outcomes in zip(CASES, by_case, strict=True):
            rows = np.array([outcome.scores[k] for outcome in outcomes])
            mean = np.nanmean(rows, axis=0)
            deviation = np.nanstd(rows, axis=0)
            cells = [f"{m:+.2f} ± {d:.2f}" for m, d in zip(mean, deviation, strict=True)]
            lines.append(_line(f"{case.name}: {kind.noise}, {kind.errors}", cells, 14))
    return "\n".join(lines)


def _starred(share: float) -> str:
    if np.isnan(share):
        return "-"
    return (
        f"{100 * share:.1f}{' ' if ACCEPTED_COVERAGE[0] <= share <= ACCEPTED_COVERAGE[1] else '*'}"
    )


def _line(name: str, cells: Sequence[str], width: int = 7) -> str:
    return f"{name:50}" + "".join(f"{cell:>{width}}" for cell in cells)


if __name__ == "__main__":
    main()
