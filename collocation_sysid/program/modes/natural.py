"""Natural modes of a body about a state: frequencies, shapes and damping ratios.

Free dofs obey M ẍ + C ẋ + K x = 0 with the stiffness K at that state, the lumped mass M and the
damping C. A mode K φ = ω² M φ has the damping ratio ζ = φᵀC φ / 2ω φᵀM φ; where Rayleigh's C = γ_r
K + γ_m M is the same throughout the body, ζ is γ_r ω / 2 + γ_m / 2ω, and modes are not coupled by
damping.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from numpy.typing import ArrayLike
from scipy.sparse.linalg import LinearOperator, eigsh

from ...common.array_types import Array, Index
from ...model.forces import Forces
from ..linear_algebra.factorisation import Factor, Factoriser

# ω² below this share of the largest K_ii / M_ii is zero up to rounding; of a rod, whose sections are
# much stiffer than its bending, below a smaller share.
RIGID = 1e-12
RIGID_THIN = 1e-14
# Largest number of dofs that are solved densely; Lanczos iterations need more vectors than modes.
DENSE = 150
# Share of the largest K_ii / M_ii by which K is shifted, because it is singular where a body can
# move rigidly.
SHIFT = 1e-10
# Number of rigid motions of a free body.
RIGID_MOTIONS = 6


@dataclass(frozen=True, eq=False)
class Modes:
    """Lowest oscillating modes, by ascending frequency."""

    frequencies_hz: Array  # (k,): undamped natural frequencies ω / 2π
    damping_ratios: Array  # (k,): damping ratios ζ; modes with 1 and above do not oscillate
    shapes: Array  # (k, n, 3): displacements with φᵀ M φ = 1 kg (unit m); zero at prescribed dofs
    # Number of modes left out because they have no restoring force: six rigid ones of a body
    # without grasp, and those in which a state is unstable.
    omitted_count: int = 0

    @property
    def angular_frequencies_rad_s(self) -> Array:
        """Undamped angular frequencies ω (k,) [rad/s]."""
        return 2 * np.pi * self.frequencies_hz


def natural_modes(forces: Forces, x: ArrayLike, free_dofs: Index, count: int = 6) -> Modes:
    """Return the lowest modes of a body about a state; those without restoring force (ω² not
    positive beyond rounding) are left out and counted in `omitted_count`.

    Parameters
    ----------
    forces : Forces
        Forces on the body at one time, see `Forces.from_experiment`.
    x : (n, 3) or (3n,) array
        The state [m], which should be an equilibrium.
    free_dofs : (k,) array
        Sorted dofs that are not prescribed; their masses must be positive.
    count : int
        Number of modes; there may be fewer.
    """
    mass = forces.mass.inertia_kg[0, free_dofs]
    pattern = forces.pattern
    state = np.asarray(x, dtype=float).reshape(1, -1)
    at = forces.linearise(state, np.zeros_like(state))
    lower = -at.by_position[0]
    damping = -at.by_velocity[0]
    stiffness = sp.csc_array(pattern.matrix(lower)[:, free_dofs][free_dofs])
    largest = float((stiffness.diagonal() / mass).max(initial=0.0))
    requested = count + RIGID_MOTIONS
    if len(free_dofs) <= max(DENSE, 3 * requested):
        squares, vectors = _dense_modes(stiffness, mass, requested=requested)
    else:
        lower[pattern.diagonal[free_dofs]] += SHIFT * largest * mass
        factor = Factoriser.cached(pattern, free_dofs).factorise(lower)
        squares, vectors = _lanczos_modes(
            stiffness, mass, factor=factor, shift_1_s2=-SHIFT * largest, requested=requested
        )
    oscillating = squares > (RIGID if forces.body.is_solid else RIGID_THIN) * largest
    shapes = np.zeros((int(oscillating.sum()), pattern.size))
    shapes[:, free_dofs] = vectors[:, oscillating].T
    omega = np.sqrt(squares[oscillating])[:count]
    shapes = shapes[:count]
    drag = np.einsum("ki,ki->k", shapes, (pattern.matrix(damping) @ shapes.T).T)
    return Modes(
        omega / (2 * np.pi),
        drag / (2 * omega),
        shapes=shapes.reshape(-1, pattern.size // 3, 3),
        omitted_count=int((~oscillating).sum()),
    )


def _dense_modes(stiffness: sp.csc_array, mass: Array, requested: int) -> tuple[Array, Array]:
    """Return the lowest λ (k,) [1/s²] and φ (n, k), φᵀ M φ = 1, of K φ = λ M φ (dense)."""
    root = np.sqrt(mass)
    scaled = stiffness.toarray() / np.outer(root, root)
    last = min(requested, len(mass)) - 1
    squares, vectors = scipy.linalg.eigh(scaled, subset_by_index=(0, last))
    return squares, vectors / root[:, None]


class _ShiftedInverse(LinearOperator):
    """Operator (K − shift · M)⁻¹ of a factorised matrix."""

    def __init__(self, factor: Factor, size: int) -> None:
        super().__init__(np.dtype(float), (size, size))
        self.factor = factor

    def _matvec(self, x: Array) -> Array:
        return self.factor.solve(np.ravel(x))


def _lanczos_modes(
    stiffness: sp.csc_array, mass: Array, factor: Factor, shift_1_s2: float, requested: int
) -> tuple[Array, Array]:
    """Return the λ [1/s²] nearest to a shift and φ (n, k), φᵀ M φ = 1, by Lanczos iterations."""
    squares, vectors = eigsh(
        stiffness,
        requested,
        M=sp.diags_array(mass, format="csc"),
        sigma=shift_1_s2,
        OPinv=_ShiftedInverse(factor, len(mass)),
        v0=np.random.default_rng(0).normal(size=len(mass)),
    )
    order = np.argsort(squares)
    return squares[order], vectors[:, order]
