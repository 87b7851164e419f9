"""Correct problems of a soft bar that is swung at one end and filmed by one or two cameras.

A bar of 120 x 30 x 20 mm moves for 0.8 s, and each camera records ten points of the sides that it
sees at 50 Hz. Each seed has its own noise, and its own errors of the stated poses of the cameras,
drawn from the prior that the problem states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from depth_twins import upright_pose
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.common.array_types import Array

TRUTH = {"young_pa": 1e5, "poisson": 0.4, "gamma_r_s": 5e-3, "gamma_m_1_s": 0.1}
UNKNOWN = {**TRUTH, "young_pa": cs.Unknown(2e5), "gamma_r_s": cs.Unknown(3e-3)}
SIZE_PX = (1280, 720)
MATRIX = np.array([[1100.0, 0.0, 655.0], [0.0, 1104.0, 352.0], [0.0, 0.0, 1.0]])
# That of a wide-angle lens.
DISTORTION = np.array([-0.28, 0.09, 1e-3, -5e-4, 0.0])
# Cameras [m] and the point at which they look, which is not in the middle of the bar.
EYES_M = {"front": np.array([0.10, -0.42, 0.11]), "top": np.array([0.0, -0.12, 0.45])}
TARGET_M = np.array([0.07, 0.02, 0.0])
PLACES_M = {
    "front": [(x, 0.0, z) for x in (0.02, 0.05, 0.08, 0.105, 0.115) for z in (0.005, 0.016)],
    "top": [(x, y, 0.02) for x in (0.02, 0.045, 0.07, 0.1, 0.115) for y in (0.006, 0.022)],
}
NOISE_PX = 0.4
TURN_DEG = 1.0
SHIFT_M = 0.005
T_S = 0.02 * np.arange(41)


@cache
def bar() -> cs.Body:
    """Return the bar; all twins share it, so that its kernels compile once."""
    return cs.Body(cs.box_mesh((0.12, 0.03, 0.02), (4, 1, 1)), density_kg_m3=1070.0)


def recording(readings: Sequence[cs.ImageTracks]) -> cs.Experiment:
    """Return the bar, whose held end moves to and fro and turns."""
    share = np.sin(2 * np.pi * 2.5 * T_S) * np.clip(T_S / 0.1, 0, 1)
    poses = np.tile(np.eye(4), (len(T_S), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(share, [0, 0.1, 0.1])).as_matrix()
    poses[:, 0, 3], poses[:, 2, 3] = 0.015 * share, 0.02 * share
    grasp = cs.Grasp(np.flatnonzero(bar().nodes_m[:, 0] < 1e-9), poses)
    return cs.Experiment(bar(), T_S, [grasp], readings=readings, nuisance=cs.Nuisance.none())


def camera(name: str) -> cs.Camera:
    """Return one of the cameras with its true pose."""
    ahead = TARGET_M - EYES_M[name]
    pose = upright_pose(EYES_M[name], ahead / np.linalg.norm(ahead))
    return cs.Camera(MATRIX, DISTORTION, pose, size_px=SIZE_PX)


@cache
def true_pixels(name: str) -> Array:
    """Return the pixels (S, N, 2) of the points of a camera without noise."""
    places = PLACES_M[name]
    names = [f"{name}_{k}" for k in range(len(places))]
    seen = cs.ImageTracks(name, camera(name), T_S, None, names, places_m=places)
    simulated = cs.simulate(recording([seen]), TRUTH, "midpoint", substeps=32)
    return simulated.custom_sensor_values[0].reshape(len(T_S), -1, 2)


def stated_tracks(name: str, rng: np.random.Generator, *, are_places_known: bool) -> cs.ImageTracks:
    """Return what a camera records, with noise, as a description with a drawn error of the pose
    states it.
    """
    true = camera(name)
    stated = true.pose.copy()
    stated[:3, 3] += SHIFT_M * rng.normal(size=3)
    turn = Rotation.from_rotvec(np.deg2rad(TURN_DEG) * rng.normal(size=3))
    stated[:3, :3] = stated[:3, :3] @ turn.as_matrix()
    pixels = true_pixels(name)
    places = PLACES_M[name]
    return cs.ImageTracks(
        name,
        replace(true, pose=stated),
        T_S,
        pixels + NOISE_PX * rng.normal(size=pixels.shape),
        [f"{name}_{k}" for k in range(len(places))],
        places_m=places if are_places_known else None,
        sigma_px=NOISE_PX,
        pose_sigma=cs.PoseSigma(turn_deg=TURN_DEG, shift_m=SHIFT_M),
    )


def filmed_twin(
    seed: int, *, cameras: Sequence[str] = ("front",), are_places_known: bool = True
) -> cs.Problem:
    """Return the problem of a recording."""
    rng = np.random.default_rng(seed)
    tracks = [stated_tracks(name, rng, are_places_known=are_places_known) for name in cameras]
    return cs.Problem([recording(tracks)], parameters=UNKNOWN)
