"""Tables of a problem file that state the rigid solid of an obstacle."""

from __future__ import annotations

from pydantic import model_validator

from ..common.schema_tables import Section, Vector, declared_in, require_one
from ..common.validated_types import NotNegative, Positive
from .obstacle_solids import KINDS, Solid


class PlaneSection(Section):
    """The half-space behind a plane.

    Attributes
    ----------
    normal : list
        Direction out of the solid.
    point_m : list
        A point on the plane.
    """

    normal: Vector = (0.0, 0.0, 1.0)
    point_m: Vector = (0.0, 0.0, 0.0)


class SphereSection(Section):
    """A ball, such as the tip of a probe.

    Attributes
    ----------
    radius_m : float
    centre_m : list
    """

    radius_m: Positive
    centre_m: Vector = (0.0, 0.0, 0.0)


class SolidCylinderSection(Section):
    """A cylinder with flat ends, whose edges may be rounded.

    Attributes
    ----------
    radius_m : float
    ends_m : list
        Centres of both ends.
    rounding_m : float
        Radius of the rounded edges [m]; zero for sharp edges.
    """

    radius_m: Positive
    ends_m: tuple[Vector, Vector]
    rounding_m: NotNegative = 0.0


class CapsuleSection(Section):
    """A cylinder with a half-ball at each end, such as a finger.

    Attributes
    ----------
    radius_m : float
    ends_m : list
        Centres of the balls.
    """

    radius_m: Positive
    ends_m: tuple[Vector, Vector]


class CuboidSection(Section):
    """A box along the axes of its frame, whose edges may be rounded.

    Attributes
    ----------
    corners_m : list
        Lowest and highest corner.
    rounding_m : float
        Radius of the rounded edges [m]; zero for sharp edges.
    """

    corners_m: tuple[Vector, Vector]
    rounding_m: NotNegative = 0.0


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
        """Raise `ValueError` unless exactly one solid is given."""
        require_one(self, *type(self).model_fields)
        return self


def solid_from_section(section: SolidSection) -> Solid:
    """Return the solid that a `SolidSection` states by its only key; errors of the solid name that
    key.
    """
    ((name, own),) = ((name, own) for name, own in section if own is not None)
    return KINDS[name](**declared_in(own, KINDS[name], where=name))
