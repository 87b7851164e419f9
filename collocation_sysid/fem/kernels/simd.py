"""Vectorised evaluator of element kernels: SX operations as LLVM code on ``<W x double>`` vectors.

Elements are arranged in blocks of W lanes. For every time step and block the native function
gathers the node values, evaluates the kernel at each quadrature point, and adds the outputs of the
block to the row of that time step, so no element output is stored. Contractions with the shape
gradients are loops over nodes, which keeps the code small: it compiles in a fraction of the time,
and fits the instruction cache.
"""

from __future__ import annotations

import ctypes
import hashlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial, reduce

import casadi as ca
import numpy as np
from llvmlite import ir
from numpy.typing import NDArray

from ..kernel import Contraction, ElementKernel, Phase
from .batch import Array, KernelBatch
from .instructions import FUSE, emit_function
from .jit import (
    DOUBLE,
    DOUBLES,
    I32,
    I32S,
    I64,
    Builder,
    NativeCode,
    Value,
    address,
    compile_function,
    for_range,
    vector_lanes,
)
from .threads import run_in_slices

# Number of quadrature points from which optimised code saves more time than its compilation takes.
OPTIMISED_FROM_POINTS = 200


class SimdEvaluator:
    """Evaluator of a `KernelBatch` by native vector code, with time steps distributed over threads.

    Arrays passed to a call must be contiguous float64 arrays of the right shapes; this is not
    checked.

    Raises
    ------
    VectorCodeError
        For operations that vector code does not support.
    RuntimeError
        If LLVM cannot compile the kernel.
    """

    def __init__(self, batch: KernelBatch) -> None:
        lanes = vector_lanes()
        kernel = batch.kernel
        count = len(batch.cells)
        blocks = -(-count // lanes)
        # Padding lanes repeat the last element with volume zero, by which they are known.
        lane_element = np.minimum(np.arange(blocks * lanes), count - 1)
        geometry = batch.geometry[lane_element].copy()
        geometry[count:, :, -1] = 0.0
        by_block = (blocks, lanes)
        self._geometry = np.ascontiguousarray(
            np.moveaxis(geometry.reshape(blocks, lanes, *geometry.shape[1:]), 1, -1)
        )
        self._nodes = _block_major(3 * batch.cells[lane_element], by_block)
        self._destinations = _block_major(batch.destinations[lane_element], by_block)
        self._blocks = blocks
        self._width = batch.width
        self._points = batch.geometry.shape[1]
        self._fields = len(kernel.fields)
        self._point_data_columns = None
        if batch.data_columns is not None:
            self._point_data_columns = _block_major(batch.data_columns[lane_element], by_block)
        tables = self._geometry, self._nodes, self._destinations
        self._tables = [address(table) for table in tables]
        key = f"rows of theta {lanes} {self._points} {hashlib.sha256(kernel.serialized.encode()).hexdigest()}"
        # What points carry adds the length of its row, its places and itself.
        signature = [ctypes.c_int64] * 7 + [ctypes.c_void_p] * (self._fields + 5)
        if kernel.point_data_count:
            signature += [ctypes.c_int64] + [ctypes.c_void_p] * 2
        points = self._points
        build = partial(_emit_kernel, kernel, points, lanes)
        quickly = count * points < OPTIMISED_FROM_POINTS
        self._run = compile_function(
            NativeCode("run", key, signature=tuple(signature), build=build, is_unoptimised=quickly)
        )

    def __call__(
        self,
        fields: Sequence[Array],
        theta: Array,
        out: Array,
        threads: int,
        add: bool = False,
        data_of_points: Array | None = None,
    ) -> None:
        """Sum the kernel over elements and points into `out` (T, width); see `Evaluator`."""
        arguments = [
            self._blocks,
            fields[0].shape[1],
            self._width,
            int(add),
            theta.shape[1] if theta.ndim > 1 else 0,
            *(address(field) for field in fields),
            *self._tables,
            address(theta),
            address(out),
        ]
        if self._point_data_columns is not None and data_of_points is not None:
            arguments += [
                data_of_points.shape[1] if len(data_of_points) > 1 else 0,
                address(self._point_data_columns),
                address(data_of_points),
            ]
        run_in_slices(self._run, len(out), threads=threads, arguments=arguments)


def _emit_kernel(kernel: ElementKernel, points: int, lanes: int) -> ir.Module:
    """Return the LLVM module of a kernel; see `_KernelEmitter` for the arguments."""
    return _KernelEmitter(kernel, points, lanes=lanes).emit()


def _block_major(array: NDArray[np.int64], by_block: tuple[int, int]) -> NDArray[np.int32]:
    """Return an array (blocks · lanes, …) as contiguous int32 (blocks, k, lanes)."""
    blocked = array.reshape(*by_block, -1)
    return np.ascontiguousarray(np.swapaxes(blocked, 1, 2), dtype=np.int32)


class _PhaseLayout:
    """Offsets of the pieces of a phase in their buffer, and of its outputs in the totals.

    Parameters
    ----------
    first : int
        Offset of the outputs of this phase in the totals.
    """

    def __init__(self, phase: Phase, first: int) -> None:
        self.sx = phase.pieces
        self.contractions = list(phase.contractions.values())
        size = 3 * phase.node_count
        entries = phase.gradient_size
        self.lengths = [self.sx.nnz_out(k) for k in range(self.sx.n_out())]
        self.pieces = np.cumsum([0, *self.lengths]).tolist()
        contracted = {
            "none": 1,
            "nodes": size / entries,
            "pairs": size * (size + 1) / 2 / entries**2,
        }
        outputs = [
            round(contracted[how] * length)
            for how, length in zip(self.contractions, self.lengths, strict=True)
        ]
        self.outputs = (first + np.cumsum([0, *outputs])).tolist()

    def output_offsets(self, first: int, how: Contraction, step: int) -> list[int]:
        """Return the offsets in the totals of outputs, in steps of `step` entries."""
        return [
            place
            for k, mine in enumerate(self.contractions)
            if k >= first and mine == how
            for place in range(self.outputs[k], self.outputs[k + 1], step)
        ]


class _KernelEmitter:
    """Emitter of ``run(t0, t1, blocks, field_stride, out_stride, add, theta_stride, fields…,
    geometry, …, out, …)``.

    For kernels with data of the points, the last arguments are the length of a row of data, the
    columns of each point and the data.

    Parameters
    ----------
    points : int
        Quadrature points of an element.
    lanes : int
        Number W of elements in a block.
    """

    def __init__(self, kernel: ElementKernel, points: int, lanes: int) -> None:
        self.fields = len(kernel.fields)
        self.points = points
        self.lanes = lanes
        self.vector = ir.VectorType(DOUBLE, lanes)
        self.nodes = kernel.phases[0].node_count
        self.size = 3 * self.nodes
        self.gradient_size = kernel.phases[0].gradient_size
        # The kernel's own outputs come first among the totals.
        self.last = _PhaseLayout(kernel.phases[-1], 0)
        self.previous_phases: list[_PhaseLayout] = []
        for phase in kernel.previous_phases:
            before = self.previous_phases[-1] if self.previous_phases else self.last
            self.previous_phases.append(_PhaseLayout(phase, before.outputs[-1]))
        # What they hold for the coupling, and for later phases.
        self.own = len(kernel.contractions)
        shared = [(phase, 0) for phase in self.previous_phases] + [(self.last, self.own)]
        self.sums = [at for phase, k in shared for at in phase.output_offsets(k, "none", step=1)]
        self.vectors = [
            at for phase, k in shared for at in phase.output_offsets(k, "nodes", step=self.size)
        ]
        self.coupling = kernel.coupling
        self.module = ir.Module()
        constants = [DOUBLES, I32S, I32S, DOUBLES, DOUBLES]
        self.point_data_count = kernel.point_data_count
        if self.point_data_count:
            constants += [I64, I32S, DOUBLES]
        kind = ir.FunctionType(ir.VoidType(), [I64] * 7 + [DOUBLES] * self.fields + constants)
        self.run = ir.Function(self.module, kind, "run")
        for argument in self.run.args:
            if isinstance(argument.type, ir.PointerType):
                argument.add_attribute("noalias")
        self.builder: Builder = ir.IRBuilder(self.run.append_basic_block("entry"))

    def emit(self) -> ir.Module:
        """Return the LLVM module with the function ``run``."""
        b = self.builder
        args = self.run.args
        t0, t1, blocks, field_stride, out_stride, add, theta_stride = args[:7]
        field_rows = args[7 : 7 + self.fields]
        geometry, nodes, destinations, theta, out, *memory = args[7 + self.fields :]
        gathered = [self._buffer(self.size, f"field{k}") for k in range(self.fields)]
        phases = [*self.previous_phases, self.last]
        outputs = self.last.outputs[self.own]
        total = max(phase.outputs[-1] for phase in phases)
        totals = self._buffer(total, "totals")
        pieces = self._buffer(max(phase.pieces[-1] for phase in phases), "pieces")
        half = self._buffer(3 * self.gradient_size, "half")
        combined = self._buffer(len(self.vectors) * self.size, "combined")
        geometry_size, theta_size = (self.last.sx.nnz_in(self.fields + k) for k in range(2))
        with for_range(b, t0, stop=t1, name="t") as t:
            rows = [b.gep(row, [b.mul(t, field_stride)]) for row in field_rows]
            out_row = b.gep(out, [b.mul(t, out_stride)])
            constants = b.gep(theta, [b.mul(t, theta_stride)])
            parameters = [
                self._splat(b.load(b.gep(constants, [I64(k)]))) for k in range(theta_size)
            ]
            with b.if_then(b.icmp_signed("==", add, I64(0))):
                self._clear(out_row, out_stride)
            with for_range(b, I64(0), stop=blocks, name="block") as block:
                address = b.gep(nodes, [b.mul(block, I64(self.size // 3 * self.lanes))])
                self._gather(rows, address, gathered=gathered)
                with for_range(b, I64(0), stop=I64(total), name="zero") as k:
                    self._store(self.vector(None), totals, entry=k)
                first = b.mul(block, I64(self.points))
                for phase in phases:
                    with for_range(
                        b, first, stop=b.add(first, I64(self.points)), name="point"
                    ) as point:
                        address = b.gep(geometry, [b.mul(point, I64(geometry_size * self.lanes))])
                        point_data = (
                            [self._load_point_data(memory, t, point=point)] if memory else []
                        )
                        self._evaluate_pieces(
                            phase,
                            [*gathered, address, parameters, *point_data, totals],
                            pieces=pieces,
                        )
                        self._contract(phase, pieces, geometry=address, half=half, totals=totals)
                if self.coupling:
                    self._couple(self.coupling, totals, combined=combined)
                address = b.gep(geometry, [b.mul(first, I64(geometry_size * self.lanes))])
                volume = self._load(address, I64(geometry_size - 1))
                zero = self.vector(None)
                # Not left to the product with the volume, which makes NaN of what is infinite.
                is_element = b.fcmp_ordered("!=", volume, zero)
                targets = b.gep(destinations, [b.mul(block, I64(outputs * self.lanes))])
                with for_range(b, I64(0), stop=I64(outputs), name="output") as k:
                    value = b.select(is_element, self._load(totals, k), zero)
                    self._scatter(value, targets, k=k, row=out_row)
        b.ret_void()
        return self.module

    def _buffer(self, count: int, name: str) -> Value:
        """Allocate memory for `count` vectors in the entry of the function."""
        buffer = self.builder.alloca(DOUBLE, size=I64(count * self.lanes), name=name)
        buffer.align = 64
        return buffer

    def _clear(self, row: ir.Value, length: ir.Value) -> None:
        """Set the outputs of one time step to zero; they stay in the cache while summed."""
        b = self.builder
        bytes_ = ir.IntType(8).as_pointer()
        memset = self.module.declare_intrinsic("llvm.memset", (bytes_, I64))
        size = b.mul(length, I64(8))
        b.call(memset, [b.bitcast(row, bytes_), ir.IntType(8)(0), size, ir.IntType(1)(0)])

    def _pointer(self, base: Value, entry: Value) -> Value:
        """Return the pointer to the vector with the index `entry`, not a constant."""
        b = self.builder
        address = b.gep(base, [b.mul(entry, I64(self.lanes))])
        return b.bitcast(address, self.vector.as_pointer())

    def _load(self, base: Value, entry: Value) -> Value:
        """Load the vector with the index `entry` from a buffer that begins at `base`."""
        return self.builder.load(self._pointer(base, entry), align=8)

    def _store(self, value: Value, base: Value, entry: Value) -> None:
        """Store a vector at the index `entry` of a buffer that begins at `base`."""
        self.builder.store(value, self._pointer(base, entry), align=8)

    def _splat(self, scalar: Value) -> Value:
        """Return a vector of W equal scalars."""
        value: Value = ir.Constant(self.vector, ir.Undefined)
        for lane in range(self.lanes):
            value = self.builder.insert_element(value, scalar, I32(lane))
        return value

    def _gather(self, rows: list, nodes: Value, gathered: list) -> None:
        """Emit the load of the three coordinates of every node of W elements."""
        b = self.builder
        with for_range(b, I64(0), stop=I64(self.size // 3), name="node") as node:
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
                    self._store(value, buffer, entry=b.add(b.mul(node, I64(3)), I64(axis)))

    def _scatter(self, value: Value, targets: Value, k: Value, row: Value) -> None:
        """Add the W lanes of one output entry at the destinations of their elements."""
        b = self.builder
        first = b.mul(k, I64(self.lanes))
        for lane in range(self.lanes):
            target = b.sext(b.load(b.gep(targets, [b.add(first, I64(lane))])), I64)
            address = b.gep(row, [target])
            b.store(b.fadd(b.load(address), b.extract_element(value, I32(lane))), address)

    def _load_point_data(self, memory: list, t: Value, point: Value) -> list:
        """Return the data of a point of W elements at step t, a vector for each datum."""
        b = self.builder
        length, places, rows = memory
        row = b.gep(rows, [b.mul(t, length)])
        first = b.mul(point, I64(self.point_data_count * self.lanes))
        values = []
        for entry in range(self.point_data_count):
            value: Value = ir.Constant(self.vector, ir.Undefined)
            for lane in range(self.lanes):
                position = b.gep(places, [b.add(first, I64(entry * self.lanes + lane))])
                scalar = b.load(b.gep(row, [b.sext(b.load(position), I64)]))
                value = b.insert_element(value, scalar, I32(lane))
            values.append(value)
        return values

    def _evaluate_pieces(self, phase: _PhaseLayout, inputs: list, pieces: Value) -> None:
        """Emit the evaluation of the pieces of one quadrature point, and store them."""

        def read(slot: int, entry: int) -> Value:
            """Return an entry of the input with the index `slot`."""
            if isinstance(inputs[slot], list):
                return inputs[slot][entry]
            place = self.sums[entry] if slot == len(inputs) - 1 else entry
            return self._load(inputs[slot], I64(place))

        for piece, entry, value in emit_function(
            self.builder, phase.sx, vector=self.vector, read=read
        ):
            self._store(value, pieces, entry=I64(phase.pieces[piece] + entry))

    def _contract(
        self, phase: _PhaseLayout, pieces: Value, geometry: Value, half: Value, totals: Value
    ) -> None:
        """Add the pieces of one point to the totals, contracted as in `kernel._contracted`."""
        b = self.builder
        for k, how in enumerate(phase.contractions):
            piece_base = self._offset_pointer(pieces, phase.pieces[k])
            output_base = self._offset_pointer(totals, phase.outputs[k])
            length = phase.lengths[k]
            if how == "none":
                with for_range(b, I64(0), stop=I64(length), name="entry") as entry:
                    self._accumulate(self._load(piece_base, entry), output_base, entry=entry)
            elif how == "nodes":
                with for_range(b, I64(0), stop=I64(self.nodes), name="node") as node:
                    values = self._at_node(
                        piece_base, length // self.gradient_size, self._gradient(geometry, node)
                    )
                    for column, row, value in values:
                        first = I64(column * self.size + row)
                        self._accumulate(
                            value, output_base, entry=b.add(b.mul(node, I64(3)), first)
                        )
            else:
                with for_range(b, I64(0), stop=I64(self.nodes), name="column") as node:
                    gradient = self._gradient(geometry, node)
                    size = self.gradient_size
                    for column, row, value in self._at_node(piece_base, size, gradient):
                        self._store(value, half, I64(column + size * row))
                    self._add_node_block(half, gradient, a=node, node=node, outputs=output_base)
                    with for_range(
                        b, b.add(node, I64(1)), stop=I64(self.nodes), name="row"
                    ) as other:
                        self._add_node_block(
                            half,
                            self._gradient(geometry, other),
                            a=other,
                            node=node,
                            outputs=output_base,
                        )

    def _add_node_block(
        self, half: Value, gradient: list, a: Value, node: Value, outputs: Value
    ) -> None:
        """Add rows of node `a` to columns of `node`; if both agree, the lower triangle."""
        b = self.builder
        for column, row, value in self._at_node(half, 3, gradient):
            if a is node and row < column:
                continue
            c = b.add(b.mul(node, I64(3)), I64(column))
            r = b.add(b.mul(a, I64(3)), I64(row))
            self._accumulate(value, outputs, entry=b.add(self._column_start(c), r))

    def _column_start(self, c: Value) -> Value:
        """Return c (2 size − c − 1) / 2, the offset of column c, less its row index."""
        b = self.builder
        return b.lshr(b.mul(c, b.sub(I64(2 * self.size - 1), c)), I64(1))

    def _couple(self, coupling: ca.Function, totals: Value, combined: Value) -> None:
        """Add the coupling of the node vectors to `totals`; `combined` is for products with D."""
        b = self.builder
        for k, columns in enumerate(self._coefficients(coupling, totals)):
            how = self.last.contractions[k]
            output_base = self._offset_pointer(totals, self.last.outputs[k])
            if how == "nodes":
                self._combine(columns, totals, output_base, self._accumulate)
            elif how == "pairs":
                self._combine(columns, totals, combined, self._store)
                with for_range(b, I64(0), stop=I64(self.size), name="column") as c:
                    factors = [
                        (
                            j * self.size,
                            self._load(self._offset_pointer(totals, self.vectors[j]), c),
                        )
                        for j in columns
                    ]
                    start = b.gep(output_base, [b.mul(self._column_start(c), I64(self.lanes))])
                    with for_range(b, c, stop=I64(self.size), name="row") as r:
                        self._accumulate(
                            self._combination(factors, combined, entry=r), start, entry=r
                        )

    def _coefficients(self, coupling: ca.Function, totals: Value) -> list[dict[int, list]]:
        """Return for each output, by column, offsets of node vectors and coefficients."""
        outputs = [coupling.sparsity_out(k) for k in range(coupling.n_out())]
        entries = [list(zip(*output.get_triplet(), strict=True)) for output in outputs]
        columns: list[dict[int, list]] = [{} for _ in outputs]

        def read(_: int, entry: int) -> Value:
            """Load an entry of the vector of all uncontracted sums."""
            return self._load(totals, I64(self.sums[entry]))

        for k, entry, value in emit_function(self.builder, coupling, vector=self.vector, read=read):
            row, column = entries[k][entry]
            columns[k].setdefault(column, []).append((self.vectors[row], value))
        return columns

    def _combine(
        self, columns: dict[int, list], totals: Value, out: Value, put: Callable[..., None]
    ) -> None:
        """Emit combinations of node vectors as columns of a matrix (3·nodes, any)."""
        for column, factors in columns.items():
            column_base = self._offset_pointer(out, column * self.size)
            with for_range(self.builder, I64(0), stop=I64(self.size), name="entry") as entry:
                put(self._combination(factors, totals, entry=entry), column_base, entry)

    def _combination(self, factors: list, base: Value, entry: Value) -> Value:
        """Return one entry of a linear combination of vectors."""
        b = self.builder
        terms = [
            b.fmul(self._load(self._offset_pointer(base, place), entry), factor, flags=FUSE)
            for place, factor in factors
        ]
        return reduce(lambda x, y: b.fadd(x, y, flags=FUSE), terms)

    def _at_node(self, stress: Value, columns: int, gradient: list) -> Iterator[tuple]:
        """Emit the product of a piece with the shape gradient of one node."""
        for column in range(columns):
            for row in range(3):
                terms = [
                    self.builder.fmul(
                        self._load(stress, I64(self.gradient_size * column + row + 3 * axis)),
                        gradient[axis],
                        flags=FUSE,
                    )
                    for axis in range(len(gradient))
                ]
                value = reduce(lambda x, y: self.builder.fadd(x, y, flags=FUSE), terms)
                yield (column, row, value)

    def _gradient(self, geometry: Value, node: Value) -> list:
        """Load the shape gradient of a node, a list of c vectors, from the geometry of a point."""
        columns = self.gradient_size // 3
        first = self.builder.mul(node, I64(columns))
        return [self._load(geometry, self.builder.add(first, I64(axis))) for axis in range(columns)]

    def _offset_pointer(self, base: Value, entry: int) -> Value:
        """Return the pointer to the vector with the constant index `entry`."""
        return self.builder.gep(base, [I64(entry * self.lanes)])

    def _accumulate(self, value: Value, base: Value, entry: Value) -> None:
        """Add a vector to that at the index `entry` of a buffer that begins at `base`."""
        self._store(self.builder.fadd(self._load(base, entry), value), base, entry=entry)
