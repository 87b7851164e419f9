"""Error bars of whole identifications, a short version of scripts/study_coverage.py."""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom, chi2, norm

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

from study_coverage import CASES, KINDS, Outcome, run

TWINS = 4  # of each case; two cases have the same noise
SIGMA_M = 1e-3
# What chance leaves out in one of a thousand tests.
RARE = 1e-3
NOISES = {"white": CASES[:2], "autoregressive": CASES[2:]}
AUTO = KINDS.index(("auto", "auto"))
ROBUST, TEXTBOOK = KINDS.index(("estimated", "auto")), KINDS.index(("estimated", "independent"))
FEWEST = float(binom.ppf(RARE / 2, 2 * TWINS, 0.95)) / (2 * TWINS)


@cache
def outcomes(noise: str) -> list[Outcome]:
    return [
        run(case, SIGMA_M, (number, twin))
        for number, case in enumerate(NOISES[noise])
        for twin in range(TWINS)
    ]


def held(noise: str, kind: int) -> np.ndarray:
    """Share of the intervals that hold the truth, by parameter."""
    return np.mean([outcome.held[kind, :4] for outcome in outcomes(noise)], axis=0)


def scores(noise: str, kind: int) -> np.ndarray:
    """(twins, 4) errors over their standard deviations."""
    return np.array([outcome.scores[kind] for outcome in outcomes(noise)])


def limits_of_spread() -> tuple[float, float]:
    """Of the standard deviation of that many standard normal numbers."""
    low, high = chi2.ppf([RARE / 2, 1 - RARE / 2], 2 * TWINS) / (2 * TWINS)
    return float(np.sqrt(low)), float(np.sqrt(high))


@pytest.mark.parametrize("noise", NOISES)
def test_every_twin_is_solved(noise):
    assert all(outcome.converged for outcome in outcomes(noise))


@pytest.mark.parametrize("kind", [ROBUST, AUTO])
@pytest.mark.parametrize("noise", NOISES)
def test_intervals_hold_the_truth(noise, kind):
    assert (held(noise, kind) >= FEWEST).all()


@pytest.mark.parametrize("noise", NOISES)
def test_errors_are_as_large_as_their_standard_deviations(noise):
    found, (low, high) = scores(noise, ROBUST), limits_of_spread()
    assert (np.abs(found.mean(axis=0)) < norm.isf(RARE / 2) / np.sqrt(2 * TWINS)).all()
    assert ((low < found.std(axis=0)) & (found.std(axis=0) < high)).all()


def test_textbook_intervals_fail_where_errors_persist():
    assert held("autoregressive", TEXTBOOK).mean() < FEWEST
    assert scores("autoregressive", TEXTBOOK).std() > limits_of_spread()[1]


def test_the_kind_of_error_bars_is_chosen_by_the_residuals():
    assert all(outcome.correlated[ROBUST] for outcome in outcomes("autoregressive"))
    chosen = sum(outcome.correlated[ROBUST] for outcome in outcomes("white"))
    assert chosen <= binom.isf(RARE, 2 * TWINS, 0.02)  # 1 % of two tests
