"""What a problem file takes from Python files: foreign code, run only when allowed."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from ..errors import InputError, hint_at, located
from ..fem.materials import Energy, Material
from ..fem.node_force import NodeForce
from ..files import reason
from ..recording.nuisance import NuisanceRow
from ..recording.selected import selection
from .nuisance_schema import OwnRow
from .recording import existing_file
from .schema import CodeSection, NodeForceSection


def load_material(section: CodeSection, folder: Path, key: str, allowed: bool) -> Material:
    """Run the file and make a material of its function.

    Raises
    ------
    InputError
        See `load_function`; or if the function is no energy density, see `Material.of`.
    """
    file, loaded = load_function(section.file, section.function, folder, f"{key}.file", allowed)
    if isinstance(loaded, Material):
        return loaded
    with located(file):
        return Material.of(cast(Energy, loaded), section.function)


def load_force(section: NodeForceSection, folder: Path, key: str, allowed: bool) -> NodeForce:
    """Run the file and make a force on nodes of its function.

    Raises
    ------
    InputError
        See `load_function`; or if the function is no force, see `NodeForce.of`.
    """
    file, loaded = load_function(section.file, section.function, folder, f"{key}.file", allowed)
    nodes = None if section.nodes is None else selection(section.nodes)
    if isinstance(loaded, NodeForce):
        return loaded if nodes is None else replace(loaded, nodes=nodes)
    with located(file):
        return NodeForce.of(loaded, nodes=nodes, name=section.function, on=section.on)


def load_function(
    name: str, function: str, folder: Path, key: str, allowed: bool
) -> tuple[Path, Callable[..., Any]]:
    """Run a file, which a key names, and take a function of it; the file's path too.

    Raises
    ------
    InputError
        If running code is not allowed, the file or the function is not there, or the file fails.
    """
    file, names = _run(name, folder, key, allowed)
    loaded = names.get(function)
    if not callable(loaded) and not isinstance(loaded, NodeForce):
        functions = [n for n, v in names.items() if callable(v) and not n.startswith("_")]
        raise InputError(
            f"there is no function {function!r}; expected one of "
            f"{', '.join(functions) or 'none'}{hint_at(function, functions)}",
            file,
        )
    return file, cast(Callable[..., Any], loaded)


def load_row(section: OwnRow, folder: Path, key: str, allowed: bool) -> NuisanceRow:
    """Run the file and take a nuisance parameter from it.

    Raises
    ------
    InputError
        If running code is not allowed, the file or the row is not there, or the file fails.
    """
    file, names = _run(section.file, folder, f"{key}.file", allowed)
    row = names.get(section.row)
    if not isinstance(row, NuisanceRow):
        rows = [name for name, value in names.items() if isinstance(value, NuisanceRow)]
        raise InputError(
            f"there is no NuisanceRow {section.row!r}; expected one of "
            f"{', '.join(rows) or 'none'}{hint_at(section.row, rows)}",
            file,
        )
    return row


def _run(name: str, folder: Path, key: str, allowed: bool) -> tuple[Path, dict[str, Any]]:
    """The file, and the names that are in it after it has run."""
    if not allowed:
        raise InputError(
            f"found the file {name}, which would be run as Python code; allow that with "
            "--allow-code (allow_code=True from Python) if you trust it",
            None,
            key.rpartition(".")[0],
        )
    file = existing_file(folder, name, key)
    try:
        return file, runpy.run_path(str(file))
    except (Exception, SystemExit) as error:
        raise InputError(f"running it failed: {reason(error)}", file) from error
