"""Compile LLVM IR to native code for this CPU, with the object code kept on disk.

The cache lives in the user's cache folder (or ``COLLOCATION_SYSID_CACHE``) and is keyed by the
code's own key, the sources that generate it, the LLVM version, the CPU and its features. A file
is the code after its SHA-256 checksum.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path

from llvmlite import __version__ as llvmlite_version
from llvmlite import binding as llvm
from llvmlite import ir
from platformdirs import user_cache_path

# Scalar functions that compiled code calls, or that vector intrinsics fall back to; resolved from
# the C library by name.
LIBM = ("exp", "exp2", "expm1", "log", "log1p", "pow", "ldexp", "hypot", "fmod", "remainder", "erf")
LIBM += ("sin", "cos", "tan", "asin", "acos", "atan", "atan2")
LIBM += ("sinh", "cosh", "tanh", "asinh", "acosh", "atanh")
CHECKSUM_BYTES = hashlib.sha256().digest_size


def cache_folder() -> Path:
    """Where compiled kernels are kept between runs."""
    override = os.environ.get("COLLOCATION_SYSID_CACHE")
    return Path(override) if override else user_cache_path("collocation_sysid")


@cache
def _initialise() -> None:
    """Make LLVM ready and the C library's functions known to it."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    library = ctypes.CDLL("ucrtbase" if os.name == "nt" else None)
    for name in LIBM:
        llvm.add_symbol(name, ctypes.cast(getattr(library, name), ctypes.c_void_p).value)


def _target_machine() -> llvm.TargetMachine:
    """A code generator for this CPU. An engine owns and frees its own."""
    _initialise()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=3,
        reloc="pic",
        codemodel="small",
        jit=True,
    )


@cache
def vector_lanes() -> int:
    """Doubles in one vector register of this CPU."""
    features = llvm.get_host_cpu_features()
    if features.get("avx512f"):
        return 8
    return 4 if features.get("avx2") else 2


class CompiledFunction:
    """A native function, called through ctypes (which releases the interpreter lock).

    Parameters
    ----------
    build : callable
        Returns the IR module that defines `name`; only called when nothing is cached.
    name : str
        The function to look up.
    key : str
        Identifies the code: while the files of this folder stay, equal keys must mean equal IR.
    signature : list of ctypes types
    """

    def __init__(
        self, build: Callable[[], ir.Module], name: str, key: str, signature: list[type]
    ) -> None:
        machine = _target_machine()
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        self._engine.add_object_file(
            llvm.ObjectFileRef.from_data(_cached_object(build, key, machine))
        )
        self._engine.finalize_object()
        address = self._engine.get_function_address(name)
        self._call = ctypes.CFUNCTYPE(None, *signature)(address)

    def __call__(self, *arguments: object) -> None:
        """Run it on integers and addresses, as in the signature."""
        self._call(*arguments)


def _cached_object(build: Callable[[], ir.Module], key: str, machine: llvm.TargetMachine) -> bytes:
    host = f"{llvmlite_version} {llvm.llvm_version_info} {llvm.get_host_cpu_name()} "
    host += llvm.get_host_cpu_features().flatten()
    digest = hashlib.sha256(f"{host}\n{_generation()}\n{key}".encode()).hexdigest()
    path = cache_folder() / f"{digest[:32]}.o"
    code = _read_checked(path)
    if code is None:
        code = _compile(build(), machine)
        with suppress(OSError):  # a read-only cache costs time, not correctness
            _write_checked(path, code)
    return code


@cache
def _generation() -> str:
    """Identify the code that emits and compiles: once it changes, old kernels must not be used."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _read_checked(path: Path) -> bytes | None:
    """Object code as `_write_checked` left it; LLVM would end the process over a damaged one."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    checksum, code = content[:CHECKSUM_BYTES], content[CHECKSUM_BYTES:]
    return code if checksum == hashlib.sha256(code).digest() else None


def _write_checked(path: Path, code: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        unfinished = Path(folder) / path.name
        unfinished.write_bytes(hashlib.sha256(code).digest() + code)
        unfinished.replace(path)


def _compile(module: ir.Module, machine: llvm.TargetMachine) -> bytes:
    module.triple = machine.triple
    parsed = llvm.parse_assembly(str(module))
    parsed.verify()
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=2))
    builder.getModulePassManager().run(parsed, builder)
    return machine.emit_object(parsed)
