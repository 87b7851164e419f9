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

from ...arrays import Array

ValueAndGradient = Callable[[Array], tuple[float, Array]]


@dataclass(frozen=True)
class CgDescentOptions:
    """Options, by the papers' letters in brackets.

    Attributes
    ----------
    tolerance : float
        Largest entry of the gradient at the end.
    max_iterations : int
    decrease, curvature : float
        Of the Wolfe conditions (δ, σ).
    rounding : float
        Relative error of the value (ε): values within it count as equal.
    memory : float
        Decay of the average size of the value (Δ).
    switch : float
        Relative change of the value below which only the approximate conditions count (ω).
    truncation : float
        Of β from below (η).
    max_trials : int
        Evaluations of one line search.
    """

    tolerance: float = 1e-6
    max_iterations: int = 10_000
    decrease: float = 0.1
    curvature: float = 0.9
    rounding: float = 1e-6
    memory: float = 0.7
    switch: float = 1e-3
    truncation: float = 0.01
    max_trials: int = 60


Ending = Literal["converged", "iteration-limit", "stopped", "line-search", "not-finite"]

# Share of the start in the first step, of the last step where the value is sampled for the next,
# and the growth of a step where that tells nothing (ψ0, ψ1, ψ2).
FIRST, SAMPLED, GROWTH = 0.01, 0.1, 2.0
# Relative change of the value below which it is not sampled: rounding would speak.
SMALL_CHANGE = 1e-12
# Where an interval is cut, what it must at least shrink by, and the growth of a bracket (θ, γ, ρ).
CUT, SHRINK, EXPANSION = 0.5, 0.66, 5.0


@dataclass(frozen=True, eq=False)
class CgState:
    """One iterate, as a callback sees it.

    Attributes
    ----------
    iteration : int
    x, value, gradient : the iterate
    direction : (n,) along which it was reached, from `slope`, the derivative at step 0
    step : float
    """

    iteration: int
    x: Array
    value: float
    gradient: Array
    direction: Array
    slope: float
    step: float


@dataclass(frozen=True, eq=False)
class CgResult:
    """Where the minimisation ended."""

    x: Array
    value: float
    gradient: Array
    iterations: int
    evaluations: int
    ending: Ending

    @property
    def converged(self) -> bool:
        """Whether the gradient is within the tolerance."""
        return self.ending == "converged"


