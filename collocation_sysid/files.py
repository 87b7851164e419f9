"""Files as they are read: regular ones, and folders of results that may be damaged."""

from __future__ import annotations

import json
import os
import stat
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

from .errors import InputError

# What reading and drawing raise where files do not hold what they should. Errors of the disk tell
# their file themselves.
DAMAGE = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    BadZipFile,
    EOFError,
    LookupError,
    MemoryError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    zlib.error,
)
LONGEST_REASON = 200
RESULT_FILE = "result.json"
# The form of result.json and summary.json.
SCHEMA = 2
AGAIN = "; run what wrote it again"


def require_regular(path: str | Path, where: str | None = None) -> None:
    """Refuse a pipe, socket or device, which a reader would wait for or never reach the end of.

    What is not there, or is a folder, is left to the reader.

    Raises
    ------
    InputError
        Naming the path.
    """
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):  # the latter where it holds what no path can
        return
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        kind = "a pipe" if stat.S_ISFIFO(mode) else "a device or socket"
        raise InputError(f"is {kind}; expected a regular file", path, where)


def read_json(file: Path, what: str) -> dict[str, Any]:
    """The object in a JSON file of a folder.

    Parameters
    ----------
    file : Path
    what : str
        What its folder is, such as "a run folder".

    Raises
    ------
    InputError
        If it is not there, is damaged, or was written by another version.
    """
    require_regular(file)
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"this is not {what}: it has no {file.name}", file.parent) from None
    except (OSError, ValueError, RecursionError, MemoryError) as error:
        raise InputError(f"{file.name} is damaged ({reason(error)}){AGAIN}", file.parent) from error
    if not isinstance(content, dict):
        raise InputError(f"{file.name} is damaged: it holds no object{AGAIN}", file.parent)
    if (found := content.get("schema")) != SCHEMA:
        said = f"{file.name} has schema {str(found)[:20]}; expected {SCHEMA}, this version's{AGAIN}"
        raise InputError(said, file.parent)
    return content


@contextmanager
def damage_refused(folder: Path, files: str, remedy: str) -> Iterator[None]:
    """Make one refusal of whatever the files of a folder make go wrong in its readers.

    Raises
    ------
    InputError
        Naming the folder, its `files`, the reason and the `remedy`.
    """
    try:
        yield
    except InputError:
        raise
    except DAMAGE as error:
        raise InputError(f"{files} is damaged ({reason(error)}); {remedy}", folder) from error


def reason(error: BaseException) -> str:
    """The error on one line that is not too long."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return text if len(text) <= LONGEST_REASON else f"{text[: LONGEST_REASON - 1]}…"
