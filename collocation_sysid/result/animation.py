"""Film of a run: the fitted body, the edges of its forward simulation over it, and the markers.

Beside the body a panel shows the distance of the markers from their measurements over time.
`animate` works from a run folder, `film` from a `MotionRecord`.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from numpy.typing import NDArray

from ..common.array_types import Array
from ..common.files import replaced_file, safe_name
from ..common.step_counting import StepUnit, complete_steps, counted_phase
from ..errors import InputError, require_among
from .figure_style import (
    BLACK,
    BLUE,
    GREEN,
    LINE_PT,
    TEXT_PT,
    VERMILION,
    add_legend_above,
    is_alone,
    own_settings,
    style_axes,
)
from .pictures.cameras import LEGEND_ENTRY
from .pictures.over_time import rms_over_markers
from .pictures.scene import (
    BodyDrawing,
    ParallelCamera,
    SheetView,
    aspect_ratio,
    draw_directions,
    draw_legend,
    draw_scale,
    legend_handles,
    sheet,
    with_nearby_outlines,
)
from .replay import MotionRecord, damaged_run_refused, read_run, run_headline

# Width of the film [mm]; its pixels are in `PIXELS_WIDE`.
FILM_WIDTH_MM = 160.0
# Largest height of the body [mm], so that a film is not higher than a screen.
MAX_BODY_HEIGHT_MM = 110.0
# Smallest height of the body [mm], for the panel of errors beside it.
MIN_BODY_HEIGHT_MM = 30.0
# Width of a film in pixels, even for H.264 (see `_with_even_pixels`); smaller for GIF, which
# compresses badly.
PIXELS_WIDE = {".mp4": 1280, ".gif": 800}
# Height of the titles above the body [mm].
HEAD_HEIGHT_MM = 12.0
# Height of scale, legend and time below the body [mm].
FOOT_HEIGHT_MM = 12.0
# Height of the headline, if there is one [mm].
HEADLINE_HEIGHT_MM = 5.0
# Width of the panel of marker errors beside the body [mm].
ERROR_PANEL_WIDTH_MM = 60.0
# Colour of the paths of measured markers.
MARKER_PATH_COLOUR = "#C4CBD4"
# Colours of the paths of a film.
PATH_COLOURS = (BLACK, BLUE)
# Frames of a film: more take minutes and hundreds of megabytes.
MAX_FILM_FRAMES = 3000
# Samples per second of a static experiment, whose recording may have taken a second or a day.
STATIC_SAMPLES_PER_SECOND = 8
# Default labels of the fitted and the simulated trajectory.
TRAJECTORY_NAMES = ("fitted", "simulated")


def animate(
    run: str | Path,
    file: str | Path | None = None,
    fps: float = 25.0,
    slowdown: float = 1.0,
    experiment: str | None = None,
) -> Path:
    """Film an experiment of a run folder, and return the film's file.

    The frames are reported to the counters of `counted_phase`.

    Parameters
    ----------
    file : str or Path, optional
        A file ending in .mp4, which needs ffmpeg, or .gif; by default <experiment>.gif in the run
        folder. An existing file is replaced at the end.
    fps : float
        Frames per second.
    slowdown : float
        How many times slower than the recording the film is.
    experiment : str, optional
        Name of the experiment; the first with a trajectory by default.

    Raises
    ------
    InputError
        If `run` is not a run folder or has no such experiment, for another kind of file, if ffmpeg
        is missing, if `fps` or `slowdown` is not above zero, if the film would have too many
        frames, and if the file cannot be written.
    """
    for name, value in (("--fps", fps), ("--slow", slowdown)):
        if not 0 < value < np.inf:
            raise InputError(f"found {value:g}; expected a number above 0", None, where=name)
    result, replays = read_run(run)
    replay = experiment_named(replays, experiment, run=run)
    with damaged_run_refused(Path(run)):
        text = run_headline(result)
    file = Path(file) if file is not None else Path(run) / f"{safe_name(replay.name)}.gif"
    if file.suffix.lower() not in PIXELS_WIDE:
        raise InputError(
            f"found '{file.suffix}'; expected {' or '.join(PIXELS_WIDE)}", file, where="--to"
        )
    return film(replay, file, fps=fps, slowdown=slowdown, headline=text)


@own_settings()
def film(
    replay: MotionRecord,
    file: Path,
    fps: float = 25.0,
    slowdown: float = 1.0,
    names: tuple[str, str] = TRAJECTORY_NAMES,
    headline: str = "",
    measured: str = "measured",
    paths_m: Mapping[str, Array] = MappingProxyType({}),
) -> Path:
    """Film one experiment and return the file; an existing file is replaced at the end.

    The frames are reported to the counters of `counted_phase`.

    Parameters
    ----------
    replay : MotionRecord
        Experiment with at least one trajectory, see `FilmFigure`.
    file : Path
        Ends in .mp4 or .gif; KeyError for another ending. Missing parent folders are made.
    fps, slowdown : float
        See `animate`; above zero, which is not checked. A static experiment is shown with
        `STATIC_SAMPLES_PER_SECOND` samples per second.
    names : (str, str)
        Labels of the fitted and of the simulated trajectory.
    headline : str
        Text above the body; empty for none.
    measured, paths_m
        See `FilmFigure`.

    Raises
    ------
    InputError
        If ffmpeg is missing for .mp4, the film would have too many frames, or the file cannot be
        written.
    """
    picture = FilmFigure(replay, names, headline, measured, paths_m)
    t_s = replay.t_s
    if replay.static:  # which may take a second or a day
        t_s = np.arange(len(t_s)) / STATIC_SAMPLES_PER_SECOND
    shown = film_samples(t_s, fps, slowdown=slowdown)
    ffmpeg = _find_ffmpeg(file) if file.suffix.lower() == ".mp4" else None
    dpi = PIXELS_WIDE[file.suffix.lower()] / (FILM_WIDTH_MM / 25.4)
    with rc_context({"animation.ffmpeg_path": ffmpeg} if ffmpeg else {}):
        writer = _frame_writer(fps, ffmpeg)
        with (
            replaced_file(file) as draft,
            _saving(writer, picture.figure, draft, dpi),
            counted_phase(StepUnit.FRAME, len(shown)),
        ):
            for t in shown:
                picture.show_sample(int(t))
                writer.grab_frame()
                complete_steps(StepUnit.FRAME)
    return file


def experiment_named(
    replays: Sequence[MotionRecord], experiment: str | None, run: str | Path | None = None
) -> MotionRecord:
    """Return the experiment called `experiment`, or the first one if that is None.

    Parameters
    ----------
    replays : sequence of MotionRecord
        Experiments, of which those without a finite trajectory do not count.
    run : str or Path, optional
        The run folder that errors name.

    Raises
    ------
    InputError
        If there is no experiment of that name with a trajectory, or none with a trajectory at all.
    """
    available = {replay.name: replay for replay in replays if replay.has_shapes()}
    if not available:
        raise InputError(
            "no experiment of this run has a stored motion of a body with a mesh; expected a run "
            "with such an experiment",
            run,
        )
    if experiment is None:
        return next(iter(available.values()))
    require_among(experiment, available, source=run, where=None if run is None else "--experiment")
    return available[experiment]


def film_samples(t_s: Array, fps: float, slowdown: float) -> NDArray[np.int64]:
    """Return the indices (k,) of the samples to show in a film's frames.

    The samples are taken as evenly spaced, and may be skipped or repeated. The last frame shows the
    last sample, or an earlier one by at most half the time between frames.

    Parameters
    ----------
    t_s : (T,)
        Times of the samples [s], ascending, at least one.
    fps : float
        Frames per second, above zero.
    slowdown : float
        How many times slower than the recording the film is; above zero.

    Raises
    ------
    InputError
        If the film would have more than `MAX_FILM_FRAMES` frames.
    """
    duration = float(t_s[-1] - t_s[0])
    count = round(duration * slowdown * fps) + 1
    if count > MAX_FILM_FRAMES:
        raise InputError(
            f"{duration:.3g} s, {slowdown:g} times slower, at {fps:g} frames a second make {count} "
            f"frames, more than {MAX_FILM_FRAMES}; lower --fps or --slow"
        )
    times_s = np.arange(count) / (slowdown * fps)
    share = times_s / max(duration, np.finfo(float).tiny)
    return np.minimum(np.rint(share * (len(t_s) - 1)), len(t_s) - 1).astype(np.int64)


class FilmFigure:
    """Figure that shows the samples of a film one after another.

    Parameters
    ----------
    replay : MotionRecord
        Experiment with at least one trajectory of nodes and markers; the first of these, the fitted
        one if there is one, must be finite at one sample at least.
    names : (str, str)
        Labels of the fitted and of the simulated trajectory.
    headline : str
        Text above the body; empty for none.
    measured : str
        Label of the measured markers.
    paths_m : mapping of name to (T, k, 3)
        Up to two sets of paths to draw, with dots where they are at the sample [m].

    Attributes
    ----------
    figure : Figure
        The figure, which `show_sample` changes in place.
    """

    figure: Figure

    def __init__(
        self,
        replay: MotionRecord,
        names: tuple[str, str] = TRAJECTORY_NAMES,
        headline: str = "",
        measured: str = "measured",
        paths_m: Mapping[str, Array] = MappingProxyType({}),
    ) -> None:
        self.replay = replay
        self.measured = measured
        trajectories = (
            (names[0], replay.positions_m, replay.markers_m),
            (names[1], replay.rolled_out_positions_m, replay.rolled_out_m),
        )
        shown = [(n, x, m) for n, x, m in trajectories if x is not None and m is not None]
        # A forward simulation that goes astray may leave the picture; fit and markers may not.
        surface_m = shown[0][1][:, np.unique(replay.surface)]
        is_finite = np.asarray(np.isfinite(surface_m).all(axis=(1, 2)))
        surface_m = surface_m[is_finite]
        camera = ParallelCamera.facing_motion(surface_m, replay.up)
        everything = _points_to_show_m(replay, surface_m, samples=is_finite)
        everything = np.vstack([everything, *(each.reshape(-1, 3) for each in paths_m.values())])
        compared = [
            (n, m)
            for n, _, m in shown
            if np.isfinite(m - replay.measured_m).any(axis=(1, 2)).sum() > 1
        ]
        width = FILM_WIDTH_MM - (ERROR_PANEL_WIDTH_MM if compared else 0.0)
        aspect = aspect_ratio(camera, everything)
        height = float(np.clip((width - 8) / aspect, MIN_BODY_HEIGHT_MM, MAX_BODY_HEIGHT_MM))
        head = HEAD_HEIGHT_MM + (HEADLINE_HEIGHT_MM if headline else 0.0)
        total = _with_even_pixels(head + height + FOOT_HEIGHT_MM)
        self.figure, axes = sheet(FILM_WIDTH_MM, total)
        self.figure.set_facecolor("white")
        axes.text(FILM_WIDTH_MM / 2, total - 3, headline, ha="center", va="top", fontsize=TEXT_PT)
        # Name, positions (T, n, 3), markers (T, M, 3), body and title of each trajectory.
        self.drawings: list[tuple[str, Array, Array, BodyDrawing, Text]] = []
        view = SheetView.fit_points(
            camera, everything, room_mm=(width - 8, height), corner_mm=(4, FOOT_HEIGHT_MM)
        )
        # Paths (T, k, 2) on the sheet and dots by name.
        self.paths = [
            self._draw_paths(axes, name, view.to_sheet_mm(own_m), colour)
            for (name, own_m), colour in zip(paths_m.items(), PATH_COLOURS, strict=False)
        ]
        self._draw_bodies(
            axes, view, trajectories=shown, top_mm=total - 3 - (head - HEAD_HEIGHT_MM)
        )
        self._draw_annotations(axes, camera, mm_per_m=view.mm_per_m)
        self.cursor = (
            self._draw_errors(compared, width, height_mm=height, figure_height_mm=total)
            if compared
            else None
        )
        self.time_label = axes.text(
            FILM_WIDTH_MM - 4, 4.0, "", ha="right", va="center", fontsize=TEXT_PT
        )

    def _draw_bodies(
        self,
        axes: Axes,
        view: SheetView,
        trajectories: Sequence[tuple[str, Array, Array]],
        top_mm: float,
    ) -> None:
        """Draw the paths of the measured markers, and add a body without shape yet and its title to
        `drawings` for each trajectory; the first body is shaded, further ones are wire frames.
        """
        replay = self.replay
        style: Any = {"color": MARKER_PATH_COLOUR, "lw": 0.6, "zorder": 0.2}
        if self.paths:  # which would hide them
            style = {"color": VERMILION, "lw": 1.2, "zorder": 3.6, "ls": (0, (3, 3))}
        for path_m in np.moveaxis(replay.measured_m, 1, 0):
            path_mm = view.to_sheet_mm(path_m)
            axes.plot(*path_mm.T, **style)
            if self.paths:
                alone = path_mm[is_alone(path_mm[:, 0])]
                axes.plot(*alone.T, **style | {"ls": "", "marker": "o", "ms": 7})
        for k, (name, positions, markers) in enumerate(trajectories):
            wire = GREEN if k else None
            title = axes.text(
                4 + k * FILM_WIDTH_MM / 4, top_mm, "", va="top", fontsize=TEXT_PT, zorder=6,
                color=wire or BLACK,
            )  # fmt: skip
            body = BodyDrawing(
                axes,
                view,
                surface=replay.surface,
                parts=replay.surface_parts,
                face_outlines=replay.face_outlines,
                edge_colour=wire,
            )
            self.drawings.append((name, positions, markers, body, title))

    @staticmethod
    def _draw_paths(axes: Axes, name: str, paths_mm: Array, colour: str) -> tuple[Array, Line2D]:
        for path_mm in np.moveaxis(paths_mm, 1, 0):
            axes.plot(*path_mm.T, color=colour, lw=0.8, zorder=3.5)
        style: Any = {"ls": "", "marker": "o", "ms": 4.5, "color": colour, "label": name}
        return paths_mm, axes.add_line(Line2D([], [], zorder=4.5, **style))

    def _draw_errors(
        self,
        trajectories: Sequence[tuple[str, Array]],
        left_mm: float,
        height_mm: float,
        figure_height_mm: float,
    ) -> Line2D:
        t_s = self.replay.t_s - self.replay.t_s[0]
        place = (
            left_mm + 12,
            FOOT_HEIGHT_MM + 9,
            ERROR_PANEL_WIDTH_MM - 16,
            min(height_mm - 12, 45.0),
        )
        panel = self.figure.add_axes(
            (
                place[0] / FILM_WIDTH_MM,
                place[1] / figure_height_mm,
                place[2] / FILM_WIDTH_MM,
                place[3] / figure_height_mm,
            )
        )
        for (name, markers), colour in zip(trajectories, (BLUE, GREEN), strict=False):
            squares = np.sum((markers - self.replay.measured_m) ** 2, axis=2)
            style = {"color": colour, "lw": LINE_PT, "ls": "-" if colour == BLUE else (0, (4, 2))}
            rms_mm = 1e3 * rms_over_markers(squares)
            panel.plot(t_s, rms_mm, label=name, **style)
            if (alone := is_alone(rms_mm)).any():
                panel.plot(t_s[alone], rms_mm[alone], color=colour, ls="", marker="o", ms=3)
        distance = f"distance from {self.measured}" if self.paths else "marker error"
        style_axes(panel, "", xlabel="time [s]", ylabel=f"{distance}, RMS [mm]")
        panel.set_xlim(t_s[0], t_s[-1])
        panel.set_ylim(bottom=0.0)
        add_legend_above(panel, columns=1)
        return panel.axvline(0.0, color=BLACK, lw=0.8)

    def _draw_annotations(self, axes: Axes, camera: ParallelCamera, mm_per_m: float) -> None:
        draw_directions(axes, camera, origin_mm=(7.0, 4.0))
        draw_scale(axes, mm_per_m, corner_mm=(FILM_WIDTH_MM * 0.17, 4.0))
        markers = [self.measured, "behind the body"] if len(self.replay.marker_names) else []
        markers = markers[:1] if self.paths else markers
        named = ["grasped", *markers]
        camera_points = LEGEND_ENTRY if self.replay.visible_points else ""
        handles = legend_handles(*named, camera_points=camera_points)
        handles += [dot for _, dot in self.paths]
        draw_legend(
            axes, handles, corner_mm=(FILM_WIDTH_MM * (0.42 if len(handles) < 4 else 0.35), 5.5)
        )

    def show_sample(self, sample: int) -> None:
        """Change the figure in place to the sample with index `sample`: bodies, markers, distances
        in the titles, time, and the line in the panel of errors.
        """
        replay = self.replay
        measured = replay.measured_m[sample]
        for name, positions_m, markers_m, body, title in self.drawings:
            outlines_m = None if replay.obstacles_m is None else replay.obstacles_m[sample]
            body.update(
                positions_m[sample],
                replay.is_prescribed[sample],
                markers_m=measured,
                outlines_m=outlines_m,
                camera_points_m=replay.camera_points_m(sample),
            )
            distances = np.linalg.norm(markers_m[sample] - measured, axis=1)
            present = distances[np.isfinite(distances)]
            is_compared = len(present) and markers_m is not replay.measured_m
            off = f": {1e3 * np.sqrt(np.mean(present**2)):.2f} mm" if is_compared else ""
            title.set_text(name + off)
        for path_mm, dot in self.paths:
            dot.set_data(*path_mm[sample].T)
        if self.cursor is not None:
            now_s = replay.t_s[sample] - replay.t_s[0]
            self.cursor.set_xdata([now_s, now_s])
        self.time_label.set_text(f"{replay.t_s[sample] - replay.t_s[0]:.2f} s")


@contextmanager
def _saving(writer: AbstractMovieWriter, figure: Figure, file: Path, dpi: float) -> Iterator[None]:
    """Context in which frames are grabbed; after an exception the film is not finished, which would
    replace the exception by another.
    """
    try:
        writer.setup(figure, str(file), dpi)
        yield
        writer.finish()
    except BaseException:
        if (process := getattr(writer, "_proc", None)) is not None:
            process.kill()
            process.communicate()
        raise


def _points_to_show_m(replay: MotionRecord, surface_m: Array, samples: NDArray[np.bool_]) -> Array:
    """Return all points (p, 3) [m] that a film has to show, NaN where missing."""
    outlines_m = replay.obstacles_m
    surroundings_m = with_nearby_outlines(
        surface_m, None if outlines_m is None else outlines_m[samples]
    )
    camera_points_m = [rows[np.isfinite(rows[:, 4]), 5:] for rows in replay.visible_points.values()]
    return np.vstack(
        [surroundings_m.reshape(-1, 3), replay.measured_m.reshape(-1, 3), *camera_points_m]
    )


def _with_even_pixels(height_mm: float) -> float:
    """Return the least height [mm] with an even number of pixels, as H.264 needs."""
    per_mm = PIXELS_WIDE[".mp4"] / FILM_WIDTH_MM
    return float(2 * np.ceil(height_mm * per_mm / 2) / per_mm)


def _frame_writer(fps: float, ffmpeg: str | None) -> AbstractMovieWriter:
    """Write GIF if `ffmpeg` is None, else H.264 by matplotlib's ``animation.ffmpeg_path``."""
    if ffmpeg is None:
        return PillowWriter(fps=fps)  # type: ignore[arg-type]
    # What every browser plays.
    return FFMpegWriter(
        fps=fps,  # type: ignore[arg-type]
        codec="h264",
        extra_args=["-pix_fmt", "yuv420p", "-crf", "18"],
    )


def _find_ffmpeg(file: Path) -> str:
    """Return the path of ffmpeg, of the system or else of imageio-ffmpeg."""
    if program := shutil.which("ffmpeg"):
        return program
    if find_spec("imageio_ffmpeg") is not None:
        from imageio_ffmpeg import get_ffmpeg_exe  # pyright: ignore[reportMissingImports]

        try:
            return get_ffmpeg_exe()
        except RuntimeError:
            pass
    raise InputError(
        "MP4 needs ffmpeg, which was not found: pip install 'collocation-sysid[film]', install "
        "ffmpeg, or choose a file ending in .gif",
        file,
        where="--to",
    )
