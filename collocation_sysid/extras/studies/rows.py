"""Numbers of a study: one row per run, and a summary per method."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, nan, sqrt
from typing import Any

import numpy as np

from ...common.serialisation import read
from ...common.validated_classes import validated
from ...common.validated_types import Positive
from ...runs.result_content import Result
from .planning import PlannedRun
from .run_execution import TIMEOUT, Record

Row = dict[str, Any]


@dataclass(frozen=True)
class NumberColumn:
    """Number of a run, with its heading and format."""

    head: str = ""  # short heading in the terminal; empty if the column is not shown
    words: str = ""  # heading on pages
    factor: float = 1.0  # factor before display, for example 1000 for millimetres
    form: str = ".2g"  # format specification
    # Function that returns the number from a result; None if it comes from elsewhere.
    from_result: Callable[[Result], float | None] | None = None
    has_median: bool = True  # whether the summary of a method contains the median over its runs

    def format(self, value: float | None) -> str:
        """Return `value` times the factor as text in the format of the column; a dash "–" for None.

        With the default format ".2g", magnitudes from 100 on are rounded to whole numbers.
        """
        if value is None:
            return "–"
        value *= self.factor
        return format(value, ".0f" if self.form == ".2g" and abs(value) >= 100 else self.form)


# Quality and cost of a run.
COLUMNS = {
    "loss": NumberColumn(
        from_result=lambda r: r.history[-1].loss if r.history else None, has_median=False
    ),
    "rms_m": NumberColumn(
        "markers mm", "markers, RMS [mm]", factor=1e3, from_result=lambda r: r.fit.rms_m
    ),
    "violation_n": NumberColumn(
        "violation N",
        "equations of motion violated by [N]",
        factor=1,
        form=".1e",
        from_result=lambda r: r.dynamics.max_violation_n,
    ),
    "violation_relative": NumberColumn(
        "relative",
        "of the largest force",
        factor=1,
        form=".1e",
        from_result=lambda r: r.dynamics.max_violation_relative,
    ),
    "rollout_rms_m": NumberColumn(
        "forward mm",
        "forward simulation, RMS [mm]",
        factor=1e3,
        from_result=lambda r: r.rollout.rms_m,
    ),
    "rollout_max_m": NumberColumn(from_result=lambda r: r.rollout.max_m, has_median=False),
    "tip_max_m": NumberColumn("tip mm", "tip, at most [mm]", factor=1e3),
    "iterations": NumberColumn(
        "iter.", "iterations", factor=1, form=".4g", from_result=lambda r: r.iterations
    ),
    "evaluations": NumberColumn(
        "evals", "evaluations", factor=1, form=".4g", from_result=lambda r: r.evaluations
    ),
    "build_s": NumberColumn("build s", "set-up [s]", from_result=lambda r: r.timing_s.build),
    "evaluations_s": NumberColumn(
        "evaluate s", "evaluations [s]", from_result=lambda r: r.timing_s.evaluations
    ),
    "linear_algebra_s": NumberColumn(
        "solve s", "linear algebra [s]", from_result=lambda r: r.timing_s.linear_algebra
    ),
    "total_s": NumberColumn("total s", "in all [s]", from_result=lambda r: r.timing_s.total),
}
# 97.5 % quantile of the standard normal distribution.
NORMAL_975 = 1.959963984540054


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


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % interval of a success rate (E. B. Wilson, J. Am. Stat. Assoc. 22, 1927).

    Unlike the normal approximation it holds at rates of 0 and 1 and for few of the `trials`. It is
    (0, 1) without trials, begins at 0 without `successes`, and ends at 1 without failures.
    """
    if trials == 0:
        return 0.0, 1.0
    rate = successes / trials
    z2 = NORMAL_975**2
    centre = (rate + z2 / (2 * trials)) / (1 + z2 / trials)
    spread = sqrt(z2 * (rate * (1 - rate) / trials + z2 / (4 * trials**2))) / (1 + z2 / trials)
    low = 0.0 if successes == 0 else centre - spread
    return low, 1.0 if successes == trials else centre + spread


# Runs ---------------------------------------------------------------------------------------------


