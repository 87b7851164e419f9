"""Autocovariances of a fit's errors, found from the lagged products of its residuals.

The residuals are r = M e, M = I − S A⁻¹ Sᵀ = I − D Dᵀ (see `information`): smaller than the errors
e and less persistent. Their lagged products r D_k r have the expectations Σ_l γ_l tr(D_k M D_l M),
linear in the autocovariances γ (Worsley et al. 2002, "A general statistical analysis for fMRI
data", NeuroImage 15, there for one series), with D_k the matrix that has ones on both k-th
diagonals of each channel, marker and axis. A few lags are solved for. Those beyond have no place
in the equations but in the products: a marker's offset takes the mean of its errors away, to which
all lags contribute. They follow from an autoregression on the lags found, in a few rounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matmul_toeplitz

from ..arrays import Array
from .information import Information
from .linearised import LinearisedFit

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
        overlap, total = [], np.zeros(self.shifted.shape[1:])
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
    products, shifted, own, overlaps = [], [], [], []
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
            ahead, behind = slice(k, None), slice(None, len(residual) - k)
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
    coefficients, innovation = np.zeros(0), autocovariance[0]
    if not innovation > 0:
        return coefficients
    best, least = coefficients, samples * np.log(innovation)
    for order in range(1, len(autocovariance)):
        remainder = autocovariance[order] - coefficients @ autocovariance[1:order][::-1]
        partial = np.clip(remainder / innovation, -LARGEST_PARTIAL, LARGEST_PARTIAL)
        coefficients = np.append(coefficients - partial * coefficients[::-1], partial)
        innovation *= 1 - partial**2
        criterion = samples * np.log(innovation) + order * np.log(max(samples, 2.0))
        if criterion < least:
            best, least = coefficients, criterion
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
