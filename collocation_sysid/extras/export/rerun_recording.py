"""Recording of a run for the Rerun viewer: an ``.rrd`` file.

On one time line, for each experiment: the deforming surface coloured by the von Mises stress,
grasped nodes and obstacles, markers as measured, fitted and simulated, distances of the fitted
markers from the measured ones, forces, and the parameters with their combined intervals. Needs the
extra ``rerun``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array
from ...common.display import as_markdown
from ...errors import InputError
from ...recording.measured_wrench import COMPONENTS, UNITS
from ...result.animation import experiment_named
from ...result.frame_fields import stress_on_faces
from ...result.replay import MotionRecord, read_run
from ...result.run_summary import run_summary
from ...result.run_writers import replaced_folder
from ...runs.result_content import Result

TARGET = "rerun"
RECORDING_FILE = "recording.rrd"
APPLICATION = "collocation_sysid"
TIMELINE = "time"
MISSING = "--to rerun needs rerun-sdk: pip install 'collocation-sysid[rerun]'"
# Radius of a marker over the largest extent of the body.
MARKER_RADIUS_RATIO = 0.012
# Colours (red, green, blue), from 0 to 255, as in the pictures of a run.
ORANGE = (230, 159, 0)
# Fitted markers.
BLUE = (0, 114, 178)
# Simulated markers.
VERMILION = (213, 94, 0)
# Grasped nodes and obstacles.
BLACK = (20, 20, 20)
# Surface without stress.
GREY = (150, 160, 170)


def write_rerun(run: str | Path, folder: str | Path, experiment: str | None = None) -> list[str]:
    """Write the recording of a run folder for the Rerun viewer, ``recording.rrd``.

    Parameters
    ----------
    folder : str or Path
        Written completely or not at all; an earlier recording there is replaced.
    experiment : str, optional
        Name of the only experiment to write; all with a trajectory by default.

    Returns
    -------
    list of str
        What is missing in the recording, a sentence for each experiment without stresses.

    Raises
    ------
    InputError
        Without rerun-sdk, if `run` is not a run folder, has no such experiment or none with a
        trajectory, or if `folder` has other files.
    """
    if find_spec("rerun") is None:
        raise InputError(MISSING)
    result, replays = read_run(run)
    if experiment is not None:
        replays = [experiment_named(replays, experiment, run=run)]
    replays = [replay for replay in replays if replay.has_shapes()]
    if not replays:
        raise InputError(
            "no experiment of this run has a stored motion of a body with a mesh; expected a run "
            "with such an experiment",
            run,
        )
    stresses = [_stress_on_faces(run, replay) for replay in replays]
    with replaced_folder(folder, marker_file=RECORDING_FILE, content_word="recording") as place:
        recording = _Recording(place / RECORDING_FILE, result, replays=replays)
        limits = _limits(stresses)
        for replay, stress in zip(replays, stresses, strict=True):
            recording.write_experiment(replay, stress, limits=limits)
        recording.close()
    return [
        f"experiment '{replay.name}' has no frames, so that its surface has no stress"
        for replay, stress in zip(replays, stresses, strict=True)
        if stress is None
    ]


def _stress_on_faces(run: str | Path, replay: MotionRecord) -> Array | None:
    """Return (T, F) [Pa] of the nearest frame; None if there are none."""
    try:
        return stress_on_faces(run, replay)
    except InputError:
        return None


def _limits(stresses: Sequence[Array | None]) -> tuple[float, float]:
    """0 and 1 if none is known [Pa]."""
    known = [each for each in stresses if each is not None and np.isfinite(each).any()]
    if not known:
        return 0.0, 1.0
    return min(float(np.nanmin(s)) for s in known), max(float(np.nanmax(s)) for s in known)


def vertex_colours(
    faces: NDArray[np.integer], values: Array, limits: tuple[float, float], count: int
) -> NDArray[np.uint8]:
    """Return the colours of vertices from values on the triangles around them.

    The value of a vertex is the mean over the triangles around it; values beyond the limits have
    the colour of the nearest limit, and so have vertices without a triangle at the value 0.

    Parameters
    ----------
    faces : (F, 3)
        Vertices of the triangles.
    values : (T, F)
        Values on the triangles; NaN counts as the lower limit.
    limits : (low, high)
        Ends of the colour scale (cividis).

    Returns
    -------
    (T, n, 4)
        Red, green, blue and opacity, from 0 to 255.
    """
    low, high = limits
    finite = np.nan_to_num(values, nan=low)
    sums = np.zeros((len(values), count))
    for corner in faces.T:
        for sample, row in zip(sums, finite, strict=True):
            np.add.at(sample, corner, row)
    triangle_counts = np.bincount(faces.ravel(), minlength=count)
    means = sums / np.maximum(triangle_counts, 1)
    scaled = (means - low) / ((high - low) or 1.0)
    return mpl.colormaps["cividis"](np.clip(scaled, 0.0, 1.0), bytes=True)


class _Recording:
    """Write a recording, whose layout and time span follow from all replays."""

    def __init__(self, file: Path, result: Result, replays: Sequence[MotionRecord]) -> None:
        rr: Any = import_module("rerun")
        self.rr = rr
        self.stream = rr.RecordingStream(APPLICATION)
        self.stream.save(file, default_blueprint=self._layout(replays))
        if result.title:
            self.stream.send_recording_name(result.title)
        summary = as_markdown(run_summary(result))
        document = rr.TextDocument(summary, media_type=rr.MediaType.MARKDOWN)
        self.stream.log("summary", document, static=True)
        span_s = (min(each.t_s[0] for each in replays), max(each.t_s[-1] for each in replays))
        self._write_parameters(result, np.array(span_s))

    def close(self) -> None:
        self.stream.flush()
        self.stream.disconnect()

    def _layout(self, replays: Sequence[MotionRecord]) -> Any:
        """Bodies are beside curves and the summary."""
        views: Any = import_module("rerun.blueprint")
        bodies = [views.Spatial3DView(origin=self._path(e.name), name=e.name) for e in replays]
        curves = [
            views.TimeSeriesView(
                origin=self._path(e.name, "residuals_mm"), name=f"{e.name}: residuals [mm]"
            )
            for e in replays
        ]
        parameters = views.TimeSeriesView(origin="parameters", name="parameters")
        summary = views.TextDocumentView(origin="summary", name="summary")
        right = views.Vertical(views.Tabs(*curves), parameters, summary)
        return views.Blueprint(views.Horizontal(views.Tabs(*bodies), right))

    def _path(self, *parts: str) -> str:
        """Names may have any characters."""
        return self.rr.new_entity_path(list(parts))

    def _write_parameters(self, result: Result, span_s: Array) -> None:
        for name, each in result.estimates.items():
            curves = {"value": each.value}
            if each.combined95 is not None:
                curves |= {"lower": each.combined95[0], "upper": each.combined95[1]}
            for curve, value in curves.items():
                self._write_curve(
                    self._path("parameters", name, curve), span_s, values=[value, value]
                )

    def write_experiment(
        self, replay: MotionRecord, stress: Array | None, limits: tuple[float, float]
    ) -> None:
        """Write what exists of an experiment."""
        name = replay.name
        self.stream.log(self._path(name), self._up_axis(replay.up), static=True)
        self._write_surface(replay, stress, limits=limits)
        extent_m = float(np.ptp(replay.undeformed_m, axis=0).max())
        radius_m = MARKER_RADIUS_RATIO * extent_m
        shapes_m = replay.shapes_m
        assert shapes_m is not None
        grasped_m = [x[h] for x, h in zip(shapes_m, replay.is_prescribed, strict=True)]
        self._write_points(
            self._path(name, "grasped"),
            replay.t_s,
            points_m=grasped_m,
            colour=BLACK,
            radius_m=radius_m / 2,
        )
        for kind, markers_m, colour in (
            ("measured", replay.measured_m, ORANGE),
            ("fitted", replay.markers_m, BLUE),
            ("simulated", replay.rolled_out_m, VERMILION),
        ):
            if markers_m is not None and len(replay.marker_names):
                path = self._path(name, "markers", kind)
                self._write_points(
                    path, replay.t_s, points_m=[*markers_m], colour=colour, radius_m=radius_m
                )
        depth_points_m = [replay.camera_points_m(k) for k in range(len(replay.t_s))]
        if any(map(len, depth_points_m)):
            path = self._path(name, "depth_points")
            self._write_points(
                path, replay.t_s, points_m=depth_points_m, colour=ORANGE, radius_m=radius_m / 4
            )
        self._write_obstacles(replay)
        self._write_residuals(replay)
        self._write_forces(replay)

    def _up_axis(self, up: Array) -> Any:
        """Return the viewer's axes nearest to a direction (3,)."""
        axis = int(np.abs(up).argmax())
        end = "UP" if up[axis] > 0 else "DOWN"
        return getattr(self.rr.ViewCoordinates, f"RIGHT_HAND_{'XYZ'[axis]}_{end}")

    def _write_surface(
        self, replay: MotionRecord, stress: Array | None, limits: tuple[float, float]
    ) -> None:
        """Samples with a position that is not finite have no surface."""
        rr = self.rr
        shapes_m = replay.shapes_m
        assert shapes_m is not None
        nodes, triangles = np.unique(replay.surface, return_inverse=True)
        triangles = triangles.reshape(replay.surface.shape)
        there = np.isfinite(shapes_m).all(axis=(1, 2))
        positions_m = shapes_m[there][:, nodes]
        count = len(nodes)
        path = self._path(replay.name, "body")
        topology = rr.Mesh3D.from_fields(
            triangle_indices=triangles, albedo_factor=GREY if stress is None else None
        )
        self.stream.log(path, topology, static=True)
        columns: dict[str, Any] = {"vertex_positions": positions_m.reshape(-1, 3)}
        if stress is not None:
            colours = vertex_colours(triangles, stress[there], limits=limits, count=count)
            columns["vertex_colors"] = colours.reshape(-1, 4)
        self._send(
            path,
            replay.t_s[there],
            columns=rr.Mesh3D.columns(**columns),
            counts=[count] * len(positions_m),
        )
        if stress is not None:
            largest = np.nanmax(np.nan_to_num(stress, nan=-np.inf), axis=1)
            path = self._path(replay.name, "largest_von_mises_pa")
            self._write_curve(path, replay.t_s, values=largest)

    def _write_points(
        self,
        path: str,
        t_s: Array,
        points_m: Sequence[Array],
        colour: tuple[int, int, int],
        radius_m: float,
    ) -> None:
        """Write points at each time that are finite, if any."""
        rr = self.rr
        there = [each[np.isfinite(each).all(axis=1)] for each in points_m]
        if not any(map(len, there)):
            return
        style = rr.Points3D.from_fields(colors=colour, radii=radius_m)
        self.stream.log(path, style, static=True)
        columns = rr.Points3D.columns(positions=np.concatenate(there))
        self._send(path, t_s, columns=columns, counts=[len(each) for each in there])

    def _write_obstacles(self, replay: MotionRecord) -> None:
        if replay.obstacles_m is None:
            return
        path = self._path(replay.name, "obstacles")
        for time_s, points_m in zip(replay.t_s, replay.obstacles_m, strict=True):
            strips = [*_polylines(points_m)]
            self.stream.set_time(TIMELINE, duration=float(time_s))
            self.stream.log(path, self.rr.LineStrips3D(strips, colors=BLACK))
        self.stream.reset_time()

    def _write_residuals(self, replay: MotionRecord) -> None:
        model_m = replay.rolled_out_m if replay.markers_m is None else replay.markers_m
        if model_m is None:
            return
        distances_mm = 1e3 * np.linalg.norm(model_m - replay.measured_m, axis=2)
        for marker, values in zip(replay.marker_names, distances_mm.T, strict=True):
            path = self._path(replay.name, "residuals_mm", str(marker))
            self._write_curve(path, replay.t_s, values=values)

    def _write_forces(self, replay: MotionRecord) -> None:
        for number, columns in enumerate(replay.wrenches, 1):
            t_s = columns[:, 0]
            values = columns[:, 1:].reshape(len(t_s), 3, len(COMPONENTS))
            for kind, each in zip(
                ("measured", "fitted", "simulated"), np.moveaxis(values, 1, 0), strict=True
            ):
                for component, unit, curve in zip(COMPONENTS, UNITS, each.T, strict=True):
                    label = f"{component} [{unit}]"
                    path = self._path(replay.name, f"wrench_{number}", label, kind)
                    self._write_curve(path, t_s, values=curve)

    def _write_curve(self, path: str, t_s: Array, values: Sequence[float] | Array) -> None:
        """Write finite values (T,) over times (T,) [s] under `path`."""
        curve = np.asarray(values, dtype=float)
        is_finite = np.isfinite(curve)
        if is_finite.any():
            columns = self.rr.Scalars.columns(scalars=curve[is_finite])
            self._send(path, t_s[is_finite], columns=columns, counts=None)

    def _send(self, path: str, t_s: Array, columns: Any, counts: Sequence[int] | None) -> None:
        """Counts are rows per time, one by default."""
        times = [self.rr.TimeColumn(TIMELINE, duration=t_s)]
        data = columns if counts is None else columns.partition(counts)
        self.stream.send_columns(path, times, data)


def _polylines(points_m: Array) -> Iterator[Array]:
    """Yield lines separated by rows that are not finite, of two or more points."""
    ends = np.flatnonzero(~np.isfinite(points_m).all(axis=1))
    start = 0
    for end in (*ends, len(points_m)):
        if end - start > 1:
            yield points_m[start:end]
        start = end + 1
