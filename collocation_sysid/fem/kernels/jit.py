"""LLVM code compiled to native code for this CPU, with the object code cached on disk.

The cache key consists of the key of the code, the source files that generate it, the LLVM version,
the CPU and its features. Because cached code is executed, the folder must belong to the user, with
nobody else able to write in it or to replace it, and a file is used only if it has the digest of
its code and key: a damaged file, or one for another key, is compiled anew.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import stat
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from llvmlite import __version__ as llvmlite_version
from llvmlite import binding as llvm
from llvmlite import ir
from numpy.typing import NDArray
from platformdirs import user_cache_path

from ...common.step_counting import report_state

DOUBLE = ir.DoubleType()
I32 = ir.IntType(32)
I64 = ir.IntType(64)
DOUBLES = DOUBLE.as_pointer()
I32S = I32.as_pointer()
Builder = Value = Any  # llvmlite is not annotated, and what is inferred of it is wrong


@contextmanager
def for_range(builder: Builder, start: Value, stop: Value, name: str) -> Iterator[Value]:
    """Emit a loop over start ≤ i < stop in steps of 1; the body of the context is that of the loop,
    and the context gives i. `name` appears in the LLVM code only.
    """
    before = builder.block
    head = builder.append_basic_block(f"{name}.head")
    body = builder.append_basic_block(f"{name}.body")
    after = builder.append_basic_block(f"{name}.after")
    builder.branch(head)
    builder.position_at_end(head)
    index = builder.phi(start.type, name)
    index.add_incoming(start, before)
    builder.cbranch(builder.icmp_signed("<", index, stop), body, after)
    builder.position_at_end(body)
    yield index
    advanced = builder.add(index, index.type(1), flags=["nsw"])
    index.add_incoming(advanced, builder.block)
    builder.branch(head)
    builder.position_at_end(after)


# Scalar functions that compiled code calls, or that vector intrinsics fall back to; resolved from
# the C library by name.
LIBM = ("exp", "exp2", "expm1", "log", "log1p", "pow", "ldexp", "hypot", "fmod", "remainder", "erf")
LIBM += ("sin", "cos", "tan", "asin", "acos", "atan", "atan2")
LIBM += ("sinh", "cosh", "tanh", "asinh", "acosh", "atanh")


@cache
def _initialise() -> None:
    """Initialise LLVM and register the functions of the C library."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    library = ctypes.CDLL("ucrtbase" if os.name == "nt" else None)
    for name in LIBM:
        llvm.add_symbol(name, ctypes.cast(getattr(library, name), ctypes.c_void_p).value)


def _target_machine(quickly: bool) -> llvm.TargetMachine:
    """Return a code generator for this CPU, owned by the engine that uses it."""
    _initialise()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=0 if quickly else 3,
        # Sections are mapped wherever there is room, and code reaches its constants by whole
        # addresses. By 32 bits it does not if they are 2 GB apart: LLVM then ends the process.
        reloc="static",
        codemodel="jitdefault",
        jit=True,
    )


@cache
def vector_lanes() -> int:
    """Return the number of doubles in one vector register of this CPU."""
    features = llvm.get_host_cpu_features()
    if features.get("avx512f"):
        return 8
    return 4 if features.get("avx2") else 2


@dataclass(frozen=True)
class NativeCode:
    """Native function to compile."""

    name: str  # name of the function
    # Identifies the code: as long as the files of this folder are unchanged, equal keys must mean
    # equal code.
    key: str
    signature: tuple[type, ...]
    # Returns the LLVM module that defines `name`; called only if nothing is cached.
    build: Callable[[], ir.Module] = field(compare=False)
    # Whether to compile without optimisation, in a fifth of the time; the function then takes up to
    # twice as long.
    is_unoptimised: bool = False


@lru_cache(128)
def compile_function(code: NativeCode) -> CompiledFunction:
    """Return the compiled function; the latest 128 are kept, by name, key and signature, and shared
    by all bodies.

    Raises
    ------
    RuntimeError
        If LLVM cannot compile the code.
    """
    return CompiledFunction(code)


class CompiledFunction:
    """Native function, called through ctypes, which releases the interpreter lock."""

    def __init__(self, code: NativeCode) -> None:
        machine = _target_machine(code.is_unoptimised)
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        self._engine.add_object_file(llvm.ObjectFileRef.from_data(_object_code(code, machine)))
        self._engine.finalize_object()
        address = self._engine.get_function_address(code.name)
        self._call = ctypes.CFUNCTYPE(None, *code.signature)(address)

    def __call__(self, *arguments: object) -> None:
        """Call the function with integers and addresses according to the signature."""
        self._call(*arguments)


def address(array: NDArray[Any]) -> int:
    """Return the address of an array's memory; ``array.ctypes.data`` takes three times as long."""
    try:
        return ctypes.addressof(ctypes.c_char.from_buffer(array.data))
    except (TypeError, ValueError):  # read-only, empty, or not contiguous
        return array.ctypes.data


def _object_code(code: NativeCode, machine: llvm.TargetMachine) -> bytes:
    """Return the object code from the cache, or compile it for `machine` and store it."""
    host = f"{llvmlite_version} {llvm.llvm_version_info} {llvm.get_host_cpu_name()} "
    host += llvm.get_host_cpu_features().flatten()
    cache_key = f"{host}\n{_source_digest()}\n{code.key}" + "\nquickly" * code.is_unoptimised
    code_bytes = load_object(cache_key)
    if code_bytes is None:
        report_state(lambda: "compiling native code")
        code_bytes = compile_module(code.build(), machine, quickly=code.is_unoptimised)
        store_object(cache_key, code_bytes)
        report_state(str)
    return code_bytes


