"""Where the time goes: seconds by kind of work."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Stopwatch:
    """Adds up the time spent on evaluating elements, on linear algebra, and on building.

    Parameters
    ----------
    clock : callable
        Seconds; `time.process_time` does not count what others take.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.clock = clock
        self.build = 0.0
        self.evaluations = 0.0
        self.linear_algebra = 0.0

    @contextmanager
    def building(self) -> Iterator[None]:
        """Time symbolic work and tables."""
        began = self.clock()
        try:
            yield
        finally:
            self.build += self.clock() - began

    @contextmanager
    def evaluating(self) -> Iterator[None]:
        """Time element kernels."""
        began = self.clock()
        try:
            yield
        finally:
            self.evaluations += self.clock() - began

    @contextmanager
    def solving(self) -> Iterator[None]:
        """Time factorisations and substitutions."""
        began = self.clock()
        try:
            yield
        finally:
            self.linear_algebra += self.clock() - began
