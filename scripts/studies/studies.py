"""Runner of the studies: cases in processes, coverage of intervals, and Markdown tables."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from scipy.stats import binom

from collocation_sysid.extras.studies import (
    PlannedRun,
    RunOptions,
    RunStore,
    Starts,
    plan_comparison,
    run_all,
)
from collocation_sysid.extras.studies.rows import Row, SuccessCriterion, run_row
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.problem import Problem
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.uncertainty import uncertainty_from_fit

T = TypeVar("T")
# Intervals by the name of what they contain; None where a solve gives none.
Intervals = Mapping[str, tuple[float, float] | None]

# True parameters of the cylinder of the studies.
TRUTH = {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0}
# Symbols of the parameters, in the order of `TRUTH`.
PARAMETER_SYMBOLS = ("λ", "μ", "γ_r", "γ_m")

# A run that does not end by its own time limit is killed this much later [s].
GRACE_S = 60.0


@dataclass(frozen=True)
class Variant:
    """Method with options."""

    name: str
    method: str
    options: Mapping[str, Any] = field(default_factory=dict)
    # Share of the initial guesses from which the method is run, for methods that are slow.
    share: float = 1.0

    @property
    def overrides(self) -> list[str]:
        """Arguments of the option --set of the command line."""
        return [f"solver.{self.method}.{key}={value}" for key, value in self.options.items()]

    def limited(self, time_s: float) -> Variant:
        """Return the variant with a time limit [s], unless it has one or its method has no such
        option.
        """
        if self.method in ("reduced-space", "continuation"):
            return self
        return replace(self, options={"max_time_s": time_s, **self.options})


def run_variants(
    path: Path,
    variants: Sequence[Variant],
    folder: Path,
    *,
    starts: int = 0,
    spread: float = 10.0,
    seed: int = 0,
    time_s: float = 60.0,
    workers: int = 2,
) -> dict[str, list[Row]]:
    """Run all variants of the method of a problem file, and return the rows of each by its name.

    `starts` initial guesses, equal for all variants, are log-uniform within a factor `spread` of the
    truth; 0 means only the guess of the file. Runs whose records are in the folder are not repeated; a
    run that does not end within `time_s` [s] is killed `GRACE_S` later.
    """
    store = RunStore(folder / "runs")
    limits = RunOptions(workers=workers, time_limit_s=time_s + GRACE_S)
    planned: dict[str, list[PlannedRun]] = {}
    for variant in variants:
        overrides = variant.limited(time_s).overrides
        problem = Problem.read(path, overrides)
        count = max(1, round(starts * variant.share)) + 1 if starts else 1
        guesses = Starts(count, spread, seed)
        runs = plan_comparison(problem, [variant.method], overrides, guesses, TRUTH)
        planned[variant.name] = runs[1:] if starts else runs
    remaining = [
        run
        for runs in planned.values()
        for run in runs
        if store.load_finished(run.key, limits.time_limit_s) is None
    ]
    names = {run.key: name for name, runs in planned.items() for run in runs}
    run_all(
        remaining, store, limits, lambda record, _: _print_progress(names[record["key"]], record)
    )
    criterion = SuccessCriterion(TRUTH)
    return {
        name: [run_row(run, store.load(run.key), criterion) for run in runs]
        for name, runs in planned.items()
    }


def _print_progress(name: str, record: Mapping[str, Any]) -> None:
    message = str(record["message"])[:100]
    line = f"{name}, start {record['start']}: {record['outcome']}, {record['wall_s']:.1f} s: "
    print(line + message, file=sys.stderr, flush=True)


def worst_error(row: Row) -> float:
    """Return the largest relative error of a parameter; infinite if a run has no answer."""
    errors = [row[f"error_{name}"] for name in TRUTH]
    return max(float("inf") if error is None else error for error in errors)


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table with the first column aligned left and the others right."""
    rule = ("---", *("---:" for _ in heads[1:]))
    return "\n".join("| " + " | ".join(line) + " |" for line in (heads, rule, *rows))


def number(value: float | None, scale: float = 1.0, digits: int = 3) -> str:
    """Return `scale` times a number for a table; a dash for None."""
    return "–" if value is None else f"{scale * value:.{digits}g}"


def save(folder: Path, name: str, text: str) -> None:
    """Print a table, and write it to a file `name`.md."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.md").write_text(text + "\n", encoding="utf-8")
    print(text)


def run_in_processes(run: Callable[..., T], jobs: Sequence[tuple], workers: int = 1) -> list[T]:
    """Return the results of a function for all tuples of arguments, computed in so many processes."""
    # Worker processes read these variables when they start: one thread each.
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "COLLOCATION_SYSID_THREADS": "1"}
    start = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=start) as pool:
        return list(pool.map(run, *zip(*jobs, strict=True), chunksize=5))


# Coverage -----------------------------------------------------------------------------------------


@dataclass
class Coverage:
    """Counted intervals, by name."""

    twins: int = 0
    # Whether each interval contains the truth.
    contained: dict[str, list[bool]] = field(default_factory=dict)
    # Half width of each interval over the true value.
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


def statistical_intervals(problem: Problem) -> Intervals:
    """Return the intervals for noise of all parameters and derived moduli, by reduced space."""
    solution = ReducedSpace()(problem.collocation())
    fit = linearise_fit(solution.collocation, solution.z)
    parameters = solution.collocation.parameters
    uncertainty = uncertainty_from_fit(fit, parameters, solution.q, problem.uncertainty)
    estimates = {**uncertainty.estimates, **uncertainty.derived}
    return {name: estimate.statistical95 for name, estimate in estimates.items()}
