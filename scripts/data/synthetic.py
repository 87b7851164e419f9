"""Synthetic problems of a body that a robot swings and cameras observe; shared by the makers of
problems.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import Experiment, Grasp, PoseSequence, write_poses_csv

# Rotation by 180° about x: the body hangs below the gripper.
HANGING = Rotation.from_rotvec([np.pi, 0, 0])

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Swing:
    """Motion from rest in all six degrees of freedom; see `swing` for the arguments."""

    duration_s: float
    amplitude_m: Triple
    amplitude_rad: Triple
    frequency_hz: Triple
    rise_s: float
    start: Rotation = HANGING

    def poses(self, step_s: float) -> PoseSequence:
        """Return the poses at a distance of `step_s` in time [s]."""
        return swing(
            np.arange(round(self.duration_s / step_s) + 1) * step_s,
            self.amplitude_m,
            self.amplitude_rad,
            self.frequency_hz,
            self.rise_s,
            self.start,
        )


def swing(
    t_s: np.ndarray,
    amplitude_m: Triple,
    amplitude_rad: Triple,
    frequency_hz: Triple,
    rise_s: float,
    start: Rotation,
) -> PoseSequence:
    """Return the poses at times `t_s` [s] of a swing from rest.

    Each axis swings at its own frequency, the rotations 1.2 times as fast. The amplitudes rise from
    zero to their values within about `rise_s` [s], from the rotation `start` on.
    """
    t = np.asarray(t_s) - t_s[0]
    rise = t**2 / (t**2 + rise_s**2)
    angular = 2 * np.pi * np.array(frequency_hz)
    phase = np.outer(t, angular)
    positions = rise[:, None] * amplitude_m * np.sin(phase + np.array([0.0, 0.7, 1.4]))
    rotation_vectors_rad = (
        rise[:, None] * amplitude_rad * np.sin(1.2 * phase + np.array([0.3, 1.0, 1.7]))
    )
    rotations = Rotation.from_rotvec(rotation_vectors_rad) * start
    return PoseSequence(np.asarray(t_s), positions, rotations.as_quat())


def prepare_experiment(problem: Path, poses: str, logged: PoseSequence) -> Experiment:
    """Write the poses, delete old marker tracks, and return the experiment at the times of the
    poses.
    """
    write_poses_csv(problem.parent / poses, logged)
    for tracks in problem.parent.glob("*_markers.csv"):
        tracks.unlink()
    return Problem.read(problem, simulation=True).experiments[0]


def simulate_tracks(
    experiment: Experiment,
    fine: PoseSequence,
    truth: Mapping[str, float],
    noise_m: float,
    seed: int,
) -> np.ndarray:
    """Return noisy tracks (T, M, 3) [m] of a Newmark simulation with the time step of the poses
    `fine`.
    """
    grasp = experiment.grasps[0]
    on_fine_grid = replace(experiment, grasps=(Grasp(grasp.nodes, fine),))
    step_s = float(fine.t_s[1] - fine.t_s[0])
    tracks = simulate(on_fine_grid, truth, timestep_s=step_s).markers_m
    return tracks + np.random.default_rng(seed).normal(size=tracks.shape) * noise_m


def exchanged(tracks: np.ndarray, pair: Sequence[int], frames: slice) -> np.ndarray:
    """Return the tracks with the labels of two markers exchanged in some frames."""
    swapped = tracks.copy()
    swapped[frames, list(pair)] = tracks[frames, list(pair)[::-1]]
    return swapped


def occluded(
    tracks: np.ndarray, blocks: Sequence[tuple[int, slice]], share: float, seed: int
) -> np.ndarray:
    """Return the tracks with NaN in blocks of (marker, frames), and in a random share of all
    samples.
    """
    is_missing = np.random.default_rng(seed).random(tracks.shape[:2]) < share
    for marker, frames in blocks:
        is_missing[frames, marker] = True
    return np.where(is_missing[..., None], np.nan, tracks)
