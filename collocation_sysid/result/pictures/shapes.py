"""The body's shapes over time with the measured markers, in colours of its parts or of a field."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ...arrays import Array
from ...errors import InputError, hint_at
from ...fem.body import Body
from ..fields import ElementFields
from ..replay import Replay
from ..style import PAGE_MM, SMALL_PT
from .camera import Camera
from .scene import Drawn, View, draw_directions, draw_key, draw_scale, key, sheet

SHOWN = 6
HEAD_MM, FOOT_MM, CORNER_MM = 5.0, 5.0, 14.0
TALLEST_MM, GAP_MM = 60.0, 4.0
BAR_MM, BAR_ROOM_MM = 2.5, 20.0
# From pale to dark, on which markers and grasped nodes stand out; its darkest fifth is left out.
COLOURS = ListedColormap(colormaps["YlGnBu"](np.linspace(0.0, 0.8, 256)))


@dataclass(frozen=True, eq=False)
class Coloured:
    """What colours a body.

    Attributes
    ----------
    title : str, with its unit
    at : callable
        Its values (k, F) on the triangles of the surface at positions (k, n, 3).
    """

    title: str
    at: Callable[[Array], Array]


def shapes(seen: Replay, count: int = SHOWN, field: Coloured | None = None) -> Figure:
    """Draw `count` of the body's shapes at evenly spaced samples, side by side in one scale.

    Heights are true; sideways the shapes are moved together. Samples of a simulation that went
    astray, which are not finite, are left out. A field colours the body instead of its parts.
    """
    t_s, positions_m, measured_m = seen.t_s, seen.shapes_m, seen.measured_m
    assert positions_m is not None  # it was chosen among those that have some
    there = np.flatnonzero(np.isfinite(positions_m).all(axis=(1, 2)))
    shown = there[np.unique(np.linspace(0, len(there) - 1, count).astype(int))]
    outer = positions_m[:, np.unique(seen.surface)]
    camera = Camera.facing(outer[there], seen.up)
    places = camera.project(np.concatenate([outer[shown], measured_m[shown]], axis=1))
    left, right = np.nanmin(places[..., 0], axis=1), np.nanmax(places[..., 0], axis=1)
    low, high = float(np.nanmin(places[..., 1])), float(np.nanmax(places[..., 1]))
    width = PAGE_MM - CORNER_MM - (BAR_ROOM_MM if field else 0.0)
    room = width - len(shown) * GAP_MM
    scale = min(room / float((right - left).sum()), TALLEST_MM / (high - low))
    gap = GAP_MM + (room - scale * float((right - left).sum())) / len(shown)
    total = HEAD_MM + scale * (high - low) + FOOT_MM
    figure, axes = sheet(PAGE_MM, total)
    skins = [None] * len(shown) if field is None else _coloured(axes, field, positions_m[shown])
    start = CORNER_MM + (gap - GAP_MM) / 2
    for t, first, last, skin in zip(shown, left, right, skins, strict=True):
        view = View(camera, scale, np.array([start - scale * first, FOOT_MM - scale * low]))
        body = Drawn(axes, view, seen.surface, seen.surface_parts, seen.surface_nodes)
        outlines_m = None if seen.obstacles_m is None else seen.obstacles_m[t]
        body.show(positions_m[t], seen.held[t], measured_m[t], skin, outlines_m)
        text = {"ha": "center", "va": "center", "fontsize": SMALL_PT}
        middle = start + scale * (last - first) / 2
        axes.text(middle, FOOT_MM / 2, f"{t_s[t] - t_s[0]:.3g} s", **text)
        start += scale * (last - first) + gap
    draw_directions(axes, camera, (6.0, FOOT_MM + 3.0))
    draw_scale(axes, scale, (2.0, total - 2.5))
    marks = ("measured", "behind the body") if np.isfinite(measured_m).any() else ()
    draw_key(axes, key("grasped", *marks), (PAGE_MM * 0.3, total - 1.0))
    return figure


def _coloured(axes: Axes, field: Coloured, positions_m: Array) -> Array:
    """Colours (k, F, 3) of the triangles at positions (k, n, 3), with their bar on the sheet."""
    values = field.at(positions_m)
    low, high = np.nanmin(values), np.nanmax(values)
    scale = ScalarMappable(Normalize(0.0 if 0 <= low < high / 5 else low, high), COLOURS)
    height = axes.get_ylim()[1]
    place = (PAGE_MM - BAR_ROOM_MM + 2, FOOT_MM, BAR_MM, height - HEAD_MM - FOOT_MM)
    beside = axes.inset_axes(place, transform=axes.transData)
    bar = axes.figure.colorbar(scale, cax=beside, ticks=MaxNLocator(4))
    bar.outline.set_linewidth(0.4)
    bar.ax.tick_params(labelsize=SMALL_PT, width=0.4, length=2, pad=1.5)
    end = {"ha": "right", "va": "top", "fontsize": SMALL_PT}
    axes.text(PAGE_MM - 1, height - 1.0, field.title, **end)
    return scale.to_rgba(values)[..., :3]


FIELDS = {
    "von_mises_pa": "von Mises stress [Pa]",
    "energy_density_j_m3": "elastic energy [J/m³]",
    "det_f": "volume over undeformed, det F",
}
# More would be too small to tell anything.
MOST_SHAPES = 20


def portrait(
    replay: Replay, body: Body, constants: Mapping[str, float], field: str | None, count: int
) -> Figure:
    """Draw `count` of the replay's shapes, coloured by a field of its elements; see `FIELDS`.

    Without a field the parts of the body have colours of their own.

    Raises
    ------
    InputError
        For an unknown field, or for no shapes or too many.
    """
    if not 1 <= count <= MOST_SHAPES:
        raise InputError(f"count is {count}; expected 1 to {MOST_SHAPES} shapes")
    if field is not None and field not in FIELDS:
        expected = f"expected one of {', '.join(FIELDS)}{hint_at(field, list(FIELDS))}"
        raise InputError(f"no field {field!r}; {expected}")
    return shapes(replay, count, None if field is None else _on_surface(body, constants, field))


def _on_surface(body: Body, constants: Mapping[str, float], field: str) -> Coloured:
    elements, cells = ElementFields.of(body, body.theta(constants)), body.mesh.surface_cells

    def at(positions_m: Array) -> Array:
        return elements.at(positions_m)[field][:, cells]

    return Coloured(FIELDS[field], at)
