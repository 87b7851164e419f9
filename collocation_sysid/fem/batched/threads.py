"""Share a range of timesteps among threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise


def available_threads() -> int:
    """``COLLOCATION_SYSID_THREADS``, or as many as there are cores that this process may use."""
    override = os.environ.get("COLLOCATION_SYSID_THREADS")
    if override:
        return max(1, int(override))
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    # Keyed by process: a forked child must not wait for its parent's threads.
    return ThreadPoolExecutor(threads)


def in_slices(run: Callable[[int, int], None], count: int, threads: int) -> None:
    """Call ``run(start, stop)`` on consecutive slices of ``range(count)``, one per thread."""
    threads = min(threads, count)
    if threads <= 1:
        run(0, count)
        return
    bounds = [count * k // threads for k in range(threads + 1)]
    pool = _pool(os.getpid(), threads)
    others = [pool.submit(run, a, b) for a, b in pairwise(bounds[1:])]
    run(bounds[0], bounds[1])
    for other in others:
        other.result()
