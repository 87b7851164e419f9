"""Reading and writing of files and folders: regular files alone, and files that are written
completely or not at all.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import stat
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

from ..errors import InputError
from .limits import machine_memory_mb
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
# Memory that is needed while text is read, in sizes of its file: cells are objects of their own.
TEXT_FACTOR = 25
# Files below this are read in any case [bytes].
SMALL_BYTES = 50_000_000
# Longest reason of an error of another library in a message [characters]: about two lines.
LONGEST_REASON = 200
RESULT_FILE = "result.json"
# Version of the form of result.json.
SCHEMA = 6
# Remedy for a damaged file, at the end of a message.
AGAIN = "; run the command that wrote it again"


def require_regular(path: str | Path, where: str | None = None) -> None:
    """Refuse a pipe, socket or device, which a reader would wait for or never reach the end of.

    A path that does not exist or is a folder is accepted: it is left to the reader.

    Parameters
    ----------
    path : str or Path
        The path; links are followed.
    where : str, optional
        Key for the message.

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
        raise InputError(f"this is {kind}; expected a regular file", path, where=where)


def require_size(path: str | Path, most: int | None = None) -> None:
    """Refuse a file of text that is too large for the memory, before it is read.

    A path that does not exist is accepted: it is left to the reader.

    Parameters
    ----------
    path : str or Path
        The path; links are followed.
    most : int, optional
        Largest size [bytes]; by default that of which this machine holds `TEXT_FACTOR` copies.

    Raises
    ------
    InputError
        Naming the path.
    """
    try:
        size = os.stat(path).st_size
    except (OSError, ValueError):
        return
    if most is None:
        memory_mb = machine_memory_mb()
        most = size if memory_mb is None else max(SMALL_BYTES, int(1e6 * memory_mb / TEXT_FACTOR))
    if size > most:
        raise InputError(
            f"this file has {size / 1e6:,.0f} MB; expected at most {most / 1e6:,.0f} MB of text: "
            "it is no such file, or has more than this machine's memory can take",
            path,
        )


def is_own(folder: Path, file: Path) -> bool:
    """Return whether a path is a regular file within the folder after links are followed; false if
    it does not exist, or is a link to a file elsewhere.
    """
    try:
        return file.is_file() and file.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # links in a circle
        return False


def require_own(file: Path) -> None:
    """Refuse a pipe, socket or device, and a link to a file in another folder; a missing file is
    accepted.

    Raises
    ------
    InputError
        Naming the path.
    """
    require_regular(file)
    if file.is_file() and not is_own(file.parent, file):
        raise InputError(
            "this is a link to a file outside of the folder; expected a file in the folder "
            "itself: replace the link by a copy",
            file,
        )


def require_run_folder(path: Path) -> None:
    """Refuse a file where a run folder is expected, such as the result.json of a run; folders and
    missing paths are accepted.

    Raises
    ------
    InputError
        Naming the folder of the file if that is a run folder.
    """
    if path.is_file():
        raise _file_instead_of_folder(path, "a run folder", expected_file=RESULT_FILE)


def _file_instead_of_folder(path: Path, what: str, expected_file: str) -> InputError:
    """The error suggests the folder of the file if that has a file `expected_file`."""
    is_within = (path.parent / expected_file).is_file()
    likely = f", likely {path.parent}" if is_within else ""
    return InputError(f"this is a file; expected {what}{likely}", path)


def read_json(file: Path, what: str) -> dict[str, Any]:
    """Return the object in a JSON file of a folder that this program wrote.

    Parameters
    ----------
    what : str
        Description of its folder for messages, such as "a run folder".

    Raises
    ------
    InputError
        If the file does not exist, is a link to elsewhere, is damaged, holds no object, or its
        "schema" is not `SCHEMA`.
    """
    require_own(file)
    require_size(file)
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except NotADirectoryError:
        raise _file_instead_of_folder(file.parent, what, expected_file=file.name) from None
    except FileNotFoundError:
        raise InputError(f"this is not {what}: it has no {file.name}", file.parent) from None
    except (OSError, ValueError, RecursionError, MemoryError) as error:
        raise InputError(f"{file.name} is damaged ({reason(error)}){AGAIN}", file.parent) from error
    if not isinstance(content, dict):
        raise InputError(f"{file.name} is damaged: it contains no JSON object{AGAIN}", file.parent)
    if (schema := content.get("schema")) != SCHEMA:
        message = (
            f"{file.name} has schema {str(schema)[:20]}; expected {SCHEMA}, which this version "
            f"writes{AGAIN}"
        )
        raise InputError(message, file.parent)
    return content


