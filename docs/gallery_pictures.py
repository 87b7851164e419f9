"""What the gallery shows besides pyplot's figures: a figure that ends a cell, as notebooks do, and a
film whose path ends a cell.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst

from collocation_sysid.result.figure_style import RESOLUTION_DPI


def last_figure(_block: object, variables: Mapping[str, Any], gallery: Mapping[str, Any]) -> str:
    """Save the figure or film that is the value of a cell's last line, and return its
    reStructuredText.
    """
    values = variables["example_globals"]
    shown = values.get("___")
    is_film = isinstance(shown, Path) and shown.suffix == ".gif"
    if not isinstance(shown, Figure) and not is_film:
        return ""
    values["___"] = None  # it is shown, and needs no text
    file = next(variables["image_path_iterator"])
    if is_film:
        file = str(Path(file).with_suffix(shown.suffix))
        shutil.copy(shown, file)
    else:
        shown.savefig(file, dpi=RESOLUTION_DPI)
    return figure_rst([PurePosixPath(file)], gallery["src_dir"])
