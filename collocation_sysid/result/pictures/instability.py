"""Picture of the mode in which a body loses its stability, on the surface of the body."""

from __future__ import annotations

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from ...program.loss_of_stability import LostStability
from ..figure_style import PAGE_MM, SMALL_PT
from .projection import Camera
from .scene import Drawn, View, draw_directions, draw_scale, sheet, width_over_height
from .shapes import COLOURS

HEAD_MM = 6.0
FOOT_MM = 8.0
MARGIN_MM = 14.0
TALLEST_MM = 90.0
# Longest drawn displacement over the largest extent of the body.
DRAWN = 0.08


def instability_picture(lost: LostStability) -> Figure:
    """Draw the body displaced along the unstable mode, coloured by the mode's amplitude."""
    extent_m = float(np.ptp(lost.positions_m, axis=0).max())
    shown_m = lost.positions_m + DRAWN * extent_m * lost.mode
    camera = Camera.facing(shown_m[None], np.array([0.0, 0.0, 1.0]))
    aspect = width_over_height(camera, shown_m)
    width = PAGE_MM - 2 * MARGIN_MM
    height = min(width / aspect, TALLEST_MM)
    figure, axes = sheet(PAGE_MM, HEAD_MM + height + FOOT_MM)
    view = View.fitting(camera, shown_m, (width, height), (MARGIN_MM, FOOT_MM))
    amplitude = np.linalg.norm(lost.mode, axis=1)[lost.faces].mean(axis=1)
    colours = ScalarMappable(Normalize(0.0, 1.0), COLOURS).to_rgba(amplitude)[:, :3]
    none = np.zeros(len(shown_m), dtype=bool)
    Drawn(axes, view, lost.faces).show(shown_m, none, np.zeros((0, 3)), colours)
    title = (
        f"unstable mode: stretches {lost.smaller_stretch:.3g} and {lost.larger_stretch:.3g}, "
        f"wavelength {1e3 * lost.wavelength_m:.3g} mm"
    )
    axes.text(PAGE_MM / 2, HEAD_MM / 2 + height + FOOT_MM, title, ha="center", fontsize=SMALL_PT)
    draw_directions(axes, camera, (6.0, FOOT_MM))
    draw_scale(axes, view.mm_per_m, (MARGIN_MM, 3.5))
    return figure
