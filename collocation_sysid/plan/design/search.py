"""Search for the smallest value of a function that costs much and has no slopes.

Draws at random first, then the evolution strategy with covariance adaptation, of which only the
diagonal is adapted (sep-CMA-ES: Hansen, The CMA evolution strategy: a tutorial, 2016, and Ros and
Hansen 2008): that learns in a few hundred evaluations, and knows only the order of values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ...arrays import Array

# Share of the evaluations that are drawn at random, and the first deviation about the best.
EXPLORED = 0.2
FIRST_DEVIATION = 0.5
# The deviation about a start that is known to be good.
NEAR = 0.15

# The value at coefficients; beyond the second number it need not be exact.
Value = Callable[[Array, float], float]
# Called with the evaluations done and the smallest value.
Watch = Callable[[int, float], None]


@dataclass(eq=False)
class Best:
    """The best there is, also while the search goes on.

    Attributes
    ----------
    at : (d,) or None before the first evaluation
    value : float
    history : list of the smallest value after each evaluation
    interrupted : bool
    """

    at: Array | None = None
    value: float = np.inf
    history: list[float] = field(default_factory=list)
    interrupted: bool = False


def search(
    value: Value,
    dimension: int,
    evaluations: int,
    seed: int = 0,
    watch: Watch | None = None,
    start: Array | None = None,
) -> Best:
    """Minimise a function of coefficients that are about as large as one.

    Ctrl-C ends the search and keeps the best.

    Parameters
    ----------
    value : callable
        Of (d,) coefficients, and a number beyond which its result need only be larger than that.
    dimension, evaluations, seed
    watch : callable, optional
    start : (d,), optional
        Where to begin, in place of the best of draws.
    """
    best, rng = Best(), np.random.default_rng(seed)

    def evaluated(at: Array, bar: float) -> float:
        size = value(at, bar)
        if best.at is None or size < best.value:
            best.at, best.value = at, size
        best.history.append(best.value)
        if watch is not None:
            watch(len(best.history), best.value)
        return size

    try:
        if start is not None:
            evaluated(start, np.inf)
        else:
            for _ in range(max(1, round(EXPLORED * evaluations))):
                evaluated(rng.normal(size=dimension), best.value)
        assert best.at is not None
        strategy = Strategy(best.at, FIRST_DEVIATION if start is None else NEAR)
        bar = np.inf
        while len(best.history) < evaluations:
            count = min(strategy.offspring, evaluations - len(best.history))
            steps = rng.normal(size=(count, dimension))
            sizes = np.array([evaluated(strategy.point(step), bar) for step in steps])
            if count == strategy.offspring:
                strategy.learn(steps[np.argsort(sizes, kind="stable")])
            bar = float(np.median(sizes))
    except KeyboardInterrupt:
        if best.at is None:
            raise
        best.interrupted = True
    return best


class Strategy:
    """Mean, deviations and paths of sep-CMA-ES, with the tutorial's constants."""

    def __init__(self, mean: Array, deviation: float) -> None:
        n = len(mean)
        self.mean, self.deviation = mean.copy(), deviation
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
        self.variances, self.path, self.drift = np.ones(n), np.zeros(n), np.zeros(n)

    def point(self, step: Array) -> Array:
        """Where a draw (d,) from the unit normal distribution leads."""
        return self.mean + self.deviation * np.sqrt(self.variances) * step

    def learn(self, steps: Array) -> None:
        """Move towards the best of the draws (offspring, d), which come first."""
        best = steps[: len(self.weights)]
        scale = np.sqrt(self.variances)
        way = self.weights @ best
        self.mean = self.mean + self.deviation * scale * way
        c, r = self.c_path, self.c_rank
        self.path = (1 - c) * self.path + np.sqrt(c * (2 - c) * self.effective) * way
        length = float(np.linalg.norm(self.path))
        steady = length < (1.4 + 2 / (len(way) + 1)) * self.usual * np.sqrt(2)
        pushed = np.sqrt(r * (2 - r) * self.effective) * scale * way
        self.drift = (1 - r) * self.drift + steady * pushed
        spread = self.weights @ (scale * best) ** 2
        kept = 1 - self.c_one - self.c_mu
        self.variances = kept * self.variances + self.c_one * self.drift**2 + self.c_mu * spread
        self.deviation *= float(np.exp(min(1.0, c / self.damping * (length / self.usual - 1))))
