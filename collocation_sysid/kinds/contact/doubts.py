"""Likely mistakes that loads of obstacles show: contact without adhesion only pushes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...common.array_types import Array
from ...methods.solution import Solution
from ...recording.experiment import Experiment
from ...recording.obstacle import Obstacle, ObstacleForces
from ...recording.obstacle_solids import Plane
from ...statistics.hypothesis import Hypothesis

# Loads in standard deviations of their noise from which on they are loads.
LOADED = 6.0
# Share of the largest load that calibration and axes may be off.
CALIBRATION = 0.1
# Fewest samples that contradict the description.
FEWEST_SAMPLES = 2


def _normal_n(obstacle: Obstacle, forces: ObstacleForces) -> Array:
    """Return loads (S,) of a plane at samples with all components, along its normal, thus positive if
    it pushes; empty for other solids.
    """
    shape = obstacle.shape
    if not isinstance(shape, Plane):
        return np.zeros(0)
    forces_n = forces.rotate_to_world_n()
    complete = np.isfinite(forces_n).all(axis=1)
    rotations, _ = obstacle.poses.at(forces.t_s[complete])
    normals = rotations @ shape.normal
    return np.sum(forces_n[complete] * normals, axis=1)


def _pulling(
    experiment: Experiment, obstacle: Obstacle, forces: ObstacleForces
) -> Iterator[Hypothesis]:
    """Yield a load of a wrong sign or zero, or a wrong normal, because the obstacle pulls."""
    # Noise and tare explain this force.
    limit_n = LOADED * float(np.hypot(1.0, experiment.nuisance.tare or 0.0)) * forces.sigma_n
    pushing_n = _normal_n(obstacle, forces)
    if not len(pushing_n):
        pushing_n = _load_along_motion_n(experiment, obstacle, forces)
    if not len(pushing_n):
        return
    largest_n = float(np.abs(pushing_n).max())
    pulls = pushing_n < -max(limit_n, CALIBRATION * largest_n)
    if np.count_nonzero(pulls) < FEWEST_SAMPLES:
        return
    data = {
        "pull_n": -float(pushing_n.min()),
        "samples": int(pulls.sum()),
        "of_samples": len(pushing_n),
    }
    yield Hypothesis(
        "obstacle-pull",
        f"obstacle '{obstacle.name}' of '{experiment.name}'",
        data=data,
        strength=-float(pushing_n.min()) / limit_n,
    )


def _load_along_motion_n(
    experiment: Experiment, obstacle: Obstacle, forces: ObstacleForces
) -> Array:
    """Return the load (S,) on the body along the axis of the world along which an obstacle moves
    most [N], positive in the direction of this motion, thus if the obstacle pushes.

    S counts the samples with this component; others are left out. Empty if the obstacle does not
    move or also moves back along the axis, or the experiment is not static.
    """
    if not experiment.is_static:
        return np.zeros(0)
    _, shifts_m = obstacle.poses.at(forces.t_s)
    stroke_m = shifts_m[-1] - shifts_m[0]
    axis = int(np.abs(stroke_m).argmax())
    monotonic = np.abs(np.diff(shifts_m[:, axis])).sum() <= 1.01 * np.abs(stroke_m[axis])
    if not stroke_m[axis] or not monotonic:
        return np.zeros(0)
    load_n = np.sign(stroke_m[axis]) * forces.rotate_to_world_n()[:, axis]
    return load_n[np.isfinite(load_n)]


def obstacle_hypotheses(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield hypotheses about the obstacles of an experiment; mostly none."""
    for obstacle in experiment.obstacles:
        forces = obstacle.find_measured_forces()
        if forces is not None:
            yield from _pulling(experiment, obstacle, forces)


def fit_hypotheses(solution: Solution) -> Iterator[Hypothesis]:
    """Yield likely errors in the obstacles of the fitted experiments and their loads."""
    for transcription in solution.collocation.transcriptions:
        yield from obstacle_hypotheses(transcription.experiment)
