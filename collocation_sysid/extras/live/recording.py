"""Recording of live estimates for the Rerun viewer: an ``.rrd`` file that grows frame by frame.

On one time line: the surface of the body at the estimate, markers as measured, distances of the
markers from the estimate, and the parameters with their statistical 95 % intervals. The verdict and
the notes are texts. Needs the extra ``rerun``.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from ...common.array_types import Array
from ...common.files import require_possible
from ...errors import InputError
from ...recording import Experiment
from ..export.rerun_recording import APPLICATION, GREY, MARKER_RADIUS_RATIO, ORANGE, TIMELINE
from .estimator import LiveUpdate
from .frames import Frame

SUFFIX = ".rrd"
MISSING = "--rerun needs rerun-sdk: pip install 'collocation-sysid[rerun]'"


def require_recordable(file: Path) -> None:
    """Refuse a file to which no recording can be written.

    Raises
    ------
    InputError
        Without rerun-sdk, for another suffix than .rrd, if the file exists, or if its folder cannot
        be made.
    """
    if find_spec("rerun") is None:
        raise InputError(MISSING)
    if file.suffix.lower() != SUFFIX:
        raise InputError(f"found {file.suffix!r}; expected {SUFFIX}", file, where="--rerun")
    if file.exists() or file.is_symlink():
        raise InputError(
            "this file exists, and live recordings are not overwritten; choose another name",
            file,
            where="--rerun",
        )
    require_possible(file.parent)


class LiveRecording:
    """Growing file of live estimates.

    Parameters
    ----------
    file : Path
        The file to write; its folder is made if necessary, see `require_recordable`.
    experiment : Experiment
        Provides body and markers.
    """

    def __init__(self, file: Path, experiment: Experiment) -> None:
        rr: Any = import_module("rerun")
        self._rr = rr
        self._marker_names = experiment.markers.names
        self._verdict = ""
        surface = experiment.body.mesh.surface
        self._nodes, triangles = np.unique(surface, return_inverse=True)
        extent_m = float(np.ptp(experiment.body.nodes_m, axis=0).max())
        file.parent.mkdir(parents=True, exist_ok=True)
        self._stream = rr.RecordingStream(APPLICATION)
        self._stream.save(file)
        topology = rr.Mesh3D.from_fields(
            triangle_indices=triangles.reshape(surface.shape), albedo_factor=GREY
        )
        self._stream.log("body", topology, static=True)
        style = rr.Points3D.from_fields(colors=ORANGE, radii=MARKER_RADIUS_RATIO * extent_m)
        self._stream.log("markers", style, static=True)

    def write(self, frame: Frame, update: LiveUpdate, positions_m: Array | None) -> None:
        """Write a frame and what was estimated after it into the file, at the time of the update.

        Parameters
        ----------
        frame : Frame
            Frame with the measured markers; missing ones are left out.
        update : LiveUpdate
            Its result.
        positions_m : (n, 3) array or None
            Node positions at the estimate [m]; None if they are unknown. The surface is then left
            out, as it is if a position is not finite.
        """
        rr = self._rr
        self._stream.set_time(TIMELINE, duration=update.t_s)
        if positions_m is not None and np.isfinite(positions_m).all():
            surface = rr.Mesh3D.from_fields(vertex_positions=positions_m[self._nodes])
            self._stream.log("body", surface)
        seen_m = frame.tracks_m[np.isfinite(frame.tracks_m).all(axis=1)]
        self._stream.log("markers", rr.Points3D.from_fields(positions=seen_m))
        distances_mm = 1e3 * update.marker_distances_m
        for name, distance in zip(self._marker_names, distances_mm, strict=False):
            self._write_number(distance, "residuals_mm", str(name))
        self._write_estimates(update)

    def write_estimates(self, update: LiveUpdate) -> None:
        """Write estimates without a frame, such as the final ones, at the time of the update."""
        self._stream.set_time(TIMELINE, duration=update.t_s)
        self._write_estimates(update)

    def close(self) -> None:
        """Write what is buffered and close the file."""
        self._stream.flush()
        self._stream.disconnect()

    def _write_estimates(self, update: LiveUpdate) -> None:
        """Write parameters and statistical intervals, the verdict with its reasons if it changed
        since the last call, and notes, at the present time of the recording; intervals that are
        None are left out.
        """
        rr = self._rr
        for name, each in update.estimates.items():
            self._write_number(each.value, "parameters", name, "value")
            if each.statistical95 is not None:
                lower, upper = each.statistical95
                self._write_number(lower, "parameters", name, "lower")
                self._write_number(upper, "parameters", name, "upper")
        trust = update.trust
        verdict = "\n".join([trust.verdict, *trust.reasons])
        if verdict != self._verdict:
            self._verdict = verdict
            self._stream.log("verdict", rr.TextDocument(verdict))
        for note in update.notes:
            self._stream.log("notes", rr.TextLog(note))

    def _write_number(self, value: float, *path: str) -> None:
        """Write the number `value` at the present time of the recording under the entity whose path
        has the parts `path`; nothing if it is not finite.
        """
        if np.isfinite(value):
            entity = self._rr.new_entity_path(list(path))
            self._stream.log(entity, self._rr.Scalars(value))
