"""Minimisation of an expensive function without derivatives.

Random samples are followed by an evolution strategy that adapts the diagonal of a covariance
(sep-CMA-ES: Ros and Hansen 2008, in the package `cmaes`). It converges in a few hundred evaluations
and uses only the order of values. Use `minimise`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from cmaes import SepCMA

from ...common.array_types import Array

# Share of the evaluations that are random samples, without a start.
EXPLORED = 0.2
# Initial standard deviation about the best random sample: coefficients are of order one.
FIRST_DEVIATION = 0.5
# Initial standard deviation about a start, which is known to be good.
SMALLEST_DISTANCE = 0.15
# Smallest number of coefficients of the strategy; it has one more if the function has only one.
LEAST_DIMENSION = 2

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
        deviation = FIRST_DEVIATION if start is None else SMALLEST_DISTANCE
        mean = np.zeros(max(dimension, LEAST_DIMENSION))
        mean[:dimension] = best.coefficients
        strategy = SepCMA(mean, deviation, seed=seed)
        bar = np.inf
        while len(best.history) < evaluations:
            count = min(strategy.population_size, evaluations - len(best.history))
            points = [strategy.ask() for _ in range(count)]
            sizes = [evaluate(point[:dimension], bar) for point in points]
            if count == strategy.population_size:
                strategy.tell([*zip(points, sizes, strict=True)])
            bar = float(np.median(sizes))
    except KeyboardInterrupt:
        if best.coefficients is None:
            raise
        best.is_interrupted = True
    return best
