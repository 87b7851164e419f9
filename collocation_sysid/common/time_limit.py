"""Limit of the time of a calculation with many steps.

`time_limit` sets the limit for a block, `require_time` is called at every step in it, and
`unlimited` frees the steps that make an answer of what has been reached.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_end_s: ContextVar[float | None] = ContextVar("end_s", default=None)


class TimeLimitReached(Exception):
    """The time of the block ended."""


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Let `require_time` raise in the block after a time [s]; the earlier of two limits counts."""
    end_s = time.perf_counter() + seconds
    outer_s = _end_s.get()
    token = _end_s.set(end_s if outer_s is None else min(end_s, outer_s))
    try:
        yield
    finally:
        _end_s.reset(token)


@contextmanager
def unlimited() -> Iterator[None]:
    """Let `require_time` not raise in the block."""
    token = _end_s.set(None)
    try:
        yield
    finally:
        _end_s.reset(token)


def require_time() -> None:
    """Raise TimeLimitReached if the time of the surrounding block has ended."""
    end_s = _end_s.get()
    if end_s is not None and time.perf_counter() > end_s:
        raise TimeLimitReached
