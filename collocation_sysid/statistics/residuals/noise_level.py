"""Size of the errors compared with the stated σ, for each marker; forces and torques count as
markers.

The residuals are r = M e + D Lᵀ Pᵀ e_P with M = I − D Dᵀ (see `linearised`) and e_P the errors of
the priors. If the errors of marker m have s_m² times the stated variance, its residuals have

    E Σ r_m² = Σ_n s_n² tr(M_mn M_nm) + tr(G_m LᵀPᵀP L) + expectation of other known errors,

with G_m = D_mᵀ D_m, which is solved for the s_n². Bartlett's test decides whether they differ, a χ²
test whether all of them are one. Other known errors are given by samples, such as those of
`pose_noise`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from ...common.array_types import Array
from ..distributions import chi2_cdf, chi2_sf
from ..linearised import Information, LinearisedFit, ResidualBlock

Noise = Literal["given", "estimated", "by-marker"]

# Residuals this small, in units of σ, are rounding.
ROUNDING = 1e-6
# Level of the test that residuals are larger than σ.
LARGER = 0.05
# Level of the test that residuals are smaller than σ.
SMALLER = 0.01
# Level of the test that markers differ.
UNEQUAL = 0.01
# A variance found below this share of the mean square of the residuals is chance.
LEAST_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class NoiseLevel:
    """Variances of the errors in units of σ²."""

    names: tuple[str, ...]  # (G,) tuple of str: markers that were measured, such as "swing/tip"
    variances: Array  # (G,): variance s_m² of each
    freedoms: Array  # (G,): degrees of freedom of each
    pooled: float  # variance s² if all are equal
    freedom: float  # degrees of freedom of all residuals
    # p-values of residuals as large, or as small, if σ is right.
    larger_p: float
    smaller_p: float
    unequal_p: float  # p-value of markers as different, if all are equal
    shares: Array = field(repr=False)  # (G, r, r): matrices G_m
    # (r, r): covariance of the score due to other known errors.
    known_score_covariance: Array = field(repr=False)
    sigma_key: str = "sigma_m"  # key of σ in the problem
    # mapping of str to str: key of σ of each series, by its name.
    sigma_keys: Mapping[str, str] = field(default_factory=dict)

    def is_unequal(self) -> bool:
        """Return whether markers differ more than by chance: `unequal_p` below `UNEQUAL`."""
        return self.unequal_p < UNEQUAL

    def suggest_noise(self) -> Noise:
        """Return the source of the variance that the residuals suggest: "by-marker" if markers are
        unequal, else "estimated" if the residuals are significantly larger (`LARGER`) or smaller
        than σ, else "given".
        """
        if self.is_unequal():
            return "by-marker"
        return "estimated" if self.larger_p < LARGER or self.smaller_p < SMALLER else "given"

    @cached_property
    def factors(self) -> dict[str, float]:
        """Standard deviation of the errors of each marker over σ, by the marker's name."""
        return dict(zip(self.names, np.sqrt(self.variances).tolist(), strict=True))

    @property
    def unevenness(self) -> float:
        """Factor by which unequal markers increase the standard deviation of a mean over
        all of them; 1 if they are equal.
        """
        if not self.is_unequal():
            return 1.0
        weights = self.variances * self.freedoms
        equal = weights.sum() ** 2 / self.freedoms.sum()
        return float(np.sqrt(np.sum(self.variances * weights) / equal))

    def score_covariance(
        self, kind: Noise, information: Information, shared: int
    ) -> tuple[Array, Array]:
        """Return the covariance of the score Sᵀe for independent errors, with that of priors and of
        other known errors.

        Parameters
        ----------
        kind : {"given", "estimated", "by-marker"}
            Source of the variance: stated σ, `pooled` or `variances`.
        shared : int
            Number of shared parameters.

        Returns
        -------
        ((r, r) array, (shared,) array)
            LᵀB L, and degrees of freedom of the variances of shared parameters after Satterthwaite
            (1946); stated σ and priors are exact.
        """
        exact = information.prior + self.known_score_covariance
        if kind == "given":
            return exact + self.shares.sum(axis=0), np.full(shared, np.inf)
        if kind == "estimated":
            of_data = self.pooled * self.shares.sum(axis=0)
            return exact + of_data, np.full(shared, max(1.0, self.freedom))
        total = exact + np.tensordot(self.variances, self.shares, 1)
        directions = information.fit.root[:shared]
        parts = np.einsum("kr,grs,ks->kg", directions, self.shares, directions) * self.variances
        variance_of_variance = np.sum(parts**2 / np.maximum(self.freedoms, 1.0), axis=1)
        variances = np.einsum("kr,rs,ks->k", directions, total, directions)
        with np.errstate(divide="ignore", invalid="ignore"):
            freedom = np.where(
                variance_of_variance > 0, variances**2 / variance_of_variance, np.inf
            )
        return total, np.maximum(freedom, 1.0)


