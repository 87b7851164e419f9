"""Displacement increments with large rotations, applied without spurious strain.

A Newton step δ is a solution of linearised equations. Added to the positions of a slender body, its
rotations stretch the body in second order: a rotation by 0.5 rad adds 12 % of strain, whose stress
exceeds that of bending by orders of magnitude, makes the stiffness indefinite, and shortens the
next steps. The retraction applies the same increment as rotation and strain (rotation–strain
coordinates: Huang, Tong, Zhou, Bao and Desbrun, IEEE TVCG 17, 2011): with the deformation
gradient F and the gradient of the increment H = ∇δ F⁻¹ = ε + ω, its symmetric and skew part,

    F_new = exp(ω) exp(ε) F

at each quadrature point, and the new positions y minimise Σ V ‖∇y − F_new‖². To first order in δ
they are x + δ, so that Newton's method keeps its order. The exponential of ε keeps volumes where its
trace is zero: I + ε would change them in second order, which in a nearly incompressible body makes
pressures with which the stiffness is indefinite.
"""

from __future__ import annotations

from math import ceil

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import SuperLU, splu
from scipy.spatial.transform import Rotation

from ...common.array_types import Array, Index
from ...fem.body import Body

# Weight of the distance to x + δ beside that of the gradients, relative to the square of the body's
# size: it determines a translation where nothing holds the body along an axis, and nothing else.
ANCHOR = 1e-10
# Largest norm of the logarithmic strain of an increment, far beyond those that are accepted.
LARGEST_STRAIN = 20.0
# Terms of the series of an exponential, whose error is below 1e-13 up to `SERIES_NORM`.
SERIES_TERMS = 8
SERIES_NORM = 0.125
# Largest entry of the gradient of an increment: steps of a nearly singular matrix may be of any
# length, and are halved later.
LONGEST_STEP = 1e6
# Gradient of an increment below which its rotations cause a strain below 1e-6.
SMALL_ROTATION = 1e-3
# Number of quadrature points that are processed at a time, of all rows of a trajectory.
POINTS_AT_A_TIME = 200_000


