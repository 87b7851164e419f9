"""Tests of interpolation between consecutive samples."""

import numpy as np
import pytest

from collocation_sysid.recording.gap_interpolation import (
    interpolate_without_gaps,
    interpolation_error,
    is_gap,
)

# Samples every second, without that at 3 s.
TIMES_S = np.array([0.0, 1.0, 2.0, 4.0, 5.0])


def positions(t_s):
    """Return positions (T, 2, 3) of two points that move at constant velocities."""
    return np.arange(6.0).reshape(2, 3) + np.ones((2, 3)) * np.asarray(t_s)[:, None, None]


def test_values_between_consecutive_samples_are_linear():
    at_s = np.array([0.25, 1.0, 1.5, 4.9, 5.0])
    found = interpolate_without_gaps(at_s, TIMES_S, positions(TIMES_S))
    np.testing.assert_allclose(found, positions(at_s), rtol=1e-14)


@pytest.mark.parametrize("at_s", [-0.1, 2.5, 3.0, 3.999, 5.1])
def test_values_in_gaps_and_beyond_the_samples_are_missing(at_s):
    found = interpolate_without_gaps(np.array([at_s]), TIMES_S, positions(TIMES_S))
    assert np.isnan(found).all()


def test_a_missing_sample_removes_only_the_interpolated_steps():
    values = positions(TIMES_S)
    values[1, 0] = np.nan
    at_s = np.array([0.0, 0.5, 1.0, 1.5, 2.0])
    found = interpolate_without_gaps(at_s, TIMES_S, values)
    assert np.isnan(found[1:4, 0]).all()
    np.testing.assert_allclose(found[[0, 4]], positions(at_s[[0, 4]]))
    np.testing.assert_allclose(found[:, 1], positions(at_s)[:, 1])


def test_rounding_of_a_time_gives_the_sample_itself():
    at_s = TIMES_S + 1e-9 * np.array([-1, 1, -1, 1, 1])
    found = interpolate_without_gaps(at_s, TIMES_S, positions(TIMES_S))
    np.testing.assert_array_equal(found, positions(TIMES_S))


def test_a_single_sample_is_found_at_its_time_alone():
    found = interpolate_without_gaps(np.array([0.0, 1e-3]), np.zeros(1), positions(np.zeros(1)))
    np.testing.assert_array_equal(found[0], positions([0.0])[0])
    assert np.isnan(found[1]).all()


def test_an_interval_over_one_and_a_half_median_intervals_is_a_gap():
    assert is_gap(TIMES_S).tolist() == [False, False, True, False]


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_the_error_of_straight_lines_is_estimated(noise: float) -> None:
    rng = np.random.default_rng(2)
    t_s = np.arange(80) / 30.0
    at_s = np.arange(60) / 25.0

    def track(times_s):
        """Two markers of three coordinates, a fast and a slow one."""
        phases = np.outer(times_s, [20.0, 2.0])[..., None] + np.arange(3)
        return np.sin(phases)

    measured = track(t_s) + noise * rng.normal(size=(80, 2, 3))
    measured[[13, 40], 0] = np.nan
    exact = interpolate_without_gaps(at_s, t_s, track(t_s)) - track(at_s)
    actual = np.sqrt(np.mean(exact**2, axis=(0, 2)))
    estimate = interpolation_error(at_s, t_s, measured)
    assert estimate[0] == pytest.approx(actual[0], rel=0.15)
    assert estimate[1] < 0.01
    at_samples = interpolation_error(t_s, t_s, measured)
    np.testing.assert_allclose(at_samples, 0, atol=1e-12)
