"""What a robot may do and cameras see: limits.toml, and motions scaled until they keep to it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field, ValidationError, model_validator

from ...arrays import Array
from ...checked import AtLeastOne, Positive
from ...errors import InputError
from ...problem.explaining import explain
from ...problem.reading import parse_toml, read_text
from ...section import Section, Vector
from .motion import HandMotion, angular_motion

# Peaks are sought on a grid; between its points they may be this much larger.
WITHIN = 1 - 6e-3
TIGHTER = 1 - 1e-4
# A peak beyond this share of its limit is at it.
REACHED = 0.98


class CameraSection(Section):
    """A camera, by the cone that it sees."""

    position_m: Vector = Field(description="Place [x, y, z] in the poses' world.")
    looks_at_m: Vector = Field(description="A point [x, y, z] in the middle of its picture.")
    field_of_view_deg: Positive = Field(
        lt=180, description="Full angle of the cone: that of the picture's shorter side."
    )

    @model_validator(mode="after")
    def _looks_somewhere(self) -> CameraSection:
        if self.position_m == self.looks_at_m:
            raise ValueError("looks_at_m is position_m; expected another point")
        return self


class Limits(Section):
    """limits.toml: what the hand may do, and where markers are seen.

    The hand is the middle of the grasped nodes.
    """

    workspace_m: tuple[Vector, Vector] = Field(
        description="Lower and upper corner, [[x, y, z], [x, y, z]], of where the hand may be in "
        "the poses' world."
    )
    speed_m_s: Positive = Field(description="Largest speed of the hand.")
    acceleration_m_s2: Positive = Field(description="Largest acceleration of the hand.")
    rotation_deg: Positive = Field(
        lt=180, description="Largest angle between its orientation and that of the start."
    )
    angular_speed_deg_s: Positive = Field(description="Largest angular speed.")
    angular_acceleration_deg_s2: Positive = Field(description="Largest angular acceleration.")
    frequency_hz: Positive | None = Field(
        None, description="No wave is faster; a tenth of the sampling rate by default."
    )
    markers_box_m: tuple[Vector, Vector] | None = Field(
        None, description="Lower and upper corner of a box, [[x, y, z], [x, y, z]], that markers "
        "stay in."
    )  # fmt: skip
    camera: list[CameraSection] = Field(
        default_factory=list, description="[[camera]] tables: markers stay in what they see."
    )
    cameras_per_marker: AtLeastOne = Field(
        2, description="So many of the cameras must have each marker in view."
    )

    @model_validator(mode="after")
    def _possible(self) -> Limits:
        for key in ("workspace_m", "markers_box_m"):
            corners = getattr(self, key)
            if corners is not None and not (np.array(corners[0]) < corners[1]).all():
                raise ValueError(f"{key} has the corners {list(map(list, corners))}; expected the "
                                 "lower one first, below the other along every axis")  # fmt: skip
        if self.camera and self.cameras_per_marker > len(self.camera):
            raise ValueError(
                f"cameras_per_marker = {self.cameras_per_marker}, but there are "
                f"{len(self.camera)} cameras; expected at most that many"
            )
        return self

    @classmethod
    def read(cls, path: str | Path) -> Limits:
        """Read limits.toml.

        Raises
        ------
        InputError
            Naming the file, the key or line, what was found and what was expected.
        """
        file = Path(path)
        content = parse_toml(read_text(file, "a file of limits (TOML)"), file)
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            raise explain(error, content, file, cls) from error

    def about(self, hand_m: Array) -> Bounds:
        """The limits of a hand that starts at a place (3,) in the poses' world.

        Raises
        ------
        InputError
            If it starts outside the workspace.
        """
        low, high = (np.array(corner) - hand_m for corner in self.workspace_m)
        if not ((low < 0) & (high > 0)).all():
            at, *corners = (
                f"[{', '.join(f'{each:.4g}' for each in place)}]"
                for place in (hand_m, *self.workspace_m)
            )
            raise InputError(
                f"the hand starts at {at}, which is not between {' and '.join(corners)}; expected "
                "a workspace around the start",
                None,
                "workspace_m",
            )
        return Bounds(self, low, high)

    def out_of_view(self, markers_m: Array) -> float:
        """How far markers (T, M, 3) leave what is seen: zero where all are in view.

        Metres beyond the box over its diagonal, or radians beyond a camera's cone.
        """
        worst = 0.0
        if self.markers_box_m is not None:
            low, high = (np.array(corner) for corner in self.markers_box_m)
            beyond = np.maximum(low - markers_m, markers_m - high).max(initial=0.0)
            worst = float(beyond / np.linalg.norm(high - low))
        if self.camera and markers_m.size:
            beyond = np.sort([_beyond_cone(camera, markers_m) for camera in self.camera], axis=0)
            worst = max(worst, float(beyond[self.cameras_per_marker - 1].max()))
        return worst


def _beyond_cone(camera: CameraSection, points_m: Array) -> Array:
    """(…) angle [rad] by which points (…, 3) are outside a camera's cone, negative inside."""
    place = np.array(camera.position_m)
    ray, axis = points_m - place, np.array(camera.looks_at_m) - place
    along = ray @ axis / (np.linalg.norm(ray, axis=-1) * np.linalg.norm(axis) + 1e-300)
    return np.arccos(np.clip(along, -1.0, 1.0)) - np.radians(camera.field_of_view_deg) / 2


