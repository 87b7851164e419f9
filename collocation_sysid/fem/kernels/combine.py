"""Linear combinations of gathered rows into sparse values, compiled or with NumPy."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array, Index


class CombinationPlan(Protocol):
    """Plan of the combinations, see `program.linear_algebra.block_band.CombinePlan`."""

    @property
    def first_task(self) -> Index:
        """First task of each column block (N + 1,); the last entry is the number of tasks."""
        ...

    @property
    def tasks(self) -> Index:
        """Tasks (tasks, 5): offset in the values, map start, map length, row, 1 to add or 0 to
        overwrite.
        """
        ...

    @property
    def coefficients(self) -> Array:
        """Coefficients a and b of each task (tasks, 2)."""
        ...

    @property
    def targets(self) -> NDArray[np.int32]:
        """Concatenated maps of positions in the values, relative to the offset of the task."""
        ...

    @property
    def sources(self) -> NDArray[np.int32]:
        """Concatenated maps of the entries of the row to read."""
        ...


Combiner = Callable[[int, int, Array, Array, Array], None]


def combine_with_numpy(plan: CombinationPlan) -> Combiner:
    """Return the reference combiner, one indexed NumPy statement for each task.

    The combiner ``combine(start, stop, a, b, values)`` executes the tasks of column blocks `start`
    … `stop` − 1 and writes to `values` in place: a task sets values[targets + offset] to α a[row,
    sources] + β b[row, sources], or adds that; a matrix with the coefficient 0 is not read.
    """

    def combine(start: int, stop: int, a: Array, b: Array, values: Array) -> None:
        """Run the tasks of column blocks `start` … `stop` − 1 on rows a and b, writing to
        `values`.
        """
        for task in range(plan.first_task[start], plan.first_task[stop]):
            out, first, length, row, add = plan.tasks[task]
            alpha, beta = plan.coefficients[task]
            target = plan.targets[first : first + length] + out
            source = plan.sources[first : first + length]
            new = np.zeros(length)
            if alpha:
                new += alpha * a[row, source]
            if beta:
                new += beta * b[row, source]
            values[target] = values[target] + new if add else new

    return combine


def compile_combiner(plan: CombinationPlan) -> Combiner:
    """Return a compiled combiner with the arguments and result of that of `combine_with_numpy`.

    Rows of a and b must be contiguous and equally far apart. Both matrices are read whatever their
    coefficients.

    Raises
    ------
    RuntimeError
        If LLVM cannot compile the code.
    """
    from .jit import NativeCode, compile_function

    signature = (*[ctypes.c_int64] * 3, *[ctypes.c_void_p] * 7)
    run = compile_function(NativeCode("combine", "combine", signature=signature, build=_emit))
    constants = [
        array.ctypes.data for array in (plan.tasks, plan.coefficients, plan.targets, plan.sources)
    ]

    def combine(start: int, stop: int, a: Array, b: Array, values: Array) -> None:
        """Run the tasks of column blocks `start` … `stop` − 1 on rows a and b, writing to
        `values`.
        """
        stride = a.strides[0] // a.itemsize
        first_task = int(plan.first_task[start])
        last_task = int(plan.first_task[stop])
        run(
            first_task,
            last_task,
            stride,
            *constants,
            a.ctypes.data,
            b.ctypes.data,
            values.ctypes.data,
        )

    return combine


def _emit() -> Any:
    """Return the LLVM module of the function `combine`, a compiled loop over tasks.

    Its arguments are the first task and the end of the tasks, the row length (`stride`) of a and b,
    the arrays of a `CombinationPlan` (tasks, coefficients, targets, sources), a, b and the values,
    which are changed in place. A task reads one row of a and one of b:
    values[offset + targets] = α a[row, sources] + β b[row, sources], or is increased by that. The
    values must not overlap with any other array.
    """
    from llvmlite import ir

    from .jit import DOUBLES, I32S, I64, for_range

    module = ir.Module()
    i64s = I64.as_pointer()
    kind = ir.FunctionType(
        ir.VoidType(), [I64, I64, I64, i64s, DOUBLES, I32S, I32S, DOUBLES, DOUBLES, DOUBLES]
    )
    function = ir.Function(module, kind, "combine")
    start, stop, stride, tasks, coefficients, targets, sources, a, b, values = function.args
    for pointer in function.args[3:]:
        pointer.add_attribute("noalias")
    builder: Any = ir.IRBuilder(function.append_basic_block("entry"))
    with for_range(builder, start, stop=stop, name="task") as task:
        first = builder.mul(task, I64(5))
        out, begin, length, row, add = (
            builder.load(builder.gep(tasks, [builder.add(first, I64(k))])) for k in range(5)
        )
        pair = builder.mul(task, I64(2))
        alpha, beta = (
            builder.load(builder.gep(coefficients, [builder.add(pair, I64(k))])) for k in range(2)
        )
        row_start = builder.mul(row, stride)
        a_row, b_row = (builder.gep(matrix, [row_start]) for matrix in (a, b))
        out_row = builder.gep(values, [out])
        targets_here, sources_here = (builder.gep(m, [begin]) for m in (targets, sources))

        def loop(accumulate: bool) -> None:
            with for_range(builder, I64(0), stop=length, name="entry") as i:
                source = builder.sext(builder.load(builder.gep(sources_here, [i])), I64)
                target = builder.sext(builder.load(builder.gep(targets_here, [i])), I64)
                new = builder.fadd(
                    builder.fmul(alpha, builder.load(builder.gep(a_row, [source]))),
                    builder.fmul(beta, builder.load(builder.gep(b_row, [source]))),
                    flags=["contract"],
                )
                address = builder.gep(out_row, [target])
                if accumulate:
                    new = builder.fadd(builder.load(address), new)
                builder.store(new, address)

        with builder.if_else(builder.icmp_signed("==", add, I64(0))) as (overwrite, accumulate):
            with overwrite:
                loop(accumulate=False)
            with accumulate:
                loop(accumulate=True)
    builder.ret_void()
    return module
