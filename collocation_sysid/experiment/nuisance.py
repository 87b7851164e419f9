"""What else is not known exactly about one recording, and how well it is known."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ..errors import InputError
from .actuator import Actuator
from .tendon import Tendon

DEGREE = float(np.pi / 180)


@dataclass(frozen=True)
class Nuisance:
    """Standard deviations of an experiment's nuisance parameters; None where not estimated.

    Every one has a normal prior around zero with its deviation. The defaults are those of a
    careful laboratory; `none` is for ideal data.

    Attributes
    ----------
    marker_offset_m : float or None
        How far markers sit off the places given for them, each coordinate. An error of a place
        turns with the body. Markers have deviations of their own in `Markers`.
    time_shift_s : float or None
        How much later than their times say the markers were seen, on the clock of the grasps.
    gravity_rad : float or None
        Tilt of gravity's direction about two axes across it.
    hand_eye_m, hand_eye_rad : float or None
        A small rigid motion, constant in time, by which the undeformed body is off in the grasp:
        x = U_t H X. It is taken as none where the start is not an equilibrium: the state that is
        given then tells where the body is.
    displacement_zero_m : float or None
        By how much displacements are off, constant in time, along each axis of a grasp whose zero
        is not known.
    joining_s : float or None
        How much later than stated point masses and forces join or leave, each that does within the
        recording.
    pose_shift_m, pose_turn_rad : float or None
        A small rigid motion, constant in time, by which grasps and body are off in the frame of
        the markers, such as that of cameras. It turns the body against gravity.
    camera_offset_m : float or None
        A constant vector by which the cameras see each marker off.
    tare : float or None
        Offset of each component of a measured wrench, constant in time, in its sigmas.
    sensor_time_s : float or None
        How much later than their times say the wrenches were measured, on the clock of the grasps;
        three deviations at most.
    sensor_lag_s : float or None
        Time constant of a first-order low-pass in the sensor; from zero to three deviations.
    tool_kg, tool_m : float or None
        Mass of what is between a sensor and the body, and each coordinate of its centre about the
        sensor's point (in the world's frame, about the middle of the grasped nodes); it is there
        without `tool_m`.
    tension_factor, tension_lost_n : float or None
        How far the factor of each tendon's tension is from one, and what friction takes of it.
    pressure_factor, pressure_lost_pa : float or None
        The same of each pressure, whose sensor may have another zero.
    """

    marker_offset_m: float | None = 1e-3
    time_shift_s: float | None = 5e-3
    gravity_rad: float | None = DEGREE
    hand_eye_m: float | None = 1e-3
    hand_eye_rad: float | None = 0.5 * DEGREE
    displacement_zero_m: float | None = 1e-4
    joining_s: float | None = 1e-2
    pose_shift_m: float | None = None
    pose_turn_rad: float | None = None
    camera_offset_m: float | None = None
    tare: float | None = 10.0
    sensor_time_s: float | None = 5e-3
    sensor_lag_s: float | None = None
    tool_kg: float | None = None
    tool_m: float | None = None
    tension_factor: float | None = None
    tension_lost_n: float | None = None
    pressure_factor: float | None = None
    pressure_lost_pa: float | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and not value > 0:
                raise InputError(f"{field.name} is {value:g}; expected a deviation above 0")

    def off(self, actuator: Actuator) -> tuple[float | None, float | None]:
        """How well its factor is known, and what it loses."""
        if isinstance(actuator, Tendon):
            return self.tension_factor, self.tension_lost_n
        return self.pressure_factor, self.pressure_lost_pa

    @classmethod
    def none(cls, **deviations: float | None) -> Nuisance:
        """Nothing is estimated but what is named."""
        nothing: dict[str, float | None] = {field.name: None for field in fields(cls)}
        return cls(**(nothing | deviations))
