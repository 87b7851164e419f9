"""`check_sensor`: sensors on points and grasps pass, and each fault is one sentence."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from kit.program_derivatives import require_derivatives

import collocation_sysid as cs
from collocation_sysid.program.custom_sensor_residual import CustomSensorResidual
from collocation_sysid.testing import check_sensor
from collocation_sysid.testing.property_check import PropertyCheck
from collocation_sysid.testing.small_problems import DENSITY_KG_M3, program_of, swung_experiment

TIMES_S = np.linspace(0.0, 0.1, 11)


def specific_force(at, bias_m_s2):
    return at.acceleration_m_s2[:, 0] + ca.vertcat(0, 0, 9.81 + bias_m_s2)


def strain(at, scale):
    way = at.position_m[:, 1] - at.position_m[:, 0]
    return (1 + scale) * (ca.norm_2(way) / 0.06 - 1)


def speed(at):
    return [ca.sqrt(ca.sumsqr(at.velocity_m_s[:, 0]) + 1e-4), at.t_s]


def pull(at, gain):
    return (1 + gain) * at.force_n[2] * (1 + ca.sumsqr(at.torque_nm))


TIP_M = [[0.05, 0.05, 0.01]]
ENDS_M = [[0.0, 0.0, 0.02], [0.0, 0.0, 0.08]]
SENSORS = {
    "accelerometer": cs.Gauge(
        "accelerometer", specific_force, TIMES_S, None, 0.05, TIP_M, {"bias_m_s2": 0.5}
    ),
    "foil": cs.Gauge("foil", strain, TIMES_S, None, 1e-4, ENDS_M, {"scale": 0.05}),
    "speed": cs.Gauge("speed", speed, TIMES_S, None, 1e-3, TIP_M),
    "load cell": cs.Gauge("cell", pull, TIMES_S, None, 1e-3, unknowns={"gain": 0.1}, grasp=1),
    "load cell, world": cs.Gauge(
        "cell", pull, TIMES_S, None, 1e-3, unknowns={"gain": 0.1}, grasp=1, frame="world"
    ),
}


@pytest.mark.parametrize("name", SENSORS)
def test_every_kind_of_sensor_passes(name: str):
    sensor = SENSORS[name]
    check_sensor(sensor)
    box = cs.box_mesh((0.1, 0.1, 0.12), (1, 1, 2))
    body = cs.Body(cs.TetMesh(box.points_m - 0.02, box.tetrahedra), density_kg_m3=DENSITY_KG_M3)
    recorded = swung_experiment(body, readings=[sensor.with_samples(TIMES_S[:5] + 0.013, None)])
    require_derivatives(PropertyCheck(name), program_of(recorded, {}))


def one_sided(at, scale):
    """A reading that depends on whether it is differentiated."""
    way = strain(at, scale)
    return -way if isinstance(way, ca.SX) else way


def test_a_reading_with_another_sign_in_programs_fails():
    with pytest.raises(AssertionError, match=r"'foil': the expression differs from its functi"):
        check_sensor(replace(SENSORS["foil"], expression=one_sided))


def test_a_prediction_with_wrong_rates_fails(monkeypatch):
    """Velocities of the wrong sign, as a stencil with exchanged neighbours would give them."""

    def backward(self, values, phi, data):
        return original(self, values[:, ::-1], phi, data)

    original = CustomSensorResidual.expression
    monkeypatch.setattr(CustomSensorResidual, "expression", backward)
    with pytest.raises(AssertionError, match="the prediction for a known motion is wrong at t = 0"):
        check_sensor(SENSORS["speed"])
