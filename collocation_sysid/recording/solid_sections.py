"""Tables of a problem file that state the rigid solid of an obstacle."""

# ruff: noqa: D101 (the table of a class has the summary of that class)
from __future__ import annotations

from pydantic import model_validator

from ..common.schema_tables import Section, declared_in, require_one
from .obstacle_solids import Capsule, Cuboid, Cylinder, Plane, Solid, Sphere


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
        """Raise `ValueError` unless exactly one solid is given."""
        require_one(self, *type(self).model_fields)
        return self


def solid_from_section(section: SolidSection) -> Solid:
    """Return the solid that a table states by its only key; errors of the solid name that key."""
    ((name, own),) = ((name, own) for name, own in section if own is not None)
    return own.of(**declared_in(own, where=name))
