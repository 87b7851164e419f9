"""Files and folders as they are read and written: regular, possible, whole or not there at all."""

from __future__ import annotations

import json
import os
import re
import secrets
import stat
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

from ..errors import InputError
from .written_files import add_to_list

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
# Longest reason of an error of another library in a message [characters]: about two lines.
LONGEST_REASON = 200
RESULT_FILE = "result.json"
# The form of result.json and summary.json.
SCHEMA = 4
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
        raise InputError(
            f"is {kind}; expected a regular file", path, where=where
        )


def is_own(folder: Path, file: Path) -> bool:
    """Whether this is a regular file of the folder, not one elsewhere that a link leads to."""
    try:
        return file.is_file() and file.resolve().is_relative_to(
            folder.resolve()
        )
    except (OSError, RuntimeError):  # links in a circle
        return False


def require_own(file: Path) -> None:
    """Refuse what is there and yet no regular file of its own folder.

    Raises
    ------
    InputError
        Naming the path.
    """
    require_regular(file)
    if file.is_file() and not is_own(file.parent, file):
        raise InputError(
            "is a link to elsewhere; expected a file of this folder itself",
            file,
        )


def require_run_folder(path: Path) -> None:
    """Refuse a file where a run folder is expected, such as the result.json of a run.

    Raises
    ------
    InputError
        Naming the folder of the file if that is a run folder.
    """
    if path.is_file():
        raise _file_instead_of_folder(
            path, "a run folder", expected_file=RESULT_FILE
        )


def _file_instead_of_folder(
    path: Path, what: str, expected_file: str
) -> InputError:
    """Return the error for a file where `what` is expected, a folder with `expected_file`."""
    is_within = (path.parent / expected_file).is_file()
    likely = f", likely {path.parent}" if is_within else ""
    return InputError(f"this is a file; expected {what}{likely}", path)


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
    require_own(file)
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except NotADirectoryError:
        raise _file_instead_of_folder(
            file.parent, what, expected_file=file.name
        ) from None
    except FileNotFoundError:
        raise InputError(
            f"this is not {what}: it has no {file.name}", file.parent
        ) from None
    except (OSError, ValueError, RecursionError, MemoryError) as error:
        raise InputError(
            f"{file.name} is damaged ({reason(error)}){AGAIN}", file.parent
        ) from error
    if not isinstance(content, dict):
        raise InputError(
            f"{file.name} is damaged: it holds no object{AGAIN}", file.parent
        )
    if (schema := content.get("schema")) != SCHEMA:
        message = f"{file.name} has schema {str(schema)[:20]}; expected {SCHEMA}, this version's{AGAIN}"
        raise InputError(message, file.parent)
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
        raise InputError(
            f"{files} is damaged ({reason(error)}); {remedy}", folder
        ) from error


def safe_name(text: str) -> str:
    """A file's name for a text, with underscores in place of what could lead elsewhere."""
    return re.sub(r"[^\w.-]+", "_", text)


@contextmanager
def replaced_file(path: str | Path) -> Iterator[Path]:
    """Give a file of the same ending beside `path` to write, and name it `path` at the end.

    So nobody ever sees half of it, and what was there is kept until then. A link is replaced and
    not followed; into a device or a pipe, where nothing can be replaced, is written directly. In a
    folder with a list of its files, see `written_files`, the file is added to the list.

    Raises
    ------
    InputError
        Naming the path, where the disk is full or it cannot be written in.
    """
    target = Path(path)
    draft = target.with_name(
        f".{target.stem}.{secrets.token_hex(4)}.partial{target.suffix}"
    )
    try:
        with naming(target, draft):
            if target.exists() and not target.is_file():
                yield target
                return
            target.parent.mkdir(parents=True, exist_ok=True)
            yield draft
            add_to_list(target, draft)
            os.replace(draft, target)
    finally:
        with suppress(OSError):
            draft.unlink()


def write_text_file(path: str | Path, text: str) -> None:
    """Write a text as UTF-8 by `replaced_file`."""
    with replaced_file(path) as draft:
        draft.write_text(text, encoding="utf-8")


@contextmanager
def naming(target: Path, draft: Path) -> Iterator[None]:
    """Let what goes wrong while a draft is written name what the draft is to be.

    Raises
    ------
    InputError
        Naming the target.
    """
    try:
        yield
    except OSError as error:
        reason = f"cannot be written: {error.strerror or error}"
        raise InputError(reason, target) from error
    except InputError as error:
        if error.source is None or not Path(error.source).is_relative_to(draft):
            raise
        raise InputError(error.message, target, where=error.where) from error


def reason(error: BaseException) -> str:
    """The error on one line that is not too long."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return (
        text
        if len(text) <= LONGEST_REASON
        else f"{text[: LONGEST_REASON - 1]}…"
    )


def run_name(problem: Path) -> str:
    """Name of a problem file's runs: its folder's where it is called problem.toml, else its own."""
    return (
        problem.resolve().parent.name
        if problem.stem == "problem"
        else problem.stem
    )


def require_possible(folder: Path) -> None:
    """Refuse a folder that cannot be made, before any work is done for it."""
    for place in (folder, *folder.parents):
        if place.is_dir():
            if not os.access(place, os.W_OK):
                raise InputError(
                    "this folder cannot be written in; choose another", place
                )
            return
        if place.exists():
            raise InputError(
                "this is a file; expected a folder to write in", place
            )
