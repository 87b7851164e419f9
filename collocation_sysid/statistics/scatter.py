"""By how much recordings disagree on the parameters that they share.

To first order the estimate from one recording alone is a Gauss–Newton step away from the joint
answer: with S its slopes by the shared parameters and its own nuisance parameters, and P the
slopes of the latter's priors, (SᵀS + PᵀP)⁻¹ Sᵀ r. Its covariance is found as that of any fit. For
each parameter

    χ² = Σ (x_e − x̄)² / v_e,   x̄ = Σ x_e / v_e / Σ 1 / v_e,

with one degree of freedom less than there are recordings that tell it. If it is larger than chance
allows, something but the noise differs among recordings: the model's error. Error bars are then
√(χ² / f) times as large (Birge 1932), and intervals are Student's. The joint fit may have seen
that error in its residuals already; not to count it twice, 1 / Σ 1 / v_e widened so is enough.

A parameter that hardly a recording tells alone may look certain because all together tell it. So
each parameter k in turn is let be another in every recording, where all others are shared: with W
what the information of everything leaves for these numbers and s their score, they differ by

    Q_k = sᵀP s,   P = W⁺ − 11ᵀ / 1ᵀW1,   E Q_k = E_k + Σ_l τ_l² tr M_klᵀ P M_kl,

E_k being what noise makes of it, as many as there are recordings less one, or more where errors
hang together; and M_kl what parameter l does to s where it differs itself, by the variance τ_l²
between recordings. All of these follow by moments, none below zero (DerSimonian & Laird 1986, of
several parameters and with the recordings' own covariance). Estimates follow by −A⁻¹ (SᵀS)_e.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from ..arrays import Array, Index
from .distributions import chi2_sf
from .linearised import FitBlock, LinearisedFit, best_step, least_squares, rows_of

# Probability that recordings without such an error are said to disagree, for all parameters.
SIGNIFICANT = 0.01
# A recording tells a parameter if the deviation of its q is below this; else a step tells nothing.
TELLING = 0.5
# Nor does all that is left of its information, where that is rounding.
SILENT = 1e-10


@dataclass(frozen=True, eq=False)
class Scatter:
    """What single recordings say, in the solver's coordinates.

    Attributes
    ----------
    recordings : (n,) names
    away : (n, nq) estimates from each less the joint one; NaN where it does not tell
    deviations : (n, nq) their standard deviations; NaN likewise
    between : (p, nq n) how the joint estimates follow what each parameter is off by in each
        recording, by the deviation between recordings that these have
    """

    recordings: tuple[str, ...]
    away: Array
    deviations: Array
    between: Array

    @property
    def chi_squared(self) -> Array:
        """(nq,) χ² of the disagreement."""
        with np.errstate(invalid="ignore", divide="ignore"):
            weight = np.nan_to_num(1 / self.deviations**2)
            mean = np.nansum(weight * self.away, axis=0) / weight.sum(axis=0)
        return np.nansum(weight * np.nan_to_num(self.away - mean) ** 2, axis=0)

    @property
    def freedom(self) -> NDArray[np.int64]:
        """(nq,) its degrees of freedom."""
        return np.maximum(np.isfinite(self.deviations).sum(axis=0) - 1, 0)

    @property
    def disagreeing(self) -> NDArray[np.bool_]:
        """(nq,) parameters on which the recordings disagree more than by chance."""
        freedom = self.freedom
        p = chi2_sf(self.chi_squared, np.maximum(freedom, 1))
        return np.asarray((freedom > 0) & (p < SIGNIFICANT / len(freedom)))

    def widened(self, variances: Array) -> Array:
        """(nq,) variances of q of the joint fit, larger where recordings disagree."""
        ratio = self.chi_squared / np.maximum(self.freedom, 1)
        with np.errstate(invalid="ignore", divide="ignore"):
            of_all = 1 / np.nansum(1 / self.deviations**2, axis=0)
            enough = np.maximum(variances, ratio * np.minimum(variances, of_all))
        return np.where(self.disagreeing, enough, variances)


def recordings_of(fit: LinearisedFit) -> dict[str, list[int]]:
    """Numbers of the blocks of each recording, by its name."""
    found: dict[str, list[int]] = {}
    for k, block in enumerate(fit.blocks):
        found.setdefault(block.name, []).append(k)
    return found


def single_fits(fit: LinearisedFit) -> Iterator[tuple[LinearisedFit, Array]]:
    """The fit to each recording alone, and its parameters less the joint ones.

    The numbers are those of its blocks.
    """
    for name, numbers in recordings_of(fit).items():
        # What recordings share they have to find alone, too.
        mine = [other.startswith((f"{name}: ", "shared")) for other in fit.names[fit.shared :]]
        columns = np.r_[np.arange(fit.shared), fit.shared + np.flatnonzero(mine)]
        yield part_fit(fit, [fit.blocks[k] for k in numbers], columns)


def part_fit(
    fit: LinearisedFit, blocks: Sequence[FitBlock], columns: Index
) -> tuple[LinearisedFit, Array]:
    """The fit of some parameters to some data alone, and these less the joint ones.

    Priors of shared parameters are of all the data, and left out.
    """
    prior_residual, prior_slope = (
        np.where(columns < fit.shared, 0.0, prior[columns])
        for prior in (fit.prior_residual, fit.prior_slope)
    )
    alone = replace(
        fit,
        blocks=tuple(replace(each, slope=each.slope[..., columns]) for each in blocks),
        names=tuple(fit.names[k] for k in columns),
        prior_residual=prior_residual,
        prior_slope=prior_slope,
        at_bound=np.zeros(len(columns), dtype=bool),
    )
    step = best_step(alone)
    return alone.after(step), step


def scatter_of(fit: LinearisedFit, alone: Mapping[str, tuple[Array, Array, Array]]) -> Scatter:
    """Compare recordings, by name, by what each says alone.

    That are its step (nq,) from the joint answer, and variances (nq,) of q as they are, and as they
    were if its errors were independent and of the σ given.
    """
    steps, variances, independent = (np.array(each) for each in zip(*alone.values(), strict=True))
    deviations = np.sqrt(variances)
    told = deviations < TELLING
    with np.errstate(invalid="ignore"):
        excess = variances / independent
    return Scatter(
        tuple(alone),
        np.where(told, steps, np.nan),
        np.where(told, deviations, np.nan),
        _between(fit, [*alone], np.where(np.isfinite(excess), excess, 1.0)),
    )


def _between(fit: LinearisedFit, names: Sequence[str], excess: Array) -> Array:
    """See `Scatter`; of parameters at a bound nothing."""
    own = [rows_of(fit, recordings_of(fit)[name]) for name in names]
    each = np.array([o.information for o in own])
    scores = np.array([o.score for o in own])
    together = least_squares(fit)
    whole = together.information
    score = together.score
    free = np.flatnonzero(~fit.at_bound)
    inverse = np.linalg.pinv(whole[np.ix_(free, free)], hermitian=True)
    shared = free[free < fit.shared]
    unlike = np.zeros(len(shared))
    by_each = np.zeros((len(shared), len(shared)))
    for row, k in enumerate(shared.tolist()):
        others = free[free != k]
        cross = each[:, k, others] @ np.linalg.pinv(whole[np.ix_(others, others)], hermitian=True)
        own_s = scores[:, k] - cross @ score[others]
        by_own = [np.diag(each[:, k, l]) - cross @ each[:, others, l].T for l in shared]
        left = by_own[row]
        if not left.sum() > SILENT * whole[k, k]:
            continue
        apart = np.linalg.pinv(left, rcond=SILENT, hermitian=True) - 1 / left.sum()
        noise = left * np.sqrt(np.outer(excess[:, k], excess[:, k]))
        unlike[row] = own_s @ apart @ own_s - np.trace(apart @ noise)
        by_each[row] = [np.trace(m.T @ apart @ m) for m in by_own]
    sizes = np.where(np.diag(by_each) > 0, np.diag(by_each), 1.0)
    variances = nnls(by_each / np.sqrt(np.outer(sizes, sizes)), unlike / np.sqrt(sizes))[0]
    moved = np.zeros((len(fit.names), fit.shared, len(names)))
    for k, tau in zip(shared, np.sqrt(variances / np.sqrt(sizes)), strict=True):
        moved[free, k] = -tau * inverse @ each[:, free, k].T
    return moved.reshape(len(fit.names), -1)
