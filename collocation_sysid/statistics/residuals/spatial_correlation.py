"""Errors of a camera that are correlated over the surface.

Errors due to lens, model or neighbouring pixels are similar in neighbouring patches of the surface.
Their covariance is modelled as

    Cov(e_i, e_j) = s² ((1 − a) δ_ij + a exp(−d_ij / ℓ)),

with distances d_ij on the undeformed body. a, ℓ and s maximise the likelihood of the residuals in
directions that the parameters do not affect (restricted maximum likelihood; Patterson and Thompson
1971).
"""

from __future__ import annotations

import numpy as np

from ...common.array_types import Array
from ..distributions import chi2_sf
from ..linearised import ResidualBlock

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
