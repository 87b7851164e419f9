"""Picture of a spatially varying constant with the ends of its 95 % interval, on the surface and in
a cut.
"""

from __future__ import annotations

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from ...common.array_types import Array
from ...fem.laws.constants import symbol_with_unit
from ...fem.meshes.checks import boundary_of
from ..figure_style import PAGE_MM, SMALL_PT
from ..replay import MotionRecord
from .scene import (
    BodyDrawing,
    ParallelCamera,
    SheetView,
    aspect_ratio,
    draw_directions,
    draw_scale,
    sheet,
)
from .shapes import FIELD_COLOURS

# Height of the titles [mm].
HEAD_MM = 5.0
# Height of directions and scale below the bodies [mm].
FOOT_MM = 8.0
# Width of the directions at the left [mm].
CORNER_MM = 14.0
# Width of the colour bar with its labels [mm].
BAR_ROOM_MM = 20.0
# Distance between two bodies [mm].
GAP_MM = 3.0
# Largest height of a body [mm], so that two rows fit on a page.
MAX_BODY_HEIGHT_MM = 55.0
COLUMN_TITLES = "lower end", "estimate", "upper end"
# Ratio of posterior to prior standard deviation above which colours fade.
FADING_START = 0.5
# Ratio at which colours have faded completely: the data add nothing to the prior.
FADING_END = 1.0
# Largest share of white, so that faded colours can still be compared.
MAX_FADING = 0.8
# Colour of other regions.
OTHER_REGION_COLOUR = np.array([0.85, 0.85, 0.85])


def field_picture(replay: MotionRecord, name: str, values: Array) -> Figure:
    """Return a figure of the estimate and the ends of its interval on the body, and below them on a
    cut through it.

    Colours fade to white where the posterior is hardly narrower than the prior. Elements of other
    regions are grey.

    Parameters
    ----------
    replay : MotionRecord
        An experiment with this body.
    values : (E, 4)
        Its values in each element, see `MotionRecord.fields`; not all NaN.
    """
    nodes_m = replay.undeformed_m
    cells = np.asarray(replay.tetrahedra, dtype=np.int64)
    camera = ParallelCamera.facing_motion(nodes_m[None], replay.up)
    # An upright cut, if it is looked at from above.
    across = camera.axes[2] - (camera.axes[2] @ replay.up) * replay.up
    forward = nodes_m[cells].mean(axis=1) @ across
    behind = np.flatnonzero(forward <= np.median(forward))
    rows = np.arange(len(cells)), behind
    aspect = aspect_ratio(camera, nodes_m)
    width = (PAGE_MM - CORNER_MM - BAR_ROOM_MM - 2 * GAP_MM) / 3
    height = min(width / aspect, MAX_BODY_HEIGHT_MM)
    total = HEAD_MM + 2 * height + GAP_MM + FOOT_MM
    figure, axes = sheet(PAGE_MM, total)
    known = values[np.isfinite(values[:, 0])]
    # Wide intervals where the data add nothing would take up the colour scale.
    low = np.quantile(known[:, 1], 0.05)
    high = np.quantile(known[:, 2], 0.95)
    scale = ScalarMappable((LogNorm if low > 0 else Normalize)(low, high), FIELD_COLOURS)
    untold = np.clip((values[:, 3] - FADING_START) / (FADING_END - FADING_START), 0.0, MAX_FADING)[
        :, None
    ]
    no_nodes = np.zeros(len(nodes_m), dtype=bool)
    for row, own in enumerate(rows):
        faces, owners = boundary_of(cells[own])
        for column, (title, place) in enumerate(zip(COLUMN_TITLES, (1, 0, 2), strict=True)):
            corner = (
                CORNER_MM + column * (width + GAP_MM),
                FOOT_MM + (1 - row) * (height + GAP_MM),
            )
            view = SheetView.fit_points(camera, nodes_m, room_mm=(width, height), corner_mm=corner)
            colours = scale.to_rgba(values[:, place])[:, :3]
            colours = (1 - np.nan_to_num(untold)) * colours + np.nan_to_num(untold)
            colours[np.isnan(values[:, place])] = OTHER_REGION_COLOUR
            BodyDrawing(axes, view, surface=faces).update(
                nodes_m, no_nodes, markers_m=np.zeros((0, 3)), colours=colours[own[owners]]
            )
            if row == 0:
                axes.text(
                    corner[0] + width / 2, total - HEAD_MM / 2, title, ha="center", va="center",
                    fontsize=SMALL_PT,
                )  # fmt: skip
    place = (PAGE_MM - BAR_ROOM_MM + 4, FOOT_MM, 2.5, total - HEAD_MM - FOOT_MM - 4)
    bar_axes = axes.inset_axes(place, transform=axes.transData)
    ticks = LogLocator(subs=(1.0, 2.0, 5.0)) if low > 0 else None
    bar = figure.colorbar(scale, cax=bar_axes, ticks=ticks, format="%.3g")
    bar.ax.minorticks_off()
    bar.ax.tick_params(labelsize=SMALL_PT, width=0.4, length=2, pad=1.5)
    end = {"ha": "right", "va": "top", "fontsize": SMALL_PT}
    axes.text(PAGE_MM - 1, total - 1.0, symbol_with_unit(name), **end)
    draw_directions(axes, camera, origin_mm=(6.0, FOOT_MM))
    draw_scale(axes, view.mm_per_m, corner_mm=(CORNER_MM + width + GAP_MM, 3.5))
    return figure
