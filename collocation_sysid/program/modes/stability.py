"""Stability of small disturbances of a state: eigenvalues s of M s² + D s + K with Re(s) > 0.

K and D are −∂F/∂x and −∂F/∂v of the free dofs at a state, constant and without velocity. Where both
are positive definite, no disturbance grows; that is checked by a factorisation of each. K is not
positive definite beyond buckling, nor D where a damping law feeds energy in.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs, eigsh, splu

from ...common.array_types import Array, Index
from ...fem.pattern import SymmetricPattern
from ...model.forces import Forces
from ..collocation import Collocation, ExperimentIterate
from ..forward.newton_linearisation import LaggedStress
from ..linear_algebra.factorisation import Factoriser

# Number of states of a motion that are examined.
STATES = 8
# Largest number of dofs that are solved densely.
DENSE = 150
# Number of most negative directions that are tried otherwise.
DIRECTIONS = 8
# Share of the largest diagonal entry per mass by which matrices are shifted, because those with
# rigid motions are singular, not indefinite.
SHIFT = 1e-9
# Largest number of restarts of Arnoldi's iteration for the fastest growth.
RESTARTS = 100
# Accuracy of Lanczos iterations, enough to determine a sign.
TOLERANCE = 1e-3


@dataclass(frozen=True)
class Instability:
    """Experiment with states in which disturbances grow."""

    experiment: str
    time_s: float  # time of the state in which they grow fastest [s]
    growth_1_s: float  # largest Re(s) there [1/s]
    # Integral of Re(s) > 0 over the recording: a disturbance may grow by e to this power. Infinite
    # for equilibria, to which a disturbed state does not return.
    e_foldings: float


def find_instabilities(collocation: Collocation, z: Array) -> tuple[Instability, ...]:
    """Return the instabilities of the motions at z, at most one for each fitted experiment, in
    their order; experiments whose examined states are stable have none.

    Up to `STATES` samples of each experiment are examined, at the states at which the scheme
    evaluates the forces next to them.
    """
    unstable = (_instability(part) for part in collocation.iterates(z))
    return tuple(each for each in unstable if each is not None)


def _instability(iterate: ExperimentIterate) -> Instability | None:
    """None if all examined states, up to `STATES` samples, are stable."""
    experiment = iterate.transcription.experiment
    last = len(experiment.t_s) - 1
    samples = np.unique(np.linspace(0, last, STATES).round().astype(int))
    t_s = experiment.t_s[samples]
    rows = iterate.transcription.sample_rows[samples]
    is_prescribed = experiment.is_prescribed(t_s).reshape(len(t_s), -1)
    dynamics = iterate.equations.dynamics
    theta = dynamics.theta
    # The mean stresses of a nearly incompressible body balance at these states only: those of the
    # grid oscillate about them from step to step.
    xi, nu = (each[rows] for each in dynamics.all_evaluation_states(iterate.x))
    growths = np.array(
        [
            growth_rate_1_s(
                Forces.from_experiment(experiment, time, theta=theta),
                x,
                free_dofs=np.flatnonzero(~there),
                v=v,
            )
            for time, x, v, there in zip(t_s, xi, nu, is_prescribed, strict=True)
        ]
    )
    worst = int(np.argmax(growths))
    if growths[worst] <= 0:
        return None
    e_foldings = np.inf if experiment.is_static else float(np.trapezoid(growths, t_s))
    return Instability(
        experiment.name, float(t_s[worst]), growth_1_s=float(growths[worst]), e_foldings=e_foldings
    )


def growth_rate_1_s(forces: Forces, x: Array, free_dofs: Index, v: Array | None = None) -> float:
    """Return the largest Re(s) of M s² + D s + K at a state [1/s]; 0 where none exceeds the
    rounding errors, no dof is free, or K or D is not finite, as where an element is inverted.

    With velocities, a state also counts as stable if K is positive definite with the complete mean
    stresses of the elements: in a nearly incompressible body the elastic and the viscous parts may
    be large and cancel.

    Parameters
    ----------
    forces : Forces
        Forces at one time.
    x : (3n,) array
        State [m].
    free_dofs : (k,) array
        Sorted dofs that are not prescribed; their masses must be positive.
    v : (3n,) array, optional
        Velocities [m/s].
    """
    if not len(free_dofs):
        return 0.0
    state = x.reshape(1, -1)
    at = forces.linearise(state, np.zeros_like(state))
    mass = forces.mass.inertia_kg[0, free_dofs]
    pattern = forces.pattern
    lowers = -at.by_position[0], -at.by_velocity[0]
    if not all(np.isfinite(lower).all() for lower in lowers):
        return 0.0
    is_definite = partial(_is_definite, pattern=pattern, free_dofs=free_dofs, mass=mass)
    if is_definite(lowers[1]):
        if is_definite(lowers[0]):
            return 0.0
        if v is not None and is_definite(lowers[0] + _viscous_volume_stiffness(forces, x, v)):
            return 0.0
    root = sp.diags_array(1 / np.sqrt(mass))
    stiffness, damping = (
        sp.csc_array(root @ pattern.matrix(lower)[:, free_dofs][free_dofs] @ root)
        for lower in lowers
    )
    noise = SHIFT * np.sqrt(stiffness.diagonal().max())
    growth = _fastest_growth(stiffness, damping)
    return growth if growth > noise else 0.0


def _viscous_volume_stiffness(forces: Forces, x: Array, v: Array) -> Array:
    """Return the lower triangle [N/m] that viscous mean stresses of the elements, or the resultants
    of a rod, add to K.
    """

    def stresses(rate: Array) -> LaggedStress:
        return LaggedStress(forces, lambda state: (state[None], rate.reshape(1, -1)))

    moving, still = stresses(v), stresses(np.zeros_like(v))
    return moving.stiffness(x, moving.at(x) - still.at(x))


def _is_definite(lower: Array, pattern: SymmetricPattern, free_dofs: Index, mass: Array) -> bool:
    """Whether positive semidefinite up to rounding; true for a zero diagonal."""
    own = pattern.diagonal[free_dofs]
    largest = float((lower[own] / mass).max())
    if largest <= 0:
        return not lower[own].any()
    shifted = lower.copy()
    shifted[own] += SHIFT * largest * mass
    return Factoriser.cached(pattern, free_dofs).factorise(shifted).positive_definite


def _fastest_growth(stiffness: sp.csc_array, damping: sp.csc_array) -> float:
    """Return the largest Re(s) [1/s] of s² + D s + K, mass-normalised; if large at least 0."""
    size = len(stiffness.diagonal())
    if size <= DENSE:
        return float(_exponents(stiffness.toarray(), damping.toarray()).real.max())
    lowest = [_lowest_eigenvectors(each) for each in (stiffness, damping) if each.nnz]
    basis, _ = np.linalg.qr(np.hstack(lowest))
    in_basis = [basis.T @ (each @ basis) for each in (stiffness, damping)]
    exponents = _exponents(*in_basis)
    guess = exponents[np.argmax(exponents.real)]
    return max(_growth_about(stiffness, damping, sigma=float(abs(guess))), 0.0)


def _lowest_eigenvectors(matrix: sp.csc_array) -> Array:
    """Return vectors (n, `DIRECTIONS`) of the smallest eigenvalues, as far as they converge."""
    # A shift below the smallest eigenvalue: in a nearly incompressible body the largest ones are so
    # large that without it the iteration hardly converges.
    start = np.random.default_rng(0).normal(size=len(matrix.diagonal()))
    options = {"sigma": -_definite_shift(matrix), "tol": TOLERANCE, "v0": start}
    try:
        return np.asarray(eigsh(matrix, DIRECTIONS, ncv=4 * DIRECTIONS, **options)[1])
    except ArpackNoConvergence as stopped:
        return np.column_stack([stopped.eigenvectors, start])


def _definite_shift(matrix: sp.csc_array) -> float:
    """Return σ > 0 with which matrix + σ is positive definite, below ten times the least."""
    size = len(matrix.diagonal())
    shift = SHIFT * float(abs(matrix).sum(axis=1).max())
    while True:
        # Without row exchanges the signs of the pivots are those of the eigenvalues.
        with suppress(RuntimeError):  # exactly singular
            factor = splu(
                sp.csc_array(matrix + shift * sp.eye_array(size)),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
            is_exchanged = (factor.perm_r != factor.perm_c).any()
            if not is_exchanged and factor.U.diagonal().min() > 0:
                return shift
        shift *= 10


def _exponents(stiffness: Array, damping: Array) -> NDArray[np.complex128]:
    """Return all 2n complex s with det(s² + D s + K) = 0, for dense matrices (n, n)."""
    size = len(stiffness)
    chain = np.block([[np.zeros((size, size)), np.eye(size)], [-stiffness, -damping]])
    return np.linalg.eigvals(chain).astype(np.complex128)


class _CayleyTransform(LinearOperator):
    """Operator (A + σ)/(A − σ) of A = [[0, 1], [−K, −D]] and σ > 0.

    Its eigenvalues (s + σ)/(s − σ) lie outside the unit circle where Re(s) > 0, so that Arnoldi's
    method finds them first.
    """

    def __init__(self, stiffness: sp.csc_array, damping: sp.csc_array, sigma: float) -> None:
        size = len(stiffness.diagonal())
        super().__init__(np.dtype(float), (2 * size, 2 * size))
        self.damping = damping
        self.sigma = sigma
        self.solver = splu(
            sp.csc_array(sigma**2 * sp.eye_array(size) + sigma * damping + stiffness)
        )

    def _matvec(self, x: Array) -> Array:
        first, second = np.split(np.ravel(x), 2)
        # (A − σ)(y, w) = (first, second), by way of (σ² + σ D + K) y.
        y = self.solver.solve(-second - self.damping @ first - self.sigma * first)
        w = first + self.sigma * y
        return np.concatenate([first + 2 * self.sigma * y, second + 2 * self.sigma * w])


def _growth_about(stiffness: sp.csc_array, damping: sp.csc_array, sigma: float) -> float:
    """Return the largest Re(s) of det(s² + D s + K) = 0 about `sigma` [1/s]; at least 0."""
    turning = _CayleyTransform(stiffness, damping, sigma=sigma)
    try:
        eigenpairs = eigs(
            turning,
            4,
            v0=np.random.default_rng(0).normal(size=turning.shape[0]),
            ncv=60,
            maxiter=RESTARTS,
        )
        turned = np.asarray(eigenpairs[0])
    except ArpackNoConvergence as stopped:
        turned = np.asarray(stopped.eigenvalues)
    exponents = sigma * (turned + 1) / (turned - 1)
    return float(exponents.real.max(initial=0.0))
