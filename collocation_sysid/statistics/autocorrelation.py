"""Errors that persist from sample to sample and are shared among markers.

Noise of a camera is nearly white; what a model misses is not. Least squares still finds the
parameters, but their covariance is the sandwich A⁻¹ B A⁻¹ with B the covariance of the score Sᵀe,
and B depends on how the errors e hang together. Here, in every experiment on its own,

    Cov(e_{t,c}, e_{s,d}) = Σ_{c,d} ρ_{|t−s|}

with ρ of one autoregressive process and Σ among the channels (marker and axis). The residuals of
a fit are smaller and less persistent than the errors, which is corrected for. The
order minimises Schwarz's criterion. Σ is that of the innovations, which are nearly independent in
time.

Compared with it on simulated fits (tests/test_error_coverage.py), a kernel estimate of B from
the scores of each time (Andrews 1991, prewhitened) covers 83–90 % where 95 % is meant, and one
without the correction of the residuals or without Σ fails for short records and shared errors.

Autocovariances are found from the lagged products of the residuals, which are r = M e with M = I −
S A⁻¹ Sᵀ = I − D Dᵀ (see `linearised`): smaller than the errors e. Their lagged products r D_k r
have the expectations Σ_l γ_l tr(D_k M D_l M), linear in the autocovariances γ (Worsley et al. 2002,
"A general statistical analysis for fMRI data", NeuroImage 15, there for one series), with D_k the
matrix that has ones on both k-th diagonals of each channel, marker and axis. A few lags are solved
for. Those beyond have no place in the equations but in the products: a marker's offset takes the
mean of its errors away, to which all lags contribute. They follow from an autoregression on the
lags found, in a few rounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matmul_toeplitz

from ..arrays import Array
from .distributions import chi2_sf, normal_isf
from .linearised import FitBlock, Information, LinearisedFit
from .noise import ROUNDING
from .spatial import spatial_errors

Mask = NDArray[np.bool_]

# Partial autocorrelations beyond this belong to a process that never forgets.
LARGEST_PARTIAL = 0.99


@dataclass(frozen=True, eq=False)
class LaggedProducts:
    """Lags 0 … `lags` of each experiment, one experiment after another.

    Attributes
    ----------
    lags : (experiments,) last lag of each
    products : (K,) r D_k r
    expected : (K, K) tr(D_k M D_l M)
    shifted : (K, r, r) Dᵀ D_k D
    """

    lags: tuple[int, ...]
    products: Array
    expected: Array
    shifted: Array

    def split(self, values: Array) -> list[Array]:
        """The values (K,) of each experiment."""
        ends = np.cumsum([last + 1 for last in self.lags])
        return np.split(values, ends[:-1])

    def autocovariances(self, beyond: Array | float = 0.0) -> list[Array]:
        """γ_0 … of each experiment, (lag + 1,), less what the lags beyond put into the products."""
        found = np.linalg.lstsq(self.expected, self.products - beyond)[0]
        return self.split(found.astype(np.float64))

    def beyond(self, fit: LinearisedFit, information: Information, tails: Sequence[Array]) -> Array:
        """(K,) what autocovariances of the lags beyond, (T,) each, put into the products.

        tr(D_k M C M) with their Toeplitz matrix C, whose k-th diagonals are zero.
        """
        if not any(tail.any() for tail in tails):
            return np.zeros_like(self.products)
        overlap = []
        total = np.zeros(self.shifted.shape[1:])
        for block, slope, last, tail in zip(
            fit.blocks, information.slopes, self.lags, tails, strict=True
        ):
            smoothed = along_time(tail, slope) * block.channels[2][:, :, None]
            total += np.einsum("tcr,tcs->rs", slope, smoothed, optimize=True)
            overlap += [
                np.vdot(slope[k:], smoothed[: len(slope) - k])
                + np.vdot(slope[: len(slope) - k], smoothed[k:])
                for k in range(last + 1)
            ]
            overlap[-last - 1] /= 2  # one diagonal, not two
        return np.einsum("krs,rs->k", self.shifted, total) - 2 * np.array(overlap)


def lagged_products(
    fit: LinearisedFit, information: Information, lags: Sequence[int]
) -> LaggedProducts:
    """The products of each experiment's residuals up to a lag, and what they are expected to be."""
    products = []
    shifted = []
    own = []
    overlaps = []
    for block, slope, last in zip(fit.blocks, information.slopes, lags, strict=True):
        residual, _, present = block.channels
        width = slope.shape[2]
        here = np.zeros((last + 1, width, width))
        overlap = np.zeros((last + 1, last + 1))
        for channel in range(residual.shape[1]):  # one at a time: all lags at once are large
            seen = present[:, channel]
            lagged = [_lagged(slope[:, channel], seen, k) for k in range(last + 1)]
            stacked = np.stack([each.ravel() for each in lagged])
            overlap += stacked @ stacked.T
            for k, each in enumerate(lagged):
                here[k] += slope[:, channel].T @ each
        for k in range(last + 1):
            twice = 1 if k == 0 else 2
            ahead = slice(k, None)
            behind = slice(None, len(residual) - k)
            products.append(twice * np.sum(residual[ahead] * residual[behind]))
            own.append(twice * np.sum(present[ahead] & present[behind]))
        shifted.append(here)
        overlaps.append(overlap)
    shifted = np.concatenate(shifted)
    rows = shifted.reshape(len(shifted), -1)
    expected = rows @ rows.T + np.diag(np.array(own, dtype=float))
    first = 0
    for overlap in overlaps:
        here = slice(first, first := first + len(overlap))
        expected[here, here] -= 2 * overlap
    return LaggedProducts(tuple(lags), np.array(products), expected, shifted)


