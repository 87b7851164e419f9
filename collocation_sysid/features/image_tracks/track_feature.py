"""Image tracks in checks and runs: likely errors of cameras and of single tracks, and notes.

Before a solve, the tracks are compared with the body carried rigidly by its grasp: with the stated
description, and with common mistakes corrected. After a fit, single tracks are compared with their
predictions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ...common.array_types import Array
from ...methods.solution import Solution
from ...program.collocation import ExperimentIterate
from ...recording.camera import Camera
from ...recording.experiment import Experiment
from ...recording.placement import LocatedBody
from ...statistics.misspecification.misspecification_hypothesis import Hypothesis
from ..feature import Feature
from .rays import points_on_surface
from .track_residual import ImageTrackResidual
from .tracks import ImageTracks, stated_places

# Images in which tracks are compared with the rigid body.
MOST_IMAGES = 12
# Distance [pixels] of a point that cannot be projected, and of a ray that meets no part of the body.
FAR_PX = 1e4
# Factor by which a correction must decrease the median distance.
NEARER = 3.0
# Share of the size of the body in the image below which distances are those of its deformation.
OF_DEFORMATION = 0.1
# Distance as a share of that size at which a camera does not show the body, whatever is corrected.
NOT_SHOWN = 0.5
# Sizes of images over those of the calibration that are tried.
SCALES = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 4 / 3, 1.5, 2.0, 3.0, 4.0)
# Frames of cameras in other programs, in columns, and the words for them.
FRAMES = {
    "x to the right, y up, z backwards (OpenGL, Blender)": np.diag([1.0, -1.0, -1.0]),
    "x forward, y to the left, z up (ROS body frame)": np.array(
        [[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    ),
}
# Standard deviations of residuals from which a track is suspicious, and the factor by which an
# exchange or a step must explain them.
SUSPICIOUS = 5.0
EXPLAINED = 3.0
# Range of a track over that of its prediction below which the tracker is stuck.
STUCK = 0.25
# Samples on each side of a jump.
FEWEST_BESIDE = 3
# Ratio of the errors of two poses of a camera below which the second is nearly as good.
SIMILAR_POSES = 2.0

MESSAGES = {
    "description/image-tracks": "the points appear {distance_px:.3g} pixels (median) from where the "
    "body is, which is {size_px:.3g} pixels large in the image: check camera.pose (x to the right, y "
    "down, z forward, in metres), the calibration and start_s",
    "description/image-tracks/likely": "the points are not where the body appears ({distance_px:.3g} "
    "pixels off, median), but {nearer:.2g} times nearer if {mistake}",
    "description/image-track/exchanged": "the tracks {first} and {second} fit each other's places: "
    "their names are exchanged",
    "description/image-track/stuck": "the track {point} hardly moves where the body moves "
    "{predicted_px:.3g} pixels: the tracker follows the background or is stuck; leave it out with "
    "points",
    "description/image-track/jumps": "the track {point} jumps by {jump_px:.3g} pixels at {t_s:.4g} s: "
    "the tracker has lost the point; delete the samples after it",
    "description/image-track/drifts": "the track {point} deviates by {sigmas:.2g} sigma_px (RMS), the "
    "others by {others:.2g}: the tracker has lost the point, or it is not on the body; leave it out "
    "with points",
}


# Before a solve -----------------------------------------------------------------------------------


def hypotheses(experiment: Experiment) -> Iterator[Hypothesis]:
    """Yield a hypothesis for each camera whose tracks are not where the body appears."""
    for tracks in experiment.readings:
        if isinstance(tracks, ImageTracks) and tracks.pixels is not None and tracks.has_known_pose:
            yield from _camera_hypotheses(experiment, tracks)


def _camera_hypotheses(experiment: Experiment, tracks: ImageTracks) -> Iterator[Hypothesis]:
    trial = _Trial(experiment, tracks)
    pixels = np.asarray(tracks.pixels)
    stated_px = trial.distance_px(tracks.camera, pixels)
    size_px = trial.size_px(tracks.camera)
    if stated_px <= OF_DEFORMATION * size_px:
        return
    of = f"'{tracks.name}' of '{experiment.name}'"
    tried = [
        (trial.distance_px(camera, other), mistake)
        for camera, other, mistake in _corrections(tracks.camera, pixels)
    ]
    best_px, mistake = min(tried)
    data = {"distance_px": stated_px, "size_px": size_px}
    if best_px * NEARER < stated_px:
        ratio = stated_px / max(best_px, 1.0)
        data |= {"mistake": mistake, "nearer": ratio}
        yield Hypothesis("image-tracks/likely", of, data=data, strength=ratio)
    elif stated_px > NOT_SHOWN * size_px:
        yield Hypothesis("image-tracks", of, data=data, strength=stated_px / size_px)


def _corrections(camera: Camera, pixels: Array) -> Iterator[tuple[Camera, Array, str]]:
    """Yield camera and pixels with one mistake corrected, and the mistake as a clause."""
    matrix = camera.require_matrix()
    width, height = camera.size_px or (2 * matrix[0, 2] + 1, 2 * matrix[1, 2] + 1)
    yield camera, pixels[..., ::-1], "u and v are exchanged (row, column): exchange the columns"
    upwards = np.stack([pixels[..., 0], height - 1 - pixels[..., 1]], axis=-1)
    yield camera, upwards, f"v points upwards: use {height - 1:g} - v"
    mirrored = np.stack([width - 1 - pixels[..., 0], pixels[..., 1]], axis=-1)
    yield camera, mirrored, f"u points to the left (a mirrored video): use {width - 1:g} - u"
    both = np.stack([width - 1 - pixels[..., 0], height - 1 - pixels[..., 1]], axis=-1)
    yield camera, both, "the video is turned by 180 degrees: turn it, or the pose"
    for scale in SCALES:
        other = pixels / scale
        yield (
            camera,
            other,
            f"the images have {scale:.3g} times the resolution of the calibration: multiply the "
            "first two rows of the matrix by this",
        )
    inverse = np.linalg.inv(camera.pose)
    yield (
        replace(camera, pose=inverse),
        pixels,
        "the pose is from the world to the camera: invert it",
    )
    for words, frame in FRAMES.items():
        pose = camera.pose.copy()
        pose[:3, :3] = pose[:3, :3] @ frame
        yield replace(camera, pose=pose), pixels, f"the pose is that of a frame with {words}"
    for factor, unit in ((1e-3, "millimetres"), (1e-2, "centimetres")):
        pose = camera.pose.copy()
        pose[:3, 3] *= factor
        yield (
            replace(camera, pose=pose),
            pixels,
            f"the position of the camera is in {unit}: state it in metres",
        )


class _Trial:
    """Comparison of the tracks of one camera with the body carried rigidly by its grasp."""

    def __init__(self, experiment: Experiment, tracks: ImageTracks) -> None:
        times = tracks.sample_times_s
        first_s, last_s = experiment.t_s[[0, -1]]
        within = np.flatnonzero((times >= first_s) & (times <= last_s) & tracks.is_seen.any(axis=1))
        count = min(MOST_IMAGES, len(within))
        self.samples = within[np.linspace(0, len(within) - 1, count).astype(int)]
        self.tracks = tracks
        self.body = experiment.body
        self.t_s = times[self.samples]
        self.shapes_m = experiment.rigid_positions(self.t_s)
        stated = stated_places(experiment)
        rest = LocatedBody(self.body.nodes_m, self.body)
        self.weights = {
            name: rest.weights_at_nearest_point(place) for name, (place, _) in stated.items()
        }

    def size_px(self, camera: Camera) -> float:
        """Return the size of the body in the first image [pixels]; `FAR_PX` if it is not there."""
        rotations, translations = camera.pose_at(self.t_s[:1])
        own = (self.shapes_m[0] - translations[0]) @ rotations[0]
        own = own[own[:, 2] > 0]
        if len(own) < 2:
            return FAR_PX
        return float(np.linalg.norm(np.ptp(camera.undistorted_pixels(own), axis=0)))

    def distance_px(self, camera: Camera, pixels: Array) -> float:
        """Return the median distance of the tracks from the rigid body [pixels]."""
        rotations, translations = camera.pose_at(self.t_s)
        seen = self.tracks.is_seen[self.samples]
        pixels = pixels[self.samples]
        focal_px = camera.require_matrix()[0, 0]
        distances = []
        for k, name in enumerate(self.tracks.names):
            if not seen[:, k].any():
                continue
            missed_px = 0.0
            if name in self.weights:
                nodes, weights = self.weights[name]
            else:
                first = int(seen[:, k].argmax())
                ray = _ray(camera, pixels[first, k])
                if ray is None:
                    distances.append(np.full(seen[:, k].sum(), FAR_PX))
                    continue
                faces, shares, missed = points_on_surface(
                    translations[[first]],
                    (rotations[first] @ ray)[None],
                    self.shapes_m[first],
                    self.body.mesh.surface,
                )
                nodes, weights = self.body.mesh.surface[faces[0]], shares[0]
                missed_px = focal_px * float(missed[0])
            points = np.einsum("c,sci->si", weights, self.shapes_m[:, nodes])
            own = np.einsum("sji,sj->si", rotations, points - translations)
            off = np.full(len(own), FAR_PX)
            front = own[:, 2] > 0
            if front.any():
                shown = camera.distorted_pixels(own[front])
                off[front] = np.linalg.norm(shown - pixels[front, k], axis=1)
            distances.append(np.minimum(off[seen[:, k]] + missed_px, FAR_PX))
        return float(np.median(np.concatenate(distances)))


def _ray(camera: Camera, pixel: Array) -> Array | None:
    """Return the direction of a pixel in the camera's frame; None where the lens has none."""
    try:
        return camera.points_at_unit_depth(pixel[None])[0]
    except ValueError:
        return None


