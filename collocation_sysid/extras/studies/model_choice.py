"""Choice of a model: prediction of held-out recordings, and Akaike's criterion.

The prediction decides. All models are compared at the same samples, with the same noise, so their
squared errors are compared block by block in time; the standard error follows from the scatter of
the difference between blocks, and of the logarithmic ratio between recordings (Diebold & Mariano
1995, with means of batches). Of the models that predict as well as the best, within one standard
error, the one with the fewest parameters is chosen.

Of a single recording the last third is held out: its samples are removed, and the simulation with
the estimates from the rest continues into it. Otherwise each recording is left out in turn and
simulated with the estimates from the others, with its own nuisance parameters fitted. Markers are
compared, or forces if there are no markers.

Akaike's criterion is −2 ln L + 2k. For n independent normal errors of unknown variance −2 ln L is n
ln(RSS/n), up to a constant that all models of the same data share. Residuals of an imperfect model
are not independent: ten samples with the same error count as one. n is therefore the equivalent
number of independent samples: samples over 1 + 2 Σ_k (1 − k/T) ρ_k along time, and observables by
(tr Σ)²/tr Σ² across, with the ρ and Σ of `statistics.residuals.autocorrelation`.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import exp, log, sqrt
from typing import Any

import numpy as np

from ...features.measurements import fit_rms, judged_residuals
from ...fem.laws.constants import symbol_of, unit_of
from ...methods.solution import Solution
from ...pipeline import run as solve_and_check
from ...problem import Problem, RolloutOptions
from ...recording.experiment import Experiment
from ...recording.measurement_selection import without_later_measurements
from ...recording.specimen import STRESS_UNIT
from ...runs.forward_simulation import ForwardSimulation, simulate_experiment
from ...runs.solving import solve
from ...statistics.linearised import (
    AT_BOUND,
    LinearisedFit,
    ResidualBlock,
    factorise_information,
    parameter_values,
)
from ...statistics.residuals.autocorrelation import ErrorProcess, error_processes
from ...statistics.residuals.noise_level import ROUNDING
from .planning import PlannedRun, fitted_recordings
from .rows import Row
from .run_execution import Record

# Predictions closer than this, as a logarithm, are considered equal.
EQUIVALENT_ERROR = 0.01
# ΔAIC beyond which a model has hardly any support (Burnham & Anderson 2002, section 2.6).
NO_SUPPORT = 10.0
# ΔAIC below which it has substantial support.
SUPPORT = 2.0
# Standard errors by which predictions differ for certain.
SURE = 2.0
# Standard errors by which predictions probably differ.
LIKELY = 1.0


def model_rows(planned: Sequence[PlannedRun], records: Mapping[str, Record]) -> list[Row]:
    """Return one row for each model, in the order of the first run of each.

    Parameters
    ----------
    planned : sequence of PlannedRun
        Runs of a comparison of models.
    records : mapping of str to Record
        Finished runs by label.

    Returns
    -------
    list of Row
        By key: "model", "status" ("missing" if the fit to all recordings is not done), "converged",
        "free" (number of parameters), "unit" of the errors, "rms" of the fit to all, "held_out_rms"
        over all predictions, "predictions" (RMS) and "blocks" (sums of squares) by held-out
        recording, "failures" (messages by recording), "evidence" (fields of `Evidence`),
        "parameters" and "budget" by name, "at_bound" (the bound, "lower" or "upper", by the name of
        each parameter that ended at it), "total_s", "independent", "delta_aic" (AIC less the
        smallest), "log_ratio" and "log_ratio_error" (logarithm of the prediction error relative to
        the best), "chosen" (true for at most one row). Values are None if they are not known;
        mappings are empty.
    """
    of_model: dict[str, dict[str, Any]] = {}
    for run in planned:
        fit = (records.get(run.label) or {}).get("model") or {}
        of_model.setdefault(run.model_name, {})[run.test_name or ""] = fit
    rows = [_model_row(label, fits) for label, fits in of_model.items()]
    _add_criterion(rows)
    _add_ratios(rows)
    chosen = chosen_row(rows)
    for row in rows:
        row["chosen"] = row is chosen
    return rows


def _model_row(label: str, fits: Mapping[str, Mapping[str, Any]]) -> Row:
    """Columns that compare models are missing, see `model_rows`."""
    complete_fit = fits.get("", {})
    predictions = {name: fit.get("prediction") or {} for name, fit in fits.items() if name}
    evidence = complete_fit.get("evidence")
    free = complete_fit.get("free")
    unit = next((each["unit"] for each in predictions.values() if each), "m")
    return {
        "model": label,
        "status": complete_fit.get("status", "missing"),
        "converged": bool(complete_fit.get("converged")),
        "free": None if free is None else len(free),
        "unit": unit,
        "rms": (complete_fit.get("rms") or {}).get(unit),
        "held_out_rms": _pooled_rms([*predictions.values()]),
        "predictions": {name: each.get("rms") for name, each in predictions.items()},
        "blocks": {name: each.get("blocks") for name, each in predictions.items()},
        "failures": {n: fits[n]["failure"] for n in predictions if fits[n].get("failure")},
        "evidence": evidence,
        "parameters": complete_fit.get("parameters") or {},
        "at_bound": complete_fit.get("at_bound") or {},
        "budget": complete_fit.get("budget") or {},
        "total_s": sum(each.get("time_s") or 0.0 for each in fits.values()),
    }


def _pooled_rms(predictions: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the RMS of all predictions in their common unit, or None."""
    if not predictions or any(each.get("rms") is None for each in predictions):
        return None
    if len({each["unit"] for each in predictions}) > 1:
        return None  # metres and newtons have no common measure
    samples = sum(each["samples"] for each in predictions)
    return sqrt(sum(each["samples"] * each["rms"] ** 2 for each in predictions) / samples)