def minimise(
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
        Value and gradient (n,) at x; an infinite value where x is out of the domain.
    x0 : (n,) ndarray
    options : CgDescentOptions, optional
    callback : callable, optional
        Called with the start and every iterate; a true answer stops.
    value : callable, optional
        The value alone, where that is cheaper.

    Returns
    -------
    CgResult
    """
    options = options or CgDescentOptions()
    counted = _Counted(fun_and_grad, value)
    x = np.array(x0, dtype=float)
    f, g = counted(x)

    def ended(ending: Ending, iterations: int) -> CgResult:
        return CgResult(x, f, g, iterations, counted.evaluations, ending)

    if not (np.isfinite(f) and np.isfinite(g).all()):
        return ended("not-finite", 0)
    d, step, change = -g, 0.0, np.inf
    average = _Average(options)
    if callback is not None and callback(CgState(0, x, f, g, d, 0.0, 0.0)):
        return ended("stopped", 0)
    for k in range(options.max_iterations):
        if np.abs(g).max(initial=0.0) <= options.tolerance:
            return ended("converged", k)
        average.add(f)
        line = _Line(counted, x, f, g, d, average.error, average.approximate, options)
        found = line.search(_first_step(x, f, g) if k == 0 else _next_step(line, step, change))
        if found is None and line.slope > -float(g @ g) * (1 - 1e-12):  # once down the gradient
            d = -g
            line = _Line(counted, x, f, g, d, average.error, average.approximate, options)
            found = line.search(_first_step(x, f, g))
        if found is None:
            return ended("line-search", k)
        change = abs(found.value - f)
        average.judge(change)
        step, slope = found.step, line.slope
        y, before = found.gradient - g, g
        x, f, g = x + step * d, found.value, found.gradient
        reached_along = d
        d = _direction(d, before, g, y, options.truncation)
        state = CgState(k + 1, x, f, g, reached_along, slope, step)
        if callback is not None and callback(state):
            return ended("stopped", k + 1)
    if np.abs(g).max(initial=0.0) <= options.tolerance:
        return ended("converged", options.max_iterations)
    return ended("iteration-limit", options.max_iterations)


def _direction(d: Array, before: Array, g: Array, y: Array, truncation: float) -> Array:
    """The next direction; after a step without curvature, steepest descent."""
    along = float(d @ y)
    if along <= 0:
        return -g
    beta = float((y - 2 * d * (float(y @ y) / along)) @ g) / along
    size = float(np.linalg.norm(d)) * min(truncation, float(np.linalg.norm(before)))
    return -g + max(beta, -1 / size) * d


def _first_step(x: Array, f: float, g: Array) -> float:
    """I0."""
    steepest = float(np.abs(g).max())
    if x.any():
        return FIRST * float(np.abs(x).max()) / steepest
    return FIRST * abs(f) / float(g @ g) if f else 1.0


def _next_step(line: _Line, last: float, change: float) -> float:
    """I1, the minimum of a parabola through a sample of the value, or I2."""
    if change > SMALL_CHANGE * abs(line.value):
        tried = SAMPLED * last
        value = line.value_at(tried)
        bend = value - line.value - tried * line.slope
        if value <= line.value and bend > 0:
            return -line.slope * tried**2 / (2 * bend)
    return GROWTH * last


class _Counted:
    """The function, with a count of its evaluations."""

    def __init__(
        self, fun_and_grad: ValueAndGradient, value: Callable[[Array], float] | None
    ) -> None:
        self._fun_and_grad, self._value = fun_and_grad, value
        self.evaluations = 0

    def __call__(self, x: Array) -> tuple[float, Array]:
        self.evaluations += 1
        return self._fun_and_grad(x)

    def value(self, x: Array) -> float:
        return self(x)[0] if self._value is None else self._value(x)


@dataclass
class _Average:
    """The average size C of the values so far, which says what rounding may do to one."""

    options: CgDescentOptions
    weight: float = 0.0
    size: float = 0.0
    approximate: bool = False

    def add(self, value: float) -> None:
        self.weight = 1 + self.options.memory * self.weight
        self.size += (abs(value) - self.size) / self.weight

    def judge(self, change: float) -> None:
        """From small changes on, only the approximate Wolfe conditions count."""
        if change <= self.options.switch * self.size:
            self.approximate = True

    @property
    def error(self) -> float:
        return self.options.rounding * self.size


@dataclass(frozen=True, eq=False)
class _Probe:
    """The function along the line at one step."""

    step: float
    value: float
    slope: float
    gradient: Array = field(repr=False)


class _Found(Exception):
    """A trial that satisfies the Wolfe conditions."""

    def __init__(self, trial: _Probe) -> None:
        super().__init__()
        self.trial = trial


class _Exhausted(Exception):
    """No more trials are allowed."""


class _Line:
    """The function along one direction, and the search for a step."""

    def __init__(
        self,
        function: _Counted,
        x: Array,
        value: float,
        gradient: Array,
        direction: Array,
        error: float,
        approximate: bool,
        options: CgDescentOptions,
    ) -> None:
        self.function, self.x, self.value, self.direction = function, x, value, direction
        self.slope = float(gradient @ direction)
        self.start = _Probe(0.0, value, self.slope, gradient)
        self.limit = value + error
        self.approximate = approximate
        self.options = options
        self.trials = 0

    def value_at(self, step: float) -> float:
        return self.function.value(self.x + step * self.direction)

    def search(self, step: float) -> _Probe | None:
        """A step that satisfies the Wolfe conditions (L0 … L3), or None."""
        try:
            a, b = self._bracket(step)
            while True:
                low, high = self._double_secant(a, b)
                if high.step - low.step > SHRINK * (b.step - a.step):
                    middle = (low.step + high.step) / 2
                    if not low.step < middle < high.step:
                        return None  # no number lies between
                    low, high = self._update(low, high, middle)
                a, b = low, high
        except _Found as found:
            return found.trial
        except _Exhausted:
            return None

    def _try(self, step: float) -> _Probe:
        if self.trials >= self.options.max_trials:
            raise _Exhausted
        self.trials += 1
        value, gradient = self.function(self.x + step * self.direction)
        # Out of the domain the slope is not a number: neither up nor down, and the value is high.
        slope = float(gradient @ self.direction) if np.isfinite(value) else np.nan
        trial = _Probe(step, value if np.isfinite(slope) else np.inf, slope, gradient)
        if self._is_enough(trial):
            raise _Found(trial)
        return trial

    def _is_enough(self, trial: _Probe) -> bool:
        """T1 or T2."""
        decrease, curvature = self.options.decrease, self.options.curvature
        if not trial.slope >= curvature * self.slope:
            return False
        if (2 * decrease - 1) * self.slope >= trial.slope and trial.value <= self.limit:
            return True
        fallen = trial.value - self.value <= decrease * trial.step * self.slope
        return fallen and not self.approximate

    def _bracket(self, step: float) -> tuple[_Probe, _Probe]:
        """B0 … B3: an interval at whose ends the slopes have opposite signs."""
        low = self.start
        while True:
            trial = self._try(step)
            if trial.slope >= 0:
                return low, trial
            if not trial.value <= self.limit:
                return self._cut(self.start, trial)
            low, step = trial, EXPANSION * step

    def _update(self, a: _Probe, b: _Probe, step: float) -> tuple[_Probe, _Probe]:
        """U0 … U3: a smaller interval, if `step` is in it."""
        if not a.step < step < b.step:
            return a, b
        trial = self._try(step)
        if trial.slope >= 0:
            return a, trial
        if trial.value <= self.limit:
            return trial, b
        return self._cut(a, trial)

    def _cut(self, a: _Probe, b: _Probe) -> tuple[_Probe, _Probe]:
        """U3: between a low point that goes down and a high one there is one that goes up."""
        while True:
            trial = self._try((1 - CUT) * a.step + CUT * b.step)
            if trial.slope >= 0:
                return a, trial
            if trial.value <= self.limit:
                a = trial
            else:
                b = trial

    def _double_secant(self, a: _Probe, b: _Probe) -> tuple[_Probe, _Probe]:
        """S1 … S4."""
        step = _secant(a, b)
        low, high = self._update(a, b, step)
        if high.step == step:
            return self._update(low, high, _secant(b, high))
        if low.step == step:
            return self._update(low, high, _secant(a, low))
        return low, high


def _secant(a: _Probe, b: _Probe) -> float:
    if a.slope == b.slope:
        return np.nan
    return (a.step * b.slope - b.step * a.slope) / (b.slope - a.slope)
