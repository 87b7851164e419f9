"""What a check and a fit say about image tracks that are described wrongly or lost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from kit.filmed import (
    NAMES,
    NOISE_PX,
    SIZE_PX,
    T_S,
    filming,
    motion_m,
    projected,
    swung,
    tracks_of,
    unknown_young,
)

import collocation_sysid as cs
from collocation_sysid.features.image_tracks.track_feature import hypotheses, track_hypotheses
from collocation_sysid.features.image_tracks.track_residual import ImageTrackResidual

Change = Callable[[cs.ImageTracks], cs.ImageTracks]


def pixels_of(tracks: cs.ImageTracks) -> np.ndarray:
    assert tracks.pixels is not None
    return np.array(tracks.pixels)


def with_pixels(tracks: cs.ImageTracks, pixels: np.ndarray) -> cs.ImageTracks:
    return tracks.with_samples(T_S, pixels.reshape(len(T_S), -1))


def with_pose(tracks: cs.ImageTracks, pose: np.ndarray) -> cs.ImageTracks:
    return replace(tracks, camera=filming("front", pose=pose))


def turned_frame(tracks: cs.ImageTracks) -> cs.ImageTracks:
    pose = np.array(tracks.camera.pose)
    pose[:3, :3] = pose[:3, :3] @ np.diag([1, -1, -1])
    return with_pose(tracks, pose)


def in_millimetres(tracks: cs.ImageTracks) -> cs.ImageTracks:
    pose = np.array(tracks.camera.pose)
    pose[:3, 3] *= 1e3
    return with_pose(tracks, pose)


MISTAKES: dict[str, tuple[Change, str]] = {
    "row and column": (lambda t: with_pixels(t, pixels_of(t)[..., ::-1]), "u and v are exchanged"),
    "v upwards": (
        lambda t: with_pixels(t, pixels_of(t) * [1, -1] + [0, SIZE_PX[1] - 1]),
        "v points upwards",
    ),
    "mirrored": (
        lambda t: with_pixels(t, pixels_of(t) * [-1, 1] + [SIZE_PX[0] - 1, 0]),
        "u points to the left",
    ),
    "half the resolution": (lambda t: with_pixels(t, pixels_of(t) / 2), "0.5 times the resolution"),
    "twice the resolution": (lambda t: with_pixels(t, pixels_of(t) * 2), "2 times the resolution"),
    "pose inverted": (
        lambda t: with_pose(t, np.linalg.inv(t.camera.pose)),
        "from the world to the camera",
    ),
    "frame of a renderer": (turned_frame, "y up, z backwards"),
    "millimetres": (in_millimetres, "in millimetres"),
}


# The rays of a mirrored image of a symmetric body meet the body, so that only places contradict it.
@pytest.mark.parametrize(
    ("mistake", "known"),
    [(m, k) for m in MISTAKES for k in (True, False) if (m, k) != ("mirrored", False)],
)
def test_wrong_descriptions_of_a_camera_are_named(mistake: str, known: bool) -> None:
    change, words = MISTAKES[mistake]
    found = [*hypotheses(swung([change(tracks_of(known=known))]))]
    assert [each.code for each in found] == ["image-tracks/likely"]
    assert words in found[0].message


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("camera", ["front", "side", "top"])
def test_a_right_description_is_not_doubted(camera: str, known: bool) -> None:
    assert [*hypotheses(swung([tracks_of(camera, known=known)]))] == []


def test_tracks_of_another_scene_are_doubted() -> None:
    pixels = np.random.default_rng(8).uniform(0, 300, (len(T_S), len(NAMES), 2))
    found = [*hypotheses(swung([with_pixels(tracks_of(), pixels)]))]
    assert [each.cause for each in found] == ["image-tracks"]


def exchanged(pixels: np.ndarray) -> np.ndarray:
    order = [2, 1, 0, 3, 4, 5, 6]
    return pixels[:, order]


def stuck(pixels: np.ndarray) -> np.ndarray:
    pixels[:, 2] = pixels[0, 2] + 0.1 * (pixels[:, 2] - pixels[0, 2])
    return pixels


def jumping(pixels: np.ndarray) -> np.ndarray:
    pixels[25:, 3] += [20.0, -8.0]
    return pixels


FAULTS = {
    "exchanged": (exchanged, "the tracks tip_front and tip_top fit each other's places"),
    "stuck": (stuck, "the track tip_top hardly moves"),
    "jumps": (jumping, "the track middle_front jumps by 21.5 pixels at 0.25 s"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_lost_tracks_are_named(fault: str) -> None:
    change, words = FAULTS[fault]
    true = projected(filming("front"), motion_m())
    rng = np.random.default_rng(9)
    pixels = change(true + NOISE_PX * rng.normal(size=true.shape))
    experiment = swung([with_pixels(tracks_of(), pixels)])
    program = cs.Problem([experiment], parameters=unknown_young()).collocation()
    (residual,) = program.transcriptions[0].residuals_of(ImageTrackResidual)
    found = [*track_hypotheses(residual, true, "'front'")]
    assert [each.code for each in found] == [f"image-track/{fault}"]
    assert words in found[0].message


def test_good_tracks_are_not_doubted() -> None:
    tracks = tracks_of(rng=np.random.default_rng(10))
    program = cs.Problem([swung([tracks])], parameters=unknown_young()).collocation()
    (residual,) = program.transcriptions[0].residuals_of(ImageTrackResidual)
    true = projected(filming("front"), motion_m())
    assert [*track_hypotheses(residual, true, "'front'")] == []
