"""Computing time by kind of work: building, element evaluations, linear algebra."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager


class Stopwatch:
    """Accumulated times of building, element evaluations and linear algebra.

    Times of parallel threads are added up.

    Attributes
    ----------
    build : float
        Time of symbolic work and tables [s].
    evaluations : float
        Time of element kernels [s].
    linear_algebra : float
        Time of factorisations and substitutions [s].

    Parameters
    ----------
    clock : callable
        Returns seconds; with `time.process_time`, the time of other processes does not count.
    """

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self.clock = clock
        self.build = 0.0
        self.evaluations = 0.0
        self.linear_algebra = 0.0
        self._adding = threading.Lock()

    @contextmanager
    def _timing(self, kind: str) -> Iterator[None]:
        """Add the time of the block, also if it raises, to the attribute `kind`."""
        began = self.clock()
        try:
            yield
        finally:
            with self._adding:
                setattr(self, kind, getattr(self, kind) + self.clock() - began)

    def add(self, build: float, evaluations: float, linear_algebra: float) -> None:
        """Add times measured by another stopwatch [s] to the attributes of the same names, in
        place.
        """
        with self._adding:
            self.build += build
            self.evaluations += evaluations
            self.linear_algebra += linear_algebra

    def read_and_reset(self) -> tuple[float, float, float]:
        """Return the times of building, evaluations and linear algebra [s]; reset them to zero."""
        spent = self.build, self.evaluations, self.linear_algebra
        self.build = self.evaluations = self.linear_algebra = 0.0
        return spent

    def building(self) -> AbstractContextManager[None]:
        """Return a context manager that adds the time of its block to `build`."""
        return self._timing("build")

    def evaluating(self) -> AbstractContextManager[None]:
        """Return a context manager that adds the time of its block to `evaluations`."""
        return self._timing("evaluations")

    def solving(self) -> AbstractContextManager[None]:
        """Return a context manager that adds the time of its block to `linear_algebra`."""
        return self._timing("linear_algebra")