def run_row(run: PlannedRun, record: Record | None, yardstick: SuccessCriterion) -> Row:
    """Return one run as a flat row; values are None if they are not known or NaN.

    The columns are "key", "method", "start", one for each swept key, "status", "converged",
    "success", those of the parameters, the names in `COLUMNS` (quality and cost, such as "loss" and
    "rms_m"), "wall_s", "attempts" and "message". The columns of the parameters are ``guess_NAME``,
    ``value_NAME``, ``std_error_NAME``, ``low_NAME``, ``high_NAME`` (combined standard error and
    interval) and ``error_NAME`` (relative to the truth, only for parameters whose truth is known).

    Parameters
    ----------
    run : PlannedRun
        Run of a comparison of methods or a sweep.
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
    values = {
        name: None if result is None else column.from_result(result)
        for name, column in COLUMNS.items()
        if column.from_result is not None
    }
    row = {
        "key": run.key,
        "method": run.method,
        "start": run.start,
        **run.varied_values,
        "status": record["outcome"] if is_timeout or result is None else result.status,
        "converged": converged,
        "success": converged and is_accurate,
        **parameters,
        **values,
        "tip_max_m": (record.get("tip") or {}).get("max_m"),
        "wall_s": record.get("wall_s"),
        "attempts": record.get("attempts"),
        "message": record.get("message", ""),
    }
    return {key: None if each != each else each for key, each in row.items()}  # NaN is no number


def _parameter_columns(run: PlannedRun, result: Result | None, truth: Mapping[str, float]) -> Row:
    """Return the columns of the estimated parameters of a run: first ``guess_NAME`` of all, then
    for each ``value_NAME``, ``std_error_NAME``, ``low_NAME`` and ``high_NAME`` (combined standard
    error and interval), and ``error_NAME`` if its truth is known.
    """
    row: Row = {}
    estimates = {} if result is None else result.parameters
    for name, guess in run.guess.items():
        known = estimates[name].guess if name in estimates else None
        row[f"guess_{name}"] = known if guess is None else guess
    for name in run.guess:
        estimate = estimates.get(name)
        value = None if estimate is None else estimate.value
        row[f"value_{name}"] = value
        row[f"std_error_{name}"] = None if estimate is None else estimate.combined_std_error
        interval = None if estimate is None else estimate.combined95
        row[f"low_{name}"], row[f"high_{name}"] = interval or (None, None)
        if name in truth:
            # Methods are compared by the optimum that they find, not by its correction.
            optimum = value if estimate is None or estimate.optimum is None else estimate.optimum
            row[f"error_{name}"] = None if optimum is None else abs(optimum / truth[name] - 1)
    return row


def parameters_in(rows: Sequence[Row], kind: str = "guess_") -> list[str]:
    """Return the names of the parameters for which there is a column with the prefix `kind`,
    without the prefix.

    Parameters
    ----------
    rows : sequence of Row
        At least one row of `run_row` or `method_rows`, the first of which decides.
    kind : str
        Prefix of columns, such as "guess_", "value_" or "error_".
    """
    return [name.removeprefix(kind) for name in rows[0] if name.startswith(kind)]


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
    """Return the summary of the runs of one method.

    Runs with the status "missing" are not counted.
    """
    done = [row for row in rows if row["status"] != "missing"]
    successes = sum(row["success"] for row in done)
    low, high = wilson_interval(successes, len(done))
    errors = [f"error_{name}" for name in parameters_in(rows, "error_")]
    medians = [name for name, column in COLUMNS.items() if column.has_median]
    known = {n: [row[n] for row in done if row[n] is not None] for n in (*errors, *medians)}
    return {
        "method": method,
        "runs": len(done),
        "converged": sum(row["converged"] for row in done),
        "successes": successes,
        "success_rate": successes / len(done) if done else None,
        "success_low": low,
        "success_high": high,
        **{name: float(np.median(each)) if each else None for name, each in known.items()},
    }


def best_run(rows: Sequence[Row]) -> Row | None:
    """Return the run with the lowest loss among the successes, without any among the converged
    runs, and without these among all runs with a result.

    A run has a result if its "rms_m" is not None. A loss of None counts as infinite. None if no run
    has a result.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `run_row`; not modified.
    """
    completed = [row for row in rows if row["rms_m"] is not None]

    def loss(row: Row) -> float:
        """Return the loss of a run; infinite if unknown."""
        return inf if row["loss"] is None else row["loss"]

    candidates = (
        [row for row in completed if row["success"]]
        or [row for row in completed if row["converged"]]
        or completed
    )
    return min(candidates, key=loss, default=None)


def reference_parameters(rows: Sequence[Row], yardstick: SuccessCriterion) -> dict[str, float]:
    """Return the parameters by name relative to which guesses are measured: the truth, or the
    estimates of the best run, see `best_run`.

    Empty if there is no truth and the best run did not converge, or no run has a result.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `run_row`, at least one.
    yardstick : SuccessCriterion
        True values; if there are any, one for each estimated parameter (otherwise `KeyError`).
    """
    names = parameters_in(rows)
    if yardstick.truth:
        return {name: yardstick.truth[name] for name in names}
    best = best_run(rows)
    if best is None or not best["converged"]:
        return {}
    return {name: best[f"value_{name}"] for name in names}


def guess_distance(row: Row, centre: Mapping[str, float]) -> float:
    """Return the largest ratio, at least 1, between a guess and its reference in either direction;
    NaN without a reference.

    Parameters
    ----------
    row : Row
        Row of `run_row`; for each parameter in `centre` its guess must be positive, not None.
    centre : mapping of str to float
        Positive reference by name.
    """
    logs = [abs(np.log(row[f"guess_{name}"] / value)) for name, value in centre.items()]
    return float(np.exp(max(logs))) if logs else nan
