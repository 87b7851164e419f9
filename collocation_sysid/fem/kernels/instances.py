"""Evaluation of a function of a few numbers at many instances, compiled or by CasADi.

Inputs are (k, instances) arrays, and so are the entries of dense outputs, column after column.
"""

from __future__ import annotations

import ctypes
import hashlib
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from ...common.array_types import Array

# Number of instances of one CasADi map; more instances are evaluated in blocks, because creating a
# map takes longer than evaluating it.
BLOCK = 1024

Instances = Callable[[list[Array]], list[Array]]


def make_casadi_instance_evaluator(function: ca.Function) -> Instances:
    """Return the reference evaluator: the function mapped over instances by CasADi.

    It takes a list of arrays (size, instances), one for each input, and returns such a list of
    outputs; each size is the number of structural nonzeros, and rows of outputs are in CasADi's
    order, column after column.
    """
    mapped: dict[int, ca.Function] = {}

    def evaluate(inputs: list[Array]) -> list[Array]:
        """Return the outputs (size, instances) at inputs (size, instances)."""
        count = inputs[0].shape[1]
        arguments = [np.ascontiguousarray(each.T, float) for each in inputs]
        outputs = [np.empty((count, function.nnz_out(k))) for k in range(function.n_out())]
        for first in range(0, count, BLOCK):
            block = slice(first, min(count, first + BLOCK))
            size = block.stop - first
            if size not in mapped:
                mapped[size] = function.map(size)
            # Through buffers, as CasADi's own matrices take ten times as long.
            buffer, run = mapped[size].buffer()
            # CasADi declares no type for what it takes.
            take: Any = buffer.set_arg
            give: Any = buffer.set_res
            for place, each in enumerate(arguments):
                if each.size:
                    take(place, each[block].data)
            for place, each in enumerate(outputs):
                give(place, each[block].data)
            run()
        return [each.T for each in outputs]

    return evaluate


def compile_instance_evaluator(function: ca.Function) -> Instances:
    """Return an evaluator in vector code, each lane of which is one instance; arguments and results
    are those of `make_casadi_instance_evaluator`. There must be at least one instance.

    Raises
    ------
    VectorCodeError
        For operations that vector code does not support.
    RuntimeError
        If LLVM cannot compile the code.
    """
    from .instructions import require_supported_operations
    from .jit import NativeCode, address, compile_function, vector_lanes

    require_supported_operations(function)
    lanes = vector_lanes()
    arrays = function.n_in() + function.n_out()
    key = f"instances {lanes} {hashlib.sha256(function.serialize().encode()).hexdigest()}"
    signature = (ctypes.c_int64, *[ctypes.c_void_p] * arrays)
    run = compile_function(
        NativeCode("instances", key, signature=signature, build=lambda: _emit(function, lanes))
    )

    entry_counts = [function.nnz_out(k) for k in range(function.n_out())]

    def evaluate(inputs: list[Array]) -> list[Array]:
        """Return the outputs (size, instances) at inputs (size, instances)."""
        count = inputs[0].shape[1]
        padded_count = -(-count // lanes) * lanes
        if padded_count > count:
            # The last lanes repeat the last instance.
            instance_indices = np.minimum(np.arange(padded_count), count - 1)
            inputs = [each[:, instance_indices] for each in inputs]
        arguments = [np.ascontiguousarray(each, float) for each in inputs]
        outputs = [np.empty((entries, padded_count)) for entries in entry_counts]
        run(padded_count, *map(address, [*arguments, *outputs]))
        return [each[:, :count] for each in outputs]

    return evaluate


def _emit(function: ca.Function, lanes: int) -> Any:
    """Return the LLVM module of ``instances(count, input…, output…)``, for whole blocks of W
    instances.
    """
    from llvmlite import ir

    from .instructions import emit_function
    from .jit import DOUBLE, DOUBLES, I64, Builder, Value, for_range

    module = ir.Module()
    vector = ir.VectorType(DOUBLE, lanes)
    arrays = [DOUBLES] * (function.n_in() + function.n_out())
    kind = ir.FunctionType(ir.VoidType(), [I64, *arrays])
    run = ir.Function(module, kind, "instances")
    count, *places = run.args
    for place in places:
        place.add_attribute("noalias")
    b: Builder = ir.IRBuilder(run.append_basic_block("entry"))
    with for_range(b, I64(0), stop=b.udiv(count, I64(lanes)), name="block") as block:
        first = b.mul(block, I64(lanes))

        def pointer(array: int, entry: int) -> Value:
            """Return the pointer to an entry of an array at the instances of the block."""
            place = b.gep(places[array], [b.add(b.mul(I64(entry), count), first)])
            return b.bitcast(place, vector.as_pointer())

        def read(array: int, entry: int) -> Value:
            """Load an entry of an input at the instances of the block."""
            return b.load(pointer(array, entry), align=8)

        for output, entry, value in emit_function(b, function, vector=vector, read=read):
            b.store(value, pointer(function.n_in() + output, entry), align=8)
    b.ret_void()
    return module
