"""Coverage of the 95 % intervals of complete identifications, for twins with different noise.

A cylinder hangs from a swung hand. The tracks are simulated with the scheme of the fit, so that
noise is the only error. Each twin has its own noise and, if nuisance parameters are estimated
(offsets of the markers, a delay of their clock), values of these drawn from their priors. It is
solved by reduced space, starting from the true values. The coverage is the share of intervals that
contain the true value: for the four parameters, for Young's modulus and Poisson's ratio, and for all
nuisance parameters together. A coverage outside 91–98 % is marked with a star. The noise is white,
or autoregressive with a coefficient of 0.85 and the same standard deviation, for which intervals of
independent errors must fail. The second table has mean ± standard deviation of the errors of the
logarithms, divided by their standard errors: 0 ± 1 if the standard errors are correct.
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
from collocation_sysid.statistics.uncertainty import (
    ErrorModel,
    Uncertainty,
    uncertainty_from_fit,
)

Array = NDArray[np.float64]

SCHEME = "midpoint"
LAYERS = 5
STEPS = 60
OFFSET_M = 0.002
SHIFT_S = 0.003
PHI = 0.85
QUANTITIES = (*TRUTH, "young_pa", "poisson")
COLUMNS = ("λ", "μ", "γ_r", "γ_m", "E", "ν", "own")
KINDS = (
    ErrorModel("given"),
    ErrorModel("estimated"),
    ErrorModel("given", "independent"),
    ErrorModel("estimated", "independent"),
    ErrorModel(),
)
ACCEPTED = (0.91, 0.98)


@dataclass(frozen=True)
class Case:
    """Kind of twins: correlation of the noise, and the nuisance parameters that are estimated."""

    name: str
    phi: float
    nuisance: Nuisance


OWN = Nuisance.none(marker_offset_m=OFFSET_M, time_shift_s=SHIFT_S)
CASES = (
    Case("white", 0.0, Nuisance.none()),
    Case("white, nuisance parameters", 0.0, OWN),
    Case(f"AR(1) {PHI}", PHI, Nuisance.none()),
    Case(f"AR(1) {PHI}, nuisance parameters", PHI, OWN),
)


@dataclass(frozen=True, eq=False)
class Outcome:
    """One twin.

    Attributes
    ----------
    held : (kinds, 7) share of intervals that hold the truth, by `COLUMNS`; NaN without interval
    scores : (kinds, 4) errors of the logarithms over their standard deviations
    correlated : (kinds,) whether error bars for correlated errors were given
    identified : (kinds, 6) whether a standard error was
    """

    converged: bool
    held: Array
    scores: Array
    correlated: Array
    identified: Array


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--twins", type=int, default=200, help="of each case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, help="processes"
    )
    parser.add_argument(
        "--sigma-m", type=float, default=1e-3, help="deviation of the noise"
    )
    arguments = parser.parse_args()
    began = time.perf_counter()
    # Workers start afresh and find one thread each.
    os.environ |= {
        "OPENBLAS_NUM_THREADS": "1",
        "COLLOCATION_SYSID_THREADS": "1",
    }
    jobs = [
        (case, arguments.sigma_m, (arguments.seed, number, twin))
        for number, case in enumerate(CASES)
        for twin in range(arguments.twins)
    ]
    start = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(arguments.workers, mp_context=start) as pool:
        outcomes = list(pool.map(run, *zip(*jobs, strict=True), chunksize=10))
    by_case = [
        outcomes[k * arguments.twins : (k + 1) * arguments.twins]
        for k in range(len(CASES))
    ]
    print(
        header(arguments.sigma_m, arguments.twins),
        coverage_table(by_case),
        sep="\n\n",
    )
    print(f"\n{score_table(by_case)}\n\n{time.perf_counter() - began:.0f} s")


# One twin -------------------------------------------------------------------------------------


def run(case: Case, sigma_m: float, seed: Sequence[int]) -> Outcome:
    """Draw a twin, identify it, and compare with the truth."""
    experiment, x = reference(sigma_m)
    rng = np.random.default_rng(seed)
    collocation, phi = twin(experiment, x, case, sigma_m, rng)
    solution = ReducedSpace(tolerance=1e-6, ladder=(1.0,))(collocation)
    collocation = solution.collocation
    q = solution.z[: collocation.nq]
    fit = linearise_fit(collocation, solution.z)
    found = [
        uncertainty_from_fit(fit, collocation.parameters, q, kind)
        for kind in KINDS
    ]
    wrong = collocation.parameters_from(solution.z)[collocation.nq :] - phi
    return Outcome(
        solution.status.converged,
        np.array([[*held(each), held_own(each, wrong)] for each in found]),
        np.array([scores(each, q) for each in found]),
        np.array([each.errors == "autocorrelated" for each in found]),
        np.array([identified(each) for each in found]),
    )


@cache
def reference(sigma_m: float) -> tuple[Experiment, Array]:
    """The experiment without noise, and its node positions (T, 3n)."""
    experiment = hanging_cylinder(LAYERS, STEPS, SCHEME)
    (grasp,) = experiment.grasps
    # Faster than there: it tells λ five times as well, and errors stay in proportion to the noise.
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
    experiment: Experiment,
    x: Array,
    case: Case,
    sigma_m: float,
    rng: np.random.Generator,
) -> tuple[Collocation, Array]:
    """The identification of one twin, from the truth, and its nuisance parameters φ."""
    experiment = replace(experiment, nuisance=case.nuisance)
    collocation = collocation_of(experiment)
    drawn = rng.standard_normal(collocation.nphi)
    followed, p = collocation.follow_estimates(
        np.append(collocation.parameters.guess_q, drawn)
    )
    (segment,) = followed.transcriptions
    phi = p[collocation.nq :]
    tracks = segment.markers.predict_positions(x, phi)
    noise = sigma_m * noise_of(rng, tracks.shape, case.phi)
    return collocation_of(with_markers(experiment, tracks + noise)), phi


def collocation_of(experiment: Experiment) -> Collocation:
    return Collocation(
        [experiment], parameters(np.array(list(TRUTH.values()))), SCHEME
    )


def noise_of(
    rng: np.random.Generator, shape: tuple[int, ...], phi: float
) -> Array:
    """Noise of unit variance, stationary and autoregressive along the first axis."""
    white = rng.standard_normal(shape)
    white[1:] *= np.sqrt(1 - phi**2)
    return np.asarray(lfilter([1.0], [1.0, -phi], white, axis=0))


def truth() -> dict[str, float]:
    young_pa, poisson = engineering_constants(
        TRUTH["lambda_pa"], TRUTH["mu_pa"]
    )
    return {**TRUTH, "young_pa": young_pa, "poisson": poisson}


def held(uncertainty: Uncertainty) -> list[float]:
    """One where an interval holds the truth, zero where not, NaN where there is none."""
    estimates = {**uncertainty.estimates, **uncertainty.derived}
    found = []
    for name, value in truth().items():
        interval = estimates[name].statistical95
        found.append(
            np.nan
            if interval is None
            else float(interval[0] <= value <= interval[1])
        )
    return found


def held_own(uncertainty: Uncertainty, wrong: Array) -> float:
    """Share of the nuisance parameters, off by `wrong`, that are within their intervals."""
    if not len(wrong):
        return np.nan
    half = norm.ppf(0.975) * np.array(list(uncertainty.nuisance.values()))
    return float(np.mean(np.abs(wrong) <= half))


def scores(uncertainty: Uncertainty, q: Array) -> Array:
    return (q - np.log(list(TRUTH.values()))) / np.sqrt(
        np.diag(uncertainty.covariance)
    )


def identified(uncertainty: Uncertainty) -> list[bool]:
    estimates = {**uncertainty.estimates, **uncertainty.derived}
    return [
        estimates[name].statistical_std_error is not None for name in QUANTITIES
    ]


# Tables ---------------------------------------------------------------------------------------


def header(sigma_m: float, twins: int) -> str:
    experiment, _ = reference(sigma_m)
    low, high = binom.interval(0.95, twins, 0.95)
    return (
        f"{len(experiment.body.nodes_m)} nodes x {len(experiment.t_s)} steps, "
        f"{len(experiment.markers.names)} markers, sigma {1e3 * sigma_m:g} mm; {twins} twins of "
        f"each case, of which chance keeps a share of {100 * low / twins:.1f}-"
        f"{100 * high / twins:.1f} % with 95 % probability"
    )


def coverage_table(by_case: list[list[Outcome]]) -> str:
    """Percent of the intervals that hold the truth."""
    lines = [_line("held [%]", COLUMNS) + "  correlated"]
    for k, kind in enumerate(KINDS):
        for case, outcomes in zip(CASES, by_case, strict=True):
            share = shares(outcomes, k)
            chosen = np.mean([outcome.correlated[k] for outcome in outcomes])
            name = f"{case.name}: {kind.noise}, {kind.errors}"
            lines.append(
                _line(name, [_marked(s) for s in share])
                + f"{100 * chosen:10.0f} %"
            )
    lines.append("")
    for case, outcomes in zip(CASES, by_case, strict=True):
        lost = sum(not outcome.converged for outcome in outcomes)
        without = int(
            np.isnan([outcome.held[0, :-1] for outcome in outcomes]).sum()
        )
        vague = 1 - np.mean(
            [outcome.identified[0] for outcome in outcomes], axis=0
        )
        lines.append(
            f"{case.name}: {lost} did not converge, {without} quantities without interval; "
            "called not identified: "
            + ", ".join(
                f"{c} {100 * v:.0f} %"
                for c, v in zip(COLUMNS, vague, strict=False)
            )
        )
    return "\n".join(lines)


def shares(outcomes: list[Outcome], kind: int) -> Array:
    """(7,) share of intervals that hold the truth, by `COLUMNS`; NaN where there are none."""
    rows = np.array([outcome.held[kind] for outcome in outcomes])
    there = np.isfinite(rows)
    counts = there.sum(axis=0)
    return np.where(
        counts > 0,
        np.where(there, rows, 0).sum(axis=0) / np.maximum(counts, 1),
        np.nan,
    )


def score_table(by_case: list[list[Outcome]]) -> str:
    """Mean and standard deviation of the scores."""
    lines = [_line("scores", COLUMNS[:4], 14)]
    for k, kind in enumerate(KINDS):
        for case, outcomes in zip(CASES, by_case, strict=True):
            rows = np.array([outcome.scores[k] for outcome in outcomes])
            mean = np.nanmean(rows, axis=0)
            deviation = np.nanstd(rows, axis=0)
            cells = [
                f"{m:+.2f} ± {d:.2f}"
                for m, d in zip(mean, deviation, strict=True)
            ]
            lines.append(
                _line(f"{case.name}: {kind.noise}, {kind.errors}", cells, 14)
            )
    return "\n".join(lines)


def _marked(share: float) -> str:
    if np.isnan(share):
        return "-"
    return f"{100 * share:.1f}{' ' if ACCEPTED[0] <= share <= ACCEPTED[1] else '*'}"


def _line(name: str, cells: Sequence[str], width: int = 7) -> str:
    return f"{name:50}" + "".join(f"{cell:>{width}}" for cell in cells)


if __name__ == "__main__":
    main()