def estimate_noise_level(fit: LinearisedFit, information: Information) -> NoiseLevel:
    """Return the size of the errors of each marker compared with the stated σ, with tests, from the
    residuals of a fit.

    Blocks with a floor of noise are left out.

    Notes
    -----
    Sums of squares that Huber's loss has shortened are corrected by `shortened_power`. If residuals
    are rounding, p-values are 1, and without a degree of freedom those of small and unequal ones.
    That of large ones is for one degree at least.
    """
    names = []
    squares = []
    counts = []
    shares = []
    prior_score = np.zeros_like(information.prior)
    for block, slope in zip(fit.blocks, information.scaled_jacobians, strict=True):
        if block.has_noise_floor:
            prior_score += _prior_score_covariance(block, slope)
            continue
        by_marker = slope.reshape(*block.is_present.shape, 3, slope.shape[2])
        for m in np.flatnonzero(block.is_present.any(axis=0)).tolist():
            rows = by_marker[:, m].reshape(3 * len(block.t_s), slope.shape[2])
            names.append(f"{block.name}/{block.marker_names[m]}")
            squares.append(float(np.sum(block.residual[:, m] ** 2)) / shortened_power(block))
            counts.append(int(block.is_measured[:, m].sum()))
            shares.append(rows.T @ rows)
    of_score, besides = _known_error_moments(fit, information)
    level = _solve_noise_level(
        tuple(names),
        np.array(squares),
        counts=np.array(counts, dtype=float),
        besides=besides,
        shares=np.array(shares).reshape(len(names), *information.prior.shape),
        prior=information.prior + prior_score,
        of_score=of_score + prior_score,
    )
    sigma_keys = {
        f"{block.name}/{block.marker_names[k]}": block.sigma_key
        for block in fit.blocks
        if not block.has_noise_floor
        for k in np.flatnonzero(block.is_present.any(axis=0))
    }
    # That of places stands for all.
    stated = min(sigma_keys.values(), key="sigma_m".__ne__, default="sigma_m")
    return replace(level, sigma_key=stated, sigma_keys=sigma_keys)


def _prior_score_covariance(block: ResidualBlock, slope: Array) -> Array:
    """Return DᵀD (r, r) times the mean square of residuals, at least once."""
    rows = slope.reshape(slope.shape[0] * slope.shape[1], slope.shape[2])
    share = rows.T @ rows
    degrees_of_freedom = max(1.0, block.measurement_count - float(np.trace(share)))
    factor = max(
        1.0, float(np.sum(block.residual**2)) / shortened_power(block) / degrees_of_freedom
    )
    return factor * share


def disturbance_samples(fit: LinearisedFit) -> list[Array]:
    """Return samples (K, T, M, 3) of known errors for every block, zero where measurements are
    missing and in blocks without known errors; K is that of the first block with known errors, 0
    if there is none.
    """
    of_blocks = [block.disturbances for block in fit.blocks]
    count = next((len(each) for each in of_blocks if each is not None), 0)
    samples_of_blocks = []
    for block, each in zip(fit.blocks, of_blocks, strict=True):
        samples = np.zeros((count, *block.residual.shape)) if each is None else each
        samples_of_blocks.append(samples[:count] * block.is_measured)
    return samples_of_blocks


def project_errors(information: Information, errors: Sequence[Array]) -> tuple[Array, list[Array]]:
    """Return the effect of samples of errors on the fit.

    Parameters
    ----------
    errors : sequence of (K, T, M, 3) arrays
        Samples for each block, zero where nothing is measured.

    Returns
    -------
    ((K, r) array, list of (K, T, M, 3) arrays)
        Scores DᵀE of all blocks together, and the residuals M e that remain after the fit.
    """
    error_rows = [each.reshape(len(each), each.shape[1], -1) for each in errors]
    pairs = [*zip(error_rows, information.scaled_jacobians, strict=True)]
    scores = np.sum([np.einsum("ktc,tcr->kr", e, slope) for e, slope in pairs], axis=0)
    remaining = [e - np.einsum("tcr,kr->ktc", slope, scores) for e, slope in pairs]
    return scores, [
        each.reshape(errors_of_block.shape)
        for each, errors_of_block in zip(remaining, errors, strict=True)
    ]


