"""Object code kept on disk between runs.

What is read here is executed. So the folder must be the user's own, with nobody else able to write
in it or to put another in its place, and a file is used only where its digest is that of its code
for its key: one that was damaged, or made for another key, is compiled anew.
"""

from __future__ import annotations

import hashlib
import os
import stat
import tempfile
import warnings
from contextlib import suppress
from functools import cache
from pathlib import Path

from platformdirs import user_cache_path

DIGEST_BYTES = hashlib.sha256().digest_size
OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def cache_folder() -> Path:
    """Where compiled kernels are kept: ``COLLOCATION_SYSID_CACHE``, or the user's cache folder."""
    override = os.environ.get("COLLOCATION_SYSID_CACHE")
    return Path(override) if override else user_cache_path("collocation_sysid")


def load(key: str) -> bytes | None:
    """The code that `store` kept for a key; None where there is none to trust."""
    folder = cache_folder()
    if not folder.is_dir() or not _is_trusted(folder):
        return None
    try:
        content = _read_own(folder / _file_name(key))
    except OSError:
        return None
    digest, code = content[:DIGEST_BYTES], content[DIGEST_BYTES:]
    return code if digest == _digest(key, code) else None


def store(key: str, code: bytes) -> None:
    """Keep code; a folder that cannot be written costs time, not correctness."""
    folder = cache_folder()
    with suppress(OSError):
        for missing in [p for p in (folder, *folder.parents) if not p.exists()][::-1]:
            missing.mkdir(mode=0o700, exist_ok=True)
        if not _is_trusted(folder):
            return
        with tempfile.TemporaryDirectory(dir=folder) as passing:
            unfinished = Path(passing) / _file_name(key)
            unfinished.write_bytes(_digest(key, code) + code)
            unfinished.chmod(0o600)
            unfinished.replace(folder / unfinished.name)


def _file_name(key: str) -> str:
    return f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.o"


def _digest(key: str, code: bytes) -> bytes:
    return hashlib.sha256(hashlib.sha256(key.encode()).digest() + code).digest()


def _read_own(path: Path) -> bytes:
    """What a plain file of the user holds; an OSError where it is anything else."""
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    with os.fdopen(os.open(path, flags | getattr(os, "O_BINARY", 0)), "rb") as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode) or _fault(found):
            raise OSError(f"{path} is not a file of this user alone")
        return file.read()


def _is_trusted(folder: Path) -> bool:
    fault = _folder_fault(folder.resolve())
    if fault is not None:
        _warn(fault)
    return fault is None


@cache
def _warn(fault: str) -> None:
    warnings.warn(
        f"compiled kernels are not kept: {fault}; set COLLOCATION_SYSID_CACHE to a folder of "
        "your own (chmod 700)",
        RuntimeWarning,
        stacklevel=2,
    )


def _folder_fault(folder: Path) -> str | None:
    """Why others could put code in a folder, or another folder in its place; None if not."""
    if (fault := _fault(folder.stat())) is not None:
        return f"{folder} {fault}"
    for parent in folder.parents:
        found = parent.stat()
        # In a sticky folder, such as /tmp, nobody can move what is another's.
        if (fault := _fault(found, or_root=True)) and not found.st_mode & stat.S_ISVTX:
            return f"{parent}, which {folder} is in, {fault}"
    return None


def _fault(found: os.stat_result, or_root: bool = False) -> str | None:
    if not hasattr(os, "getuid"):
        return None  # Windows: the profile's access list keeps others out
    owners = {os.getuid(), 0} if or_root else {os.getuid()}
    if found.st_uid not in owners:
        return "belongs to another user"
    return "can be written by others" if found.st_mode & OTHERS_WRITE else None
