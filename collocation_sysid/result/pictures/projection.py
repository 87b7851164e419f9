"""Parallel projection of bodies: viewing directions, shaded triangles, and hidden points.

The 3-D axes of matplotlib cost tenths of a second each and leave wide margins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ...common.array_types import Array

Triangles = NDArray[np.integer]

# Angle between the view and the normal of the plane of motion, to show its third axis.
AZIMUTH_DEG = 25.0
# Angle by which the view looks down.
ELEVATION_DEG = 18.0
# Brightness of a face turned away from the light.
AMBIENT_BRIGHTNESS = 0.62
# Direction towards the light in the axes of the camera.
LIGHT_DIRECTION = np.array([-0.4, 0.5, 0.8]) / np.linalg.norm([-0.4, 0.5, 0.8])


@dataclass(frozen=True, eq=False)
class ParallelCamera:
    """Parallel projection along a viewing direction."""

    # (3, 3): orthonormal rows in the world: right and top of the picture, and towards the viewer.
    axes: Array

    @classmethod
    def from_direction(cls, direction: ArrayLike, up: ArrayLike) -> ParallelCamera:
        """Return the camera that is in the direction `direction` (3,) from the body, with `up` (3,)
        upright.

        Neither vector needs to have unit length; they must not be parallel.
        """
        direction = np.asarray(direction, dtype=float)
        direction = direction / np.linalg.norm(direction)
        right = np.cross(np.asarray(up, dtype=float), direction)
        right /= np.linalg.norm(right)
        return cls(np.array([right, np.cross(direction, right), direction]))

    @classmethod
    def facing_motion(cls, positions_m: Array, up: ArrayLike) -> ParallelCamera:
        """Return a camera that faces the plane in which a body moves most, or is widest.

        The direction is horizontal, then turned by `AZIMUTH_DEG` and raised by `ELEVATION_DEG`.

        Parameters
        ----------
        positions_m : (T, n, 3)
            Finite positions of its nodes.
        up : (3,)
            Unit vector against gravity.
        """
        up = np.asarray(up, dtype=float)
        level = np.linalg.svd(up[None])[2][1:]
        motion = (positions_m - positions_m.mean(axis=0)) @ level.T
        extent = (positions_m[0] - positions_m[0].mean(axis=0)) @ level.T
        # A body hardly moving is seen from its broad side.
        spread = sum(np.einsum("ki,kj->ij", d, d) / len(d) for d in (motion.reshape(-1, 2), extent))
        least = np.linalg.eigh(spread)[1][:, 0] @ level
        # Of the two opposite directions the one nearer to +x, −y.
        if least @ (1.0, -1.1, 0.01) < 0:
            least = -least
        return cls.from_direction(least, up).turned(AZIMUTH_DEG, up).raised(ELEVATION_DEG)

    def turned(self, angle_deg: float, up: ArrayLike) -> ParallelCamera:
        """Return the camera moved around the body by an angle [°] about `up` (3,), a unit vector;
        counter-clockwise as seen from above.
        """
        turn = Rotation.from_rotvec(np.radians(angle_deg) * np.asarray(up, dtype=float))
        return ParallelCamera(turn.apply(self.axes))

    def raised(self, angle_deg: float) -> ParallelCamera:
        """Return the camera raised by an angle [°]; negative to look from further below."""
        angle = np.radians(angle_deg)
        right, top, forward = self.axes
        direction = np.cos(angle) * forward + np.sin(angle) * top
        return ParallelCamera(np.array([right, np.cross(direction, right), direction]))

    def project(self, points_m: ArrayLike) -> Array:
        """Return the positions (…, 2) [m] in the picture of points (…, 3) [m]."""
        return np.asarray(points_m) @ self.axes[:2].T

    def coordinates_to_viewer_m(self, points_m: ArrayLike) -> Array:
        """Return the coordinate (…) [m] of points (…, 3) [m] towards the viewer."""
        return np.asarray(points_m) @ self.axes[2]

    def visible_faces(
        self, positions_m: Array, surface: Triangles
    ) -> tuple[Array, Array, NDArray[np.int64]]:
        """Return the triangles that are turned towards the viewer, from far to near; those that
        others hide are included: corners (k, 3, 2) in the picture [m], brightness (k,) up to 1, and
        indices (k,) in the surface.

        Parameters
        ----------
        positions_m : (n, 3)
            Positions of the nodes.
        surface : (F, 3)
            Nodes of the triangles, counter-clockwise as seen from outside.
        """
        corners = positions_m[surface] @ self.axes.T
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        front = np.flatnonzero(normals[:, 2] > 0)
        order = front[np.argsort(corners[front, :, 2].mean(axis=1), kind="stable")]
        light = np.clip(normals[order] @ LIGHT_DIRECTION, 0.0, 1.0)
        brightness = AMBIENT_BRIGHTNESS + (1 - AMBIENT_BRIGHTNESS) * light
        return corners[order, :, :2], brightness, order

    def are_hidden(
        self, points_m: Array, positions_m: Array, surface: Triangles
    ) -> NDArray[np.bool_]:
        """Return for each point (k, 3) whether it is behind the surface; False for NaN.

        Points less than 5 % of the body's largest dimension below the surface count as visible,
        because noise moves markers on the surface into the body.

        Parameters
        ----------
        points_m : (k, 3)
            Points [m]; NaN where missing.
        positions_m : (n, 3)
            Positions of the nodes.
        surface : (F, 3)
            Nodes of the boundary triangles.
        """
        corners = positions_m[surface] @ self.axes.T
        points = np.asarray(points_m) @ self.axes.T
        size = np.ptp(positions_m, axis=0).max()
        a, b, c = (corners[:, i, :2] for i in range(3))
        area = _plane_cross_product(b - a, c - a)
        facing = area > 1e-9 * size**2
        a = a[facing]
        b = b[facing]
        c = c[facing]
        area = area[facing]
        to_viewer = corners[facing, :, 2]
        behind = np.zeros(len(points), dtype=bool)
        for k, point in enumerate(points):
            place = point[:2]
            opposite_a = _plane_cross_product(b - place, c - place)
            opposite_b = _plane_cross_product(c - place, a - place)
            weights = np.stack([opposite_a, opposite_b], axis=1) / area[:, None]
            weights = np.column_stack([weights, 1 - weights.sum(axis=1)])
            is_inside = (weights >= 0).all(axis=1)
            surface_coordinate = np.einsum("kc,kc->k", weights[is_inside], to_viewer[is_inside])
            # A marker on the surface, or a noise's breadth below, is not hidden by it.
            behind[k] = bool((surface_coordinate > point[2] + 0.05 * size).any())
        return behind


def _plane_cross_product(a: Array, b: Array) -> Array:
    """Return the cross product (…) of vectors in the plane (…, 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