def _known_error_moments(fit: LinearisedFit, information: Information) -> tuple[Array, Array]:
    """Return the covariance (r, r) of the score, and the sums of squares (G, K) of each of G
    markers in each of K samples, due to known errors; zeros with K = 1 if there are none.
    """
    is_used = [block.is_present.any(axis=0) & (not block.has_noise_floor) for block in fit.blocks]
    if not len((samples := disturbance_samples(fit))[0]):
        return np.zeros_like(information.prior), np.zeros((int(np.concatenate(is_used).sum()), 1))
    scores, remaining = project_errors(information, samples)
    present = [block.is_measured for block in fit.blocks]
    sums = [
        np.sum((each * there) ** 2, axis=(1, 3))[:, used].T
        for each, there, used in zip(remaining, present, is_used, strict=True)
    ]
    return scores.T @ scores / len(scores), np.concatenate(sums)


def _solve_noise_level(
    names: tuple[str, ...],
    squares: Array,
    counts: Array,
    besides: Array,
    shares: Array,
    prior: Array,
    of_score: Array,
) -> NoiseLevel:
    """Return the variances of the markers' errors, and tests of them."""
    fitted = np.trace(shares, axis1=1, axis2=2)
    own_freedoms = np.maximum(counts - fitted, 0.0)
    # Sums of squares with these means and twice these "spreads" as variances are tested as χ² of
    # the same mean and variance.
    known_means = besides.mean(axis=1)
    means = own_freedoms + known_means
    spreads = own_freedoms + 2 * known_means + besides.var(axis=1) / 2
    freedoms = means**2 / np.maximum(spreads, 1e-300)
    spread = own_freedoms.sum() + 2 * known_means.sum() + besides.sum(axis=0).var() / 2
    freedom = float(means.sum() ** 2 / max(spread, 1e-300))
    of_prior = np.einsum("grs,sr->g", shares, prior)
    overlap = np.einsum("grs,hsr->gh", shares, shares)
    expected = np.diag(counts - 2 * fitted) + overlap
    own = squares - of_prior - known_means
    raw = np.maximum(squares - known_means, 0.0)
    least = np.maximum(LEAST_SHARE * raw / np.maximum(counts, 1.0), ROUNDING**2)
    by_marker = np.maximum(np.linalg.lstsq(expected, own)[0], least)
    pooled = max(own.sum() / max(1.0, expected.sum()), counts @ least / max(1.0, counts.sum()))
    exact = squares.sum() <= ROUNDING**2 * counts.sum()
    tested = not exact and own_freedoms.sum() >= 1
    statistic = float(squares.sum()) * freedom / max(float(means.sum()), 1e-300)
    return NoiseLevel(
        names=names,
        variances=by_marker,
        freedoms=freedoms,
        pooled=float(pooled),
        freedom=freedom,
        larger_p=1.0 if exact else float(chi2_sf(statistic, max(1.0, freedom))),
        smaller_p=float(chi2_cdf(statistic, freedom)) if tested else 1.0,
        unequal_p=_bartlett(squares * freedoms / np.maximum(means, 1e-300), freedoms)
        if tested
        else 1.0,
        shares=shares,
        known_score_covariance=of_score,
    )


def _bartlett(squares: Array, freedoms: Array) -> float:
    """Return the p-value of Bartlett's test of equal variances; 1 for fewer than two groups."""
    used = (freedoms >= 1) & (squares > 0)
    count = int(used.sum())
    each = freedoms[used]
    if count < 2:
        return 1.0
    total = each.sum()
    pooled = squares[used].sum() / total
    statistic = total * np.log(pooled) - np.sum(each * np.log(squares[used] / each))
    correction = 1 + (np.sum(1 / each) - 1 / total) / (3 * (count - 1))
    return float(chi2_sf(statistic / correction, count - 1))


def shortened_power(block: ResidualBlock) -> float:
    """Return the share of white noise's power that remains in residuals of a block shortened by
    Huber's loss; 1 without outliers.

    It is E min(χ², k²) / E χ² for three axes and the largest shortened residual k.
    """
    if not block.outliers.any():
        return 1.0
    squared = float(np.sum(block.residual[block.outliers] ** 2, axis=1).max())
    return float(squared * chi2_sf(squared, 3) / 3 + chi2_cdf(squared, 5))
