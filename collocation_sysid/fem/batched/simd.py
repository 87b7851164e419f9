"""Vectorised kernels: SX instructions emitted as LLVM IR on ``<W x double>`` vectors.

Elements are laid out in blocks of W lanes. For every timestep and block the native function
gathers the node values, runs the kernel at each quadrature point, and adds the block's outputs
straight into the row of that timestep, so no element output outlives its block.
"""

from __future__ import annotations

import ctypes
import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import casadi as ca
import numpy as np
from llvmlite import ir
from numpy.typing import NDArray

from ...errors import InputError
from .batch import Array, Batch
from .jit import CompiledFunction, vector_lanes
from .threads import in_slices

DOUBLE, I32, I64 = ir.DoubleType(), ir.IntType(32), ir.IntType(64)
DOUBLES, I32S = DOUBLE.as_pointer(), I32.as_pointer()
Builder = Value = Any  # llvmlite is not annotated, and what is inferred of it is wrong


class SimdEvaluator:
    """Evaluate a `Batch` with native vector code, timesteps shared among threads."""

    def __init__(self, batch: Batch) -> None:
        lanes = vector_lanes()
        kernel = batch.kernel
        count = len(batch.cells)
        blocks = -(-count // lanes)
        # Padding lanes repeat the last element with volume zero: they add exactly nothing.
        lane_element = np.minimum(np.arange(blocks * lanes), count - 1)
        geometry = batch.geometry[lane_element].copy()
        geometry[count:, :, -1] = 0.0
        by_block = (blocks, lanes)
        self._geometry = np.ascontiguousarray(
            np.moveaxis(geometry.reshape(*by_block, *geometry.shape[1:]), 1, -1)
        )
        self._nodes = _block_major(3 * batch.cells[lane_element], by_block)
        self._destinations = _block_major(batch.destinations[lane_element], by_block)
        self._blocks = blocks
        self._width = batch.width
        self._points = batch.geometry.shape[1]
        self._fields = len(kernel.fields)
        source = kernel.function.serialize()
        key = f"{lanes} {self._points} {hashlib.sha256(source.encode()).hexdigest()}"
        signature = [ctypes.c_int64] * 5 + [ctypes.c_void_p] * (self._fields + 5)
        self._run = CompiledFunction(
            lambda: _emit(kernel.function, self._fields, self._points, lanes),
            "run",
            key,
            signature,
        )

    def __call__(self, fields: Sequence[Array], theta: Array, out: Array, threads: int) -> None:
        """Add up the kernel over elements and points into `out` (T, width), overwriting it."""
        addresses = [field.ctypes.data for field in fields]
        constants = [
            self._geometry.ctypes.data,
            self._nodes.ctypes.data,
            self._destinations.ctypes.data,
            theta.ctypes.data,
            out.ctypes.data,
        ]
        stride = fields[0].shape[1]

        def run(start: int, stop: int) -> None:
            self._run(start, stop, self._blocks, stride, self._width, *addresses, *constants)

        in_slices(run, len(out), threads)


def _block_major(array: NDArray[np.int64], by_block: tuple[int, int]) -> NDArray[np.int32]:
    """(blocks · lanes, k) to contiguous (blocks, k, lanes)."""
    blocked = array.reshape(*by_block, -1)
    return np.ascontiguousarray(np.swapaxes(blocked, 1, 2), dtype=np.int32)


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


class _Emitter:
    """Writes ``run(t0, t1, blocks, field_stride, out_stride, fields…, geometry, …, out)``."""

    def __init__(self, function: ca.Function, fields: int, points: int, lanes: int) -> None:
        self.sx = function
        self.fields = fields
        self.points = points
        self.lanes = lanes
        self.vector = ir.VectorType(DOUBLE, lanes)
        self.output_offsets = np.cumsum(
            [0] + [function.nnz_out(k) for k in range(function.n_out())]
        )
        self.size = function.nnz_in(0)
        self.module = ir.Module()
        constants = [DOUBLES, I32S, I32S, DOUBLES, DOUBLES]
        kind = ir.FunctionType(ir.VoidType(), [I64] * 5 + [DOUBLES] * fields + constants)
        self.run = ir.Function(self.module, kind, "run")
        for argument in self.run.args:
            if isinstance(argument.type, ir.PointerType):
                argument.add_attribute("noalias")
        self.builder: Builder = ir.IRBuilder(self.run.append_basic_block("entry"))

    def emit(self) -> ir.Module:
        b, args = self.builder, self.run.args
        t0, t1, blocks, field_stride, out_stride = args[:5]
        field_rows = args[5 : 5 + self.fields]
        geometry, nodes, destinations, theta, out = args[5 + self.fields :]
        gathered = [self._buffer(self.size, f"field{k}") for k in range(self.fields)]
        total = int(self.output_offsets[-1])
        outputs = self._buffer(total, "outputs")
        geometry_size, theta_size = self.sx.nnz_in(self.fields), self.sx.nnz_in(self.fields + 1)
        parameters = [self._splat(b.load(b.gep(theta, [I64(k)]))) for k in range(theta_size)]
        with counting(b, t0, t1, "t") as t:
            rows = [b.gep(row, [b.mul(t, field_stride)]) for row in field_rows]
            out_row = b.gep(out, [b.mul(t, out_stride)])
            self._clear(out_row, out_stride)
            with counting(b, I64(0), blocks, "block") as block:
                here = b.gep(nodes, [b.mul(block, I64(self.size // 3 * self.lanes))])
                self._gather(rows, here, gathered)
                if self.points > 1:
                    with counting(b, I64(0), I64(total), "zero") as k:
                        self._store(self.vector(None), outputs, k)
                first = b.mul(block, I64(self.points))
                with counting(b, first, b.add(first, I64(self.points)), "point") as point:
                    here = b.gep(geometry, [b.mul(point, I64(geometry_size * self.lanes))])
                    self._kernel(gathered, here, parameters, outputs)
                targets = b.gep(destinations, [b.mul(block, I64(total * self.lanes))])
                with counting(b, I64(0), I64(total), "output") as k:
                    self._scatter(self._load(outputs, k), targets, k, out_row)
        b.ret_void()
        return self.module

    def _buffer(self, count: int, name: str) -> Value:
        buffer = self.builder.alloca(DOUBLE, size=I64(count * self.lanes), name=name)
        buffer.align = 64
        return buffer

    def _clear(self, row: ir.Value, length: ir.Value) -> None:
        """Zero one timestep's outputs, which then stay in the cache while they are added up."""
        b, bytes_ = self.builder, ir.IntType(8).as_pointer()
        memset = self.module.declare_intrinsic("llvm.memset", (bytes_, I64))
        size = b.mul(length, I64(8))
        b.call(memset, [b.bitcast(row, bytes_), ir.IntType(8)(0), size, ir.IntType(1)(0)])

    def _pointer(self, base: Value, entry: Value) -> Value:
        b = self.builder
        address = b.gep(base, [b.mul(entry, I64(self.lanes))])
        return b.bitcast(address, self.vector.as_pointer())

    def _load(self, base: Value, entry: Value) -> Value:
        return self.builder.load(self._pointer(base, entry), align=8)

    def _store(self, value: Value, base: Value, entry: Value) -> None:
        self.builder.store(value, self._pointer(base, entry), align=8)

    def _splat(self, scalar: Value) -> Value:
        value: Value = ir.Constant(self.vector, ir.Undefined)
        for lane in range(self.lanes):
            value = self.builder.insert_element(value, scalar, I32(lane))
        return value

    def _gather(self, rows: list, nodes: Value, gathered: list) -> None:
        """Load the three coordinates of every node of W elements, field by field."""
        b = self.builder
        with counting(b, I64(0), I64(self.size // 3), "node") as node:
            first = b.mul(node, I64(self.lanes))
            lanes = [
                b.sext(b.load(b.gep(nodes, [b.add(first, I64(lane))])), I64)
                for lane in range(self.lanes)
            ]
            for row, buffer in zip(rows, gathered, strict=True):
                for axis in range(3):
                    value: Value = ir.Constant(self.vector, ir.Undefined)
                    for lane, entry in enumerate(lanes):
                        scalar = b.load(b.gep(row, [b.add(entry, I64(axis))]))
                        value = b.insert_element(value, scalar, I32(lane))
                    self._store(value, buffer, b.add(b.mul(node, I64(3)), I64(axis)))

    def _scatter(self, value: Value, targets: Value, k: Value, row: Value) -> None:
        """Add the W lanes of one output entry where their elements' destinations are."""
        b = self.builder
        first = b.mul(k, I64(self.lanes))
        for lane in range(self.lanes):
            target = b.sext(b.load(b.gep(targets, [b.add(first, I64(lane))])), I64)
            address = b.gep(row, [target])
            b.store(b.fadd(b.load(address), b.extract_element(value, I32(lane))), address)

    def _kernel(self, gathered: list, geometry: Value, parameters: list, outputs: Value) -> None:
        """Walk the SX instructions of one quadrature point."""
        work: dict[int, Value] = {}
        sx = self.sx
        for k in range(sx.n_instructions()):
            operation, source = sx.instruction_id(k), sx.instruction_input(k)
            target = sx.instruction_output(k)
            if operation == ca.OP_INPUT:
                slot, entry = source
                if slot < self.fields:
                    work[target[0]] = self._load(gathered[slot], I64(entry))
                elif slot == self.fields:
                    work[target[0]] = self._load(geometry, I64(entry))
                else:
                    work[target[0]] = parameters[entry]
            elif operation == ca.OP_CONST:
                constant = float(sx.instruction_constant(k))
                work[target[0]] = ir.Constant(self.vector, [constant] * self.lanes)
            elif operation == ca.OP_OUTPUT:
                entry = I64(int(self.output_offsets[target[0]]) + target[1])
                value = work[source[0]]
                if self.points > 1:
                    value = self.builder.fadd(self._load(outputs, entry), value)
                self._store(value, outputs, entry)
            else:
                work[target[0]] = self._operate(operation, [work[i] for i in source])

    def _operate(self, operation: int, operands: list) -> Value:
        b, x = self.builder, operands[0]
        fuse = ["contract"]
        binary = {
            ca.OP_ADD: b.fadd,
            ca.OP_SUB: b.fsub,
            ca.OP_MUL: b.fmul,
            ca.OP_DIV: b.fdiv,
        }
        if operation in binary:
            return binary[operation](x, operands[1], flags=fuse)
        if operation == ca.OP_SQ:
            return b.fmul(x, x, flags=fuse)
        if operation == ca.OP_TWICE:
            return b.fadd(x, x, flags=fuse)
        if operation == ca.OP_NEG:
            return b.fneg(x)
        if operation == ca.OP_ASSIGN:
            return x
        if operation == ca.OP_INV:
            return b.fdiv(ir.Constant(self.vector, [1.0] * self.lanes), x, flags=fuse)
        if operation in INTRINSICS:
            kind = ir.FunctionType(self.vector, [self.vector] * len(operands))
            name = f"llvm.{INTRINSICS[operation]}.v{self.lanes}f64"
            intrinsic = self.module.globals.get(name) or ir.Function(self.module, kind, name)
            return b.call(intrinsic, operands)
        names = (name for name, number in vars(ca).items() if number == operation)
        name = next((name for name in names if name.startswith("OP_")), operation)
        raise InputError(
            f"the vector evaluator has no CasADi operation {name}; "
            "choose evaluator='casadi' for this material"
        )


INTRINSICS = {
    ca.OP_SQRT: "sqrt",
    ca.OP_FABS: "fabs",
    ca.OP_LOG: "log",
    ca.OP_EXP: "exp",
    ca.OP_POW: "pow",
    ca.OP_CONSTPOW: "pow",
    ca.OP_SIN: "sin",
    ca.OP_COS: "cos",
    ca.OP_FMIN: "minnum",
    ca.OP_FMAX: "maxnum",
}


def _emit(function: ca.Function, fields: int, points: int, lanes: int) -> ir.Module:
    return _Emitter(function, fields, points, lanes).emit()
