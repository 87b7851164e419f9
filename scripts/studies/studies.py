"""Runner of the studies: cases in processes, and Markdown tables."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from collocation_sysid.extras.studies import (
    PlannedRun,
    RunOptions,
    Starts,
    plan_comparison,
    run_all,
)
from collocation_sysid.extras.studies.rows import Row, SuccessCriterion, run_row
from collocation_sysid.extras.studies.run_execution import Record
from collocation_sysid.problem import Problem

T = TypeVar("T")

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

    @property
    def overrides(self) -> list[str]:
        """Arguments of the option --set of the command line."""
        return [f"solver.{self.method}.{key}={value}" for key, value in self.options.items()]

    def limited(self, time_s: float) -> Variant:
        """Return the variant with a time limit [s], which reduced space does not need."""
        if self.method == "reduced-space":
            return self
        return replace(self, options={"max_time_s": time_s, **self.options})


def run_variants(
    path: Path, variants: Sequence[Variant], *, time_s: float = 60.0, workers: int = 2
) -> dict[str, Row]:
    """Run all variants of the method of a problem file, and return the row of each by its name.

    A run that does not end within `time_s` [s] is killed `GRACE_S` later.
    """
    planned: dict[str, PlannedRun] = {}
    for variant in variants:
        overrides = variant.limited(time_s).overrides
        problem = Problem.read(path, overrides)
        (planned[variant.name],) = plan_comparison(
            problem, [variant.method], overrides, Starts(1), TRUTH
        )
    names = {id(run): name for name, run in planned.items()}
    records: dict[str, Record] = {}

    def keep(run: PlannedRun, record: Record) -> None:
        name = names[id(run)]
        records[name] = record
        message = str(record["message"])[:100]
        line = f"{name}: {record['outcome']}, {record['wall_s']:.1f} s: "
        print(line + message, file=sys.stderr, flush=True)

    run_all([*planned.values()], RunOptions(workers, time_s + GRACE_S), keep)
    criterion = SuccessCriterion(TRUTH)
    return {name: run_row(run, records.get(name), criterion) for name, run in planned.items()}


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table with the first column aligned left and the others right."""
    rule = ("---", *("---:" for _ in heads[1:]))
    return "\n".join("| " + " | ".join(line) + " |" for line in (heads, rule, *rows))


def number(value: float | None, scale: float = 1.0, digits: int = 3) -> str:
    """Return `scale` times a number for a table; a dash for None."""
    return "–" if value is None else f"{scale * value:.{digits}g}"


def run_in_processes(run: Callable[..., T], jobs: Sequence[tuple], workers: int = 1) -> list[T]:
    """Return the results of a function for all tuples of arguments, computed in so many processes."""
    # Worker processes read these variables when they start: one thread each.
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "COLLOCATION_SYSID_THREADS": "1"}
    start = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=start) as pool:
        return list(pool.map(run, *zip(*jobs, strict=True), chunksize=5))
