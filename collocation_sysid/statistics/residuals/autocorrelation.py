"""Correlated errors: persistence from sample to sample, and errors that markers have in common.

Noise of a camera is nearly white; model errors are not. Least squares remains consistent, but the
covariance of the parameters is the sandwich A⁻¹ B A⁻¹ with B the covariance of the score Sᵀe, which
depends on the correlation of the errors e. In every experiment separately,

    Cov(e_{t,c}, e_{s,d}) = Σ_{c,d} ρ_{|t−s|}

with the autocorrelation ρ of one autoregressive process and the covariance Σ among the channels
(marker and axis). The residuals of a fit are smaller and less persistent than the errors, which is
corrected for. The order minimises Schwarz's criterion. Σ is estimated from the innovations, which
are nearly independent in time.

Compared with it on simulated fits (tests/truths/test_error_coverage.py), a kernel estimate of B
from the scores of each time (Andrews 1991, prewhitened) covers 83–90 % where 95 % is nominal, and
one without the correction of the residuals or without Σ fails for short records and shared errors.

Autocovariances are estimated from lagged products of the residuals r = M e with M = I − S A⁻¹ Sᵀ =
I − D Dᵀ (see `linearised`). The lagged products r D_k r have the expectations Σ_l γ_l tr(D_k M D_l
M), linear in the autocovariances γ (Worsley et al. 2002, "A general statistical analysis for fMRI
data", NeuroImage 15, there for one series); D_k has ones on both k-th diagonals of each channel. A
few lags are solved for. Longer lags do not enter these equations but contribute to the products,
because a marker's offset absorbs the mean of its errors; they follow from the autoregression, in a
few iterations.

Errors of a camera due to lens, model or neighbouring pixels are similar in neighbouring patches of the
surface. Their covariance is modelled as

    Cov(e_i, e_j) = s² ((1 − a) δ_ij + a exp(−d_ij / ℓ)),

with distances d_ij on the undeformed body. a, ℓ and s maximise the likelihood of the residuals in
directions that the parameters do not affect (restricted maximum likelihood; Patterson and Thompson
1971).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matmul_toeplitz

from ...common.array_types import Array
from ..distributions import chi2_sf, normal_isf
from ..linearised import Information, LinearisedFit, ResidualBlock
from ..thresholds import PERSISTENT
from .noise_level import ROUNDING

Mask = NDArray[np.bool_]

# Largest partial autocorrelation, so that the process is stationary.
LARGEST_PARTIAL = 0.99


@dataclass(frozen=True, eq=False)
class LaggedProducts:
    """Lagged products of the residuals for lags 0 … `lags`, one experiment after another."""

    lags: tuple[int, ...]  # (experiments,) tuple of int: last lag of each experiment
    products: Array  # (K,): r D_k r
    expected: Array  # (K, K): tr(D_k M D_l M)
    shifted: Array  # (K, r, r): Dᵀ D_k D

    def split(self, values: Array) -> list[Array]:
        """Split values (K,) by experiment, into arrays (lag + 1,)."""
        ends = np.cumsum([last + 1 for last in self.lags])
        return np.split(values, ends[:-1])

    def autocovariances(self, beyond: Array | float = 0.0) -> list[Array]:
        """Return the autocovariances γ_0 … of each experiment, (lag + 1,).

        Parameters
        ----------
        beyond : (K,) array or 0
            Contribution of longer lags to the products, which is subtracted.

        Notes
        -----
        γ are the least-squares solution of expected γ = products − beyond, for all experiments
        together.
        """
        solution = np.linalg.lstsq(self.expected, self.products - beyond)[0]
        return self.split(solution.astype(np.float64))

    def long_lag_products(
        self, fit: LinearisedFit, information: Information, tails: Sequence[Array]
    ) -> Array:
        """Return the contribution (K,) of autocovariances at longer lags to the products; zero if
        all are zero.

        It is tr(D_k M C M) with their Toeplitz matrix C, whose k-th diagonals are zero.

        Parameters
        ----------
        tails : sequence of (T,) arrays
            Autocovariances of each experiment by lag, zero at the lags in `lags`.
        """
        if not any(tail.any() for tail in tails):
            return np.zeros_like(self.products)
        overlap = []
        total = np.zeros(self.shifted.shape[1:])
        for block, slope, last, tail in zip(
            fit.blocks, information.scaled_jacobians, self.lags, tails, strict=True
        ):
            smoothed = toeplitz_product(tail, slope) * block.channels.is_measured[:, :, None]
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
    """Return the lagged products of each experiment's residuals, and their expectations.

    Parameters
    ----------
    lags : sequence of int
        Last lag of each experiment.
    """
    products = []
    shifted = []
    diagonal_counts = []
    overlaps = []
    for block, slope, last in zip(fit.blocks, information.scaled_jacobians, lags, strict=True):
        residual = block.channels.residual
        present = block.channels.is_measured
        width = slope.shape[2]
        within = np.zeros((last + 1, width, width))
        overlap = np.zeros((last + 1, last + 1))
        for channel in range(residual.shape[1]):  # one at a time: all lags at once are large
            is_present = present[:, channel]
            lagged = [_lagged(slope[:, channel], is_present, lag=k) for k in range(last + 1)]
            stacked = np.stack([each.ravel() for each in lagged])
            overlap += stacked @ stacked.T
            for k, each in enumerate(lagged):
                within[k] += slope[:, channel].T @ each
        for k in range(last + 1):
            twice = 1 if k == 0 else 2
            lagged_rows = slice(k, None)
            behind = slice(None, len(residual) - k)
            products.append(twice * np.sum(residual[lagged_rows] * residual[behind]))
            diagonal_counts.append(twice * np.sum(present[lagged_rows] & present[behind]))
        shifted.append(within)
        overlaps.append(overlap)
    shifted = np.concatenate(shifted)
    rows = shifted.reshape(len(shifted), -1)
    expected = rows @ rows.T + np.diag(np.array(diagonal_counts, dtype=float))
    first = 0
    for overlap in overlaps:
        within = slice(first, first := first + len(overlap))
        expected[within, within] -= 2 * overlap
    return LaggedProducts(tuple(lags), np.array(products), expected=expected, shifted=shifted)


def toeplitz_product(autocorrelation: Array, values: Array) -> Array:
    """Return the product of the symmetric Toeplitz matrix of an autocorrelation by lag (T,) with
    values (T, …), along their first axis.
    """
    columns = values.reshape(len(values), -1)
    product = np.asarray(matmul_toeplitz(autocorrelation, columns), dtype=np.float64)
    return product.reshape(values.shape)


def _lagged(columns: Array, is_present: Mask, lag: int) -> Array:
    """Return D_k columns, D_k symmetric with ones at lag k, zero at samples not present."""
    if lag == 0:
        return columns
    shifted = np.zeros_like(columns)
    shifted[lag:] += columns[:-lag]
    shifted[:-lag] += columns[lag:]
    return shifted * is_present[:, None]


# Autoregression -----------------------------------------------------------------------------


def fit_autoregression(autocovariance: Array, samples: float) -> Array:
    """Return the coefficients of the autoregression with the least Schwarz criterion, by Levinson's
    recursion.

    Parameters
    ----------
    autocovariance : (lags + 1,) array
        Autocovariances; the largest order is `lags`.
    samples : float
        Number of independent samples.

    Returns
    -------
    (order,) array
        Coefficients of x_t = Σ c_k x_{t−k} + noise, k from 1; empty for white noise, and if the
        variance is not positive. Partial autocorrelations are limited to ±`LARGEST_PARTIAL`, so
        that the process is stationary.
    """
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


def process_autocorrelation(coefficients: Array, samples: int) -> Array:
    """Return the autocorrelation by lag (samples,), beginning with 1, of an autoregressive process
    with coefficients (order,), from its Yule–Walker equations; white noise for order 0.
    """
    order = len(coefficients)
    correlation = np.zeros(samples + order)
    correlation[0] = 1.0
    if order:
        equations = np.eye(order)
        for k in range(1, order + 1):
            for j, coefficient in enumerate(coefficients, start=1):
                if k != j:
                    equations[k - 1, abs(k - j) - 1] -= coefficient
        correlation[1 : order + 1] = np.linalg.solve(equations, coefficients)
        for k in range(order + 1, samples):
            correlation[k] = coefficients @ correlation[k - order : k][::-1]
    return correlation[:samples]


# Largest order of the autoregression.
MAX_ORDER = 4
# Samples per coefficient of the autoregression.
SAMPLES_PER_ORDER = 10
# Iterations between the autocovariances at few and at longer lags.
ROUNDS = 4
# Relative change that ends these iterations; smaller ones do not show in error bars.
SETTLED = 0.01
# Level of the tests for correlation.
SIGNIFICANCE = 0.01
# Autocorrelation that changes error bars by less than 5 %, significant or not.
NOTICEABLE = 0.05


@dataclass(frozen=True)
class Dependence:
    """Tests of the errors of a fit for correlation."""

    # Autocorrelation of consecutive samples, pooled over all channels and corrected for the effect
    # of the fit on the residuals.
    lag1: float
    # Its standard deviation for independent errors; infinite if it is unknown.
    lag1_deviation: float
    shared_p: float  # p-value of the correlations among channels, for independent errors
    # p-value of the correlations of neighbours on the surface, after Bonferroni, so that it may
    # exceed 1; 1 if nothing is tested.
    space_p: float = 1.0

    def is_correlated_in_time(self) -> bool:
        """Return whether the absolute `lag1` is significant at the level `SIGNIFICANCE` and above
        `NOTICEABLE`; false if its deviation is infinite.
        """
        limit = float(normal_isf(SIGNIFICANCE / 2)) * self.lag1_deviation
        return abs(self.lag1) > max(limit, NOTICEABLE)

    def is_slightly_correlated_in_time(self) -> bool:
        """Return whether `is_correlated_in_time` holds with an absolute `lag1` up to `PERSISTENT`,
        which does not change the verdict.
        """
        return self.is_correlated_in_time() and abs(self.lag1) <= PERSISTENT

    def is_correlated_in_space(self) -> bool:
        """Return whether errors of neighbours on the surface are correlated: `space_p` below
        `SIGNIFICANCE`.
        """
        return self.space_p < SIGNIFICANCE

    def is_correlated(self) -> bool:
        """Return whether the errors are correlated in any of these ways."""
        return (
            self.is_correlated_in_time()
            or self.shared_p < SIGNIFICANCE
            or self.is_correlated_in_space()
        )


@dataclass(frozen=True, eq=False)
class ErrorProcess:
    """Correlation model of the errors of one experiment, in units of σ."""

    autocorrelation: Array  # (T,): autocorrelation by lag; the first is one
    channel_covariance: Array  # (3M, 3M): covariance at one time
    order: int  # order of the autoregression
    # Number of independent samples in time that `channel_covariance` is estimated from.
    samples: float
    degrees_of_freedom: float  # degrees of freedom of the mean variance


def analyse_dependence(fit: LinearisedFit, information: Information) -> Dependence:
    """Test the residuals of a fit for correlation in time, among channels and in space.

    Residuals at the level of rounding count as uncorrelated. Blocks with a floor of noise are not
    tested in space.

    Notes
    -----
    Without consecutive samples `lag1` is 0 with an infinite deviation. Huber's weights are those of
    the residuals of the fit.
    """
    if fit.chi_squared <= ROUNDING**2 * fit.measurement_count:
        return Dependence(0.0, np.inf, shared_p=1.0)
    pairs = zip(fit.blocks, information.scaled_jacobians, strict=True)
    tested = (each for each in pairs if not each[0].has_noise_floor)
    over_space = [found for each in tested if (found := estimate_spatial_correlation(*each))]
    space_p = min((len(over_space) * p_value for _, p_value, _ in over_space), default=1.0)
    moments = lagged_products(fit, information, lags=[1] * len(fit.blocks))
    # Rows and columns: variance and lag one, pooled over the experiments.
    pool = np.tile(np.eye(2), len(fit.blocks))
    products = pool @ moments.products
    expected = pool @ moments.expected @ pool.T
    if not expected[1, 1] > 0:  # nothing follows on anything
        return Dependence(0.0, np.inf, shared_p=_channel_correlation_p(fit), space_p=space_p)
    variance = products[0] / expected[0, 0]
    lag1_variance = (products[1] - variance * expected[1, 0]) / expected[1, 1]
    return Dependence(
        lag1=float(np.clip(lag1_variance / variance, -1.0, 1.0)),  # corrected, it may be beyond
        lag1_deviation=float(np.sqrt(2 / expected[1, 1])),
        shared_p=_channel_correlation_p(fit),
        space_p=space_p,
    )


def _channel_correlation_p(fit: LinearisedFit) -> float:
    """Return the p-value of Breusch and Pagan (1980) for pairs of channels; 1 without."""
    statistic = 0.0
    pairs = 0
    for block in fit.blocks:
        residual = block.channels.residual
        present = block.channels.is_measured
        counts = present.T.astype(float) @ present
        of_channel = np.sqrt(np.sum(residual**2, axis=0) / np.maximum(np.diag(counts), 1))
        scaled = residual / np.where(of_channel > 0, of_channel, np.inf)
        used = np.triu(counts > 2, 1)
        correlation = (scaled.T @ scaled)[used] / counts[used]
        statistic += float(np.sum((counts[used] - 1) * correlation**2))
        pairs += int(used.sum())
    return float(chi2_sf(statistic, pairs)) if pairs else 1.0


def error_processes(fit: LinearisedFit, information: Information) -> tuple[ErrorProcess, ...]:
    """Estimate the error process of each block of a fit, in their order.

    The order of the autoregression is at most `MAX_ORDER`, and one per `SAMPLES_PER_ORDER` samples.
    Autocovariances at few and at longer lags are computed in turn, `ROUNDS` times or until they
    change by less than `SETTLED`.
    """
    orders = [min(MAX_ORDER, len(block.t_s) // SAMPLES_PER_ORDER) for block in fit.blocks]
    moments = lagged_products(fit, information, lags=[max(1, order) for order in orders])
    autocovariances = moments.autocovariances()
    for _ in range(ROUNDS):
        tails = [
            _long_lag_autocovariances(block, gamma, order=order)
            for block, gamma, order in zip(fit.blocks, autocovariances, orders, strict=True)
        ]
        before, autocovariances = (
            autocovariances,
            moments.autocovariances(moments.long_lag_products(fit, information, tails=tails)),
        )
        if np.allclose(
            np.concatenate(autocovariances), np.concatenate(before), rtol=SETTLED, atol=0
        ):
            break
    return tuple(
        _error_process(block, slope, autocovariance=gamma[: order + 1])
        for block, slope, gamma, order in zip(
            fit.blocks, information.scaled_jacobians, autocovariances, orders, strict=True
        )
    )


def _long_lag_autocovariances(block: ResidualBlock, autocovariance: Array, order: int) -> Array:
    """Return autocovariances (T,) by an autoregression beyond given lags, zero before."""
    coefficients = _autoregression_of(block, autocovariance[: order + 1])
    tail = max(0.0, autocovariance[0]) * process_autocorrelation(coefficients, len(block.t_s))
    tail[: len(autocovariance)] = 0.0
    return tail


def _autoregression_of(block: ResidualBlock, autocovariance: Array) -> Array:
    """Return the autoregression of a block's errors from autocovariances (order + 1,)."""
    residual = block.channels.residual
    present = block.channels.is_measured
    channels = _effective_channels(_channel_covariance(residual, present))
    return fit_autoregression(autocovariance, _mean_sample_count(present) * channels)


