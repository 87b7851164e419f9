"""What every emitter of LLVM code needs: types, and a loop."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from llvmlite import ir

DOUBLE, I32, I64 = ir.DoubleType(), ir.IntType(32), ir.IntType(64)
DOUBLES, I32S = DOUBLE.as_pointer(), I32.as_pointer()
Builder = Value = Any  # llvmlite is not annotated, and what is inferred of it is wrong


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
