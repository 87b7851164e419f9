"""Correct problems of a soft bar that one depth camera of low resolution observes.

A bar of 120 x 30 x 20 mm is clamped at one end. `hanging_twin` has one image of its sag,
`swinging_twin` several images of its motion. Each seed has its own noise, and its own error of the
stated camera pose, drawn from the prior that the problem states.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from collocation_sysid.common.array_types import Array, Index
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.model.parameters import Parameters, Unknown
from collocation_sysid.problem import Problem
from collocation_sysid.program.depth.visible_surface import VisibleSurface
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import (
    Depth,
    DepthCamera,
    Experiment,
    Grasp,
    Nuisance,
    PoseSequence,
)
from collocation_sysid.recording.depth_camera import depth_image

# Edges [m], numbers of elements and density of the bar.
SIZE_M = (0.12, 0.03, 0.02)
DIVISIONS = (4, 1, 1)
DENSITY_KG_M3 = 1070.0
TRUTH = {"young_pa": 1e5, "poisson": 0.4, "gamma_r_s": 5e-3, "gamma_m_1_s": 0.1}
UNKNOWN = {**TRUTH, "young_pa": Unknown(2e5)}
# Camera matrix [px]; the principal point is not at the centre, as in a cropped image.
MATRIX = [[260.0, 0.0, 66.0], [0.0, 260.0, 70.0], [0.0, 0.0, 1.0]]
SHAPE_PX = (120, 160)
# Noise of the depth of each pixel [m].
NOISE_M = 3e-4
# Standard deviation along the normal of the surface, which the rays meet at an angle.
SIGMA_M = 0.6 * NOISE_M
# Distance of the points that are compared [m].
SPACING_M = 0.005
EYE_M = np.array([0.12, -0.30, 0.16])
TARGET_M = np.array([0.05, 0.015, 0.0])
# Standard deviations of the error of the stated camera pose, and its priors.
TURN_RAD = 0.02
SHIFT_M = 0.004
# Samples and step of the motion, and the samples that have an image.
SAMPLES = 31
STEP_S = 0.01
IMAGE_SAMPLES = np.arange(0, SAMPLES, 5)


@cache
def bar() -> Body:
    """Return the bar; all twins share it, so that its kernels compile once."""
    return Body(box_mesh(SIZE_M, DIVISIONS), density_kg_m3=DENSITY_KG_M3, element="tet10")


def camera_pose() -> Array:
    """Return the pose (4, 4) of a camera that looks at the bar from the side and from above."""
    optical_axis = (TARGET_M - EYE_M) / np.linalg.norm(TARGET_M - EYE_M)
    return upright_pose(EYE_M, optical_axis)


def upright_pose(eye_m: Array, optical_axis: Array) -> Array:
    """Return the pose (4, 4) of a camera at `eye_m` (3,) [m] that looks along a unit vector (3,),
    with its rows of pixels horizontal.
    """
    right = np.cross(optical_axis, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.column_stack([right, np.cross(optical_axis, right), optical_axis, eye_m])
    return pose


def hanging_twin(seed: int) -> Problem:
    """Return the problem of one image of the bar that sags at rest."""
    times_s = np.array([0.0])
    clamped = PoseSequence.fixed()
    return _problem(times_s, clamped, image_samples=np.array([0]), seed=seed)


def swinging_twin(seed: int) -> Problem:
    """Return the problem of several images of the bar, whose clamp moves."""
    times_s: Array = STEP_S * np.arange(SAMPLES, dtype=np.float64)
    return _problem(times_s, _motion(times_s), image_samples=IMAGE_SAMPLES, seed=seed)


def _motion(times_s: Array) -> PoseSequence:
    """Return a motion of the clamp from rest, in translation and rotation, at times (T,) [s]."""
    rise = times_s**2 / (times_s**2 + 0.08**2)
    waves = np.sin(2 * np.pi * np.outer(times_s, [2.0, 2.7, 3.3]))
    positions_m = rise[:, None] * waves * np.array([0.01, 0.015, 0.03])
    rotation_vectors_rad = rise[:, None] * waves[:, ::-1] * np.array([0.05, 0.2, 0.15])
    return PoseSequence(times_s, positions_m, Rotation.from_rotvec(rotation_vectors_rad).as_quat())


def _experiment(times_s: Array, clamp: PoseSequence, depth: Depth) -> Experiment:
    """Return the experiment of the bar in a clamp that a camera observes."""
    clamp_grasp = Grasp(np.flatnonzero(bar().nodes_m[:, 0] < 1e-9), clamp)
    return Experiment(
        bar(),
        times_s,
        [clamp_grasp],
        name="bar",
        kind="static" if len(times_s) == 1 else "dynamic",
        depths=[depth],
        air_density_kg_m3=0.0,
        nuisance=Nuisance.none(depth_turn_rad=TURN_RAD, depth_shift_m=SHIFT_M),
    )


def _problem(times_s: Array, clamp: PoseSequence, image_samples: Index, seed: int) -> Problem:
    """Return the problem of one twin."""
    rng = np.random.default_rng(seed)
    images_m = np.array(_images_m(tuple(times_s), tuple(image_samples))) + NOISE_M * rng.normal(
        size=(len(image_samples), *SHAPE_PX)
    )
    camera = DepthCamera(MATRIX, pose=_pose_with_error(rng))
    depth = Depth.of_images(
        "front", images_m, camera, SIGMA_M, times_s[image_samples], spacing_m=SPACING_M
    )
    return Problem(
        [_experiment(times_s, clamp, depth)], Parameters.from_mapping(UNKNOWN), substeps=1
    )


@cache
def _images_m(times_s: tuple[float, ...], image_samples: tuple[int, ...]) -> Array:
    """Return the images (S, rows, columns) without noise, NaN where the bar is not visible; cached."""
    times = np.array(times_s)
    image_times_s = times[list(image_samples)]
    blank = Depth("none", image_times_s, [np.zeros((1, 3))] * len(image_times_s), SIGMA_M)
    clamp = PoseSequence.fixed() if len(times) == 1 else _motion(times)
    experiment = _experiment(times, clamp, blank)
    positions_m = simulate(experiment, TRUTH).positions_m
    surface = VisibleSurface.from_body(experiment.body, blank)
    pose = camera_pose()
    camera = DepthCamera(MATRIX, pose=pose)
    images_m = []
    for sample in image_samples:
        triangles_m = surface.subdivided_triangles(positions_m[sample][surface.nodes])
        in_camera_m = (triangles_m - pose[:3, 3]) @ pose[:3, :3]
        images_m.append(depth_image(camera, SHAPE_PX, in_camera_m))
    return np.array(images_m)


def _pose_with_error(rng: np.random.Generator) -> Array:
    """Return the camera pose (4, 4) with a random error of one standard deviation or less."""
    pose = camera_pose()
    turn = Rotation.from_rotvec(TURN_RAD * rng.uniform(-1, 1, 3)).as_matrix()
    shift_m = SHIFT_M * rng.uniform(-1, 1, 3)
    described_pose = pose.copy()
    described_pose[:3, :3] = turn @ pose[:3, :3]
    described_pose[:3, 3] = turn @ (pose[:3, 3] - TARGET_M) + TARGET_M + shift_m
    return described_pose


# A soft bar, whose stated camera is far off ------------------------------------------------------------

SOFT_TRUTH = {"young_pa": 2.5e4, "poisson": 0.45, "gamma_r_s": 1e-3, "gamma_m_1_s": 0.1}
# Camera matrix and image shape (rows, columns) [px].
SOFT_MATRIX = [[420.0, 0, 160], [0, 420.0, 120], [0, 0, 1]]
SOFT_SHAPE_PX = (240, 320)
# Point of the bar at which the camera looks [m], direction from there to the camera, and distance.
SOFT_CENTRE_M = np.array([0.045, 0.015, -0.04])
SOFT_VIEW_DIRECTION = np.array([0, -0.9, 0.35])
SOFT_DISTANCE_M = 0.4
# Standard deviation of the noise along the rays [m].
SOFT_NOISE_M = 4e-4
# Errors of the stated pose: rotation and shift, in random directions.
SOFT_TURN_RAD = np.radians(2.7)
SOFT_SHIFT_M = 0.008
# Standard deviations of the true pose of the camera between images.
TRUE_TURN_RAD = np.radians(1.0)
TRUE_SHIFT_M = 0.003
# Number of parts of each edge of a face for the rendered images; with 4 parts, chords in place of
# arcs would make E 1.5 % too large.
SOFT_DIVISIONS = 12


@cache
def soft_body() -> Body:
    """Return the soft bar, which has a finer mesh; cached."""
    mesh = box_mesh((0.12, 0.03, 0.02), (6, 2, 1))
    return Body(mesh, density_kg_m3=1070.0, element="tet10")


def soft_experiment(depth: Depth) -> Experiment:
    """Return the experiment of the soft bar with the default nuisance parameters."""
    body = soft_body()
    clamp = Grasp(np.flatnonzero(body.nodes_m[:, 0] < 1e-9), PoseSequence.fixed())
    return Experiment(body, [0.0], [clamp], kind="static", depths=[depth])


def soft_camera(turn_rad: Array, shift_m: Array) -> DepthCamera:
    """Return the camera of the soft bar, rotated about a point of the bar and shifted [rad, m]."""
    optical_axis = -SOFT_VIEW_DIRECTION / np.linalg.norm(SOFT_VIEW_DIRECTION)
    pose = upright_pose(SOFT_CENTRE_M - SOFT_DISTANCE_M * optical_axis, optical_axis)
    rotation = Rotation.from_rotvec(turn_rad).as_matrix()
    pose[:3, :3] = rotation @ pose[:3, :3]
    pose[:3, 3] = rotation @ (pose[:3, 3] - SOFT_CENTRE_M) + SOFT_CENTRE_M + shift_m
    return DepthCamera(SOFT_MATRIX, pose=pose)


@cache
def soft_shape_m() -> Array:
    """Return the positions (n, 3) of the nodes of the hanging soft bar [m]; cached."""
    no_points = Depth("none", [0.0], [np.zeros((1, 3))], 1e-3)
    return simulate(soft_experiment(no_points), SOFT_TRUTH).positions_m[0]


def soft_image_m(true_camera: DepthCamera) -> Array:
    """Return the image of the soft bar without noise [m]; NaN where the bar is not visible."""
    no_points = Depth("none", [0.0], [np.zeros((1, 3))], 1e-3)
    surface = VisibleSurface.from_body(soft_body(), no_points)
    rotations, translations = true_camera.pose_at([0.0])
    triangles_m = surface.subdivided_triangles(soft_shape_m()[surface.nodes], SOFT_DIVISIONS)
    return depth_image(true_camera, SOFT_SHAPE_PX, (triangles_m - translations[0]) @ rotations[0])


def soft_problem(seed: int, guess_pa: float | None = None) -> Problem:
    """Return the problem of one noisy image of the soft bar.

    The true pose of the camera differs between seeds, so that the rounding of edges to pixels
    differs between images; so does the error of the stated pose. Without `guess_pa`, E has no
    guess.
    """
    rng = np.random.default_rng(seed)
    noise_m = SOFT_NOISE_M * rng.normal(size=SOFT_SHAPE_PX)
    rotation_axis, direction = rng.normal(size=(2, 3))
    turn_rad = TRUE_TURN_RAD * rng.normal(size=3)
    shift_m = TRUE_SHIFT_M * rng.normal(size=3)
    image_m = soft_image_m(soft_camera(turn_rad, shift_m)) + noise_m
    camera = soft_camera(
        turn_rad + SOFT_TURN_RAD * rotation_axis / np.linalg.norm(rotation_axis),
        shift_m + SOFT_SHIFT_M * direction / np.linalg.norm(direction),
    )
    depth = Depth.of_images("front", image_m, camera, SOFT_NOISE_M, spacing_m=0.004)
    unknown = Unknown() if guess_pa is None else Unknown(guess_pa)
    parameters = Parameters.from_mapping({**SOFT_TRUTH, "young_pa": unknown})
    return Problem([soft_experiment(depth)], parameters)
