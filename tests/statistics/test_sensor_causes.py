"""Mistakes in the description of sensors are named, also where nothing else is measured."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from kit.problems import GUESS, TRUTH, hung_cube, measured
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.judge.engine import find_misspecifications
from collocation_sysid.judge.sensors import whole_mistakes
from collocation_sysid.program.simulation import simulate

SIGMA = 2e-4
STEPS = 15


def sensed(mistake=lambda t_s, values: (t_s, values), markers=True, seed=0):
    """A swung cube of whose lower corners two are sensed, one with a mistake; noise of SIGMA."""
    cube = measured(hung_cube(STEPS))
    rng = np.random.default_rng(seed)

    def gauge(name, point_m, t_s, values):
        return cs.Gauge(
            name, lambda at: at.position_m[:, 0], t_s, values, SIGMA, [point_m], unit="m"
        )

    made = []
    for name, point_m in (("probe", [0.1, 0, 0]), ("other", [0, 0.1, 0])):
        blank = gauge(name, point_m, cube.t_s, np.zeros((STEPS + 1, 3)))
        (values,) = simulate(
            replace(cube, readings=[blank]), TRUTH, "midpoint", substeps=1
        ).custom_sensor_values
        t_s, values = (mistake if name == "probe" else lambda *given: given)(cube.t_s, values)
        made.append(gauge(name, point_m, t_s, values + SIGMA * rng.normal(size=values.shape)))
    tracks_m = cube.markers.positions_m
    noise_m = cube.markers.sigma_m[0] * rng.normal(size=tracks_m.shape)
    seen = replace(cube.markers, positions_m=tracks_m + noise_m)
    changes = {} if markers else {"markers": None}
    return replace(replace(cube, markers=seen), readings=made, **changes)


def causes(experiment):
    solution = cs.solve(cs.Problem([experiment], GUESS, scheme="midpoint", substeps=1))
    return find_misspecifications(solution)


MISTAKES = {
    "sensor-sign": lambda t_s, values: (t_s, -values),
    "sensor-unit": lambda t_s, values: (t_s, 1e3 * values),
    "sensor-axes": lambda t_s, values: (t_s, values[:, [1, 0, 2]]),
}


def test_likely_mistakes_of_a_sensor_correct_the_readings():
    experiment = sensed(MISTAKES["sensor-unit"])
    probe, other = experiment.readings
    predicted = 1e-3 * probe.measured_values
    rows = {row.name: row for row in whole_mistakes(probe, predicted)}
    assert set(rows) == {"sensor-sign", "sensor-unit"}
    corrected, data = rows["sensor-unit"].correct(experiment, np.ones(1))
    assert data == {"what": "values", "factor": 1e-3}
    np.testing.assert_allclose(corrected.readings[0].measured_values, predicted)
    assert corrected.readings[1] is other


@pytest.mark.parametrize("degrees", [30.0, 45.0, 180.0])
def test_turned_axes_of_a_sensor_are_turned_back(degrees):
    experiment = sensed()
    probe, _ = experiment.readings
    turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    predicted = probe.measured_values @ turn
    (axes,) = (r for r in whole_mistakes(probe, predicted) if r.name == "sensor-axes")
    corrected, data = axes.correct(experiment, np.ones(1))
    np.testing.assert_allclose(corrected.readings[0].measured_values, predicted)
    np.testing.assert_allclose(json.loads(str(data["axes"])), turn, atol=0.01)
    for sign in (1, -1):
        rows = whole_mistakes(probe, sign * probe.measured_values)
        assert "sensor-axes" not in {row.name for row in rows}


@pytest.mark.long
@pytest.mark.parametrize(
    ("code", "markers"),
    [*((code, True) for code in MISTAKES), ("sensor-sign", False), ("sensor-unit", False)],
)
def test_a_mistake_of_a_sensor_is_named(code, markers):
    first, *_ = causes(sensed(MISTAKES[code], markers=markers))
    assert first.code == code, first.message
    assert "probe" in first.message


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2))
def test_right_sensors_have_no_cause(seed):
    assert causes(sensed(seed=seed)) == ()


@pytest.mark.long
def test_a_wrong_grasp_has_no_other_cause_without_markers():
    right = sensed(markers=False)
    layer = cs.Grasp(np.flatnonzero(right.body.nodes_m[:, 2] > 0.04), right.grasps[0].poses)
    deeper = replace(right, grasps=[layer])
    simulated = simulate(deeper, TRUTH, "midpoint", substeps=1).custom_sensor_values
    rng = np.random.default_rng(0)
    read = [
        replace(each, values=values + SIGMA * rng.normal(size=values.shape))
        for each, values in zip(right.readings, simulated, strict=True)
    ]
    found = causes(replace(right, readings=read))
    assert all("one layer of nodes more than stated" in each.message for each in found)
