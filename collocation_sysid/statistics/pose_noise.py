"""What noise of the poses does to the residuals: it acts through the dynamics.

A pose that is off for a sample shakes the body, and the markers miss the fit for as long as that
swings on. To first order the residuals change by D η, η being the noise of all poses and D the
response of the linearised equations of motion to grasped nodes that move, and of a sensor's frame
that is carried along. D is never formed:
samples of D η for random η tell its covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline, interp1d
from scipy.special import binom

from ..arrays import Array
from ..program.collocation import Collocation, Part
from ..program.lapack import one_blas_thread
from ..program.sweep import Columns, Sweep
from ..recording.grasp import Grasp
from ..recording.poses import PoseSequence
from .considered import followed
from .linearised import LinearisedFit

# Samples of D η, and the fewest and the memory where bodies are large.
DRAWS = 200
FEWEST_DRAWS = 32
BYTES = 2e8
# Differences of this order leave noise and take away a smooth motion.
ORDER = 5
# Noise below these is rounding of a file.
LEAST_M = 2e-6
LEAST_RAD = 2e-5
# Noise whose residuals are below this share of sigma is of no consequence.
NEGLIGIBLE = 0.02


@dataclass(frozen=True)
class PoseNoise:
    """Noise of the poses of one grasp.

    Attributes
    ----------
    experiment : str
    sigma_m, sigma_rad : float
    judged : bool
        By how rough the poses are, not given.
    """

    experiment: str
    sigma_m: float
    sigma_rad: float
    judged: bool

    @property
    def sentence(self) -> str:
        """For people."""
        how = "as rough as they are" if self.judged else "as given"
        return (
            f"the error bars of '{self.experiment}' allow for noise of the poses of "
            f"{1e3 * self.sigma_m:.2g} mm and {np.degrees(self.sigma_rad):.2g}°, {how}"
        )


def roughness(poses: PoseSequence) -> tuple[float, float]:
    """Standard deviations [m] and [rad] of white noise that makes poses as rough as they are.

    From differences of fifth order, in which a smooth motion hardly shows; zero for noise that
    printing explains, and for too few poses.
    """
    if len(poses.t_s) < 4 * ORDER:
        return 0.0, 0.0
    turns = poses.turns
    sizes = [np.diff(poses.positions_m, ORDER, axis=0), np.diff(turns, ORDER - 1, axis=0)]
    scale = np.sqrt(binom(2 * ORDER, ORDER))
    # The median of squares, so that a jump or a stroke does not count as noise.
    found = [float(np.median(np.abs(size)) / 0.6745 / scale) for size in sizes]
    return (
        found[0] if found[0] > LEAST_M else 0.0,
        found[1] if found[1] > LEAST_RAD else 0.0,
    )


@one_blas_thread()
def with_pose_noise(
    fit: LinearisedFit, collocation: Collocation, z: Array, seed: int = 0
) -> tuple[LinearisedFit, tuple[PoseNoise, ...]]:
    """A fit with samples of how noise of the poses changes its residuals, and what noise that is.

    Returns
    -------
    fit : LinearisedFit
    noises : tuple of PoseNoise, those that matter
    """
    draws: list[Array | None] = []
    noises: list[PoseNoise] = []
    for part in collocation.parts(z):
        here = [_noise(part.segment.experiment.name, g) for g in part.segment.experiment.grasps]
        found: list[Array | None] = [None] * len(part.segment.readings)
        if any(noise.sigma_m or noise.sigma_rad for noise in here):
            drawn = _drawn(part, here, np.random.default_rng(seed))
            if any(np.sqrt(np.mean(each**2)) >= NEGLIGIBLE for each in drawn):
                found = [*drawn]
        draws += found
        if found[0] is not None:
            noises += [noise for noise in here if noise.sigma_m or noise.sigma_rad]
    return fit.disturbed(draws), tuple(noises)


def _noise(name: str, grasp: Grasp) -> PoseNoise:
    rough_m, rough_rad = roughness(grasp.poses)
    sigma_m = rough_m if grasp.sigma_m is None else grasp.sigma_m
    sigma_rad = rough_rad if grasp.sigma_rad is None else grasp.sigma_rad
    return PoseNoise(name, sigma_m, sigma_rad, grasp.sigma_m is None)


def _drawn(part: Part, noises: Sequence[PoseNoise], rng: np.random.Generator) -> list[Array]:
    """(K, T, M, 3) changes of the residuals of each reading."""
    segment = part.segment
    held = part.setting.held
    numbers = held.positions_m.size * 8
    count = int(np.clip(BYTES / numbers, FEWEST_DRAWS, DRAWS))
    moved = np.zeros((*held.positions_m.shape, count))
    off = []
    for grasp, noise in zip(segment.experiment.grasps, noises, strict=True):
        shifts, turns = _poses_drawn(part, grasp, noise, rng, count)
        _add_noise(moved, part, grasp, shifts, turns)
        off.append((grasp, shifts, turns))
    solver = Sweep(segment)
    changes = []
    columns = Columns.along(solver, part.setting, moved)
    for reading, motion, looked, by in followed(part, solver, columns):
        for grasp, shifts, turns in off:
            by = by + reading.channel.carried(grasp, motion, part.phi, shifts, turns)
        changes.append(np.moveaxis(reading.changes(looked, by, part.phi), 3, 0))
    return changes


def _poses_drawn(
    part: Part, grasp: Grasp, noise: PoseNoise, rng: np.random.Generator, count: int
) -> tuple[Array, Array]:
    """Shifts and turns (N, c, 3) of the poses at grid times, zero where they do not hold."""
    t_s = part.segment.dynamics.t_s
    found = np.zeros((2, len(t_s), count, 3))
    if len(grasp.poses.t_s) > 1:
        rows = np.flatnonzero(grasp.holds(t_s))
        white = rng.normal(size=(2, len(grasp.poses.t_s), 3 * count))
        for own, sigma, values in zip(found, (noise.sigma_m, noise.sigma_rad), white, strict=True):
            between = _between(grasp.poses, sigma * values, t_s[rows])
            own[rows] = between.reshape(len(rows), count, 3)
    return found[0], found[1]


def _add_noise(moved: Array, part: Part, grasp: Grasp, shifts: Array, turns: Array) -> None:
    """Add how poses that are off move a grasp's nodes to `moved` (N, g, c), in place."""
    segment = part.segment
    held = part.setting.held
    t_s = segment.dynamics.t_s
    count = moved.shape[2]
    rows = np.flatnonzero(grasp.holds(t_s))
    dofs = np.searchsorted(held.dofs, grasp.dofs)
    arms = grasp.poses.at(t_s[rows])[0] @ segment.body.nodes_m[grasp.nodes].T
    arms = np.moveaxis(arms, 1, 2)
    change = shifts[rows, None] + np.cross(turns[rows, None], arms[:, :, None])
    change = change[..., grasp.columns]  # (rows, nodes, c, axes)
    moved[np.ix_(rows, dofs)] += np.moveaxis(change, 3, 2).reshape(len(rows), len(dofs), count)


def _between(poses: PoseSequence, values: Array, t_s: Array) -> Array:
    """Values (m, …) at the poses' times as the poses are interpolated."""
    if poses.interpolation == "smooth" and len(poses.t_s) > 3:
        return CubicSpline(poses.t_s, values)(t_s)
    kind = "previous" if poses.interpolation == "hold" else "linear"
    inside = np.clip(t_s, poses.t_s[0], poses.t_s[-1])
    return interp1d(poses.t_s, values, kind, axis=0)(inside)
