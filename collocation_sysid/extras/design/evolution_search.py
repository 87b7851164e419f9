"""Minimisation of an expensive function without derivatives.

Random samples are followed by an evolution strategy that adapts the diagonal of a covariance
(sep-CMA-ES: Hansen, The CMA evolution strategy: a tutorial, 2016, and Ros and Hansen 2008). It
converges in a few hundred evaluations and uses only the order of values. Use `minimise`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ...common.array_types import Array

# Share of the evaluations that are random samples, without a start.
EXPLORED = 0.2
# Initial standard deviation about the best random sample: coefficients are of order one.
FIRST_DEVIATION = 0.5
# Initial standard deviation about a start, which is known to be good.
SMALLEST_DISTANCE = 0.15

# Function that returns the value at coefficients (d,); beyond the bound, the second argument, it
# need not be exact.
Value = Callable[[Array, float], float]
# Function that is called with the number of evaluations so far and the smallest value.
Watch = Callable[[int, float], None]


@dataclass(eq=False)
class SearchResult:
    """Best point of a search, updated while the search runs."""

    # (d,) or None: best coefficients; None before the first evaluation.
    coefficients: Array | None = None
    value: float = np.inf  # smallest value; infinite before the first evaluation
    history: list[float] = field(default_factory=list)  # smallest value after each evaluation
    is_interrupted: bool = False  # whether Ctrl-C ended the search


def minimise(
    value: Value,
    dimension: int,
    evaluations: int,
    seed: int = 0,
    watch: Watch | None = None,
    start: Array | None = None,
) -> SearchResult:
    """Return the best point of a search for the minimum of a function of coefficients whose
    expected magnitude is one.

    Ctrl-C ends the search; the result is the best point so far.

    Parameters
    ----------
    value : callable
        Function of coefficients (d,) and of a bound; beyond the bound its result need not be exact,
        only larger than the bound.
    dimension : int
        Number of coefficients d.
    evaluations : int
        Number of evaluations, all of which are made; at least 1.
    seed : int
        Seed of the random numbers.
    watch : callable, optional
        Function that is called after each evaluation with the number of evaluations so far and the
        smallest value.
    start : (d,) array, optional
        Initial coefficients, which are evaluated first and searched around more closely than
        without; by default the best of random samples, the share `EXPLORED` of all evaluations.

    Returns
    -------
    SearchResult
        Best coefficients, their value, and the smallest value after each evaluation.

    Raises
    ------
    KeyboardInterrupt
        If the search is interrupted before the first evaluation.
    """
    best = SearchResult()
    rng = np.random.default_rng(seed)

    def evaluate(at: Array, bar: float) -> float:
        """Return the value at coefficients `at` (d,), and update the best point and its history;
        `bar` is the bound beyond which the value need not be exact.
        """
        size = value(at, bar)
        if best.coefficients is None or size < best.value:
            best.coefficients = at
            best.value = size
        best.history.append(best.value)
        if watch is not None:
            watch(len(best.history), best.value)
        return size

    try:
        if start is not None:
            evaluate(start, np.inf)
        else:
            for _ in range(max(1, round(EXPLORED * evaluations))):
                evaluate(rng.normal(size=dimension), best.value)
        assert best.coefficients is not None
        strategy = EvolutionStrategy(
            best.coefficients, FIRST_DEVIATION if start is None else SMALLEST_DISTANCE
        )
        bar = np.inf
        while len(best.history) < evaluations:
            count = min(strategy.offspring, evaluations - len(best.history))
            steps = rng.normal(size=(count, dimension))
            sizes = np.array([evaluate(strategy.point(step), bar) for step in steps])
            if count == strategy.offspring:
                strategy.update(steps[np.argsort(sizes, kind="stable")])
            bar = float(np.median(sizes))
    except KeyboardInterrupt:
        if best.coefficients is None:
            raise
        best.is_interrupted = True
    return best


class EvolutionStrategy:
    """State of sep-CMA-ES: mean, deviations and paths, with the constants of the tutorial.

    Parameters
    ----------
    mean : (d,) array
        Initial mean; it is copied.
    deviation : float
        Initial standard deviation, equal for all coefficients.

    Attributes
    ----------
    offspring : int
        Number of samples per update.
    """

    def __init__(self, mean: Array, deviation: float) -> None:
        n = len(mean)
        self.mean = mean.copy()
        self.deviation = deviation
        self.offspring = 4 + int(3 * np.log(n))
        weights = np.log((self.offspring + 1) / 2) - np.log(np.arange(self.offspring // 2) + 1)
        self.weights = weights / weights.sum()
        effective = self.effective = 1 / float(np.sum(self.weights**2))
        self.c_path = (effective + 2) / (n + effective + 5)
        self.damping = 1 + 2 * max(0.0, np.sqrt((effective - 1) / (n + 1)) - 1) + self.c_path
        self.c_rank = (4 + effective / n) / (n + 4 + 2 * effective / n)
        faster = (n + 2) / 3  # for a diagonal
        self.c_one = min(0.5, faster * 2 / ((n + 1.3) ** 2 + effective))
        several = 2 * (effective - 2 + 1 / effective) / ((n + 2) ** 2 + effective)
        self.c_mu = min(1 - self.c_one, faster * several)
        self.usual = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
        self.variances = np.ones(n)
        self.path = np.zeros(n)
        self.drift = np.zeros(n)

    def point(self, step: Array) -> Array:
        """Return the coefficients (d,) for a sample `step` (d,) of the standard normal
        distribution, at the present mean and deviations; the strategy is not changed.
        """
        return self.mean + self.deviation * np.sqrt(self.variances) * step

    def update(self, steps: Array) -> None:
        """Update mean, deviation, variances and paths, in place, from the standard normal samples
        (`offspring`, d) whose points were evaluated, sorted from best to worst.
        """
        best = steps[: len(self.weights)]
        scale = np.sqrt(self.variances)
        mean_step = self.weights @ best
        self.mean = self.mean + self.deviation * scale * mean_step
        c = self.c_path
        r = self.c_rank
        self.path = (1 - c) * self.path + np.sqrt(c * (2 - c) * self.effective) * mean_step
        length = float(np.linalg.norm(self.path))
        is_path_short = length < (1.4 + 2 / (len(mean_step) + 1)) * self.usual * np.sqrt(2)
        drift_step = np.sqrt(r * (2 - r) * self.effective) * scale * mean_step
        self.drift = (1 - r) * self.drift + is_path_short * drift_step
        spread = self.weights @ (scale * best) ** 2
        previous_weight = 1 - self.c_one - self.c_mu
        self.variances = (
            previous_weight * self.variances + self.c_one * self.drift**2 + self.c_mu * spread
        )
        self.deviation *= float(np.exp(min(1.0, c / self.damping * (length / self.usual - 1))))
