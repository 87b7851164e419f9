"""Compiled factorisation L D Uᵀ of narrow banded matrices within their skyline, without row
exchanges.

LAPACK's blocks are as high as the widest row, its LU factorisation reserves space for row
exchanges, and it solves column by column. Here a few pivots are eliminated at a time, each one acts
only on the rows within its reach, and one pass over the factors serves all right-hand sides. Use
LAPACK for bands that exceed the cache.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from llvmlite import ir
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from .instructions import FUSE
from .jit import (
    DOUBLE,
    DOUBLES,
    I32,
    I64,
    Builder,
    CompiledFunction,
    NativeCode,
    Value,
    address,
    compile_function,
    for_range,
    vector_lanes,
)

# Number of pivots that are eliminated at a time: each row is read and written once for all of them.
PIVOTS = 4
# Size of a cache line, to which memory is aligned [bytes].
LINE_BYTES = 64
# Numbers of integer arguments, integer arrays and floating-point arrays of each compiled function.
ARGUMENTS = {"fill": (1, 2, 5), "factorise": (2, 1, 4), "solve": (4, 1, 4)}


class SkylineFactorisation:
    """Factorisation of matrices with a common skyline.

    A side holds a triangle: row k contains column k of the lower triangle, or row k of the upper
    one, in whole vectors of matrix positions, so that all loads are aligned.

    Parameters
    ----------
    size : int
        Number n of rows.
    rows, columns : (e,) int
        Row and column of the entries of one triangle, with the diagonal; each entry may be given in
        either triangle.
    source : (e,) int
        Positions of the entries in given values.

    Attributes
    ----------
    shape : (n, width)
        Shape of a side.

    Raises
    ------
    RuntimeError
        If LLVM cannot compile the code.
    """

    def __init__(self, size: int, rows: Index, columns: Index, source: Index) -> None:
        low = np.minimum(rows, columns)
        high = np.maximum(rows, columns)
        reach = np.arange(size)
        np.maximum.at(reach, low, high)
        self._reach = np.maximum.accumulate(reach)
        height = int((self._reach - np.arange(size)).max(initial=0))
        lanes = vector_lanes()
        # As far as the last of some pivots reaches; an odd number spreads rows over the cache.
        vectors = -(-(height + PIVOTS + lanes) // lanes) | 1
        self.shape = size, vectors * lanes
        places = low * self.shape[1] + high - low // lanes * lanes
        order = np.argsort(places)
        self._places = places[order]
        self._source = source[order]
        on_diagonal = rows == columns
        self._diagonal = source[on_diagonal][np.argsort(rows[on_diagonal])]
        # A skew part's entries have another sign beyond the diagonal.
        self._signs = np.where(rows < columns, -1.0, 1.0)[order]
        (self._reached,) = _addresses(self._reach)
        self._fixed = _addresses(self._source, self._places, self._signs)
        self._kernels = {k: (_compile("fill", k), _compile("factorise", k)) for k in (1, 2)}
        self._solve = _compile("solve", 1)

    def allocate(self, sides: int) -> FactorMemory:
        """Return memory, filled with zeros, for a factorisation of one matrix.

        Parameters
        ----------
        sides : int
            1 for a symmetric matrix, otherwise 2.

        Returns
        -------
        FactorMemory
            Sides (sides, n, width), aligned with cache lines, and results (2, n + width).
        """
        array_size = sides * math.prod(self.shape)
        size, width = self.shape
        memory = np.zeros(array_size + LINE_BYTES // 8)
        start = -memory.ctypes.data % LINE_BYTES // 8
        return FactorMemory(
            memory[start : start + array_size].reshape(sides, *self.shape),
            np.zeros((2, size + width)),
        )

    def factorise(self, room: FactorMemory, symmetric: Array, skew: Array) -> tuple[Array, Array]:
        """Compute L and U without their unit diagonals in the given memory; only L for a symmetric
        matrix.

        Zero pivots are not detected: they give infinite or NaN results.

        Parameters
        ----------
        room : FactorMemory
            Memory with one side for a symmetric matrix, else two; overwritten.
        symmetric, skew : array
            Values of the symmetric and skew parts of the matrix, in which `source` are positions;
            `skew` is empty if there is none.

        Returns
        -------
        pivots : (n,)
            Diagonal D; a view of the memory.
        growth : (n,)
            Σ_k |L_ik D_k U_ik| / A_ii: bound of the relative change of each diagonal entry. Zero
            for a symmetric matrix.
        """
        size, width = self.shape
        count = 2 if skew.size else 1
        room.sides[:count].fill(0)
        room.results.fill(0)
        fill, factorise = self._kernels[count]
        parts = [np.ascontiguousarray(part, dtype=float) for part in (symmetric, skew)]
        ends = room.ends[:1] * 2 if count == 1 else room.ends
        fill(len(self._source), *self._fixed, *_addresses(*parts), *ends)
        factorise(size, width, self._reached, *ends, *room.results_at)
        pivots, growth = room.results[:, :size]
        if count == 2:
            with np.errstate(divide="ignore", invalid="ignore"):
                growth = growth / symmetric[self._diagonal]
        return pivots, growth

    def solve(self, first: Array, pivots: Array, second: Array, right: Array) -> Array:
        """Return the solutions of L D Uᵀ x = b for the rows b of `right`, (columns, n), in new
        memory.

        Exchange `first` and `second` to solve with the transposed matrix.

        Parameters
        ----------
        first, second : (n, width)
            Sides of L and of U; twice the same for a symmetric matrix.
        pivots : (n,)
            Diagonal D.
        right : (columns, n)
            Right-hand sides; not modified.
        """
        size, width = self.shape
        rows = np.empty((len(right), size + width))
        rows[:, :size] = right
        rows[:, size:] = 0.0
        columns, stride = rows.shape
        addresses = _addresses(first, second, pivots, rows)
        self._solve(size, width, columns, stride, self._reached, *addresses)
        return rows[:, :size]


class FactorMemory:
    """Memory of one factorisation.

    Parameters
    ----------
    sides : (1, n, width) for a symmetric matrix, or (2, n, width)
    results : (2, n + width)
        Pivots and growth.
    """

    def __init__(self, sides: Array, results: Array) -> None:
        self.sides = sides
        self.results = results
        self.ends = _addresses(*sides)
        self.results_at = _addresses(*results)


def _addresses(*arrays: NDArray[Any]) -> list[int]:
    """Return the addresses of arrays."""
    return [address(array) for array in arrays]


def _compile(name: str, sides: int) -> CompiledFunction:
    """Return "fill", "factorise" or "solve" for a symmetric matrix (1 side) or any (2)."""
    emit: Callable[[_SkylineEmitter], ir.Module] = getattr(_SkylineEmitter, name)
    integers, *arrays = ARGUMENTS[name]
    lanes = vector_lanes()
    signature = (*[ctypes.c_int64] * integers, *[ctypes.c_void_p] * sum(arrays))
    key = f"skyline {name} {sides} {lanes}"
    return compile_function(
        NativeCode(
            name, key, signature=signature, build=lambda: emit(_SkylineEmitter(lanes, sides))
        )
    )


class _SkylineEmitter:
    """Emitter of the loops over vectors of matrix rows.

    Parameters
    ----------
    lanes : int
        Number of doubles of a vector.
    sides : int
        1 for a symmetric matrix, otherwise 2.
    """

    def __init__(self, lanes: int, sides: int) -> None:
        self.lanes = lanes
        self.count = sides
        self.vector = ir.VectorType(DOUBLE, lanes)
        self.module = ir.Module()

    def _begin(self, name: str) -> Sequence[Value]:
        """Begin a function with the arguments of `ARGUMENTS`; `b` becomes its builder."""
        integers, maps, arrays = ARGUMENTS[name]
        kinds = [I64] * integers + [I64.as_pointer()] * maps + [DOUBLES] * arrays
        function = ir.Function(self.module, ir.FunctionType(ir.VoidType(), kinds), name)
        self.b: Builder = ir.IRBuilder(function.append_basic_block("entry"))
        return function.args

    def fill(self) -> Any:
        """Return the module of ``fill(entries, source, places, signs, symmetric, …)``."""
        count, source, places, signs, symmetric, skew, lower, upper = self._begin("fill")
        b = self.b
        with for_range(b, I64(0), stop=count, name="entry") as k:
            origin, place = (b.load(b.gep(array, [k])) for array in (source, places))
            value = b.load(b.gep(symmetric, [origin]))
            if self.count == 1:
                b.store(value, b.gep(lower, [place]))
            else:
                sign = b.load(b.gep(signs, [k]))
                other = b.load(b.gep(skew, [origin]))
                signed_skew = b.fmul(sign, other)
                b.store(b.fadd(value, signed_skew), b.gep(lower, [place]))
                b.store(b.fsub(value, signed_skew), b.gep(upper, [place]))
        b.ret_void()
        return self.module

    def factorise(self) -> Any:
        """Return the module of ``factorise(n, width, reach, lower, upper, pivots, growth)``."""
        size, self.width, self.reach, *sides, self.pivots, self.growth = self._begin("factorise")
        self.sides = sides[: self.count]
        kind = ir.FunctionType(self.vector, [self.vector])
        self.absolute = ir.Function(self.module, kind, f"llvm.fabs.v{self.lanes}f64")
        b = self.b
        groups = b.sdiv(size, I64(PIVOTS))
        with for_range(b, I64(0), stop=groups, name="group") as group:
            first = b.mul(group, I64(PIVOTS))
            self._eliminate([b.add(first, I64(p)) for p in range(PIVOTS)])
        with for_range(b, b.mul(groups, I64(PIVOTS)), stop=size, name="rest") as pivot:
            self._eliminate([pivot])
        b.ret_void()
        return self.module

    def _eliminate(self, pivots: Sequence[Value]) -> None:
        """Emit the elimination of consecutive pivots, with one pass over the rows."""
        b = self.b
        last = b.load(b.gep(self.reach, [pivots[-1]]))
        for p, pivot in enumerate(pivots):
            self._scale(pivot, last)
            for later in pivots[p + 1 :]:
                self._subtract([pivot], later, last=last)
        next_row = b.add(pivots[-1], I64(1))
        with for_range(b, next_row, stop=b.add(last, I64(1)), name="row") as row:
            self._subtract(pivots, row, last=last)

    def _scale(self, pivot: Value, last: Value) -> None:
        """Emit the division of the entries beyond a pivot, up to the position `last`, by the pivot,
        which is stored in D; the pivot itself and entries before it in its vector become zero. With
        two sides, add |L_ik D_k U_ik| to the growth of each row i.
        """
        b = self.b
        diagonal = b.load(self._entry(self.sides[0], pivot, place=pivot))
        b.store(diagonal, b.gep(self.pivots, [pivot]))
        inverse = self._splat(b.fdiv(DOUBLE(1.0), diagonal))
        lanes = ir.Constant(ir.VectorType(I64, self.lanes), list(range(self.lanes)))
        with self._vectors(pivot, last) as start:
            after = b.icmp_signed(">", lanes, self._splat(b.sub(pivot, start)))
            places = [self._entry(side, pivot, place=start) for side in self.sides]
            nothing = ir.Constant(self.vector, [0.0] * self.lanes)
            values = [b.select(after, self._load(place), nothing) for place in places]
            scaled = [b.fmul(value, inverse) for value in values]
            for place, value in zip(places, scaled, strict=True):
                self._store(value, place)
            if self.count == 2:
                grown = b.gep(self.growth, [start])
                change = b.call(self.absolute, [b.fmul(values[0], scaled[1])])
                self._store(b.fadd(self._load(grown), change), grown)

    def _subtract(self, pivots: Sequence[Value], row: Value, last: Value) -> None:
        """Subtract the contribution of pivots from a row of each side, up to `last`."""
        b = self.b
        scales = []
        for pivot in pivots:
            diagonal = b.load(b.gep(self.pivots, [pivot]))
            row_entries = [
                b.load(self._entry(side, pivot, place=row)) for side in reversed(self.sides)
            ]
            scales.append([self._splat(b.fmul(diagonal, value)) for value in row_entries])
        with self._vectors(row, last) as start:
            for k, side in enumerate(self.sides):
                target = self._entry(side, row, place=start)
                value = self._load(target)
                for pivot, scale in zip(pivots, scales, strict=True):
                    value = self._multiply_subtract(
                        value, self._load(self._entry(side, pivot, place=start)), y=scale[k]
                    )
                self._store(value, target)

    def solve(self) -> Any:
        """Return the module of ``solve(n, width, columns, stride, reach, first, second, …)``."""
        (size, self.width, columns, stride, reach, first, second, pivots, rows) = self._begin(
            "solve"
        )
        b = self.b
        kind = ir.FunctionType(DOUBLE, [DOUBLE, self.vector])
        total = ir.Function(self.module, kind, f"llvm.vector.reduce.fadd.v{self.lanes}f64")
        dot = b.alloca(self.vector)
        with for_range(b, I64(0), stop=size, name="forward") as k:
            last = b.load(b.gep(reach, [k]))
            with for_range(b, I64(0), stop=columns, name="column") as column:
                right = b.gep(rows, [b.mul(column, stride)])
                loaded = self._splat(b.load(b.gep(right, [k])))
                with self._vectors(k, last) as start:
                    place = b.gep(right, [start])
                    factor = self._entry(first, k, place=start)
                    self._store(
                        self._multiply_subtract(self._load(place), self._load(factor), y=loaded),
                        place,
                    )
        with for_range(b, I64(0), stop=size, name="backward") as done:
            k = b.sub(b.sub(size, I64(1)), done)
            last = b.load(b.gep(reach, [k]))
            diagonal = b.load(b.gep(pivots, [k]))
            with for_range(b, I64(0), stop=columns, name="column") as column:
                right = b.gep(rows, [b.mul(column, stride)])
                b.store(ir.Constant(self.vector, [0.0] * self.lanes), dot)
                with self._vectors(k, last) as start:
                    loaded = b.gep(right, [start])
                    factor = self._entry(second, k, place=start)
                    b.store(
                        self._multiply_subtract(
                            b.load(dot), self._load(loaded), y=self._load(factor)
                        ),
                        dot,
                    )
                solution = b.gep(right, [k])
                scaled = b.fdiv(b.load(solution), diagonal)
                b.store(b.call(total, [scaled, b.load(dot)], fastmath=("reassoc",)), solution)
        b.ret_void()
        return self.module

    @contextmanager
    def _vectors(self, first: Value, last: Value) -> Iterator[Value]:
        """Loop over the start positions of the vectors that contain rows from `first` to `last`."""
        b = self.b
        lanes = I64(self.lanes)
        stop = b.add(b.sdiv(last, lanes), I64(1))
        with for_range(b, b.sdiv(first, lanes), stop=stop, name="vector") as k:
            yield b.mul(k, lanes)

    def _entry(self, side: Value, row: Value, place: Value) -> Value:
        """Return the pointer to the entry of row `row` of a side at matrix position `place`."""
        b = self.b
        lanes = I64(self.lanes)
        start = b.mul(b.sdiv(row, lanes), lanes)
        return b.gep(side, [b.add(b.mul(row, self.width), b.sub(place, start))])

    def _load(self, place: Value) -> Value:
        """Load a vector from a pointer."""
        return self.b.load(self.b.bitcast(place, self.vector.as_pointer()), align=8)

    def _store(self, value: Value, place: Value) -> None:
        """Store a vector at a pointer."""
        self.b.store(value, self.b.bitcast(place, self.vector.as_pointer()), align=8)

    def _multiply_subtract(self, value: Value, x: Value, y: Value) -> Value:
        """Return value − x y."""
        return self.b.fsub(value, self.b.fmul(x, y, flags=FUSE), flags=FUSE)

    def _splat(self, value: Value) -> Value:
        """Return a vector of equal numbers."""
        nothing = ir.Constant(ir.VectorType(value.type, self.lanes), ir.Undefined)
        zeros = ir.Constant(ir.VectorType(I32, self.lanes), [0] * self.lanes)
        return self.b.shuffle_vector(self.b.insert_element(nothing, value, I32(0)), nothing, zeros)