def along_time(autocorrelation: Array, values: Array) -> Array:
    """The Toeplitz matrix of an autocorrelation (T,) times (T, …)."""
    columns = values.reshape(len(values), -1)
    found = np.asarray(matmul_toeplitz(autocorrelation, columns), dtype=np.float64)
    return found.reshape(values.shape)


def _lagged(columns: Array, seen: Mask, lag: int) -> Array:
    """D_k times the columns (T, r) of one channel, at its present samples."""
    if lag == 0:
        return columns
    found = np.zeros_like(columns)
    found[lag:] += columns[:-lag]
    found[:-lag] += columns[lag:]
    return found * seen[:, None]


# Autoregression -----------------------------------------------------------------------------


def autoregression(autocovariance: Array, samples: float) -> Array:
    """Coefficients of the order with the least Schwarz criterion, by Levinson's recursion."""
    coefficients = np.zeros(0)
    innovation = autocovariance[0]
    if not innovation > 0:
        return coefficients
    best = coefficients
    least = samples * np.log(innovation)
    for order in range(1, len(autocovariance)):
        remainder = autocovariance[order] - coefficients @ autocovariance[1:order][::-1]
        partial = np.clip(remainder / innovation, -LARGEST_PARTIAL, LARGEST_PARTIAL)
        coefficients = np.append(coefficients - partial * coefficients[::-1], partial)
        innovation *= 1 - partial**2
        criterion = samples * np.log(innovation) + order * np.log(max(samples, 2.0))
        if criterion < least:
            best = coefficients
            least = criterion
    return best


def autocorrelation(coefficients: Array, samples: int) -> Array:
    """(samples,) of the autoregressive process, from its Yule–Walker equations."""
    order = len(coefficients)
    found = np.zeros(samples + order)
    found[0] = 1.0
    if order:
        equations = np.eye(order)
        for k in range(1, order + 1):
            for j, coefficient in enumerate(coefficients, start=1):
                if k != j:
                    equations[k - 1, abs(k - j) - 1] -= coefficient
        found[1 : order + 1] = np.linalg.solve(equations, coefficients)
        for k in range(order + 1, samples):
            found[k] = coefficients @ found[k - order : k][::-1]
    return found[:samples]


MAX_ORDER = 4
# So many samples per coefficient of the autoregression.
SAMPLES_PER_ORDER = 10
# Of finding the autocovariances at the lags beyond from the few, and the few without those.
# They end when nothing changes by more than a share that no error bar shows.
ROUNDS = 4
SETTLED = 0.01
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
    space_p : float
        The same of neighbours on the surface.
    """

    lag1: float
    lag1_deviation: float
    shared_p: float
    space_p: float = 1.0

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
    def in_space(self) -> bool:
        """Errors that are near each other on the surface are alike."""
        return self.space_p < SIGNIFICANCE

    @property
    def found(self) -> bool:
        """The errors are not independent."""
        return self.in_time or self.among_channels or self.in_space


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
    pairs = zip(fit.blocks, information.slopes, strict=True)
    tested = (each for each in pairs if not each[0].noise_at_least_stated)
    over_space = [found for each in tested if (found := spatial_errors(*each))]
    space_p = min((len(over_space) * found.p for found in over_space), default=1.0)
    found = lagged_products(fit, information, [1] * len(fit.blocks))
    # Rows and columns: variance and lag one, pooled over the experiments.
    pool = np.tile(np.eye(2), len(fit.blocks))
    products = pool @ found.products
    expected = pool @ found.expected @ pool.T
    if not expected[1, 1] > 0:  # nothing follows on anything
        return Dependence(0.0, np.inf, _shared_p(fit), space_p)
    variance = products[0] / expected[0, 0]
    lag1_variance = (products[1] - variance * expected[1, 0]) / expected[1, 1]
    return Dependence(
        lag1=float(np.clip(lag1_variance / variance, -1.0, 1.0)),  # corrected, it may be beyond
        lag1_deviation=float(np.sqrt(2 / expected[1, 1])),
        shared_p=_shared_p(fit),
        space_p=space_p,
    )


def _shared_p(fit: LinearisedFit) -> float:
    """Lagrange-multiplier test of Breusch and Pagan (1980) on all pairs of channels."""
    statistic = 0.0
    pairs = 0
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
    over_space = spatial_errors(block, slope)
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
        channels = _among_channels(residual, present)
        known = present
    level = weight @ np.diag(channels)
    channels *= autocovariance[0] * weight.sum() / level if level > 0 else 0.0
    if over_space is not None and len(residual) <= residual.shape[1]:
        # Samples are too few to tell a covariance by themselves.
        covariance = over_space.covariance
        freedom = len(residual) * over_space.freedom
        if block.noise_at_least_stated and np.trace(covariance) < len(covariance):
            covariance = np.eye(len(covariance))
            freedom = np.inf
        samples = np.inf, freedom
        return ErrorProcess(along, covariance, len(coefficients), *samples)
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
        shape = slope.shape[0] * slope.shape[1], slope.shape[2]
        smoothed = along_time(process.along_time, slope)
        mixed = np.einsum("cd,tdr->tcr", process.among_channels, smoothed)
        part = slope.reshape(shape).T @ mixed.reshape(shape)
        total += (part + part.T) / 2
        for k, direction in enumerate(directions.T):
            by_time = slope @ direction
            share = process.among_channels @ (by_time.T @ along_time(process.along_time, by_time))
            variance = np.trace(share)
            spread = np.sum(share * share.T)
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
    innovation = residual[order:].copy()
    known = present[order:].copy()
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
