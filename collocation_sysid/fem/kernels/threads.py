"""Distribution of time steps, or of experiments, over threads.

`run_in_slices` distributes consecutive time steps of one evaluation; `map_experiments` distributes
whole experiments, each of which then runs on one thread.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import cache
from itertools import pairwise, starmap
from typing import Any, TypeVar

from ...errors import InputError

R = TypeVar("R")


# Lock for building kernels: of several threads that need the same one, the first builds it.
COMPILING = threading.Lock()
# State of a thread that evaluates whole experiments and therefore starts no further threads.
_alone = threading.local()


def available_threads() -> int:
    """Return ``COLLOCATION_SYSID_THREADS``, at least 1, or the number of cores that this process
    may use.

    Raises
    ------
    InputError
        If the environment variable is no whole number.
    """
    variable = "COLLOCATION_SYSID_THREADS"
    override = os.environ.get(variable)
    if override:
        try:
            return max(1, int(override))
        except ValueError:
            message = f"found {override!r}; expected a whole number"
            raise InputError(message, "environment variable", where=variable) from None
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """Return the pool of threads of this process; a forked child must not wait for its parent's."""
    return ThreadPoolExecutor(threads)


def run_in_slices(
    run: Callable[..., None], count: int, threads: int, arguments: Sequence[Any] = ()
) -> None:
    """Call ``run(start, stop, *arguments)`` on consecutive slices of ``range(count)``, one per
    thread, and wait for all.

    On a thread of `map_experiments`, or with one thread, it is called once for the complete range,
    also if `count` is 0. An exception of ``run`` is passed on.

    Raises
    ------
    KeyboardInterrupt
        On a thread of `map_experiments`, if another experiment failed or was interrupted.
    """
    if (stop := getattr(_alone, "stop", None)) is not None and stop.is_set():
        raise KeyboardInterrupt
    threads = min(threads, count)
    if threads <= 1 or getattr(_alone, "in_experiment", False):
        run(0, count, *arguments)
        return
    bounds = [count * k // threads for k in range(threads + 1)]
    pool = _pool(os.getpid(), threads)
    others = [pool.submit(run, a, b, *arguments) for a, b in pairwise(bounds[1:])]
    run(bounds[0], bounds[1], *arguments)
    for other in others:
        other.result()


def map_experiments(run: Callable[..., R], *columns: Sequence[Any], threads: int) -> list[R]:
    """Return ``run(*row)`` for every row of one entry of each column, in their order.

    The columns have the same length. Each row runs on one thread, see `concurrent_count`; context
    variables are those of the caller.

    Much of the work of an experiment is too short to release and acquire the interpreter lock: more
    experiments than cores at a time fill the gaps. An exception of ``run`` is passed on; rows that
    are running are then interrupted at their next `run_in_slices`.
    """
    rows = [*zip(*columns, strict=True)]
    count = concurrent_count(len(rows), threads)
    if count == 1:
        return [*starmap(run, rows)]

    stop = threading.Event()

    def passed(row: tuple[Any, ...]) -> R:
        """Run one row on this thread, which can be stopped by `stop`."""
        _alone.stop = stop
        return run_single_threaded(run, *row)

    # Each row needs a copy of its own: a context cannot be entered by two threads.
    contexts = [copy_context() for _ in rows]

    with ThreadPoolExecutor(count) as pool:
        try:
            return list(pool.map(lambda context, row: context.run(passed, row), contexts, rows))
        except BaseException:
            stop.set()  # only the main thread hears of Ctrl-C, and it waits for the others
            raise


def run_single_threaded(run: Callable[..., R], *arguments: Any) -> R:
    """Return ``run(*arguments)``, and start no further threads from this thread from now on, also
    after the call.
    """
    _alone.in_experiment = True
    return run(*arguments)


def concurrent_count(items: int, threads: int) -> int:
    """Return how many of this many items `map_experiments` runs at the same time: one with one
    thread or within an experiment, else at most two for each of the `threads`, and at least one.
    """
    if threads == 1 or getattr(_alone, "in_experiment", False):
        return 1
    return max(1, min(items, 2 * threads))
