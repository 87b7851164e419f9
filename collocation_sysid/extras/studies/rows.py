"""Numbers of a study: one row per run, and a summary per method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Any

import numpy as np

from ...common.validated_classes import validated
from ...common.validated_types import Positive
from .planning import PlannedRun
from .run_execution import TIMEOUT, Record

Row = dict[str, Any]

# Quality and cost of a run: loss Σ (residual / σ)² with priors, largest residual of the equations of
# motion [N], RMS difference between the forward simulation and the measurements, in their unit.
NUMBERS = ("loss", "violation_n", "forward", "iterations", "total_s")


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
    parameters, the names in `NUMBERS` (quality and cost), "unit" (of "forward"), "wall_s" and
    "message". The columns of the parameters are ``guess_NAME``,
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
    fit: Row = record.get("fit") or {}
    is_timeout = record["outcome"] == TIMEOUT
    converged = fit.get("converged", False) and not is_timeout
    estimates: Mapping[str, float] = fit.get("parameters", {})
    values = {f"value_{name}": estimates.get(name) for name in run.guess}
    errors = {
        f"error_{name}": abs(estimates[name] / yardstick.truth[name] - 1) if estimates else None
        for name in run.guess
        if name in yardstick.truth
    }
    is_accurate = all(error is not None and error <= yardstick.within for error in errors.values())
    # A run without an answer has the numbers of its last iteration.
    reached = {**(record.get("iteration") or {}), **fit}
    row = {
        "label": run.label,
        "method": run.method,
        "start": run.start,
        "status": record["outcome"] if is_timeout or not fit else fit["status"],
        "converged": converged,
        "success": converged and is_accurate,
        **{f"guess_{name}": guess for name, guess in (run.guess | fit.get("guess", {})).items()},
        **values,
        **errors,
        **{name: reached.get(name) for name in NUMBERS},
        "unit": fit.get("unit"),
        "wall_s": record.get("wall_s"),
        "message": record.get("message", ""),
    }
    return {key: None if each != each else each for key, each in row.items()}  # NaN is no number


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
        "unit": next((row["unit"] for row in done if row["unit"]), ""),
        **{name: float(np.median(each)) if each else None for name, each in known.items()},
    }
