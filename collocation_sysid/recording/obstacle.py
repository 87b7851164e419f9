"""What a body may touch: a table, a plate, a finger, at rest or moving."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..arrays import Array, Index
from ..checked import NotNegative, Positive, Text
from ..errors import InputError
from ..fem.constants import FRICTION, Constant, constant_named
from ..fem.selection import Selection
from ..fem.touching import Touching
from ..stated import key, stated
from .grasp import Grasp
from .poses import PoseSequence
from .selected import Nodes, selection
from .solids import KINDS, Solid, SolidSection, across, solid_of

if TYPE_CHECKING:
    from ..fem.body import Body


def _shape(shape: Any) -> Solid:
    if not isinstance(shape, Solid):
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
    are stated and read as those of grasps are. Its force is that on the body. Where a body comes
    to rest on it, take the scheme "bdf2": under the midpoint rule contact rings.

    Parameters
    ----------
    shape : Solid
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
        κ of the pressure κ (⟨δ − g⟩² − ⟨−g⟩²)/δ at the gap g; a hundred times E over the mean edge
        of the face at each point by default, at the E of the trial.
    width_m : float, optional
        δ, the gap at which it begins; a five-thousandth of that edge by default, with friction a
        five-hundredth.
    slip : float, optional
        Speed [m/s], or slip from sample to sample [m] of a static experiment, at which friction is
        seven tenths of its limit.
    wrench : Wrench, optional
        What it was measured to give the body.
    relaxed : float, optional
        Of contact as complementarity, without friction: in shares of κδ², what pressure times gap
        is. The energy's by default.

    Raises
    ------
    InputError
        If the friction is out of its bounds.
    """

    nodes: Index = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    poses: PoseSequence = field(default_factory=PoseSequence.fixed)
    shape: Solid = key(SolidSection, read=solid_of, converter=_shape, kw_only=True)
    name: str = key(Text | None, default="obstacle", kw_only=True)
    friction: float | str = key(NotNegative | Text, default=0.0, kw_only=True)
    faces: Selection | None = key(
        Nodes | None, converter=_faces, read=selection, default=None, kw_only=True
    )
    stiffness_pa_m: float | None = key(Positive | None, default=None, kw_only=True)
    width_m: float | None = key(Positive | None, default=None, kw_only=True)
    slip: float | None = key(Positive | None, default=None, kw_only=True)
    relaxed: float | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        self._begin()
        if self.axes != "xyz":
            raise InputError(f"axes of {self.name} is {self.axes!r}; expected none: it is rigid")
        least, largest = FRICTION.bounds
        if isinstance(self.friction, float) and self.friction > largest:
            raise InputError(
                f"friction of {self.name} is {self.friction:g}; expected {least:g} to {largest:g}"
            )
        if (named := self.coefficient) and not named.name.endswith(FRICTION.name):
            raise InputError(
                f"friction of {self.name} is {named.name!r}; expected a number, or the name of a "
                f"parameter that ends with {FRICTION.name}, such as table_friction"
            )

    def framed(self, frame: Index, t_s: Array) -> Obstacle:
        """The same with the nodes (4,) of its frame, and matrices as the poses at `t_s`."""
        same = np.array_equal(frame, self.nodes)
        return self._with_nodes(self.nodes if same else frame, t_s)

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
        return across(self.shape.normal)

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
        return constant_named(self.friction) if isinstance(self.friction, str) else None


@lru_cache(maxsize=32)
def _touching(body: Body, obstacle: Obstacle) -> Touching:
    return Touching.of(body, obstacle.nodes, obstacle.faces)


def with_frames_of(body: Body, obstacles: Sequence[Obstacle], *, static: bool) -> Body:
    """Return the body with a frame for each obstacle.

    Slopes of contact have a skew part where an obstacle has friction, and where pressures are
    averaged over time steps, which they may be unless the experiment is static.
    """
    named = (each.coefficient for each in obstacles)
    frictions = tuple(dict.fromkeys(constant for constant in named if constant is not None))
    unsymmetric = any(each.rubs or (each.relaxed is None and not static) for each in obstacles)
    return body.with_frames(len(obstacles), unsymmetric, frictions)
