"""Rigid obstacles that a body may touch, such as a table, a plate or a finger, at rest or
moving.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from ..common.array_types import Array, Index
from ..common.declarations import declaration, key
from ..common.validated_types import NotNegative, Positive, Text
from ..errors import InputError
from ..fem.contact_surface import ContactSurface
from ..fem.laws.constants import FRICTION, Constant, constant_named
from ..fem.meshes.selection import Selection
from ..fem.pattern import SymmetricPattern
from .grasp import Grasp, unconverted_poses
from .node_selection import Nodes, selection_from_section
from .obstacle_solids import KINDS, Solid, SolidSection, orthogonal_axes, solid_from_section
from .poses import PoseSequence

if TYPE_CHECKING:
    from ..fem.body import Body


def _require_solid(shape: Solid) -> Solid:
    if not isinstance(shape, Solid):
        kinds = ", ".join(kind.__name__ for kind in KINDS.values())
        raise InputError(f"shape of an obstacle is {shape!r}; expected one of {kinds}")
    return shape


def _require_selection(faces: Selection | None) -> Selection | None:
    if not isinstance(faces, Selection):
        raise InputError(
            f"faces of an obstacle is {faces!r}; expected a selection, such as cs.Named(…)"
        )
    return faces


@dataclass(frozen=True, eq=False)
class ObstacleForces:
    """Measured forces of an obstacle on the body."""

    t_s: Array  # (S,): sample times [s]
    forces_n: Array  # (S, 3): forces along the axes of the sensor [N]; NaN where missing
    sigma_n: float  # standard deviation of their noise [N]
    # Motion of the axes of the sensor; None if they are those of the world.
    frame_poses: PoseSequence | None

    def rotate_to_world_n(self) -> Array:
        """Return the forces (S, 3) along the axes of the world [N], NaN where a component is
        missing.
        """
        if self.frame_poses is None:
            return np.array(self.forces_n)
        rotations, _ = self.frame_poses.at(self.t_s)
        return np.einsum("sij,sj->si", rotations, self.forces_n)


@declaration
class Obstacle(Grasp):
    """A rigid solid that pushes against the surface of a body, with or without friction.

    It is a grasp of a frame of its own instead of body nodes, so that its poses, displacements and
    forces are stated as those of grasps. Its force is the force on the body. For a body that comes
    to rest on it, use the scheme "bdf2": with the midpoint rule contact forces oscillate.

    Parameters
    ----------
    shape : Solid
        Plane, Sphere, Cylinder, Capsule or Cuboid.
    poses : PoseSequence or (T, 4, 4) array
        Motion of its frame; at rest in the body's frame by default.
    name : str
        Name in messages and pictures.
    friction : float or str
        Coefficient of friction; or the name of a parameter, whose bounds are 0 and 2.
    faces : Selection, optional
        Faces of the body that may touch the obstacle: those whose corners are all selected. All by
        default.
    stiffness_pa_m : float, optional
        Contact stiffness κ [Pa/m] in the pressure κ (⟨δ − g⟩² − ⟨−g⟩²)/δ at the gap g; by default
        100 times Young's modulus at the current parameters over the mean edge of the face at each
        point.
    width_m : float, optional
        Gap δ at which the pressure begins [m]; by default the mean edge of the face over 5000, or
        over 500 with friction.
    slip : float, optional
        Sliding speed [m/s] at which friction is 0.7 of its limit; in a static experiment, sliding
        distance from sample to sample [m].
    wrench : Wrench, optional
        Measured force and torque that it exerts on the body.
    relaxed : float, optional
        Complementarity of contact without friction: value of pressure times gap, in units of κδ².
        By default contact has an energy instead.

    Raises
    ------
    InputError
        If the friction is out of its bounds.
    """

    nodes: Index = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    poses: PoseSequence = field(
        default_factory=PoseSequence.fixed, metadata={"converter": unconverted_poses}
    )
    shape: Solid = key(
        SolidSection, read=solid_from_section, converter=_require_solid, kw_only=True
    )
    name: str = key(Text | None, default="obstacle", kw_only=True)
    friction: float | str = key(NotNegative | Text, default=0.0, kw_only=True)
    faces: Selection | None = key(
        Nodes | None,
        converter=_require_selection,
        read=selection_from_section,
        default=None,
        kw_only=True,
    )
    stiffness_pa_m: float | None = key(Positive | None, default=None, kw_only=True)
    width_m: float | None = key(Positive | None, default=None, kw_only=True)
    slip: float | None = key(Positive | None, default=None, kw_only=True)
    relaxed: float | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        self._check_times_and_axes()
        if self.axes != "xyz":
            raise InputError(
                f"axes of {self.name} is {self.axes!r}; expected no axes, because an obstacle is rigid"
            )
        least, largest = FRICTION.bounds
        if isinstance(self.friction, float) and self.friction > largest:
            raise InputError(
                f"friction of {self.name} is {self.friction:g}; expected {least:g} to {largest:g}"
            )
        if (named := self.friction_constant) and not named.name.endswith(FRICTION.name):
            raise InputError(
                f"friction of {self.name} is {named.name!r}; expected a number, or the name of a "
                f"parameter that ends with {FRICTION.name}, such as table_friction"
            )

    def with_frame_nodes(self, frame: Index, t_s: Array) -> Obstacle:
        """Return the obstacle tied to the nodes (4,) of its frame: the origin and the ends of three
        axes; self if nothing changes.

        Poses that are matrices (T, 4, 4) become a `PoseSequence` at the times `t_s` (T,).
        """
        same = np.array_equal(frame, self.nodes)
        return self._with_nodes(self.nodes if same else frame, t_s)

    def contact_surface(self, body: Body) -> ContactSurface:
        """Return the contact points between a body and the obstacle; the latest
        results are cached.
        """
        return _contact_surface(body, self)

    def find_measured_forces(self) -> ObstacleForces | None:
        """Return the measured forces on the body; None without a sensor."""
        if self.wrench is None:
            return None
        return ObstacleForces(
            self.wrench.t_s,
            self.wrench.values[:, :3],
            sigma_n=float(self.wrench.value_sigmas[0]),
            frame_poses=None if self.wrench.frame == "world" else self.poses,
        )

    def couplings_with(self, body: Body) -> SymmetricPattern:
        """Return the pairs of nodes of a body and the obstacle between which forces can act."""
        return self.contact_surface(body).points.couplings

    @property
    def offset_direction(self) -> Array:
        """Direction (3,) of the obstacle's uncertain offset: the sum of the unit vectors of the
        axes in `zero`, not normalised; if there are none, the unit vector that its shape states.
        """
        uncertain_axes = np.array([float(axis in self.zero) for axis in "xyz"])
        return uncertain_axes if uncertain_axes.any() else self.shape.offset_direction

    @property
    def tilt_axes(self) -> Array:
        """(2, 3) unit axes of its uncertain tilt; with the normal of its shape they are an
        orthonormal basis.
        """
        return orthogonal_axes(self.shape.offset_direction)

    def displaced(self, offset_m: float, tilt_rad: Array, delay_s: float) -> Obstacle:
        """Return a copy of the obstacle, shifted and tilted in its own frame, and delayed.

        Parameters
        ----------
        offset_m : float
            Shift along `offset_direction`.
        tilt_rad : (2,) array
            Rotation about the axes `tilt_axes`, through the middle of its shape.
        delay_s : float
            Delay of its motion, added to the times of its poses.
        """
        motion = np.eye(4)
        middle = self.shape.tilt_centre_m
        motion[:3, :3] = Rotation.from_rotvec(tilt_rad @ self.tilt_axes).as_matrix()
        motion[:3, 3] = middle - motion[:3, :3] @ middle + offset_m * self.offset_direction
        poses = self.poses.after(motion)
        return replace(self, poses=replace(poses, t_s=poses.t_s + delay_s))

    @property
    def has_friction(self) -> bool:
        """Whether the obstacle has friction: a coefficient above zero, or a parameter as
        coefficient.
        """
        return self.friction != 0

    @cached_property
    def friction_constant(self) -> Constant | None:
        """Parameter that is the coefficient of friction; None if the coefficient is a number."""
        return constant_named(self.friction) if isinstance(self.friction, str) else None


@lru_cache(maxsize=32)
def _contact_surface(body: Body, obstacle: Obstacle) -> ContactSurface:
    """Return the contact points between a body and an obstacle; the last 32 pairs are cached."""
    return ContactSurface.from_body(body, obstacle.nodes, chosen=obstacle.faces)


def with_obstacle_frames(body: Body, obstacles: Sequence[Obstacle], *, is_static: bool) -> Body:
    """Return the body with four nodes for the frame of each obstacle, and the coefficients of
    friction that are parameters among its constants; self if it has these already. Frames of other
    obstacles are replaced.

    The Jacobian of the contact forces is declared as not symmetric if an obstacle has friction, or
    if pressures are averaged over time steps, which happens in motions without `relaxed` contact.
    """
    named = (each.friction_constant for each in obstacles)
    frictions = tuple(dict.fromkeys(constant for constant in named if constant is not None))
    unsymmetric = any(
        each.has_friction or (each.relaxed is None and not is_static) for each in obstacles
    )
    return body.with_frames(len(obstacles), has_skew_frame_forces=unsymmetric, frictions=frictions)
