"""Interactive 3-D view of a run through pyvista, and its web page with a chosen field.

`view_run` opens a window in which the body can be turned, stepped through time and coloured by a
field of the run's ParaView frames. `export_page` needs no pyvista.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from contextlib import AbstractContextManager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import meshio
import numpy as np

from ..common.array_types import Array
from ..common.files import damage_refused, is_own
from ..errors import InputError, require_among
from .animation import experiment_named
from .figure_style import BLACK, VERMILION
from .pictures.projection import ParallelCamera
from .replay import MotionRecord, damaged_run_refused, read_run, run_headline
from .run_writers import FRAMES_FILE
from .web_page import Colouring, cells_below_faces, write_page

# Width and height of the window in pixels.
WINDOW_SIZE_PIXELS = (1100, 800)
DEFAULT_FIELD = "von_mises_pa"
# Fields on the surface, of replays with obstacles.
SURFACE_FIELDS = ("pressures_pa", "gaps_m")


def export_page(
    run: str | Path, file: str | Path, experiment: str | None = None, field: str | None = None
) -> Path:
    """Write an experiment of a run folder as a stand-alone web page, and return the page's file; an
    existing file is replaced.

    Parameters
    ----------
    run : str or Path
        A run folder.
    file : str or Path
        HTML file to write; missing parent folders are made.
    experiment : str, optional
        Name of the experiment; by default the first with a trajectory, fitted or simulated.
    field : str, optional
        Point or cell data of the frames that colour the fitted body, or the quantities of faces
        "pressures_pa" or "gaps_m", which experiments for validation have, too; by default the
        strain of the fitted and the simulated body.

    Raises
    ------
    InputError
        If `run` is not a run folder or a damaged one, has no such experiment or field, or the file
        cannot be written; and if the `field` needs frames and the experiment has none, as one for
        validation.
    """
    result, replays = read_run(run)
    replay = experiment_named(replays, experiment, run=run)
    with damaged_run_refused(Path(run)):
        text = run_headline(result)
    colouring = None
    if field is not None:
        colouring = Colouring.by_field(
            field,
            field_on_faces(run, replay, field=field),
            trajectory="simulated" if replay.positions_m is None else "fitted",
        )
    return write_page(replay, file, headline=text, colouring=colouring)


def field_on_faces(run: str | Path, replay: MotionRecord, field: str) -> Array:
    """Return a field (T, F) on the boundary triangles, at each sample that of the nearest frame.

    Point data are averaged over the corners of a triangle; of vectors the norm is taken.
    Pressure and gap come from `replay` and need no frames.

    Parameters
    ----------
    run : str or Path
        The run folder.
    replay : MotionRecord
        Experiment of this run.
    field : str
        Point or cell data of the frames, or one of `SURFACE_FIELDS`.

    Raises
    ------
    InputError
        If the frames have no such field, are damaged, or there are none.
    """
    if field in SURFACE_FIELDS and (values_of_faces := getattr(replay, field)) is not None:
        return values_of_faces
    frames = _frames_of_fit(run, replay)
    cells = cells_below_faces(replay.tetrahedra, replay.surface)
    with _damaged_frames_refused(Path(run)):
        shown = []
        for _, file in frames:
            frame = meshio.read(file)
            points = frame.point_data
            in_cells = frame.cell_data
            require_among(field, [*in_cells, *points], where="--field")
            if field in in_cells:
                values = in_cells[field][0][cells]
            else:
                values = points[field][replay.surface].mean(axis=1)
            shown.append(np.linalg.norm(values, axis=1) if values.ndim == 2 else values)
        times = np.array([time for time, _ in frames])
        nearest = np.abs(replay.t_s[:, None] - times).argmin(axis=1)
        return np.array(shown)[nearest]


def view_run(
    run: str | Path,
    field: str = DEFAULT_FIELD,
    experiment: str | None = None,
    screenshot: str | Path | None = None,
) -> None:
    """Show an experiment of a run folder in a window, and return when the window is closed.

    Parameters
    ----------
    run : str or Path
        A run folder.
    field : str
        Point or cell data of the frames that colour the body.
    experiment : str, optional
        Name of a fitted experiment; by default the first with a trajectory.
    screenshot : str or Path, optional
        Picture file, with an ending such as .png, into which the middle frame is drawn instead,
        without a window; an existing file is replaced.

    Raises
    ------
    InputError
        If pyvista is missing, `run` is not a run folder or a damaged one, or it has no such
        experiment, no frames of it, or no such field.
    """
    if find_spec("pyvista") is None:
        raise InputError(
            "the 3-D view needs pyvista: pip install 'collocation-sysid[view]', or write a web "
            "page with --html, which needs nothing"
        )
    _, replays = read_run(run)
    replay = experiment_named(replays, experiment, run=run)
    frames = _frames_of_fit(run, replay)
    with _damaged_frames_refused(Path(run)):
        scene = _FrameWindow(frames, field, replay=replay, off_screen=screenshot is not None)
    if screenshot is None:
        scene.plotter.show()
    else:
        scene.show_nearest_frame(frames[len(frames) // 2][0])
        scene.plotter.screenshot(str(screenshot))
        scene.plotter.close()


def frame_files(run: Path, experiment: str) -> list[tuple[float, Path]]:
    """Return times [s] and files of an experiment's frames, in their order in the list of frames.

    If the experiment has no folder of frames, those of the run folder itself are returned, which
    belong to its only fitted experiment.

    Raises
    ------
    InputError
        If the run folder has no frames of that experiment, or a damaged list of frames.
    """
    listings = (run / experiment / FRAMES_FILE, run / FRAMES_FILE)
    listing = next((each for each in listings if each.is_file()), None)
    if listing is None:
        raise _missing_frames(run, experiment)
    with _damaged_frames_refused(run):
        sets = ElementTree.parse(listing).getroot().iter("DataSet")
        frames = [(float(s.attrib["timestep"]), listing.parent / s.attrib["file"]) for s in sets]
        if not frames or not all(is_own(run, file) for _, file in (*frames, (0.0, listing))):
            raise ValueError(
                "it lists no frames, or frames that are missing or outside the run folder"
            )
        return frames


def _missing_frames(run: str | Path, experiment: str) -> InputError:
    """Return the error for an experiment of a run without frames."""
    return InputError(
        f"experiment '{experiment}' of this run has no {FRAMES_FILE}: only fitted experiments "
        "have frames; to view others, use --html without --field",
        run,
    )


def _frames_of_fit(run: str | Path, replay: MotionRecord) -> list[tuple[float, Path]]:
    """Return times [s] and files of the frames of an experiment that was fitted, see `frame_files`."""
    if replay.positions_m is None:
        raise _missing_frames(run, replay.name)
    return frame_files(Path(run), replay.name)


def _damaged_frames_refused(run: Path) -> AbstractContextManager[None]:
    """Return a context in which errors from damaged frames become an InputError on the run."""
    return damage_refused(
        run, f"{FRAMES_FILE} or one of its frames", remedy="solve the problem again"
    )


class _FrameWindow:
    """Window with the body of one frame and the measured markers nearest in time.

    Parameters
    ----------
    frames : list of (float, Path)
        Time [s] and file of each frame.
    field : str
        Point or cell data that colour the body.
    replay : MotionRecord
        The experiment, for markers, grasped nodes and obstacles.
    off_screen : bool
        Draw without a window.

    Raises
    ------
    InputError
        If the frames have no such field.
    """

    def __init__(
        self, frames: list[tuple[float, Path]], field: str, replay: MotionRecord, off_screen: bool
    ) -> None:
        pv: Any = import_module("pyvista")
        self.pv = pv
        self.replay = replay
        self.field = field
        self.times = np.array([time for time, _ in frames])
        self.meshes: list[Any] = [pv.read(file) for _, file in frames]
        known = [*self.meshes[0].cell_data, *self.meshes[0].point_data]
        require_among(field, known, where="--field")
        self.plotter = pv.Plotter(off_screen=off_screen, window_size=list(WINDOW_SIZE_PIXELS))
        self.plotter.set_background("white")
        self.range = self._value_range()
        self.plotter.add_axes(color="black")
        self.show_nearest_frame(self.times[0])
        positions = np.array([mesh.points for mesh in self.meshes])
        self.plotter.view_vector(
            ParallelCamera.facing_motion(positions, replay.up).axes[2], viewup=replay.up
        )
        self._fit_camera()
        if not off_screen:
            self.plotter.add_slider_widget(
                self.show_nearest_frame,
                (self.times[0], self.times[-1]),
                title="time [s]",
                color=BLACK,
                pointa=(0.3, 0.08),
                pointb=(0.7, 0.08),
                interaction_event="always",
            )

    def _value_range(self) -> tuple[float, float]:
        """Return the limits of the colour scale, the same for all frames: the smallest and the
        largest value of the field; NaN is ignored.
        """
        values = [self._field_values(mesh) for mesh in self.meshes]
        return min(float(np.nanmin(v)) for v in values), max(float(np.nanmax(v)) for v in values)

    def _field_values(self, mesh: Any) -> np.ndarray:
        """Return the field of this window on a mesh, (n,) for point data or (E,) for cell data; of
        vectors their norms. `KeyError` if the mesh has no such field.
        """
        values = np.asarray(mesh[self.field])
        return np.linalg.norm(values, axis=1) if values.ndim == 2 else values

    def _fit_camera(self) -> None:
        """Place the camera so that the whole motion is in view."""
        bounds = np.array([mesh.bounds for mesh in self.meshes])
        extent = np.empty(6)
        extent[::2] = bounds[:, ::2].min(axis=0)
        extent[1::2] = bounds[:, 1::2].max(axis=0)
        self.plotter.reset_camera(bounds=extent)
        self.plotter.camera.zoom(1.4)  # the box is seen through its sphere

    def show_nearest_frame(self, time_s: float) -> None:
        """Show the frame nearest to a time [s], with measured markers, grasped nodes and obstacles
        of the nearest sample, in place of the last one.

        Markers without a measurement at that sample are not shown. Grasped nodes are at their
        fitted positions, and are not drawn without a fit.
        """
        mesh = self.meshes[int(np.abs(self.times - time_s).argmin())]
        sample = int(np.abs(self.replay.t_s - time_s).argmin())
        if self.replay.obstacles_m is not None:
            points = self.replay.obstacles_m[sample]
            pairs = np.array([np.arange(len(points) - 1), np.arange(1, len(points))]).T
            # Lines end where a point is no number.
            pairs = pairs[np.isfinite(points[pairs]).all(axis=(1, 2))]
            drawn = np.hstack([np.full((len(pairs), 1), 2), pairs])
            lines = self.pv.PolyData(np.nan_to_num(points), lines=drawn)
            self.plotter.add_mesh(lines, color=BLACK, name="obstacles", reset_camera=False)
        bar = {"title": self.field, "color": "black", "vertical": True, "fmt": "%.3g"}
        bar |= {"title_font_size": 16, "label_font_size": 16, "position_x": 0.86}
        self.plotter.add_mesh(
            mesh, scalars=self.field, clim=self.range, cmap="cividis", show_edges=True, name="body",
            edge_color="#5A6B7B", line_width=1, scalar_bar_args=bar, reset_camera=False,
            ambient=0.45, diffuse=0.6,
        )  # fmt: skip
        balls = {"render_points_as_spheres": True, "point_size": 12, "reset_camera": False}
        measured = self.replay.measured_m[sample]
        measured = measured[np.isfinite(measured).all(axis=1)]
        if len(measured):
            self.plotter.add_mesh(
                self.pv.PolyData(measured), color=VERMILION, name="measured", **balls
            )
        else:
            self.plotter.remove_actor("measured", reset_camera=False)
        shapes = self.replay.shapes_m
        grasped = np.flatnonzero(self.replay.is_prescribed[sample])
        if shapes is not None and len(grasped):
            nodes = self.pv.PolyData(np.asarray(shapes[sample][grasped], dtype=float))
            self.plotter.add_mesh(nodes, color=BLACK, name="grasped", **{**balls, "point_size": 8})
        else:
            self.plotter.remove_actor("grasped", reset_camera=False)
