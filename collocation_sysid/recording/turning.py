"""How far a recording's grasps turn within a step of the time grid.

A scheme evaluates forces on the chord of a turn: at midpoint a body that turns rigidly by θ within
a step seems to be compressed by 1 − cos(θ/2), about θ²/8, and an error of this size goes into the
parameters, first into the damping.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np

from .experiment import Experiment

# A turn a grid step [rad] that is worth a warning, and that substeps bring it down to.
FAST, SLOW = 0.055, 0.05
# A turn a grid step [rad] that puts the answer in doubt.
TOO_FAST = 0.1
_KEY = "transcription.substeps"


@dataclass(frozen=True)
class Turn:
    """The largest turn of a grasp between two times of the grid.

    Attributes
    ----------
    experiment : str
    angle_rad : float
    time_s : float
        When the step begins.
    step_s : float
    remedy : str
    """

    experiment: str
    angle_rad: float
    time_s: float
    step_s: float
    remedy: str

    @property
    def rate_rad_s(self) -> float:
        """Mean angular velocity within the step."""
        return self.angle_rad / self.step_s


def fastest_turn(experiment: Experiment, substeps: int) -> Turn:
    """The largest turn of an experiment's grasps within a step, `substeps` of them a sample.

    Between the samples of a static experiment there is no step.
    """
    step_s = experiment.timestep_s / substeps
    steps = (len(experiment.t_s) - 1) * substeps
    t_s = experiment.t_s[0] + step_s * np.arange(steps + 1)
    largest, time_s, held = 0.0, float(t_s[0]), False
    for grasp in () if experiment.static else experiment.grasps:
        held_s = t_s[grasp.holds(t_s)]
        if len(held_s) < 2:
            continue
        rotations = grasp.poses.at(held_s)[0]
        # tr RᵀQ = 1 + 2 cos θ loses small angles to rounding; |R − Q|² = 8 sin²(θ/2) does not.
        chords = np.linalg.norm(np.diff(rotations, axis=0), axis=(1, 2))
        k = int(np.argmax(chords))
        angle = 2 * float(np.arcsin(min(1.0, chords[k] / np.sqrt(8))))
        if angle > largest:
            largest, time_s = angle, float(held_s[k])
            held = grasp.poses.interpolation == "hold"
    needed = max(1, ceil(substeps * largest / SLOW))
    # A pose that is held turns by as much at a sample, however many steps there are between.
    remedy = 'set interpolation = "smooth" in the grasp' if held else f"set {_KEY} = {needed}"
    return Turn(experiment.name, largest, time_s, step_s, remedy)