# After a fit --------------------------------------------------------------------------------------


def fit_hypotheses(solution: Solution) -> Iterator[Hypothesis]:
    """Yield exchanged, stuck, jumping and lost tracks."""
    for part in solution.parts:
        name = part.transcription.experiment.name
        pairs = zip(part.transcription.residuals, part.observables, strict=True)
        for reading, values in pairs:
            if isinstance(reading, ImageTrackResidual):
                predicted = reading.predict(values, part.phi)[..., :2]
                of = f"'{reading.sensor.name}' of '{name}'"
                yield from track_hypotheses(reading, predicted, of)


def track_hypotheses(
    reading: ImageTrackResidual, predicted: Array, of: str
) -> Iterator[Hypothesis]:
    """Yield hypotheses about the tracks of one camera.

    Parameters
    ----------
    reading : ImageTrackResidual
    predicted : (s, N, 2) array
        Predicted pixels of the first s images.
    of : str
        Camera and experiment, for messages.
    """
    sigma = reading.sensor.sigma_px
    names = reading.sensor.names
    compared = np.asarray(reading.is_compared[: len(predicted), :, :2].all(axis=2))
    measured = np.where(compared[..., None], reading.measured[: len(predicted), :, :2], np.nan)
    used = np.flatnonzero(compared.any(axis=0)).tolist()
    off = (measured - predicted) / sigma
    rms = {k: float(np.sqrt(np.nanmean(off[:, k] ** 2))) for k in used}
    exchanged: set[int] = set()
    for i in used:
        for j in (k for k in used if k > i):
            own = np.hypot(rms[i], rms[j])
            if own < SUSPICIOUS or {i, j} & exchanged:
                continue
            crossed = (measured[:, [j, i]] - predicted[:, [i, j]]) / sigma
            known = np.asarray(np.isfinite(crossed).all(axis=(1, 2)))
            if not known.any():
                continue
            other = float(np.sqrt(2 * np.mean(crossed[known] ** 2)))
            if other * EXPLAINED < own:
                exchanged |= {i, j}
                data = {"first": names[i], "second": names[j]}
                yield Hypothesis("image-track/exchanged", of, data=data, strength=own / other)
    usual = float(np.median([*rms.values()])) if rms else 0.0
    for k in used:
        if k in exchanged or rms[k] < SUSPICIOUS or rms[k] < EXPLAINED * usual:
            continue
        yield _track_hypothesis(reading, k, measured[:, k], predicted[:, k], of, rms[k], usual)


