"""Effect of noise of the poses on the residuals, through the dynamics.

A pose error in one sample excites oscillations of the body, so that the markers miss the fit for
some time. To first order the residuals change by D η, η being the noise of all poses and D the
response of the linearised equations of motion to displacements of the grasped nodes (and of a
sensor frame that moves along). D is never formed: samples of D η for random η approximate its
covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from scipy.special import binom

from ..common.array_types import Array
from ..program.collocation import Collocation, ExperimentIterate
from ..program.linear_algebra.lapack import one_blas_thread
from ..program.sweep import Sweep, SweepColumns
from ..recording.grasp import Grasp
from ..recording.poses import PoseSequence
from .budget.consider_analysis import propagate_columns
from .linearised import LinearisedFit, linearise_fit
from .uncertainty import AUTO, ErrorModel, Uncertainty, uncertainty_from_fit

# Samples of D η: the standard deviation that they give is within 9 %.
DRAWS = 64
# Fewest samples, for large bodies.
FEWEST_DRAWS = 32
# Memory of the samples [bytes].
BYTES = 2e8
# Order of the differences that remove a smooth motion.
ORDER = 5
# Noise of translations below which it is rounding of a file [m].
LEAST_M = 2e-6
# Noise of rotations below which it is rounding of a file [rad].
LEAST_RAD = 2e-5
# RMS effect on the residuals that is negligible [σ].
NEGLIGIBLE = 0.02


@dataclass(frozen=True)
class PoseNoise:
    """Noise of the poses of one grasp."""

    experiment: str
    sigma_m: float  # standard deviation of the translations [m]
    sigma_rad: float  # standard deviation of the rotations [rad]
    is_estimated: bool  # whether it was estimated from the roughness of the poses instead of stated

    def describe(self) -> str:
        """Return the message for the user: the size of the noise in mm and degrees, and whether it
        was stated or estimated.
        """
        how = "estimated from their roughness" if self.is_estimated else "as stated"
        return (
            f"the error bars of '{self.experiment}' include noise of the poses of "
            f"{1e3 * self.sigma_m:.2g} mm and {np.degrees(self.sigma_rad):.2g}°, {how}"
        )


def estimate_pose_noise(poses: PoseSequence) -> tuple[float, float]:
    """Estimate the standard deviations of translations [m] and rotations [rad] of white noise in
    poses, from differences of fifth order, in which a smooth motion hardly shows.

    Robust: the median of the absolute differences decides. Zero for a noise below `LEAST_M` or
    `LEAST_RAD`, which rounding of a file explains, and for fewer than 20 poses.
    """
    if len(poses.t_s) < 4 * ORDER:
        return 0.0, 0.0
    rotations = poses.rotation_steps
    sizes = [np.diff(poses.positions_m, ORDER, axis=0), np.diff(rotations, ORDER - 1, axis=0)]
    scale = np.sqrt(binom(2 * ORDER, ORDER))
    # The median of squares, so that a jump or a stroke does not count as noise.
    sigmas = [float(np.median(np.abs(size)) / 0.6745 / scale) for size in sizes]
    return (sigmas[0] if sigmas[0] > LEAST_M else 0.0, sigmas[1] if sigmas[1] > LEAST_RAD else 0.0)


@one_blas_thread()
def with_pose_noise(
    fit: LinearisedFit, collocation: Collocation, z: Array, seed: int = 0
) -> tuple[LinearisedFit, tuple[PoseNoise, ...]]:
    """Return a fit with samples of the effect of pose noise, and the noise that matters.

    The fit is not modified. The samples replace the `disturbances` of all its blocks.

    Parameters
    ----------
    z : (variables,) array
        The optimum.
    seed : int
        Seed of the random numbers, used anew for each experiment.

    Returns
    -------
    (LinearisedFit, tuple of PoseNoise)
        The fit with `disturbances` for all measurements of the experiments in which the RMS effect
        on a measurement is at least `NEGLIGIBLE` σ, else None; and the noise of the grasps of these
        experiments, without those of zero noise.
    """
    draws: list[Array | None] = []
    noises: list[PoseNoise] = []
    for part in collocation.iterates(z):
        noise_of_grasps = [
            _grasp_noise(part.transcription.experiment.name, g)
            for g in part.transcription.experiment.grasps
        ]
        disturbances: list[Array | None] = [None] * len(part.transcription.residuals)
        if any(noise.sigma_m or noise.sigma_rad for noise in noise_of_grasps):
            drawn = _residual_samples(part, noise_of_grasps, rng=np.random.default_rng(seed))
            if any(np.sqrt(np.mean(each**2)) >= NEGLIGIBLE for each in drawn):
                disturbances = [*drawn]
        draws += disturbances
        if disturbances[0] is not None:
            noises += [noise for noise in noise_of_grasps if noise.sigma_m or noise.sigma_rad]
    return fit.with_disturbances(draws), tuple(noises)


def _grasp_noise(name: str, grasp: Grasp) -> PoseNoise:
    rough_m, rough_rad = estimate_pose_noise(grasp.poses)
    sigma_m = rough_m if grasp.sigma_m is None else grasp.sigma_m
    sigma_rad = rough_rad if grasp.sigma_rad is None else grasp.sigma_rad
    return PoseNoise(name, sigma_m, sigma_rad=sigma_rad, is_estimated=grasp.sigma_m is None)


def _residual_samples(
    iterate: ExperimentIterate, noises: Sequence[PoseNoise], rng: np.random.Generator
) -> list[Array]:
    """Return, for each measurement of an experiment, K samples (K, T, M, 3) of the changes of its
    residuals by noise of the poses.

    K is `DRAWS`, or less for large bodies, but at least `FEWEST_DRAWS`.
    """
    transcription = iterate.transcription
    prescribed = iterate.equations.prescribed
    value_count = prescribed.positions_m.size * 8
    count = int(np.clip(BYTES / value_count, FEWEST_DRAWS, DRAWS))
    displacements_m = np.zeros((*prescribed.positions_m.shape, count))
    pose_errors = []
    for grasp, noise in zip(transcription.experiment.grasps, noises, strict=True):
        shifts, rotations = _pose_samples(iterate, grasp, noise=noise, rng=rng, count=count)
        _add_displacements(
            displacements_m, iterate, grasp=grasp, shifts=shifts, rotations=rotations
        )
        pose_errors.append((grasp, shifts, rotations))
    solver = Sweep(transcription)
    changes = []
    columns = SweepColumns.from_prescribed(solver, iterate.equations, changes_m=displacements_m)
    for residual, motion, values, by_noise in propagate_columns(iterate, solver, columns=columns):
        for grasp, shifts, rotations in pose_errors:
            by_noise = by_noise + residual.observable.frame_changes(
                grasp, motion, phi=iterate.phi, shifts=shifts, rotations=rotations
            )
        residual_changes = residual.residual_changes(values, by_noise, phi=iterate.phi)
        changes.append(np.moveaxis(residual_changes, 3, 0))
    return changes


def _pose_samples(
    iterate: ExperimentIterate, grasp: Grasp, noise: PoseNoise, rng: np.random.Generator, count: int
) -> tuple[Array, Array]:
    """Return `count` samples of translation [m] and rotation [rad] errors of the poses of a grasp
    at the N grid times, (N, count, 3) each; zero while the grasp does not hold, and for a single
    pose. Noise is white at the times of the poses and interpolated to the grid as the poses are.
    """
    t_s = iterate.transcription.dynamics.t_s
    samples = np.zeros((2, len(t_s), count, 3))
    if len(grasp.poses.t_s) > 1:
        rows = np.flatnonzero(grasp.is_active(t_s))
        white = rng.normal(size=(2, len(grasp.poses.t_s), 3 * count))
        for own, sigma, values in zip(
            samples, (noise.sigma_m, noise.sigma_rad), white, strict=True
        ):
            between = _interpolate(grasp.poses, sigma * values, t_s=t_s[rows])
            own[rows] = between.reshape(len(rows), count, 3)
    return samples[0], samples[1]


def _add_displacements(
    displacements_m: Array,
    iterate: ExperimentIterate,
    grasp: Grasp,
    shifts: Array,
    rotations: Array,
) -> None:
    """Add displacements due to pose errors in place."""
    transcription = iterate.transcription
    prescribed = iterate.equations.prescribed
    t_s = transcription.dynamics.t_s
    count = displacements_m.shape[2]
    rows = np.flatnonzero(grasp.is_active(t_s))
    dofs = np.searchsorted(prescribed.dofs, grasp.prescribed_dofs)
    arms = grasp.poses.at(t_s[rows])[0] @ transcription.body.nodes_m[grasp.nodes].T
    arms = np.moveaxis(arms, 1, 2)
    change = shifts[rows, None] + np.cross(rotations[rows, None], arms[:, :, None])
    change = change[..., grasp.axis_indices]  # (rows, nodes, c, axes)
    displacements_m[np.ix_(rows, dofs)] += np.moveaxis(change, 3, 2).reshape(
        len(rows), len(dofs), count
    )


def _interpolate(poses: PoseSequence, values: Array, t_s: Array) -> Array:
    """Return values (m, …) at the poses' times, interpolated to the times `t_s` as the poses are:
    by cubic splines, linearly, or held; beyond the first and last pose, held values and linear
    ones stay constant.
    """
    if poses.interpolation == "smooth" and len(poses.t_s) > 3:
        return scipy.interpolate.CubicSpline(poses.t_s, values)(t_s)
    kind = "previous" if poses.interpolation == "hold" else "linear"
    inside = np.clip(t_s, poses.t_s[0], poses.t_s[-1])
    return scipy.interpolate.interp1d(poses.t_s, values, kind, axis=0)(inside)


def uncertainty_at(
    collocation: Collocation, z: Array, error_model: ErrorModel = AUTO
) -> Uncertainty:
    """Return the uncertainty of the parameters at the optimum z (variables,), with noise of the
    poses.

    Raises
    ------
    InputError
        If the noise is to be estimated from fewer measurements than parameters.
    SimulationError
        If the equations of motion are singular.
    """
    fit, _ = with_pose_noise(linearise_fit(collocation, z), collocation, z=z)
    return uncertainty_from_fit(fit, collocation.parameters, z[: collocation.nq], error_model)
