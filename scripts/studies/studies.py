"""Runner of the studies: cases in processes, and Markdown tables."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table with the first column aligned left and the others right."""
    rule = ("---", *("---:" for _ in heads[1:]))
    return "\n".join("| " + " | ".join(line) + " |" for line in (heads, rule, *rows))


def number(value: float | None, scale: float = 1.0, digits: int = 3) -> str:
    """Return `scale` times a number for a table; a dash for None."""
    return "–" if value is None else f"{scale * value:.{digits}g}"


def run_in_processes(run: Callable[..., T], jobs: Sequence[tuple], workers: int = 1) -> list[T]:
    """Return the results of a function for all tuples of arguments, computed in so many processes."""
    # Worker processes read these variables when they start: one thread each.
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "COLLOCATION_SYSID_THREADS": "1"}
    start = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=start) as pool:
        return list(pool.map(run, *zip(*jobs, strict=True), chunksize=5))
