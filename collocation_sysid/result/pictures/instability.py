"""Picture of the mode in which a body loses its stability, on the surface of the body."""

from __future__ import annotations

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from ...program.forward.loss_of_stability import StabilityLoss
from ..figure_style import PAGE_MM, SMALL_PT, own_settings
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

# Height of the title [mm].
HEAD_MM = 6.0
# Height of directions and scale below the body [mm].
FOOT_MM = 8.0
# Width of the margins at the left and the right [mm].
MARGIN_MM = 14.0
# Largest height of the body [mm], half of a page.
MAX_BODY_HEIGHT_MM = 90.0
# Longest drawn displacement over the largest extent of the body.
RELATIVE_AMPLITUDE = 0.08


@own_settings()
def instability_picture(instability: StabilityLoss) -> Figure:
    """Return a figure of the body displaced along its unstable mode, coloured by the mode's
    amplitude, with its stretches and wavelength as the title.

    The largest displacement is the share `RELATIVE_AMPLITUDE` of the body's largest dimension; z is
    drawn upwards, whatever the direction of gravity.

    Parameters
    ----------
    instability : StabilityLoss
        Positions at the loss of stability, and the mode, whose largest amplitude is 1.
    """
    extent_m = float(np.ptp(instability.positions_m, axis=0).max())
    shown_m = instability.positions_m + RELATIVE_AMPLITUDE * extent_m * instability.mode
    camera = ParallelCamera.facing_motion(shown_m[None], np.array([0.0, 0.0, 1.0]))
    aspect = aspect_ratio(camera, shown_m)
    width = PAGE_MM - 2 * MARGIN_MM
    height = min(width / aspect, MAX_BODY_HEIGHT_MM)
    figure, axes = sheet(PAGE_MM, HEAD_MM + height + FOOT_MM)
    view = SheetView.fit_points(
        camera, shown_m, room_mm=(width, height), corner_mm=(MARGIN_MM, FOOT_MM)
    )
    amplitude = np.linalg.norm(instability.mode, axis=1)[instability.faces].mean(axis=1)
    colours = ScalarMappable(Normalize(0.0, 1.0), FIELD_COLOURS).to_rgba(amplitude)[:, :3]
    none = np.zeros(len(shown_m), dtype=bool)
    BodyDrawing(axes, view, surface=instability.faces).update(
        shown_m, none, markers_m=np.zeros((0, 3)), colours=colours
    )
    title = (
        f"unstable mode: stretches {instability.smaller_stretch:.3g} "
        f"and {instability.larger_stretch:.3g}, "
        f"wavelength {1e3 * instability.wavelength_m:.3g} mm"
    )
    axes.text(PAGE_MM / 2, HEAD_MM / 2 + height + FOOT_MM, title, ha="center", fontsize=SMALL_PT)
    draw_directions(axes, camera, origin_mm=(6.0, FOOT_MM))
    draw_scale(axes, view.mm_per_m, corner_mm=(MARGIN_MM, 3.5))
    return figure
