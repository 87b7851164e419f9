"""Factorise narrow bands within their skyline natively, without exchanging rows: L D Uᵀ.

LAPACK's blocks are as high as the widest row, its LU makes room for exchanges, and it solves
column by column. Here pivots are taken a few at a time, each acts on the rows that it reaches, and
one pass over the factors serves all right-hand sides. Bands that outgrow the cache are LAPACK's.
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

from ...arrays import Array, Index
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
    compiled,
    counting,
    vector_lanes,
)

# Pivots that act on a row at a time: it is then read and written once for all of them.
PIVOTS = 4
LINE_BYTES = 64
# Integers, arrays of integers and arrays of numbers that each kernel takes.
ARGUMENTS = {"fill": (1, 2, 5), "factorise": (2, 1, 4), "solve": (4, 1, 4)}


class Skyline:
    """Factors of matrices of one skyline.

    A side holds a triangle: row k that of column k of the lower one, or of row k of the upper one,
    in whole vectors of the matrix's own places, so that all loads are aligned.

    Parameters
    ----------
    size : int
        n.
    rows, columns : (e,) int
        The entries of one triangle, on either side of the diagonal and on it.
    source : (e,) int
        Where in given values they are.

    Attributes
    ----------
    shape : (n, width) of a side
    """

    def __init__(self, size: int, rows: Index, columns: Index, source: Index) -> None:
        low, high = np.minimum(rows, columns), np.maximum(rows, columns)
        reach = np.arange(size)
        np.maximum.at(reach, low, high)
        self._reach = np.maximum.accumulate(reach)
        height, lanes = int((self._reach - np.arange(size)).max(initial=0)), vector_lanes()
        # As far as the last of some pivots reaches; an odd number spreads rows over the cache.
        vectors = -(-(height + PIVOTS + lanes) // lanes) | 1
        self.shape = size, vectors * lanes
        places = low * self.shape[1] + high - low // lanes * lanes
        order = np.argsort(places)
        self._places, self._source = places[order], source[order]
        on_diagonal = rows == columns
        self._diagonal = source[on_diagonal][np.argsort(rows[on_diagonal])]
        # A skew part's entries have another sign beyond the diagonal.
        self._signs = np.where(rows < columns, -1.0, 1.0)[order]
        (self._reached,) = _addresses(self._reach)
        self._fixed = _addresses(self._source, self._places, self._signs)
        self._kernels = {k: (_compiled("fill", k), _compiled("factorise", k)) for k in (1, 2)}
        self._solve = _compiled("solve", 1)

    def room(self, sides: int) -> Room:
        """Memory for the sides of a matrix; a symmetric one needs one."""
        numbers, (size, width) = sides * math.prod(self.shape), self.shape
        memory = np.zeros(numbers + LINE_BYTES // 8)
        start = -memory.ctypes.data % LINE_BYTES // 8
        return Room(
            memory[start : start + numbers].reshape(sides, *self.shape),
            np.zeros((2, size + width)),
        )

    def factorise(self, room: Room, symmetric: Array, skew: Array) -> tuple[Array, Array]:
        """Make L and U without their diagonals of ones in a room, of a symmetric matrix only L.

        Parameters
        ----------
        room : Room
        symmetric, skew : values of the matrix's two parts; without a skew one the latter is empty

        Returns
        -------
        pivots : (n,) D, in the room
        growth : (n,) Σ_k |L_ik D_k U_ik| / A_ii
            How many times itself a diagonal entry has changed at most; of a symmetric matrix zero.
        """
        (size, width), count = self.shape, 2 if skew.size else 1
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
        """Solve L D Uᵀ x = b for rows b of `right` (columns, n), with L `first` and U `second`."""
        size, width = self.shape
        rows = np.empty((len(right), size + width))
        rows[:, :size], rows[:, size:] = right, 0.0
        arrays = first, second, pivots, rows
        self._solve(size, width, *rows.shape, self._reached, *_addresses(*arrays))
        return rows[:, :size]


class Room:
    """Memory of one factor.

    Parameters
    ----------
    sides : (1, n, width) for a symmetric matrix, or (2, n, width)
    results : (2, n + width) pivots and growth
    """

    def __init__(self, sides: Array, results: Array) -> None:
        self.sides, self.results = sides, results
        self.ends, self.results_at = _addresses(*sides), _addresses(*results)


def _addresses(*arrays: NDArray[Any]) -> list[int]:
    return [address(array) for array in arrays]


def _compiled(name: str, sides: int) -> CompiledFunction:
    emit: Callable[[_Emitter], ir.Module] = getattr(_Emitter, name)
    integers, *arrays = ARGUMENTS[name]
    lanes = vector_lanes()
    signature = (*[ctypes.c_int64] * integers, *[ctypes.c_void_p] * sum(arrays))
    key = f"skyline {name} {sides} {lanes}"
    return compiled(NativeCode(name, key, signature, lambda: emit(_Emitter(lanes, sides))))


class _Emitter:
    """Loops over vectors of the matrix's rows, by their numbers."""

    def __init__(self, lanes: int, sides: int) -> None:
        self.lanes = lanes
        self.count = sides
        self.vector = ir.VectorType(DOUBLE, lanes)
        self.module = ir.Module()

    def _begin(self, name: str) -> Sequence[Value]:
        integers, maps, arrays = ARGUMENTS[name]
        kinds = [I64] * integers + [I64.as_pointer()] * maps + [DOUBLES] * arrays
        function = ir.Function(self.module, ir.FunctionType(ir.VoidType(), kinds), name)
        self.b: Builder = ir.IRBuilder(function.append_basic_block("entry"))
        return function.args

    def fill(self) -> Any:
        """``fill(entries, source, places, signs, symmetric, skew, lower, upper)``."""
        count, source, places, signs, symmetric, skew, lower, upper = self._begin("fill")
        b = self.b
        with counting(b, I64(0), count, "entry") as k:
            origin, place = (b.load(b.gep(array, [k])) for array in (source, places))
            value = b.load(b.gep(symmetric, [origin]))
            if self.count == 1:
                b.store(value, b.gep(lower, [place]))
            else:
                sign, other = b.load(b.gep(signs, [k])), b.load(b.gep(skew, [origin]))
                turned = b.fmul(sign, other)
                b.store(b.fadd(value, turned), b.gep(lower, [place]))
                b.store(b.fsub(value, turned), b.gep(upper, [place]))
        b.ret_void()
        return self.module

    def factorise(self) -> Any:
        """``factorise(n, width, reach, lower, upper, pivots, growth)``."""
        size, self.width, self.reach, *sides, self.pivots, self.growth = self._begin("factorise")
        self.sides = sides[: self.count]
        kind = ir.FunctionType(self.vector, [self.vector])
        self.absolute = ir.Function(self.module, kind, f"llvm.fabs.v{self.lanes}f64")
        b = self.b
        groups = b.sdiv(size, I64(PIVOTS))
        with counting(b, I64(0), groups, "group") as group:
            first = b.mul(group, I64(PIVOTS))
            self._eliminate([b.add(first, I64(p)) for p in range(PIVOTS)])
        with counting(b, b.mul(groups, I64(PIVOTS)), size, "rest") as pivot:
            self._eliminate([pivot])
        b.ret_void()
        return self.module

    def _eliminate(self, pivots: Sequence[Value]) -> None:
        b = self.b
        last = b.load(b.gep(self.reach, [pivots[-1]]))
        for p, pivot in enumerate(pivots):
            self._scale(pivot, last)
            for later in pivots[p + 1 :]:
                self._subtract([pivot], later, last)
        following = b.add(pivots[-1], I64(1))
        with counting(b, following, b.add(last, I64(1)), "row") as row:
            self._subtract(pivots, row, last)

    def _scale(self, pivot: Value, last: Value) -> None:
        """Divide what is below and right of a pivot by it, and clear what is not."""
        b = self.b
        diagonal = b.load(self._entry(self.sides[0], pivot, pivot))
        b.store(diagonal, b.gep(self.pivots, [pivot]))
        inverse = self._spread(b.fdiv(DOUBLE(1.0), diagonal))
        lanes = ir.Constant(ir.VectorType(I64, self.lanes), list(range(self.lanes)))
        with self._vectors(pivot, last) as start:
            after = b.icmp_signed(">", lanes, self._spread(b.sub(pivot, start)))
            places = [self._entry(side, pivot, start) for side in self.sides]
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
        """Take what pivots do to a row of either side, as far as `last`."""
        b, scales = self.b, []
        for pivot in pivots:
            diagonal = b.load(b.gep(self.pivots, [pivot]))
            across = [b.load(self._entry(side, pivot, row)) for side in reversed(self.sides)]
            scales.append([self._spread(b.fmul(diagonal, value)) for value in across])
        with self._vectors(row, last) as start:
            for k, side in enumerate(self.sides):
                target = self._entry(side, row, start)
                value = self._load(target)
                for pivot, scale in zip(pivots, scales, strict=True):
                    value = self._less(value, self._load(self._entry(side, pivot, start)), scale[k])
                self._store(value, target)

    def solve(self) -> Any:
        """``solve(n, width, columns, stride, reach, first, second, pivots, rows)``."""
        size, self.width, columns, stride, reach, first, second, pivots, rows = self._begin("solve")
        b = self.b
        kind = ir.FunctionType(DOUBLE, [DOUBLE, self.vector])
        total = ir.Function(self.module, kind, f"llvm.vector.reduce.fadd.v{self.lanes}f64")
        dot = b.alloca(self.vector)
        with counting(b, I64(0), size, "forward") as k:
            last = b.load(b.gep(reach, [k]))
            with counting(b, I64(0), columns, "column") as column:
                right = b.gep(rows, [b.mul(column, stride)])
                known = self._spread(b.load(b.gep(right, [k])))
                with self._vectors(k, last) as start:
                    place, factor = b.gep(right, [start]), self._entry(first, k, start)
                    self._store(self._less(self._load(place), self._load(factor), known), place)
        with counting(b, I64(0), size, "backward") as done:
            k = b.sub(b.sub(size, I64(1)), done)
            last, diagonal = b.load(b.gep(reach, [k])), b.load(b.gep(pivots, [k]))
            with counting(b, I64(0), columns, "column") as column:
                right = b.gep(rows, [b.mul(column, stride)])
                b.store(ir.Constant(self.vector, [0.0] * self.lanes), dot)
                with self._vectors(k, last) as start:
                    known, factor = b.gep(right, [start]), self._entry(second, k, start)
                    b.store(self._less(b.load(dot), self._load(known), self._load(factor)), dot)
                here = b.gep(right, [k])
                scaled = b.fdiv(b.load(here), diagonal)
                b.store(b.call(total, [scaled, b.load(dot)], fastmath=("reassoc",)), here)
        b.ret_void()
        return self.module

    @contextmanager
    def _vectors(self, first: Value, last: Value) -> Iterator[Value]:
        """The starts of the vectors that hold rows from `first` to `last`."""
        b, lanes = self.b, I64(self.lanes)
        stop = b.add(b.sdiv(last, lanes), I64(1))
        with counting(b, b.sdiv(first, lanes), stop, "vector") as k:
            yield b.mul(k, lanes)

    def _entry(self, side: Value, row: Value, place: Value) -> Value:
        """Where row `row` of a side has what belongs to `place` of the matrix."""
        b, lanes = self.b, I64(self.lanes)
        start = b.mul(b.sdiv(row, lanes), lanes)
        return b.gep(side, [b.add(b.mul(row, self.width), b.sub(place, start))])

    def _load(self, place: Value) -> Value:
        return self.b.load(self.b.bitcast(place, self.vector.as_pointer()), align=8)

    def _store(self, value: Value, place: Value) -> None:
        self.b.store(value, self.b.bitcast(place, self.vector.as_pointer()), align=8)

    def _less(self, value: Value, x: Value, y: Value) -> Value:
        """Value − x y."""
        return self.b.fsub(value, self.b.fmul(x, y, flags=FUSE), flags=FUSE)

    def _spread(self, value: Value) -> Value:
        """A vector of equal numbers."""
        nothing = ir.Constant(ir.VectorType(value.type, self.lanes), ir.Undefined)
        zeros = ir.Constant(ir.VectorType(I32, self.lanes), [0] * self.lanes)
        return self.b.shuffle_vector(self.b.insert_element(nothing, value, I32(0)), nothing, zeros)
