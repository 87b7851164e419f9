"""Solids that a body may touch, by how far a point is outside them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from itertools import product
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from pydantic import model_validator

from ..arrays import Array
from ..checked import NotNegative, Positive
from ..errors import InputError
from ..section import Section, Vector, require_one, section_of, stated_in
from ..stated import key, stated
from .arrays import floats

# Below it the square root of a distance has no second derivative.
TINY_M2 = 1e-24


class Solid(ABC):
    """A solid, in the frame of its obstacle: that of the world where the obstacle rests."""

    @abstractmethod
    def gap(self, point: ca.SX) -> ca.SX:
        """How far outside a point (3,) is [m]; negative inside."""

    @abstractmethod
    def outline(self, about_m: Array, size_m: float) -> list[Array]:
        """Polylines (k, 3) for pictures, of a plane about a point and so long."""

    @property
    def normal(self) -> Array:
        """(3,) direction along which its place may be off."""
        return np.array([0.0, 0.0, 1.0])

    @property
    def flat(self) -> bool:
        """Whether it may be tilted."""
        return False

    @property
    def middle_m(self) -> Array:
        """(3,) about which."""
        return np.zeros(3)


def _unit(name: str) -> Any:
    def made(value: Any) -> Array:
        vector = floats((3,), name)(value)
        length = float(np.linalg.norm(vector))
        if not length > 0:
            raise InputError(f"{name} is zero; expected a direction")
        return vector / length

    return made


@stated
class Plane(Solid):
    """All that is behind a plane.

    Parameters
    ----------
    normal : (3,) array
        Direction out of the solid.
    point_m : (3,) array
        A point on the plane.
    """

    normal: Array = key(Vector, converter=_unit("normal of a plane"), default=(0.0, 0.0, 1.0))
    point_m: Array = key(Vector, converter=floats((3,), "point_m of a plane"), default=(0.0,) * 3)

    @property
    def flat(self) -> bool:
        """It may be tilted."""
        return True

    @property
    def middle_m(self) -> Array:
        """Its point."""
        return self.point_m

    def outline(self, about_m: Array, size_m: float) -> list[Array]:
        """A square."""
        middle = about_m - (about_m - self.point_m) @ self.normal * self.normal
        u, v = across(self.normal) * size_m / 2
        corners = [middle + a * u + b * v for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1))]
        return [np.array(corners)]

    def gap(self, point: ca.SX) -> ca.SX:
        """Along the normal."""
        return ca.dot(ca.DM(self.normal), point - ca.DM(self.point_m))


@stated
class Sphere(Solid):
    """A ball, such as the tip of a probe.

    Parameters
    ----------
    radius_m : float
    centre_m : (3,) array
    """

    radius_m: float = key(Positive)
    centre_m: Array = key(Vector, converter=floats((3,), "centre_m"), default=(0.0,) * 3)

    def outline(self, about_m: Array, size_m: float) -> list[Array]:
        """Three circles."""
        return [_circle(self.centre_m, axis, self.radius_m) for axis in np.eye(3)]

    def gap(self, point: ca.SX) -> ca.SX:
        """From its surface."""
        return _length(point - ca.DM(self.centre_m)) - self.radius_m


def _ends(value: Any) -> Array:
    ends = floats((2, 3), "ends_m")(value)
    if (ends[0] == ends[1]).all():
        raise InputError("the ends of an axis are at the same place; expected two places")
    return ends


@stated
class _Round(Solid):
    """A solid about an axis between two ends."""

    radius_m: float = key(Positive)
    ends_m: Array = key(tuple[Vector, Vector], converter=_ends)

    def outline(self, about_m: Array, size_m: float) -> list[Array]:
        """A circle at each end, and four lines between them."""
        axis = np.diff(self.ends_m, axis=0)[0]
        first, last = (_circle(end, axis, self.radius_m) for end in self.ends_m)
        quarters = range(0, len(first) - 1, (len(first) - 1) // 4)
        return [first, last, *(np.array([first[k], last[k]]) for k in quarters)]

    def _along(self, point: ca.SX) -> tuple[ca.SX, ca.SX, float]:
        """How far along the axis from the middle, how far from it, and half of its length."""
        first, last = self.ends_m
        half = float(np.linalg.norm(last - first)) / 2
        axis, away = ca.DM((last - first) / (2 * half)), point - ca.DM((first + last) / 2)
        along = ca.dot(axis, away)
        return along, _length(away - along * axis), half


@stated
class Cylinder(_Round):
    """A cylinder with flat ends, whose edges may be rounded.

    Parameters
    ----------
    radius_m : float
    ends_m : (2, 3) array
        Middles of both ends.
    rounding_m : float
        Radius of its edges.
    """

    rounding_m: float = key(NotNegative, default=0.0)

    def gap(self, point: ca.SX) -> ca.SX:
        """From its surface."""
        along, away, half = self._along(point)
        beyond = ca.vertcat(away - self.radius_m, ca.fabs(along) - half)
        return _of_corner(beyond + self.rounding_m) - self.rounding_m


@stated
class Capsule(_Round):
    """A cylinder with half a ball at each end, such as a finger.

    Parameters
    ----------
    radius_m : float
    ends_m : (2, 3) array
        Centres of the balls.
    """

    def gap(self, point: ca.SX) -> ca.SX:
        """From its surface."""
        along, away, half = self._along(point)
        beyond = ca.fmax(ca.fabs(along) - half, 0)
        return _length(ca.vertcat(beyond, away)) - self.radius_m


@stated
class Cuboid(Solid):
    """A box along the axes of its frame, whose edges may be rounded.

    Parameters
    ----------
    corners_m : (2, 3) array
        Its lowest and its highest corner.
    rounding_m : float
        Radius of its edges.
    """

    corners_m: Array = key(tuple[Vector, Vector], converter=floats((2, 3), "corners_m"))
    rounding_m: float = key(NotNegative, default=0.0)

    def __post_init__(self) -> None:
        if not (self.corners_m[0] < self.corners_m[1]).all():
            raise InputError("the corners of a box have to be its lowest, then its highest")

    @property
    def flat(self) -> bool:
        """It may be tilted."""
        return True

    @property
    def middle_m(self) -> Array:
        """Half way between the corners."""
        return self.corners_m.mean(axis=0)

    def outline(self, about_m: Array, size_m: float) -> list[Array]:
        """Its edges."""
        corners = np.array(list(product(*self.corners_m.T)))
        apart = (corners[:, None] != corners).sum(axis=2)
        return [corners[[i, j]] for i, j in np.argwhere(apart == 1) if i < j]

    def gap(self, point: ca.SX) -> ca.SX:
        """From its surface."""
        low, high = self.corners_m
        beyond = ca.fabs(point - ca.DM((low + high) / 2)) - ca.DM((high - low) / 2)
        return _of_corner(beyond + self.rounding_m) - self.rounding_m


def across(normal: Array) -> Array:
    """(2, 3) axes that complete a direction to a basis."""
    return np.linalg.svd(normal[None])[2][1:]


def _circle(centre_m: Array, axis: Array, radius_m: float) -> Array:
    angle = np.linspace(0, 2 * np.pi, 33)
    round_m = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ across(axis)
    return centre_m + radius_m * round_m


def _length(vector: ca.SX) -> ca.SX:
    return ca.sqrt(ca.sumsqr(vector) + TINY_M2)


def _of_corner(beyond: ca.SX) -> ca.SX:
    """Distance from a corner, by how far a point is beyond each of its sides."""
    return _length(ca.fmax(beyond, 0)) + ca.fmin(ca.mmax(beyond), 0)


if TYPE_CHECKING:
    PlaneSection = SphereSection = CylinderSection = CapsuleSection = CuboidSection = Section
else:
    PlaneSection, SphereSection, CylinderSection, CapsuleSection, CuboidSection = (
        section_of(kind, f"{kind.__name__}Section")
        for kind in (Plane, Sphere, Cylinder, Capsule, Cuboid)
    )


class SolidSection(Section):
    """The solid, by exactly one of these, in the frame of its poses: the body's without.

    Attributes
    ----------
    plane : PlaneSection, optional
        All that is behind a plane: normal, point_m.
    sphere_m : SphereSection, optional
        A ball: radius_m, centre_m.
    cylinder_m : CylinderSection, optional
        A cylinder: radius_m, ends_m, rounding_m.
    capsule_m : CapsuleSection, optional
        A cylinder with half a ball at each end: radius_m, ends_m.
    box_m : CuboidSection, optional
        A box: corners_m, rounding_m.
    """

    plane: PlaneSection | None = None
    sphere_m: SphereSection | None = None
    cylinder_m: CylinderSection | None = None
    capsule_m: CapsuleSection | None = None
    box_m: CuboidSection | None = None

    @model_validator(mode="after")
    def _one(self) -> SolidSection:
        require_one(self, *type(self).model_fields)
        return self


KINDS: dict[str, type[Solid]] = {
    "plane": Plane,
    "sphere_m": Sphere,
    "cylinder_m": Cylinder,
    "capsule_m": Capsule,
    "box_m": Cuboid,
}


def name_of(solid: Solid) -> str:
    """What files call its kind."""
    return next(name for name, kind in KINDS.items() if isinstance(solid, kind))


def solid_of(section: SolidSection) -> Solid:
    """What a table states."""
    ((name, own),) = ((name, own) for name, own in section if own is not None)
    return KINDS[name](**stated_in(own, KINDS[name], name))
