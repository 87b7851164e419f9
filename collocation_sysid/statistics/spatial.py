"""Errors of a depth camera that hang together over the surface.

What its noise, its lens or the model leave is alike in neighbouring patches of the surface. Their
covariance is taken as

    Cov(e_i, e_j) = s² ((1 − a) δ_ij + a exp(−d_ij / ℓ)),

d_ij being distances on the undeformed body. What parameters took out of the residuals tells
nothing: a, ℓ and s are those of the largest likelihood of what is left across their slopes
(restricted maximum likelihood; Patterson and Thompson 1971).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from .distributions import chi2_sf
from .linearised import FitBlock

# What is looked for: shares, and lengths between that of a patch and this share of the body.
SHARES = (0.25, 0.5, 0.75, 0.95)
LENGTHS = 10
LONGEST = 0.5
# A direction of which the data tell more than this share has taken its part of the residuals.
TAKEN = 0.1
MOST_SAMPLES = 20


@dataclass(frozen=True, eq=False)
class SpatialErrors:
    """How the errors of one sample of a block hang together.

    Attributes
    ----------
    covariance : (n, n) of its channels, in units of σ²
    length_m : float
    p : float
        Probability of residuals as much alike, if errors are independent.
    freedom : float
        Degrees of freedom of the variance.
    """

    covariance: Array
    length_m: float
    p: float
    freedom: float


def spatial_errors(block: FitBlock, slope: Array) -> SpatialErrors | None:
    """Those of a block with places and slopes (T, n, r) in units of what is known; or None."""
    residual, _, present = block.channels
    if block.places_m is None or not present.any():
        return None
    apart = np.linalg.norm(block.places_m[:, None] - block.places_m, axis=2)
    left = []
    samples = np.unique(np.linspace(0, len(residual) - 1, MOST_SAMPLES).astype(int))
    for t in samples:
        here = np.flatnonzero(present[t])
        directions, taken, _ = np.linalg.svd(slope[t, here])
        free = directions[:, np.concatenate([taken, np.zeros(len(here) - len(taken))]) < TAKEN]
        if free.shape[1] > 2:
            left.append((free.T @ residual[t, here], free, apart[np.ix_(here, here)]))
    if not left:
        return None
    count = sum(len(z) for z, _, _ in left)
    nearest = float(np.median(np.where(apart > 0, apart, np.inf).min(axis=1)))
    longest = max(LONGEST * float(apart.max()), 2 * nearest)
    white, _ = _misfit(left, 0.0, 1.0)
    tried = [
        (*_misfit(left, share, length), share, length)
        for share in SHARES
        for length in np.geomspace(nearest / 2, longest, LENGTHS)
    ]
    least, level, share, length = min(tried)
    p = float(chi2_sf(max(0.0, white - least), 2))
    shape = _shape(apart, share, float(length))
    share_known = count / max(1, sum(len(f) for _, f, _ in left))
    freedom = max(1.0, len(left) * share_known * np.trace(shape) ** 2 / float(np.sum(shape**2)))
    return SpatialErrors(level * shape, float(length), p, freedom)


def _shape(apart: Array, share: float, length_m: float) -> Array:
    return (1 - share) * np.eye(len(apart)) + share * np.exp(-apart / length_m)


def _misfit(
    left: list[tuple[Array, Array, Array]], share: float, length_m: float
) -> tuple[float, float]:
    """−2 log-likelihood, up to a constant, and the variance that is most likely."""
    squares = 0.0
    logarithms = 0.0
    count = 0
    for z, free, apart in left:
        root = np.linalg.cholesky(free.T @ _shape(apart, share, length_m) @ free)
        squares += float(np.sum(np.linalg.solve(root, z) ** 2))
        logarithms += 2 * float(np.log(np.diag(root)).sum())
        count += len(z)
    variance = max(squares / count, 1e-300)
    return count * float(np.log(variance)) + logarithms, variance
