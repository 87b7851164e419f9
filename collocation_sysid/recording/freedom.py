"""Which rigid motions of a body its grasps leave free."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array

# Of the largest singular value: what is held less than so much of it is not held.
HELD = 1e-6


def free_motions(points_m: Array, held: NDArray[np.bool_]) -> list[str]:
    """Rigid motions that holding these coordinates leaves free, in words.

    Parameters
    ----------
    points_m : (n, 3)
    held : (n, 3) bool
    """
    if not held.any():
        return ["move and turn as a whole"]
    about = points_m[held.any(axis=1)].mean(axis=0)
    arms = points_m - about
    size_m = float(np.linalg.norm(arms[held.any(axis=1)], axis=1).max()) or 1.0
    turned = np.stack([np.cross(axis, arms / size_m) for axis in np.eye(3)], axis=2)
    modes = np.concatenate([np.broadcast_to(np.eye(3), turned.shape), turned], axis=2)[held]
    _, values, directions = np.linalg.svd(modes)
    rank = int((values > HELD * values[0]).sum())
    free = directions[rank:]
    if not len(free):
        return []
    # What is left without a turn, and the axes of what turns.
    shifts, turns = _null(free[:, 3:].T) @ free[:, :3], free[:, 3:]
    return [
        *(f"move along {_named(d)}" for d in _plain(shifts)),
        *(f"turn about {_named(d)}" for d in _plain(turns)),
    ]


def _null(matrix: Array) -> Array:
    """(k, n) orthonormal vectors v with matrix @ v = 0."""
    _, values, directions = np.linalg.svd(matrix)
    return directions[int((values > HELD).sum()) :]


def _plain(vectors: Array) -> Iterator[Array]:
    """An orthonormal basis of what vectors (k, 3) span, along the axes where that is possible."""
    _, values, directions = np.linalg.svd(vectors.reshape(-1, 3), full_matrices=False)
    space = directions[values > HELD]
    while len(space):
        projected = space.T @ space
        best = int(np.argmax(np.diag(projected).round(9)))
        direction = projected[best] / np.linalg.norm(projected[best])
        yield direction
        space = _null(np.vstack([direction, _null(space)]))


def _named(direction: Array) -> str:
    axis = int(np.abs(direction).argmax())
    if abs(direction[axis]) > 1 - 1e-6:
        return "xyz"[axis]
    return f"({', '.join(f'{x:.3g}' for x in direction)})"
