"""CasADi callback that observes the iterations of a solver, with the history of a solve."""

from __future__ import annotations

import time

import casadi as ca
import numpy as np

from ..common.array_types import Array
from ..program.collocation import Collocation, convert_variables
from .solve_recorder import Recorder


class IterationMonitor(ca.Callback):
    """CasADi callback that is called after each iteration: history, best iterate, and requests to
    stop.

    Attributes
    ----------
    stop : bool
        Set it to true to stop the solver after the iteration.
    best : tuple of two arrays or None
        Variables and multipliers with the least merit (objective plus largest constraint); None
        before the first iteration.
    seconds : float
        Time of the calls [s].
    lines : int
        Number of calls.

    Parameters
    ----------
    recorder : Recorder
        Record of the solve; an entry is added to its history per call.
    program : Collocation
        Program that is solved, which may be condensed or have lifted variables.
    errors : list
        Exceptions; the solver is stopped once it contains one.
    """

    def __init__(
        self, recorder: Recorder, program: Collocation, errors: list[BaseException]
    ) -> None:
        ca.Callback.__init__(self)
        self.recorder = recorder
        self.program = program
        self.errors = errors
        self.stop = False
        self.best: tuple[Array, Array] | None = None
        self.seconds = 0.0
        self.lines = 0
        self._best_merit = np.inf
        self.construct("monitor")

    def get_n_in(self) -> int:
        return ca.nlpsol_n_out()

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        program = self.program
        sizes = {
            "x": program.variable_count,
            "f": 1,
            "g": program.constraint_count,
            "lam_x": program.variable_count,
            "lam_g": program.constraint_count,
        }
        return ca.Sparsity.dense(sizes.get(ca.nlpsol_out(i), 0), 1)

    def eval(self, arguments):
        """Record an iteration; return [1] if the solver should stop, else [0] (CasADi's interface).

        It should stop on request, at the limit of time, and after an exception, which is stored in
        `errors` instead of being raised.
        """
        began = time.perf_counter()
        if self.errors:
            return [1]
        try:
            self._record(arguments)
        except BaseException as error:
            self.errors.append(error)
        self.seconds += time.perf_counter() - began
        return [1 if self.stop or self.recorder.is_late() or self.errors else 0]

    def _record(self, arguments) -> None:
        """Add an entry, and store the iterate of least objective plus largest violation."""
        z, value, rows, _, multipliers, *_ = (argument.full().ravel() for argument in arguments)
        # Objective and constraints are both of order one.
        merit = float(value[0] + np.abs(rows).max(initial=0.0))
        if merit < self._best_merit:
            self._best_merit = merit
            self.best = (z, multipliers)
        recorder = self.recorder
        loss = float(value[0]) / self.program.loss_scale
        variables = convert_variables(z, self.program, target=recorder.collocation)
        number = recorder.history[-1].number + 1 if recorder.history else 0
        self.lines += 1
        recorder.add_variables(number, variables, loss=loss)
