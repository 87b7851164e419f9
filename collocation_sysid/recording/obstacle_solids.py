"""Rigid solids that a body may touch, each given by its signed distance, and their tables in a
problem file.
"""

# ruff: noqa: D101 (the table of a class has the summary of that class)
from __future__ import annotations

from abc import ABC, abstractmethod
from functools import lru_cache
from itertools import product
from typing import ClassVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from pydantic import model_validator

from ..common.array_types import Array
from ..common.checked_arrays import float_converter, point_text
from ..common.declarations import declaration, key
from ..common.schema_tables import Section, Vector, declared_in, require_one
from ..common.validated_types import NotNegative, Positive
from ..errors import InputError

# Added to squared distances [m²]: the square root has no derivative at zero.
SMALLEST_SQUARE_M2 = 1e-24


class Solid(ABC):
    """A rigid solid in the frame of its obstacle: the world's frame if the obstacle is at rest.

    Attributes
    ----------
    has_tilt : bool
        Whether a tilt of the solid may be estimated.
    """

    has_tilt: ClassVar[bool] = False

    @abstractmethod
    def signed_distance(self, point: ca.SX) -> ca.SX:
        """Return the signed distance of a point (3,) from the surface [m], an expression; negative
        inside.
        """

    def signed_distances_m(self, points_m: Array) -> Array:
        """Return the signed distances (n,) of points (n, 3) from the surface [m]."""
        return _distance(self)(points_m.T).full()[0]

    @abstractmethod
    def outline_polylines(self, about_m: Array, size_m: float) -> list[Array]:
        """Return polylines (k, 3) that draw the solid.

        Parameters
        ----------
        about_m : (3,) array
            Point near which an unbounded solid is drawn.
        size_m : float
            Length of the drawn part of an unbounded solid.
        """

    @property
    def offset_direction(self) -> Array:
        """(3,) unit vector along which the solid's position is uncertain: the z axis unless a solid
        states another.
        """
        return np.array([0.0, 0.0, 1.0])

    @property
    def tilt_centre_m(self) -> Array:
        """(3,) point about which the solid is tilted [m]; the origin unless a solid states another
        one.
        """
        return np.zeros(3)


def _unit_normal(value: ArrayLike) -> Array:
    vector = float_converter((3,), "normal of a plane")(value)
    length = float(np.linalg.norm(vector))
    if not length > 0:
        raise InputError("normal of a plane is zero; expected a direction")
    return vector / length


@lru_cache(maxsize=64)
def _distance(solid: Solid) -> ca.Function:
    point = ca.SX.sym("point", 3)
    return ca.Function("distance", [point], [solid.signed_distance(point)])


@declaration
class Plane(Solid):
    """The half-space behind a plane.

    Parameters
    ----------
    normal : (3,) array
        Direction out of the solid.
    point_m : (3,) array
        A point on the plane.
    """

    has_tilt: ClassVar[bool] = True

    normal: Array = key(Vector, converter=_unit_normal, default=(0.0, 0.0, 1.0))
    point_m: Array = key(
        Vector, converter=float_converter((3,), "point_m of a plane"), default=(0.0,) * 3
    )

    @property
    def offset_direction(self) -> Array:
        return self.normal

    @property
    def tilt_centre_m(self) -> Array:
        return self.point_m

    def outline_polylines(self, about_m: Array, size_m: float) -> list[Array]:
        """Return a closed polyline (5, 3) of a square with edges of `size_m` about the point of the
        plane that is nearest to `about_m` (3,).
        """
        middle = about_m - (about_m - self.point_m) @ self.normal * self.normal
        u, v = orthogonal_axes(self.normal) * size_m / 2
        corners = [middle + a * u + b * v for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1))]
        return [np.array(corners)]

    def signed_distance(self, point: ca.SX) -> ca.SX:
        """Return the signed distance of a point (3,) from the plane along its normal [m]; negative
        behind the plane.
        """
        return ca.dot(ca.DM(self.normal), point - ca.DM(self.point_m))


