"""Every check for every kind of measurement: a table without an empty field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problems import hung_cube, measured

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.features.measurements import (
    copied,
    instrument_misfits,
    judged_residuals,
    lost_samples,
    reason_against_copy,
)
from collocation_sysid.statistics.assessment import validation_concerns

NUMBERS = ("markers", "wrench", "sensor", "specimen")


def only(kind):
    """Experiment in which one kind of measurement is measured, with values of one."""
    if kind == "specimen":
        strain = np.linspace(0.1, 0.5, 11)
        return cs.Specimen("uniaxial", strain, 1.0 + 0 * strain, 0.1).experiment(name="pull")
    cube = measured(hung_cube())
    ones = np.ones(len(cube.t_s))
    if kind == "markers":
        return cube
    if kind == "wrench":
        force = cs.Wrench(cube.t_s, ones[:, None] * [[1.0, 1.0, 1.0]], sigma_n=0.1)
        grasps = [replace(cube.grasps[0], wrench=force)]
        return replace(cube, grasps=grasps, markers=None)
    gauge = cs.Gauge("height", lambda at: at.position_m[2, 0], cube.t_s, ones, 0.1, [[0, 0, 0]])
    return replace(cube, readings=[gauge], markers=None)


@pytest.fixture(params=NUMBERS)
def case(request):
    """An experiment, its measured values as predictions, and the index of its measurement."""
    experiment = only(request.param)
    values = [each.measured_values for each in experiment.measurements]
    (k,) = (k for k, each in enumerate(experiment.measurements) if each.has_samples())
    return experiment, values, k


def test_a_wrong_prediction_of_a_validation_recording_is_doubtful(case):
    experiment, values, k = case
    (right,) = instrument_misfits(experiment, values)
    assert not validation_concerns(experiment.name, right, 1.0, {})
    off = experiment.measurements[k].value_sigmas * 20
    wrong = [each + off if j == k else each for j, each in enumerate(values)]
    (misfit,) = instrument_misfits(experiment, wrong)
    assert misfit.sigmas == pytest.approx(20.0)
    (concern,) = validation_concerns(experiment.name, misfit, 1.0, {})
    assert (concern.code, concern.grade) == ("roll-out/predicted", "doubtful")
    assert misfit.what in concern.message


def test_a_prediction_is_judged_by_the_measurement(case):
    experiment, values, k = case
    residuals = judged_residuals(experiment, values)
    assert residuals.unit == experiment.measurements[k].unit
    assert np.nanmax(np.abs(residuals.values)) == 0.0
    assert residuals.is_counted.any()


def test_a_copy_of_the_recording_predicts_it(case):
    experiment, values, k = case
    assert reason_against_copy(experiment, experiment) == ""
    np.testing.assert_array_equal(copied(experiment, experiment)[k], values[k])


def test_a_complete_measurement_has_no_note(case):
    experiment, _, _ = case
    assert lost_samples(experiment) == []


def test_a_measurement_outside_the_recording_is_refused(case):
    experiment, _, k = case
    if experiment.measurements[k] is experiment.markers:
        pytest.skip("markers are measured at the times of the recording")
    late = replace(experiment.measurements[k], t_s=experiment.t_s + 100.0)

    def shifted():
        if experiment.readings:
            return replace(experiment, readings=[late])
        return replace(experiment, grasps=[replace(experiment.grasps[0], wrench=late)])

    with pytest.raises(InputError):
        lost_samples(shifted())


def test_texts_name_the_instrument_and_its_noise(case):
    experiment, _, k = case
    measurement = experiment.measurements[k]
    assert measurement.title
    assert measurement.sigma_text
    assert measurement.noise_key
    assert all(measurement.presence)
