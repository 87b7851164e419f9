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
# Largest logarithmic strain of an increment, far beyond those that are accepted.
LARGEST_STRAIN = 20.0
# Largest entry of the gradient of an increment: steps of a nearly singular matrix may be of any
# length, and are halved later.
LONGEST_STEP = 1e6


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
        """Return positions (3n,) [m] after an increment; the gradients of x must be regular."""
        moved = (x + increment).reshape(-1, 3)
        right = self._gradient.T @ (self._weights[:, None] * self._target(x, increment))
        right += self._anchor[:, None] * moved
        for k, (free, fixed, factor, coupling) in enumerate(self._axes):
            moved[free, k] = factor.solve(right[free, k] - coupling @ moved[fixed, k])
        return moved.ravel()

    def relative_gradient(self, x: Array, increment: Array) -> Array:
        """Return the gradients ∇δ F⁻¹ (points, 3, 3) of an increment (3n,) in the shape x (3n,)
        [m].
        """
        return self._deformation(increment) @ np.linalg.inv(self._deformation(x))

    def _target(self, x: Array, increment: Array) -> Array:
        """Return gradients (3 · points, 3) after an increment, whose spin is a finite rotation."""
        deformation = self._deformation(x)
        relative = self._deformation(increment) @ np.linalg.inv(deformation)
        relative = np.nan_to_num(relative).clip(-LONGEST_STEP, LONGEST_STEP)
        strain = (relative + relative.transpose(0, 2, 1)) / 2
        spin = (relative - relative.transpose(0, 2, 1)) / 2
        vectors = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
        rotation = Rotation.from_rotvec(vectors).as_matrix()
        target = rotation @ _exponential(strain) @ deformation
        return target.transpose(2, 0, 1).reshape(-1, 3)

    def _deformation(self, field: Array) -> Array:
        """Return the gradient (points, 3, 3) of a nodal field (3n,) by the undeformed positions."""
        by_axis = (self._gradient @ field.reshape(-1, 3)).reshape(3, -1, 3)
        return by_axis.transpose(1, 2, 0)


def _exponential(strain: Array) -> Array:
    """Return the exponentials of symmetric matrices (points, 3, 3)."""
    values, vectors = np.linalg.eigh(strain)
    values = values.clip(-LARGEST_STRAIN, LARGEST_STRAIN)
    return (vectors * np.exp(values)[:, None, :]) @ vectors.transpose(0, 2, 1)


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
