"""A bar that hangs from one end, seen by a depth camera."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.program.depth.outline_residual import OutlineResidual
from collocation_sysid.program.depth.residual import DepthResidual
from collocation_sysid.program.depth.visible_surface import VisibleSurface
from collocation_sysid.program.transcription import Transcription

TRUTH = {"young_pa": 1.5e5, "poisson": 0.45, "gamma_r_s": 1e-3, "gamma_m_1_s": 0.1}


MATRIX, SHAPE = [[300.0, 0, 80], [0, 300.0, 60], [0, 0, 1]], (120, 160)


MIDDLE_M, BIAS_M, NOISE_M = np.array([0.06, 0.015, -0.01]), 0.002, 1.5e-4


def looking(eye_m: np.ndarray, at_m: np.ndarray = MIDDLE_M) -> np.ndarray:
    """The pose of a camera that looks from one point at another, upright."""
    ahead = (at_m - eye_m) / np.linalg.norm(at_m - eye_m)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.column_stack([right, np.cross(ahead, right), ahead, eye_m])
    return pose


POSE = looking(np.array([0.06, -0.3, 0.15]))


@cache
def bar() -> cs.Body:
    return cs.Body(
        cs.box_mesh((0.12, 0.03, 0.02), (4, 1, 1)), density_kg_m3=1070.0, element="tet10"
    )


def hanging(depths: tuple[cs.Depth, ...], **changes) -> cs.Experiment:
    """The bar held at one end, sagging."""
    held = cs.Grasp(np.flatnonzero(bar().nodes_m[:, 0] < 1e-9), cs.PoseSequence.fixed())
    kept = cs.Nuisance.none(
        depth_turn_rad=0.09, depth_shift_m=0.02, depth_bias_m=0.005, depth_scale=0.005
    )
    return cs.Experiment(
        bar(), [0.0], [held], kind="static", depths=depths, **{"nuisance": kept} | changes
    )


NOTHING = cs.Depth("none", [0.0], [np.zeros((1, 3))], 1e-3)


@cache
def hanging_m() -> np.ndarray:
    """The surface of the bar, sagging."""
    x = cs.simulate(hanging((NOTHING,)), TRUTH).positions_m[0]
    return x[VisibleSurface.from_body(bar(), NOTHING).nodes]


@cache
def image_m() -> np.ndarray:
    """What a camera at POSE sees of the bar, without noise."""
    skin, camera = (VisibleSurface.from_body(bar(), NOTHING), cs.DepthCamera(MATRIX, pose=POSE))
    seen = (skin.subdivided_triangles(hanging_m()) - POSE[:3, 3]) @ POSE[:3, :3]
    return cs.depth_image(camera, SHAPE, seen)


def noisy(rng: np.random.Generator) -> np.ndarray:
    """The same with a bias, and noise that is alike over three pixels."""
    noise = gaussian_filter(rng.normal(size=SHAPE), 1.2)
    return image_m() + BIAS_M + NOISE_M * noise / noise.std()


def moved(turn_rad: np.ndarray, shift_m: np.ndarray) -> np.ndarray:
    """A pose that is stated wrong by a turn about the middle of the bar, and a shift."""
    off = np.eye(4)
    off[:3, :3] = Rotation.from_rotvec(turn_rad).as_matrix()
    off[:3, 3] = MIDDLE_M - off[:3, :3] @ MIDDLE_M + shift_m
    return off @ POSE


def fitted(image: np.ndarray, pose: np.ndarray, guess: float = 2e5, **options) -> cs.Solution:
    camera = cs.DepthCamera(MATRIX, pose=pose)
    depth = cs.Depth.of_images("front", image, camera, NOISE_M, spacing_m=0.004, **options)
    unknown = {**TRUTH, "young_pa": cs.Unknown(guess)}
    return cs.solve(cs.Problem([hanging((depth,))], cs.Parameters.from_mapping(unknown)))


PROBLEM = """
[object]
mesh = "bar.vtu"
element = "tet10"
density_kg_m3 = 1070.0
[parameters]
young_pa = { guess = 1.5e5 }
poisson = 0.45
gamma_r_s = 1e-3
gamma_m_1_s = 0.1
[[experiment]]
name = "hanging"
kind = "static"
[experiment.grasp]
nodes = { box_m = [[-1, -1, -1], [1e-6, 1, 1]] }
[[experiment.depth]]
name = "front"
file = "front.npz"
sigma_m = 0.0002
"""


def camera_residuals(transcription: Transcription) -> list[DepthResidual]:
    """Residuals of the points of the depth cameras, without those of outlines."""
    found = transcription.residuals_of(DepthResidual)
    return [each for each in found if not isinstance(each, OutlineResidual)]
