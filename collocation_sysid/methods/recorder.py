"""The record that every method keeps of a solve: history, time, notes, and the answer."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..errors import SimulationError
from ..fem.constants import is_mode
from ..program.collocation import Collocation
from ..program.stopwatch import Stopwatch
from .solution import Iteration, Solution, Status, Timing, Watch
from .start import initial_variables


class Ended(Exception):
    """Ends a search from within."""

    def __init__(self, status: Status, message: str = "") -> None:
        super().__init__(message)
        self.status, self.message = status, message or status.sentence


class Recorder:
    """History and clock of one solve.

    Parameters
    ----------
    method : str
        Its name.
    collocation : Collocation
    watch : callable, optional
        Called with every line of the history.
    max_time_s : float

    Attributes
    ----------
    history : list of Iteration
    notes : list of str
    stopwatch : Stopwatch
    """

    def __init__(
        self,
        method: str,
        collocation: Collocation,
        watch: Watch | None = None,
        max_time_s: float = np.inf,
    ) -> None:
        self.began = time.perf_counter()
        self.method, self.collocation, self.watch = method, collocation, watch
        self.max_time_s = max_time_s
        self.history: list[Iteration] = []
        self.notes: list[str] = []
        self.stopwatch = Stopwatch()

    @property
    def elapsed_s(self) -> float:
        """Time since the solve began."""
        return time.perf_counter() - self.began

    @property
    def late(self) -> bool:
        """Whether the time is over."""
        return self.elapsed_s > self.max_time_s

    def start(self, given: Array | None) -> Array:
        """The variables given, or those of a simulation at the guess."""
        if given is not None:
            return given
        z, notes = initial_variables(self.collocation)
        self.notes += notes
        return z

    def search(self, steps: Callable[[], tuple[Status, str]]) -> tuple[Status, str]:
        """Status and message of a search, also where that ends by an exception."""
        try:
            return steps()
        except Ended as end:
            return end.status, end.message
        except SimulationError as error:
            return Status.NOT_SIMULABLE, f"{Status.NOT_SIMULABLE.sentence} {error}."
        except KeyboardInterrupt:
            return Status.INTERRUPTED, Status.INTERRUPTED.sentence

    def line(self, number: int, z: Array, loss: float) -> None:
        """Add the line for variables z to the history."""
        nlp = self.collocation
        violation_n = max(float(np.abs(r).max(initial=0.0)) for r in nlp.violations_n(z))
        line = Iteration(number, loss, nlp.rms_m(z), violation_n, nlp.values(z), self.elapsed_s)
        self.add(line)

    def add(self, line: Iteration) -> None:
        """Add a line to the history, and show it to who watches, but for shares of a field."""
        told = {name: value for name, value in line.parameters.items() if not is_mode(name)}
        line = replace(line, parameters=told)
        self.history.append(line)
        if self.watch is not None:
            self.watch(line)

    def solution(
        self,
        status: Status,
        message: str,
        z: Array,
        multipliers: Array | None,
        iterations: int,
        evaluations: int,
    ) -> Solution:
        """The answer of the solve."""
        return Solution(
            status,
            message,
            self.method,
            self.collocation,
            z,
            multipliers,
            iterations,
            tuple(self.history),
            Timing.of(self.stopwatch, self.began),
            tuple(self.notes),
            evaluations,
        )
