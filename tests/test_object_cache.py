"""What is kept compiled is executed: nothing that others could have written is used."""

import os
from pathlib import Path

import pytest

from collocation_sysid.fem.kernels import jit

CODE = b"\x7fELF and so on"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    folder = tmp_path / "deep" / "kernels"
    monkeypatch.setenv("COLLOCATION_SYSID_CACHE", str(folder))
    jit._warn.cache_clear()
    return folder


def entry(folder: Path) -> Path:
    jit.store("key", CODE)
    (found,) = folder.iterdir()
    return found


def test_what_is_stored_is_loaded_by_its_key_alone():
    jit.store("key", CODE)
    assert jit.load("key") == CODE
    assert jit.load("other") is None


def test_folders_and_files_that_it_makes_are_the_users_alone(folder):
    old = os.umask(0)
    try:
        file = entry(folder)
    finally:
        os.umask(old)
    assert [path.stat().st_mode & 0o777 for path in (folder, folder.parent)] == [0o700] * 2
    assert file.stat().st_mode & 0o777 == 0o600


def test_object_of_another_key_in_its_place_is_refused(folder):
    jit.store("foreign", b"does something else")
    (foreign,) = folder.iterdir()
    foreign.rename(folder / jit._file_name("key"))
    assert jit.load("key") is None


@pytest.mark.parametrize("content", [b"", CODE, b"\0" * 32 + CODE])
def test_object_without_its_digest_is_refused(folder, content):
    entry(folder).write_bytes(content)
    assert jit.load("key") is None


def test_file_that_others_can_write_is_refused(folder):
    entry(folder).chmod(0o666)
    assert jit.load("key") is None


def test_link_and_pipe_are_refused_at_once(folder):
    file = entry(folder)
    moved = file.rename(folder.parent / "elsewhere.o")
    file.symlink_to(moved)
    assert jit.load("key") is None
    file.unlink()
    os.mkfifo(file)
    assert jit.load("key") is None


def test_folder_that_others_can_write_is_neither_read_nor_written(folder):
    entry(folder)
    folder.chmod(0o777)
    with pytest.warns(RuntimeWarning, match=r"kernels can be written by others; set COLLOC"):
        assert jit.load("key") is None
    jit.store("another", CODE)
    assert len(list(folder.iterdir())) == 1


def test_parent_that_others_can_write_is_refused_unless_sticky(folder):
    entry(folder)
    folder.parent.chmod(0o777)
    with pytest.warns(RuntimeWarning, match=r"deep, which .*kernels is in, can be written"):
        assert jit.load("key") is None
    folder.parent.chmod(0o1777)
    assert jit.load("key") == CODE


def test_folder_of_another_user_is_refused(folder, monkeypatch):
    entry(folder)
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    with pytest.warns(RuntimeWarning, match="belongs to another user"):
        assert jit.load("key") is None
