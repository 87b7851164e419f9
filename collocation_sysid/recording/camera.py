"""Cameras: how points in front of a lens appear in the pixels of an image.

A camera's frame has x to the right, y downwards, z along the optical axis; the centre of the first
pixel is (0, 0). With x' = X/Z, y' = Y/Z and r² = x'² + y'², the model "pinhole" has the distortion of
Brown and Conrady, in the order of OpenCV,

    x'' = x' s + 2 p1 x' y' + p2 (r² + 2 x'²),   y'' = y' s + p1 (r² + 2 y'²) + 2 p2 x' y',
    s = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶),

and the model "fisheye" the equidistant one of Kannala and Brandt, with θ = atan r,

    (x'', y'') = (x', y') θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) / r.

The pixel is K (x'', y'', 1).
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from ..common.array_types import Array
from ..common.checked_arrays import read_only_floats, unconverted, unconverted_or_none
from ..common.declarations import declaration, key
from ..common.schema_tables import Vector
from ..common.validated_types import AtLeastOne, Finite
from ..errors import InputError
from .poses import PoseSequence

MatrixRow = tuple[Finite, Finite, Finite, Finite]
PoseMatrix = tuple[MatrixRow, MatrixRow, MatrixRow, MatrixRow]
Lens = Literal["pinhole", "fisheye"]
# Columns and rows of an image.
ImageSize = tuple[
    Annotated[AtLeastOne, Field(le=100_000)], Annotated[AtLeastOne, Field(le=100_000)]
]
# Names of the coefficients of each lens, in their order.
COEFFICIENTS: dict[Lens, str] = {
    "pinhole": "k1, k2, p1, p2, k3, k4, k5, k6",
    "fisheye": "k1, k2, k3, k4",
}
# Numbers of coefficients that each lens may have: p1 and p2 belong together, and rational lenses
# have all eight.
COUNTS: dict[Lens, tuple[int, ...]] = {"pinhole": (0, 1, 2, 4, 5, 8), "fisheye": (0, 4)}
# Fixed-point iterations that invert the distortion; each gains two digits for usual lenses.
UNDISTORTION_ITERATIONS = 12
# Newton iterations for lenses for which the fixed-point iteration does not converge.
NEWTON_ITERATIONS = 30
# Error above which Newton's method continues the fixed-point iteration [pixels].
USUAL_DISTORTION_ERROR_PX = 1e-3
# Error of an inverted distortion above which the iteration counts as not converged [pixels].
LARGEST_DISTORTION_ERROR_PX = 1.0
# Added to r² of a fisheye, so that θ/r has derivatives on the optical axis; far below rounding.
ON_AXIS = 1e-18

X = TypeVar("X", Array, ca.SX)


def _require_poses(poses: PoseSequence) -> PoseSequence:
    if not isinstance(poses, PoseSequence):
        raise InputError(f"poses of a camera is {type(poses).__name__}; expected a PoseSequence")
    return poses


@declaration
class Camera:
    """A camera: of images of points (`ImageTracks`), a depth camera, or the frame of a scanner.

    Parameters
    ----------
    matrix : (3, 3) array, optional
        Camera matrix: [[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels. Clouds of a scanner need
        none. If a cloud of a depth camera has one, an offset and a scale error of the depth are
        estimated, and surfaces that face away from the camera are not used.
    distortion : sequence of numbers
        Coefficients in the order of OpenCV. "pinhole": one, two, four, five or eight of k1,
        k2, p1, p2, k3, k4, k5, k6. "fisheye": four, k1 to k4.
    model : {"pinhole", "fisheye"}
        Model of the lens: Brown and Conrady, or the equidistant fisheye.
    size_px : (int, int), optional
        Columns and rows of the images for which matrix and distortion hold.
    pose : (4, 4) array
        Transform from the frame of the camera to the world or, with `poses`, to the frame whose
        poses these are (hand–eye transform).
    poses : PoseSequence, optional
        Motion of the frame that carries the camera; at rest by default.

    Raises
    ------
    InputError
        If the matrix is not that of a camera, the model has another number of coefficients, or the
        pose is no rigid motion.
    """

    description_name: ClassVar[str] = "camera"

    matrix: Array | None = key(
        tuple[Vector, Vector, Vector] | None, converter=unconverted_or_none, default=None
    )
    distortion: Array = key(list[Finite], converter=unconverted, default=())
    pose: Array = key(PoseMatrix | None, converter=unconverted, default=None)
    poses: PoseSequence | None = key(converter=_require_poses, default=None)
    model: Lens = key(Lens, default="pinhole")
    size_px: tuple[int, int] | None = key(ImageSize | None, default=None)

    def __post_init__(self) -> None:
        pose = read_only_floats(np.eye(4) if self.pose is None else self.pose, (4, 4), name="pose")
        turn = pose[:3, :3]
        rigid = np.allclose(turn @ turn.T, np.eye(3), atol=1e-4) and np.linalg.det(turn) > 0
        if not rigid or not np.allclose(pose[3], [0, 0, 0, 1]):
            raise InputError(
                f"pose of a camera is {pose.tolist()}; expected a rigid motion "
                "[[R, p], [0, 0, 0, 1]] from its frame to the world, in metres"
            )
        distortion = read_only_floats(self.distortion, (None,), name="distortion of a camera")
        if len(distortion) not in COUNTS[self.model]:
            counts = "none, one, two, four, five or eight" if self.model == "pinhole" else "four"
            raise InputError(
                f"distortion has {len(distortion)} numbers; expected {counts} for the model "
                f'"{self.model}": {COEFFICIENTS[self.model]}'
            )
        vars(self).update(pose=pose, distortion=distortion)
        if self.matrix is not None:
            matrix = read_only_floats(self.matrix, (3, 3), name="matrix of a camera")
            lower = matrix[[1, 2, 2, 2], [0, 0, 1, 2]]
            if not (np.diag(matrix) > 0).all() or not np.allclose(lower, [0, 0, 0, 1]):
                raise InputError(
                    f"matrix of a camera is {matrix.tolist()}; expected "
                    "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"
                )
            vars(self)["matrix"] = matrix

    def require_matrix(self) -> Array:
        """Return the matrix (3, 3) of the camera, which must have one."""
        assert self.matrix is not None
        return self.matrix

    def pose_at(self, t_s: ArrayLike) -> tuple[Array, Array]:
        """Return rotations R (S, 3, 3) and translations p (S, 3) [m] from the camera's frame to the
        world, x = R X + p, at times (S,) [s]; the same for all times if the camera does not move.

        Raises
        ------
        InputError
            If the poses of a moving camera do not cover a time, see `PoseSequence.at`.
        """
        times = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        rotation = self.pose[:3, :3]
        translation = self.pose[:3, 3]
        if self.poses is None:
            return np.tile(rotation, (len(times), 1, 1)), np.tile(translation, (len(times), 1))
        rotations, translations = self.poses.at(times)
        return rotations @ rotation, rotations @ translation + translations

    def distort(self, x: X, y: X) -> tuple[X, X]:
        """Return the distorted coordinates (x'', y'') of x' and y', as arrays or expressions."""
        r2 = x * x + y * y
        if self.model == "fisheye":
            math: Any = ca if isinstance(x, ca.SX) else np
            r = math.sqrt(r2 + ON_AXIS)
            angle = (math.atan if isinstance(x, ca.SX) else math.arctan)(r)
            k1, k2, k3, k4 = self._coefficients(4)
            a2 = angle * angle
            factor: Any = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))) / r
            return factor * x, factor * y
        k1, k2, p1, p2, k3, *rational = self._coefficients(8)
        radial: Any = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        if any(rational):
            k4, k5, k6 = rational
            radial = radial / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        xy = x * y
        return (
            x * radial + 2 * p1 * xy + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * xy,
        )

    def _coefficients(self, count: int) -> list[float]:
        return [*self.distortion.tolist(), *[0.0] * (count - len(self.distortion))]

    def points_at_unit_depth(self, pixels: Array) -> Array:
        """Return the points (P, 3) at depth z = 1 in the camera's frame that appear at the pixels
        (P, 2), u and v.

        Distortion is inverted by `UNDISTORTION_ITERATIONS` steps of a fixed-point iteration and, if
        these do not converge, by Newton's method. The camera must have a matrix.

        Raises
        ------
        InputError
            If the iteration does not converge for a pixel.
        """
        rows = np.column_stack([pixels, np.ones(len(pixels))])
        distorted = np.asarray(np.linalg.solve(self.require_matrix(), rows.T).T, dtype=np.float64)
        if not len(self.distortion) and self.model == "pinhole":
            return np.column_stack([distorted[:, :2], np.ones(len(pixels))])
        points = np.column_stack([self._undistorted(distorted[:, :2]), np.ones(len(pixels))])
        off_px = np.abs(self.distorted_pixels(points) - pixels)
        if not np.all(off_px <= LARGEST_DISTORTION_ERROR_PX):
            raise InputError(
                f"distortion of a camera is {self.distortion.tolist()}, which cannot be inverted "
                f"within the image; expected {COEFFICIENTS[self.model]} of a calibration, in this "
                "order"
            )
        return points

    def _undistorted(self, distorted: Array) -> Array:
        """Return the coordinates (P, 2) whose distorted ones are given, perhaps inexactly."""
        if self.model == "fisheye":
            return self._by_newton(distorted, start=self._tangents(distorted))
        k1, k2, p1, p2, k3, k4, k5, k6 = self._coefficients(8)
        undistorted = distorted.copy()
        with np.errstate(all="ignore"):
            for _ in range(UNDISTORTION_ITERATIONS):
                x, y = undistorted.T
                r2 = x**2 + y**2
                radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
                radial = radial / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
                across = 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
                down = p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
                undistorted = (distorted - np.column_stack([across, down])) / radial[:, None]
            off = np.abs(np.column_stack(self.distort(*undistorted.T)) - distorted)
        error_px = off * self.require_matrix()[0, 0]
        if np.all(error_px <= USUAL_DISTORTION_ERROR_PX):
            return undistorted
        is_near = np.all(error_px <= LARGEST_DISTORTION_ERROR_PX, axis=1, keepdims=True)
        return self._by_newton(distorted, start=np.where(is_near, undistorted, distorted))

    def _tangents(self, distorted: Array) -> Array:
        """Return the coordinates (P, 2) for a fisheye without coefficients."""
        angle = np.minimum(np.linalg.norm(distorted, axis=1, keepdims=True), 1.5)
        return distorted * np.tan(angle) / np.maximum(angle, ON_AXIS)

    def _by_newton(self, distorted: Array, start: Array) -> Array:
        """Return the coordinates (P, 2) by damped steps of Newton's method from a start (P, 2)."""
        xy = ca.SX.sym("xy", 2)
        image = ca.vertcat(*self.distort(xy[0], xy[1]))
        slopes = ca.Function("slopes", [xy], [image, ca.jacobian(image, xy)]).map(len(start))
        points = start.copy()
        for _ in range(NEWTON_ITERATIONS):
            value, jacobian = (each.full() for each in slopes(points.T))
            by = jacobian.reshape(2, len(points), 2).transpose(1, 0, 2)
            step = np.linalg.solve(by, (distorted - value.T)[..., None])[..., 0]
            longest = np.linalg.norm(step, axis=1, keepdims=True)
            allowed = 0.5 * (1 + np.linalg.norm(points, axis=1, keepdims=True))
            points = points + step * np.minimum(1.0, allowed / np.maximum(longest, ON_AXIS))
        return points

    def distorted_pixels(self, points_m: Array) -> Array:
        """Return the pixels (P, 2), u and v, of points (P, 3) in the camera's frame, with
        distortion.

        At z = 1 this is the inverse of `points_at_unit_depth`. Points must be in front of the
        camera, z > 0, and the camera must have a matrix.
        """
        x, y = (points_m[:, :2] / points_m[:, 2:]).T
        distorted = np.stack([*self.distort(x, y), np.ones_like(x)])
        return (self.require_matrix() @ distorted)[:2].T

    def pixel_expression(
        self, point: ca.SX, focal: ca.SX | float = 0.0, centre: ca.SX | None = None
    ) -> ca.SX:
        """Return the pixel (2,) of a point (3,) in the camera's frame, in front of the camera.

        Parameters
        ----------
        point : (3,) SX
        focal : SX or float
            Error of both focal lengths: the factor minus one.
        centre : (2,) SX, optional
            Error of the principal point [pixels].
        """
        x, y = self.distort(point[0] / point[2], point[1] / point[2])
        matrix = self.require_matrix()
        pixel = (1 + focal) * (ca.DM(matrix[:2, :2]) @ ca.vertcat(x, y)) + ca.DM(matrix[:2, 2])
        return pixel if centre is None else pixel + centre

    def undistorted_pixels(self, points_m: Array) -> Array:
        """Return the pixels (P, 2), u and v, of points (P, 3) in the camera's frame, without
        distortion; points must have z > 0, and the camera a matrix.
        """
        projected = points_m @ self.require_matrix().T
        return projected[:, :2] / projected[:, 2:]
