"""Bodies in space on plain axes: a parallel projection, shaded triangles, and what they hide.

matplotlib's own 3-D axes cost tenths of a second each and leave wide margins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ...arrays import Array

Triangles = NDArray[np.integer]

# The view is turned off the plane of motion, and looks down, by these angles.
TURN_DEG, ELEVATION_DEG = 25.0, 18.0
# Brightness of a face turned away from the light, and the light in the camera's own axes.
AMBIENT = 0.62
LIGHT = np.array([-0.4, 0.5, 0.8]) / np.linalg.norm([-0.4, 0.5, 0.8])


@dataclass(frozen=True, eq=False)
class Camera:
    """A direction to look from.

    Attributes
    ----------
    axes : (3, 3)
        Rows: the picture's right, the picture's top, and towards the viewer; orthonormal.
    """

    axes: Array

    @classmethod
    def looking(cls, towards: ArrayLike, up: ArrayLike) -> Camera:
        """Look from the direction `towards`, `up` being upright in the picture."""
        near = np.asarray(towards, dtype=float)
        near = near / np.linalg.norm(near)
        right = np.cross(np.asarray(up, dtype=float), near)
        right /= np.linalg.norm(right)
        return cls(np.array([right, np.cross(near, right), near]))

    @classmethod
    def facing(cls, positions_m: Array, up: ArrayLike) -> Camera:
        """Look at the plane in which a body (T, n, 3) moves most, or is widest, from aside.

        The direction is level but for a glance from above.
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
        return cls.looking(least, up).turned(TURN_DEG, up).raised(ELEVATION_DEG)

    def turned(self, angle_deg: float, up: ArrayLike) -> Camera:
        """Walk around the body, about `up`."""
        turn = Rotation.from_rotvec(np.radians(angle_deg) * np.asarray(up, dtype=float))
        return Camera(turn.apply(self.axes))

    def raised(self, angle_deg: float) -> Camera:
        """Look from higher up."""
        angle = np.radians(angle_deg)
        right, top, near = self.axes
        higher = np.cos(angle) * near + np.sin(angle) * top
        return Camera(np.array([right, np.cross(higher, right), higher]))

    def project(self, points_m: ArrayLike) -> Array:
        """Places in the picture, (…, 3) to (…, 2) metres."""
        return np.asarray(points_m) @ self.axes[:2].T

    def nearness(self, points_m: ArrayLike) -> Array:
        """Distance towards the viewer, (…, 3) to (…) metres."""
        return np.asarray(points_m) @ self.axes[2]

    def faces(
        self, positions_m: Array, surface: Triangles
    ) -> tuple[Array, Array, NDArray[np.int64]]:
        """Triangles that are turned to the viewer, from far to near.

        Returns
        -------
        polygons : (k, 3, 2) places in the picture
        brightness : (k,) from `AMBIENT` to 1
        chosen : (k,) which of the surface's they are
        """
        corners = positions_m[surface] @ self.axes.T
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        front = np.flatnonzero(normals[:, 2] > 0)
        order = front[np.argsort(corners[front, :, 2].mean(axis=1), kind="stable")]
        light = np.clip(normals[order] @ LIGHT, 0.0, 1.0)
        return corners[order, :, :2], AMBIENT + (1 - AMBIENT) * light, order

    def hidden(self, points_m: Array, positions_m: Array, surface: Triangles) -> NDArray[np.bool_]:
        """Which points (k, 3) lie behind the surface; NaN does not."""
        corners = positions_m[surface] @ self.axes.T
        points = np.asarray(points_m) @ self.axes.T
        size = np.ptp(positions_m, axis=0).max()
        a, b, c = (corners[:, i, :2] for i in range(3))
        area = _cross(b - a, c - a)
        facing = area > 1e-9 * size**2
        a, b, c, area, depth = a[facing], b[facing], c[facing], area[facing], corners[facing, :, 2]
        behind = np.zeros(len(points), dtype=bool)
        for k, point in enumerate(points):
            place = point[:2]
            weights = np.stack(
                [_cross(b - place, c - place), _cross(c - place, a - place)], axis=1
            ) / area[:, None]  # fmt: skip
            weights = np.column_stack([weights, 1 - weights.sum(axis=1)])
            over = (weights >= 0).all(axis=1)
            ahead = np.einsum("kc,kc->k", weights[over], depth[over])
            # A marker on the surface, or a noise's breadth below, is not hidden by it.
            behind[k] = bool((ahead > point[2] + 0.05 * size).any())
        return behind


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
