"""What people mistake in a description, and the description as it would be without the mistake."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..arrays import Array
from ..program.any_stiffness import Described
from .hypothesis import Hypothesis

# How many times as large what is given in another unit should be, and the key's value.
UNITS = {1e-3: "mm", 1e-2: "cm", 0.0254: "in", 1e3: "", 1e2: ""}
# A direction within about 20 degrees of the one that is given is none of another axis.
SAME_DIRECTION = 0.94


def mistakes(given: Described) -> Iterator[Hypothesis]:
    """The mistakes that need no fit, each undone."""
    moving = np.ptp(given.rotations, axis=0).any() or np.ptp(given.translations_m, axis=0).any()
    if moving or np.abs(given.translations_m).any():
        yield from _poses(given)
        yield from _lengths(given, "translations_m", "the poses would fit if they", "grasp")
    yield from _lengths(given, "tracks_m", "the markers would fit if they", "markers")
    yield from _lengths(given, "mesh_scale", "the mesh would fit if it", "object")
    yield from gravity_mistakes(given)


def _poses(given: Described) -> Iterator[Hypothesis]:
    inverse = given.rotations.transpose(0, 2, 1)
    shift = -np.einsum("tij,tj->ti", inverse, given.translations_m)
    inverted = replace(given, rotations=inverse, translations_m=shift)
    yield Hypothesis("poses-inverted", given.name, without=inverted)
    yield Hypothesis("rotation-inverted", given.name, without=replace(given, rotations=inverse))
    quaternions = Rotation.from_matrix(given.rotations).as_quat()
    # Signs are free; neighbours of one sign keep the reordered ones continuous.
    flips = np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0
    quaternions *= np.cumprod(np.r_[1.0, np.where(flips, -1.0, 1.0)])[:, None]
    for order, turn in (("wxyz", -1), ("xyzw", 1)):
        reordered = Rotation.from_quat(np.roll(quaternions, turn, axis=1)).as_matrix()
        without = replace(given, rotations=reordered)
        yield Hypothesis("quaternion-order", given.name, {"order": order}, without)


def _lengths(given: Described, what: str, who: str, section: str) -> Iterator[Hypothesis]:
    key = f"{section}.length_unit"
    for factor, unit in UNITS.items():
        remedy = f'set {key} = "{unit}"' if unit else f"check {key}"
        data = {"who": who, "factor": factor, "remedy": remedy}
        without = replace(given, **{what: factor * getattr(given, what)})
        yield Hypothesis("length-unit", given.name, data, without)


def gravity_mistakes(given: Described) -> Iterator[Hypothesis]:
    """Gravity along the other axes, and with the other sign."""
    size = float(np.linalg.norm(given.gravity_m_s2))
    for axis, name in enumerate("xyz"):
        for sign, plus in ((1.0, "+"), (-1.0, "−")):
            other: Array = np.where(np.arange(3) == axis, sign * size, 0.0)
            if size and other @ given.gravity_m_s2 <= SAME_DIRECTION * size**2:
                data = {"axis": plus + name, "vector": ", ".join(f"{x:g}" for x in other)}
                without = replace(given, gravity_m_s2=other)
                yield Hypothesis("gravity", given.name, data, without)
