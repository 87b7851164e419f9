"""Film of a run: the fitted body, the edges of its forward simulation over it, and the markers.

Beside the body a panel shows the distance of the markers from their measurements over time.
`animate`
works from a run folder, `write_film` from a `Replay`.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from ..array_types import Array
from ..errors import InputError, require_among
from ..files import safe_name, whole_file
from .figure_style import BLACK, BLUE, GREEN, LINE_PT, TEXT_PT, dress, legend_above
from .pictures.over_time import rms_over_markers
from .pictures.projection import Camera
from .pictures.scene import (
    Drawn,
    View,
    draw_directions,
    draw_key,
    draw_scale,
    key,
    sheet,
    width_over_height,
    with_outlines,
)
from .replay import Replay, headline, read_run, reading_run

WIDTH_MM = 160.0
TALLEST_MM = 110.0
LOWEST_MM = 30.0
# Width of a film in pixels, even for H.264 (see `_stiffening_of_interval`); smaller for GIF, which
# compresses badly.
PIXELS_WIDE = {".mp4": 1280, ".gif": 800}
HEAD_MM = 12.0
FOOT_MM = 12.0
LINE_MM = 5.0
# Width of the panel of marker errors beside the body.
ERRORS_MM = 60.0
# Colour of the paths of measured markers.
PATH = "#C4CBD4"
# Frames of a film: more take minutes and hundreds of megabytes.
MOST_FRAMES = 3000
# Samples per second of a static experiment, whose recording may have taken a second or a day.
STATES_A_SECOND = 8
NAMES = ("fitted", "simulated")

Progress = Callable[[float], None]


def animate(
    run: str | Path,
    to: str | Path | None = None,
    fps: float = 25.0,
    slow: float = 1.0,
    experiment: str | None = None,
    progress: Progress | None = None,
) -> Path:
    """Film an experiment of a run folder, and return the film's file.

    Parameters
    ----------
    run : str or Path
        A run folder.
    to : str or Path, optional
        A file ending in .mp4, which needs ffmpeg, or .gif; by default <experiment>.gif in the run
        folder.
    fps : float
        Frames per second.
    slow : float
        How many times slower than the recording the film is.
    experiment : str, optional
        Name of the experiment; the first by default.
    progress : callable, optional
        Called with the share of frames written, from 0 to 1.

    Raises
    ------
    InputError
        If `run` is not a run folder or has no such experiment, for another kind of file, if ffmpeg
        is
        missing, and for numbers out of range.
    """
    for name, value in (("--fps", fps), ("--slow", slow)):
        if not 0 < value < np.inf:
            raise InputError(f"found {value:g}; expected a number above 0", None, name)
    result, replays = read_run(run)
    replay = chosen(replays, experiment, run)
    with reading_run(Path(run)):
        text = headline(result)
    file = Path(to) if to is not None else Path(run) / f"{safe_name(replay.name)}.gif"
    if file.suffix.lower() not in PIXELS_WIDE:
        raise InputError(
            f"found '{file.suffix}'; expected {' or '.join(PIXELS_WIDE)}", file, "--to"
        )
    return film(replay, file, fps, slow, progress, headline=text)


def film(
    replay: Replay,
    file: Path,
    fps: float = 25.0,
    slow: float = 1.0,
    progress: Progress | None = None,
    names: tuple[str, str] = NAMES,
    headline: str = "",
) -> Path:
    """Film one experiment and return the file.

    Parameters
    ----------
    replay : Replay
        Experiment with at least one trajectory.
    file : Path
        Ends in .mp4 or .gif.
    fps, slow, progress
        See `animate`. A static experiment is shown with `STATES_A_SECOND` samples per second.
    names : (str, str)
        Labels of the fitted and of the simulated trajectory.
    headline : str
        Text above the body.
    """
    picture = Film(replay, names, headline)
    t_s = replay.t_s
    if replay.static:  # which may take a second or a day
        t_s = np.arange(len(t_s)) / STATES_A_SECOND
    shown = film_samples(t_s, fps, slow)
    ffmpeg = _ffmpeg(file) if file.suffix.lower() == ".mp4" else None
    dpi = PIXELS_WIDE[file.suffix.lower()] / (WIDTH_MM / 25.4)
    with rc_context({"animation.ffmpeg_path": ffmpeg} if ffmpeg else {}):
        writer = _writer(fps, ffmpeg)
        with whole_file(file) as draft, writer.saving(picture.figure, str(draft), dpi):
            for number, t in enumerate(shown):
                picture.show(int(t))
                writer.grab_frame()
                if progress is not None:
                    progress((number + 1) / len(shown))
    return file


def chosen(
    replays: Sequence[Replay], experiment: str | None, run: str | Path | None = None
) -> Replay:
    """Return the experiment called `experiment`, or the first one if that is None.

    Experiments without a trajectory do not count. `run` is the run folder that errors name.

    Raises
    ------
    InputError
        If there is no experiment of that name, or none with a trajectory.
    """
    available = {replay.name: replay for replay in replays if replay.has_shapes}
    if not available:
        raise InputError("no experiment of this run has a trajectory", run)
    if experiment is None:
        return next(iter(available.values()))
    require_among(experiment, available, run, None if run is None else "--experiment")
    return available[experiment]


def film_samples(t_s: Array, fps: float, slow: float) -> NDArray[np.int64]:
    """Return the indices (k,) of the samples nearest to the times of a film's frames.

    Parameters
    ----------
    t_s : (T,)
        Times of the samples.
    fps : float
        Frames per second.
    slow : float
        How many times slower than the recording the film is.

    Raises
    ------
    InputError
        If the film would have more than `MOST_FRAMES` frames.
    """
    duration = float(t_s[-1] - t_s[0])
    count = round(duration * slow * fps) + 1
    if count > MOST_FRAMES:
        raise InputError(
            f"{duration:.3g} s, {slow:g} times slower, at {fps:g} frames a second make {count} "
            f"frames, more than {MOST_FRAMES}; lower --fps or --slow"
        )
    times_s = np.arange(count) / (slow * fps)
    share = times_s / max(duration, np.finfo(float).tiny)
    return np.minimum(np.rint(share * (len(t_s) - 1)), len(t_s) - 1).astype(np.int64)


class Film:
    """Figure that shows the samples of a film one after another.

    Attributes
    ----------
    figure : Figure
    """

    figure: Figure

    def __init__(self, replay: Replay, names: tuple[str, str] = NAMES, headline: str = "") -> None:
        self.replay = replay
        trajectories = (
            (names[0], replay.positions_m, replay.markers_m),
            (names[1], replay.rolled_out_positions_m, replay.rolled_out_m),
        )
        shown = [(n, x, m) for n, x, m in trajectories if x is not None and m is not None]
        # A forward simulation that goes astray may leave the picture; fit and markers may not.
        surface_m = shown[0][1][:, np.unique(replay.surface)]
        is_finite = np.isfinite(surface_m).all(axis=(1, 2))
        surface_m = surface_m[is_finite]
        outlines_m = replay.obstacles_m
        camera = Camera.facing(surface_m, replay.up)
        surroundings_m = with_outlines(
            surface_m, None if outlines_m is None else outlines_m[is_finite]
        )
        depth_points_m = [rows[np.isfinite(rows[:, 4]), 5:] for rows in replay.seen.values()]
        everything = np.vstack(
            [surroundings_m.reshape(-1, 3), replay.measured_m.reshape(-1, 3), *depth_points_m]
        )
        compared = [
            (n, m) for n, _, m in shown if m.size and np.isfinite(m - replay.measured_m).any()
        ]
        width = WIDTH_MM - (ERRORS_MM if compared else 0.0)
        aspect = width_over_height(camera, everything)
        height = float(np.clip((width - 8) / aspect, LOWEST_MM, TALLEST_MM))
        head = HEAD_MM + (LINE_MM if headline else 0.0)
        total = _even(head + height + FOOT_MM)
        self.figure, axes = sheet(WIDTH_MM, total)
        self.figure.set_facecolor("white")
        axes.text(WIDTH_MM / 2, total - 3, headline, ha="center", va="top", fontsize=TEXT_PT)
        self.panels = []
        view = View.fitting(camera, everything, (width - 8, height), (4, FOOT_MM))
        for path_m in np.moveaxis(replay.measured_m, 1, 0):
            axes.plot(*view.places(path_m).T, color=PATH, lw=0.6, zorder=0.2)
        for k, (name, positions, markers) in enumerate(shown):
            top = total - 3 - (head - HEAD_MM)
            wire = GREEN if k else None
            title = axes.text(
                4 + k * WIDTH_MM / 4, top, "", va="top", fontsize=TEXT_PT, zorder=6,
                color=wire or BLACK,
            )  # fmt: skip
            body = Drawn(
                axes,
                view,
                replay.surface,
                parts=replay.surface_parts,
                nodes=replay.surface_nodes,
                wire=wire,
            )
            self.panels.append((name, positions, markers, body, title))
        self._surround(axes, camera, view.mm_per_m, total)
        self.cursor = self._draw_errors(compared, width, height, total) if compared else None
        self.clock = axes.text(WIDTH_MM - 4, 4.0, "", ha="right", va="center", fontsize=TEXT_PT)

    def _draw_errors(
        self, compared: Sequence[tuple[str, Array]], left_mm: float, height_mm: float, total: float
    ) -> Line2D:
        """Draw the panel of marker errors over time, and return the vertical line that marks the
        current time.

        Parameters
        ----------
        compared : sequence of (str, (T, M, 3))
            Label and marker positions [m] of each trajectory.
        left_mm, height_mm, total : float
            Left edge of the panel, height of the body's picture, and height of the figure [mm].
        """
        t_s = self.replay.t_s - self.replay.t_s[0]
        place = left_mm + 12, FOOT_MM + 9, ERRORS_MM - 16, min(height_mm - 12, 45.0)
        panel = self.figure.add_axes(
            (place[0] / WIDTH_MM, place[1] / total, place[2] / WIDTH_MM, place[3] / total)
        )
        for (name, markers), colour in zip(compared, (BLUE, GREEN), strict=False):
            squares = np.sum((markers - self.replay.measured_m) ** 2, axis=2)
            style = {"color": colour, "lw": LINE_PT, "ls": "-" if colour == BLUE else (0, (4, 2))}
            panel.plot(t_s, 1e3 * rms_over_markers(squares), label=name, **style)
        dress(panel, "", "time [s]", "markers, RMS [mm]")
        panel.set_ylim(bottom=0.0)
        legend_above(panel, columns=1)
        return panel.axvline(0.0, color=BLACK, lw=0.8)

    def _surround(self, axes: Axes, camera: Camera, mm_per_m: float, total: float) -> None:
        """Draw the axis directions, the scale bar and the legend around the body."""
        draw_directions(axes, camera, (7.0, 4.0))
        draw_scale(axes, mm_per_m, (WIDTH_MM * 0.17, 4.0))
        named = ["grasped", "measured", "behind the body"]
        if self.replay.seen:
            markers = named[1:] if len(self.replay.marker_names) else []
            named = ["grasped", *markers, "seen in depth"]
        draw_key(axes, key(*named), (WIDTH_MM * (0.42 if len(named) < 4 else 0.35), 5.5))

    def show(self, t: int) -> None:
        """Show the sample with index `t`."""
        replay = self.replay
        measured = replay.measured_m[t]
        for name, positions, markers, drawn, title in self.panels:
            outlines_m = None if replay.obstacles_m is None else replay.obstacles_m[t]
            drawn.show(positions[t], replay.held[t], measured, None, outlines_m, replay.seen_m(t))
            distances = np.linalg.norm(markers[t] - measured, axis=1)
            present = distances[np.isfinite(distances)]
            off = f"{1e3 * np.sqrt(np.mean(present**2)):.2f} mm" if len(present) else "no markers"
            title.set_text(name if markers is replay.measured_m else f"{name}: {off}")
        if self.cursor is not None:
            now_s = replay.t_s[t] - replay.t_s[0]
            self.cursor.set_xdata([now_s, now_s])
        self.clock.set_text(f"{replay.t_s[t] - replay.t_s[0]:.2f} s")


def _even(height_mm: float) -> float:
    """Return the next larger height [mm] that is an even number of pixels in a film, as H.264
    needs.
    """
    per_mm = PIXELS_WIDE[".mp4"] / WIDTH_MM
    return float(2 * np.ceil(height_mm * per_mm / 2) / per_mm)


def _writer(fps: float, ffmpeg: str | None) -> AbstractMovieWriter:
    """Return the writer of frames: for GIF if `ffmpeg` is None, else for H.264 by that program."""
    if ffmpeg is None:
        return PillowWriter(fps=fps)  # type: ignore[arg-type]
    # What every browser plays.
    return FFMpegWriter(fps=fps, codec="h264", extra_args=["-pix_fmt", "yuv420p", "-crf", "18"])  # type: ignore[arg-type]


def _ffmpeg(file: Path) -> str:
    """Return the path of ffmpeg, of the system or else of imageio-ffmpeg.

    Raises
    ------
    InputError
        Naming the film's `file`, if neither is installed.
    """
    if program := shutil.which("ffmpeg"):
        return program
    if find_spec("imageio_ffmpeg") is not None:
        from imageio_ffmpeg import get_ffmpeg_exe  # pyright: ignore[reportMissingImports]

        try:
            return get_ffmpeg_exe()
        except RuntimeError:
            pass
    raise InputError(
        "MP4 needs ffmpeg, which is not there: pip install 'collocation-sysid[film]', install "
        "ffmpeg, or choose a file ending in .gif",
        file,
        "--to",
    )