def _add_criterion(rows: Sequence[Row]) -> None:
    """Add "delta_aic" and "independent" to each row, in place."""
    known = [row for row in rows if row["converged"] and row["evidence"]]
    evidences = [Evidence(**row["evidence"]) for row in known]
    best = min(evidences, key=lambda e: e.misfit, default=None)
    values = [e.criterion(best.independent) for e in evidences] if best else []
    for row in rows:
        row["independent"] = best.independent if best else None
        row["delta_aic"] = None
    for row, value in zip(known, values, strict=True):
        row["delta_aic"] = value - min(values)


def _add_ratios(rows: Sequence[Row]) -> None:
    """Add "log_ratio" to the best, and "log_ratio_error", to each row."""
    best = _best_prediction(rows)
    for row in rows:
        row["log_ratio"] = row["log_ratio_error"] = None
        if best is None or row["held_out_rms"] is None:
            continue
        names = [name for name, rms in best["predictions"].items() if rms]
        logs = [log(row["predictions"][name] / best["predictions"][name]) for name in names]
        row["log_ratio"] = log(row["held_out_rms"] / best["held_out_rms"])
        row["log_ratio_error"] = _log_ratio_error(row, best, logs=logs)


def _log_ratio_error(row: Row, best: Row, logs: Sequence[float]) -> float:
    """Take the larger scatter, of blocks in time or recordings; NaN for a single block."""
    if row is best:
        return 0.0
    pairs = [(row["blocks"][name], best["blocks"][name]) for name in best["blocks"]]
    squares, best_squares = (np.concatenate(each) for each in zip(*pairs, strict=True))
    change = squares - best_squares
    # d ln √(a/b) = (a − b) / (a + b) to first order
    of_sum = float(np.std(change, ddof=1)) * sqrt(len(change))
    between = float(np.std(logs, ddof=1)) / sqrt(len(logs)) if len(logs) > 1 else 0.0
    return max(between, of_sum / float(np.sum(squares + best_squares)))


def _best_prediction(rows: Sequence[Row]) -> Row | None:
    predicted = [r for r in rows if r["converged"] and r["held_out_rms"]]
    return min(predicted, key=lambda r: r["held_out_rms"], default=None)