@dataclass(frozen=True, eq=False)
class Bounds:
    """Limits of a hand that starts at a given place.

    Attributes
    ----------
    limits : Limits
    low_m, high_m : (3,) how far it may go from its start, along each axis
    """

    limits: Limits
    low_m: Array
    high_m: Array

    @property
    def reach(self) -> tuple[Array, Array, Array]:
        """Size, rate and rate of the rate, each of shifts [m] and turns [rad]."""
        limits, farthest = self.limits, np.maximum(-self.low_m, self.high_m).max()
        angular_rate, growth = limits.angular_speed_deg_s, limits.angular_acceleration_deg_s2
        return (
            np.array([farthest, np.radians(limits.rotation_deg)]),
            np.array([limits.speed_m_s, np.radians(angular_rate)]),
            np.array([limits.acceleration_m_s2, np.radians(growth)]),
        )

    def shares(self, motion: HandMotion) -> dict[str, float]:
        """Largest values of a motion as shares of what is allowed, by the limits' names."""
        course = motion.derivatives(motion.grid_s)
        return self._of_shift(*course) | self._of_turn(*course)

    def _of_shift(self, *course: Array) -> dict[str, float]:
        shift, rate, curvature = (each[:, :3] for each in course)
        limits = self.limits
        return {
            "workspace_m": float(np.maximum(shift / self.low_m, shift / self.high_m).max()),
            "speed_m_s": _largest(rate) / limits.speed_m_s,
            "acceleration_m_s2": _largest(curvature) / limits.acceleration_m_s2,
        }

    def _of_turn(self, *course: Array) -> dict[str, float]:
        turn, limits = course[0][:, 3:], self.limits
        largest = map(_largest, (turn, *angular_motion(*(each[:, 3:] for each in course))))
        names = "rotation_deg", "angular_speed_deg_s", "angular_acceleration_deg_s2"
        pairs = zip(names, largest, strict=True)
        return {name: np.degrees(peak) / getattr(limits, name) for name, peak in pairs}

    def within(self, motion: HandMotion) -> HandMotion:
        """The motion with its shifts, and its turns, made so small that every limit is kept.

        What keeps to all of them is left as it is. Peaks of shifts are proportional to their
        scale, those of turns nearly.
        """
        course = motion.derivatives(motion.grid_s)
        shift = WITHIN / max(WITHIN, *self._of_shift(*course).values())
        return motion.scaled(shift, self._turn_scale(course))

    def _turn_scale(self, course: tuple[Array, Array, Array]) -> float:
        scale = 1.0
        while (largest := max(self._of_turn(*(scale * c for c in course)).values())) > WITHIN:
            scale *= TIGHTER * WITHIN / largest
        return scale


def _largest(vectors: Array) -> float:
    return float(np.linalg.norm(vectors, axis=1).max())
