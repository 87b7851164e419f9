"""Shared by the studies: methods with options, run in processes of their own, and tables."""

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
from collocation_sysid.extras.studies.study_rows import (
    Row,
    SuccessCriterion,
    run_row,
)
from collocation_sysid.problem import Problem

TRUTH = {
    "lambda_pa": 200.0,
    "mu_pa": 300.0,
    "gamma_r_s": 0.009,
    "gamma_m_1_s": 1.0,
}
HEADS = ("λ", "μ", "γ_r", "γ_m")

# A run that does not end by its own time limit is killed this much later [s].
GRACE_S = 60.0


@dataclass(frozen=True)
class Variant:
    """A method with options of its own.

    Attributes
    ----------
    name : str, in tables
    method : str
    options : mapping, as in the method's table of a problem file
    share : float
        Of the starts that it is run from; the first ones, for a method that takes long.
    """

    name: str
    method: str
    options: Mapping[str, Any] = field(default_factory=dict)
    share: float = 1.0

    @property
    def overrides(self) -> list[str]:
        """The options for the command line's --set."""
        return [
            f"solver.{self.method}.{key}={value}"
            for key, value in self.options.items()
        ]

    def limited(self, time_s: float) -> Variant:
        """With a time limit, unless it has one of its own; reduced-space knows none."""
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
    """Rows of every variant by its name.

    Parameters
    ----------
    path : Path
        A problem file.
    variants : sequence of Variant
    folder : Path
        For the records; runs that are there already are not repeated.
    starts : int
        Guesses, log-uniform within a factor `spread` of the truth, the same for all variants;
        with 0 the file's own guess alone.
    time_s : float
        A run ends by itself after this, or is killed a little later.
    """
    store = RunStore(folder / "runs")
    limits = RunOptions(workers=workers, time_limit_s=time_s + GRACE_S)
    planned: dict[str, list[PlannedRun]] = {}
    for variant in variants:
        overrides = variant.limited(time_s).overrides
        problem = Problem.read(path, overrides)
        count = max(1, round(starts * variant.share)) + 1 if starts else 1
        drawn = Starts(count, spread, seed)
        runs = plan_comparison(
            problem, [variant.method], overrides, drawn, TRUTH
        )
        planned[variant.name] = runs[1:] if starts else runs
    remaining = [
        run
        for runs in planned.values()
        for run in runs
        if store.load_finished(run.key, limits.time_limit_s) is None
    ]
    names = {run.key: name for name, runs in planned.items() for run in runs}
    run_all(
        remaining,
        store,
        limits,
        lambda record, _: _tell(names[record["key"]], record),
    )
    yardstick = SuccessCriterion(TRUTH)
    return {
        name: [run_row(run, store.load(run.key), yardstick) for run in runs]
        for name, runs in planned.items()
    }


def _tell(name: str, record: Mapping[str, Any]) -> None:
    message = str(record["message"])[:100]
    line = f"{name}, start {record['start']}: {record['outcome']}, {record['wall_s']:.1f} s: "
    print(line + message, file=sys.stderr, flush=True)


def worst_error(row: Row) -> float:
    """Largest relative error of a parameter; infinite without an answer."""
    errors = [row[f"error_{name}"] for name in TRUTH]
    return max(float("inf") if error is None else error for error in errors)


def markdown(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table, names to the left and numbers to the right."""
    rule = ("---", *("---:" for _ in heads[1:]))
    return "\n".join(
        "| " + " | ".join(line) + " |" for line in (heads, rule, *rows)
    )


def number(value: float | None, scale: float = 1.0, digits: int = 3) -> str:
    """A number for a table."""
    return "–" if value is None else f"{scale * value:.{digits}g}"


def save(folder: Path, name: str, text: str) -> None:
    """Print a table and keep it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.md").write_text(text + "\n", encoding="utf-8")
    print(text)
