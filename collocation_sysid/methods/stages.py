"""What the penalty and augmented-Lagrangian methods share: budget, history, and the answer."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..nlp.collocation import Collocation
from ..nlp.stopwatch import Stopwatch
from .inner import FIRST_ORDER, Inner, check_inner, minimise
from .merit import Merit, Unconstrained
from .solution import Iteration, Solution, Status, Timing
from .start import initial_variables

Watch = Callable[[Iteration], None]

# Iterations between lines of the history; those of first order are many and cheap.
EVERY, EVERY_OF_FIRST_ORDER = 1, 20
# Rounding leaves about this much of the gradient for every unit of curvature, of the loss or ρ.
ROUNDING = 1e-14


@dataclass(frozen=True)
class Slack:
    """How far a point is from satisfying the equations of motion.

    Attributes
    ----------
    newtons : float
        Largest residual.
    relative : float
        The same over the largest force in the balance.
    scaled : float
        Largest row of g, grasps included.
    """

    newtons: float
    relative: float
    scaled: float

    def __str__(self) -> str:
        return f"slack of {self.newtons:.2g} N ({self.relative:.1g} of the largest force)"


class OutOfBudget(Exception):
    """The limit of iterations or time is reached."""

    def __init__(self, status: Status) -> None:
        super().__init__(status.value)
        self.status = status


class Stages:
    """A solve in stages: the last iterate, the budget, and the history.

    Parameters
    ----------
    collocation : Collocation
    inner : name of the inner solver
    max_iterations, max_time_s : budget of inner iterations and seconds
    watch : callable or None
    start : (variables,) ndarray or None

    Attributes
    ----------
    z : (variables,) the last iterate, which is the best: the merit decreases within a stage
    rows : (constraints,) multipliers of all rows that go with it
    gradient : float
        Largest entry of the merit's projected gradient there.
    """

    def __init__(
        self,
        collocation: Collocation,
        inner: Inner,
        max_iterations: int,
        max_time_s: float,
        watch: Watch | None,
        start: Array | None,
    ) -> None:
        check_inner(inner)
        self.began = time.perf_counter()
        self.collocation, self.watch = collocation, watch
        self.inner: Inner = inner
        self.max_iterations, self.max_time_s = max_iterations, max_time_s
        self.stopwatch = Stopwatch()
        self.problem = Unconstrained(collocation, self.stopwatch)
        self.history: list[Iteration] = []
        self.notes: list[str] = []
        if start is None:
            start, self.notes = initial_variables(collocation)
        self.z = np.clip(start, self.problem.lower, self.problem.upper)
        if not self.problem.is_upright(self.z):
            raise InputError("elements are inverted at the start; start from another point")
        self.gradient = np.inf
        self.iterations = 0
        self.merit = Merit(self.problem, 0.0, np.zeros(self.problem.nlp.constraints))
        no_weights = np.zeros(self.problem.nlp.constraints)
        self._curvature = float(
            self.problem.nlp.hessian(self.z, 1.0, no_weights).diagonal().max(initial=0.0)
        )
        self._every = EVERY_OF_FIRST_ORDER if inner in FIRST_ORDER else EVERY

    def minimise(self, merit: Merit, tolerance: float, max_iterations: int) -> bool:
        """One stage from the last iterate; whether its gradient became as small as `tolerance`.

        Where ρ or the loss is so curved that rounding hides such a gradient, it may be larger.

        Raises
        ------
        OutOfBudget
        """
        self.merit, done = merit, 0
        tolerance = max(tolerance, ROUNDING * (merit.rho + self._curvature))
        before = self.iterations

        def report(z: Array, value: float, projected: Array) -> None:
            nonlocal done
            self.z, self.gradient = z, float(np.abs(projected).max(initial=0.0))
            self.iterations = before + done
            if (done % self._every == 0 and done > 0) or not self.history:
                self.record()
            if time.perf_counter() - self.began > self.max_time_s:
                raise OutOfBudget(Status.TIME_LIMIT)
            if self.iterations >= self.max_iterations and self.gradient > tolerance:
                raise OutOfBudget(Status.ITERATION_LIMIT)
            done += 1

        reached = minimise(self.inner, merit, self.z, tolerance, max_iterations, report)
        if self.history[-1].number < self.iterations:
            self.record()
        return reached

    def record(self) -> None:
        """Add a line to the history."""
        nlp, z = self.problem.nlp, self.answer
        line = Iteration(
            number=self.iterations,
            loss=nlp.objective(z) / nlp.loss_scale,
            rms_m=nlp.rms_m(z),
            violation_n=self.slack().newtons,
            parameters=nlp.values(z),
            time_s=time.perf_counter() - self.began,
        )
        self.history.append(line)
        if self.watch is not None:
            self.watch(line)

    @property
    def answer(self) -> Array:
        """The last iterate with held nodes where their grasps are."""
        return self.problem.grasped(self.z)

    def slack(self) -> Slack:
        """How far the answer is from satisfying the equations of motion."""
        nlp, z = self.problem.nlp, self.answer
        newtons = max(float(np.abs(r).max(initial=0.0)) for r in nlp.violations_n(z))
        rows = self.problem.constraint_values(self.z)
        scaled = float(np.abs(rows).max(initial=0.0))
        return Slack(newtons, newtons / max(nlp.largest_force_n(z), 1e-300), scaled)

    def solution(self, method: str, status: Status, message: str) -> Solution:
        """The last iterate as an answer of the given collocation."""
        estimate = self.merit.estimate(self.problem.constraint_values(self.z))
        return Solution(
            status=status,
            message=message,
            method=method,
            collocation=self.collocation,
            z=self.answer,
            multipliers=self.problem.multipliers(estimate),
            iterations=self.iterations,
            history=tuple(self.history),
            timing=Timing.of(self.stopwatch, self.began),
            notes=tuple(self.notes),
            evaluations=self.problem.evaluations,
        )


def check_positive(options: Any, *names: str) -> None:
    """Refuse options that are not positive numbers.

    Raises
    ------
    InputError
    """
    for name in names:
        value = getattr(options, name)
        if not value > 0:
            raise InputError(f"{name} = {value:g}; expected a positive number", None, "solver")
