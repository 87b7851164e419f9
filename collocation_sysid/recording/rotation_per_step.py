"""Rotation of grasps within a time step, and the substeps that keep it small.

A scheme evaluates forces on the chord of a rotation: with the midpoint rule a body that rotates
rigidly by θ within a step seems to be compressed by 1 − cos(θ/2), about θ²/8, and an error of this
size enters the parameters, first of all the damping.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np

from .experiment import Experiment

# Rotation within a grid step [rad] above which there is a warning: it seems a strain of 4e-4.
WARNING_ANGLE_RAD = 0.055
# Rotation within a grid step [rad] that the recommended substeps reach; below FAST for rounding.
TARGET_ANGLE_RAD = 0.05
# Rotation within a grid step [rad] that makes the result doubtful: it seems a strain of 1e-3.
DOUBTFUL_ANGLE_RAD = 0.1
_KEY = "transcription.substeps"


@dataclass(frozen=True)
class GraspRotation:
    """The largest rotation of a grasp between two times of the grid."""

    experiment: str
    angle_rad: float  # angle of the rotation within the step
    time_s: float  # begin of the step
    step_s: float  # length of the step
    # What to change in the problem, for messages: the substeps that reduce the angle to
    # `TARGET_ANGLE_RAD`, or, for poses held between samples, a smooth interpolation.
    remedy: str


def fastest_rotation(experiment: Experiment, substeps: int) -> GraspRotation:
    """Return the largest rotation of an experiment's grasps and obstacles within a step of the time
    grid, while they are active.

    Parameters
    ----------
    experiment : Experiment
        Of a static experiment the angle is 0, as there are no steps, and the time that of the first
        sample.
    substeps : int
        Steps per sample.
    """
    step_s = experiment.timestep_s / substeps
    steps = (len(experiment.t_s) - 1) * substeps
    t_s = experiment.t_s[0] + step_s * np.arange(steps + 1)
    largest = 0.0
    time_s = float(t_s[0])
    is_rigid_grasp = False
    for grasp in () if experiment.is_static else experiment.grasps:
        times_s = t_s[grasp.is_active(t_s)]
        if len(times_s) < 2:
            continue
        rotations = grasp.poses.at(times_s)[0]
        # tr RᵀQ = 1 + 2 cos θ loses small angles to rounding; |R − Q|² = 8 sin²(θ/2) does not.
        chords = np.linalg.norm(np.diff(rotations, axis=0), axis=(1, 2))
        k = int(np.argmax(chords))
        angle = 2 * float(np.arcsin(min(1.0, chords[k] / np.sqrt(8))))
        if angle > largest:
            largest = angle
            time_s = float(times_s[k])
            is_rigid_grasp = grasp.poses.interpolation == "hold"
    needed = max(1, ceil(substeps * largest / TARGET_ANGLE_RAD))
    # A pose that is held turns by as much at a sample, however many steps there are between.
    remedy = (
        'set interpolation = "smooth" in the grasp' if is_rigid_grasp else f"set {_KEY} = {needed}"
    )
    return GraspRotation(experiment.name, largest, time_s=time_s, step_s=step_s, remedy=remedy)
