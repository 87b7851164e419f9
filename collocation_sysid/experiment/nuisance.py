"""What else is not known exactly about one recording, and how well it is known."""

from __future__ import annotations

from dataclasses import dataclass, fields

from ..errors import InputError


@dataclass(frozen=True)
class Nuisance:
    """Standard deviations of an experiment's nuisance parameters; None where not estimated.

    Every one has a normal prior around zero with its deviation.

    Attributes
    ----------
    marker_offset_m : float or None
        A constant vector by which each marker sits off its place.
    time_shift_s : float or None
        How much later than their times say the markers were seen, on the clock of the grasps.
    pose_turn_rad, pose_shift_m : float or None
        A small rigid motion, constant in time, by which grasps and body are off in the frame of
        the markers. It turns the body against gravity.
    gravity_rad : float or None
        Tilt of gravity's direction about two axes across it.
    """

    marker_offset_m: float | None = None
    time_shift_s: float | None = None
    pose_turn_rad: float | None = None
    pose_shift_m: float | None = None
    gravity_rad: float | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and not value > 0:
                raise InputError(f"{field.name} is {value:g}; expected a deviation above 0")
