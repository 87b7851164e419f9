"""Print pip constraints that take every dependency at the lowest version that pyproject allows."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

PROJECT = Path(__file__).parents[1] / "pyproject.toml"


def lowest(requirements: list[str]) -> list[str]:
    """A pin for each requirement of the form "name>=version", without its extras."""
    pins = []
    for requirement in requirements:
        found = re.fullmatch(r"([\w.-]+)(?:\[.*\])?>=([\d.]+)", requirement)
        if found is None:
            raise ValueError(f"{requirement!r} states no lowest version")
        pins.append(f"{found[1]}=={found[2]}")
    return pins


if __name__ == "__main__":
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    print("\n".join(lowest(project["dependencies"])))