def _track_hypothesis(
    reading: ImageTrackResidual,
    k: int,
    measured: Array,
    predicted: Array,
    of: str,
    rms: float,
    usual: float,
) -> Hypothesis:
    """Return what is wrong with a track that deviates."""
    name = reading.sensor.names[k]
    known = np.flatnonzero(np.isfinite(measured).all(axis=1))
    strength = rms / max(usual, 1.0)
    ranges = [float(np.linalg.norm(np.ptp(v[known], axis=0))) for v in (measured, predicted)]
    if ranges[0] < STUCK * ranges[1]:
        data = {"point": name, "predicted_px": ranges[1]}
        return Hypothesis("image-track/stuck", of, data=data, strength=strength)
    off = (measured - predicted)[known]
    best, at, jump = np.inf, 0, np.zeros(2)
    for cut in range(FEWEST_BESIDE, len(off) - FEWEST_BESIDE + 1):
        means = off[:cut].mean(axis=0), off[cut:].mean(axis=0)
        rest = np.sum((off[:cut] - means[0]) ** 2) + np.sum((off[cut:] - means[1]) ** 2)
        if rest < best:
            best, at, jump = rest, cut, means[1] - means[0]
    if best * EXPLAINED**2 < np.sum((off - off.mean(axis=0)) ** 2):
        t_s = float(reading.t_s[known[at]])
        data = {"point": name, "jump_px": float(np.linalg.norm(jump)), "t_s": t_s}
        return Hypothesis("image-track/jumps", of, data=data, strength=strength)
    data = {"point": name, "sigmas": rms, "others": usual}
    return Hypothesis("image-track/drifts", of, data=data, strength=strength)


