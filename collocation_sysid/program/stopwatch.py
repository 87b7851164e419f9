"""Where the time goes: seconds by kind of work."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager


class Stopwatch:
    """Adds up the time spent on evaluating elements, on linear algebra, and on building.

    Of threads side by side, the time of all.

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
        self._adding = threading.Lock()

    @contextmanager
    def _timing(self, kind: str) -> Iterator[None]:
        began = self.clock()
        try:
            yield
        finally:
            with self._adding:
                setattr(self, kind, getattr(self, kind) + self.clock() - began)

    def add(self, build: float, evaluations: float, linear_algebra: float) -> None:
        """Add seconds that another has measured."""
        with self._adding:
            self.build += build
            self.evaluations += evaluations
            self.linear_algebra += linear_algebra

    def taken(self) -> tuple[float, float, float]:
        """Its seconds as `add` takes them; it begins again from zero."""
        spent = self.build, self.evaluations, self.linear_algebra
        self.build = self.evaluations = self.linear_algebra = 0.0
        return spent

    def building(self) -> AbstractContextManager[None]:
        """Time symbolic work and tables."""
        return self._timing("build")

    def evaluating(self) -> AbstractContextManager[None]:
        """Time element kernels."""
        return self._timing("evaluations")

    def solving(self) -> AbstractContextManager[None]:
        """Time factorisations and substitutions."""
        return self._timing("linear_algebra")
