"""Shared by the scripts that make synthetic problems: a body swung by a robot, seen by cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import (
    Experiment,
    Grasp,
    PoseSequence,
    write_poses_csv,
)

HANGING = Rotation.from_rotvec([np.pi, 0, 0])

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Swing:
    """A motion from rest in all six degrees of freedom, of a body that hangs at first."""

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
    """Poses at `t_s`: from rest, each axis swings at its own frequency, rotations faster."""
    t = np.asarray(t_s) - t_s[0]
    rise = t**2 / (t**2 + rise_s**2)
    angular = 2 * np.pi * np.array(frequency_hz)
    phase = np.outer(t, angular)
    positions = (
        rise[:, None] * amplitude_m * np.sin(phase + np.array([0.0, 0.7, 1.4]))
    )
    turns = (
        rise[:, None]
        * amplitude_rad
        * np.sin(1.2 * phase + np.array([0.3, 1.0, 1.7]))
    )
    rotations = Rotation.from_rotvec(turns) * start
    return PoseSequence(np.asarray(t_s), positions, rotations.as_quat())


def unmeasured(problem: Path, poses: str, logged: PoseSequence) -> Experiment:
    """Write the robot's poses, remove old tracks, and load the experiment at the poses' times."""
    write_poses_csv(problem.parent / poses, logged)
    for tracks in problem.parent.glob("*_markers.csv"):
        tracks.unlink()
    return Problem.read(problem, simulation=True).experiments[0]


def measure(
    experiment: Experiment,
    fine: PoseSequence,
    truth: Mapping[str, float],
    noise_m: float,
    seed: int,
) -> np.ndarray:
    """Marker tracks (T, M, 3) of a Newmark simulation on the fine poses' own step, with noise."""
    grasp = experiment.grasps[0]
    moved = replace(experiment, grasps=(Grasp(grasp.nodes, fine),))
    step_s = float(fine.t_s[1] - fine.t_s[0])
    tracks = simulate(moved, truth, timestep_s=step_s).markers_m
    return (
        tracks + np.random.default_rng(seed).normal(size=tracks.shape) * noise_m
    )


def exchanged(
    tracks: np.ndarray, pair: Sequence[int], frames: slice
) -> np.ndarray:
    """Tracks in which two markers have each other's label for some frames."""
    swapped = tracks.copy()
    swapped[frames, list(pair)] = tracks[frames, list(pair)[::-1]]
    return swapped


def occluded(
    tracks: np.ndarray,
    blocks: Sequence[tuple[int, slice]],
    share: float,
    seed: int,
) -> np.ndarray:
    """Tracks without some markers' blocks of frames, and without a share of all samples."""
    lost = np.random.default_rng(seed).random(tracks.shape[:2]) < share
    for marker, frames in blocks:
        lost[frames, marker] = True
    return np.where(lost[..., None], np.nan, tracks)
