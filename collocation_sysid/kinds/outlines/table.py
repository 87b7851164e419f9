"""Keys of [[experiment.outlines]], and how the files of masks are read."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field

from ...common.array_types import Array
from ...common.schema_tables import Declared, declared_in
from ...common.validated_types import Finite, Positive, Text
from ...errors import InputError, located
from ...problem.measurement_section import MeasurementSection, RecordingFolder
from ...recording.time_tables import is_within_experiment
from ..image_tracks.camera_images import PoseSigma
from ..image_tracks.table import ImageCameraSection, PoseSigmaSection
from .masks import Mask, read_masks
from .outlines import Outlines


class OutlinesSection(MeasurementSection, of=Outlines):
    """Masks of the body in the images of an ordinary camera, with whose edges the outline of the body
    is compared.

    Attributes
    ----------
    name : str
        Name in messages, error bars and files.
    file : str, optional
        Masks: a .png, white where the body is, a folder of these in the order of their names, or a
        .json with run lengths of COCO, as SAM writes them. A simulation writes the file.
    camera : ImageCameraSection
        Calibration and pose of the camera.
    t_s : list of float, optional
        Times of the images [s].
    frame_rate_hz : float, optional
        Images per second, in place of times.
    start_s : float
        Time of the first image, with `frame_rate_hz`.
    pose_sigma : PoseSigmaSection
        Uncertainty of the stated pose.
    """

    file: Text | None = None
    camera: ImageCameraSection
    t_s: list[Finite] | None = None
    frame_rate_hz: Positive | None = None
    start_s: Finite = 0.0
    sigma_px: Declared
    pose_sigma: PoseSigmaSection = Field(
        default_factory=lambda: PoseSigmaSection.model_construct(**vars(PoseSigma()))
    )

    def read_times_s(self, folder: RecordingFolder, where: str) -> Array:
        """Return the times of all masks [s]; in a simulation without them, the stated ones, by
        default that of a single photograph.
        """
        if not folder.must_read(self.file):
            return np.array([0.0] if self.t_s is None else self.t_s)
        return self._read_file(folder, where)[1]

    def read(self, folder: RecordingFolder, where: str, t_s: Array) -> Outlines:
        if self.camera.pose == "unknown":
            raise InputError(
                'found "unknown", but a body may have the same outline from several sides; expected '
                "the pose of the camera, such as that which a solve with image_tracks of at least "
                "four points with places_m in the same images notes",
                where=f"{where}.camera.pose",
            )
        camera = self.camera.read(folder, f"{where}.camera")
        arguments: dict[str, Any] = {
            "name": self.name,
            "camera": camera,
            "pose_sigma": PoseSigma(**self.pose_sigma.model_dump()),
            **declared_in(self, where=where),
        }
        arguments.pop("t_s", None)
        if not folder.must_read(self.file):
            return Outlines(t_s=t_s, masks=None, **arguments)
        masks, at_s = self._read_file(folder, where)
        with located(where=where):
            is_used = is_within_experiment(
                at_s, t_s, name=str(self.file), is_static=folder.is_static
            )
            folder.add_note(f"{self.file}: {is_used.sum()} of {len(at_s)} masks are used")
            used = [masks[k] for k in np.flatnonzero(is_used).tolist()]
            return Outlines(t_s=at_s[is_used], masks=used, **arguments)

    def _read_file(self, folder: RecordingFolder, where: str) -> tuple[list[Mask], Array]:
        path = folder.path / (self.file or "")
        if self.file is None or not path.is_dir():
            path = folder.require_existing(self.file, f"{where}.file", "a file of masks")
        with located(where=f"{where}.file"):
            masks = read_masks(path)
        count = len(masks)
        if self.t_s is not None:
            if self.frame_rate_hz is not None or len(self.t_s) != count:
                raise InputError(
                    f"found {len(self.t_s)} times for {count} masks"
                    + " and a frame rate" * (self.frame_rate_hz is not None)
                    + "; expected one time for each mask, or the frame rate",
                    where=f"{where}.t_s",
                )
            return masks, np.array(self.t_s, dtype=float)
        if self.frame_rate_hz is None and count > 1 and not folder.is_static:
            raise InputError(
                f"missing; expected the times of the {count} masks, or frame_rate_hz",
                where=f"{where}.t_s",
            )
        return masks, self.start_s + np.arange(float(count)) / (self.frame_rate_hz or 1.0)
