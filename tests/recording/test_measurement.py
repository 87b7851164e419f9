"""Copies of measurements with other samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problems import hung_cube
from kit.wrenches import sensing

from collocation_sysid.recording import Gauge, Wrench
from collocation_sysid.recording.measurement_selection import shortened_experiment


def forces() -> Wrench:
    """A sensor that measures forces at five times, and no torque."""
    return Wrench(0.1 * np.arange(5), np.arange(15.0).reshape(5, 3), 0.1)


def test_samples_of_a_force_sensor_are_cut_to_times():
    cut = forces().within(np.array([0.1, 0.35]), fewest=3)
    assert cut is not None
    np.testing.assert_allclose(cut.t_s, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(cut.values, forces().values[1:4])
    assert forces().within(np.array([0.1, 0.35]), fewest=4) is None


def test_later_values_are_missing_and_times_stay():
    early = forces().without_later_values(0.2)
    np.testing.assert_array_equal(early.t_s, forces().t_s)
    np.testing.assert_array_equal(early.is_measured.any(axis=1), [True, True, True, False, False])


def test_a_sensor_without_earlier_values_is_left_out():
    cube = sensing(hung_cube())
    late = np.where(cube.t_s > 0.05, 1.0, np.nan)
    string = Gauge("string", lambda at: at.position_m[0, 0], cube.t_s, late, 1e-3, [[0, 0, 0]])
    assert string.without_later_values(0.05) is None
    assert string.without_later_values(0.06).is_measured.sum() == 1
    assert forces().without_later_values(-1.0) is None


def test_placeholders_are_zero_where_a_component_is_measured():
    zero = forces().with_zeros_at([0.0, 0.05])
    np.testing.assert_array_equal(zero.values[:, :3], 0.0)
    assert np.isnan(zero.values[:, 3:]).all()


def test_every_measurement_can_be_replaced_or_left_out():
    cube = sensing(hung_cube())
    string = Gauge("string", lambda at: at.position_m[0, 0], cube.t_s, None, 1e-3, [[0, 0, 0]])
    cube = replace(cube, readings=[string])
    markers, wrench, *_ = cube.measurements
    other = cube.with_measurements([markers, *(None for _ in cube.measurements[1:])])
    assert other.measurements == (markers,)
    shifted = wrench.with_samples(wrench.sample_times_s, wrench.measured_values + 1.0)
    moved = cube.with_measurements([None, shifted, *cube.measurements[2:]])
    assert not moved.markers.names
    np.testing.assert_array_equal(moved.measurements[0].measured_values, shifted.values)
    with pytest.raises(ValueError, match="argument"):
        cube.with_measurements([markers])


def test_a_shortened_recording_keeps_three_samples_of_a_slow_sensor():
    """The picture of the first steps of a recording with a slower camera had ended in an error."""
    cube = hung_cube(20)
    slow_s = cube.t_s[1::6]
    string = Gauge(
        "string", lambda at: at.position_m[0, 0], slow_s, 0 * slow_s, 1e-3, [[0, 0, 0]], unit="m"
    )
    short = shortened_experiment(replace(cube, readings=[string]), 4, shortens_sensors=True)
    assert short.t_s[-1] == pytest.approx(slow_s[2])
