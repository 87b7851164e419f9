"""Limits of the robot and views of the cameras (limits.toml), and scaling of motions to
satisfy them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from pydantic import Field, ValidationError, model_validator

from ...common.array_types import Array
from ...common.schema_tables import Section, Vector
from ...common.validated_types import AtLeastOne, Positive
from ...errors import InputError
from ...problem.reading import parse_toml, read_text
from ...problem.validation_messages import explain_validation_error
from .hand_motion import HandMotion, TimeDerivatives, angular_motion

# Largest share of a limit on the grid of a motion: between grid points peaks may be larger.
WITHIN = 1 - 6e-3
# Factor that keeps a motion within its limits in spite of rounding.
TIGHTER = 1 - 1e-4
# Share of a limit beyond which a motion counts as reaching the limit.
REACHED = 0.98


class CameraSection(Section):
    """A camera, described by its cone of view."""

    position_m: Vector = Field(
        description="Position [x, y, z] of the camera in the world frame of the poses."
    )
    looks_at_m: Vector = Field(
        description="A point [x, y, z] that appears in the middle of its image."
    )
    field_of_view_deg: Positive = Field(
        lt=180, description="Full angle of the cone of view: that of the image's shorter side."
    )

    @model_validator(mode="after")
    def _require_direction(self) -> CameraSection:
        """Return the camera, unchanged; raise `ValueError` if it is at the point it looks at."""
        if self.position_m == self.looks_at_m:
            raise ValueError("looks_at_m is position_m; expected another point")
        return self


class Limits(Section):
    """limits.toml: what the hand may do, and where markers are seen.

    The hand is the middle of the grasped nodes.
    """

    workspace_m: tuple[Vector, Vector] = Field(
        description="Lower and upper corner, [[x, y, z], [x, y, z]], of the region in which the "
        "hand may be, in the world frame of the poses."
    )
    speed_m_s: Positive = Field(description="Largest speed of the hand.")
    acceleration_m_s2: Positive = Field(description="Largest acceleration of the hand.")
    rotation_deg: Positive = Field(
        lt=180, description="Largest angle between its orientation and that of the start."
    )
    angular_speed_deg_s: Positive = Field(description="Largest angular speed.")
    angular_acceleration_deg_s2: Positive = Field(description="Largest angular acceleration.")
    frequency_hz: Positive | None = Field(
        None,
        description="Largest frequency in the motion; a tenth of the sampling rate by default.",
    )
    markers_box_m: tuple[Vector, Vector] | None = Field(
        None, description="Lower and upper corner of a box, [[x, y, z], [x, y, z]], in which the "
        "markers must stay."
    )  # fmt: skip
    camera: list[CameraSection] = Field(
        default_factory=list,
        description="[[camera]] tables: the markers must stay in their fields of view.",
    )
    cameras_per_marker: AtLeastOne = Field(
        2, description="Number of cameras that must have each marker in view."
    )

    @model_validator(mode="after")
    def _require_consistent(self) -> Limits:
        """Refuse corners in the wrong order, and too few cameras."""
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
        """Read limits.toml from a file.

        Raises
        ------
        InputError
            If the file is missing, is no TOML, or has a key or value that is not allowed; the
            message names the file, the key or line, what was found and what was expected.
        """
        file = Path(path)
        content = parse_toml(read_text(file, "a file of limits (TOML)"), file)
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            raise explain_validation_error(error, content, path=file, root=cls) from error

    def bounds_from(self, hand_m: Array) -> HandBounds:
        """Return the limits of a hand that starts at the position `hand_m` (3,) in the world frame
        of the poses [m].

        Raises
        ------
        InputError
            If it starts outside the workspace or on its boundary.
        """
        low, high = (np.array(corner) - hand_m for corner in self.workspace_m)
        if not ((low < 0) & (high > 0)).all():
            at, *corners = (
                f"[{', '.join(f'{each:.4g}' for each in place)}]"
                for place in (hand_m, *self.workspace_m)
            )
            raise InputError(
                f"the hand starts at {at}, which is not between {' and '.join(corners)}; expected "
                "a workspace that contains the start",
                None,
                where="workspace_m",
            )
        return HandBounds(self, low, high_m=high)

    def out_of_view(self, markers_m: Array) -> float:
        """Return how far markers (T, M, 3) [m] leave the box or the views; zero if all are within,
        or if there is neither a box nor a camera.

        Distances beyond the box, along one axis, are relative to its diagonal; those beyond a
        camera's cone are angles [rad], of which for each marker that of the camera number
        `cameras_per_marker` in ascending order counts. The largest is returned.
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
    """Return angles [rad] outside of a camera's field of view; negative inside."""
    position_m = np.array(camera.position_m)
    ray = points_m - position_m
    axis = np.array(camera.looks_at_m) - position_m
    cosine = ray @ axis / (np.linalg.norm(ray, axis=-1) * np.linalg.norm(axis) + 1e-300)
    return np.arccos(np.clip(cosine, -1.0, 1.0)) - np.radians(camera.field_of_view_deg) / 2


