"""How large the errors are against the σ given, marker by marker; forces and torques count as such.

The residuals are r = M e + D Lᵀ Pᵀ e_P with M = I − D Dᵀ (see `linearised`) and e_P the errors of
the priors. If the errors of marker m have s_m² times the variance given, its residuals have

    E Σ r_m² = Σ_n s_n² tr(M_mn M_nm) + tr(G_m LᵀPᵀP L) + what is expected besides,

with G_m = D_mᵀ D_m, which is solved for the s_n². Whether they differ is Bartlett's test; whether
all of them are one is that of χ². What is known to add to the residuals besides the noise may be
given by samples of it, such as those of `pose_noise`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from ..arrays import Array
from .distributions import chi2_cdf, chi2_sf
from .linearised import FitBlock, Information, LinearisedFit

Noise = Literal["given", "estimated", "by-marker"]

# Residuals this small, in units of σ, are rounding.
ROUNDING = 1e-6
# Levels of the tests that residuals are larger, smaller, and different among markers.
LARGER = 0.05
SMALLER = 0.01
UNEQUAL = 0.01
# A variance found below this share of the mean square of the residuals is chance.
LEAST_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class NoiseLevel:
    """Variances of the errors in units of σ².

    Attributes
    ----------
    names : (G,) "swing/tip", the markers that were seen
    by_marker : (G,) s_m²
    freedoms : (G,) degrees of freedom of each
    pooled : float
        s² if all are equal.
    freedom : float
        Degrees of freedom of all residuals.
    larger_p, smaller_p : float
        Probability of residuals as large, or as small, if σ is right.
    unequal_p : float
        Probability of markers as different, if all are alike.
    shares : (G, r, r) G_m
    extra : (r, r)
        What is expected besides adds to the covariance of the score.
    stated : str
        What states σ in the problem.
    """

    names: tuple[str, ...]
    by_marker: Array
    freedoms: Array
    pooled: float
    freedom: float
    larger_p: float
    smaller_p: float
    unequal_p: float
    shares: Array = field(repr=False)
    extra: Array = field(repr=False)
    stated: str = "sigma_m"

    @property
    def smaller(self) -> bool:
        """The residuals are clearly smaller than σ says."""
        return self.smaller_p < SMALLER

    @property
    def unequal(self) -> bool:
        """Markers differ more than by chance."""
        return self.unequal_p < UNEQUAL

    @property
    def kind(self) -> Noise:
        """What the residuals ask for."""
        if self.unequal:
            return "by-marker"
        return "estimated" if self.larger_p < LARGER or self.smaller else "given"

    @cached_property
    def factors(self) -> dict[str, float]:
        """How many times σ the errors of each marker are."""
        return dict(zip(self.names, np.sqrt(self.by_marker).tolist(), strict=True))

    @property
    def unevenness(self) -> float:
        """By how much markers that differ widen a mean over all of them: one if they do not."""
        if not self.unequal:
            return 1.0
        weights = self.by_marker * self.freedoms
        equal = weights.sum() ** 2 / self.freedoms.sum()
        return float(np.sqrt(np.sum(self.by_marker * weights) / equal))

    def score_covariance(
        self, kind: Noise, information: Information, shared: int
    ) -> tuple[Array, Array]:
        """LᵀB L (r, r), and the degrees of freedom of the shared parameters' variances (shared,).

        The latter after Satterthwaite (1946); σ as given and priors are exact.
        """
        exact = information.prior + self.extra
        if kind == "given":
            return exact + self.shares.sum(axis=0), np.full(shared, np.inf)
        if kind == "estimated":
            of_data = self.pooled * self.shares.sum(axis=0)
            return exact + of_data, np.full(shared, max(1.0, self.freedom))
        total = exact + np.tensordot(self.by_marker, self.shares, 1)
        directions = information.fit.root[:shared]
        parts = np.einsum("kr,grs,ks->kg", directions, self.shares, directions) * self.by_marker
        doubt = np.sum(parts**2 / np.maximum(self.freedoms, 1.0), axis=1)
        variances = np.einsum("kr,rs,ks->k", directions, total, directions)
        with np.errstate(divide="ignore", invalid="ignore"):
            freedom = np.where(doubt > 0, variances**2 / doubt, np.inf)
        return total, np.maximum(freedom, 1.0)


def noise_level(fit: LinearisedFit, information: Information) -> NoiseLevel:
    """Compare the residuals with the σ given.

    Parameters
    ----------
    fit : LinearisedFit
    information : Information
        Of the fit.
    """
    names = []
    squares = []
    counts = []
    shares = []
    stated = np.zeros_like(information.prior)
    for block, slope in zip(fit.blocks, information.slopes, strict=True):
        if block.noise_at_least_stated:
            stated += _stated_noise(block, slope)
            continue
        by_marker = slope.reshape(*block.present.shape, 3, slope.shape[2])
        for m in np.flatnonzero(block.present.any(axis=0)).tolist():
            rows = by_marker[:, m].reshape(3 * len(block.t_s), slope.shape[2])
            names.append(f"{block.name}/{block.marker_names[m]}")
            squares.append(float(np.sum(block.residual[:, m] ** 2)) / shortened(block))
            counts.append(int(block.seen[:, m].sum()))
            shares.append(rows.T @ rows)
    of_score, besides = _besides(fit, information)
    level = _level(
        tuple(names),
        np.array(squares),
        np.array(counts, dtype=float),
        besides,
        np.array(shares).reshape(len(names), *information.prior.shape),
        information.prior + stated,
        of_score + stated,
    )
    said = [b.stated for b in fit.blocks if b.present.any() and not b.noise_at_least_stated]
    # That of places stands for all.
    return replace(level, stated=min(said, key="sigma_m".__ne__, default="sigma_m"))


def _stated_noise(block: FitBlock, slope: Array) -> Array:
    """Return the covariance (r, r) of the score by the noise of a block that is known as stated.

    Residuals that are larger than stated make it larger.

    Parameters
    ----------
    block : FitBlock
    slope : (T, 3M, r) array
        In units of what is known.
    """
    rows = slope.reshape(slope.shape[0] * slope.shape[1], slope.shape[2])
    share = rows.T @ rows
    left = max(1.0, block.measurements - float(np.trace(share)))
    factor = max(1.0, float(np.sum(block.residual**2)) / shortened(block) / left)
    return factor * share


def drawn(fit: LinearisedFit) -> list[Array]:
    """Samples (K, T, M, 3) of every block, zero where it has none and where samples are missing."""
    of_blocks = [block.disturbances for block in fit.blocks]
    count = next((len(each) for each in of_blocks if each is not None), 0)
    found = []
    for block, each in zip(fit.blocks, of_blocks, strict=True):
        samples = np.zeros((count, *block.residual.shape)) if each is None else each
        found.append(samples[:count] * block.seen)
    return found


def projected(information: Information, errors: Sequence[Array]) -> tuple[Array, list[Array]]:
    """Scores (K, r), and residuals (K, T, M, 3) by block, that errors of that shape leave."""
    flat = [each.reshape(len(each), each.shape[1], -1) for each in errors]
    pairs = [*zip(flat, information.slopes, strict=True)]
    scores = np.sum([np.einsum("ktc,tcr->kr", e, slope) for e, slope in pairs], axis=0)
    left = [e - np.einsum("tcr,kr->ktc", slope, scores) for e, slope in pairs]
    return scores, [each.reshape(given.shape) for each, given in zip(left, errors, strict=True)]


def _besides(fit: LinearisedFit, information: Information) -> tuple[Array, Array]:
    """Covariance (r, r) of the score, and (G, K) sums of squares of each marker."""
    seen = [block.present.any(axis=0) & (not block.noise_at_least_stated) for block in fit.blocks]
    if not len((samples := drawn(fit))[0]):
        return np.zeros_like(information.prior), np.zeros((int(np.concatenate(seen).sum()), 1))
    scores, left = projected(information, samples)
    present = [block.seen for block in fit.blocks]
    sums = [
        np.sum((each * there) ** 2, axis=(1, 3))[:, used].T
        for each, there, used in zip(left, present, seen, strict=True)
    ]
    return scores.T @ scores / len(scores), np.concatenate(sums)


def _level(
    names: tuple[str, ...],
    squares: Array,
    counts: Array,
    besides: Array,
    shares: Array,
    prior: Array,
    of_score: Array,
) -> NoiseLevel:
    fitted = np.trace(shares, axis1=1, axis2=2)
    left = np.maximum(counts - fitted, 0.0)
    # Sums of squares with these means and twice these "spreads" as variances are tested as χ² of
    # the same mean and variance.
    more = besides.mean(axis=1)
    means = left + more
    spreads = left + 2 * more + besides.var(axis=1) / 2
    freedoms = means**2 / np.maximum(spreads, 1e-300)
    spread = left.sum() + 2 * more.sum() + besides.sum(axis=0).var() / 2
    freedom = float(means.sum() ** 2 / max(spread, 1e-300))
    of_prior = np.einsum("grs,sr->g", shares, prior)
    overlap = np.einsum("grs,hsr->gh", shares, shares)
    expected = np.diag(counts - 2 * fitted) + overlap
    own = squares - of_prior - more
    raw = np.maximum(squares - more, 0.0)
    least = np.maximum(LEAST_SHARE * raw / np.maximum(counts, 1.0), ROUNDING**2)
    by_marker = np.maximum(np.linalg.lstsq(expected, own)[0], least)
    pooled = max(own.sum() / max(1.0, expected.sum()), counts @ least / max(1.0, counts.sum()))
    exact = squares.sum() <= ROUNDING**2 * counts.sum()
    tested = not exact and left.sum() >= 1
    statistic = float(squares.sum()) * freedom / max(float(means.sum()), 1e-300)
    return NoiseLevel(
        names=names,
        by_marker=by_marker,
        freedoms=freedoms,
        pooled=float(pooled),
        freedom=freedom,
        larger_p=float(chi2_sf(statistic, freedom)) if tested else 1.0,
        smaller_p=float(chi2_cdf(statistic, freedom)) if tested else 1.0,
        unequal_p=_bartlett(squares * freedoms / np.maximum(means, 1e-300), freedoms)
        if tested
        else 1.0,
        shares=shares,
        extra=of_score,
    )


def _bartlett(squares: Array, freedoms: Array) -> float:
    """Probability of mean squares as different, if the variances are equal."""
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


def shortened(block: FitBlock) -> float:
    """Share of white noise's power that Huber's loss leaves in the residuals; one without it.

    E min(χ², k²) / E χ² of three axes, with the threshold k.
    """
    if not block.wild.any():
        return 1.0
    squared = float(np.sum(block.residual[block.wild] ** 2, axis=1).max())
    return float(squared * chi2_sf(squared, 3) / 3 + chi2_cdf(squared, 5))
