"""Files that a problem file names."""

from __future__ import annotations

from pathlib import Path

from ..common.files import require_regular
from ..errors import InputError, hint_at
from ..recording.sources.logs import stored_files


def existing_file(folder: Path, name: str, key: str) -> Path:
    """Return the path of a file that a key of the problem file names, relative to `folder`; `name`
    may also be a topic of a log, as "log#topic", or an absolute path.

    Raises
    ------
    InputError
        At `key`, if it does not exist, is a folder or no regular file.
    """
    file = folder / name
    require_regular(file, key)
    if not stored_files(file):
        fault = "is a folder" if file.is_dir() else "does not exist"
        hint = folder / "README.md"
        see = f"; {hint} may explain how to get it" if hint.is_file() else ""
        beside = [each.name for each in file.parent.iterdir()] if file.parent.is_dir() else []
        similar = hint_at(file.name, sorted(beside)) if not file.exists() else ""
        message = (
            f"{file} {fault}; expected a file: the path is relative to the folder of the problem "
            f"file{similar}{see}"
        )
        raise InputError(message, where=key)
    return file