def chosen_row(rows: Sequence[Row]) -> Row | None:
    """Return the model to use: the one with fewest parameters among the converged models that
    predict as well as the best within `LIKELY` standard errors, of several the one with the
    smallest error.

    If no converged model has predicted all held-out data it is the one with the least AIC; None if
    none has an AIC either.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `model_rows`, which must have "delta_aic" and "log_ratio"; not modified.
    """
    best = _best_prediction(rows)
    if best is None:
        fitted = [row for row in rows if row["delta_aic"] is not None]
        return min(fitted, key=lambda r: r["delta_aic"], default=None)
    as_good = [
        row
        for row in rows
        if row["converged"]
        and row["log_ratio"] is not None
        and row["log_ratio"] <= max(EQUIVALENT_ERROR, LIKELY * row["log_ratio_error"])
    ]
    return min(as_good, key=lambda row: (row["free"], row["held_out_rms"]))


def advice(rows: Sequence[Row]) -> str:
    """Return in words which model to use, why, and how certain that is, as one paragraph.

    If no row is chosen, or no other model converged, it says so. If nothing was predicted it
    compares the AIC alone. Models that cannot predict all held-out data are named.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `model_rows`, which contain "chosen"; not modified.
    """
    chosen = next((row for row in rows if row["chosen"]), None)
    if chosen is None:
        return "No model could be fitted."
    return " ".join([_reasons(rows, chosen), *bound_sentences(rows)])


def bound_sentences(rows: Sequence[Row]) -> list[str]:
    """Return a sentence for each converged model with constants at bounds, with the remedy; empty
    if there is none. `rows` are those of `model_rows`.

    The values are those of the fit to all recordings. A constant at a lower bound contributes next
    to nothing, so that the model is one with fewer terms, or with another sign of the constant.
    """
    sentences = []
    for row in rows:
        if not row["converged"] or not row["at_bound"]:
            continue
        values = " and ".join(
            f"{symbol_of(name)} = {row['parameters'][name]:.4g} {unit_of(name)}".rstrip()
            + f" (its {bound} bound)"
            for name, bound in row["at_bound"].items()
        )
        sentences.append(
            f"{row['model']} ended with {values}: the bound determines the value, not the data; use "
            "a law without this term, or widen the bound if it is not physical."
        )
    return sentences


def _reasons(rows: Sequence[Row], chosen: Row) -> str:
    """Return which model to use, why, and how certainly."""
    others = [row for row in rows if row is not chosen and row["converged"]]
    use = f"Use {chosen['model']}"
    if not others:
        return f"{use}: no other could be fitted."
    if chosen["held_out_rms"] is None:
        rival = min(others, key=lambda row: row["delta_aic"])
        return (
            f"{use}, by AIC alone, because nothing could be predicted: its AIC is "
            f"{rival['delta_aic']:.3g} lower than that of {rival['model']}."
        )
    predicted = [row for row in others if row["log_ratio"] is not None]
    failures = [_failed_prediction(row, chosen) for row in others if row["log_ratio"] is None]
    if not predicted:
        return " ".join([f"{use}: no other model predicts the held-out samples.", *failures])
    rival = min(predicted, key=lambda row: row["log_ratio"])
    sentences = [f"{use}: {_comparison(chosen, rival)}.", _certainty(chosen, rival), *failures]
    return " ".join(sentences)


def _failed_prediction(row: Row, chosen: Row) -> str:
    without = " and ".join(f"'{name}'" for name, rms in row["predictions"].items() if not rms)
    sentence = f"{row['model']} does not predict {without}"
    if (more := chosen["delta_aic"] - row["delta_aic"]) <= NO_SUPPORT:
        return f"{sentence}."
    return (
        f"{sentence}, but fits all recordings better (its AIC is {more:.3g} lower): only the "
        "held-out samples determine its parameters, and more such recordings would decide."
    )


