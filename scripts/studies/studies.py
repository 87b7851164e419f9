"""Runs of methods with options in separate processes, and Markdown tables; shared by the studies."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from collocation_sysid.extras.studies import (
    PlannedRun,
    RunOptions,
    RunStore,
    Starts,
    plan_comparison,
    run_all,
)
from collocation_sysid.extras.studies.rows import Row, SuccessCriterion, run_row
from collocation_sysid.problem import Problem

# True parameters of the cylinder of the studies.
TRUTH = {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0}
# Symbols of the parameters, in the order of `TRUTH`.
PARAMETER_SYMBOLS = ("λ", "μ", "γ_r", "γ_m")

# A run that does not end by its own time limit is killed this much later [s].
GRACE_S = 60.0


@dataclass(frozen=True)
class Variant:
    """Method with options.

    Attributes
    ----------
    name : str
        Name in tables.
    method : str
    options : mapping, as in the method's table of a problem file
    share : float
        Share of the initial guesses from which the method is run, for methods that are slow.
    """

    name: str
    method: str
    options: Mapping[str, Any] = field(default_factory=dict)
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
    """Run all variants, and return the rows of each by its name.

    Parameters
    ----------
    path : Path
        A problem file.
    variants : sequence of Variant
    folder : Path
        Folder of the records; runs that are finished there are not repeated.
    starts : int
        Number of initial guesses, log-uniform within a factor `spread` of the truth and equal for
        all variants; 0 means only the guess of the file.
    time_s : float
        Time limit of a run [s]; a run that does not end is killed `GRACE_S` later.
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
