"""A run in an interactive window, through pyvista: turn it, step through time, colour by a field.

The fields are those of the run's frames for ParaView.
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

from ..arrays import Array
from ..errors import InputError, require_among
from ..files import damage_refused, is_own
from .animation import chosen
from .page import Colouring, cells_of_faces, write_page
from .pictures.camera import Camera
from .replay import Replay, headline, read_run, reading_run
from .style import BLACK, VERMILION
from .writers import FRAMES_FILE

WINDOW = (1100, 800)
FIELD = "von_mises_pa"
# Of the surface, in replays of what touches something.
CONTACT = ("pressures_pa", "gaps_m")


def export_page(
    run: str | Path, file: str | Path, experiment: str | None = None, field: str | None = None
) -> Path:
    """Write an experiment of a run as a stand-alone web page; needs no pyvista.

    Parameters
    ----------
    run : str or Path
    file : str or Path
    experiment : str, optional
        By default the first.
    field : str, optional
        Which of the frames' point or cell data colours the body as fitted, or "pressures_pa" or
        "gaps_m" of what it touches; by default the strain of the body as fitted and as simulated
        forward.

    Raises
    ------
    InputError
        If `run` is not a run folder, or has no such experiment or field.
    """
    result, replays = read_run(run)
    replay = chosen(replays, experiment, run)
    with reading_run(Path(run)):
        said = headline(result)
    colouring = None if field is None else Colouring.field(field, _on_faces(run, replay, field))
    return write_page(replay, file, said, colouring)


def _on_faces(run: str | Path, replay: Replay, field: str) -> Array:
    """A field of the frames (T, F) on the boundary's faces, at each sample that of the nearest."""
    if field in CONTACT and (touched := getattr(replay, field)) is not None:
        return touched
    frames = frame_files(Path(run), replay.name)
    cells = cells_of_faces(replay.tetrahedra, replay.surface)
    with _reading_frames(Path(run)):
        shown = []
        for _, file in frames:
            frame = meshio.read(file)
            points, in_cells = frame.point_data, frame.cell_data
            require_among(field, [*in_cells, *points], None, "--field")
            if field in in_cells:
                values = in_cells[field][0][cells]
            else:
                values = points[field][replay.surface].mean(axis=1)
            shown.append(np.linalg.norm(values, axis=1) if values.ndim == 2 else values)
        times = np.array([time for time, _ in frames])
        nearest = np.abs(replay.t_s[:, None] - times).argmin(axis=1)
        return np.array(shown)[nearest]


def view(
    run: str | Path,
    field: str = FIELD,
    experiment: str | None = None,
    screenshot: str | Path | None = None,
) -> None:
    """Show an experiment of a run in a window, and return when that is closed.

    Parameters
    ----------
    run : str or Path
    field : str
        Which of the frames' point or cell data colours the body.
    experiment : str, optional
        By default the first.
    screenshot : str or Path, optional
        Draw the middle of the motion into this file instead, without a window.

    Raises
    ------
    InputError
        If pyvista is missing, `run` is not a run folder or has no frames, no such experiment, or
        no such field.
    """
    if find_spec("pyvista") is None:
        raise InputError(
            "the 3-D view needs pyvista: pip install 'collocation-sysid[view]', or write a web "
            "page with --html, which needs nothing"
        )
    _, replays = read_run(run)
    replay = chosen(replays, experiment, run)
    frames = frame_files(Path(run), replay.name)
    with _reading_frames(Path(run)):
        scene = _Scene(frames, field, replay, off_screen=screenshot is not None)
    if screenshot is None:
        scene.plotter.show()
    else:
        scene.show(frames[len(frames) // 2][0])
        scene.plotter.screenshot(str(screenshot))
        scene.plotter.close()


def frame_files(run: Path, experiment: str) -> list[tuple[float, Path]]:
    """Times and files of an experiment's frames.

    Raises
    ------
    InputError
        If there are none.
    """
    listings = (run / experiment / FRAMES_FILE, run / FRAMES_FILE)
    listing = next((each for each in listings if each.is_file()), None)
    if listing is None:
        raise InputError(
            f"experiment '{experiment}' of this run has no {FRAMES_FILE}: only fitted experiments "
            "have frames; use --html to look at others",
            run,
        )
    with _reading_frames(run):
        sets = ElementTree.parse(listing).getroot().iter("DataSet")
        frames = [(float(s.attrib["timestep"]), listing.parent / s.attrib["file"]) for s in sets]
        if not frames or not all(is_own(run, file) for _, file in (*frames, (0.0, listing))):
            raise ValueError("it names no frames, or frames that are not in the folder")
        return frames


def _reading_frames(run: Path) -> AbstractContextManager[None]:
    return damage_refused(run, f"{FRAMES_FILE} or one of its frames", "solve the problem again")


class _Scene:
    """The window: the body of one frame with the markers measured nearest to its time."""

    def __init__(
        self, frames: list[tuple[float, Path]], field: str, replay: Replay, off_screen: bool
    ) -> None:
        pv: Any = import_module("pyvista")
        self.pv, self.replay, self.field = pv, replay, field
        self.times = np.array([time for time, _ in frames])
        self.meshes: list[Any] = [pv.read(file) for _, file in frames]
        known = [*self.meshes[0].cell_data, *self.meshes[0].point_data]
        require_among(field, known, None, "--field")
        self.plotter = pv.Plotter(off_screen=off_screen, window_size=list(WINDOW))
        self.plotter.set_background("white")
        self.range = self._range()
        self.plotter.add_axes(color="black")
        self.show(self.times[0])
        positions = np.array([mesh.points for mesh in self.meshes])
        self.plotter.view_vector(Camera.facing(positions, replay.up).axes[2], viewup=replay.up)
        self._fit()
        if not off_screen:
            self.plotter.add_slider_widget(
                self.show, (self.times[0], self.times[-1]), title="time [s]", color=BLACK,
                pointa=(0.3, 0.08), pointb=(0.7, 0.08), interaction_event="always",
            )  # fmt: skip

    def _range(self) -> tuple[float, float]:
        """Limits of the colours, the same for all frames."""
        values = [self._values(mesh) for mesh in self.meshes]
        return min(float(np.nanmin(v)) for v in values), max(float(np.nanmax(v)) for v in values)

    def _values(self, mesh: Any) -> np.ndarray:
        values = np.asarray(mesh[self.field])
        return np.linalg.norm(values, axis=1) if values.ndim == 2 else values

    def _fit(self) -> None:
        """Let the camera see all of the motion."""
        bounds = np.array([mesh.bounds for mesh in self.meshes])
        whole = np.empty(6)
        whole[::2], whole[1::2] = bounds[:, ::2].min(axis=0), bounds[:, 1::2].max(axis=0)
        self.plotter.reset_camera(bounds=whole)
        self.plotter.camera.zoom(1.4)  # the box is seen through its sphere

    def show(self, time_s: float) -> None:
        """Show the frame nearest to a time."""
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
        shapes = self.replay.shapes_m
        held = np.flatnonzero(self.replay.held[sample])
        if shapes is not None and len(held):
            nodes = self.pv.PolyData(np.asarray(shapes[sample][held], dtype=float))
            self.plotter.add_mesh(nodes, color=BLACK, name="grasped", **{**balls, "point_size": 8})
