"""Loads of a wrong sign: deforming a body takes work, so that loads that fall as their grasp advances
contradict the description. No simulation is needed.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..common.array_types import Array
from ..recording.experiment import Experiment
from ..recording.grasp import Grasp
from ..recording.obstacle import Obstacle
from ..recording.poses import Frame
from ..statistics.hypothesis import Hypothesis
from ..statistics.thresholds import AGAINST

# Fewest samples for this correlation.
FEWEST_SAMPLES = 3
# Loads of an obstacle below this share of the largest may be those before it touches the body.
TOUCHING = 0.05


def load_sign_hypotheses(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield a hypothesis of a wrong sign for each grasp and axis of a static experiment where
    displacement and measured force are anticorrelated, below `AGAINST`.

    Tested are axes along which a grasp is displaced by a test bench, or along which an obstacle or a
    face whose displacements were measured moves most, relative to the grasps that hold the others.
    Dynamic experiments are not tested, because of inertia.
    """
    for k, grasp in enumerate(experiment.grasps if experiment.is_static else (), start=1):
        sensor = experiment.sensors_by_grasp.get(k)
        if sensor is None:
            continue
        shifts_m = _relative_shifts(experiment, grasp, sensor.t_s)
        for axis in grasp.zero or _pushing_axis(grasp, shifts_m, frame=sensor.frame):
            axis_index = "xyz".index(axis)
            displacement_m = shifts_m[:, axis_index]
            load_n = sensor.values[:, axis_index]
            is_measured = np.isfinite(load_n)
            if isinstance(grasp, Obstacle):
                # Before the obstacle touches the body, the load is noise.
                is_measured &= np.abs(load_n) > TOUCHING * np.nanmax(np.abs(load_n), initial=0.0)
            if is_measured.sum() < FEWEST_SAMPLES or not (
                np.ptp(displacement_m[is_measured]) and np.ptp(load_n[is_measured])
            ):
                continue
            correlation = float(np.corrcoef(displacement_m[is_measured], load_n[is_measured])[0, 1])
            if correlation < AGAINST:
                data = {"axis": axis, "grasp": k, "correlation": correlation}
                strength = 1 / (1 + correlation + 1e-3)
                yield Hypothesis("sign", f"'{experiment.name}'", data=data, strength=strength)


def _relative_shifts(experiment: Experiment, grasp: Grasp, t_s: Array) -> Array:
    """Return the mean positions (T, 3) [m] of a grasp's nodes, along each axis relative to those of the
    other grasps that hold it all the time.
    """
    nodes_m = experiment.body.nodes_m
    shifts_m = grasp.positions_at(nodes_m, t_s).mean(axis=1)
    others = [each for each in experiment.body_grasps if each is not grasp]
    for axis in grasp.axis_indices:
        held_m = [
            each.positions_at(nodes_m, t_s)[:, :, axis].mean(axis=1)
            for each in others
            if axis in each.axis_indices and each.is_active(t_s).all()
        ]
        shifts_m[:, axis] -= np.mean(held_m, axis=0) if held_m else 0.0
    return shifts_m


def _pushing_axis(grasp: Grasp, shifts_m: Array, frame: Frame) -> str:
    """Return the world axis along which an obstacle or a measured face moves most; "" for others."""
    moved_m = np.ptp(shifts_m, axis=0)
    if not isinstance(grasp, Obstacle) and grasp.poses.deformation is None:
        return ""
    if not moved_m.any() or frame != "world":
        return ""
    return "xyz"[int(moved_m.argmax())]