def _mean_sample_count(present: NDArray[np.bool_]) -> float:
    """Return the mean over channels that have any samples; `present` (T, 3M)."""
    return float(present.sum() / max(1, present.any(axis=0).sum()))


def _error_process(block: ResidualBlock, slope: Array, autocovariance: Array) -> ErrorProcess:
    """Return the error process of one block.

    If samples are not more than channels, the covariance among channels is that of
    `estimate_spatial_correlation` if there is one; with a floor of noise it is at least that of
    independent errors of the stated σ.
    """
    residual = block.channels.residual
    present = block.channels.is_measured
    over_space = estimate_spatial_correlation(block, slope)
    measured = present.any(axis=0)
    raw_variance = float(np.sum(residual**2)) / max(1, present.sum())
    if not autocovariance[0] > 0:  # the fit leaves too little to be corrected
        autocovariance = np.array([raw_variance])
    coefficients = _autoregression_of(block, autocovariance)
    correlation = process_autocorrelation(coefficients, len(residual))
    innovation, known = _innovations(residual, present, coefficients=coefficients)
    channels = _channel_covariance(innovation, known)
    weight = present.sum(axis=0)
    if not weight @ np.diag(channels) > 0:  # no run of samples is long enough
        channels = _channel_covariance(residual, present)
        known = present
    level = weight @ np.diag(channels)
    channels *= autocovariance[0] * weight.sum() / level if level > 0 else 0.0
    if over_space is not None and len(residual) <= residual.shape[1]:
        # Samples are too few to tell a covariance by themselves.
        covariance, _, freedom = over_space
        freedom *= len(residual)
        if block.has_noise_floor and np.trace(covariance) < len(covariance):
            covariance = np.eye(len(covariance))
            freedom = np.inf
        return ErrorProcess(
            autocorrelation=correlation,
            channel_covariance=covariance,
            order=len(coefficients),
            samples=np.inf,
            degrees_of_freedom=freedom,
        )
    fitted = float(np.sum(slope**2))
    memory = 1 + 2 * float(np.sum(correlation[1:] ** 2))
    independent = _mean_sample_count(present) * _effective_channels(channels)
    return ErrorProcess(
        autocorrelation=correlation,
        channel_covariance=channels,
        order=len(coefficients),
        samples=max(1.0, (known.sum() - fitted) / max(1, measured.sum())),
        degrees_of_freedom=max(1.0, (independent - fitted) / memory),
    )


