"""Limits of the robot (limits.toml)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field, model_validator

from ...common.array_types import Array
from ...common.schema_tables import Vector
from ...common.text_files import HAND_WRITTEN_BYTES, parse_toml, read_text
from ...common.validated_classes import validated
from ...common.validated_types import Positive
from ...errors import InputError, located
from ...problem.validation_messages import StatedSection
from .hand_motion import TimeDerivatives, angular_motion

# Largest share of a limit on the grid of a motion: between grid points peaks may be larger.
WITHIN = 1 - 6e-3
# Share of a limit beyond which a motion counts as reaching the limit.
REACHED = 0.98


class Limits(StatedSection):
    """limits.toml: what the hand may do.

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

    @model_validator(mode="after")
    def _require_consistent(self) -> Limits:
        """Refuse corners in the wrong order."""
        if not (np.array(self.workspace_m[0]) < self.workspace_m[1]).all():
            raise ValueError(
                f"workspace_m has the corners {list(map(list, self.workspace_m))}; expected the "
                "lower one first, below the other along every axis"
            )
        return self

    @classmethod
    @validated
    def read(cls, path: str | Path) -> Limits:
        """Read limits.toml from a file.

        Raises
        ------
        InputError
            If the file is missing, is no TOML, or has a key or value that is not allowed; the
            message names the file, the key or line, what was found and what was expected.
        """
        file = Path(path)
        text = read_text(file, "a file of limits (TOML)", HAND_WRITTEN_BYTES)
        content = parse_toml(text, file)
        with located(file):
            return cls(**content)

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

    def shares(self, course: TimeDerivatives) -> dict[str, float]:
        """Return the largest values of a motion as shares of the limits, by name of the limit; the
        limit is exceeded above 1.

        The names are "workspace_m", "speed_m_s", "acceleration_m_s2", "rotation_deg",
        "angular_speed_deg_s" and "angular_acceleration_deg_s2". The motion is relative to the
        initial pose.
        """
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


def _largest_norm(vectors: Array) -> float:
    """Return the largest norm of vectors (T, 3), at least one, in their unit."""
    return float(np.linalg.norm(vectors, axis=1).max())
