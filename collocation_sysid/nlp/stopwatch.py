"""Where the time goes: seconds by kind of work."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Adds up the time spent on evaluating elements, on linear algebra, and on building."""

    def __init__(self) -> None:
        self.build = 0.0
        self.evaluations = 0.0
        self.linear_algebra = 0.0

    @contextmanager
    def building(self) -> Iterator[None]:
        """Time symbolic work and tables."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.build += time.perf_counter() - began

    @contextmanager
    def evaluating(self) -> Iterator[None]:
        """Time element kernels."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.evaluations += time.perf_counter() - began

    @contextmanager
    def solving(self) -> Iterator[None]:
        """Time factorisations and substitutions."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.linear_algebra += time.perf_counter() - began
