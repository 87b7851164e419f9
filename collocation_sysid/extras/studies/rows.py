"""Numbers of a study: one row per run, and a summary per method."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field
from typing import Any

import numpy as np

from ...common.serialisation import read
from ...common.validated_classes import validated
from ...common.validated_types import Positive
from ...runs.result_content import Result
from .planning import PlannedRun
from .run_execution import TIMEOUT, Record

Row = dict[str, Any]

# Quality and cost of a run, from its result.
NUMBERS: dict[str, Callable[[Result], float | None]] = {
    "rms_m": lambda r: r.fit.rms_m,
    "violation_n": lambda r: r.dynamics.max_violation_n,
    "violation_relative": lambda r: r.dynamics.max_violation_relative,
    "iterations": lambda r: r.iterations,
    "total_s": lambda r: r.timing_s.total,
}


@validated
class SuccessCriterion:
    """Criterion of success.

    Attributes
    ----------
    truth : mapping of name to value, empty where it is unknown
        True values of the parameters.
    within : float
        Largest relative error of an estimated parameter.
    """

    truth: Mapping[str, float] = field(default_factory=dict)
    within: Positive = 0.01

    def describe(self) -> str:
        """Return the explanation of the criterion for the user."""
        if not self.truth:
            return "A run succeeds when it converges."
        return (
            "A run succeeds when it converges with every estimated parameter within "
            f"{100 * self.within:g} % of the truth."
        )


# Runs ---------------------------------------------------------------------------------------------


def run_row(run: PlannedRun, record: Record | None, yardstick: SuccessCriterion) -> Row:
    """Return one run as a flat row; values are None if they are not known or NaN.

    The columns are "label", "method", "start", "status", "converged", "success", those of the
    parameters, the names in `NUMBERS` (quality and cost, such as "rms_m"),
    "wall_s" and "message". The columns of the parameters are ``guess_NAME``,
    ``value_NAME``, and ``error_NAME`` (relative to the truth, only for parameters whose truth is
    known).

    Parameters
    ----------
    run : PlannedRun
        Run of a comparison of methods.
    record : Record or None
        Its record; None if it was not executed: its "status" is then "missing".
    yardstick : SuccessCriterion
        Criterion of success. A run that exceeded its time limit counts as not converged.
    """
    record = record or {"outcome": "missing", "message": "not run yet"}
    result: Result | None = read(Result | None, record.get("result"))
    is_timeout = record["outcome"] == TIMEOUT
    converged = result is not None and result.converged and not is_timeout
    parameters = _parameter_columns(run, result, truth=yardstick.truth)
    errors = [parameters[f"error_{name}"] for name in run.guess if name in yardstick.truth]
    is_accurate = all(error is not None and error <= yardstick.within for error in errors)
    numbers = {name: None if result is None else number(result) for name, number in NUMBERS.items()}
    row = {
        "label": run.label,
        "method": run.method,
        "start": run.start,
        "status": record["outcome"] if is_timeout or result is None else result.status,
        "converged": converged,
        "success": converged and is_accurate,
        **parameters,
        **numbers,
        "wall_s": record.get("wall_s"),
        "message": record.get("message", ""),
    }
    return {key: None if each != each else each for key, each in row.items()}  # NaN is no number


def _parameter_columns(run: PlannedRun, result: Result | None, truth: Mapping[str, float]) -> Row:
    """First ``guess_NAME`` of all, then ``value_NAME`` and ``error_NAME`` of each."""
    row: Row = {}
    estimates = {} if result is None else result.parameters
    for name, guess in run.guess.items():
        known = estimates[name].guess if name in estimates else None
        row[f"guess_{name}"] = known if guess is None else guess
    for name in run.guess:
        estimate = estimates.get(name)
        # Methods are compared by the optimum that they find, not by its correction.
        value = estimate and (estimate.value if estimate.optimum is None else estimate.optimum)
        row[f"value_{name}"] = value
        if name in truth:
            row[f"error_{name}"] = None if value is None else abs(value / truth[name] - 1)
    return row


def error_columns(rows: Sequence[Row]) -> list[str]:
    """Return the names of the columns ``error_NAME``. `rows`, at least one, are those of `run_row`
    or `method_rows`; the first one decides.
    """
    return [name for name in rows[0] if name.startswith("error_")]


# Methods ------------------------------------------------------------------------------------------


def method_rows(rows: Sequence[Row]) -> list[Row]:
    """Return a summary of each method, in the order of their first runs, see `_method_summary`.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `run_row`, also of runs that are missing; empty gives an empty list.
    """
    methods = dict.fromkeys(row["method"] for row in rows)
    return [
        _method_summary(method, [row for row in rows if row["method"] == method])
        for method in methods
    ]


def _method_summary(method: str, rows: Sequence[Row]) -> Row:
    """Runs with the status "missing" are not counted."""
    done = [row for row in rows if row["status"] != "missing"]
    successes = sum(row["success"] for row in done)
    medians = (*error_columns(rows), *NUMBERS)
    known = {name: [row[name] for row in done if row[name] is not None] for name in medians}
    return {
        "method": method,
        "runs": len(done),
        "converged": sum(row["converged"] for row in done),
        "successes": successes,
        **{name: float(np.median(each)) if each else None for name, each in known.items()},
    }
