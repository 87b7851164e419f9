"""Pictures of the body's shapes over time with markers, coloured by parts of the body or by a
field.
"""

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

from ...common.array_types import Array, Index
from ...errors import InputError, hint_at
from ...fem.body import Body
from ..element_fields import ElementFields
from ..figure_style import PAGE_MM, SMALL_PT, own_settings
from ..replay import MotionRecord
from .scene import (
    ELEVATION_DEG,
    BodyDrawing,
    ParallelCamera,
    SheetView,
    draw_directions,
    draw_legend,
    draw_scale,
    legend_handles,
    sheet,
    with_nearby_outlines,
)

# Number of shapes in a picture, evenly spaced in time: more would be too small on a page.
SHOWN_SHAPES = 6
# Height of the titles with the times [mm].
HEAD_MM = 5.0
# Height of directions, scale and legend below the bodies [mm].
FOOT_MM = 5.0
# Width of the directions at the left [mm].
CORNER_MM = 14.0
# Largest height of a body [mm].
MAX_BODY_HEIGHT_MM = 60.0
# Distance between two bodies [mm].
GAP_MM = 4.0
# Width of the colour bar [mm].
BAR_MM = 2.5
# Width of the colour bar with its labels [mm].
BAR_ROOM_MM = 20.0
# Colour map from pale to dark, without its darkest fifth, so that markers stand out.
FIELD_COLOURS = ListedColormap(colormaps["YlGnBu"](np.linspace(0.0, 0.8, 256))).with_extremes(
    bad="0.85"
)


@dataclass(frozen=True, eq=False)
class SurfaceField:
    """Field that colours the surface of a body."""

    title: str  # name with unit
    # Returns the values (k, F) on the boundary triangles at samples with indices (k,).
    values_at: Callable[[Index], Array]


def shapes_picture(
    replay: MotionRecord,
    count: int = SHOWN_SHAPES,
    field: SurfaceField | None = None,
    camera: ParallelCamera | None = None,
) -> Figure:
    """Return a figure of the body at evenly spaced samples, side by side in one scale.

    Drawn are the fitted shapes, or else the simulated ones, with the measured markers. Heights are
    true; horizontally the shapes are moved together. Samples that are not finite, as in a
    simulation that diverged, are left out.

    Parameters
    ----------
    replay : MotionRecord
        An experiment with shapes, at least one of which is finite, see `MotionRecord.has_shapes()`.
    count : int
        Number of samples, at least 1; fewer are shown if there are not as many.
    field : SurfaceField, optional
        Colours of the body; those of its parts by default.
    camera : ParallelCamera, optional
        Viewing direction; onto the plane of motion by default.
    """
    t_s = replay.t_s
    positions_m = replay.shapes_m
    measured_m = replay.measured_m
    assert positions_m is not None  # it was chosen among those that have some
    finite = np.flatnonzero(np.isfinite(positions_m).all(axis=(1, 2)))
    shown = finite[np.unique(np.linspace(0, len(finite) - 1, count).astype(int))]
    surface_m = positions_m[:, np.unique(replay.surface)]
    camera = camera or ParallelCamera.facing_motion(surface_m[finite], replay.up)
    outlines_m = None if replay.obstacles_m is None else replay.obstacles_m[shown]
    extents_m = with_nearby_outlines(
        np.concatenate([surface_m[shown], measured_m[shown]], axis=1), outlines_m
    )
    places = camera.project(extents_m)
    lefts = np.nanmin(places[..., 0], axis=1)
    rights = np.nanmax(places[..., 0], axis=1)
    low = float(np.nanmin(places[..., 1]))
    high = float(np.nanmax(places[..., 1]))
    width = PAGE_MM - CORNER_MM - (BAR_ROOM_MM if field else 0.0)
    room = width - len(shown) * GAP_MM
    scale = min(room / float((rights - lefts).sum()), MAX_BODY_HEIGHT_MM / (high - low))
    gap = GAP_MM + (room - scale * float((rights - lefts).sum())) / len(shown)
    total = HEAD_MM + scale * (high - low) + FOOT_MM
    figure, axes = sheet(PAGE_MM, total)
    colours = [None] * len(shown) if field is None else _draw_colour_bar(axes, field, samples=shown)
    start = CORNER_MM + (gap - GAP_MM) / 2
    for t, first, last, colour in zip(shown, lefts, rights, colours, strict=True):
        view = SheetView(
            camera, scale, origin_mm=np.array([start - scale * first, FOOT_MM - scale * low])
        )
        body = BodyDrawing(
            axes,
            view,
            surface=replay.surface,
            parts=replay.surface_parts,
            face_outlines=replay.face_outlines,
        )
        obstacles_m = None if replay.obstacles_m is None else replay.obstacles_m[t]
        body.update(
            positions_m[t],
            replay.is_prescribed[t],
            markers_m=measured_m[t],
            colours=colour,
            outlines_m=obstacles_m,
        )
        text = {"ha": "center", "va": "center", "fontsize": SMALL_PT}
        middle = start + scale * (last - first) / 2
        axes.text(middle, FOOT_MM / 2, f"{t_s[t] - t_s[0]:.3g} s", **text)
        start += scale * (last - first) + gap
    draw_directions(axes, camera, origin_mm=(7.5, FOOT_MM + 3.0))
    draw_scale(axes, scale, corner_mm=(2.0, total - 2.5))
    marks = ("measured", "behind the body") if np.isfinite(measured_m).any() else ()
    draw_legend(axes, legend_handles("grasped", *marks), corner_mm=(PAGE_MM * 0.3, total - 1.0))
    return figure


