"""Live estimates to look at: a plot in the terminal, and a film."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.figure import Figure

from ..arrays import Array
from ..display import Shown, Table, millimetres
from ..errors import InputError
from ..fem.constants import unit_of
from ..files import whole_file
from ..result.run_sections import verdict_of
from ..result.style import BLUE, ORANGE, dress, mathematical, new_figure
from .estimator import Update

BARS = "▁▂▃▄▅▆▇█"
COLUMNS, SHOWN_REASONS = 40, 2
WIDTH_MM, ROW_MM, DPI, FRAMES_A_SECOND = 160.0, 32.0, 100, 25


def bars(values: Sequence[float], columns: int = COLUMNS) -> str:
    """The last values as a line of bars, on a logarithmic scale where all are positive."""
    last = np.array(values[-columns:], dtype=float)
    if not len(last):
        return ""
    shown = np.log(last) if (last > 0).all() else last
    low, high = float(shown.min()), float(shown.max())
    share = (shown - low) / (high - low) if high > low else np.full(len(shown), 0.5)
    return "".join(BARS[round(s * (len(BARS) - 1))] for s in share)


def picture(updates: Sequence[Update]) -> list[Shown]:
    """What the last update knows, with the way there."""
    last = updates[-1]
    rows = []
    for name, estimate in last.estimates.items():
        error = (
            ""
            if estimate.statistical_std_error is None
            else f"{estimate.statistical_std_error:.2g}"
        )
        way = bars([update.estimates[name].value for update in updates[-COLUMNS:]])
        rows.append((name, f"{estimate.value:.5g}", error, unit_of(name), way))
    return [
        f"t = {last.t_s:.2f} s   markers missed by {millimetres(last.marker_rms_m)}   "
        f"{1e3 * last.latency_s:.1f} ms",
        Table("", ("", "estimate", "±", "unit", "so far"), tuple(rows), names=5),
        verdict_of(last.trust, most=SHOWN_REASONS),
    ]


def summary(updates: Sequence[Update], settled: Update) -> list[Shown]:
    """What the estimate has settled at, and how long frames took."""
    took_ms = 1e3 * np.array([update.latency_s for update in updates])
    median, late = np.percentile(took_ms, [50, 99])
    said = f"{len(updates)} frames, latency {median:.1f} ms in the median, {late:.1f} ms at 99 %; "
    said += f"settled {1e3 * settled.latency_s:.0f} ms after the last"
    return [*picture([*updates, settled]), said]


def require_film(file: Path) -> None:
    """Refuse files that are no GIF, as an `InputError`."""
    if file.suffix.lower() != ".gif":
        raise InputError(f"found '{file.suffix}'; expected .gif", file, "--film")


def film(updates: Sequence[Update], file: str | Path) -> Path:
    """Write the estimates with their intervals, growing as they grew, as a GIF.

    Raises
    ------
    InputError
        For another kind of file.
    """
    to = Path(file)
    require_film(to)
    t_s = np.array([update.t_s for update in updates])
    names = list(updates[-1].estimates)
    figure = new_figure(WIDTH_MM, ROW_MM * len(names))
    lines = [_drawn(figure, k, len(names), name, t_s, updates) for k, name in enumerate(names)]
    step = max(1, round(len(t_s) / max(1.0, (t_s[-1] - t_s[0]) * FRAMES_A_SECOND)))
    writer = PillowWriter(fps=FRAMES_A_SECOND)
    with whole_file(to) as draft, writer.saving(figure, str(draft), DPI):
        for stop in [*range(1, len(t_s), step), len(t_s)]:
            for line, values in lines:
                for part, each in zip(line, values, strict=True):
                    part.set_data(t_s[:stop], each[:stop])
            writer.grab_frame()
    return to


def _drawn(
    figure: Figure, k: int, count: int, name: str, t_s: Array, updates: Sequence[Update]
) -> tuple[list, list[Array]]:
    """Lines of a parameter's value and interval, empty yet, and what they will show."""
    found = [update.estimates[name] for update in updates]
    value = np.array([each.value for each in found])
    ends = np.array([each.statistical95 or (np.nan, np.nan) for each in found])
    axes = figure.add_subplot(count, 1, k + 1)
    # Intervals of the beginning would leave no room for those of the end.
    near = value[len(value) // 4 :]
    low, high = near.min(), near.max()
    late = ends[len(ends) // 2 :]
    if np.isfinite(late).any():
        low, high = min(low, np.nanmin(late)), max(high, np.nanmax(late))
    room = 0.1 * (high - low) or 0.1 * abs(high) or 1.0
    axes.set_xlim(t_s[0], max(t_s[-1], t_s[0] + 1e-9))
    axes.set_ylim(low - room, high + room)
    unit = unit_of(name)
    label = mathematical(name) + (f" [{unit}]" if unit else "")
    dress(axes, "", "t [s]" if k == count - 1 else "", label)
    styles = ((BLUE, "-"), (ORANGE, "--"), (ORANGE, "--"))
    lines = [axes.plot([], [], style, color=colour)[0] for colour, style in styles]
    return lines, [value, ends[:, 0], ends[:, 1]]