def _comparison(chosen: Row, rival: Row) -> str:
    """Both rows must predict all held-out data."""
    prediction = f"its prediction error for held-out samples is {_prediction_text(chosen)}"
    ratio, error = _log_ratio_between(chosen, rival)
    more = chosen["free"] - rival["free"]
    count = f"{abs(more)} parameter{'s' * (abs(more) > 1)}"
    size = f" with {count} {'more' if more > 0 else 'fewer'}" if more else ""
    support = rival["delta_aic"] - chosen["delta_aic"]
    better, worse = (chosen, rival) if support > 0 else (rival, chosen)
    return (
        f"{prediction}{size}, that of {rival['model']} is {_prediction_text(rival)}, "
        f"{_ratio_text(ratio, error)}. The AIC of {better['model']} is "
        f"{abs(support):.3g} lower than that of {worse['model']}"
    )


def _ratio_text(ratio: float, error: float) -> str:
    """Give the interval of `SURE` errors unless the logarithm exceeds `LIKELY` errors."""
    if ratio > LIKELY * error:
        return f"{exp(ratio):.3g} times as large (±{100 * error:.2g} %)"
    low = exp(ratio - SURE * error)
    high = exp(ratio + SURE * error)
    return f"a ratio of {exp(ratio):.3g}, which may be one ({low:.2g} to {high:.2g})"


def _prediction_text(row: Row) -> str:
    factor, unit = display_unit(row["unit"])
    return f"{factor * row['held_out_rms']:.3g} {unit}"


def display_unit(unit: str) -> tuple[float, str]:
    """Return factor and unit for the display of numbers in `unit`: (1000, "mm") for "m", (0.001,
    "kPa") for pascals, and (1, `unit`) for others.
    """
    return {"m": (1e3, "mm"), STRESS_UNIT: (1e-3, "kPa")}.get(unit, (1.0, unit))


def _log_ratio_between(chosen: Row, rival: Row) -> tuple[float, float]:
    """Return the logarithm, positive if the chosen one is better, and its standard error."""
    ratio = rival["log_ratio"] - chosen["log_ratio"]
    return ratio, max(rival["log_ratio_error"], chosen["log_ratio_error"])


def _certainty(chosen: Row, rival: Row) -> str:
    """Predictions and AIC must both favour the chosen model (`SURE`, `NO_SUPPORT`)."""
    ratio, error = _log_ratio_between(chosen, rival)
    support = rival["delta_aic"] - chosen["delta_aic"]
    if ratio > SURE * error and support > NO_SUPPORT:
        return "The difference is significant."
    if ratio > LIKELY * error and support > SUPPORT:
        return "The difference is likely, but not certain."
    if support < -NO_SUPPORT:
        return (
            f"{rival['model']} fits better, but does not predict better: more recordings, or "
            "larger motions, would decide."
        )
    if ratio > LIKELY * error:
        certainty = "certainly" if ratio > SURE * error else "probably"
        return (
            f"{chosen['model']} {certainty} predicts these held-out samples better, but does not "
            "fit all recordings better: more recordings, or larger motions, would decide."
        )
    return (
        "These recordings hardly distinguish the models: of those that predict equally well, the "
        "one with the fewest parameters is chosen."
    )


def model_notes(rows: Sequence[Row]) -> list[str]:
    """Return notes that explain the table and list failures: what is held out, the equivalent
    number of independent measurements if known, models that did not converge, and failed
    predictions.

    Parameters
    ----------
    rows : sequence of Row
        Rows of `model_rows`, at least one, with "predictions", "independent" (may be None),
        "evidence", "status", "converged" and "failures".
    """
    names = rows[0]["predictions"]
    test_data = "each recording in turn" if len(names) > 1 else "the last third of the recording"
    counted = rows[0]["independent"]
    evidence = next((row["evidence"] for row in rows if row["evidence"]), None)
    equivalent = ""
    if counted is not None and evidence is not None:
        equivalent = (
            f" The {evidence['measurements']} measurements contain as much information "
            f"as {counted:.0f} "
        )
        equivalent += "independent ones."
    return [
        f"Held out: {test_data}; ±: standard error of the ratio to the best.{equivalent}",
        *(f"{row['model']}: {row['status']}" for row in rows if not row["converged"]),
        *(
            f"{row['model']} without '{name}': {why}"
            for row in rows
            for name, why in row["failures"].items()
        ),
    ]


