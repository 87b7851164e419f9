"""A soft block that a ball presses in, with the measured force."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

import collocation_sysid as cs
from collocation_sysid.recording import Experiment

TRUTH = {"young_pa": 2e4, "poisson": 0.3, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}


DEPTHS_M = np.linspace(-0.0005, 0.006, 14)


SMALL, FLAT = (cs.Sphere(0.004, (0.03, 0.03, 0.034)), cs.Plane((0, 0, -1), (0, 0, 0.03)))


SIGMA_N = 0.002


@cache
def block() -> cs.Body:
    return cs.Body(cs.box_mesh((0.06, 0.06, 0.03), (4, 4, 2)), density_kg_m3=50.0)


def poked(
    higher_m: float = 0.0,
    place_sigma_m: float | None = 5e-4,
    depths_m: np.ndarray = DEPTHS_M,
    **changes,
) -> Experiment:
    """A ball that comes down on the middle of a block, stated so much higher than it is."""
    t_s = np.arange(len(depths_m), dtype=float)
    down = np.outer(-depths_m + higher_m, [0.0, 0.0, 1.0])
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
    ball = cs.Obstacle(
        shape=cs.Sphere(0.02, (0.03, 0.03, 0.05)),
        poses=cs.PoseSequence(t_s, down, upright),
        name="ball",
        wrench=cs.Wrench(t_s, np.zeros((len(t_s), 3)), SIGMA_N),
    )
    below = np.flatnonzero(block().nodes_m[:, 2] < 1e-6)
    held = cs.Grasp(below, cs.PoseSequence.fixed())
    known = {"kind": "static", "gravity_m_s2": (0.0, 0.0, 0.0), "name": "poke"}
    known["nuisance"] = cs.Nuisance.none(obstacle_offset_m=place_sigma_m)
    return Experiment(block(), t_s, [held, replace(ball, **changes)], None, **known)
