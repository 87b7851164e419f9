"""Shared by the scripts that make synthetic problems: a swing in all six degrees of freedom."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from collocation_sysid.experiment import Experiment, Grasp, PoseSequence
from collocation_sysid.nlp.parameters import Theta
from collocation_sysid.nlp.simulation import simulate


def swing(
    t_s: np.ndarray,
    amplitude_m: tuple[float, float, float],
    amplitude_rad: tuple[float, float, float],
    frequency_hz: tuple[float, float, float],
    rise_s: float,
    start: Rotation,
) -> PoseSequence:
    """Poses at `t_s`: from rest, each axis swings at its own frequency, rotations faster."""
    t = np.asarray(t_s) - t_s[0]
    rise = t**2 / (t**2 + rise_s**2)
    angular = 2 * np.pi * np.array(frequency_hz)
    phase = np.outer(t, angular)
    positions = rise[:, None] * amplitude_m * np.sin(phase + np.array([0.0, 0.7, 1.4]))
    turns = rise[:, None] * amplitude_rad * np.sin(1.2 * phase + np.array([0.3, 1.0, 1.7]))
    rotations = Rotation.from_rotvec(turns) * start
    return PoseSequence(np.asarray(t_s), positions, rotations.as_quat())


def measure(
    experiment: Experiment, fine: PoseSequence, truth: Theta, noise_m: float, seed: int
) -> np.ndarray:
    """Marker tracks (T, M, 3) of a Newmark simulation on the fine poses' own step, with noise."""
    grasp = experiment.grasps[0]
    moved = replace(experiment, grasps=(Grasp(grasp.nodes, fine),))
    step_s = float(fine.t_s[1] - fine.t_s[0])
    tracks = simulate(moved, truth, timestep_s=step_s).markers_m
    return tracks + np.random.default_rng(seed).normal(size=tracks.shape) * noise_m
