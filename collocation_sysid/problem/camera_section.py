"""Keys of [[experiment.depth]], and how the files of a camera or scanner are read."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field

from ..common.array_types import Array
from ..common.schema_tables import Section, Unit, declared_in
from ..common.validated_types import FileName, Finite, Positive, Text
from ..errors import InputError, located
from ..recording import Depth, DepthCamera, read_poses
from ..recording.depth_camera import points_from_image, samples_with_outlines
from ..recording.sources.depth_files import DepthFileContent, read_depth
from ..recording.sources.units import METRES_PER_UNIT
from ..recording.time_tables import is_within_experiment
from .measurement_section import MeasurementSection, RecordingFolder, existing_file


class DepthCameraSection(Section, of=DepthCamera):
    """A depth camera, or the frame of a scanner; keys that an .npz or a log contains may be
    omitted.

    Attributes
    ----------
    poses : str, optional
        File of poses of the rigid body that carries the camera; by default the camera is at rest.
    """

    poses: Text | None = None


class DepthSection(MeasurementSection, of=Depth):
    """Depth images or point clouds of the body from a camera or a scanner, without labels.

    Attributes
    ----------
    name : str
        Name in messages, error bars and pictures.
    file : str
        Depth images (.npz, .png of 16 bits, .exr) or clouds of points (.ply, .pcd, .npy, .xyz), or
        a folder of these in the order of their names, with times.csv or t_s; or a topic of a log,
        ``run.mcap#/camera/depth/image_rect_raw``.
    camera : DepthCameraSection
        Pose and projection of the camera.
    t_s : list of float, optional
        Times [s], if the file does not contain them; a single image is assigned to the first sample
        by default.
    count_m : float, optional
        Depth of one count of an image, 0.001 by default.
    length_unit : {"m", "cm", "mm", "in"}
        Unit of the coordinates of clouds.
    """

    name: FileName = "depth"
    file: Text
    camera: DepthCameraSection = Field(default_factory=lambda: DepthCameraSection.model_construct())
    t_s: list[Finite] | None = None
    count_m: Positive | None = None
    length_unit: Unit = "m"

    def read_times_s(self, folder: RecordingFolder, where: str) -> Array:
        return self._read_images(folder, where)[1]

    def read(self, folder: RecordingFolder, where: str, t_s: Array) -> Depth:
        """Return the images or clouds within the times t_s (T,) of the experiment [s], and note how
        many are used.

        Images are converted to clouds of points. What the table states about the camera replaces
        what the file contains.
        """
        content, at_s = self._read_images(folder, where)
        camera = self._camera(folder, content, where=f"{where}.camera")
        with located(where=where):
            is_used = is_within_experiment(at_s, t_s, name=self.file, is_static=folder.is_static)
            used = np.flatnonzero(is_used).tolist()
            clouds = [content.clouds_m[k] for k in used] if content.clouds_m else []
            images = []
            outlined = samples_with_outlines(len(used))
            for number, sample in enumerate(used if len(content.images_m) else ()):
                image = content.images_m[sample]
                clouds.append(points_from_image(image, camera))
                images.append(image if number in outlined else None)
            arguments = {"name": self.name, **declared_in(self, where=where)}
            depth = Depth(
                t_s=at_s[is_used], clouds=clouds, camera=camera, images_m=images, **arguments
            )
        folder.add_note(f"{self.file}: {len(clouds)} of {len(at_s)} images are used")
        return depth

    def _camera(
        self, folder: RecordingFolder, content: DepthFileContent, where: str
    ) -> DepthCamera:
        """Return the camera, completed by its file; an incomplete one is refused."""
        arguments: dict[str, Any] = declared_in(self.camera, where=where)
        for name in ("matrix", "pose", "distortion"):
            if name not in self.camera.model_fields_set:  # a default does not replace the file's
                arguments[name] = getattr(content, name)
        if self.camera.poses is not None:
            file = existing_file(folder.path, self.camera.poses, key=f"{where}.poses")
            arguments["poses"] = read_poses(file)
        with located(where=where):
            return DepthCamera(
                **{name: value for name, value in arguments.items() if value is not None}
            )

    def _read_images(self, folder: RecordingFolder, where: str) -> tuple[DepthFileContent, Array]:
        """Return times that default to those of the file; of equilibria to 0, 1, 2, …"""
        file = folder.path / self.file
        if not file.is_dir():
            file = existing_file(folder.path, self.file, key=f"{where}.file")
        content = read_depth(
            file,
            self.count_m,
            length_m=METRES_PER_UNIT[self.length_unit],
            known_camera_fields=self.camera.model_fields_set,
        )
        count = len(content.images_m) or len(content.clouds_m)
        t_s = self.t_s if self.t_s is not None else content.t_s
        if t_s is None and count > 1 and not folder.is_static:
            message = (
                f"{self.file} does not contain times of its {count} images; expected them in t_s"
            )
            raise InputError(message, where=f"{where}.t_s")
        times = np.arange(float(count)) if t_s is None else np.array(t_s, dtype=float).ravel()
        if len(times) != count:
            message = (
                f"found {len(times)} times for {count} images or clouds; expected one time for each"
            )
            raise InputError(message, where=f"{where}.t_s")
        return content, times