def _effective_channels(covariance: Array) -> float:
    """Return (tr Σ)² / tr Σ², the equal independent channels of Σ (c, c); 1 for zero."""
    squares = float(np.sum(covariance**2))
    return float(np.trace(covariance)) ** 2 / squares if squares > 0 else 1.0


def score_covariance(
    information: Information, processes: tuple[ErrorProcess, ...], shared: int
) -> tuple[Array, Array]:
    """Return the covariance of the score for correlated errors.

    Parameters
    ----------
    shared : int
        Number of shared parameters.

    Returns
    -------
    ((r, r) array, (shared,) array)
        LᵀB L, and degrees of freedom of the variances of shared parameters after Satterthwaite
        (1946), with a Wishart distribution for Σ and exact priors.
    """
    directions = information.fit.root[:shared].T
    total = information.prior.copy()
    variance_of_variance = np.zeros(directions.shape[1])
    for slope, process in zip(information.scaled_jacobians, processes, strict=True):
        shape = slope.shape[0] * slope.shape[1], slope.shape[2]
        smoothed = toeplitz_product(process.autocorrelation, slope)
        mixed = np.einsum("cd,tdr->tcr", process.channel_covariance, smoothed)
        part = slope.reshape(shape).T @ mixed.reshape(shape)
        total += (part + part.T) / 2
        for k, direction in enumerate(directions.T):
            by_time = slope @ direction
            share = process.channel_covariance @ (
                by_time.T @ toeplitz_product(process.autocorrelation, by_time)
            )
            variance = np.trace(share)
            spread = np.sum(share * share.T)
            if spread > 0:
                freedom = process.samples * variance**2 / spread
                variance_of_variance[k] += variance**2 / min(freedom, process.degrees_of_freedom)
    variances = np.sum((directions.T @ total) * directions.T, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        freedom = np.where(variance_of_variance > 0, variances**2 / variance_of_variance, np.inf)
    return total, np.maximum(freedom, 1.0)


def _innovations(
    residual: Array, present: NDArray[np.bool_], coefficients: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the part of the residuals that earlier samples do not predict, and where it is known."""
    order = len(coefficients)
    innovation = residual[order:].copy()
    is_known = present[order:].copy()
    for k, coefficient in enumerate(coefficients, start=1):
        past = slice(order - k, len(residual) - k)
        innovation -= coefficient * residual[past]
        is_known &= present[past]
    return innovation * is_known, is_known


def _channel_covariance(residual: Array, present: NDArray[np.bool_]) -> Array:
    """Return the covariance (3M, 3M) of channels about zero, over samples that both channels have.

    It is made positive semidefinite if samples are missing, and zero for a pair without a common
    sample before that.
    """
    counts = present.T.astype(float) @ present
    covariance = residual.T @ residual / np.maximum(counts, 1)
    if present.all():
        return covariance
    # Pairs with different gaps can give a matrix that is no covariance.
    values, vectors = np.linalg.eigh(covariance)
    return (vectors * np.maximum(values, 0)) @ vectors.T


# Correlated shares a that are tried.
SHARES = (0.25, 0.5, 0.75, 0.95)
# Number of correlation lengths that are tried.
LENGTHS = 10
# Longest correlation length over the extent of the body.
LONGEST = 0.5
# Directions in which the data determine more than this share of a parameter are left out.
LEAST_CORRELATION = 0.1
# Largest number of images that are used.
MOST_SAMPLES = 20


def estimate_spatial_correlation(
    block: ResidualBlock, slope: Array
) -> tuple[Array, float, float] | None:
    """Estimate the spatial correlation of the errors of a sample of a block.

    Parameters
    ----------
    slope : (T, n, r) array
        Its D = S L, see `linearised`.

    Returns
    -------
    (covariance, p_value, freedom) or None
        Covariance (n, n) of its channels in units of σ², p-value of the likelihood ratio for
        independent errors, degrees of freedom of the variance. None if the block has no places, no
        samples, or too few points in each.

    Notes
    -----
    At most `MOST_SAMPLES` samples are used. The result is the best of `SHARES` and `LENGTHS`
    lengths, also where independent errors would be as likely; then the p-value is 1. The covariance
    is that of all n channels.
    """
    residual = block.channels.residual
    present = block.channels.is_measured
    if block.places_m is None or not present.any():
        return None
    distances_m = np.linalg.norm(block.places_m[:, None] - block.places_m, axis=2)
    contrasts: list[tuple[Array, Array, Array]] = []
    samples = np.unique(np.linspace(0, len(residual) - 1, MOST_SAMPLES).astype(int))
    for t in samples:
        present_channels = np.flatnonzero(present[t])
        directions, singular_values, _ = np.linalg.svd(slope[t, present_channels])
        free = directions[
            :,
            np.concatenate(
                [singular_values, np.zeros(len(present_channels) - len(singular_values))]
            )
            < LEAST_CORRELATION,
        ]
        if free.shape[1] > 2:
            contrasts.append(
                (
                    free.T @ residual[t, present_channels],
                    free,
                    distances_m[np.ix_(present_channels, present_channels)],
                )
            )
    if not contrasts:
        return None
    count = sum(len(values) for values, *_ in contrasts)
    nearest = float(np.median(np.where(distances_m > 0, distances_m, np.inf).min(axis=1)))
    longest = max(LONGEST * float(distances_m.max()), 2 * nearest)
    white, _ = _restricted_likelihood(contrasts, 0.0, length_m=1.0)
    candidates = [
        (*_restricted_likelihood(contrasts, share, length_m=length), share, length)
        for share in SHARES
        for length in np.geomspace(nearest / 2, longest, LENGTHS)
    ]
    least, level, share, length = min(candidates)
    p = float(chi2_sf(max(0.0, white - least), 2))
    shape = _correlation_matrix(distances_m, share, length_m=float(length))
    share_known = count / max(1, sum(len(matrix) for _, matrix, _ in contrasts))
    freedom = max(
        1.0, len(contrasts) * share_known * np.trace(shape) ** 2 / float(np.sum(shape**2))
    )
    return level * shape, p, freedom


def _correlation_matrix(distances_m: Array, share: float, length_m: float) -> Array:
    """Return the correlation matrix (n, n) of distances `distances_m` (n, n) for a share a and a
    length [m].
    """
    return (1 - share) * np.eye(len(distances_m)) + share * np.exp(-distances_m / length_m)


def _restricted_likelihood(
    contrasts: list[tuple[Array, Array, Array]], share: float, length_m: float
) -> tuple[float, float]:
    """Return −2 log-likelihood up to a constant, and the variance s² that maximises the likelihood.

    Contrasts are combinations (k,) of the residuals of one sample, in units of σ, that the
    parameters do not affect, the orthonormal columns (n, k) that form them from n channels, and the
    distances (n, n) of the channels' points on the undeformed body [m].
    """
    squares = 0.0
    logarithms = 0.0
    count = 0
    for values, matrix, distances_m in contrasts:
        correlation = _correlation_matrix(distances_m, share, length_m=length_m)
        root = np.linalg.cholesky(matrix.T @ correlation @ matrix)
        squares += float(np.sum(np.linalg.solve(root, values) ** 2))
        logarithms += 2 * float(np.log(np.diag(root)).sum())
        count += len(values)
    variance = max(squares / count, 1e-300)
    return count * float(np.log(variance)) + logarithms, variance
