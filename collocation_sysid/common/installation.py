"""Installation of the package: its metadata, also if it is run from its sources, and the command of
further Python processes.
"""

from __future__ import annotations

import sys
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGE = "collocation-sysid"
_FOLDER = Path(__file__).resolve().parents[1]
# Makes this package importable where it is not installed, without any other file beside it.
_IMPORT_PACKAGE = """
import importlib.util, sys
_spec = importlib.util.spec_from_file_location({name!r}, {file!r})
sys.modules[{name!r}] = _package = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(_package)
"""


def python_command(code: str, *words: str, with_package: bool = False) -> list[str]:
    """Return the command of a Python process that imports nothing from the working folder.

    Every process that this package starts is started by this command.

    Parameters
    ----------
    code : str
        Program.
    *words : str
        The arguments ``sys.argv[1:]`` of the program.
    with_package : bool
        Whether the program imports this package, which need not be installed.
    """
    if with_package:
        file = str(_FOLDER / "__init__.py")
        code = _IMPORT_PACKAGE.format(name=_FOLDER.name, file=file) + code
    return [sys.executable, "-P", "-c", code, *words]


def package_version() -> str:
    """Return the version of this package."""
    try:
        return metadata.version(PACKAGE)
    except metadata.PackageNotFoundError:
        return _source_metadata()["version"]


def stated_requirements() -> list[str]:
    """Return the requirements of this package and of its extras, as the metadata of packages state
    them.
    """
    try:
        return metadata.requires(PACKAGE) or []
    except metadata.PackageNotFoundError:
        stated = _source_metadata()
    of_extras = []
    for extra, requirements in stated["optional-dependencies"].items():
        for requirement in requirements:
            name, _, marker = requirement.partition(";")
            condition = (
                f'({marker.strip()}) and extra == "{extra}"' if marker else f'extra == "{extra}"'
            )
            of_extras.append(f"{name.strip()}; {condition}")
    return [*stated["dependencies"], *of_extras]


def extra_names() -> list[str]:
    """Return the names of the extras of this package."""
    try:
        return metadata.metadata(PACKAGE).get_all("Provides-Extra") or []
    except metadata.PackageNotFoundError:
        return [*_source_metadata()["optional-dependencies"]]


def _source_metadata() -> dict[str, Any]:
    """Return the table "project" of pyproject.toml, for sources without installation."""
    with (_FOLDER.parent / "pyproject.toml").open("rb") as file:
        return tomllib.load(file)["project"]
