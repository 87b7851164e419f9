"""What the pages share: the template engine, pictures inside the page, and numbers for people."""

from __future__ import annotations

import base64
import math
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined, TemplateError

from ...files import is_own

# Pictures wider than this can be moved sideways on a phone rather than shrunk.
WIDE_PX = 1000


def rendered(template: str, **values: Any) -> str:
    """A page from a template of this folder; text is escaped.

    Raises
    ------
    ValueError
        If the template cannot be filled with the values.
    """
    environment = Environment(
        loader=FunctionLoader(_template),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": number, "millimetres": millimetres}
    try:
        return environment.get_template(template).render(**values)
    except TemplateError as error:  # a value that the page needs is not there
        raise ValueError(error) from error


def _template(name: str) -> str:
    return (
        files("collocation_sysid.output.report")
        .joinpath("templates", name)
        .read_text(encoding="utf-8")
    )


def number(value: float | None, digits: int = 5) -> str:
    """A number as people write it; a dash for none."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value:.{digits}g}".replace("e-0", "e-").replace("e+0", "e")


def millimetres(metres: float | None) -> str:
    """A length in millimetres, to the micrometre at most."""
    return "–" if metres is None else f"{1e3 * metres:.3g} mm"


def own_pictures(folder: Path) -> list[Path]:
    """The PNG of a folder; what links lead to elsewhere is not shown."""
    return sorted(file for file in folder.glob("*.png") if is_own(folder, file))


def picture(file: Path, caption: str) -> dict[str, Any]:
    """A PNG as an address that holds its data, its caption, and whether it is wide."""
    content = file.read_bytes()
    data = base64.b64encode(content).decode("ascii")
    width_px = int.from_bytes(content[16:20])  # in the header
    return {
        "source": f"data:image/png;base64,{data}",
        "caption": caption,
        "wide": width_px > WIDE_PX,
    }