@dataclass(frozen=True)
class Evidence:
    """Data of a fit for Akaike's criterion."""

    # Sum of the squared measurement residuals, in units of σ²; not less than rounding.
    misfit: float
    prior: float  # sum of the squared residuals of the priors
    fitted: float  # number of parameters that the data determine, nuisance parameters included
    measurements: int  # number of measurements
    independent: float  # equivalent number of independent measurements

    def criterion(self, independent: float) -> float:
        """Return Akaike's criterion N ln(misfit) + prior + 2 · fitted; smaller is better.

        Parameters
        ----------
        independent : float
            Equivalent number N of independent measurements, equal for all compared models; it
            replaces this fit's own.
        """
        return independent * float(np.log(self.misfit)) + self.prior + 2 * self.fitted


def evidence_from_fit(fit: LinearisedFit) -> Evidence:
    """Return the evidence of a model from its linearised fit at the solution.

    The equivalent number of independent measurements follows from the correlation of the residuals
    of each block; it is the number of measurements if the residuals are zero up to rounding.
    """
    factored = factorise_information(fit)
    rounding = ROUNDING**2 * fit.measurement_count
    independent = float(fit.measurement_count)
    if fit.chi_squared > rounding:
        processes = error_processes(fit, factored)
        pairs = zip(fit.blocks, processes, strict=True)
        independent = sum(_independent_measurements(b, p) for b, p in pairs if b.measurement_count)
    return Evidence(
        max(fit.chi_squared, rounding),
        float(np.sum(fit.prior_residual**2)),
        fitted=factored.determined_count,
        measurements=fit.measurement_count,
        independent=independent,
    )


def _independent_measurements(block: ResidualBlock, process: ErrorProcess) -> float:
    """Return the equivalent number of independent measurements."""
    lags = np.arange(1, len(process.autocorrelation))
    in_time = 1 + 2 * float((1 - lags / len(block.t_s)) @ process.autocorrelation[1:])
    is_observed = block.channels[2].any(axis=0)
    among = process.channel_covariance[np.ix_(is_observed, is_observed)]
    total = float(np.trace(among)) ** 2
    # Few samples make channels look alike that are not: that much is taken off tr Σ².
    sum_of_squares = float(np.sum(among**2)) - total / max(process.samples, 1.0)
    channels = float(np.clip(total / max(sum_of_squares, 1e-300), 1.0, len(among)))
    return block.measurement_count * channels / len(among) / max(1.0, in_time)


# Share of a single recording that is fitted.
FITTED = 2 / 3
# Number of blocks in time of held-out data: each longer than most errors persist, and enough of
# them for a standard deviation.
BLOCKS = 8


def fit_record(problem: Problem, method: str, test_name: str) -> dict[str, Any]:
    """Fit a model to all recordings, or to all but the held-out data, and return its fit and
    prediction.

    Parameters
    ----------
    problem : Problem
        Problem with the model; not modified.
    test_name : str
        Fitted recording that is predicted, see `reserve_test_data`; "" to fit all.

    Returns
    -------
    dict
        "status", "converged", "rms" by unit (None where nothing is measured), "parameters",
        "at_bound" ("lower" or "upper" by the name of each parameter that ended at this bound),
        "free" (names) and "time_s". If the fit converged also "evidence" and "budget" if all are
        fitted, else "prediction" (see `_prediction_error`), which is None with a "failure" if the
        simulation failed. A fit that cannot be linearised counts as not converged.

    Raises
    ------
    InputError
        If the problem cannot be solved with the method.
    KeyboardInterrupt
        If the fit of the nuisance parameters of the held-out recording is interrupted; an
        interrupted solve is a record that has not converged.
    StopIteration
        If the problem has no recording called `test_name`.
    """
    if not test_name:
        return _complete_record(problem, method)
    known, start_s = reserve_test_data(problem, test_name)
    solution = solve(known, method)
    record = _solution_record(solution)
    if not solution.status.converged:
        return record
    experiment = next(e for e in known.experiments if e.name == test_name)
    # With the scheme that was fitted: what is compared are models, not integrators.
    rollout = simulate_experiment(
        replace(known, rollout=RolloutOptions("scheme")), solution, experiment=experiment
    )
    if not isinstance(rollout, ForwardSimulation):
        return record | {"prediction": None, "failure": rollout}
    complete_experiment = next(e for e in problem.experiments if e.name == test_name)
    return record | {"prediction": _prediction_error(complete_experiment, rollout, start_s=start_s)}


