"""What people mistake in a description, and the description as it would be without the mistake."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..arrays import Array
from ..nlp.any_stiffness import Described

UNITS = {"mm": 1e-3, "cm": 1e-2, "in": 0.0254, "m": 1.0}
AXES = ("x", "y", "z")
# A direction within about 20 degrees of the one that is given is none of another axis.
SAME_DIRECTION = 0.94


@dataclass(frozen=True, eq=False)
class Mistake:
    """A description without a mistake, and what that mistake is."""

    cause: str
    said: str
    without: Described


def mistakes(given: Described) -> Iterator[Mistake]:
    """The mistakes that need no fit, each undone."""
    moving = np.ptp(given.rotations, axis=0).any() or np.ptp(given.translations_m, axis=0).any()
    if moving or np.abs(given.translations_m).any():
        yield from _poses(given)
        yield from _lengths(given, "poses", "the poses", "grasp.length_unit")
    yield from _lengths(given, "tracks", "the markers", "markers.length_unit")
    yield from _lengths(given, "mesh", "the mesh", "object.length_unit")
    yield from gravity_mistakes(given)


def _poses(given: Described) -> Iterator[Mistake]:
    inverse = given.rotations.transpose(0, 2, 1)
    shift = -np.einsum("tij,tj->ti", inverse, given.translations_m)
    yield Mistake(
        "poses-inverted",
        "the markers move as if the poses were inverted: invert them, they are to map the "
        "undeformed body to where it is",
        replace(given, rotations=inverse, translations_m=shift),
    )
    yield Mistake(
        "rotation-inverted",
        "the markers move as if the poses' rotations were inverted: transpose the matrices or "
        "conjugate the quaternions, and leave the positions",
        replace(given, rotations=inverse),
    )
    quaternions = Rotation.from_matrix(given.rotations).as_quat()
    # Signs are free; neighbours of one sign keep the reordered ones continuous.
    for order, turn in (("wxyz", -1), ("xyzw", 1)):
        reordered = np.roll(_continuous(quaternions), turn, axis=1)
        yield Mistake(
            "quaternion-order",
            f"the markers move as if the quaternions were in another order: set grasp.quaternion "
            f'= "{order}" or swap the columns',
            replace(given, rotations=Rotation.from_quat(reordered).as_matrix()),
        )


def _continuous(quaternions: Array) -> Array:
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    return quaternions * np.cumprod(np.r_[1.0, np.where(flips, -1.0, 1.0)])[:, None]


def _lengths(given: Described, what: str, who: str, key: str) -> Iterator[Mistake]:
    for factor in (1e-3, 1e-2, 0.0254, 1e3, 1e2):
        unit = next((u for u, size in UNITS.items() if size == factor), "m")
        scaled = {
            "poses": lambda f: {"translations_m": f * given.translations_m},
            "tracks": lambda f: {"tracks_m": f * given.tracks_m},
            "mesh": lambda f: {"mesh_scale": f},
        }[what](factor)
        so = f'set {key} = "{unit}"' if factor < 1 else f"check {key}"
        yield Mistake(
            "length-unit",
            f"{who} would fit if {'it' if what == 'mesh' else 'they'} were {factor:g} times as "
            f"large: {so}",
            replace(given, **scaled),
        )


def gravity_mistakes(given: Described) -> Iterator[Mistake]:
    """Gravity along the other axes, and with the other sign."""
    size = float(np.linalg.norm(given.gravity_m_s2))
    if not size:
        return
    for axis, name in enumerate(AXES):
        for sign in (1.0, -1.0):
            other = np.zeros(3)
            other[axis] = sign * size
            if other @ given.gravity_m_s2 > SAME_DIRECTION * size**2:
                continue
            yield Mistake(
                "gravity",
                f"the markers hang as if gravity were along {'+' if sign > 0 else '−'}{name}: set "
                f"gravity_m_s2 = [{', '.join(f'{x:g}' for x in other)}]",
                replace(given, gravity_m_s2=other),
            )
