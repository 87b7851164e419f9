"""Share a range of timesteps, or the experiments, among threads."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any, TypeVar

T = TypeVar("T")
R = TypeVar("R")


# Of several threads that need a kernel the first builds it.
COMPILING = threading.Lock()
# Threads that do a whole experiment each share nothing of it with others.
_alone = threading.local()


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
    if (stop := getattr(_alone, "stop", None)) is not None and stop.is_set():
        raise KeyboardInterrupt
    threads = min(threads, count)
    if threads <= 1 or getattr(_alone, "whole", False):
        run(0, count)
        return
    bounds = [count * k // threads for k in range(threads + 1)]
    pool = _pool(os.getpid(), threads)
    others = [pool.submit(run, a, b) for a, b in pairwise(bounds[1:])]
    run(bounds[0], bounds[1])
    for other in others:
        other.result()


def side_by_side(run: Callable[[T], R], items: Sequence[T], threads: int) -> list[R]:
    """``run`` of every item, in their order; each on a thread of its own, see `at_once`.

    Much of an experiment's row is too short to pass the interpreter's lock on and back: more
    experiments than cores at a time fill the gaps.
    """
    count = at_once(len(items), threads)
    if count == 1:
        return [run(item) for item in items]

    stop = threading.Event()

    def passed(item: T) -> R:
        _alone.stop = stop
        return alone(run, item)

    with ThreadPoolExecutor(count) as pool:
        try:
            return list(pool.map(passed, items))
        except BaseException:
            stop.set()  # only the main thread hears of Ctrl-C, and it waits for the others
            raise


def alone(run: Callable[..., R], *arguments: Any) -> R:
    """``run(*arguments)`` on this thread, which from now on shares nothing with others."""
    _alone.whole = True
    return run(*arguments)


def at_once(items: int, threads: int) -> int:
    """How many items are done side by side."""
    if threads == 1 or getattr(_alone, "whole", False):
        return 1
    return max(1, min(items, 2 * threads))
