"""A bar that is swung at one end, filmed by ordinary cameras."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np

import collocation_sysid as cs
from kit.depth import looking

TRUTH = {"young_pa": 1.5e5, "poisson": 0.45, "gamma_r_s": 2e-3, "gamma_m_1_s": 0.1}
MATRIX = [[900.0, 0.0, 640.0], [0.0, 905.0, 360.0], [0.0, 0.0, 1.0]]
SIZE_PX = (1280, 720)
DISTORTION = [-0.1, 0.02, 1e-3, -5e-4, 0.0]
EYES_M = {"front": (0.06, -0.45, 0.1), "side": (0.5, -0.15, 0.15), "top": (0.05, 0.1, 0.55)}
T_S = 0.01 * np.arange(41)
NOISE_PX = 0.5
# Points on all sides of the bar.
PLACES_M = {
    "tip_front": (0.115, 0.0, 0.012),
    "tip_end": (0.12, 0.016, 0.008),
    "tip_top": (0.108, 0.012, 0.02),
    "middle_front": (0.07, 0.0, 0.006),
    "middle_top": (0.066, 0.02, 0.02),
    "near_front": (0.035, 0.0, 0.014),
    "near_top": (0.04, 0.01, 0.02),
}
NAMES = tuple(PLACES_M)
# Statements of a camera without errors, and of exact places.
EXACT: dict[str, Any] = {
    "pose_sigma": cs.PoseSigma(turn_deg=0.0, shift_m=0.0),
    "focal_sigma": 0.0,
    "centre_sigma_px": 0.0,
    "clock_sigma_s": 0.0,
    "place_sigma_m": 0.0,
}


def filming(name: str, **changes: Any) -> cs.Camera:
    """One of the three cameras."""
    pose = looking(np.array(EYES_M[name]), np.array([0.06, 0.015, 0.0]))
    arguments: dict[str, Any] = {"distortion": DISTORTION, "pose": pose, "size_px": SIZE_PX}
    return cs.Camera(MATRIX, **arguments | changes)


@cache
def bar() -> cs.Body:
    return cs.Body(cs.box_mesh((0.12, 0.03, 0.02), (4, 1, 1)), density_kg_m3=1070.0)


def swung(readings: Sequence[cs.CustomSensor] = (), **changes: Any) -> cs.Experiment:
    """The bar, whose held end is moved sideways and up, with markers at the places without
    readings.
    """
    share = 0.5 * (1 - np.cos(np.pi * np.clip(T_S / 0.12, 0, 1)))
    poses = np.tile(np.eye(4), (len(T_S), 1, 1))
    poses[:, 1, 3], poses[:, 2, 3] = 0.015 * share, 0.01 * share
    held = cs.Grasp(np.flatnonzero(bar().nodes_m[:, 0] < 1e-9), poses)
    arguments: dict[str, Any] = {"nuisance": cs.Nuisance.none(), "readings": readings}
    if not readings:
        tracks = np.zeros((len(T_S), len(NAMES), 3))
        arguments["markers"] = cs.Markers(
            T_S, tracks, 1e-3, names=NAMES, places_m=list(PLACES_M.values())
        )
    return cs.Experiment(bar(), T_S, [held], name="swing", **arguments | changes)


@cache
def motion_m() -> np.ndarray:
    """Positions of the points in the world."""
    return cs.simulate(swung(), TRUTH, "midpoint", substeps=1).markers_m


def projected(camera: cs.Camera, points_m: np.ndarray) -> np.ndarray:
    """Pixels of points in the world, without the package's model of tracks."""
    own = (points_m - camera.pose[:3, 3]) @ camera.pose[:3, :3]
    return camera.distorted_pixels(own.reshape(-1, 3)).reshape(*points_m.shape[:-1], 2)


def tracks_of(
    name: str = "front",
    rng: np.random.Generator | None = None,
    camera: cs.Camera | None = None,
    known: bool = True,
    **changes: Any,
) -> cs.ImageTracks:
    """What a camera records, with noise if a generator is given; described by another camera if one
    is stated.
    """
    pixels = projected(filming(name), motion_m())
    if rng is not None:
        pixels = pixels + NOISE_PX * rng.normal(size=pixels.shape)
    arguments: dict[str, Any] = {"sigma_px": NOISE_PX, "places_m": None}
    if known:
        arguments["places_m"] = list(PLACES_M.values())
    return cs.ImageTracks(name, camera or filming(name), T_S, pixels, NAMES, **arguments | changes)


def unknown_young(guess_pa: float = 6e4) -> dict[str, Any]:
    return {**TRUTH, "young_pa": cs.Unknown(guess_pa)}
