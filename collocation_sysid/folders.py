"""Folders that results are written to."""

from __future__ import annotations

import os
from pathlib import Path

from .errors import InputError


def run_name(problem: Path) -> str:
    """Name of a problem file's runs: its folder's where it is called problem.toml, else its own."""
    return problem.resolve().parent.name if problem.stem == "problem" else problem.stem


def require_possible(folder: Path) -> None:
    """Refuse a folder that cannot be made, before any work is done for it."""
    for place in (folder, *folder.parents):
        if place.is_dir():
            if not os.access(place, os.W_OK):
                raise InputError("this folder cannot be written in; choose another", place)
            return
        if place.exists():
            raise InputError("this is a file; expected a folder to write in", place)
