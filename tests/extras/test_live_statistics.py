"""Size and correlation of live residuals, and wider intervals because of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import t as student

from collocation_sysid.extras.live.trust import ResidualScatter, variance_factor
from collocation_sysid.program.least_squares import SquareRootInformation

WAVE = 2.0 * np.cos(np.pi / 4 * np.arange(33))
NONE = np.full((2, 3), np.nan)


def samples(values: np.ndarray, markers: int = 2) -> list[np.ndarray]:
    """Residuals (M, 3) of samples in turn, the same of every marker and axis."""
    return [np.full((markers, 3), value) for value in values]


def test_the_autocorrelation_of_a_wave_is_the_cosine_of_its_step():
    found = ResidualScatter.from_residuals(samples(WAVE))
    assert found.rms == pytest.approx(np.sqrt(np.mean(WAVE**2)))
    expected = np.mean(WAVE[1:] * WAVE[:-1]) / np.mean(WAVE**2)
    assert found.lag1 == pytest.approx(expected)
    assert found.lag1 == pytest.approx(np.cos(np.pi / 4), abs=0.03)


@pytest.mark.parametrize("size", [0.1, 10.0])
def test_the_statistic_does_not_depend_on_the_size_of_the_residuals(size):
    one, other = (
        ResidualScatter.from_residuals(samples(WAVE)),
        ResidualScatter.from_residuals(samples(size * WAVE)),
    )
    assert other.lag1 == pytest.approx(one.lag1)
    assert other.rms == pytest.approx(size * one.rms)


def test_missing_samples_carry_no_information():
    seen = samples(WAVE)
    gaps = [each if k % 7 else NONE for k, each in enumerate(seen)]
    here = np.array([value if k % 7 else np.nan for k, value in enumerate(WAVE)])
    found = ResidualScatter.from_residuals(gaps)
    assert found.rms == pytest.approx(np.sqrt(np.nanmean(here**2)))
    assert found.lag1 == pytest.approx(np.nanmean(here[1:] * here[:-1]) / np.nanmean(here**2))


TOO_LITTLE = {
    "nothing": [],
    "nothing seen": [NONE] * 12,
    "zeros": samples(np.zeros(12)),
    "nine samples": samples(WAVE[:9]),
    "one seen": [*samples(WAVE[:1]), *[NONE] * 11],
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("values", TOO_LITTLE.values(), ids=TOO_LITTLE)
def test_too_little_shows_no_autocorrelation(values):
    assert ResidualScatter.from_residuals(values).lag1 == 0.0


def test_ten_samples_suffice_and_persistent_errors_are_limited():
    assert ResidualScatter.from_residuals(samples(np.ones(10))) == ResidualScatter(1.0, 0.98)


@pytest.mark.parametrize(("count", "matters"), [(30, False), (60, True)])
def test_relevant_changes_exceed_three_standard_deviations(count, matters):
    wave = np.cos(np.arccos(0.3) * np.arange(count))
    found = ResidualScatter.from_residuals(samples(wave, markers=1)).lag1
    assert found == pytest.approx(0.3 if matters else 0.0, abs=0.03)


def test_only_significant_deviations_count(rng):
    white = rng.normal(size=(400, 2, 3))
    assert ResidualScatter.from_residuals([*white]).lag1 == 0.0
    weak = white.copy()
    weak[1:] += 0.15 * white[:-1]
    assert ResidualScatter.from_residuals([*weak]).lag1 == pytest.approx(0.147, abs=0.06)
    # As large, but of so few that it may be chance; and seen often, but too small to matter.
    assert ResidualScatter.from_residuals([*weak[:30]]).lag1 == 0.0
    slight = rng.normal(size=(8000, 2, 3))
    slight[1:] += 0.06 * slight[:-1]
    assert ResidualScatter.from_residuals([*slight]).lag1 == 0.0
    assert ResidualScatter.from_residuals(samples(np.tile([1.0, -1.0], 20))).lag1 == 0.0


FITTED, ROWS = 2, 60


def known(size: float) -> tuple[SquareRootInformation, np.ndarray]:
    """Rows whose residuals are of a size, and the estimate."""
    slope = np.random.default_rng(0).normal(size=(ROWS, FITTED))
    p = np.array([0.3, -0.2])
    return SquareRootInformation.empty(FITTED).with_rows(np.full(ROWS, size), slope, p), p


@pytest.mark.parametrize("size", [0.5, 1.0, 1.1])
def test_residuals_within_sigma_widen_nothing(size):
    assert variance_factor(*known(size), FITTED, ResidualScatter(size)) == (1.0, 1.96)


def test_larger_residuals_widen_by_their_variance_and_students_quantile():
    factor, quantile = variance_factor(*known(2.0), FITTED, ResidualScatter(2.0))
    assert factor == pytest.approx(4.0 * ROWS / (ROWS - FITTED))
    assert quantile == pytest.approx(student.ppf(0.975, ROWS - FITTED))


def test_no_rows_to_spare_count_as_one():
    factor, quantile = variance_factor(*known(3.0), ROWS, ResidualScatter(3.0))
    assert factor == pytest.approx(9.0 * ROWS)
    assert quantile == pytest.approx(student.ppf(0.975, 1))


def test_errors_that_persist_widen_by_how_many_samples_are_one():
    alone, _ = variance_factor(*known(2.0), FITTED, ResidualScatter(2.0))
    factor, _ = variance_factor(*known(2.0), FITTED, ResidualScatter(2.0, 0.6))
    assert factor == pytest.approx(alone * 1.6 / 0.4)
    assert variance_factor(*known(1.0), FITTED, ResidualScatter(1.0, 0.5)) == (
        pytest.approx(3.0),
        1.96,
    )
