"""Keys of [[experiment.mass]], [[experiment.force]], [[experiment.tendon]] and
[[experiment.pressure]]: what acts on the body besides gravity and grasps.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from ..common.schema_tables import Section, Vector, require_one
from ..common.validated_types import Finite, NotNegative, Positive, Text
from ..recording import Force, PointMass, Pressure, Tendon
from ..recording.node_selection import Nodes


class PointMassSection(Section):
    """A rigid point mass tied to nodes: inertia and weight.

    Attributes
    ----------
    nodes : Nodes
        Nodes that carry the mass in equal parts, selected as in a grasp.
    mass_kg : float
    from_s : float, optional
        Time at which the mass is attached to the body [s], with the uncertainty nuisance.joining;
        by default it is attached before the recording.
    until_s : float, optional
        Time at which the mass is removed from the body [s], with the same uncertainty; by default
        it is removed after the recording.
    """

    nodes: Nodes
    mass_kg: Positive
    from_s: Finite | None = None
    until_s: Finite | None = None


class ForceSection(Section):
    """A force on nodes besides gravity.

    Attributes
    ----------
    nodes : Nodes
        Nodes on which the force acts in equal parts, selected as in a grasp.
    force_n : list, optional
        Constant force [x, y, z].
    file : str, optional
        CSV with the columns t_s, fx_n, fy_n, fz_n.
    from_s : float, optional
        Time at which the force begins [s], with the uncertainty nuisance.joining; by default it
        begins before the recording.
    until_s : float, optional
        Time at which the force ends [s], with the same uncertainty; by default it ends after the
        recording.
    """

    nodes: Nodes
    force_n: Vector | None = None
    file: Text | None = None
    from_s: Finite | None = None
    until_s: Finite | None = None

    @model_validator(mode="after")
    def _require_one_force(self) -> ForceSection:
        """Return the section itself; raise `ValueError` unless exactly one of a constant force and
        a file is given.
        """
        require_one(self, "force_n", "file")
        return self


class TendonSection(Section):
    """A cable under tension through points of the body, straight from each point to the next.

    Attributes
    ----------
    points_m : list
        List of points [x, y, z] on the undeformed body, from base to end.
    tension_n : float, optional
        Constant tension.
    tension : str, optional
        CSV with the columns t_s and tension_n, which covers the complete recording.
    name : str, optional
        Name; tendon_1, tendon_2 and so on by default.
    """

    points_m: Annotated[list[Vector], Field(min_length=2)]
    tension_n: NotNegative | None = None
    tension: Text | None = None
    name: Text | None = None

    @model_validator(mode="after")
    def _require_one_tension(self) -> TendonSection:
        """Return the section itself; raise `ValueError` unless exactly one of a constant tension
        and a file is given.
        """
        require_one(self, "tension_n", "tension")
        return self


class PressureSection(Section):
    """A pressure, relative to the surroundings, on faces of the boundary such as the wall of a
    cavity.

    Attributes
    ----------
    faces : Nodes
        Faces whose corners are all in box_m, ball_m or indices; or the name of a physical group or
        cell array of triangles, or of a point array.
    pressure_pa : float, optional
        Constant pressure; negative for suction.
    pressure : str, optional
        CSV with the columns t_s and pressure_pa, which covers the complete recording.
    name : str, optional
        Name; pressure_1, pressure_2 and so on by default.
    lag_s : float
        Time constant τ of the pressure p in the chamber behind valve and tube,
        τ dp/dt = stated pressure − p, beginning at the first stated pressure; zero for no lag.
    """

    faces: Nodes
    pressure_pa: Finite | None = None
    pressure: Text | None = None
    name: Text | None = None
    lag_s: NotNegative = 0.0

    @model_validator(mode="after")
    def _require_one_pressure(self) -> PressureSection:
        """Return the section itself; raise `ValueError` unless exactly one of a constant pressure
        and a file is given.
        """
        require_one(self, "pressure_pa", "pressure")
        return self


# Field of `Experiment`, key of the tables, and class of the objects that they state.
LOADS: tuple[tuple[str, str, type], ...] = (
    ("masses", "mass", PointMass),
    ("forces", "force", Force),
    ("tendons", "tendon", Tendon),
    ("pressures", "pressure", Pressure),
)
