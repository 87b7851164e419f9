"""Keys of [[experiment.image_tracks]], and how the files of tracks and cameras are read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from pydantic import Field

from ...common.array_types import Array
from ...common.schema_tables import Declared, Section, Unit, Vector, declared_in
from ...common.validated_types import Finite, NotNegative, Positive, Text
from ...errors import InputError, located
from ...problem.measurement_section import MeasurementSection, RecordingFolder, existing_file
from ...recording import read_poses
from ...recording.camera import Camera, ImageSize, PoseMatrix
from ...recording.sources.calibration_files import read_calibration
from ...recording.sources.units import METRES_PER_UNIT
from ...recording.time_tables import is_within_experiment
from .files import TrackFile, read_tracks
from .tracks import ImageTracks, PoseSigma

# Share of the pixels that may be outside of the image.
MOST_OUTSIDE = 0.02
# Likelihood below which a sample is missing.
LEAST_LIKELIHOOD = 0.6


class ImageCameraSection(Section, of=Camera):
    """A camera: its calibration and its pose.

    Attributes
    ----------
    file : str, optional
        Calibration of OpenCV, ROS, Kalibr, Anipose, COLMAP, camodocal or MATLAB; keys of the table
        replace what it states.
    name : str, optional
        Name or number of the camera in a file of several.
    length_unit : {"m", "cm", "mm", "in"}
        Unit of length of the poses in the file.
    pose : (4, 4) array, "file" or "unknown"
        Transform from the frame of the camera to the world or, with `poses`, to the frame whose
        poses these are; "file" for that of the calibration, and "unknown" for a pose that is found
        from the body at rest.
    poses : str, optional
        File of poses of what carries the camera; by default the camera is at rest.
    """

    file: Text | None = None
    name: Text | None = None
    length_unit: Unit = "m"
    matrix: Declared
    distortion: Declared
    model: Declared
    size_px: Declared
    pose: PoseMatrix | Literal["file", "unknown"]
    poses: Text | None = None

    def read(self, folder: RecordingFolder, where: str) -> Camera:
        """Return the camera of the table, completed by the calibration file."""
        arguments: dict[str, Any] = {}
        if self.file is not None:
            file = existing_file(folder.path, self.file, key=f"{where}.file")
            with located(where=f"{where}.file"):
                read = read_calibration(file, self.name)
            if read.unread:
                keys = ", ".join(read.unread)
                folder.add_note(f"{self.file}: these keys are not understood: {keys}")
            names = ("matrix", "distortion", "model", "size_px", "pose")
            arguments = {name: getattr(read, name) for name in names}
            if arguments["pose"] is not None:
                arguments["pose"][:3, 3] *= METRES_PER_UNIT[self.length_unit]
        stated = self.model_fields_set & {"matrix", "distortion", "model", "size_px"}
        arguments |= {name: getattr(self, name) for name in stated}
        if arguments.get("matrix") is None:
            raise InputError(
                "missing; expected the matrix of the camera, or a calibration file",
                where=f"{where}.matrix",
            )
        if self.pose == "file" and arguments.get("pose") is None:
            raise InputError(
                f'found "file", but {self.file or "no file"} states no pose; expected the pose '
                'as a matrix, or "unknown"',
                where=f"{where}.pose",
            )
        if self.pose != "file":
            arguments["pose"] = None if self.pose == "unknown" else self.pose
        if self.poses is not None:
            poses = existing_file(folder.path, self.poses, key=f"{where}.poses")
            arguments["poses"] = read_poses(poses)
        with located(where=where):
            return Camera(**arguments)


class PoseSigmaSection(Section, of=PoseSigma):  # noqa: D101 (that of the class)
    pass


class ImageTracksSection(MeasurementSection, of=ImageTracks):
    """Tracks of points of the body in the images of an ordinary camera.

    Attributes
    ----------
    name : str
        Name of the camera in messages, error bars and files.
    file : str, optional
        Pixels: a table with `t_s` and the columns `NAME_u`, `NAME_v`, `NAME_likelihood` of each
        point, a long table, DeepLabCut .csv or .h5, SLEAP .h5 or .slp, CoTracker or TAPIR .npz. A
        simulation writes the file.
    camera : ImageCameraSection
        Calibration and pose of the camera.
    points : list of str, optional
        Points of the file that are used; all by default.
    places_m : mapping of str to list
        Places [x, y, z] on the undeformed body by the names of points; others are found from their
        first image and estimated.
    s_m : mapping of str to float
        On a rod, arc lengths of points on the centreline instead, from the beginning of the rod.
    frame_rate_hz : float, optional
        Images per second, for files without times.
    start_s : float
        Time of the image number 0 of files without times; added to the times of other files.
    least_likelihood : float
        Confidence of the tracker below which a pixel is missing.
    size_px : list of int, optional
        Columns and rows of the images of the tracks, which are compared with the calibration.
    pose_sigma : PoseSigmaSection
        Uncertainty of the stated pose.
    """

    file: Text | None = None
    camera: ImageCameraSection
    points: list[Text] | None = None
    places_m: dict[str, Vector] = Field(default_factory=dict)
    s_m: dict[str, NotNegative] = Field(default_factory=dict)
    sigma_px: Declared
    least_likelihood: NotNegative = LEAST_LIKELIHOOD
    frame_rate_hz: Positive | None = None
    start_s: Finite = 0.0
    size_px: ImageSize | None = None
    pose_sigma: PoseSigmaSection = Field(
        default_factory=lambda: PoseSigmaSection.model_construct(**vars(PoseSigma()))
    )

    def read_times_s(self, folder: RecordingFolder, where: str) -> Array:
        if not folder.must_read(self.file):
            return np.zeros(0)
        return self._read_file(folder, where)[1]

    def read(self, folder: RecordingFolder, where: str, t_s: Array) -> ImageTracks:
        camera = self.camera.read(folder, f"{where}.camera")
        arguments: dict[str, Any] = {
            "name": self.name,
            "has_known_pose": self.camera.pose != "unknown",
            "pose_sigma": PoseSigma(**self.pose_sigma.model_dump()),
            **declared_in(self, where=where),
        }
        stated_m = {**folder.places_on_rod(self.s_m, f"{where}.s_m"), **self.places_m}
        if not folder.must_read(self.file):
            names = self.points or [*stated_m]
            missing = [name for name in names if name not in stated_m]
            if missing or not names:
                raise InputError(
                    f"found no place of {missing[0] if missing else 'any point'}; expected the "
                    "place on the undeformed body of each point that is simulated",
                    where=f"{where}.places_m",
                )
            return self._tracks(camera, names, t_s, None, where, arguments, stated_m)
        content, at_s = self._read_file(folder, where)
        if content.sigma_px > 0 and "sigma_px" not in self.model_fields_set:
            arguments["sigma_px"] = content.sigma_px
            folder.add_note(f"{self.file}: sigma_px = {content.sigma_px:g}, that of its table")
        names = self._names(content, where)
        columns = [content.names.index(name) for name in names]
        pixels = content.confident(self.least_likelihood)[:, columns]
        self._require_size(camera, pixels, where)
        with located(where=where):
            is_used = is_within_experiment(
                at_s, t_s, name=str(self.file), is_static=folder.is_static
            )
        counts = np.isfinite(pixels[is_used]).all(axis=2).sum(axis=0)
        if never := [name for name, count in zip(names, counts, strict=True) if not count]:
            folder.add_note(f"{self.file}: {', '.join(never)} never seen and left out")
            kept = np.flatnonzero(counts).tolist()
            names, pixels = [names[k] for k in kept], pixels[:, kept]
        folder.add_note(f"{self.file}: {is_used.sum()} of {len(at_s)} images are used")
        return self._tracks(
            camera, names, at_s[is_used], pixels[is_used], where, arguments, stated_m
        )

    def _tracks(
        self,
        camera: Camera,
        names: list[str],
        t_s: Array,
        pixels: Array | None,
        where: str,
        arguments: dict[str, Any],
        stated_m: Mapping[str, Sequence[float]],
    ) -> ImageTracks:
        places = [stated_m.get(name, [np.nan] * 3) for name in names]
        with located(where=where):
            return ImageTracks(
                camera=camera, t_s=t_s, pixels=pixels, names=names, places_m=places, **arguments
            )

    def _names(self, content: TrackFile, where: str) -> list[str]:
        names = list(content.names) if self.points is None else self.points
        for key, stated in (
            ("points", names),
            ("places_m", [*self.places_m]),
            ("s_m", [*self.s_m]),
        ):
            absent = [name for name in stated if name not in content.names]
            if absent:
                known = ", ".join(content.names)
                raise InputError(
                    f"found {absent[0]!r}, which is not in {self.file}; expected one of {known}",
                    where=f"{where}.{key}",
                )
        return names

    def _read_file(self, folder: RecordingFolder, where: str) -> tuple[TrackFile, Array]:
        file = folder.require_existing(self.file, f"{where}.file", "a file of tracks")
        with located(where=f"{where}.file"):
            content = read_tracks(file)
        if content.t_s is not None:
            if self.frame_rate_hz is not None:
                raise InputError(
                    f"found a frame rate, but {self.file} has times; expected one of them",
                    where=f"{where}.frame_rate_hz",
                )
            return content, content.t_s + self.start_s
        if self.frame_rate_hz is None:
            if folder.is_static:
                return content, content.frames + self.start_s
            raise InputError(
                f"missing, but {self.file} has no times; expected the images per second of the video",
                where=f"{where}.frame_rate_hz",
            )
        return content, self.start_s + content.frames / self.frame_rate_hz

    def _require_size(self, camera: Camera, pixels: Array, where: str) -> None:
        size = camera.size_px
        if size is None:
            return
        if self.size_px is not None and tuple(self.size_px) != tuple(size):
            factors = [a / b for a, b in zip(self.size_px, size, strict=True)]
            remedy = "calibrate the camera with images of this size"
            if abs(factors[0] / factors[1] - 1) < 1e-3:
                remedy = (
                    f"if the images were scaled, multiply the first two rows of the matrix by "
                    f"{factors[0]:.4g}"
                )
            raise InputError(
                f"found images of {self.size_px[0]} x {self.size_px[1]} pixels, but the calibration "
                f"is for {size[0]} x {size[1]}; expected the same size: {remedy}",
                where=f"{where}.size_px",
            )
        share = share_outside(pixels, size)
        if share > MOST_OUTSIDE:
            largest = np.nanmax(pixels, axis=(0, 1))
            remedy = ""
            if share_outside(pixels[..., ::-1], size) <= MOST_OUTSIDE:
                remedy = ": u and v fit if they are exchanged"
            elif self.size_px is None:
                remedy = "; state size_px, the size of the video, which may be another one"
            raise InputError(
                f"{share:.0%} of the pixels are outside of the images of {size[0]} x {size[1]} "
                f"pixels of the calibration (largest u, v: {largest[0]:.0f}, {largest[1]:.0f}); "
                f"expected tracks of images of this size, with u to the right and v downwards{remedy}",
                where=f"{where}.file",
            )


def share_outside(pixels: Array, size_px: Sequence[int]) -> float:
    """Return the share of the known pixels (…, 2) that are outside of images of a size."""
    known = np.isfinite(pixels).all(axis=-1)
    with np.errstate(invalid="ignore"):
        outside = known & ((pixels < -0.5) | (pixels > np.array(size_px) - 0.5)).any(axis=-1)
    return float(outside.sum() / max(1, known.sum()))
