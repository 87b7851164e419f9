"""Numbers of a study: one row for each run, and a comparison's summary of each method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, nan, sqrt
from typing import Any

import numpy as np

from ..errors import InputError
from .plan import PlannedRun
from .store import TIMEOUT, Record

Row = dict[str, Any]

# Medians over a method's runs that have an answer, under the names of the runs' columns.
MEDIANS = (
    "rms_m",
    "violation_n",
    "violation_relative",
    "rollout_rms_m",
    "tip_max_m",
    "iterations",
    "evaluations",
    "build_s",
    "evaluations_s",
    "linear_algebra_s",
    "total_s",
)
NORMAL_975 = 1.959963984540054


@dataclass(frozen=True)
class Yardstick:
    """What a success is.

    Attributes
    ----------
    truth : mapping of name to value, empty where it is unknown
    within : float
        Largest relative error of an estimated parameter.
    """

    truth: Mapping[str, float] = field(default_factory=dict)
    within: float = 0.01

    def __post_init__(self) -> None:
        if not self.within > 0:
            raise InputError(f"found {self.within:g}; expected a number above 0", None, "--within")

    @property
    def sentence(self) -> str:
        """The same for people."""
        if not self.truth:
            return "A run succeeds when it converges."
        return (
            "A run succeeds when it converges with every estimated parameter within "
            f"{100 * self.within:g} % of the truth."
        )


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """95 % interval of a success rate (E. B. Wilson, J. Am. Stat. Assoc. 22, 1927).

    Unlike the normal approximation it holds at rates of 0 and 1 and for few trials.
    """
    if trials == 0:
        return 0.0, 1.0
    rate, z2 = successes / trials, NORMAL_975**2
    centre = (rate + z2 / (2 * trials)) / (1 + z2 / trials)
    spread = sqrt(z2 * (rate * (1 - rate) / trials + z2 / (4 * trials**2))) / (1 + z2 / trials)
    low = 0.0 if successes == 0 else centre - spread
    return low, 1.0 if successes == trials else centre + spread


# Runs ---------------------------------------------------------------------------------------------


def run_row(run: PlannedRun, record: Record | None, yardstick: Yardstick) -> Row:
    """One run as a flat row; None where there is no number.

    Columns ``guess_*``, ``value_*``, ``std_error_*``, ``low_*``, ``high_*`` and ``error_*``
    (relative to the truth) hold the parameters; swept keys have columns of their own.
    """
    record = record or {"outcome": "missing", "message": "not run yet"}
    result = record.get("result") or {}
    timing, rollout = result.get("timing_s") or {}, result.get("rollout") or {}
    dynamics, history = result.get("dynamics") or {}, result.get("history") or []
    late = record["outcome"] == TIMEOUT
    converged = bool(result.get("converged")) and not late
    parameters = _parameters(run, result, yardstick.truth)
    errors = [parameters[f"error_{name}"] for name in run.guess if name in yardstick.truth]
    near = all(error is not None and error <= yardstick.within for error in errors)
    return {
        "key": run.key,
        "method": run.method,
        "start": run.start,
        **run.swept,
        "status": record["outcome"] if late else result.get("status", record["outcome"]),
        "converged": converged,
        "success": converged and near,
        **parameters,
        "loss": history[-1]["loss"] if history else None,
        "rms_m": (result.get("fit") or {}).get("rms_m"),
        "violation_n": dynamics.get("max_violation_n"),
        "violation_relative": dynamics.get("max_violation_relative"),
        "rollout_rms_m": rollout.get("rms_m"),
        "rollout_max_m": rollout.get("max_m"),
        "tip_max_m": (record.get("tip") or {}).get("max_m"),
        "iterations": result.get("iterations"),
        "evaluations": result.get("evaluations"),
        **{
            f"{part}_s": timing.get(part)
            for part in ("build", "evaluations", "linear_algebra", "total")
        },
        "wall_s": record.get("wall_s"),
        "attempts": record.get("attempts"),
        "message": record.get("message", ""),
    }


def _parameters(run: PlannedRun, result: Mapping[str, Any], truth: Mapping[str, float]) -> Row:
    row: Row = {}
    found = result.get("parameters") or {}
    for name, guess in run.guess.items():
        estimate = found.get(name) or {}
        row[f"guess_{name}"] = estimate.get("guess") if guess is None else guess
    for name in run.guess:
        estimate = found.get(name) or {}
        value = estimate.get("value")
        row[f"value_{name}"] = value
        row[f"std_error_{name}"] = estimate.get("std_error")
        row[f"low_{name}"], row[f"high_{name}"] = estimate.get("ci95") or (None, None)
        if name in truth:
            error = None if value is None else abs(value / truth[name] - 1)
            row[f"error_{name}"] = error
    return row


# Methods ------------------------------------------------------------------------------------------


def method_rows(rows: Sequence[Row]) -> list[Row]:
    """A comparison's summary, one row for each method in the order of their first runs."""
    methods = dict.fromkeys(row["method"] for row in rows)
    return [
        _summary(method, [row for row in rows if row["method"] == method]) for method in methods
    ]


def _summary(method: str, rows: Sequence[Row]) -> Row:
    done = [row for row in rows if row["status"] != "missing"]
    successes = sum(row["success"] for row in done)
    low, high = wilson_interval(successes, len(done))
    errors = [name for name in rows[0] if name.startswith("error_")]
    return {
        "method": method,
        "runs": len(done),
        "converged": sum(row["converged"] for row in done),
        "successes": successes,
        "success_rate": successes / len(done) if done else None,
        "success_low": low,
        "success_high": high,
        **{name: _median(done, name) for name in (*errors, *MEDIANS)},
    }


def _median(rows: Sequence[Row], name: str) -> float | None:
    values = [row[name] for row in rows if row[name] is not None]
    return float(np.median(values)) if values else None


def best_run(rows: Sequence[Row]) -> Row | None:
    """The answer with the lowest loss, of the successes if there are any, else of the converged."""
    answered = [row for row in rows if row["rms_m"] is not None]

    def rank(row: Row) -> tuple[bool, bool, float]:
        loss = row["loss"] if row["loss"] is not None else inf
        return not row["success"], not row["converged"], loss

    return min(answered, key=rank, default=None)


def reference(rows: Sequence[Row], yardstick: Yardstick) -> dict[str, float]:
    """Where guesses are measured from: the truth, or the best answer's parameters."""
    names = [name.removeprefix("guess_") for name in rows[0] if name.startswith("guess_")]
    if yardstick.truth:
        return {name: yardstick.truth[name] for name in names}
    best = best_run(rows)
    if best is None or not best["converged"]:
        return {}
    return {name: best[f"value_{name}"] for name in names}


def distance(row: Row, centre: Mapping[str, float]) -> float:
    """Factor by which the guess that is farthest off misses."""
    logs = [abs(np.log(row[f"guess_{name}"] / value)) for name, value in centre.items()]
    return float(np.exp(max(logs))) if logs else nan