class Retraction:
    """Retraction of displacement increments for one set of prescribed degrees of freedom.

    Parameters
    ----------
    prescribed : (n, 3) bool
        Coordinates that are prescribed, and are displaced exactly by the increment.
    """

    def __init__(self, body: Body, prescribed: NDArray[np.bool_]) -> None:
        self._gradient = body.shape_gradients
        self._weights = np.tile(body.geometry[..., -1].ravel(), 3)
        laplacian = self._gradient.T @ sp.diags_array(self._weights) @ self._gradient
        size_m = float(np.linalg.norm(np.ptp(body.nodes_m, axis=0)))
        # Nodes of obstacle frames belong to no element: the anchor alone determines them.
        anchor = np.full(len(body.nodes_m), ANCHOR * float(self._weights.sum()) / size_m**2)
        self._anchor = anchor
        normal = sp.csc_array(laplacian + sp.diags_array(anchor))
        known: dict[bytes, tuple[Index, Index, SuperLU, sp.csc_array]] = {}
        for column in prescribed.T:
            key = column.tobytes()
            if key not in known:
                known[key] = _axis(normal, column)
        self._axes = [known[column.tobytes()] for column in prescribed.T]

    def __call__(self, x: Array, increment: Array) -> Array:
        """Return positions (..., 3n) [m] after an increment of the same shape; the gradients of x
        must be regular.
        """
        moved = _columns(x + increment)
        right = self._gradient.T @ (self._weights[:, None] * self._target(x, increment))
        right += self._anchor[:, None] * moved
        # The columns are the axes of the first state, those of the second, and so on.
        for k, (free, fixed, factor, coupling) in enumerate(self._axes):
            of_axis = right[free, k::3] - coupling @ moved[fixed, k::3]
            moved[free, k::3] = factor.solve(of_axis)
        return moved.reshape(len(moved), -1, 3).swapaxes(0, 1).reshape(x.shape)

    def of_rows(self, x: Array, increments: Array) -> Array:
        """Return positions (rows, 3n) [m] after an increment in each row; increments without
        significant rotations are added.
        """
        moved = x + increments
        count = max(1, 3 * POINTS_AT_A_TIME // len(self._weights))
        for first in range(0, len(x), count):
            rows = np.arange(first, min(first + count, len(x)))
            gradients = np.abs(self._gradient @ _columns(increments[rows]))
            largest = gradients.max(axis=0, initial=0.0).reshape(-1, 3).max(axis=1)
            rows = rows[largest > SMALL_ROTATION]
            if len(rows):
                moved[rows] = self(x[rows], increments[rows])
        return moved

    def relative_gradient(self, x: Array, increment: Array) -> Array:
        """Return the gradients ∇δ F⁻¹ (points, 3, 3) of an increment (3n,) in the shape x (3n,)
        [m].
        """
        return self._deformation(increment) @ np.linalg.inv(self._deformation(x))

    def _target(self, x: Array, increment: Array) -> Array:
        """Return gradients (3 · points, 3 · states) after an increment, whose spin is a finite
        rotation.
        """
        deformation = self._deformation(x)
        relative = self._deformation(increment) @ np.linalg.inv(deformation)
        relative = np.nan_to_num(relative).clip(-LONGEST_STEP, LONGEST_STEP)
        strain = (relative + relative.transpose(0, 2, 1)) / 2
        spin = (relative - relative.transpose(0, 2, 1)) / 2
        vectors = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
        rotation = Rotation.from_rotvec(vectors).as_matrix()
        target = rotation @ _exponential(strain) @ deformation
        states = target.reshape(len(self._weights) // 3, -1, 3, 3)
        return states.transpose(3, 0, 1, 2).reshape(len(self._weights), -1)

    def _deformation(self, field: Array) -> Array:
        """Return the gradients (points · states, 3, 3) of nodal fields (..., 3n) by the undeformed
        positions.
        """
        by_axis = (self._gradient @ _columns(field)).reshape(3, -1, 3)
        return by_axis.transpose(1, 2, 0)


def _columns(field: Array) -> Array:
    """Return nodal fields (..., 3n) as new columns (n, 3 · states)."""
    states = field.reshape(-1, field.shape[-1] // 3, 3)
    return states.swapaxes(0, 1).reshape(states.shape[1], -1)


def _exponential(strain: Array) -> Array:
    """Return the exponentials of symmetric matrices (points, 3, 3): squares of a series, in half
    of the time of an eigenvalue decomposition.
    """
    norms = np.linalg.norm(strain, axis=(1, 2), keepdims=True)
    strain = strain * (LARGEST_STRAIN / np.maximum(norms, LARGEST_STRAIN))
    largest = min(norms.max(initial=0.0), LARGEST_STRAIN)
    squarings = max(0, ceil(np.log2(max(largest, SERIES_NORM) / SERIES_NORM)))
    strain /= 2**squarings
    result = np.eye(3) + strain / SERIES_TERMS
    for k in range(SERIES_TERMS - 1, 0, -1):
        result = np.eye(3) + strain @ result / k
    for _ in range(squarings):
        result = result @ result
    return result


def _axis(
    normal: sp.csc_array, prescribed: NDArray[np.bool_]
) -> tuple[Index, Index, SuperLU, sp.csc_array]:
    """Return free and prescribed nodes, the factor of the normal equations, and the coupling."""
    free = np.flatnonzero(~prescribed)
    fixed = np.flatnonzero(prescribed)
    rows = normal[free]
    return free, fixed, splu(sp.csc_matrix(rows[:, free])), sp.csc_array(rows[:, fixed])


def add_increment(x: Array, increment: Array) -> Array:
    """Return x + `increment`, the update of a time step, in which a body rotates little; same
    arguments as `Retraction.__call__`.
    """
    return x + increment
