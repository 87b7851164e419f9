"""The cache of compiled kernels uses no file that others could have written."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from collocation_sysid.fem.kernels import jit

CODE = b"\x7fELF and so on"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    folder = tmp_path / "deep" / "kernels"
    monkeypatch.setenv("COLLOCATION_SYSID_CACHE", str(folder))
    jit._warn_once.cache_clear()
    return folder


def entry(folder: Path) -> Path:
    jit.store_object("key", CODE)
    (found,) = folder.iterdir()
    return found


def test_cached_objects_are_loaded_by_key():
    jit.store_object("key", CODE)
    assert jit.load_object("key") == CODE
    assert jit.load_object("other") is None


def test_created_folders_and_files_belong_to_the_user_alone(folder):
    old = os.umask(0)
    try:
        file = entry(folder)
    finally:
        os.umask(old)
    assert [path.stat().st_mode & 0o777 for path in (folder, folder.parent)] == [0o700] * 2
    assert file.stat().st_mode & 0o777 == 0o600


def test_object_of_another_key_in_its_place_is_refused(folder):
    jit.store_object("foreign", b"does something else")
    (foreign,) = folder.iterdir()
    foreign.rename(folder / jit._file_name("key"))
    assert jit.load_object("key") is None


@pytest.mark.parametrize("content", [b"", CODE, b"\0" * 32 + CODE])
def test_object_without_its_digest_is_refused(folder, content):
    entry(folder).write_bytes(content)
    assert jit.load_object("key") is None


def test_file_that_others_can_write_is_refused(folder):
    entry(folder).chmod(0o666)
    assert jit.load_object("key") is None


def test_link_and_pipe_are_refused_at_once(folder):
    file = entry(folder)
    moved = file.rename(folder.parent / "elsewhere.o")
    file.symlink_to(moved)
    assert jit.load_object("key") is None
    file.unlink()
    os.mkfifo(file)
    assert jit.load_object("key") is None


def test_folder_that_others_can_write_is_neither_read_nor_written(folder):
    entry(folder)
    folder.chmod(0o777)
    with pytest.warns(RuntimeWarning, match=r"kernels can be written by others; set .*COLLOC"):
        assert jit.load_object("key") is None
    jit.store_object("another", CODE)
    assert len(list(folder.iterdir())) == 1


def test_parent_that_others_can_write_is_refused_unless_sticky(folder):
    entry(folder)
    folder.parent.chmod(0o777)
    with pytest.warns(RuntimeWarning, match=r"deep, which .*kernels is in, can be written"):
        assert jit.load_object("key") is None
    folder.parent.chmod(0o1777)
    assert jit.load_object("key") == CODE


def test_folder_of_another_user_is_refused(folder, monkeypatch):
    entry(folder)
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    with pytest.warns(RuntimeWarning, match="belongs to another user"):
        assert jit.load_object("key") is None


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give files away")
@pytest.mark.parametrize("given", ["file", "folder", "parent"])
def test_objects_of_another_user_are_not_loaded(folder, given):
    file = entry(folder)
    os.chown({"file": file, "folder": folder, "parent": folder.parent}[given], 65534, 65534)
    if given == "file":
        assert jit.load_object("key") is None
    else:
        with pytest.warns(RuntimeWarning, match="belongs to another user"):
            assert jit.load_object("key") is None


APART = """
import ctypes, mmap, sys

from llvmlite import ir

from collocation_sysid.fem.kernels.jit import DOUBLE, DOUBLES, CompiledFunction, NativeCode, address
import numpy as np

library = ctypes.CDLL(None)
library.mmap.restype = ctypes.c_void_p
library.mmap.argtypes = ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long
library.munmap.argtypes = ctypes.c_void_p, ctypes.c_size_t


def taken(size):
    return library.mmap(None, size, 0, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, -1, 0)


def scaled_often():
    module = ir.Module()
    run = ir.Function(module, ir.FunctionType(ir.VoidType(), [DOUBLES]), "run")
    builder = ir.IRBuilder(run.append_basic_block())
    value = builder.load(run.args[0])
    for _ in range(1000):
        value = builder.fmul(value, DOUBLE(1.0001))
    builder.store(value, run.args[0])
    builder.ret_void()
    return module


blocks = [taken(3 << 30) for _ in range(100)]
for size in [mmap.PAGESIZE << k for k in range(14, 0, -1)]:
    while taken(size) > min(blocks):
        pass
for block in blocks:
    library.munmap(block, mmap.PAGESIZE)
code = NativeCode("run", "scaled", (ctypes.c_void_p,), scaled_often, is_unoptimised=True)
value = np.ones(1)
for each in [CompiledFunction(code) for _ in range(4)]:
    each(address(value))
print(value[0])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="it maps memory as Linux does")
def test_code_and_its_constants_may_be_mapped_far_apart(tmp_path):
    """As in a process with much else mapped, where a page is free here and another there."""
    done = subprocess.run(
        [sys.executable, "-c", APART],
        env=os.environ | {"COLLOCATION_SYSID_CACHE": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == pytest.approx(1.0001**4000)