@cache
def _source_digest() -> str:
    """Return a digest of the sources of this folder: changes invalidate cached kernels."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def compile_module(module: ir.Module, machine: llvm.TargetMachine, quickly: bool) -> bytes:
    """Return the object code of an LLVM module for a machine, without optimisation if `quickly`;
    the target triple of the module is set.
    """
    module.triple = machine.triple
    parsed = llvm.parse_assembly(str(module))
    parsed.verify()
    if not quickly:
        options = llvm.create_pipeline_tuning_options(speed_level=2)
        builder = llvm.create_pass_builder(machine, options)
        builder.getModulePassManager().run(parsed, builder)
    return machine.emit_object(parsed)


DIGEST_BYTES = hashlib.sha256().digest_size
OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def cache_folder() -> Path:
    """Return the folder of compiled kernels: ``COLLOCATION_SYSID_CACHE``, or the user's cache
    folder. It need not exist.
    """
    override = os.environ.get("COLLOCATION_SYSID_CACHE")
    return Path(override) if override else user_cache_path("collocation_sysid")


def load_object(key: str) -> bytes | None:
    """Return the code stored for a key; None if there is none, if it is damaged, or if others could
    have written it.
    """
    folder = cache_folder()
    if not folder.is_dir() or not _is_trusted(folder):
        return None
    try:
        content = _read_private_file(folder / _file_name(key))
    except OSError:
        return None
    digest = content[:DIGEST_BYTES]
    code = content[DIGEST_BYTES:]
    return code if digest == _digest(key, code) else None


def store_object(key: str, code: bytes) -> None:
    """Store code in the cache under a key, in place of what is there; do nothing if the folder
    cannot be written or trusted (the latter with a warning). The folder is created if missing.
    """
    folder = cache_folder()
    with suppress(OSError):
        for missing in [p for p in (folder, *folder.parents) if not p.exists()][::-1]:
            missing.mkdir(mode=0o700, exist_ok=True)
        if not _is_trusted(folder):
            return
        with tempfile.TemporaryDirectory(dir=folder) as temporary_folder:
            unfinished = Path(temporary_folder) / _file_name(key)
            unfinished.write_bytes(_digest(key, code) + code)
            unfinished.chmod(0o600)
            unfinished.replace(folder / unfinished.name)


def cache_fault() -> str | None:
    """Return why compiled kernels cannot be stored, or None if they can. The folder of the cache is
    created if missing.
    """
    folder = cache_folder()
    try:
        for missing in [p for p in (folder, *folder.parents) if not p.exists()][::-1]:
            missing.mkdir(mode=0o700, exist_ok=True)
        if (fault := _folder_fault(folder.resolve())) is not None:
            return fault
        with tempfile.TemporaryFile(dir=folder):
            return None
    except OSError as error:
        return f"{folder} cannot be written: {error.strerror or error}"


def _file_name(key: str) -> str:
    """Return the file name of a key."""
    return f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.o"


def _digest(key: str, code: bytes) -> bytes:
    """Return the digest of a key and its code."""
    return hashlib.sha256(hashlib.sha256(key.encode()).digest() + code).digest()


def _read_private_file(path: Path) -> bytes:
    """Return the content of a plain file that belongs to the user alone; links are not followed."""
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    with os.fdopen(os.open(path, flags | getattr(os, "O_BINARY", 0)), "rb") as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode) or _ownership_fault(status):
            raise OSError(f"{path} is not owned by this user alone")
        return file.read()


def _is_trusted(folder: Path) -> bool:
    """Return whether nobody else can write in a folder or replace it; warn if somebody can."""
    fault = _folder_fault(folder.resolve())
    if fault is not None:
        _warn_once(fault)
    return fault is None


@cache
def _warn_once(fault: str) -> None:
    """Warn with a `RuntimeWarning` that compiled kernels are not stored, once for each reason."""
    warnings.warn(
        f"compiled code is not cached, so that each run compiles it again: {fault}; set the "
        "environment variable COLLOCATION_SYSID_CACHE to a folder that only you can write "
        "(chmod 700)",
        RuntimeWarning,
        stacklevel=2,
    )


def _folder_fault(folder: Path) -> str | None:
    """Return why others could put code in a folder, or replace the folder; None if they cannot."""
    if (fault := _ownership_fault(folder.stat())) is not None:
        return f"{folder} {fault}"
    for parent in folder.parents:
        status = parent.stat()
        # In a sticky folder, such as /tmp, nobody can move what is another's.
        if (fault := _ownership_fault(status, or_root=True)) and not status.st_mode & stat.S_ISVTX:
            return f"{parent}, which {folder} is in, {fault}"
    return None


def _ownership_fault(status: os.stat_result, or_root: bool = False) -> str | None:
    """Return why a file or folder is not the user's alone; None if it is."""
    if not hasattr(os, "getuid"):
        return None  # Windows: the profile's access list keeps others out
    owners = {os.getuid(), 0} if or_root else {os.getuid()}
    if status.st_uid not in owners:
        return "belongs to another user"
    return "can be written by others" if status.st_mode & OTHERS_WRITE else None
