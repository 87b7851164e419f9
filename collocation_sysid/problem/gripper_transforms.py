"""Poses of the undeformed body in the frames of grippers, as a problem file states them."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable

from ..common.array_types import Array
from .problem import Problem
from .schema import ProblemFile


def gripper_transforms(
    problem: Problem, experiment: str, grasps: Iterable[int]
) -> list[Array | None]:
    """Return the key `gripper_to_body` of grasps and obstacles, as transformation matrices.

    Parameters
    ----------
    problem : Problem
        Problem; its file has the key.
    grasps : iterable of int
        Indices of grasps, obstacles after them, counted from 0.

    Returns
    -------
    list of (4, 4) array or None
        Pose of the undeformed body in the frame of each gripper; None where the key is not stated,
        and for a problem that was not read from a file.
    """
    indices = list(grasps)
    if problem.origin is None:
        return [None] * len(indices)
    sections = ProblemFile.model_validate(tomllib.loads(problem.origin.text)).recordings
    (section,) = (each for each in sections if each.name == experiment)
    transforms: list[Array | None] = []
    for k in indices:
        stated = section.moved_sections[k].gripper_to_body
        transforms.append(None if stated is None else stated.to_matrix())
    return transforms
