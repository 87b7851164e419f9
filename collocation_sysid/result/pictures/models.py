"""The two models of every measurement, fitted and simulated, and how they are drawn."""

from __future__ import annotations

from typing import Any

from ...arrays import Array
from ..style import BLUE, LINE_PT, VERMILION


def models(
    fitted_m: Array | None, rolled_out_m: Array | None
) -> list[tuple[str, Array, dict[str, Any]]]:
    """Label, markers (T, M, 3) and style of the models that are there.

    The dashes of the second leave the first visible where they agree.
    """
    named = (
        ("fitted", fitted_m, {"color": BLUE, "lw": LINE_PT}),
        ("simulated", rolled_out_m, {"color": VERMILION, "lw": LINE_PT, "ls": (0, (4, 2))}),
    )
    return [(label, model, style) for label, model, style in named if model is not None]