class CheckedMotion(Protocol):
    """Motion of a hand whose limits are checked: its derivatives at times that resolve its peaks."""

    @property
    def grid_s(self) -> Array:
        """Times (T,) since the start [s]."""
        ...

    def derivatives(self, t_s: Array, /) -> TimeDerivatives:
        """Return the coordinates (T, 6) and their first and second derivatives."""
        ...


@dataclass(frozen=True, eq=False)
class HandBounds:
    """Limits of a hand with a known initial position."""

    limits: Limits  # limits of the robot
    # (3,): corners of the workspace relative to the initial position [m]: all below zero and all
    # above zero.
    low_m: Array
    high_m: Array

    @property
    def reach(self) -> TimeDerivatives:
        """Largest translation [m] along the farthest axis of the workspace and largest
        rotation [rad], as an array (2,), with the limits of their first and second derivatives,
        (2,) each.
        """
        limits = self.limits
        farthest = np.maximum(-self.low_m, self.high_m).max()
        angular_rate = limits.angular_speed_deg_s
        growth = limits.angular_acceleration_deg_s2
        return TimeDerivatives(
            np.array([farthest, np.radians(limits.rotation_deg)]),
            np.array([limits.speed_m_s, np.radians(angular_rate)]),
            second=np.array([limits.acceleration_m_s2, np.radians(growth)]),
        )

    def shares(self, motion: CheckedMotion) -> dict[str, float]:
        """Return the largest values of a motion on its grid as shares of the limits, by name of the
        limit; the limit is exceeded above 1.

        The names are "workspace_m", "speed_m_s", "acceleration_m_s2", "rotation_deg",
        "angular_speed_deg_s" and "angular_acceleration_deg_s2". The motion is relative to the
        initial pose.
        """
        course = motion.derivatives(motion.grid_s)
        return self._translation_shares(course) | self._rotation_shares(course)

    def _translation_shares(self, course: TimeDerivatives) -> dict[str, float]:
        """Return extent, speed and acceleration over their limits."""
        shift, rate, curvature = (each[:, :3] for each in course)
        limits = self.limits
        return {
            "workspace_m": float(np.maximum(shift / self.low_m, shift / self.high_m).max()),
            "speed_m_s": _largest_norm(rate) / limits.speed_m_s,
            "acceleration_m_s2": _largest_norm(curvature) / limits.acceleration_m_s2,
        }

    def _rotation_shares(self, course: TimeDerivatives) -> dict[str, float]:
        """Return rotation, angular speed and acceleration over their limits."""
        turn, rate, curvature = (each[:, 3:] for each in course)
        velocity, acceleration = angular_motion(turn, rate, curvature=curvature)
        quantities = {
            "rotation_deg": turn,
            "angular_speed_deg_s": velocity,
            "angular_acceleration_deg_s2": acceleration,
        }
        return {
            name: np.degrees(_largest_norm(vectors)) / getattr(self.limits, name)
            for name, vectors in quantities.items()
        }

    def scale_to_limits(self, motion: HandMotion) -> HandMotion:
        """Return the motion with translations and rotations reduced so that every limit is
        satisfied on its grid; the motion itself is not changed.

        All translations get one factor, all rotations another, both at most 1. A motion whose
        shares of the limits are at most `WITHIN` keeps its amplitudes. Peaks of translations are
        proportional to their scale, those of rotations nearly.
        """
        course = motion.derivatives(motion.grid_s)
        shift = WITHIN / max(WITHIN, *self._translation_shares(course).values())
        return motion.scaled(shift, self._rotation_scale(course))

    def _rotation_scale(self, course: TimeDerivatives) -> float:
        """Return the factor ≤ 1 with which all limits of rotation hold."""
        scale = 1.0
        while (largest := max(self._rotation_shares(course.scaled(scale)).values())) > WITHIN:
            scale *= TIGHTER * WITHIN / largest
        return scale


def _largest_norm(vectors: Array) -> float:
    """Return the largest norm of vectors (T, 3), at least one, in their unit."""
    return float(np.linalg.norm(vectors, axis=1).max())
