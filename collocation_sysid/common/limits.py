"""Limits of a process: the memory that it may have, and the time of a calculation with many steps.

`time_limit` sets a limit for a block, `require_time` is called at every step in it, and `unlimited`
frees the steps that make an answer of what has been reached.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

# Where containers state their limits.
CGROUP_LIMITS = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)
_end_s: ContextVar[float | None] = ContextVar("end_s", default=None)


def machine_memory_mb() -> float | None:
    """Return the memory that this process may have [MB]: the least of the machine's, a container's
    and the process's limit; None if none is known.
    """
    return min(_limits_mb(), default=None)


def _limits_mb() -> Iterator[float]:
    """Yield the limits of memory that are known on this system [MB]."""
    with suppress(AttributeError, OSError, ValueError):  # not on every system
        yield os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e6
    for file in CGROUP_LIMITS:
        with suppress(OSError, ValueError):  # "max" is no limit
            yield int(file.read_text()) / 1e6
    with suppress(ImportError, OSError, ValueError):
        import resource

        limit, _ = resource.getrlimit(resource.RLIMIT_AS)
        if limit != resource.RLIM_INFINITY:
            yield limit / 1e6


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
