"""What the pages share: the template engine, pictures inside the page, and numbers for people."""

from __future__ import annotations

import base64
import json
import math
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined

from ...errors import InputError


def rendered(template: str, **values: Any) -> str:
    """A page from a template of this folder; text is escaped."""
    environment = Environment(
        loader=FunctionLoader(_template),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": number, "millimetres": millimetres}
    return environment.get_template(template).render(**values)


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


def picture(file: Path) -> str:
    """A PNG as an address that holds its data."""
    data = base64.b64encode(file.read_bytes()).decode("ascii")
    return f"data:image/png;base64,{data}"


def read_json(file: Path, what: str) -> dict[str, Any]:
    """The object in a JSON file.

    Raises
    ------
    InputError
        If it is not there, or is damaged.
    """
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"this is not {what}: it has no {file.name}", file.parent) from None
    except (OSError, ValueError) as error:
        raise InputError(f"{file.name} is damaged ({error})", file.parent) from error
    if not isinstance(content, dict):
        raise InputError(f"{file.name} is damaged: it holds no object", file.parent)
    return content
