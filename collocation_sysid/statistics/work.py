"""A body that is deformed takes work: loads that fall as their grasp goes on have a wrong sign."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..recording.experiment import Experiment
from .hypothesis import Hypothesis

# Of load and displacement; noise and hysteresis leave it above zero.
AGAINST = -0.8
FEWEST = 3


def against_the_load(experiment: Experiment) -> Iterator[Hypothesis]:
    """Displacements of a static experiment whose own load goes the other way.

    What moves may be pushed against its displacement, by its inertia.
    """
    for k, grasp in enumerate(experiment.grasps if experiment.static else (), start=1):
        if grasp.wrench is None:
            continue
        shifts_m = grasp.poses.at(grasp.wrench.t_s)[1]
        for axis in grasp.zero:
            along = "xyz".index(axis)
            moved_m, load_n = shifts_m[:, along], grasp.wrench.values[:, along]
            there = np.isfinite(load_n)
            if there.sum() < FEWEST or not (np.ptp(moved_m[there]) and np.ptp(load_n[there])):
                continue
            together = float(np.corrcoef(moved_m[there], load_n[there])[0, 1])
            if together < AGAINST:
                data = {"axis": axis, "grasp": k, "correlation": together}
                strength = 1 / (1 + together + 1e-3)
                yield Hypothesis("sign", f"'{experiment.name}'", data, strength=strength)