@declaration
class Sphere(Solid):
    """A ball, such as the tip of a probe.

    Parameters
    ----------
    radius_m : float
    centre_m : (3,) array
    """

    radius_m: float = key(Positive)
    centre_m: Array = key(Vector, converter=float_converter((3,), "centre_m"), default=(0.0,) * 3)

    def outline_polylines(self, about_m: Array, size_m: float) -> list[Array]:
        return [_circle(self.centre_m, axis, radius_m=self.radius_m) for axis in np.eye(3)]

    def signed_distance(self, point: ca.SX) -> ca.SX:
        return _length(point - ca.DM(self.centre_m)) - self.radius_m


def _checked_ends(value: ArrayLike) -> Array:
    ends = float_converter((2, 3), "ends_m")(value)
    if (ends[0] == ends[1]).all():
        raise InputError(
            f"both ends of the axis are at {point_text(ends[0])} m; expected two different points"
        )
    return ends


@declaration
class _AxialSolid(Solid):
    """A solid of revolution about an axis between two ends."""

    radius_m: float = key(Positive)
    ends_m: Array = key(tuple[Vector, Vector], converter=_checked_ends)

    def outline_polylines(self, about_m: Array, size_m: float) -> list[Array]:
        axis = np.diff(self.ends_m, axis=0)[0]
        first, last = (_circle(end, axis, radius_m=self.radius_m) for end in self.ends_m)
        quarters = range(0, len(first) - 1, (len(first) - 1) // 4)
        return [first, last, *(np.array([first[k], last[k]]) for k in quarters)]

    def _beyond_ends_and_radius(self, point: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Return the distances [m] beyond the nearer end and from the axis."""
        first, last = self.ends_m
        half = float(np.linalg.norm(last - first)) / 2
        axis = ca.DM((last - first) / (2 * half))
        offset = point - ca.DM((first + last) / 2)
        axial = ca.dot(axis, offset)
        return ca.fabs(axial) - half, _length(offset - axial * axis)


@declaration
class Cylinder(_AxialSolid):
    """A cylinder with flat ends, whose edges may be rounded.

    Parameters
    ----------
    radius_m : float
    ends_m : (2, 3) array
        Centres of both ends.
    rounding_m : float
        Radius of the rounded edges [m]; zero for sharp edges.
    """

    rounding_m: float = key(NotNegative, default=0.0)

    def signed_distance(self, point: ca.SX) -> ca.SX:
        along_m, radial_m = self._beyond_ends_and_radius(point)
        beyond = ca.vertcat(radial_m - self.radius_m, along_m)
        return _corner_distance(beyond + self.rounding_m) - self.rounding_m


@declaration
class Capsule(_AxialSolid):
    """A cylinder with a half-ball at each end, such as a finger.

    Parameters
    ----------
    radius_m : float
    ends_m : (2, 3) array
        Centres of the balls.
    """

    def signed_distance(self, point: ca.SX) -> ca.SX:
        along_m, radial_m = self._beyond_ends_and_radius(point)
        return _length(ca.vertcat(ca.fmax(along_m, 0), radial_m)) - self.radius_m


@declaration
class Cuboid(Solid):
    """A box along the axes of its frame, whose edges may be rounded.

    Parameters
    ----------
    corners_m : (2, 3) array
        Lowest and highest corner.
    rounding_m : float
        Radius of the rounded edges [m]; zero for sharp edges.
    """

    has_tilt: ClassVar[bool] = True

    corners_m: Array = key(tuple[Vector, Vector], converter=float_converter((2, 3), "corners_m"))
    rounding_m: float = key(NotNegative, default=0.0)

    def __post_init__(self) -> None:
        if not (self.corners_m[0] < self.corners_m[1]).all():
            raise InputError(
                f"a box has the corners {self.corners_m.tolist()}; expected the lower one first, "
                "below the other along every axis"
            )

    @property
    def tilt_centre_m(self) -> Array:
        return self.corners_m.mean(axis=0)

    def outline_polylines(self, about_m: Array, size_m: float) -> list[Array]:
        corners = np.array(list(product(*self.corners_m.T)))
        differences = (corners[:, None] != corners).sum(axis=2)
        return [corners[[i, j]] for i, j in np.argwhere(differences == 1) if i < j]

    def signed_distance(self, point: ca.SX) -> ca.SX:
        low, high = self.corners_m
        beyond = ca.fabs(point - ca.DM((low + high) / 2)) - ca.DM((high - low) / 2)
        return _corner_distance(beyond + self.rounding_m) - self.rounding_m


def orthogonal_axes(normal: Array) -> Array:
    """Return two unit vectors (2, 3) orthogonal to a nonzero direction (3,) and to each other, which
    hardly change with small changes of the direction.
    """
    # Weights, because directions in the middle between two axes are common, too.
    k = np.argmax(np.abs(normal) * [1.0, 1.5, 2.0])
    across = np.cross(normal, np.eye(3)[k - 1])
    axes = np.array([np.cross(across, normal), across])
    return axes / np.linalg.norm(axes, axis=1)[:, None]


def _circle(centre_m: Array, axis: Array, radius_m: float) -> Array:
    """Return a closed polyline (33, 3) of a circle across an axis (3,) of any length."""
    angle = np.linspace(0, 2 * np.pi, 33)
    round_m = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ orthogonal_axes(axis)
    return centre_m + radius_m * round_m


def _length(vector: ca.SX) -> ca.SX:
    """Return √(|v|² + 1e-24 m²), with finite second derivatives at zero."""
    return ca.sqrt(ca.sumsqr(vector) + SMALLEST_SQUARE_M2)


def _corner_distance(beyond: ca.SX) -> ca.SX:
    """Return the signed distance [m] from a convex corner by those from its sides."""
    return _length(ca.fmax(beyond, 0)) + ca.fmin(ca.mmax(beyond), 0)


KINDS: dict[str, type[Solid]] = {
    "plane": Plane,
    "sphere_m": Sphere,
    "cylinder_m": Cylinder,
    "capsule_m": Capsule,
    "box_m": Cuboid,
}


def solid_key(solid: Solid) -> str:
    """Return the key of a solid's kind in a problem file, such as "sphere_m"."""
    return next(name for name, kind in KINDS.items() if isinstance(solid, kind))


class PlaneSection(Section, of=Plane): ...


class SphereSection(Section, of=Sphere): ...


class SolidCylinderSection(Section, of=Cylinder): ...


class CapsuleSection(Section, of=Capsule): ...


class CuboidSection(Section, of=Cuboid): ...


class SolidSection(Section):
    """Rigid solid, described by exactly one of these keys in the frame of its poses.

    Without poses the frame is that of the undeformed body.

    Attributes
    ----------
    plane : PlaneSection, optional
        The half-space behind a plane: normal, point_m.
    sphere_m : SphereSection, optional
        A ball: radius_m, centre_m.
    cylinder_m : SolidCylinderSection, optional
        A cylinder: radius_m, ends_m, rounding_m.
    capsule_m : CapsuleSection, optional
        A cylinder with a half-ball at each end: radius_m, ends_m.
    box_m : CuboidSection, optional
        A box: corners_m, rounding_m.
    """

    plane: PlaneSection | None = None
    sphere_m: SphereSection | None = None
    cylinder_m: SolidCylinderSection | None = None
    capsule_m: CapsuleSection | None = None
    box_m: CuboidSection | None = None

    @model_validator(mode="after")
    def _require_one_solid(self) -> SolidSection:
        require_one(self, *type(self).model_fields)
        return self


def solid_from_section(section: SolidSection) -> Solid:
    """Return the solid that a table states by its only key; errors of the solid name that key."""
    ((name, own),) = ((name, own) for name, own in section if own is not None)
    return own.of(**declared_in(own, where=name))
