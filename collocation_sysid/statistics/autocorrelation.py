"""Errors that persist from sample to sample and are shared among markers.

Noise of a camera is nearly white; what a model misses is not. Least squares still finds the
parameters, but their covariance is the sandwich A⁻¹ B A⁻¹ with B the covariance of the score Sᵀe,
and B depends on how the errors e hang together. Here, in every experiment on its own,

    Cov(e_{t,c}, e_{s,d}) = Σ_{c,d} ρ_{|t−s|}

with ρ of one autoregressive process and Σ among the channels (marker and axis). The residuals of
a fit are smaller and less persistent than the errors; `autocovariance` corrects for that. The
order minimises Schwarz's criterion. Σ is that of the innovations, which are nearly independent in
time.

Compared with it on simulated fits (tests/test_error_coverage.py), a kernel estimate of B from
the scores of each time (Andrews 1991, prewhitened) covers 83–90 % where 95 % is meant, and one
without the correction of the residuals or without Σ fails for short records and shared errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from .autocovariance import along_time, autocorrelation, autoregression, lagged_products
from .distributions import chi2_sf, normal_isf
from .information import Information
from .linearised import FitBlock, LinearisedFit
from .noise import ROUNDING

MAX_ORDER = 4
# So many samples per coefficient of the autoregression.
SAMPLES_PER_ORDER = 10
# Of finding the autocovariances at the lags beyond from the few, and the few without those.
# They end when nothing changes by more than a share that no error bar shows.
ROUNDS, SETTLED = 4, 0.01
SIGNIFICANCE = 0.01
# A smaller autocorrelation changes no error bar by more than 5 %, significant or not.
NOTICEABLE = 0.05


@dataclass(frozen=True)
class Dependence:
    """Whether the errors of a fit look independent.

    Attributes
    ----------
    lag1 : float
        Autocorrelation of consecutive samples, pooled over all channels, corrected for what the
        fit has taken out of the residuals.
    lag1_deviation : float
        Its standard deviation if the errors are independent; infinite where it cannot be told.
    shared_p : float
        Probability of correlations among channels as large as found, if they are independent.
    """

    lag1: float
    lag1_deviation: float
    shared_p: float

    @property
    def in_time(self) -> bool:
        """The errors persist, significantly and noticeably."""
        limit = float(normal_isf(SIGNIFICANCE / 2)) * self.lag1_deviation
        return abs(self.lag1) > max(limit, NOTICEABLE)

    @property
    def among_channels(self) -> bool:
        """Markers or axes have errors in common."""
        return self.shared_p < SIGNIFICANCE

    @property
    def found(self) -> bool:
        """The errors are not independent."""
        return self.in_time or self.among_channels


@dataclass(frozen=True, eq=False)
class ErrorProcess:
    """How the errors of one experiment hang together, in units of σ.

    Attributes
    ----------
    along_time : (T,) autocorrelation by lag, the first is one
    among_channels : (3M, 3M) covariance at one time
    order : int
        Of the autoregression.
    samples : float
        Number of independent samples in time that `among_channels` rests on.
    degrees_of_freedom : float
        Of the mean variance.
    """

    along_time: Array
    among_channels: Array
    order: int
    samples: float
    degrees_of_freedom: float


def dependence(fit: LinearisedFit, information: Information) -> Dependence:
    """Test the residuals for correlation, in time and among channels."""
    if fit.chi_squared <= ROUNDING**2 * fit.measurements:
        return Dependence(0.0, np.inf, 1.0)
    if all(len(block.t_s) < 2 for block in fit.blocks):  # nothing follows on anything
        return Dependence(0.0, np.inf, _shared_p(fit))
    found = lagged_products(fit, information, [1] * len(fit.blocks))
    # Rows and columns: variance and lag one, pooled over the experiments.
    pool = np.tile(np.eye(2), len(fit.blocks))
    products, expected = pool @ found.products, pool @ found.expected @ pool.T
    variance = products[0] / expected[0, 0]
    lag1_variance = (products[1] - variance * expected[1, 0]) / expected[1, 1]
    return Dependence(
        lag1=float(np.clip(lag1_variance / variance, -1.0, 1.0)),  # corrected, it may be beyond
        lag1_deviation=float(np.sqrt(2 / expected[1, 1])),
        shared_p=_shared_p(fit),
    )


def _shared_p(fit: LinearisedFit) -> float:
    """Lagrange-multiplier test of Breusch and Pagan (1980) on all pairs of channels."""
    statistic, pairs = 0.0, 0
    for block in fit.blocks:
        residual, _, present = block.channels
        counts = present.T.astype(float) @ present
        of_channel = np.sqrt(np.sum(residual**2, axis=0) / np.maximum(np.diag(counts), 1))
        scaled = residual / np.where(of_channel > 0, of_channel, np.inf)
        used = np.triu(counts > 2, 1)
        correlation = (scaled.T @ scaled)[used] / counts[used]
        statistic += float(np.sum((counts[used] - 1) * correlation**2))
        pairs += int(used.sum())
    return float(chi2_sf(statistic, pairs)) if pairs else 1.0


def error_processes(fit: LinearisedFit, information: Information) -> tuple[ErrorProcess, ...]:
    """The error process of each experiment."""
    orders = [min(MAX_ORDER, len(block.t_s) // SAMPLES_PER_ORDER) for block in fit.blocks]
    moments = lagged_products(fit, information, [max(1, order) for order in orders])
    found = moments.autocovariances()
    for _ in range(ROUNDS):
        tails = [
            _tail(block, gamma, order)
            for block, gamma, order in zip(fit.blocks, found, orders, strict=True)
        ]
        before, found = found, moments.autocovariances(moments.beyond(fit, information, tails))
        if np.allclose(np.concatenate(found), np.concatenate(before), rtol=SETTLED, atol=0):
            break
    return tuple(
        _error_process(block, slope, gamma[: order + 1])
        for block, slope, gamma, order in zip(
            fit.blocks, information.slopes, found, orders, strict=True
        )
    )


def _tail(block: FitBlock, autocovariance: Array, order: int) -> Array:
    """(T,) autocovariances at the lags beyond those given, zero up to there."""
    coefficients = _coefficients(block, autocovariance[: order + 1])
    tail = max(0.0, autocovariance[0]) * autocorrelation(coefficients, len(block.t_s))
    tail[: len(autocovariance)] = 0.0
    return tail


def _coefficients(block: FitBlock, autocovariance: Array) -> Array:
    """Of the autoregression of the errors."""
    residual, _, present = block.channels
    channels = _effective_channels(_among_channels(residual, present))
    return autoregression(autocovariance, _samples(present) * channels)


def _samples(present: NDArray[np.bool_]) -> float:
    """Mean number of samples of the channels that have any."""
    return float(present.sum() / max(1, present.any(axis=0).sum()))


def _error_process(block: FitBlock, slope: Array, autocovariance: Array) -> ErrorProcess:
    residual, _, present = block.channels
    measured = present.any(axis=0)
    raw_variance = float(np.sum(residual**2)) / max(1, present.sum())
    if not autocovariance[0] > 0:  # the fit leaves too little to be corrected
        autocovariance = np.array([raw_variance])
    coefficients = _coefficients(block, autocovariance)
    along = autocorrelation(coefficients, len(residual))
    innovation, known = _innovations(residual, present, coefficients)
    channels = _among_channels(innovation, known)
    weight = present.sum(axis=0)
    if not weight @ np.diag(channels) > 0:  # no run of samples is long enough
        channels, known = _among_channels(residual, present), present
    level = weight @ np.diag(channels)
    channels *= autocovariance[0] * weight.sum() / level if level > 0 else 0.0
    fitted = float(np.sum(slope**2))
    memory = 1 + 2 * float(np.sum(along[1:] ** 2))
    independent = _samples(present) * _effective_channels(channels)
    return ErrorProcess(
        along_time=along,
        among_channels=channels,
        order=len(coefficients),
        samples=max(1.0, (known.sum() - fitted) / max(1, measured.sum())),
        degrees_of_freedom=max(1.0, (independent - fitted) / memory),
    )


def _effective_channels(covariance: Array) -> float:
    """Number of equal independent channels whose mean variance is known as well."""
    squares = float(np.sum(covariance**2))
    return float(np.trace(covariance)) ** 2 / squares if squares > 0 else 1.0


def score_covariance(
    information: Information, processes: tuple[ErrorProcess, ...], shared: int
) -> tuple[Array, Array]:
    """LᵀB L (r, r), and the degrees of freedom of the shared parameters' variances (shared,).

    The latter after Satterthwaite (1946), with a Wishart matrix for Σ; priors are exact.
    """
    directions = information.fit.root[:shared].T
    total = information.prior.copy()
    doubt = np.zeros(directions.shape[1])
    for slope, process in zip(information.slopes, processes, strict=True):
        width = slope.shape[2]
        smoothed = along_time(process.along_time, slope)
        mixed = np.einsum("cd,tdr->tcr", process.among_channels, smoothed)
        part = slope.reshape(-1, width).T @ mixed.reshape(-1, width)
        total += (part + part.T) / 2
        for k, direction in enumerate(directions.T):
            by_time = slope @ direction
            share = process.among_channels @ (by_time.T @ along_time(process.along_time, by_time))
            variance, spread = np.trace(share), np.sum(share * share.T)
            if spread > 0:
                freedom = process.samples * variance**2 / spread
                doubt[k] += variance**2 / min(freedom, process.degrees_of_freedom)
    variances = np.sum((directions.T @ total) * directions.T, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = np.where(doubt > 0, variances**2 / doubt, np.inf)
    return total, np.maximum(freedom, 1.0)


def _innovations(
    residual: Array, present: NDArray[np.bool_], coefficients: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """What the past does not predict, (T − order, 3M), zero where a sample it needs is missing."""
    order = len(coefficients)
    innovation, known = residual[order:].copy(), present[order:].copy()
    for k, coefficient in enumerate(coefficients, start=1):
        past = slice(order - k, len(residual) - k)
        innovation -= coefficient * residual[past]
        known &= present[past]
    return innovation * known, known


def _among_channels(residual: Array, present: NDArray[np.bool_]) -> Array:
    """Covariance of channels (3M, 3M) over the samples both have."""
    counts = present.T.astype(float) @ present
    found = residual.T @ residual / np.maximum(counts, 1)
    if present.all():
        return found
    # Pairs with different gaps can give a matrix that is no covariance.
    values, vectors = np.linalg.eigh(found)
    return (vectors * np.maximum(values, 0)) @ vectors.T
