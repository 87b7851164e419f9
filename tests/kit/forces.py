"""The forces on a body alone, and two user-defined nodal forces: a bed with dashpots, and a pressure
with damping along the normal.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from collocation_sysid.fem.body import Body
from collocation_sysid.model.forces import Forces
from collocation_sysid.recording import Experiment, Markers


def forces_alone(body: Body, theta: np.ndarray) -> Forces:
    """The internal and custom forces of a body at one time, without loads, gravity and air."""
    t_s = np.arange(3.0)
    markers = Markers(t_s, np.zeros((3, 1, 3)), 1e-3, ["m"], body.nodes_m[:1])
    weightless = Experiment(
        body,
        t_s,
        [],
        markers,
        gravity_m_s2=np.zeros(3),
        start="undeformed",
        air_density_kg_m3="none",
    )
    return Forces.from_experiment(weightless, 0.0, theta)


def foundation(x, v, at, bed_n_m3, whirl_n_m3):
    """A bed of springs with dashpots under a body, and something that turns, growing in time."""
    moved = x - at.rest_m
    beside = ca.vertcat(-moved[1], moved[0], 0)
    spring = bed_n_m3 * at.area_m2 * (1 + ca.sumsqr(moved) / 1e-4)
    return -spring * (moved + 0.1 * v) + whirl_n_m3 * at.t_s * at.volume_m3 * beside


def breath(x, v, at, breath_pa, brake_pa_s_m):
    """A pressure that grows in time and with the place, and what brakes along the normal."""
    pressure_pa = breath_pa * (1 + 10 * at.t_s) * (1 + ca.sumsqr(x - at.rest_m) / 1e-6)
    along = ca.dot(v, at.normal)
    return -at.area_m2 * (pressure_pa + brake_pa_s_m * along) * at.normal
