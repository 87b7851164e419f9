"""User-defined nuisance parameters of markers: a scale, a drifting clock, and a sag."""

from __future__ import annotations

import casadi as ca

import collocation_sysid as cs

SCALE = cs.Deviation("camera_scale", "1", 0.02, reading=lambda y, scale, t_s, data: (1 + scale) * y)


DRIFT = cs.Deviation("clock_drift", "1", 0.05, clock=lambda drift, t_s, data: drift * t_s)


# Cameras that sag while they warm up, each marker's lens by a vector of its own.
SAG = cs.Deviation(
    "sag",
    "m",
    0.003,
    of="marker",
    axes="x y z",
    reading=lambda y, sag, t_s, data: y + sag * (1 - ca.exp(-t_s / data.duration_s)),
)


ROWS = {row.name: row for row in (SCALE, DRIFT, SAG)}
