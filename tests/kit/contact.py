"""Poses, grasps and a force sensor for bodies that touch obstacles."""

from __future__ import annotations

import numpy as np

from collocation_sysid.fem.body import Body
from collocation_sysid.recording import Grasp, PoseSequence, Wrench
from kit.problems import nodes_where


def sensor(t_s) -> Wrench:
    """Not read yet."""
    return Wrench(t_s, np.zeros((len(t_s), 6)), 1.0, sigma_nm=1.0)


def moved(t_s, way_m, **changes) -> PoseSequence:
    """Along a way (T, 3), not turned."""
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
    return PoseSequence(t_s, np.asarray(way_m, dtype=float), turns, "linear", **changes)


def quarter(body: Body) -> list[Grasp]:
    """Two planes of symmetry."""
    fixed = PoseSequence.fixed()
    return [
        Grasp(nodes_where(body, 0, 0.0), fixed, axes="x"),
        Grasp(nodes_where(body, 1, 0.0), fixed, axes="y"),
    ]
