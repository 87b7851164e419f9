"""What a check and a fit say about image tracks that are described wrongly or lost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from kit.depth import looking
from kit.filmed import (
    NAMES,
    NOISE_PX,
    PLACES_M,
    SIZE_PX,
    T_S,
    bar,
    filming,
    motion_m,
    projected,
    swung,
    tracks_of,
    unknown_young,
)

import collocation_sysid as cs
from collocation_sysid.kinds.image_tracks.doubts import track_hypotheses
from collocation_sysid.kinds.image_tracks.notes import notes
from collocation_sysid.kinds.image_tracks.places import find_places
from collocation_sysid.kinds.image_tracks.residual import ImageTrackResidual
from collocation_sysid.kinds.image_tracks.stated_cameras import hypotheses

TEMPLATE = Path(cs.__file__).parent / "problem/templates/video/problem.toml"
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


def transposed(tracks: cs.ImageTracks) -> cs.ImageTracks:
    pose = np.array(tracks.camera.pose)
    pose[:3, :3] = pose[:3, :3].T
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
    "turned clockwise": (
        lambda t: with_pixels(t, pixels_of(t)[..., ::-1] * [-1, 1] + [SIZE_PX[1] - 1, 0]),
        "turned by 90 degrees clockwise",
    ),
    "shares of the image": (
        lambda t: with_pixels(t, pixels_of(t) / SIZE_PX),
        "shares of the image",
    ),
    "over the focal length": (
        lambda t: with_pixels(t, (pixels_of(t) - [640, 360]) / [900, 905]),
        "divided by the focal length",
    ),
    "cropped": (lambda t: with_pixels(t, pixels_of(t) - [300, 100]), "is cropped"),
    "rotation transposed": (transposed, "its rotation is transposed"),
}


# The rays of a mirrored image of a symmetric body meet the body, so that only places contradict it.
@pytest.mark.parametrize(
    ("mistake", "known"),
    [*((m, True) for m in MISTAKES), ("v upwards", False), ("pose inverted", False)],
)
def test_wrong_descriptions_of_a_camera_are_named(mistake: str, known: bool) -> None:
    change, words = MISTAKES[mistake]
    found = [*hypotheses(swung([change(tracks_of(known=known))]))]
    assert len(found) == 1
    assert words in found[0].message


@pytest.mark.parametrize(
    ("camera", "known"), [("front", True), ("side", True), ("top", True), ("front", False)]
)
def test_a_right_description_is_not_doubted(camera: str, known: bool) -> None:
    assert [*hypotheses(swung([tracks_of(camera, known=known)]))] == []


TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
MOVED: dict[str, tuple[Change, str]] = {
    "late": (lambda t: replace(t, t_s=T_S[:-8] + 0.08, pixels=pixels_of(t)[:-8]), "80 ms earlier"),
    "slow": (lambda t: replace(t, t_s=2 * T_S[:21], pixels=pixels_of(t)[:21]), "rate is 2 times"),
    "v upwards": MISTAKES["v upwards"],
    "y up": (
        lambda t: replace(t, camera=filming("front", pose=TO_Y_UP @ t.camera.pose)),
        "y axis points upwards",
    ),
}


@pytest.mark.parametrize("mistake", MOVED)
def test_points_near_the_grasp_move_with_the_grasp(mistake: str) -> None:
    places = {"one": (0.02, 0.0, 0.005), "two": (0.03, 0.0, 0.015)}
    at_m = np.array(list(places.values()))
    poses = np.tile(np.eye(4), (len(T_S), 1, 1))
    poses[:, 0, 3] = 0.012 * np.sin(12 * T_S)
    poses[:, 2, 3] = 0.02 * np.sin(17 * T_S)
    held = cs.Grasp(np.flatnonzero(bar().nodes_m[:, 0] < 1e-9), poses)

    def swaying(tracks: cs.ImageTracks) -> cs.Experiment:
        return cs.Experiment(bar(), T_S, [held], readings=[tracks])

    blank = cs.ImageTracks("front", filming("front"), T_S, np.ones((len(T_S), 1, 2)), ["one"])
    rotations, translations = swaying(blank).rigid_motion(T_S)
    points = np.einsum("sij,pj->spi", rotations, at_m) + translations[:, None]
    # A camera that sees the bar in the middle of its image.
    pose = looking(np.array([0.03, -0.45, 0.02]), np.array([0.03, 0.0, 0.012]))
    camera = filming("front", pose=pose)
    pixels = projected(camera, points)
    right = cs.ImageTracks("front", camera, T_S, pixels, [*places], sigma_px=0.3)
    assert [*hypotheses(swaying(right))] == []
    lost = pixels.copy()
    lost[:, 1] = lost[0, 1]
    assert [*hypotheses(swaying(replace(right, pixels=lost)))] == []
    change, words = MOVED[mistake]
    (found,) = hypotheses(swaying(change(right)))
    assert words in found.message


@cache
def video_template() -> cs.Experiment:
    """The swung bar of the template, filmed by one camera."""
    return cs.Problem.read(TEMPLATE).experiments[0]


def test_a_video_of_half_the_stated_rate_is_named_in_the_template() -> None:
    experiment = video_template()
    (tracks,) = (each for each in experiment.readings if isinstance(each, cs.ImageTracks))
    assert [*hypotheses(experiment)] == []
    every_second = pixels_of(tracks)[::2].reshape(-1, 2 * len(tracks.names))
    half = tracks.with_samples(tracks.t_s[: len(every_second)], every_second)
    (found,) = hypotheses(replace(experiment, readings=[half]))
    assert "their rate is 0.5 times the stated one" in found.message


def test_a_wrong_rate_is_named_where_four_points_far_from_the_grasp_determine_the_pose() -> None:
    experiment = video_template()
    (tracks,) = (each for each in experiment.readings if isinstance(each, cs.ImageTracks))
    rigid = experiment.rigid_positions
    found_m = find_places(experiment, lambda t_s: rigid(np.clip(t_s, *experiment.t_s[[0, -1]])))[2]
    places_m = np.array([found_m[name] for name in tracks.names])
    places_m[np.argsort(places_m[:, 2])[4:]] = np.nan
    free = replace(tracks, places_m=places_m, has_known_pose=False)
    assert [*hypotheses(replace(experiment, readings=[free]))] == []
    slow_s = 1.2 * tracks.t_s
    kept = slow_s <= experiment.t_s[-1]
    slow = free.with_samples(slow_s[kept], pixels_of(tracks)[kept].reshape(kept.sum(), -1))
    (found,) = hypotheses(replace(experiment, readings=[slow]))
    assert "their rate is 1.2 times the stated one" in found.message


def test_places_on_sides_that_the_camera_does_not_see_are_named() -> None:
    behind = np.array([(x, 0.03, 0.01) for x in np.linspace(0.02, 0.1, len(PLACES_M))])
    (found,) = hypotheses(swung([tracks_of(places_m=behind)]))
    assert "7 of 7 points with places_m are on sides" in found.message


def test_places_far_from_the_body_are_refused() -> None:
    tracks = tracks_of(places_m=1e3 * np.array(list(PLACES_M.values())))
    with pytest.raises(cs.InputError, match=r"the place of 'tip_front' is 11.* expected places_m"):
        cs.Problem([swung([tracks])], parameters=unknown_young()).collocation()


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


@pytest.mark.parametrize("change", [exchanged, stuck])
def test_lost_tracks_are_named(change: Callable[[np.ndarray], np.ndarray]) -> None:
    true = projected(filming("front"), motion_m())
    rng = np.random.default_rng(9)
    pixels = change(true + NOISE_PX * rng.normal(size=true.shape))
    experiment = swung([with_pixels(tracks_of(), pixels)])
    program = cs.Problem([experiment], parameters=unknown_young()).collocation()
    (residual,) = program.transcriptions[0].residuals_of(ImageTrackResidual)
    found = [*track_hypotheses(residual, true, "'front'")]
    assert {each.code for each in found} == {"image-track"}
    assert "tip_top" in {each.data["point"] for each in found}


def test_no_track_is_named_where_the_others_are_not_explained() -> None:
    true = projected(filming("front"), motion_m())
    pixels = stuck(true + np.array([20 * NOISE_PX, 0.0]))
    pixels[:, 2, 1] += 100 * NOISE_PX
    experiment = swung([with_pixels(tracks_of(), pixels)])
    program = cs.Problem([experiment], parameters=unknown_young()).collocation()
    (residual,) = program.transcriptions[0].residuals_of(ImageTrackResidual)
    assert [*track_hypotheses(residual, true, "'front'")] == []


def test_samples_after_a_jump_are_left_out() -> None:
    tracks = tracks_of(rng=np.random.default_rng(9))
    pixels = pixels_of(tracks).copy()
    pixels[25:, 3] += [20.0, -8.0]
    experiment = swung([with_pixels(tracks, pixels)])
    program = cs.Problem([experiment], parameters=unknown_young()).collocation()
    (residual,) = program.transcriptions[0].residuals_of(ImageTrackResidual)
    assert not residual.is_compared[25:, 3].any()
    assert residual.is_compared[:25, 3, :2].all()
    rigid_m = experiment.rigid_positions(residual.observable_s)
    x = rigid_m.reshape(len(rigid_m), -1)
    (note,) = notes(program.iterates_at(program.guess_p, [x])[0])
    assert f"{len(T_S) - 25} samples of {NAMES[3]} in which the tracker has lost the point" in note


def test_good_tracks_are_not_doubted() -> None:
    tracks = tracks_of(rng=np.random.default_rng(10))
    program = cs.Problem([swung([tracks])], parameters=unknown_young()).collocation()
    (residual,) = program.transcriptions[0].residuals_of(ImageTrackResidual)
    true = projected(filming("front"), motion_m())
    assert [*track_hypotheses(residual, true, "'front'")] == []


@pytest.mark.parametrize("known", [True, False])
def test_images_in_reverse_order_are_named_where_a_delay_of_half_a_period_is_as_near(
    known: bool,
) -> None:
    experiment = swinging()
    tracks = carried_tracks(experiment)
    tracks = replace(tracks, places_m=tracks.places_m if known else None)
    assert not [*hypotheses(replace(experiment, readings=[tracks]))]
    backwards = with_pixels(tracks, pixels_of(tracks)[::-1])
    (found,) = hypotheses(replace(experiment, readings=[backwards]))
    assert str(found.data["mistake"]).startswith("the images are in reverse order")


def swinging() -> cs.Experiment:
    """The bar, whose held end moves to and fro."""
    experiment = swung()
    poses = np.tile(np.eye(4), (len(T_S), 1, 1))
    poses[:, 2, 3] = 0.05 * np.sin(2 * np.pi * 5 * T_S) * np.clip(T_S / 0.05, 0, 1)
    held = replace(experiment.grasps[0], poses=cs.PoseSequence.from_matrices(T_S, poses))
    return replace(experiment, grasps=[held])


def carried_tracks(experiment: cs.Experiment) -> cs.ImageTracks:
    """Tracks of a rigid body in its grasp."""
    points = experiment.markers.predict_positions(experiment.rigid_positions(T_S))
    rng = np.random.default_rng(2)
    pixels = projected(filming("front"), points)
    return with_pixels(tracks_of("front"), pixels + NOISE_PX * rng.normal(size=pixels.shape))


@pytest.mark.parametrize("wrong", ["u points to the left", "u and v are exchanged", ""])
def test_tracks_of_a_camera_with_an_unknown_pose_are_checked(wrong: str) -> None:
    tracks = tracks_of("front", np.random.default_rng(2), has_known_pose=False)
    changes: dict[str, Change] = {
        "u points to the left": MISTAKES["mirrored"][0],
        "u and v are exchanged": MISTAKES["row and column"][0],
        "": lambda t: t,
    }
    found = [*hypotheses(swung([changes[wrong](tracks)]))]
    if not wrong:
        assert not found
        return
    (named,) = found
    # Images mirrored about any axis differ by a rotation, which the pose takes up.
    mirrored = ("u points", "v points", "u and v are")
    assert any(f"but sees them if {text}" in str(named.data["remedy"]) for text in mirrored)
