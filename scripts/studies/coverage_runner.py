"""Runner of studies of coverage: twins are solved, and intervals that contain the truth are counted.

A study yields its twins with their true values and says how one is solved; `count_coverage` does
the rest.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from scipy.stats import binom
from studies import markdown

import collocation_sysid as cs
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.uncertainty import uncertainty_from_fit

T = TypeVar("T")
# Intervals by the name of what they contain; None where a solve gives none.
Intervals = Mapping[str, tuple[float, float] | None]


@dataclass
class Coverage:
    """Counted intervals, by name.

    Attributes
    ----------
    twins : int
        Number of twins.
    contained : mapping of str to list of bool
        Whether each interval contains the truth.
    half_widths : mapping of str to list of float
        Half width of each interval over the true value.
    """

    twins: int = 0
    contained: dict[str, list[bool]] = field(default_factory=dict)
    half_widths: dict[str, list[float]] = field(default_factory=dict)

    def add(self, intervals: Intervals, truth: Mapping[str, float]) -> None:
        """Count the intervals of one twin; the name may be followed by the kind of the interval
        after a comma.
        """
        self.twins += 1
        for name, interval in intervals.items():
            contained = self.contained.setdefault(name, [])
            half_widths = self.half_widths.setdefault(name, [])
            if interval is not None:
                value = truth[name.partition(",")[0]]
                contained.append(interval[0] <= value <= interval[1])
                half_widths.append((interval[1] - interval[0]) / 2 / abs(value))

    def table(self) -> str:
        """Return the expected range and the counts as Markdown."""
        low, high = binom.interval(0.95, self.twins, 0.95)
        rows = [
            (
                name,
                f"{sum(each)} of {len(each)}",
                f"{100 * np.mean(each):.1f}" if each else "–",
                f"{100 * np.median(self.half_widths[name]):.3g}" if each else "–",
            )
            for name, each in self.contained.items()
        ]
        heads = ("interval", "contain the truth", "coverage %", "median half width %")
        return (
            f"{self.twins} twins; the coverage of exact intervals is {100 * low / self.twins:.1f} "
            f"to {100 * high / self.twins:.1f} % with a probability of 95 %\n\n"
            + markdown(heads, rows)
        )


def count_coverage(
    twins: Iterable[tuple[T, Mapping[str, float]]], solve: Callable[[T], Intervals | None]
) -> Coverage:
    """Return the coverage of the intervals that `solve` returns for each twin, given with its true
    values; a twin without an answer (None) is reported and left out.
    """
    coverage = Coverage()
    for number, (twin, truth) in enumerate(twins, start=1):
        intervals = solve(twin)
        if intervals is None:
            print(f"twin {number} has no answer", file=sys.stderr, flush=True)
            continue
        coverage.add(intervals, truth)
        if number % 20 == 0:
            print(f"{number} twins", file=sys.stderr, flush=True)
    return coverage


def statistical_intervals(problem: cs.Problem) -> Intervals:
    """Return the intervals for noise of all parameters and derived moduli, by reduced space."""
    solution = cs.ReducedSpace()(problem.collocation())
    fit = linearise_fit(solution.collocation, solution.z)
    parameters = solution.collocation.parameters
    uncertainty = uncertainty_from_fit(fit, parameters, solution.q, problem.uncertainty)
    estimates = {**uncertainty.estimates, **uncertainty.derived}
    return {name: estimate.statistical95 for name, estimate in estimates.items()}
