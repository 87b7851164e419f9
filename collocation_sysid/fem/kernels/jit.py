"""LLVM IR compiled to native code for this CPU, with the object code kept on disk.

It is keyed by the code's own key, the sources that generate it, the LLVM version, the CPU and its
features. What is read from disk is executed. So the folder must be the user's own, with nobody else
able to write in it or to put another in its place, and a file is used only where its digest is that
of its code for its key: one that was damaged, or made for another key, is compiled anew.
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

DOUBLE, I32, I64 = ir.DoubleType(), ir.IntType(32), ir.IntType(64)
DOUBLES, I32S = DOUBLE.as_pointer(), I32.as_pointer()
Builder = Value = Any  # llvmlite is not annotated, and what is inferred of it is wrong

# So many functions stay in memory for further bodies.
KEPT = 128


@contextmanager
def counting(builder: Builder, start: Value, stop: Value, name: str) -> Iterator[Value]:
    """A loop over start ≤ i < stop; yields i."""
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
    """Make LLVM ready and the C library's functions known to it."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    library = ctypes.CDLL("ucrtbase" if os.name == "nt" else None)
    for name in LIBM:
        llvm.add_symbol(name, ctypes.cast(getattr(library, name), ctypes.c_void_p).value)


def _target_machine(quickly: bool) -> llvm.TargetMachine:
    """A code generator for this CPU. An engine owns and frees its own."""
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
    """Doubles in one vector register of this CPU."""
    features = llvm.get_host_cpu_features()
    if features.get("avx512f"):
        return 8
    return 4 if features.get("avx2") else 2


@dataclass(frozen=True)
class NativeCode:
    """A native function that is wanted.

    Attributes
    ----------
    name : str
        The function to look up.
    key : str
        Identifies the code: while the files of this folder stay, equal keys must mean equal IR.
    signature : tuple of ctypes types
    build : callable
        Returns the IR module that defines `name`; only called when nothing is cached.
    quickly : bool
        Compile it as it is written, in a fifth of the time; it then runs up to twice as long.
    """

    name: str
    key: str
    signature: tuple[type, ...]
    build: Callable[[], ir.Module] = field(compare=False)
    quickly: bool = False


@lru_cache(KEPT)
def compiled(code: NativeCode) -> CompiledFunction:
    """The function, of which one serves all bodies."""
    return CompiledFunction(code)


class CompiledFunction:
    """A native function, called through ctypes (which releases the interpreter lock)."""

    def __init__(self, code: NativeCode) -> None:
        machine = _target_machine(code.quickly)
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        self._engine.add_object_file(llvm.ObjectFileRef.from_data(_cached_object(code, machine)))
        self._engine.finalize_object()
        address = self._engine.get_function_address(code.name)
        self._call = ctypes.CFUNCTYPE(None, *code.signature)(address)

    def __call__(self, *arguments: object) -> None:
        """Run it on integers and addresses, as in the signature."""
        self._call(*arguments)


def address(array: NDArray[Any]) -> int:
    """Where an array's memory begins; ``array.ctypes.data`` takes three times as long."""
    try:
        return ctypes.addressof(ctypes.c_char.from_buffer(array.data))
    except (TypeError, ValueError):  # read-only, empty, or not contiguous
        return array.ctypes.data


def _cached_object(code: NativeCode, machine: llvm.TargetMachine) -> bytes:
    host = f"{llvmlite_version} {llvm.llvm_version_info} {llvm.get_host_cpu_name()} "
    host += llvm.get_host_cpu_features().flatten()
    whole_key = f"{host}\n{_generation()}\n{code.key}" + "\nquickly" * code.quickly
    found = load(whole_key)
    if found is None:
        found = _compile(code.build(), machine, code.quickly)
        store(whole_key, found)
    return found


@cache
def _generation() -> str:
    """Identify the code that emits and compiles: once it changes, old kernels must not be used."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _compile(module: ir.Module, machine: llvm.TargetMachine, quickly: bool) -> bytes:
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