def notes(part: ExperimentIterate) -> Iterator[str]:
    """Yield a note for each camera: how many pixels are compared, and what is left out."""
    experiment = part.transcription.experiment
    pairs = zip(part.transcription.residuals, part.observables, strict=True)
    for reading, values in pairs:
        if not isinstance(reading, ImageTrackResidual):
            continue
        places, tracks = reading.correspondences, reading.sensor
        off = (reading.predict(values, part.phi) - reading.measured[: len(values)])[..., :2]
        compared = reading.is_compared[: len(off), :, :2]
        known = compared.all(axis=2)
        rms = float(np.sqrt(np.mean(off[compared] ** 2))) if compared.any() else np.nan
        left = []
        if not places.is_placed.all():
            absent = [n for n, on in zip(tracks.names, places.is_placed, strict=True) if not on]
            left.append(f"{', '.join(absent)} (their rays do not meet the body)")
        hidden = tracks.is_seen & places.is_placed & ~places.is_visible
        if hidden.any():
            left.append(f"{hidden.sum()} samples of points that the body hides")
        yield (
            f"experiment '{experiment.name}': {known.sum()} samples of {known.any(axis=0).sum()} "
            f"points of '{tracks.name}' deviate by {rms:.3g} pixels (RMS of a coordinate); left out: "
            f"{'; '.join(left) or 'none'}"
        )
        if places.mirror_ratio < SIMILAR_POSES:
            yield (
                f"the pose of '{tracks.name}' was found from points that a mirrored pose explains "
                f"nearly as well (error {places.mirror_ratio:.2g} times as large): state the places "
                "of points that are not in a plane, or the pose"
            )


IMAGE_TRACKS = Feature(
    messages=MESSAGES, hypotheses=hypotheses, fit_hypotheses=fit_hypotheses, notes=notes
)
