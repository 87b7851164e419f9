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

from ...arrays import Array, Index
from ...errors import InputError, hint_at
from ...fem.body import Body
from ..fields import ElementFields
from ..replay import Replay
from ..style import PAGE_MM, SMALL_PT
from .camera import ELEVATION_DEG, Camera
from .scene import Drawn, View, draw_directions, draw_key, draw_scale, key, sheet, with_outlines

SHOWN = 6
HEAD_MM, FOOT_MM, CORNER_MM = 5.0, 5.0, 14.0
TALLEST_MM, GAP_MM = 60.0, 4.0
BAR_MM, BAR_ROOM_MM = 2.5, 20.0
# From pale to dark, on which markers and grasped nodes stand out; its darkest fifth is left out.
COLOURS = ListedColormap(colormaps["YlGnBu"](np.linspace(0.0, 0.8, 256))).with_extremes(bad="0.85")


@dataclass(frozen=True, eq=False)
class Coloured:
    """What colours a body.

    Attributes
    ----------
    title : str, with its unit
    at : callable
        Its values (k, F) on the triangles of the surface at samples (k,).
    """

    title: str
    at: Callable[[Index], Array]


def shapes(
    seen: Replay, count: int = SHOWN, field: Coloured | None = None, camera: Camera | None = None
) -> Figure:
    """Draw `count` of the body's shapes at evenly spaced samples, side by side in one scale.

    Heights are true; sideways the shapes are moved together. Samples of a simulation that went
    astray, which are not finite, are left out. A field colours the body instead of its parts.
    """
    t_s, positions_m, measured_m = seen.t_s, seen.shapes_m, seen.measured_m
    assert positions_m is not None  # it was chosen among those that have some
    there = np.flatnonzero(np.isfinite(positions_m).all(axis=(1, 2)))
    shown = there[np.unique(np.linspace(0, len(there) - 1, count).astype(int))]
    outer = positions_m[:, np.unique(seen.surface)]
    camera = camera or Camera.facing(outer[there], seen.up)
    outlines_m = None if seen.obstacles_m is None else seen.obstacles_m[shown]
    beside = with_outlines(np.concatenate([outer[shown], measured_m[shown]], axis=1), outlines_m)
    places = camera.project(beside)
    left, right = np.nanmin(places[..., 0], axis=1), np.nanmax(places[..., 0], axis=1)
    low, high = float(np.nanmin(places[..., 1])), float(np.nanmax(places[..., 1]))
    width = PAGE_MM - CORNER_MM - (BAR_ROOM_MM if field else 0.0)
    room = width - len(shown) * GAP_MM
    scale = min(room / float((right - left).sum()), TALLEST_MM / (high - low))
    gap = GAP_MM + (room - scale * float((right - left).sum())) / len(shown)
    total = HEAD_MM + scale * (high - low) + FOOT_MM
    figure, axes = sheet(PAGE_MM, total)
    skins = [None] * len(shown) if field is None else _coloured(axes, field, shown)
    start = CORNER_MM + (gap - GAP_MM) / 2
    for t, first, last, skin in zip(shown, left, right, skins, strict=True):
        view = View(camera, scale, np.array([start - scale * first, FOOT_MM - scale * low]))
        body = Drawn(axes, view, seen.surface, seen.surface_parts, seen.surface_nodes)
        around = None if seen.obstacles_m is None else seen.obstacles_m[t]
        body.show(positions_m[t], seen.held[t], measured_m[t], skin, around)
        text = {"ha": "center", "va": "center", "fontsize": SMALL_PT}
        middle = start + scale * (last - first) / 2
        axes.text(middle, FOOT_MM / 2, f"{t_s[t] - t_s[0]:.3g} s", **text)
        start += scale * (last - first) + gap
    draw_directions(axes, camera, (7.5, FOOT_MM + 3.0))
    draw_scale(axes, scale, (2.0, total - 2.5))
    marks = ("measured", "behind the body") if np.isfinite(measured_m).any() else ()
    draw_key(axes, key("grasped", *marks), (PAGE_MM * 0.3, total - 1.0))
    return figure


def _coloured(axes: Axes, field: Coloured, samples: Index) -> Array:
    """Colours (k, F, 3) of the triangles at samples (k,), with their bar on the sheet."""
    values = field.at(samples)
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


def contact_shapes(seen: Replay) -> dict[str, Figure]:
    """The same coloured by pressure and by gap, from where most of the pressure is seen."""
    positions_m, gaps_m, pressures_pa = seen.shapes_m, seen.gaps_m, seen.pressures_pa
    if positions_m is None or gaps_m is None or pressures_pa is None:
        return {}
    camera = _towards(seen, positions_m, pressures_pa)
    fields = {
        "pressure": Coloured("pressure [Pa]", lambda samples: pressures_pa[samples]),
        "gap": Coloured("gap [mm]", lambda samples: 1e3 * gaps_m[samples]),
    }
    return {name: shapes(seen, SHOWN, field, camera) for name, field in fields.items()}


def _towards(seen: Replay, positions_m: Array, weights: Array) -> Camera:
    """Of views from above and below, from the front and behind, that of most weights (T, F)."""
    there = np.isfinite(positions_m).all(axis=(1, 2))
    front = Camera.facing(positions_m[there][:, np.unique(seen.surface)], seen.up)
    low = front.raised(-2 * ELEVATION_DEG)
    views = [front, low, front.turned(180.0, seen.up), low.turned(180.0, seen.up)]
    corners = positions_m[there][:, seen.surface]
    normals = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    shown = [(np.maximum(normals @ view.axes[2], 0) * weights[there]).sum() for view in views]
    return views[int(np.argmax(shown))]


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
    coloured = None if field is None else _on_surface(replay, body, constants, field)
    return shapes(replay, count, coloured)


def _on_surface(seen: Replay, body: Body, constants: Mapping[str, float], field: str) -> Coloured:
    elements, cells = ElementFields.of(body, body.theta(constants)), body.mesh.surface_cells

    def at(samples: Index) -> Array:
        assert seen.shapes_m is not None
        return elements.at(seen.shapes_m[samples])[field][:, cells]

    return Coloured(FIELDS[field], at)
