"""User-defined sensors: an accelerometer and a strain gauge."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from collocation_sysid.program.simulation import with_readings
from collocation_sysid.recording import Experiment, Gauge, PointQuantities

LOW_M = [[0.05, 0.05, 0.01]]


ENDS_M = [[0.0, 0.0, 0.02], [0.0, 0.0, 0.08]]


def specific_force(at: PointQuantities, bias_m_s2):
    """Three axes of the world, its bias along z not known."""
    return at.acceleration_m_s2[:, 0] + ca.vertcat(0, 0, 9.81 + bias_m_s2)


def strain(at: PointQuantities, scale):
    """Of the way between two points, with a factor that is not known."""
    way = at.position_m[:, 1] - at.position_m[:, 0]
    return (1 + scale) * (ca.norm_2(way) / 0.06 - 1)


CLAMPED = {"expression": lambda at: at.force_n, "unknowns": {}}


def accelerometer(t_s: np.ndarray, **changes) -> Gauge:
    given = {"sigma": 0.05, "points_m": LOW_M, "unknowns": {"bias_m_s2": 0.5}} | changes
    return Gauge("accelerometer", specific_force, t_s, np.zeros((len(t_s), 3)), **given)


def strain_gauge(t_s: np.ndarray) -> Gauge:
    return Gauge("foil", strain, t_s, np.zeros(len(t_s)), 1e-4, ENDS_M, {"scale": 0.05})


def instrumented(experiment: Experiment, *gauges: Gauge) -> Experiment:
    return replace(experiment, readings=gauges)


def noisy(experiment: Experiment) -> Experiment:
    rng = np.random.default_rng(0)
    read = [
        np.where(
            rng.random(g.measured_values.shape) < 0.1, np.nan, 3 * g.sigma * rng.normal(size=(1,))
        )
        + g.measured_values
        for g in experiment.readings
    ]
    return with_readings(experiment, read)
