"""Description of one feature by what it contributes to runs: predictions, checks, concerns, results
and their texts.

Runs, checks and reports iterate over `features.registry.FEATURES` and call the functions of each
`Feature`; they name no feature. A function that a feature does not set contributes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

from ..common.array_types import Array
from ..common.declarations import identity
from ..methods.solution import Solution
from ..problem import Problem
from ..program.collocation import Collocation, ExperimentIterate
from ..program.simulation import Trajectory
from ..program.transcription import Transcription
from ..recording.experiment import Experiment
from ..statistics.concerns import Concern, Topic
from ..statistics.instrument_misfit import InstrumentMisfit
from ..statistics.misspecification.misspecification_hypothesis import Hypothesis
from .measurement_results import (
    FittedExperiment,
    InstrumentPrediction,
    PictureKind,
    PredictionErrors,
    PredictionResiduals,
    Samples,
    SensorSeries,
    SeriesKind,
)

Fields = Mapping[str, Any]
Units = Mapping[str, str] | None


def _nothing(*_: Any) -> tuple[()]:
    """Return no contribution."""
    return ()


def _no_fields(*_: Any) -> Fields:
    """Return no fields."""
    return {}


def _no_reason(*_: Any) -> str:
    """Return no reason."""
    return ""


def _no_loss(_: ExperimentIterate) -> float:
    """Return zero."""
    return 0.0


def _no_residuals(*_: Any) -> None:
    """Return no differences."""


@dataclass(frozen=True, eq=False)
class SimulatedCheck:
    """Simulation at the guess, with which a check compares the description of a problem.

    Attributes
    ----------
    problem : Problem
        Checked problem.
    collocation : Collocation
        Its nonlinear program.
    parts : sequence of ExperimentIterate
        Experiments simulated at the guess, perhaps only their first samples.
    causes : sequence of Hypothesis
        Likely errors that are known already.
    is_full : bool
        Whether comparisons are made however long they take.
    fit_s : callable
        ``fit_s(samples)``, the estimated time [s] to fit the first samples to the markers.
    report_progress : callable
        Called with progress messages.
    is_simulated : bool
        Whether `parts` are simulated; false if a simulation failed, and a body is only moved
        rigidly with its grasp.
    """

    problem: Problem
    collocation: Collocation
    parts: Sequence[ExperimentIterate]
    causes: Sequence[Hypothesis]
    is_full: bool
    fit_s: Callable[[int], float]
    report_progress: Callable[[str], None]
    is_simulated: bool = True


@dataclass(frozen=True, eq=False)
class Feature:
    """Contributions of one feature, a kind of measurement or force, to checks and runs.

    Attributes
    ----------
    name : str
        Name of the feature.
    topics : mapping of str to Topic
        Topics of concerns that only this feature has, with their messages, by key.
    messages : mapping of str to str
        Messages of its concerns of general topics, by code.
    picture_kinds : sequence of PictureKind
        Captions of its pictures; a kind stands before a general one or one of an earlier feature.
    series_kind : SeriesKind, optional
        Numbers of its sensors over time, if all of them measure the same; `recorded` then has them
        as "sensor_columns" by the name of the kind.
    instruments : callable
        ``instruments(experiment)``: texts of what the feature measures in a recording.
    samples : callable
        ``samples(experiment)``: the measurements as `Samples`, of which `lost_samples` reports what
        is missing.
    require_valid : callable
        ``require_valid(experiment)`` raises an `InputError` for data that cannot be fitted.
    predict : callable
        ``predict(transcription, trajectory, phi)``: fields of `InstrumentPrediction` for a
        simulated motion and nuisance parameters φ (k,).
    fitted : callable
        ``fitted(part, solution)``: the same fields for the fit.
    copied : callable
        ``copied(experiment, other)``: the same fields from the measurements of another recording.
    copied_times_s : callable
        ``copied_times_s(experiment, other)``: pairs of sample times of both recordings, which must
        agree for a copy.
    reason_against_copy : callable
        ``reason_against_copy(experiment, other)``: why measurements of another recording cannot be
        compared; "" if they can.
    for_simulation : callable
        ``for_simulation(experiment)``: the experiment as forward simulations need it.
    largest_difference_step : callable
        ``largest_difference_step(experiment)``: largest scaled step of differences at the guess
        with which a check tests derivatives.
    recorded : callable
        ``recorded(experiment, solution, predicted, positions_m)``: fields of `MotionRecord` for
        pictures and films, of a recording that was fitted, simulated (`predicted` is not None), or
        both; `positions_m` are the shown positions (T, n, 3).
    simulated_series : callable
        ``simulated_series(experiment, predicted)``: measured and simulated numbers of each sensor
        over time, for a picture.
    errors : callable
        ``errors(experiment, predicted)``: fields of `PredictionErrors`.
    misfits : callable
        ``misfits(experiment, predicted)``: differences over the stated σ, for each instrument.
    step_differences : callable
        ``step_differences(part, trajectory, predicted, share)``: changes of the residuals, in the
        order of the feature's residuals, for `share` times the difference between a forward
        simulation and the fit.
    hypotheses : callable
        ``hypotheses(experiment)``: likely errors in the description, without a simulation.
    simulated_hypotheses : callable
        ``simulated_hypotheses(check)``: the same by comparison with a simulation, and notes.
    fit_hypotheses : callable
        ``fit_hypotheses(solution)``: the same by the residuals of a fit.
    guess_concerns : callable
        ``guess_concerns(parts, is_complete)``: concerns about the simulation at the guess, of which
        `is_complete` is false if it ends before the recordings.
    part_concerns, concerns : callable
        ``part_concerns(part)`` and ``concerns(parts)``: concerns about the fit of one experiment
        and of all.
    simulation_concerns : callable
        ``simulation_concerns(name, error)``: concerns about any forward simulation.
    live_limitations : callable
        ``live_limitations(experiment)``: parts of an experiment that live estimation does not
        support, each as its description, a value that is true if the experiment has it, and the
        supported alternative.
    write_predicted : callable
        ``write_predicted(experiment, trajectory, folder)`` writes predicted measurements of an
        experiment as files of a problem.
    read_predicted : callable
        ``read_predicted(table)`` modifies the table of an experiment in a problem file, in place,
        so that it reads these files beside the problem file; the table is unchanged without such
        measurements.
    prediction_residuals : callable
        ``prediction_residuals(experiment, trajectory, predicted)``: differences by which a
        prediction is judged in a comparison of models; None without such measurements. Of several
        features the first counts.
    fit_rms : callable
        ``fit_rms(solution)``: RMS residual of all fitted experiments by its unit, that of
        `prediction_residuals`; None where nothing is measured.
    notes : callable
        ``notes(part)``: notes on the fit of one experiment.
    excluded_loss : callable
        ``excluded_loss(part)``: loss of measurements that the fit excludes.
    fit_fields, pooled_fields : callable
        ``fit_fields(part, solution)``: fields of `FittedExperiment`; ``pooled_fields(solution)``:
        fields of `FitResult`.
    fit_lines : callable
        ``fit_lines(name, fitted, is_symmetric)``: lines of a summary on the fit of an experiment,
        of which a symmetric part may be modelled.
    error_texts : callable
        ``error_texts(error, units)``: errors of a prediction in words, with the units of custom
        sensors by name.
    brief_texts : callable
        ``brief_texts(error)``: the same in a few words, for a display that changes.
    """

    name: str
    topics: Mapping[str, Topic] = field(default_factory=dict)
    messages: Mapping[str, str] = field(default_factory=dict)
    picture_kinds: Sequence[PictureKind] = ()
    series_kind: SeriesKind | None = None
    instruments: Callable[[Experiment], Iterable[str]] = _nothing
    samples: Callable[[Experiment], Iterable[Samples]] = _nothing
    require_valid: Callable[[Experiment], object] = _nothing
    predict: Callable[[Transcription, Trajectory, Array], Fields] = _no_fields
    fitted: Callable[[ExperimentIterate, Solution], Fields] = _no_fields
    copied: Callable[[Experiment, Experiment], Fields] = _no_fields
    copied_times_s: Callable[[Experiment, Experiment], Iterable[tuple[Array, Array]]] = _nothing
    reason_against_copy: Callable[[Experiment, Experiment], str] = _no_reason
    for_simulation: Callable[[Experiment], Experiment] = identity
    largest_difference_step: Callable[[Experiment], float] = lambda _: inf
    recorded: Callable[[Experiment, Solution, InstrumentPrediction | None, Array], Fields] = (
        _no_fields
    )
    simulated_series: Callable[[Experiment, InstrumentPrediction], Iterable[SensorSeries]] = (
        _nothing
    )
    errors: Callable[[Experiment, InstrumentPrediction], Fields] = _no_fields
    misfits: Callable[[Experiment, InstrumentPrediction], Iterable[InstrumentMisfit]] = _nothing
    step_differences: Callable[
        [ExperimentIterate, Trajectory, InstrumentPrediction, float], Iterable[Array]
    ] = _nothing
    hypotheses: Callable[[Experiment], Iterable[Hypothesis]] = _nothing
    simulated_hypotheses: Callable[[SimulatedCheck], tuple[Sequence[Hypothesis], Sequence[str]]] = (
        lambda _: ((), ())
    )
    fit_hypotheses: Callable[[Solution], Iterable[Hypothesis]] = _nothing
    guess_concerns: Callable[[Sequence[ExperimentIterate], bool], Iterable[Concern]] = _nothing
    part_concerns: Callable[[ExperimentIterate], Iterable[Concern]] = _nothing
    concerns: Callable[[Sequence[ExperimentIterate]], Iterable[Concern]] = _nothing
    simulation_concerns: Callable[[str, PredictionErrors], Iterable[Concern]] = _nothing
    live_limitations: Callable[[Experiment], Iterable[tuple[str, object, str]]] = _nothing
    write_predicted: Callable[[Experiment, Trajectory, Path], object] = _nothing
    read_predicted: Callable[[dict[str, Any]], object] = _nothing
    prediction_residuals: Callable[
        [Experiment, Trajectory, InstrumentPrediction], PredictionResiduals | None
    ] = _no_residuals
    fit_rms: Callable[[Solution], Mapping[str, float | None]] = _no_fields
    notes: Callable[[ExperimentIterate], Iterable[str]] = _nothing
    excluded_loss: Callable[[ExperimentIterate], float] = _no_loss
    fit_fields: Callable[[ExperimentIterate, Solution], Fields] = _no_fields
    pooled_fields: Callable[[Solution], Fields] = _no_fields
    fit_lines: Callable[[str, FittedExperiment, bool], Iterable[str]] = _nothing
    error_texts: Callable[[PredictionErrors, Units], Iterable[str]] = _nothing
    brief_texts: Callable[[PredictionErrors], Iterable[str]] = _nothing