@contextmanager
def damage_refused(folder: Path, files: str, remedy: str) -> Iterator[None]:
    """Convert exceptions that damaged files cause in their readers (`DAMAGE`) into an `InputError`;
    other ones, also `OSError`, pass.

    Parameters
    ----------
    folder : Path
        Folder that the message names.
    files : str
        Names of the files, for the message.
    remedy : str
        Remedy at the end of the message.

    Raises
    ------
    InputError
        Naming the folder, its `files`, the reason and the `remedy`; an `InputError` of the block
        itself passes unchanged.
    """
    try:
        yield
    except InputError:
        raise
    except DAMAGE as error:
        raise InputError(f"{files} is damaged ({reason(error)}); {remedy}", folder) from error


def safe_name(text: str) -> str:
    """Return the text as a file name: each sequence of characters other than letters, digits, "_",
    "." and "-" becomes one underscore.
    """
    return re.sub(r"[^\w.-]+", "_", text)


@contextmanager
def replaced_file(path: str | Path) -> Iterator[Path]:
    """Yield the path of a draft with the same ending beside `path`, which replaces `path` at the
    end of the block.

    So nobody ever sees an incomplete file, and the previous content is kept until then; it is kept
    for good if the block raises, and the draft is removed. Missing parent folders are created. A
    link is replaced and not followed. If `path` is a device, a pipe or a folder, `path` itself is
    yielded and nothing is replaced. In a folder with a list of its files, see `written_files`, the
    file is added to the list.

    Raises
    ------
    InputError
        Naming the path, if the disk is full or the path cannot be written; and for an `OSError` of
        the block.
    """
    target = Path(path)
    if target.is_dir():
        with naming(target, target):
            yield target
        return
    draft = target.with_name(f".{target.stem}.{secrets.token_hex(4)}.partial{target.suffix}")
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


def write_new_files(contents: Mapping[Path, str | Path]) -> list[Path]:
    """Write files, texts or copies of other files, all of them or none, and return their paths.

    Raises
    ------
    InputError
        If a file exists, or cannot be written.
    """
    for file in contents:
        require_possible(file.parent)
        if file.exists():
            raise InputError("this file exists already; choose another folder", file)
    made = [each for file in contents for each in file.parents if not each.exists()]
    try:
        with ExitStack() as stack:  # all files appear at its end, or none
            for file, content in contents.items():
                draft = stack.enter_context(replaced_file(file))
                raw = content.encode() if isinstance(content, str) else content.read_bytes()
                draft.write_bytes(raw)
    except BaseException:
        for folder in made:
            with suppress(OSError):  # from the deepest folder on, unless others wrote into it
                folder.rmdir()
        raise
    return [*contents]


def write_text_file(path: str | Path, text: str) -> None:
    """Write a text as UTF-8 by `replaced_file`, whose errors it raises."""
    with replaced_file(path) as draft:
        draft.write_text(text, encoding="utf-8")


@contextmanager
def naming(target: Path, draft: Path) -> Iterator[None]:
    """Convert errors raised while a draft is written into errors that name its target.

    An `OSError` becomes an `InputError`; an `InputError` about the draft gets the target as source;
    all others pass.

    Raises
    ------
    InputError
        Naming the target.
    """
    try:
        yield
    except OSError as error:
        reason = f"this cannot be written: {error.strerror or error}"
        raise InputError(reason, target) from error
    except InputError as error:
        if error.source is None or not Path(error.source).is_relative_to(draft):
            raise
        raise InputError(error.message, target, where=error.where) from error


def reason(error: BaseException) -> str:
    """Return type and message of an error on one line of at most `LONGEST_REASON` characters."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return text if len(text) <= LONGEST_REASON else f"{text[: LONGEST_REASON - 1]}…"


def in_counting_order(files: Iterable[Path]) -> list[Path]:
    """Return files in the order of their names, with numbers by their value: 2.png before 10.png."""

    def key(file: Path) -> list[tuple[bool, int, str]]:
        parts = re.split(r"([0-9]+)", file.name)
        return [(not p.isdecimal(), int(p) if p.isdecimal() else 0, p) for p in parts if p]

    return sorted(files, key=key)


def run_name(problem: Path) -> str:
    """Return the name of a problem file's runs: that of its folder if the file is called
    problem.toml, else the file's without its ending.
    """
    return problem.resolve().parent.name if problem.stem == "problem" else problem.stem


def require_possible(folder: Path) -> None:
    """Refuse a folder that cannot be created or written in, before any work is done for it; nothing
    is created.

    Raises
    ------
    InputError
        If the nearest existing folder is not writable, or a file is in the way.
    """
    for place in (folder, *folder.parents):
        if place.is_dir():
            if not os.access(place, os.W_OK):
                raise InputError(
                    "this folder is not writable; expected one that is: choose another", place
                )
            return
        if place.exists():
            raise InputError("this is a file; expected a folder: choose another path", place)
