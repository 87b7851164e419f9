"""Twins of a hanging, swung cylinder with different noise, and their complete identification.

The tracks are simulated with the scheme of the fit, so that noise is the only error. Each twin has
its own noise and, if nuisance parameters are estimated (offsets of the markers, a delay of their
clock), values of these drawn from their priors. The noise is white, or autoregressive with a
coefficient of 0.85 and the same standard deviation, for which intervals of independent errors must
fail.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
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
ERROR_MODELS = (
    ErrorModel("given"),
    ErrorModel("estimated"),
    ErrorModel("given", "independent"),
    ErrorModel("estimated", "independent"),
    ErrorModel(),
)


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
    """Results of one twin, by error model (K of `ERROR_MODELS`)."""

    converged: bool  # whether the solve converged
    # (K, 6): whether the intervals of `QUANTITIES` contain the true value; NaN without interval.
    contains_truth: Array
    scores: Array  # (K, 4): errors of the logarithms, divided by their standard errors
    correlated: Array  # (K,): whether the standard errors are those of correlated errors


def run(case: TwinKind, sigma_m: float, seed: Sequence[int]) -> CoverageOutcome:
    """Draw a twin, identify it, and compare the answer with the truth."""
    experiment, x = reference(sigma_m)
    rng = np.random.default_rng(seed)
    collocation = twin(experiment, x, case, sigma_m, rng)
    solution = ReducedSpace(tolerance=1e-6, ladder=(1.0,))(collocation)
    collocation = solution.collocation
    q = solution.z[: collocation.nq]
    fit = linearise_fit(collocation, solution.z)
    uncertainties = [
        uncertainty_from_fit(fit, collocation.parameters, q, kind) for kind in ERROR_MODELS
    ]
    return CoverageOutcome(
        solution.status.converged,
        np.array([intervals_with_truth(each) for each in uncertainties]),
        np.array([scores(each, q) for each in uncertainties]),
        np.array([each.errors == "autocorrelated" for each in uncertainties]),
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
) -> Collocation:
    """Return the program of one twin, which starts from the truth.

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
    return collocation_of(with_markers(experiment, tracks + noise))


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


def scores(uncertainty: Uncertainty, q: Array) -> Array:
    """Return the errors (4,) of the logarithms `q`, divided by their standard errors."""
    return (q - np.log(list(TRUTH.values()))) / np.sqrt(np.diag(uncertainty.covariance))