def _complete_record(problem: Problem, method: str) -> dict[str, Any]:
    began_s = time.perf_counter()
    finished = solve_and_check(problem, method, seek_causes=False)
    solution = finished.solution
    record: dict[str, Any] = _solution_record(solution)
    record["time_s"] = time.perf_counter() - began_s
    if not solution.status.converged:
        return record
    if finished.fit is None:
        return record | {
            "converged": False,
            "status": "; ".join(finished.notes) or finished.omitted_checks,
        }
    reported = {name: each.value for name, each in finished.estimates.items()}
    return record | {
        "parameters": {n: reported.get(n, value) for n, value in record["parameters"].items()},
        "evidence": asdict(evidence_from_fit(finished.fit)),
        "budget": {name: asdict(line) for name, line in finished.budget.items()},
    }


def _solution_record(solution: Solution) -> dict[str, Any]:
    return {
        "status": solution.status.value,
        "converged": solution.status.converged,
        "rms": fit_rms(solution),
        "parameters": parameter_values(solution.collocation, solution.q),
        "at_bound": _names_at_bounds(solution),
        "free": [item.name for item in solution.collocation.parameters.free],
        "time_s": solution.timing.total,
    }


def _names_at_bounds(solution: Solution) -> dict[str, str]:
    """Return "lower" or "upper" by name, within `AT_BOUND` in the coordinates of the solver."""
    parameters = solution.collocation.parameters
    at_bound: dict[str, str] = {}
    for item, coordinate, lower, upper in zip(
        parameters.free, np.asarray(solution.q, dtype=float), *parameters.bounds_q, strict=True
    ):
        if coordinate - lower < AT_BOUND:
            at_bound[item.name] = "lower"
        elif upper - coordinate < AT_BOUND:
            at_bound[item.name] = "upper"
    return at_bound


def reserve_test_data(problem: Problem, name: str) -> tuple[Problem, float]:
    """Return the problem without a recording, or without its end, and the time [s] after which its
    samples are held out.

    If it is the only fitted recording, the measurements after two thirds of its duration are
    removed, see `without_later_measurements`. Otherwise the recording becomes one for validation,
    and the time is −∞. `problem` is not modified.

    Raises
    ------
    StopIteration
        If the problem has no recording with this name.
    """
    chosen = next(e for e in problem.experiments if e.name == name)
    if len(fitted_recordings(problem)) > 1:
        remaining = replace(chosen, validation=True)
        start_s = -np.inf
    else:
        start_s = float(chosen.t_s[0] + FITTED * chosen.duration_s)
        remaining = without_later_measurements(chosen, start_s)
    experiments = [remaining if e is chosen else e for e in problem.experiments]
    return replace(problem, experiments=experiments), start_s


def _prediction_error(
    experiment: Experiment, rollout: ForwardSimulation, start_s: float
) -> dict[str, Any]:
    """Return RMS, number of samples and sums of squares by block; missing ones do not count."""
    residuals = judged_residuals(experiment, rollout.trajectory.predicted)
    is_test_sample = residuals.t_s > start_s
    squares = np.where(residuals.is_counted, np.nansum(residuals.values**2, axis=2), 0.0)[
        is_test_sample
    ]
    samples = int(residuals.is_counted[is_test_sample].sum())
    blocks = [float(np.sum(each)) for each in np.array_split(squares, BLOCKS)]
    rms = float(np.sqrt(squares.sum() / samples)) if samples else None
    return {"rms": rms, "unit": residuals.unit, "samples": samples, "blocks": blocks}
