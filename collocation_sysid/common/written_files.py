"""Lists of the files that this program wrote into a folder, by which others are told from them.

A folder may be replaced only if all its files are listed and unchanged; a recording or a note that
somebody put there is not, nor is an exported file after it was edited.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

LIST_FILE = ".collocation-sysid.json"
# Nobody's data: drafts of a process that was killed, see `files.replaced_file`, and what file
# managers leave in folders that they show.
IGNORED_NAME = re.compile(r"\..+\.[0-9a-f]{8}\.partial(\.\w+)?|\.DS_Store|Thumbs\.db|desktop\.ini")


def list_files(folder: Path) -> None:
    """Write the list of all files below a folder, with their hashes, as `LIST_FILE` into it.

    Files in subfolders that have a list of their own are left to that list; an existing list of the
    folder is overwritten. Drafts (`IGNORED_NAME`) and the lists themselves are not listed.

    Parameters
    ----------
    folder : Path
        Existing folder; every file in it must have been written by this program.
    """
    hashes = {
        file.relative_to(folder).as_posix(): _hash(file)
        for file in _files(folder)
        if _home(file, folder) == folder
    }
    (folder / LIST_FILE).write_text(list_as_text(hashes), encoding="utf-8")


def add_to_list(file: Path, content: Path) -> None:
    """Enter a file with its present hash in the list of its folder; no effect if the folder has no
    list (or a link in its place), or for the list itself.

    Parameters
    ----------
    file : Path
        The file under its final name, which need not exist yet.
    content : Path
        File with its content now, for example a draft.
    """
    listing = file.parent / LIST_FILE
    if file != listing and listing.is_file() and not listing.is_symlink():
        hashes = listed_hashes(file.parent)
        hash_now = _hash(content)
        if hashes.get(file.name) != hash_now:
            draft = listing.with_name(f"{LIST_FILE}.{secrets.token_hex(4)}.partial")
            draft.write_text(list_as_text({**hashes, file.name: hash_now}), encoding="utf-8")
            os.replace(draft, listing)


def hashes_of(contents: Mapping[str, Path]) -> dict[str, str]:
    """Return the SHA-256 hashes of files by name, from the paths of their contents by name."""
    return {name: _hash(content) for name, content in contents.items()}


def list_as_text(hashes: Mapping[str, str]) -> str:
    """Return the content of a list file (JSON, names in alphabetical order) from hashes by name."""
    return json.dumps({"written": dict(sorted(hashes.items()))}, indent=1) + "\n"


def listed_hashes(folder: Path) -> dict[str, str]:
    """Return the SHA-256 hashes of the listed files by path relative to the folder; an empty
    dictionary if there is no valid list.
    """
    try:
        content: Any = json.loads((folder / LIST_FILE).read_text(encoding="utf-8"))
        return {str(name): str(value) for name, value in content["written"].items()}
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return {}


def is_written_here(file: Path) -> bool:
    """Return whether a regular file is on the list of its folder, with the content that was listed;
    false for links and missing files.
    """
    if file.is_symlink() or not file.is_file():
        return False
    known = listed_hashes(file.parent).get(file.name)
    return known is not None and known == _hash(file)


def foreign_files(folder: Path) -> Iterator[Path]:
    """Yield, in the order of their names, files and links below a folder that are not on its list,
    or were changed since; all files if it has no list.

    Links are not followed. A list in a subfolder, such as that of an export in a run folder, is
    valid for the files of that subfolder. Lists and ignored names (`IGNORED_NAME`, such as
    drafts) are not yielded, but a link in place of a list is.

    Raises
    ------
    OSError
        If the folder does not exist or cannot be read.
    """
    lists: dict[Path, dict[str, str]] = {}
    for file in _files(folder):
        home = _home(file, folder)
        if home not in lists:
            lists[home] = listed_hashes(home)
        known = lists[home].get(file.relative_to(home).as_posix())
        if file.is_symlink() or not file.is_file() or known is None or known != _hash(file):
            yield file


def _files(folder: Path) -> Iterator[Path]:
    """Yield files and links, which are not followed, without lists and ignored names."""
    for entry in sorted(os.scandir(folder), key=lambda each: each.name):
        path = folder / entry.name
        if entry.is_dir(follow_symlinks=False):
            yield from _files(path)
        elif not IGNORED_NAME.fullmatch(entry.name) and (
            entry.name != LIST_FILE or entry.is_symlink()
        ):
            yield path


def _home(file: Path, folder: Path) -> Path:
    """Return the nearest folder above a file that has a list, else `folder`."""
    for parent in file.parents:
        if parent == folder or (parent / LIST_FILE).is_file():
            return parent
    return folder


def _hash(file: Path) -> str:
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()
