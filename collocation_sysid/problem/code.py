"""Materials that a problem file takes from Python files: foreign code, run only when allowed."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import cast

from ..errors import InputError, hint_at
from ..fem.materials import Energy, Material
from ..files import reason
from .recording import existing_file
from .schema import CodeSection


def load_material(section: CodeSection, folder: Path, key: str, allowed: bool) -> Material:
    """Run the file and make a material of its function.

    Raises
    ------
    InputError
        If running code is not allowed, the file or the function is not there, the file fails, or
        the function is no energy density, see `Material.of`.
    """
    if not allowed:
        raise InputError(
            f"found the file {section.file}, which would be run as Python code; allow that with "
            "--allow-code (allow_code=True from Python) if you trust it",
            None,
            key,
        )
    file = existing_file(folder, section.file, f"{key}.file")
    try:
        names = runpy.run_path(str(file))
    except (Exception, SystemExit) as error:
        raise InputError(f"running it failed: {reason(error)}", file) from error
    found = names.get(section.function)
    if not callable(found):
        functions = [n for n, v in names.items() if callable(v) and not n.startswith("_")]
        raise InputError(
            f"there is no function {section.function!r}; expected one of "
            f"{', '.join(functions) or 'none'}{hint_at(section.function, functions)}",
            file,
        )
    if isinstance(found, Material):
        return found
    try:
        return Material.of(cast(Energy, found), section.function)
    except InputError as error:
        raise error.located(file) from error
