"""Print pip constraints that take every dependency at the lowest version that pyproject allows."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from script_arguments import require_no_arguments

PROJECT = Path(__file__).parents[2] / "pyproject.toml"


def lowest_pins(requirements: list[str]) -> list[str]:
    """Return a pin for each requirement of the form "name>=version", without its extras."""
    pins = []
    for requirement in requirements:
        match = re.fullmatch(r"([\w.-]+)(?:\[.*\])?>=([\d.]+)", requirement)
        if match is None:
            raise ValueError(f"{requirement!r} states no lowest version")
        pins.append(f"{match[1]}=={match[2]}")
    return pins


def project_pins() -> list[str]:
    """Return the lowest versions of the dependencies of the package and its extras.

    Requirements of an extra on the package itself, and requirements for some platforms only, are
    left out.
    """
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    extras = [each for extra in project["optional-dependencies"].values() for each in extra]
    extra_requirements = [e for e in extras if ";" not in e and not e.startswith(project["name"])]
    return lowest_pins([*project["dependencies"], *extra_requirements])


if __name__ == "__main__":
    require_no_arguments(__doc__)
    print("\n".join(project_pins()))
