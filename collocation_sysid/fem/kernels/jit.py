"""Compile LLVM IR to native code for this CPU, with the object code kept on disk.

It is keyed by the code's own key, the sources that generate it, the LLVM version, the CPU and its
features, see `object_cache`.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from llvmlite import __version__ as llvmlite_version
from llvmlite import binding as llvm
from llvmlite import ir
from numpy.typing import NDArray

from . import object_cache

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


def address(array: NDArray[Any]) -> int:
    """Where an array's memory begins; ``array.ctypes.data`` takes three times as long."""
    try:
        return ctypes.addressof(ctypes.c_char.from_buffer(array.data))
    except (TypeError, ValueError):  # read-only, empty, or not contiguous
        return array.ctypes.data


def _cached_object(build: Callable[[], ir.Module], key: str, machine: llvm.TargetMachine) -> bytes:
    host = f"{llvmlite_version} {llvm.llvm_version_info} {llvm.get_host_cpu_name()} "
    host += llvm.get_host_cpu_features().flatten()
    whole_key = f"{host}\n{_generation()}\n{key}"
    code = object_cache.load(whole_key)
    if code is None:
        code = _compile(build(), machine)
        object_cache.store(whole_key, code)
    return code


@cache
def _generation() -> str:
    """Identify the code that emits and compiles: once it changes, old kernels must not be used."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _compile(module: ir.Module, machine: llvm.TargetMachine) -> bytes:
    module.triple = machine.triple
    parsed = llvm.parse_assembly(str(module))
    parsed.verify()
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=2))
    builder.getModulePassManager().run(parsed, builder)
    return machine.emit_object(parsed)
