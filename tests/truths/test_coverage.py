"""Coverage of intervals in complete identifications."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from coverage_twins import CASES, ERROR_MODELS, CoverageOutcome, run
from scipy.stats import binom, chi2, norm

from collocation_sysid.statistics.uncertainty import ErrorModel

pytestmark = pytest.mark.long

TWINS, MANY = 2, 15  # of each case; two cases have the same noise
SIGMA_M = 1e-3
# What chance leaves out in one of a thousand tests.
RARE = 1e-3
NOISES = {"white": CASES[:2], "autoregressive": CASES[2:]}
AUTO = ERROR_MODELS.index(ErrorModel())
ROBUST = ERROR_MODELS.index(ErrorModel("estimated"))
TEXTBOOK = ERROR_MODELS.index(ErrorModel("estimated", "independent"))


@cache
def outcomes(noise: str, twins: int = TWINS) -> list[CoverageOutcome]:
    return [
        run(case, SIGMA_M, (number, twin))
        for number, case in enumerate(NOISES[noise])
        for twin in range(twins)
    ]


def held(noise: str, kind: int, twins: int = TWINS) -> np.ndarray:
    """Share of the intervals that hold the truth, by parameter."""
    return np.mean([outcome.contains_truth[kind, :4] for outcome in outcomes(noise, twins)], axis=0)


def fewest(twins: int) -> float:
    """The share that right intervals hold at least."""
    return float(binom.ppf(RARE / 2, 2 * twins, 0.95)) / (2 * twins)


def scores(noise: str, kind: int, twins: int = TWINS) -> np.ndarray:
    """(twins, 4) errors over their standard deviations."""
    return np.array([outcome.scores[kind] for outcome in outcomes(noise, twins)])


def limits_of_spread(twins: int) -> tuple[float, float]:
    """Of the standard deviation of that many standard normal numbers."""
    low, high = chi2.ppf([RARE / 2, 1 - RARE / 2], 2 * twins) / (2 * twins)
    return float(np.sqrt(low)), float(np.sqrt(high))


@pytest.mark.parametrize("noise", NOISES)
def test_every_twin_is_solved(noise):
    assert all(outcome.converged for outcome in outcomes(noise))


@pytest.mark.parametrize("kind", [ROBUST, AUTO])
@pytest.mark.parametrize("noise", NOISES)
def test_intervals_hold_the_truth(noise, kind):
    assert (held(noise, kind) >= fewest(TWINS)).all()


@pytest.mark.parametrize("noise", NOISES)
def test_errors_are_as_large_as_their_standard_deviations(noise):
    found, (low, high) = scores(noise, ROBUST), limits_of_spread(TWINS)
    assert (np.abs(found.mean(axis=0)) < norm.isf(RARE / 2) / np.sqrt(2 * TWINS)).all()
    assert ((low < found.std(axis=0)) & (found.std(axis=0) < high)).all()


@pytest.mark.slow  # so many twins take a minute; test_error_coverage has the same of linear fits
def test_textbook_intervals_fail_where_errors_persist():
    assert (held("autoregressive", TEXTBOOK, MANY) < fewest(MANY)).all()
    spread = scores("autoregressive", TEXTBOOK, MANY).std(axis=0)
    assert (spread > limits_of_spread(MANY)[1]).all()


def test_the_kind_of_error_bars_is_chosen_by_the_residuals():
    assert all(outcome.correlated[ROBUST] for outcome in outcomes("autoregressive"))
    chosen = sum(outcome.correlated[ROBUST] for outcome in outcomes("white"))
    assert chosen <= binom.isf(RARE, 2 * TWINS, 0.02)  # 1 % of two tests
