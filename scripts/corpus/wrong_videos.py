"""Errors in the description of ordinary cameras and of the tracks of points in their images.

Each entry of `VIDEO_FAULTS` takes an experiment with image tracks and returns it with one error in
its description. `PAIR_FAULTS` need two cameras, `PLACE_FAULTS` points with known places.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from wrong_cameras import OPENGL, with_axes_of_robot, with_inverse_pose, with_transposed_rotation
from wrong_twins import ExperimentChange, Fault, Rng

from collocation_sysid.common.array_types import Array
from collocation_sysid.kinds.image_tracks.tracks import ImageTracks
from collocation_sysid.recording import Experiment
from collocation_sysid.recording.camera import Camera

Change = Callable[[ImageTracks], ImageTracks]
# Columns and rows of the images.
WIDTH, HEIGHT = 1280, 720
# World of a calibration board: turned about the vertical axis and shifted by its corner [m].
BOARD_TURN_DEG = 40.0
BOARD_M = (0.20, -0.10, 0.05)
# Lines of a rolling shutter [s].
LINE_S = 3e-5


def tracks(change: Change) -> ExperimentChange:
    """Return the change of the tracks of every camera."""

    def changed(experiment: Experiment, rng: Rng) -> Experiment:
        readings = [
            change(each) if isinstance(each, ImageTracks) else each for each in experiment.readings
        ]
        return replace(experiment, readings=readings)

    return changed


def pixels(change: Callable[[Array], Array]) -> ExperimentChange:
    """Return the change of the pixels (S, N, 2) of every camera."""
    return tracks(lambda each: replace(each, pixels=change(np.array(each.pixels))))


def cameras(change: Callable[[Camera], Camera]) -> ExperimentChange:
    """Return the change of every camera."""
    return tracks(lambda each: replace(each, camera=change(each.camera)))


def poses(change: Callable[[Array], Array]) -> ExperimentChange:
    """Return the change of the stated pose (4, 4) of every camera."""
    return cameras(lambda camera: replace(camera, pose=change(np.array(camera.pose))))


def matrices(change: Callable[[Array], Array]) -> ExperimentChange:
    """Return the change of the matrix (3, 3) of every camera."""
    return cameras(lambda camera: replace(camera, matrix=change(np.array(camera.matrix))))


def times(change: Callable[[Array], Array]) -> ExperimentChange:
    """Return the change of the times (S,) of every camera; images after the end are left out."""

    def changed(experiment: Experiment, rng: Rng) -> Experiment:
        def one(each: ImageTracks) -> ImageTracks:
            t_s = change(np.array(each.t_s))
            kept = (t_s >= experiment.t_s[0] - 1e-9) & (t_s <= experiment.t_s[-1] + 1e-9)
            return replace(each, t_s=t_s[kept], pixels=np.asarray(each.pixels)[kept])

        return tracks(one)(experiment, rng)

    return changed


def undistorted(each: ImageTracks) -> ImageTracks:
    """Return tracks in images that were undistorted, with the distortion still stated."""
    flat = np.asarray(each.pixels).reshape(-1, 2)
    rays = each.camera.points_at_unit_depth(flat)
    shown = each.camera.undistorted_pixels(rays)
    return replace(each, pixels=shown.reshape(np.asarray(each.pixels).shape))


def normalised(each: ImageTracks) -> ImageTracks:
    """Return tracks divided by the focal length, about the principal point."""
    matrix = each.camera.require_matrix()
    values = (np.asarray(each.pixels) - matrix[:2, 2]) / np.diag(matrix)[:2]
    return replace(each, pixels=values)


def with_distortion(*coefficients: float, model: str = "pinhole") -> ExperimentChange:
    """Return the change of the distortion."""
    return cameras(lambda camera: replace(camera, distortion=coefficients, model=model))


def reordered_distortion(camera: Camera) -> Camera:
    """Return the camera with its coefficients in the order k1, k2, k3, p1, p2."""
    return replace(camera, distortion=camera.distortion[[0, 1, 4, 2, 3]])


def with_focal_lengths_times(factor: float) -> Callable[[Array], Array]:
    """Return the change of both focal lengths, as of another lens or a zoom."""
    return lambda matrix: matrix * np.array([[factor, 1, 1], [1, factor, 1], [1, 1, 1]])


def with_exchanged_centre(matrix: Array) -> Array:
    """Return the matrix with cx and cy exchanged."""
    matrix[[0, 1], 2] = matrix[[1, 0], 2]
    return matrix


def translation_of_world(pose: Array) -> Array:
    """Return the pose with the translation of its inverse, as of an extrinsic matrix of which only
    the rotation was inverted.
    """
    pose[:3, 3] = np.linalg.inv(pose)[:3, 3]
    return pose


def in_board(pose: Array) -> Array:
    """Return the pose in the frame of a calibration board."""
    board = np.eye(4)
    board[:3, :3] = Rotation.from_euler("z", BOARD_TURN_DEG, degrees=True).as_matrix()
    board[:3, 3] = BOARD_M
    return np.linalg.inv(board) @ pose


def bumped(pose: Array) -> Array:
    """Return the pose of a camera that was turned by 10 degrees about its vertical axis."""
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("y", 10, degrees=True).as_matrix()
    return pose


def with_y_up(pose: Array) -> Array:
    """Return the pose in a world whose y axis points upwards."""
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    return turn @ pose


def moved_by_times(factor: float) -> Callable[[Array], Array]:
    """Return the change of the unit of the position of a pose."""

    def change(pose: Array) -> Array:
        pose[:3, 3] *= factor
        return pose

    return change


def exchanged(values: Array) -> Array:
    """Return the pixels with two names exchanged from half of the images on."""
    half = len(values) // 2
    values[half:, [0, 7]] = values[half:, [7, 0]]
    return values


def stuck(values: Array) -> Array:
    """Return the pixels with one track that stays where it began."""
    values[:, 6] = values[:1, 6]
    return values


def jumping(values: Array) -> Array:
    """Return the pixels with one track that moves to a neighbouring corner."""
    values[len(values) // 2 :, 4] += [25.0, -12.0]
    return values


def on_background(values: Array) -> Array:
    """Return the pixels with one track of the wall beside the body."""
    values[:, 3] = [150.0, 80.0] + 0.3 * np.sin(np.arange(len(values)))[:, None]
    return values


def on_gripper(values: Array) -> Array:
    """Return the pixels with one track that follows another part of the body half as far: a
    reflection or a shadow.
    """
    values[:, 8] = values[0, 8] + 0.5 * (values[:, 8] - values[0, 8])
    return values


def drifting(values: Array) -> Array:
    """Return the pixels with tracks that drift by up to 12 pixels, as those of a tracker without
    alignment with the first image.
    """
    share = np.linspace(0, 1, len(values))[:, None]
    rate = np.array([12.0, -9.0, 7.0, -12.0, 10.0, -6.0, 8.0, -11.0, 9.0, -7.0])[: values.shape[1]]
    values[..., 0] += share * rate
    return values


def of_another_scene(values: Array) -> Array:
    """Return the pixels of tracks in another video."""
    return np.random.default_rng(8).uniform(0, 300, values.shape)


def rolling(each: ImageTracks) -> ImageTracks:
    """Return tracks of a rolling shutter whose line delay is not stated."""
    values = np.array(each.pixels)
    slopes = np.gradient(values, np.asarray(each.t_s), axis=0)
    return replace(each, pixels=values + LINE_S * values[..., 1:] * slopes)


def places(change: Callable[[Array], Array]) -> ExperimentChange:
    """Return the change of the known places (N, 3)."""
    return tracks(lambda each: replace(each, places_m=change(np.array(each.places_m))))


def exchanged_cameras(experiment: Experiment, rng: Rng) -> Experiment:
    """Return the experiment with the files of two cameras exchanged."""
    first, second = experiment.readings
    assert isinstance(first, ImageTracks)
    assert isinstance(second, ImageTracks)
    swapped = [
        replace(first, pixels=second.pixels, names=second.names, places_m=second.places_m),
        replace(second, pixels=first.pixels, names=first.names, places_m=first.places_m),
    ]
    return replace(experiment, readings=swapped)


def one_camera_late(experiment: Experiment, rng: Rng) -> Experiment:
    """Return the experiment with the second camera started 0.1 s later."""
    first, second = experiment.readings
    late = times(lambda t_s: t_s + 0.1)(replace(experiment, readings=[second]), rng)
    return replace(experiment, readings=[first, *late.readings])


NAMED = ("image-tracks",)
VIDEO_FAULTS = {
    "video: (row, column) as (u, v)": Fault(pixels(lambda p: p[..., ::-1]), NAMED),
    "video: v upwards": Fault(pixels(lambda p: p * [1, -1] + [0, HEIGHT - 1]), NAMED),
    "video: mirrored": Fault(pixels(lambda p: p * [-1, 1] + [WIDTH - 1, 0]), NAMED),
    "video: turned by 180 deg": Fault(pixels(lambda p: [WIDTH - 1, HEIGHT - 1] - p), NAMED),
    "video: turned by 90 deg": Fault(
        pixels(lambda p: np.stack([HEIGHT - 1 - p[..., 1], p[..., 0]], -1)), NAMED
    ),
    "video: half the resolution": Fault(pixels(lambda p: p / 2), NAMED),
    "video: twice the resolution": Fault(pixels(lambda p: p * 2), NAMED),
    "video: cropped by (300, 100)": Fault(pixels(lambda p: p - [300, 100]), NAMED),
    "video: pixels as shares of the image": Fault(pixels(lambda p: p / [WIDTH, HEIGHT]), NAMED),
    "video: pixels over the focal length": Fault(tracks(normalised), NAMED),
    "video: undistorted, distortion stated": Fault(tracks(undistorted), NAMED),
    "video: distorted, no distortion stated": Fault(with_distortion(), NAMED),
    "video: coefficients k1, k2, k3, p1, p2": Fault(cameras(reordered_distortion), ()),
    "video: sign of the distortion": Fault(
        cameras(lambda c: replace(c, distortion=-c.distortion)), NAMED
    ),
    "video: coefficients as those of a fisheye": Fault(
        with_distortion(-0.28, 0.09, 1e-3, -5e-4, model="fisheye"), NAMED
    ),
    "video: focal length 1.5 times (other lens)": Fault(
        matrices(with_focal_lengths_times(1.5)), NAMED
    ),
    "video: focal length 0.9 times (stabilised)": Fault(
        matrices(with_focal_lengths_times(0.9)), NAMED
    ),
    "video: cx and cy exchanged": Fault(matrices(with_exchanged_centre), NAMED),
    "video: pose inverted": Fault(poses(with_inverse_pose), NAMED),
    "video: pose of an OpenGL frame": Fault(poses(lambda pose: pose @ OPENGL), NAMED),
    "video: pose of a frame with x forward": Fault(poses(with_axes_of_robot), NAMED),
    "video: rotation transposed": Fault(poses(with_transposed_rotation), NAMED),
    "video: translation not inverted": Fault(poses(translation_of_world), NAMED),
    "video: position in mm": Fault(poses(moved_by_times(1e3)), NAMED),
    "video: position in cm": Fault(poses(moved_by_times(1e2)), NAMED),
    "video: pose in the frame of the board": Fault(poses(in_board), NAMED),
    "video: world with y up": Fault(poses(with_y_up), NAMED),
    "video: camera turned by 10 deg": Fault(poses(bumped), NAMED),
    "video: 0.1 s late": Fault(times(lambda t_s: t_s + 0.1), NAMED),
    "video: 0.02 s late": Fault(times(lambda t_s: t_s + 0.02), ()),
    "video: 25 Hz stated for 50 Hz": Fault(times(lambda t_s: 2 * t_s), NAMED),
    "video: 60 Hz stated for 50 Hz": Fault(times(lambda t_s: t_s / 1.2), NAMED),
    "video: images in reverse order": Fault(pixels(lambda p: p[::-1]), NAMED),
    "video: rolling shutter of 22 ms": Fault(tracks(rolling), ()),
    "video: two names exchanged halfway": Fault(pixels(exchanged), ("image-track",)),
    "video: one track stuck": Fault(pixels(stuck), ("image-track",)),
    "video: one track jumps": Fault(pixels(jumping), ("image-track",)),
    "video: one track on the wall": Fault(pixels(on_background), ("image-track",)),
    "video: one track of a reflection": Fault(pixels(on_gripper), ("image-track",)),
    "video: all tracks drift": Fault(pixels(drifting), ("image-track",)),
    "video: tracks of another scene": Fault(pixels(of_another_scene), NAMED),
    "video: sigma_px a tenth": Fault(tracks(lambda t: replace(t, sigma_px=0.1 * t.sigma_px)), ()),
}
PLACE_FAULTS = {
    "video: places in mm": Fault(places(lambda p: 1e3 * p), ()),
    "video: places with y and z exchanged": Fault(places(lambda p: p[:, [0, 2, 1]]), NAMED),
    "video: places from the other end": Fault(
        places(lambda p: [0.12, 0, 0] + p * [-1, 1, 1]), NAMED
    ),
    "video: places shifted by 10 mm": Fault(places(lambda p: np.array([0.01, 0, 0]) + p), ()),
}
PAIR_FAULTS = {
    "video: files of two cameras exchanged": Fault(exchanged_cameras, NAMED),
    "video: second camera 0.1 s late": Fault(one_camera_late, NAMED),
}
