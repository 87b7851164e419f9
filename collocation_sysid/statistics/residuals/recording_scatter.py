"""Differences between recordings in the parameters that they share.

To first order the estimate from one recording alone is a Gauss–Newton step away from the joint
answer: with S its derivatives by the shared parameters and its own nuisance parameters, and P the
derivatives of the latter's priors, (SᵀS + PᵀP)⁻¹ Sᵀ r. Its covariance is that of any fit. For each
parameter

    χ² = Σ (x_e − x̄)² / v_e,   x̄ = Σ x_e / v_e / Σ 1 / v_e,

has one degree of freedom less than there are recordings that determine it. If it is larger than
chance allows, recordings differ by an error of the model with the standard deviation τ, of which two
recordings say little: its prior is half normal (Gelman, Bayesian Analysis 1, 2006). The mean at given
τ is normal with the weights 1 / (v_e + τ²), and its interval holds 95 % over the posterior of τ. The
joint fit may contain that error in its residuals already; not to count it twice, the interval of the
mean is enough.

A parameter that hardly any recording determines alone may look certain because all together
determine it. So each parameter k in turn may differ between recordings, while all others are
shared: with W the information that remains for these numbers and s their score, they differ by

    Q_k = sᵀP s,   P = W⁺ − 11ᵀ / 1ᵀW1,   E Q_k = E_k + Σ_l τ_l² tr M_klᵀ P M_kl,

E_k being the contribution of noise, the number of recordings less one or more for correlated
errors, and M_kl the change of s if parameter l differs with the variance τ_l² between recordings.
All τ_l² ≥ 0 follow by moments (DerSimonian & Laird 1986, for several parameters and with the
recordings' own covariance). Estimates change by −A⁻¹ (SᵀS)_e.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from ..distributions import chi2_sf, normal_isf
from ..linearised import (
    LinearisedFit,
    ResidualBlock,
    gauss_newton_step,
    least_squares_of_blocks,
    least_squares_of_fit,
)

# Probability that consistent recordings are reported to disagree, for all parameters together.
SIGNIFICANT = 0.01
# Scale of the half normal prior of τ, in q: how much temperature, clamps and age change a modulus.
PRIOR_SPREAD = 0.2
# Standard deviation of q below which a recording determines a parameter; otherwise a linear step is
# meaningless.
TELLING = 0.5
# Share of the information that is rounding.
SILENT = 1e-10


@dataclass(frozen=True, eq=False)
class RecordingComparison:
    """Comparison of single recordings, in the solver's coordinates."""

    recordings: tuple[str, ...]  # (n,) tuple of str: names
    # (n, nq): estimates from each alone less the joint ones; NaN where it does not determine them.
    differences: Array
    deviations: Array  # (n, nq): their standard deviations; NaN likewise
    # (p, nq n): changes of the joint estimates if a parameter differs in one recording by its
    # standard deviation between recordings; column n k + e for parameter k and recording e, from 0.
    sensitivities: Array

    @property
    def chi_squared(self) -> Array:
        """χ² of the disagreement on each parameter (nq,); recordings that do not determine
        it (NaN) are left out.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            weight = np.nan_to_num(1 / self.deviations**2)
            mean = np.nansum(weight * self.differences, axis=0) / weight.sum(axis=0)
        return np.nansum(weight * np.nan_to_num(self.differences - mean) ** 2, axis=0)

    @property
    def degrees_of_freedom(self) -> NDArray[np.int64]:
        """Degrees of freedom (nq,) of χ²: the number of recordings that determine the
        parameter, less one, at least 0.
        """
        return np.maximum(np.isfinite(self.deviations).sum(axis=0) - 1, 0)

    def find_disagreements(self) -> NDArray[np.bool_]:
        """Return the mask (nq,) of the parameters on which the recordings disagree more than by
        chance: p-value of χ² below `SIGNIFICANT` over the number of parameters.
        """
        freedom = self.degrees_of_freedom
        p = chi2_sf(self.chi_squared, np.maximum(freedom, 1))
        return np.asarray((freedom > 0) & (p < SIGNIFICANT / len(freedom)))

    def widen(self, variances: Array) -> Array:
        """Return the variances (nq,) of q of the joint fit, increased for parameters on which the
        recordings disagree: to that of a normal distribution with the interval of their mean, less
        by the part of the variance in that of the mean without τ, if that is more. The argument is
        not modified.
        """
        wide = variances.copy()
        for k in np.flatnonzero(self.find_disagreements()):
            known = np.isfinite(self.deviations[:, k])
            deviations = self.deviations[known, k]
            half_width = half_width_of_mean(self.differences[known, k], deviations)
            part = min(1.0, float(variances[k] * np.sum(1 / deviations**2)))
            wide[k] = max(variances[k], part * (half_width / normal_isf(0.025)) ** 2)
        return wide


def half_width_of_mean(differences: Array, deviations: Array) -> float:
    """Return half the width of the interval about zero that has 95 % of the posterior of the mean of
    recordings (n,), with their standard deviations (n,) and an unknown spread τ between them.
    """
    tau = PRIOR_SPREAD * np.linspace(0, 5, 501)[:, None]
    weights = 1 / (deviations**2 + tau**2)
    information = weights.sum(axis=1)
    mean = weights @ differences / information
    misfit = np.sum(weights * (differences - mean[:, None]) ** 2, axis=1)
    logarithm = np.log(weights).sum(axis=1) - np.log(information) - misfit
    logarithm -= (tau[:, 0] / PRIOR_SPREAD) ** 2
    share = np.exp((logarithm - logarithm.max()) / 2)
    share /= share.sum()

    def outside(half_width: float) -> float:
        ends = (np.array([[half_width], [-half_width]]) - mean) * np.sqrt(information)
        above, below = scipy.special.ndtr(ends)
        return float(share @ (1 - above + below)) - 0.05

    largest = np.abs(mean).max() + 10 / np.sqrt(information.min())
    return float(scipy.optimize.brentq(outside, 0, largest))


def blocks_by_recording(fit: LinearisedFit) -> dict[str, list[int]]:
    """Return the indices of the blocks of each recording, by its name, in the order of the
    blocks.
    """
    blocks: dict[str, list[int]] = {}
    for k, block in enumerate(fit.blocks):
        blocks.setdefault(block.name, []).append(k)
    return blocks


def single_fits(fit: LinearisedFit) -> Iterator[tuple[LinearisedFit, Array]]:
    """Yield for each recording the fit to it alone, after a Gauss–Newton step, and this step (m,)
    from the joint parameters, in the order of `blocks_by_recording`.

    Its m parameters are the shared ones, then the nuisance parameters of the recording and those
    shared between recordings.
    """
    for name, block_numbers in blocks_by_recording(fit).items():
        # What recordings share they have to find alone, too.
        mine = [
            other.startswith((f"{name}: ", "shared")) for other in fit.names[fit.shared_count :]
        ]
        columns = np.r_[np.arange(fit.shared_count), fit.shared_count + np.flatnonzero(mine)]
        yield fit_part(fit, [fit.blocks[k] for k in block_numbers], columns=columns)


def fit_part(
    fit: LinearisedFit, blocks: Sequence[ResidualBlock], columns: Index
) -> tuple[LinearisedFit, Array]:
    """Return the fit of some parameters to some data alone, after a Gauss–Newton step, and this
    step (m,): these parameters less the joint ones.

    Priors of shared parameters belong to all the data and are left out; no parameter counts as at a
    bound.

    Parameters
    ----------
    fit : LinearisedFit
        The joint fit; not modified.
    blocks : sequence of ResidualBlock
        Data of the part.
    columns : (m,) array
        Indices of the parameters that are fitted; shared ones are those below `fit.shared_count`.
    """
    prior_residual, prior_slope = (
        np.where(columns < fit.shared_count, 0.0, prior[columns])
        for prior in (fit.prior_residual, fit.prior_jacobian)
    )
    alone = replace(
        fit,
        blocks=tuple(replace(each, jacobian=each.jacobian[..., columns]) for each in blocks),
        names=tuple(fit.names[k] for k in columns),
        prior_residual=prior_residual,
        prior_jacobian=prior_slope,
        at_bound=np.zeros(len(columns), dtype=bool),
    )
    step = gauss_newton_step(alone)
    return alone.after_step(step), step


def compare_recordings(
    fit: LinearisedFit, alone: Mapping[str, tuple[Array, Array, Array]]
) -> RecordingComparison:
    """Compare recordings by the result of each alone; a parameter that a recording hardly
    determines, with a standard deviation of q of at least `TELLING`, has NaN there.

    Parameters
    ----------
    alone : mapping
        By recording, at least one: its estimates of q less those of the joint fit (nq,), their
        variances, NaN or infinite where it does not determine them, and the variances for
        independent errors of the stated σ.
    """
    steps, variances, independent = map(np.array, zip(*alone.values(), strict=True))
    deviations = np.sqrt(variances)
    is_determined = deviations < TELLING
    with np.errstate(invalid="ignore"):
        excess = variances / independent
    return RecordingComparison(
        tuple(alone),
        np.where(is_determined, steps, np.nan),
        deviations=np.where(is_determined, deviations, np.nan),
        sensitivities=_sensitivities_to_differences(
            fit, [*alone], excess=np.where(np.isfinite(excess), excess, 1.0)
        ),
    )


def _sensitivities_to_differences(fit: LinearisedFit, names: Sequence[str], excess: Array) -> Array:
    own = [least_squares_of_blocks(fit, blocks_by_recording(fit)[name]) for name in names]
    each = np.array([o.information for o in own])
    scores = np.array([o.score for o in own])
    together = least_squares_of_fit(fit)
    information = together.information
    score = together.score
    free = np.flatnonzero(~fit.at_bound)
    inverse = np.linalg.pinv(information[np.ix_(free, free)], hermitian=True)
    shared = free[free < fit.shared_count]
    excess_scatter = np.zeros(len(shared))
    by_each = np.zeros((len(shared), len(shared)))
    for row, k in enumerate(shared.tolist()):
        others = free[free != k]
        cross = each[:, k, others] @ np.linalg.pinv(
            information[np.ix_(others, others)], hermitian=True
        )
        own_s = scores[:, k] - cross @ score[others]
        by_own = [np.diag(each[:, k, l]) - cross @ each[:, others, l].T for l in shared]
        remaining = by_own[row]
        if not remaining.sum() > SILENT * information[k, k]:
            continue
        projection = np.linalg.pinv(remaining, rcond=SILENT, hermitian=True) - 1 / remaining.sum()
        noise = remaining * np.sqrt(np.outer(excess[:, k], excess[:, k]))
        excess_scatter[row] = own_s @ projection @ own_s - np.trace(projection @ noise)
        by_each[row] = [np.trace(m.T @ projection @ m) for m in by_own]
    sizes = np.where(np.diag(by_each) > 0, np.diag(by_each), 1.0)
    variances = scipy.optimize.nnls(
        by_each / np.sqrt(np.outer(sizes, sizes)), excess_scatter / np.sqrt(sizes)
    )[0]
    sensitivities = np.zeros((len(fit.names), fit.shared_count, len(names)))
    for k, tau in zip(shared, np.sqrt(variances / np.sqrt(sizes)), strict=True):
        sensitivities[free, k] = -tau * inverse @ each[:, free, k].T
    return sensitivities.reshape(len(fit.names), -1)
