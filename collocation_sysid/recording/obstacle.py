"""What a body may touch: a table, a plate, a finger, at rest or moving."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import field, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from pydantic import model_validator
from scipy.spatial.transform import Rotation

from ..arrays import Array, Index
from ..checked import NotNegative, Positive, Text
from ..errors import InputError
from ..fem.constants import Constant
from ..fem.selection import Selection
from ..fem.touching import Touching
from ..section import Section, Vector, require_one, section_of, stated_in
from ..stated import key, stated
from .arrays import floats
from .grasp import Grasp
from .poses import PoseSequence
from .selected import Nodes, selection

if TYPE_CHECKING:
    from ..fem.body import Body

LARGEST_FRICTION = 2.0
# Below it the square root of a distance has no second derivative.
TINY_M2 = 1e-24


class Shape(ABC):
    """A solid, in the frame of its obstacle: that of the world where the obstacle rests."""

    @abstractmethod
    def gap(self, point: ca.SX) -> ca.SX:
        """How far outside a point (3,) is [m]; negative inside."""

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
class Plane(Shape):
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

    def gap(self, point: ca.SX) -> ca.SX:
        """Along the normal."""
        return ca.dot(ca.DM(self.normal), point - ca.DM(self.point_m))


@stated
class Sphere(Shape):
    """A ball, such as the tip of a probe.

    Parameters
    ----------
    radius_m : float
    centre_m : (3,) array
    """

    radius_m: float = key(Positive)
    centre_m: Array = key(Vector, converter=floats((3,), "centre_m"), default=(0.0,) * 3)

    def gap(self, point: ca.SX) -> ca.SX:
        """From its surface."""
        return _length(point - ca.DM(self.centre_m)) - self.radius_m


class _Round(Shape):
    """A solid about an axis between two ends."""

    radius_m: float
    ends_m: Array

    def _along(self, point: ca.SX) -> tuple[ca.SX, ca.SX, float]:
        """How far along the axis from the middle, how far from it, and half of its length."""
        first, last = self.ends_m
        half = float(np.linalg.norm(last - first)) / 2
        if not half > 0:
            raise InputError("the ends of an axis are at the same place; expected two places")
        axis, away = ca.DM((last - first) / (2 * half)), point - ca.DM((first + last) / 2)
        along = ca.dot(axis, away)
        return along, _length(away - along * axis), half


def _ends(value: Any) -> Array:
    return floats((2, 3), "ends_m")(value)


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

    radius_m: float = key(Positive)
    ends_m: Array = key(tuple[Vector, Vector], converter=_ends)
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

    radius_m: float = key(Positive)
    ends_m: Array = key(tuple[Vector, Vector], converter=_ends)

    def gap(self, point: ca.SX) -> ca.SX:
        """From its surface."""
        along, away, half = self._along(point)
        beyond = ca.fmax(ca.fabs(along) - half, 0)
        return _length(ca.vertcat(beyond, away)) - self.radius_m


@stated
class Cuboid(Shape):
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

    def gap(self, point: ca.SX) -> ca.SX:
        """From its surface."""
        low, high = self.corners_m
        beyond = ca.fabs(point - ca.DM((low + high) / 2)) - ca.DM((high - low) / 2)
        return _of_corner(beyond + self.rounding_m) - self.rounding_m


def _length(vector: ca.SX) -> ca.SX:
    return ca.sqrt(ca.sumsqr(vector) + TINY_M2)


def _of_corner(beyond: ca.SX) -> ca.SX:
    """Distance from a corner, by how far a point is beyond each of its sides."""
    return _length(ca.fmax(beyond, 0)) + ca.fmin(ca.mmax(beyond), 0)


class ShapeSection(Section):
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

    plane: section_of(Plane, "PlaneSection") | None = None
    sphere_m: section_of(Sphere, "SphereSection") | None = None
    cylinder_m: section_of(Cylinder, "CylinderSection") | None = None
    capsule_m: section_of(Capsule, "CapsuleSection") | None = None
    box_m: section_of(Cuboid, "CuboidSection") | None = None

    @model_validator(mode="after")
    def _one(self) -> ShapeSection:
        require_one(self, *type(self).model_fields)
        return self


KINDS: dict[str, type[Shape]] = {
    "plane": Plane,
    "sphere_m": Sphere,
    "cylinder_m": Cylinder,
    "capsule_m": Capsule,
    "box_m": Cuboid,
}


def shape_of(section: ShapeSection) -> Shape:
    """What a table states."""
    ((name, own),) = ((name, own) for name, own in section if own is not None)
    return KINDS[name](**stated_in(own, KINDS[name], name))


def _shape(shape: Any) -> Shape:
    if not isinstance(shape, Shape):
        kinds = ", ".join(kind.__name__ for kind in KINDS.values())
        raise InputError(f"shape of an obstacle is {shape!r}; expected one of {kinds}")
    return shape


def _faces(faces: Any) -> Selection:
    if not isinstance(faces, Selection):
        raise InputError(f"faces of an obstacle is {faces!r}; expected a selection")
    return faces


@stated
class Obstacle(Grasp):
    """A rigid solid that pushes away the surface of a body, and may rub on it.

    It is a grasp that holds nothing but a frame of its own, so that poses, displacements and forces
    are stated and read as those of grasps are. Its force is that on the body.

    Parameters
    ----------
    shape : Shape
        Plane, Sphere, Cylinder, Capsule or Cuboid.
    poses : PoseSequence or (T, 4, 4) array
        Where its frame is; at rest in the body's frame by default.
    name : str
        For messages and pictures.
    friction : float or str
        Coefficient of friction; or the name of a parameter, whose bounds are 0 and 2.
    faces : Selection, optional
        Faces that it may touch: those with all corners there. All by default.
    stiffness_pa_m : float, optional
        κ of the pressure κ ⟨δ − g⟩²/δ at the gap g; a hundred times E over the length of an edge by
        default, at the E of the trial.
    width_m : float, optional
        δ, the gap at which it begins; a five-hundredth of an edge by default.
    slip : float, optional
        Speed [m/s], or slip from sample to sample [m] of a static experiment, at which friction is
        seven tenths of its limit.
    wrench : Wrench, optional
        What it was measured to give the body.

    Raises
    ------
    InputError
        If the friction is out of its bounds.
    """

    nodes: Index = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    poses: PoseSequence = field(default_factory=PoseSequence.fixed)
    shape: Shape = key(ShapeSection, read=shape_of, converter=_shape, kw_only=True)
    name: str = key(Text, default="obstacle", kw_only=True)
    friction: float | str = key(NotNegative | Text, default=0.0, kw_only=True)
    faces: Selection | None = key(
        Nodes | None, converter=_faces, read=selection, default=None, kw_only=True
    )
    stiffness_pa_m: float | None = key(Positive | None, default=None, kw_only=True)
    width_m: float | None = key(Positive | None, default=None, kw_only=True)
    slip: float | None = key(Positive | None, default=None, kw_only=True)

    def __post_init__(self) -> None:
        self._begin()
        if self.axes != "xyz":
            raise InputError(f"axes of {self.name} is {self.axes!r}; expected none: it is rigid")
        if isinstance(self.friction, float) and self.friction > LARGEST_FRICTION:
            raise InputError(
                f"friction of {self.name} is {self.friction:g}; expected 0 to {LARGEST_FRICTION:g}"
            )

    def framed(self, frame: Index, t_s: Array) -> Obstacle:
        """The same with the nodes (4,) of its frame, and matrices as the poses at `t_s`."""
        poses = self.poses
        if not isinstance(poses, PoseSequence):
            poses = PoseSequence.from_matrices(t_s, poses)
        placed = poses is self.poses and np.array_equal(frame, self.nodes)
        return self if placed else replace(self, nodes=frame, poses=poses)

    def surface(self, body: Body) -> Touching:
        """Where it may touch a body; that is kept."""
        return _touching(body, self)

    @property
    def direction(self) -> Array:
        """(3,) along which its place may be off: as it is displaced, or of its shape."""
        along = np.array([float(axis in self.zero) for axis in "xyz"])
        return along if along.any() else self.shape.normal

    @property
    def across(self) -> Array:
        """(2, 3) axes that it may be tilted about: they complete its normal to a basis."""
        return np.linalg.svd(self.shape.normal[None])[2][1:]

    def off_by(self, offset_m: float, tilt_rad: Array, late_s: float) -> Obstacle:
        """The same elsewhere, by a shift along its direction, a tilt (2,), and later."""
        motion, middle = np.eye(4), self.shape.middle_m
        motion[:3, :3] = Rotation.from_rotvec(tilt_rad @ self.across).as_matrix()
        motion[:3, 3] = middle - motion[:3, :3] @ middle + offset_m * self.direction
        poses = self.poses.after(motion)
        return replace(self, poses=replace(poses, t_s=poses.t_s + late_s))

    @property
    def rubs(self) -> bool:
        """Whether there is friction."""
        return self.friction != 0

    @cached_property
    def coefficient(self) -> Constant | None:
        """Its friction as a parameter; None where it is a number."""
        return friction_named(self.friction) if isinstance(self.friction, str) else None


@lru_cache(maxsize=32)
def _touching(body: Body, obstacle: Obstacle) -> Touching:
    return Touching.of(body, obstacle.nodes, obstacle.faces)


def friction_named(name: str) -> Constant:
    """A coefficient of friction as a parameter."""
    bounds = 0.0, LARGEST_FRICTION
    return Constant(name, "μ_f", "friction", bounds, "linear", 0.1, 0.3, at_least=0.0)


def with_frames_of(body: Body, obstacles: Sequence[Obstacle]) -> Body:
    """A body that has frames for obstacles."""
    named = (each.coefficient for each in obstacles)
    frictions = tuple(dict.fromkeys(constant for constant in named if constant is not None))
    return body.with_frames(len(obstacles), any(each.rubs for each in obstacles), frictions)
