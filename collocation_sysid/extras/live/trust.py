"""Reliability of a live estimate: concerns due to residuals and estimates."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ...common.array_types import Array
from ...program.streaming import SquareRootInformation
from ...statistics.assessment import GROSS_MISFIT, HARDLY_TAME, MISFIT, WILD
from ...statistics.concerns import Concern, concern_if
from ...statistics.distributions import chi2_sf, student_95
from ...statistics.estimates import Estimate
from ...statistics.thresholds import PERSISTENT

# Distance from the linearisation point, in standard errors, above which estimates may still change.
LARGEST_SETTLED_DISTANCE = 0.5
# Probability, at each test, that noise of the stated σ is taken for larger noise.
TEST_LEVEL = 1e-3
# Smallest autocorrelation that is taken into account.
CORRELATED = 0.1
# Smallest ratio of an autocorrelation to its standard deviation to be taken into account.
DEVIATIONS = 3.3
# Largest autocorrelation used, to keep the variance finite.
LARGEST_AUTOCORRELATION = 0.98
# Smallest number of samples for an estimate of the autocorrelation.
FEWEST_SAMPLES = 10


@dataclass(frozen=True)
class ResidualScatter:
    """Size and autocorrelation of residuals."""

    rms: float = 0.0  # root mean square in standard deviations
    lag1: float = 0.0  # autocorrelation between consecutive samples; zero if it is not significant

    @classmethod
    def from_residuals(cls, residuals: Sequence[Array]) -> ResidualScatter:
        """Return RMS and lag-one autocorrelation of residuals (M, 3) of consecutive samples, in
        standard deviations, NaN where missing.

        The autocorrelation is zero if it is not significant (or negative) or if there are fewer
        than `FEWEST_SAMPLES` samples, and at most `LARGEST_AUTOCORRELATION`; both are zero without
        residuals that are not NaN.
        """
        if not residuals:
            return cls()
        values = np.array(residuals)
        square = np.nanmean(values**2) if np.isfinite(values).any() else 0.0
        products = values[1:] * values[:-1]
        count = int(np.isfinite(products).sum())
        if len(values) < FEWEST_SAMPLES or not count or not square:
            return cls(float(np.sqrt(square)))
        lag1 = float(np.nanmean(products) / square)
        is_significant = lag1 > max(CORRELATED, DEVIATIONS / np.sqrt(count))
        return cls(
            float(np.sqrt(square)), min(lag1, LARGEST_AUTOCORRELATION) if is_significant else 0.0
        )


def variance_factor(
    known: SquareRootInformation, p: Array, parameter_count: float, scatter: ResidualScatter
) -> tuple[float, float]:
    """Return the factor of all variances, and the half width of 95 % intervals in standard
    deviations.

    The factor is 1, and the half width 1.96, unless the loss is larger than chance explains
    (χ² test at `TEST_LEVEL`): then they are the loss over the degrees of freedom, and the quantile
    of Student's t. In both cases the factor is multiplied by (1 + a)/(1 − a) with the
    autocorrelation a of the residuals.

    Parameters
    ----------
    known : SquareRootInformation
        Information in transformed parameters, including the priors.
    p : (P,)
        Estimate in transformed parameters.
    parameter_count : float
        Number of fitted parameters; the degrees of freedom are the rows of `known` less this
        number, at least 1.
    scatter : ResidualScatter
        Autocorrelation of the residuals; its RMS is not used.
    """
    freedom = max(1.0, known.row_count - parameter_count)
    loss = known.loss(p)
    factor = 1.0
    quantile = 1.96
    if chi2_sf(loss, freedom) < TEST_LEVEL:
        factor = loss / freedom
        quantile = float(student_95(freedom))
    return factor * (1 + scatter.lag1) / (1 - scatter.lag1), quantile


def data_concerns(
    scatter: ResidualScatter,
    counts: Counter[str],
    samples: int,
    sigma_key: str = "sigma_m",
    errs_slowly: bool = False,
) -> list[Concern]:
    """Return the concerns due to residuals, outliers and restarts; empty if there are none.

    They are residuals larger than σ, correlated residuals, a large share of outliers among
    `samples`, and any restart. Nothing is changed.

    Parameters
    ----------
    scatter : ResidualScatter
        Size and autocorrelation of the residuals.
    counts : Counter
        Numbers of irregularities, by kind; those of outliers ("wild") and of restarts ("begun
        anew") are used.
    samples : int
        Number of marker positions measured so far, each marker of each frame counted once; may be
        0.
    sigma_key : str
        Key of σ in a problem file.
    errs_slowly : bool
        Whether errors within σ may be correlated, see `MeasurementResidual`.
    """
    outlier_share = counts["wild"] / max(1, samples)
    restarts = counts["begun anew"]
    size = {"factor": scatter.rms, "stated": sigma_key}
    times = "once" if restarts == 1 else f"{restarts} times"
    return [
        *concern_if(scatter.rms > MISFIT, scatter.rms > GROSS_MISFIT, code="noise/larger", **size),
        *concern_if(
            scatter.lag1 > PERSISTENT and not (errs_slowly and scatter.rms <= 1),
            False,
            code="residuals/persist",
            autocorrelation=scatter.lag1,
        ),
        *concern_if(
            outlier_share > WILD,
            outlier_share > HARDLY_TAME,
            code="residuals/far",
            percent=100 * outlier_share,
        ),
        *concern_if(restarts > 0, False, code="solve/anew", times=times),
    ]


def estimate_concerns(estimates: Mapping[str, Estimate], distance: float) -> list[Concern]:
    """Return the concerns due to the estimates themselves; empty if there are none.

    One concern if the estimate may still change (`LARGEST_SETTLED_DISTANCE`), and one for each
    parameter that is at a bound or, otherwise, has a reason why it is not determined.

    Parameters
    ----------
    estimates : mapping of name to Estimate
        Current estimates.
    distance : float
        Distance of the estimate from the linearisation point, in standard errors.
    """
    concerns = concern_if(distance > LARGEST_SETTLED_DISTANCE, False, code="solve/moves")
    for name, estimate in estimates.items():
        if estimate.at_bound:
            concerns += concern_if(True, False, code="information/at-bound", name=name)
        elif estimate.reason is not None:
            reason = estimate.reason
            concerns += concern_if(
                True, False, code="information/not-yet", name=name, reason=reason
            )
    return concerns
