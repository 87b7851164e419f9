"""CG_DESCENT, the nonlinear conjugate gradient method of Hager and Zhang.

The direction d' = −g' + β d has sufficient descent, g'ᵀd' ≤ −⅞ ‖g'‖², whatever the line search,

    β = max((y − 2 d ‖y‖² / dᵀy)ᵀ g' / dᵀy, −1 / (‖d‖ min(η, ‖g‖))),   y = g' − g,

and the line search ends at the approximate Wolfe conditions, which rounding near the minimum
does not spoil as it does the sufficient decrease of the value. Names of rules (I0 … U3) are
those of W. W. Hager and H. Zhang, "A new conjugate gradient method with guaranteed descent and an
efficient line search", SIAM J. Optim. 16 (2005), and "Algorithm 851: CG_DESCENT", ACM TOMS 32
(2006). A value that is not finite stands for a point out of the domain: the search turns back.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from ...common.array_types import Array

ValueAndGradient = Callable[[Array], tuple[float, Array]]


@dataclass(frozen=True)
class CgDescentOptions:
    """Options, with the letters of the papers in parentheses."""

    tolerance: float = 1e-6  # largest entry of the gradient at the end
    max_iterations: int = 10_000  # largest number of iterations
    # Constants of the Wolfe conditions (δ, σ).
    decrease: float = 0.1
    curvature: float = 0.9
    rounding: float = 1e-6  # relative error of the value (ε): values within it are considered equal
    memory: float = 0.7  # decay of the average size of the value (Δ)
    # Relative change of the value below which only the approximate conditions count (ω).
    switch: float = 1e-3
    truncation: float = 0.01  # lower bound of β (η)
    max_trials: int = 60  # largest number of evaluations of one line search


Ending = Literal["converged", "iteration-limit", "stopped", "line-search", "not-finite"]

# First step size over the size of the start (ψ0).
FIRST = 0.01
# Step size at which the value is sampled, over the last step size (ψ1).
SAMPLED = 0.1
# Growth of the step size if that sample is not convex (ψ2).
GROWTH = 2.0
# Relative change of the value below which it is not sampled, because rounding would dominate.
SMALL_CHANGE = 1e-12
# Where an interval is cut (θ).
CUT = 0.5
# Largest ratio of an interval to the previous one (γ).
SHRINK = 0.66
# Growth of a bracket (ρ).
EXPANSION = 5.0


@dataclass(frozen=True, eq=False)
class CgState:
    """One iterate, the argument of a callback."""

    iteration: int  # number of the iterate; 0 is the start
    x: Array  # (n,): variables
    value: float  # value of the function
    gradient: Array  # (n,): gradient
    direction: Array  # (n,): direction of the step that led to the iterate
    slope: float  # derivative along it at step 0
    step: float  # step size


@dataclass(frozen=True, eq=False)
class CgResult:
    """Result of a minimisation."""

    x: Array  # (n,): last variables
    value: float  # value of the function
    gradient: Array  # (n,): gradient
    # Numbers of iterations, and of evaluations of the gradient.
    iterations: int
    evaluations: int
    # Reason for the end: "converged"; "iteration-limit"; "stopped" by the callback; "line-search",
    # if no step satisfied the Wolfe conditions; or "not-finite", if the function is not finite at
    # the start.
    ending: Ending


def minimise_cg_descent(
    fun_and_grad: ValueAndGradient,
    x0: Array,
    options: CgDescentOptions | None = None,
    callback: Callable[[CgState], bool | None] | None = None,
    value: Callable[[Array], float] | None = None,
) -> CgResult:
    """Minimise a smooth function.

    Parameters
    ----------
    fun_and_grad : callable
        Function that returns value and gradient (n,) at x; an infinite value where x is out of the
        domain.
    x0 : (n,) array
        Initial variables; not modified.
    callback : callable, optional
        Function that is called with the start and every iterate; it stops the minimisation by
        returning true. Its exceptions are not caught. The direction of the start is that of the
        steepest descent.
    value : callable, optional
        Function that returns the value alone, if that is cheaper.

    Returns
    -------
    CgResult
        Last iterate and the reason for the end.
    """
    options = options or CgDescentOptions()
    counted = _CountedFunction(fun_and_grad, value)
    x = np.array(x0, dtype=float)
    f, g = counted(x)

    def result(ending: Ending, iterations: int) -> CgResult:
        """Return the last iterate as the result, with the reason for the end and the number of
        iterations.
        """
        return CgResult(
            x, f, gradient=g, iterations=iterations, evaluations=counted.evaluations, ending=ending
        )

    if not (np.isfinite(f) and np.isfinite(g).all()):
        return result("not-finite", 0)
    d = -g
    step = 0.0
    change = np.inf
    average = _AverageValue(options)

    def line_search_in(direction: Array) -> _LineSearch:
        """Return a line search from the last iterate along a direction (n,)."""
        return _LineSearch(
            counted,
            x,
            value=f,
            gradient=g,
            direction=direction,
            error=average.options.rounding * average.size,
            approximate=average.approximate,
            options=options,
        )

    if callback is not None and callback(
        CgState(0, x, value=f, gradient=g, direction=d, slope=0.0, step=0.0)
    ):
        return result("stopped", 0)
    for k in range(options.max_iterations):
        if np.abs(g).max(initial=0.0) <= options.tolerance:
            return result("converged", k)
        average.add(f)
        line = line_search_in(d)
        first_step = (
            _initial_step(x, f, g=g) if k == 0 else _initial_step_after(line, step, change=change)
        )
        trial = line.search(first_step)
        is_deflected = line.slope > -float(g @ g) * (1 - 1e-12)
        if trial is None and is_deflected:
            d = -g
            line = line_search_in(d)
            trial = line.search(_initial_step(x, f, g=g))
        if trial is None:
            return result("line-search", k)
        change = abs(trial.value - f)
        average.note_change(change)
        step = trial.step
        slope = line.slope
        y = trial.gradient - g
        before = g
        x = x + step * d
        f = trial.value
        g = trial.gradient
        last_direction = d
        d = _next_direction(d, before, g=g, y=y, truncation=options.truncation)
        state = CgState(
            k + 1, x, value=f, gradient=g, direction=last_direction, slope=slope, step=step
        )
        if callback is not None and callback(state):
            return result("stopped", k + 1)
    if np.abs(g).max(initial=0.0) <= options.tolerance:
        return result("converged", options.max_iterations)
    return result("iteration-limit", options.max_iterations)


def _next_direction(d: Array, previous: Array, g: Array, y: Array, truncation: float) -> Array:
    """Return a direction of descent (n,); steepest after a step without curvature."""
    curvature = float(d @ y)
    if curvature <= 0:
        return -g
    beta = float((y - 2 * d * (float(y @ y) / curvature)) @ g) / curvature
    size = float(np.linalg.norm(d)) * min(truncation, float(np.linalg.norm(previous)))
    return -g + max(beta, -1 / size) * d


def _initial_step(x: Array, f: float, g: Array) -> float:
    """Return the step size of the first line search at x with the value f and the gradient g ≠ 0,
    rule I0: `FIRST` times the largest magnitude in x over that in g; if x is zero, `FIRST` times
    |f| over the squared Euclidean norm of g; 1 if f is zero too.
    """
    steepest = float(np.abs(g).max())
    if x.any():
        return FIRST * float(np.abs(x).max()) / steepest
    return FIRST * abs(f) / float(g @ g) if f else 1.0


def _initial_step_after(line: _LineSearch, last: float, change: float) -> float:
    """Return the step of a later line search: I1 (parabola) or I2."""
    if change > SMALL_CHANGE * abs(line.value):
        sample_step = SAMPLED * last
        value = line.value_at(sample_step)
        curvature = value - line.value - sample_step * line.slope
        if value <= line.value and curvature > 0:
            return -line.slope * sample_step**2 / (2 * curvature)
    return GROWTH * last


class _CountedFunction:
    """Function with a count of the evaluations of its gradient.

    Parameters
    ----------
    fun_and_grad : callable
        Returns value and gradient (n,) at x.
    value : callable or None
        Returns the value alone; None to use `fun_and_grad`.
    """

    def __init__(
        self, fun_and_grad: ValueAndGradient, value: Callable[[Array], float] | None
    ) -> None:
        self._fun_and_grad = fun_and_grad
        self._value = value
        self.evaluations = 0

    def __call__(self, x: Array) -> tuple[float, Array]:
        """Return value and gradient at x."""
        self.evaluations += 1
        return self._fun_and_grad(x)

    def value(self, x: Array) -> float:
        """Return the value at x (n,); it is counted only if the gradient is evaluated, too."""
        return self(x)[0] if self._value is None else self._value(x)


@dataclass
class _AverageValue:
    """Average size C of the values so far, from which the effect of rounding is estimated."""

    options: CgDescentOptions
    weight: float = 0.0  # weight of the values so far
    size: float = 0.0  # average size C
    approximate: bool = False  # whether only the approximate Wolfe conditions count

    def add(self, value: float) -> None:
        """Update the average size with the size of a value, in place."""
        self.weight = 1 + self.options.memory * self.weight
        self.size += (abs(value) - self.size) / self.weight

    def note_change(self, change: float) -> None:
        """Keep to the approximate conditions after a change of `switch` C."""
        if change <= self.options.switch * self.size:
            self.approximate = True


@dataclass(frozen=True, eq=False)
class _LineTrial:
    """Function along the line at one step size: value, derivative (`slope`) and gradient."""

    step: float
    value: float
    slope: float
    gradient: Array = field(repr=False)


class _TrialAccepted(Exception):
    """Exception that ends a line search with a trial that satisfies the Wolfe conditions."""

    def __init__(self, trial: _LineTrial) -> None:
        super().__init__()
        self.trial = trial


class _TrialsExhausted(Exception):
    """Exception that ends a line search after the largest number of trials."""


class _LineSearch:
    """Line search along one direction.

    Parameters
    ----------
    function : _CountedFunction
    x : (n,) array
        Start of the line.
    value, gradient
        Value and gradient (n,) at x.
    direction : (n,) array
        Direction of the line, along which the value decreases.
    error : float
        Rounding error of the value; values up to it above `value` count as equal.
    approximate : bool
        Whether only the approximate Wolfe conditions count.
    options : CgDescentOptions
    """

    def __init__(
        self,
        function: _CountedFunction,
        x: Array,
        value: float,
        gradient: Array,
        direction: Array,
        error: float,
        approximate: bool,
        options: CgDescentOptions,
    ) -> None:
        self.function = function
        self.x = x
        self.value = value
        self.direction = direction
        self.slope = float(gradient @ direction)
        self.start = _LineTrial(0.0, value, slope=self.slope, gradient=gradient)
        self.limit = value + error
        self.approximate = approximate
        self.options = options
        self.trials = 0

    def value_at(self, step: float) -> float:
        """Return the value at a step size, which is no counted trial."""
        return self.function.value(self.x + step * self.direction)

    def search(self, step: float) -> _LineTrial | None:
        """Return a trial that satisfies the Wolfe conditions (L0 … L3), starting at a step size
        above zero.

        None if the allowed number of trials does not contain one, or no number lies between the
        ends of the interval.
        """
        try:
            a, b = self._bracket(step)
            while True:
                low, high = self._double_secant(a, b)
                if high.step - low.step > SHRINK * (b.step - a.step):
                    middle = (low.step + high.step) / 2
                    if not low.step < middle < high.step:
                        return None  # no number lies between
                    low, high = self._update(low, high, step=middle)
                a = low
                b = high
        except _TrialAccepted as found:
            return found.trial
        except _TrialsExhausted:
            return None

    def _try(self, step: float) -> _LineTrial:
        """Return and count a trial; infinite value, NaN slope where not finite."""
        if self.trials >= self.options.max_trials:
            raise _TrialsExhausted
        self.trials += 1
        value, gradient = self.function(self.x + step * self.direction)
        # Out of the domain the slope is not a number: neither up nor down, and the value is high.
        slope = float(gradient @ self.direction) if np.isfinite(value) else np.nan
        trial = _LineTrial(
            step, value if np.isfinite(slope) else np.inf, slope=slope, gradient=gradient
        )
        if self._satisfies_wolfe(trial):
            raise _TrialAccepted(trial)
        return trial

    def _satisfies_wolfe(self, trial: _LineTrial) -> bool:
        """Return whether a trial satisfies the Wolfe conditions: T2, the approximate ones with a
        value up to `limit`, or, unless only these count, T1.

        Both require a slope of at least `curvature` times that at the start; false if it is NaN.
        """
        decrease = self.options.decrease
        curvature = self.options.curvature
        if not trial.slope >= curvature * self.slope:
            return False
        if (2 * decrease - 1) * self.slope >= trial.slope and trial.value <= self.limit:
            return True
        is_decreased = trial.value - self.value <= decrease * trial.step * self.slope
        return is_decreased and not self.approximate

    def _bracket(self, step: float) -> tuple[_LineTrial, _LineTrial]:
        """Return a descending end a and an ascending end b, rules B0 … B3."""
        low = self.start
        while True:
            trial = self._try(step)
            if trial.slope >= 0:
                return low, trial
            if not trial.value <= self.limit:
                return self._cut(self.start, trial)
            low = trial
            step = EXPANSION * step

    def _update(self, a: _LineTrial, b: _LineTrial, step: float) -> tuple[_LineTrial, _LineTrial]:
        """Return an interval with the trial at `step` as an end, rules U0 … U3."""
        if not a.step < step < b.step:
            return a, b
        trial = self._try(step)
        if trial.slope >= 0:
            return a, trial
        if trial.value <= self.limit:
            return trial, b
        return self._cut(a, trial)

    def _cut(self, a: _LineTrial, b: _LineTrial) -> tuple[_LineTrial, _LineTrial]:
        """Return an interval with an ascending end by bisection, rule U3."""
        while True:
            trial = self._try((1 - CUT) * a.step + CUT * b.step)
            if trial.slope >= 0:
                return a, trial
            if trial.value <= self.limit:
                a = trial
            else:
                b = trial

    def _double_secant(self, a: _LineTrial, b: _LineTrial) -> tuple[_LineTrial, _LineTrial]:
        """Return an interval after up to two secant steps, rules S1 … S4."""
        step = _secant(a, b)
        low, high = self._update(a, b, step=step)
        if high.step == step:
            return self._update(low, high, step=_secant(b, high))
        if low.step == step:
            return self._update(low, high, step=_secant(a, low))
        return low, high


def _secant(a: _LineTrial, b: _LineTrial) -> float:
    """Return the step at which the interpolated slope is zero; NaN for equal slopes."""
    if a.slope == b.slope:
        return np.nan
    return (a.step * b.slope - b.step * a.slope) / (b.slope - a.slope)
