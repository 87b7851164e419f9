"""What the gallery shows besides pyplot's figures: a figure that ends a cell, as notebooks do."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any

from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst

from collocation_sysid.result.figure_style import RESOLUTION_DPI


def last_figure(_block: object, variables: Mapping[str, Any], gallery: Mapping[str, Any]) -> str:
    """Save the figure that is the value of a cell's last line, and return its reStructuredText."""
    values = variables["example_globals"]
    figure = values.get("___")
    if not isinstance(figure, Figure):
        return ""
    values["___"] = None  # it is shown, and needs no text
    file = next(variables["image_path_iterator"])
    figure.savefig(file, dpi=RESOLUTION_DPI)
    return figure_rst([PurePosixPath(file)], gallery["src_dir"])
