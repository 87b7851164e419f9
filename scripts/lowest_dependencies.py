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
        match = re.fullmatch(r"([\w.-]+)(?:\[.*\])?>=([\d.]+)", requirement)
        if match is None:
            raise ValueError(f"{requirement!r} states no lowest version")
        pins.append(f"{match[1]}=={match[2]}")
    return pins


def of_project() -> list[str]:
    """Return the lowest versions of the dependencies of the package and its extras.

    Requirements of an extra on the package itself, and requirements for some platforms only, are
    left out.
    """
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    extras = [
        each
        for extra in project["optional-dependencies"].values()
        for each in extra
    ]
    stated = [
        e for e in extras if ";" not in e and not e.startswith(project["name"])
    ]
    return lowest([*project["dependencies"], *stated])


if __name__ == "__main__":
    print("\n".join(of_project()))
