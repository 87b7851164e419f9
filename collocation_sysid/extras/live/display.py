"""Display of live estimates: bars in the terminal, and a film."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.figure import Figure

from ...common.array_types import Array
from ...common.display import Shown, Table, millimetres
from ...common.files import replaced_file
from ...common.step_counting import StepUnit, complete_steps, counted_phase
from ...errors import InputError
from ...fem.laws.constants import unit_of
from ...result.figure_style import (
    BLUE,
    ORANGE,
    new_figure,
    own_settings,
    style_axes,
    symbol_as_mathtext,
)
from ...result.run_sections import verdict_section
from .estimator import LiveUpdate

# Characters of increasing height.
BARS = "▁▂▃▄▅▆▇█"
# Number of passes whose estimates are shown as bars: half of a terminal's 80 columns.
COLUMNS = 40
# Largest number of reasons of the verdict: more do not fit below the estimates.
SHOWN_REASONS = 2
# Width of the film [mm].
WIDTH_MM = 160.0
# Height of a parameter's panel in the film [mm].
ROW_MM = 32.0
# Resolution of the film [pixels per inch], which makes it 630 pixels wide.
DPI = 100
# Frame rate of the film [1/s], as of cinema.
FRAMES_A_SECOND = 25


def sparkline(values: Sequence[float], columns: int = COLUMNS) -> str:
    """Return the last values as a line of bars, on a logarithmic scale if all of them are positive.

    The smallest of these values has the lowest bar, the largest the highest. Equal values, or any
    NaN among them, give bars of middle height; no values, an empty text.
    """
    last = np.array(values[-columns:], dtype=float)
    if not len(last):
        return ""
    shown = np.log(last) if (last > 0).all() else last
    low = float(shown.min())
    high = float(shown.max())
    share = (shown - low) / (high - low) if high > low else np.full(len(shown), 0.5)
    return "".join(BARS[round(s * (len(BARS) - 1))] for s in share)


def display_of(updates: Sequence[LiveUpdate]) -> list[Shown]:
    """Return the display of the last of some updates: a line of text, a table of the estimates with
    their history as bars, and the verdict with up to `SHOWN_REASONS` reasons.

    Unknown standard errors are empty.

    Parameters
    ----------
    updates : sequence of LiveUpdate
        At least one update, in order of time, all with the same parameters; the last `COLUMNS` are
        the history.
    """
    last = updates[-1]
    error_text = f"marker error {millimetres(last.marker_rms_m)}"
    if np.isfinite(last.pixel_rms) and not np.isfinite(last.marker_rms_m):
        error_text = f"pixel error {last.pixel_rms:.2g} px"
    rows = []
    for name, estimate in last.estimates.items():
        error = (
            ""
            if estimate.statistical_std_error is None
            else f"{estimate.statistical_std_error:.2g}"
        )
        history = sparkline([update.estimates[name].value for update in updates[-COLUMNS:]])
        rows.append((name, f"{estimate.value:.5g}", error, unit_of(name), history))
    return [
        f"t = {last.t_s:.2f} s   {error_text} RMS   latency {1e3 * last.latency_s:.1f} ms",
        Table("", ("", "estimate", "±", "unit", "history"), rows=tuple(rows), names=5),
        verdict_section(last.trust, max_reasons=SHOWN_REASONS),
    ]


def final_display(updates: Sequence[LiveUpdate], settled: LiveUpdate) -> list[Shown]:
    """Return the display of the final estimate, as by `display_of`, and a line with the median and
    99 % quantile of the latency of the frames.

    Parameters
    ----------
    updates : sequence of LiveUpdate
        Updates of the frames, at least one, in order of time.
    settled : LiveUpdate
        Result of `LiveEstimator.finish`, with the same parameters.
    """
    took_ms = 1e3 * np.array([update.latency_s for update in updates])
    median, late = np.percentile(took_ms, [50, 99])
    latency_text = (
        f"{len(updates)} frames, latency {median:.1f} ms (median), {late:.1f} ms (99 % quantile); "
    )
    latency_text += f"final estimate {1e3 * settled.latency_s:.0f} ms after the last frame"
    return [*display_of([*updates, settled]), latency_text]


def require_gif(file: Path) -> None:
    """Raise an `InputError` unless the file's name ends in .gif, in any case of letters."""
    if file.suffix.lower() != ".gif":
        raise InputError(f"found '{file.suffix}'; expected .gif", file, where="--film")


@own_settings()
def write_film(updates: Sequence[LiveUpdate], file: str | Path) -> Path:
    """Write the estimates with their statistical intervals as a growing plot in a GIF.

    The film runs in real time, at most `FRAMES_A_SECOND`; an existing file is replaced, and missing
    folders are made.

    Parameters
    ----------
    updates : sequence of LiveUpdate
        At least one update, in order of time, all with the same parameters.

    Returns
    -------
    Path
        Path of the file.

    Raises
    ------
    InputError
        If the name of the file does not end in .gif, or it cannot be written.
    """
    path = Path(file)
    require_gif(path)
    t_s = np.array([update.t_s for update in updates])
    names = list(updates[-1].estimates)
    figure = new_figure(WIDTH_MM, ROW_MM * len(names))
    lines = [
        _draw_parameter(figure, k, count=len(names), name=name, t_s=t_s, updates=updates)
        for k, name in enumerate(names)
    ]
    step = max(1, round(len(t_s) / max(1.0, (t_s[-1] - t_s[0]) * FRAMES_A_SECOND)))
    writer = PillowWriter(fps=FRAMES_A_SECOND)
    stops = [*range(1, len(t_s), step), len(t_s)]
    with (
        replaced_file(path) as draft,
        writer.saving(figure, str(draft), DPI),
        counted_phase(StepUnit.FRAME, len(stops)),
    ):
        for stop in stops:
            for line, values in lines:
                for part, each in zip(line, values, strict=True):
                    part.set_data(t_s[:stop], each[:stop])
            writer.grab_frame()
            complete_steps(StepUnit.FRAME)
    return path


def _draw_parameter(
    figure: Figure, k: int, count: int, name: str, t_s: Array, updates: Sequence[LiveUpdate]
) -> tuple[list, list[Array]]:
    """Add the axes of a parameter to a figure; return the three lines of its value and of the ends
    of its interval, without data yet, and their data (T,), NaN for ends that are unknown.
    """
    estimates = [update.estimates[name] for update in updates]
    value = np.array([each.value for each in estimates])
    ends = np.array([each.statistical95 or (np.nan, np.nan) for each in estimates])
    axes = figure.add_subplot(count, 1, k + 1)
    # Intervals of the beginning would leave no room for those of the end.
    later_values = value[len(value) // 4 :]
    low = later_values.min()
    high = later_values.max()
    later_intervals = ends[len(ends) // 2 :]
    if np.isfinite(later_intervals).any():
        low = min(low, np.nanmin(later_intervals))
        high = max(high, np.nanmax(later_intervals))
    margin = 0.1 * (high - low) or 0.1 * abs(high) or 1.0
    axes.set_xlim(t_s[0], max(t_s[-1], t_s[0] + 1e-9))
    axes.set_ylim(low - margin, high + margin)
    unit = unit_of(name)
    label = symbol_as_mathtext(name) + (f" [{unit}]" if unit else "")
    style_axes(axes, "", xlabel="t [s]" if k == count - 1 else "", ylabel=label)
    styles = ((BLUE, "-"), (ORANGE, "--"), (ORANGE, "--"))
    lines = [axes.plot([], [], style, color=colour)[0] for colour, style in styles]
    return lines, [value, ends[:, 0], ends[:, 1]]