def _draw_colour_bar(axes: Axes, field: SurfaceField, samples: Index) -> Array:
    """Return colours (k, F, 3) at samples (k,); the scale is the same for all, grey for NaN."""
    values = field.values_at(samples)
    low = np.nanmin(values)
    high = np.nanmax(values)
    scale = ScalarMappable(Normalize(0.0 if 0 <= low < high / 5 else low, high), FIELD_COLOURS)
    height = axes.get_ylim()[1]
    place = (PAGE_MM - BAR_ROOM_MM + 2, FOOT_MM, BAR_MM, height - HEAD_MM - FOOT_MM)
    bar_axes = axes.inset_axes(place, transform=axes.transData)
    bar = axes.figure.colorbar(scale, cax=bar_axes, ticks=MaxNLocator(4))
    bar.outline.set_linewidth(0.4)
    bar.ax.tick_params(labelsize=SMALL_PT, width=0.4, length=2, pad=1.5)
    end = {"ha": "right", "va": "top", "fontsize": SMALL_PT}
    axes.text(PAGE_MM - 1, height - 1.0, field.title, **end)
    return scale.to_rgba(values)[..., :3]


def obstacle_pictures(replay: MotionRecord) -> dict[str, Figure]:
    """Return the pictures of `shapes_picture` coloured by pressure of obstacles and by gap, as
    "pressure" and "gap".

    The viewing direction is the one from which most of the pressure is visible. Empty without
    obstacles or without shapes; shapes, if there are any, must be finite at one sample at least.
    """
    positions_m = replay.shapes_m
    gaps_m = replay.gaps_m
    pressures_pa = replay.pressures_pa
    if positions_m is None or gaps_m is None or pressures_pa is None:
        return {}
    camera = _camera_facing_weights(replay, positions_m, weights=pressures_pa)
    fields = {
        "pressure": SurfaceField("pressure [Pa]", lambda samples: pressures_pa[samples]),
        "gap": SurfaceField("gap [mm]", lambda samples: 1e3 * gaps_m[samples]),
    }
    return {
        name: shapes_picture(replay, SHOWN_SHAPES, field=field, camera=camera)
        for name, field in fields.items()
    }


def _camera_facing_weights(
    replay: MotionRecord, positions_m: Array, weights: Array
) -> ParallelCamera:
    """Return the one of four cameras that faces most of the weights: onto the plane of motion from
    above, the same from below, and both from behind the body.

    The weight of a triangle counts in proportion to its projected area, whether or not another
    part of the body hides it. Samples with NaN are ignored.
    """
    there = np.isfinite(positions_m).all(axis=(1, 2))
    front = ParallelCamera.facing_motion(
        positions_m[there][:, np.unique(replay.surface)], replay.up
    )
    low = front.raised(-2 * ELEVATION_DEG)
    views = [front, low, front.turned(180.0, replay.up), low.turned(180.0, replay.up)]
    corners = positions_m[there][:, replay.surface]
    normals = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    shown = [(np.maximum(normals @ view.axes[2], 0) * weights[there]).sum() for view in views]
    return views[int(np.argmax(shown))]


FIELD_TITLES = {
    "von_mises_pa": "von Mises stress [Pa]",
    "energy_density_j_m3": "elastic energy [J/m³]",
    "det_f": "volume relative to the undeformed volume, det F",
}
# Largest number of shapes; more would be too small to be read.
MAX_SHAPES = 20


@own_settings()
def field_shapes(
    replay: MotionRecord, body: Body, constants: Mapping[str, float], field: str | None, count: int
) -> Figure:
    """Return a figure of `count` shapes of an experiment, fitted or else simulated, coloured by a
    field of its elements.

    Parameters
    ----------
    replay : MotionRecord
        Experiment with shapes.
    constants : mapping of name to value
        Values of the body's constants by name, at which stresses and energies are computed.
    field : str or None
        One of `FIELD_TITLES`; None for the colours of the body's parts.
    count : int
        Number of shapes, at most `MAX_SHAPES`.

    Raises
    ------
    InputError
        For an unknown field, or a number of shapes out of range.
    """
    if not 1 <= count <= MAX_SHAPES:
        raise InputError(f"count is {count}; expected 1 to {MAX_SHAPES} shapes")
    if field is not None and field not in FIELD_TITLES:
        expected = f"expected one of {', '.join(FIELD_TITLES)}{hint_at(field, list(FIELD_TITLES))}"
        raise InputError(f"no field {field!r}; {expected}")
    coloured = (
        None if field is None else _surface_field(replay, body, constants=constants, field=field)
    )
    return shapes_picture(replay, count, field=coloured)


def _surface_field(
    replay: MotionRecord, body: Body, constants: Mapping[str, float], field: str
) -> SurfaceField:
    if not body.is_solid:
        kind = body.kind.name
        raise InputError(
            f"found the field {field!r} of a {kind}; expected pictures without a field"
        )
    elements = ElementFields.from_body(body, body.theta_from_values(constants))
    cells = body.mesh.surface_cells

    def at(samples: Index) -> Array:
        assert replay.shapes_m is not None
        return elements.evaluate_at(replay.shapes_m[samples])[field][:, cells]

    return SurfaceField(FIELD_TITLES[field], at)
