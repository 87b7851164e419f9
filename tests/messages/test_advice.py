"""The advice of likely causes, followed mechanically: the description is right afterwards, and nothing
is in doubt.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from kit.filmed import MATRIX, SIZE_PX, filming, swung, tracks_of
from twins import SOFT, twin
from wrong_twins import FAULTS

import collocation_sysid as cs
from collocation_sysid.kinds.image_tracks.stated_cameras import hypotheses
from collocation_sysid.runs.check import misspecification_hypotheses

Tracks = cs.ImageTracks


def pixels_of(tracks: Tracks) -> np.ndarray:
    assert tracks.pixels is not None
    return np.array(tracks.pixels)


def with_pixels(tracks: Tracks, pixels: np.ndarray) -> Tracks:
    return tracks.with_samples(tracks.t_s, pixels.reshape(len(tracks.t_s), -1))


def with_pose(tracks: Tracks, change: Callable[[np.ndarray], np.ndarray]) -> Tracks:
    return replace(tracks, camera=filming("front", pose=change(np.array(tracks.camera.pose))))


def with_rotation(pose: np.ndarray, turn: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    pose[:3, :3] = turn(pose[:3, :3])
    return pose


def in_units(pose: np.ndarray, factor: float) -> np.ndarray:
    pose[:3, 3] *= factor
    return pose


WIDTH, HEIGHT = SIZE_PX
FOCAL_PX, CENTRE_PX = np.diag(MATRIX)[:2], np.array(MATRIX)[:2, 2]
FLIP = np.diag([1, -1, -1])
CAMERA_MISTAKES: dict[str, Callable[[Tracks], Tracks]] = {
    "row and column": lambda t: with_pixels(t, pixels_of(t)[..., ::-1]),
    "v upwards": lambda t: with_pixels(t, pixels_of(t) * [1, -1] + [0, HEIGHT - 1]),
    "mirrored": lambda t: with_pixels(t, pixels_of(t) * [-1, 1] + [WIDTH - 1, 0]),
    "half the resolution": lambda t: with_pixels(t, pixels_of(t) / 2),
    "twice the resolution": lambda t: with_pixels(t, pixels_of(t) * 2),
    "shares of the image": lambda t: with_pixels(t, pixels_of(t) / SIZE_PX),
    "over the focal length": lambda t: with_pixels(t, (pixels_of(t) - CENTRE_PX) / FOCAL_PX),
    "cropped": lambda t: with_pixels(t, pixels_of(t) - [300, 100]),
    "turned clockwise": lambda t: with_pixels(
        t, pixels_of(t)[..., ::-1] * [-1, 1] + [HEIGHT - 1, 0]
    ),
    "pose inverted": lambda t: with_pose(t, np.linalg.inv),
    "frame of a renderer": lambda t: with_pose(t, lambda p: with_rotation(p, lambda r: r @ FLIP)),
    "millimetres": lambda t: with_pose(t, lambda p: in_units(p, 1e3)),
    "rotation transposed": lambda t: with_pose(t, lambda p: with_rotation(p, np.transpose)),
}


def camera_after(tracks: Tracks, advice: str) -> Tracks:
    """The tracks as the advice states them."""
    pixels = pixels_of(tracks)
    if "exchange the columns" in advice:
        return with_pixels(tracks, pixels[..., ::-1])
    if found := re.search(r"use (\d+) - ([uv])", advice):
        axis = "uv".index(found[2])
        pixels[..., axis] = float(found[1]) - pixels[..., axis]
        return with_pixels(tracks, pixels)
    if found := re.search(r"have (\S+) times the resolution", advice):
        scaled = np.diag([float(found[1])] * 2 + [1.0]) @ MATRIX
        return replace(tracks, camera=replace(tracks.camera, matrix=scaled))
    if "multiply them by its size" in advice:
        return with_pixels(tracks, pixels * SIZE_PX)
    if "state pixels of the original images" in advice:
        return with_pixels(tracks, pixels * FOCAL_PX + CENTRE_PX)
    if found := re.search(r"shifted by \((-?\d+), (-?\d+)\)", advice):
        return with_pixels(tracks, pixels + np.array([float(found[1]), float(found[2])]))
    if "turned by 90 degrees clockwise: turn it back" in advice:
        back = np.stack([pixels[..., 1], HEIGHT - 1 - pixels[..., 0]], axis=-1)
        return with_pixels(tracks, back)
    if "invert it" in advice:
        return with_pose(tracks, np.linalg.inv)
    if "y up, z backwards" in advice:
        return with_pose(tracks, lambda p: with_rotation(p, lambda r: r @ FLIP))
    if "is in millimetres: state it in metres" in advice:
        return with_pose(tracks, lambda p: in_units(p, 1e-3))
    assert "its rotation is transposed" in advice, advice
    return with_pose(tracks, lambda p: with_rotation(p, np.transpose))


@pytest.mark.parametrize("mistake", CAMERA_MISTAKES)
def test_followed_advice_on_a_camera_leaves_a_right_description(mistake):
    right = tracks_of()
    wrong = CAMERA_MISTAKES[mistake](right)
    (found,) = hypotheses(swung([wrong]))
    after = camera_after(wrong, found.message)
    assert not [*hypotheses(swung([after]))]
    if mistake == "cropped":  # the shift is that of the median point
        assert pixels_of(after) == pytest.approx(pixels_of(right), abs=10)
    elif "resolution" in mistake:  # the matrix is scaled, and the pixels stay
        ratio = np.asarray(after.camera.matrix) @ np.linalg.inv(MATRIX)
        scale = 0.5 if mistake.startswith("half") else 2.0
        np.testing.assert_allclose(ratio, np.diag([scale, scale, 1.0]), atol=1e-9)
    else:
        np.testing.assert_allclose(pixels_of(after), pixels_of(right), atol=1e-6)
        np.testing.assert_allclose(after.camera.pose, right.camera.pose, atol=1e-9)


@pytest.mark.long
def test_followed_advice_on_the_unit_of_poses_leaves_nothing_in_doubt():
    wrong = FAULTS["poses in mm"](twin("bar", SOFT, 1), np.random.default_rng(3))
    first, *_ = misspecification_hypotheses(wrong)
    size = re.search(r"the poses would fit if they were (\S+) times as large", first.message)
    assert size is not None
    (experiment,) = wrong.experiments
    (grasp,) = experiment.grasps
    poses = replace(grasp.poses, positions_m=float(size[1]) * grasp.poses.positions_m)
    changed = replace(experiment, grasps=[replace(grasp, poses=poses)])
    assert misspecification_hypotheses(replace(wrong, experiments=[changed])) == ()
