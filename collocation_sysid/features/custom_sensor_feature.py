"""Custom sensors in checks and runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from ..common.array_types import Array, root_mean
from ..common.display import number, short
from ..methods.solution import Solution, custom_sensor_rms
from ..program.collocation import ExperimentIterate
from ..program.custom_sensor_residual import custom_sensor_residuals
from ..program.observables import ObservedMotion, ReactionForces
from ..program.reactions.reaction_resultant import ReactionGrid
from ..program.simulation import Trajectory
from ..program.transcription import Transcription
from ..recording.experiment import Experiment
from ..recording.specimen import STRESS_UNIT
from ..statistics.instrument_misfit import InstrumentMisfit, misfit
from .feature import Feature, Units
from .measurement_results import (
    FittedExperiment,
    InstrumentPrediction,
    PictureKind,
    PredictionErrors,
    PredictionResiduals,
    Samples,
    SensorSeries,
    comparison_columns,
    during,
)


def instruments(experiment: Experiment) -> list[str]:
    """Return the names of the sensors."""
    return [gauge.name for gauge in experiment.readings]


def samples(experiment: Experiment) -> Iterator[Samples]:
    """Yield the values of each sensor during the recording."""
    for gauge in experiment.readings:
        values = gauge.measured_values
        is_within = during(experiment, gauge.sample_times_s)
        names = [f"{gauge.name} {j + 1}" for j in range(values.shape[1])]
        yield Samples(f"'{gauge.name}'", names, np.isfinite(values) & is_within[:, None])


def predict(transcription: Transcription, trajectory: Trajectory, phi: Array) -> dict[str, Any]:
    """Return the predicted values (S, m) by name."""
    positions_m = trajectory.positions_m
    predicted = _predict_sensors(
        transcription,
        positions_m.reshape(len(positions_m), -1),
        reactions=trajectory.reactions,
        phi=phi,
    )
    return {
        "readings": {
            gauge.sensor.name: gauge.without_padding(values)
            for gauge, values in zip(transcription.custom_sensors, predicted, strict=True)
        }
    }


def fitted(part: ExperimentIterate, solution: Solution) -> dict[str, Any]:
    """Return the fitted values (S, m) by name."""
    return {"readings": solution.readings[part.transcription.experiment.name]}


def copied(_: Experiment, other: Experiment) -> dict[str, Any]:
    """Return the measured values of another recording by name."""
    return {"readings": {gauge.name: gauge.measured_values for gauge in other.readings}}


def copied_times_s(experiment: Experiment, other: Experiment) -> Iterable[tuple[Array, Array]]:
    """Return the sample times of each sensor in both recordings."""
    pairs = zip(experiment.readings, other.readings, strict=True)
    return [(own.sample_times_s, theirs.sample_times_s) for own, theirs in pairs]


def reason_against_copy(experiment: Experiment, other: Experiment) -> str:
    """Return that the recordings have different sensors; "" if the same."""
    own = [gauge.name for gauge in experiment.readings]
    theirs = [gauge.name for gauge in other.readings]
    return "other sensor readings" if own != theirs else ""


def errors(experiment: Experiment, predicted: InstrumentPrediction) -> dict[str, Any]:
    """Return the RMS differences by name, in the units of the sensors; None without sensors."""
    rms = custom_sensor_rms(experiment, predicted.readings)
    return {"reading_rms": rms or None}


def misfits(experiment: Experiment, predicted: InstrumentPrediction) -> Iterator[InstrumentMisfit]:
    """Yield the differences of each sensor over its σ."""
    for gauge in experiment.readings:
        difference = predicted.readings[gauge.name] - gauge.measured_values
        known = difference[np.isfinite(difference)]
        size = f"{root_mean(known**2):.3g} {gauge.unit}".rstrip() + " RMS" if known.size else ""
        yield misfit(gauge.name, "its sigma", ratio=difference / gauge.sigma, size=size)


def step_differences(
    part: ExperimentIterate, trajectory: Trajectory, _: InstrumentPrediction, share: float
) -> Iterator[Array]:
    """Yield the changes (S, G, 3) of the residuals of each sensor; zero where not predicted."""
    if not (transcription := part.transcription).custom_sensors:
        return
    fitted_x = part.x[transcription.markers.observable.rows]
    fitted = _predict_sensors(
        transcription,
        fitted_x,
        reactions=(ReactionGrid.from_dynamics(transcription.dynamics), part.reactions),
        phi=part.phi,
    )
    simulated = _predict_sensors(
        transcription,
        trajectory.positions_m.reshape(len(fitted_x), -1),
        reactions=trajectory.reactions,
        phi=part.phi,
    )
    rows = zip(transcription.custom_sensors, fitted, simulated, strict=True)
    for gauge, of_fit, of_simulation in rows:
        change = share * np.nan_to_num(of_simulation - of_fit)
        yield change / gauge.sigmas[:, None]


def _predict_sensors(
    transcription: Transcription,
    x: Array,
    reactions: tuple[ReactionGrid, ReactionForces],
    phi: Array,
) -> list[Array]:
    """Return the predictions of custom sensors, for each (S, G, 3) at S samples of G points, or
    forces and torques.
    """
    grid, reaction_forces = reactions
    motion = ObservedMotion(x, reaction_forces)
    gauges = custom_sensor_residuals(
        transcription.experiment,
        transcription.experiment.t_s,
        grid=grid,
        nuisance=transcription.nuisance,
    )
    return [gauge.predict_motion(motion, phi) for gauge in gauges]


def recorded(
    experiment: Experiment, solution: Solution, predicted: InstrumentPrediction | None, _: Array
) -> dict[str, Any]:
    """Return an array (S, 1 + 3m) for each sensor, by name.

    The columns are the time [s], and its m numbers as measured, fitted and simulated; NaN where the
    experiment was not fitted or not simulated.
    """
    fitted = solution.readings.get(experiment.name, {})
    simulated = {} if predicted is None else predicted.readings
    return {
        "readings": {
            gauge.name: comparison_columns(
                gauge.sample_times_s,
                gauge.measured_values,
                *(each.get(gauge.name) for each in (fitted, simulated)),
            )
            for gauge in experiment.readings
        }
    }


def simulated_series(
    experiment: Experiment, predicted: InstrumentPrediction
) -> Iterator[SensorSeries]:
    """Yield the measured and simulated numbers of each sensor, without units."""
    for k, gauge in enumerate(experiment.readings, 1):
        columns = comparison_columns(
            gauge.sample_times_s, gauge.measured_values, None, predicted.readings[gauge.name]
        )
        count = gauge.measured_values.shape[1]
        names = [f"{gauge.name} {j + 1}" for j in range(count)]
        yield SensorSeries("reading", k, columns, names)


def prediction_residuals(
    experiment: Experiment, _: Trajectory, predicted: InstrumentPrediction
) -> PredictionResiduals | None:
    """Return the differences of all stresses [Pa] of a specimen without a mesh; None for other
    experiments.
    """
    if experiment.specimen is None:
        return None
    return _stress_residuals(experiment, predicted.readings)


def fit_rms(solution: Solution) -> dict[str, float | None]:
    """Return the RMS residual of the stresses of all fitted specimens [Pa]; None without any."""
    residuals_pa = [
        _stress_residuals(
            transcription.experiment, solution.readings[transcription.experiment.name]
        ).values
        for transcription in solution.collocation.transcriptions
        if transcription.experiment.specimen is not None
    ]
    if not residuals_pa:
        return {STRESS_UNIT: None}
    squares = np.concatenate(residuals_pa) ** 2
    return {STRESS_UNIT: float(np.sqrt(np.nanmean(squares)))}


def _stress_residuals(
    experiment: Experiment, predicted: Mapping[str, Array]
) -> PredictionResiduals:
    """Return the differences of the stresses of a specimen, the custom sensors with the unit Pa."""
    stresses = [gauge for gauge in experiment.readings if gauge.unit == STRESS_UNIT]
    return PredictionResiduals.in_order_of_time(
        np.concatenate([gauge.sample_times_s for gauge in stresses]),
        np.concatenate([predicted[gauge.name] - gauge.measured_values for gauge in stresses]),
        unit=STRESS_UNIT,
    )


def units_by_name(experiment: Experiment) -> dict[str, str] | None:
    """Return the units of the custom sensors that state one, by name; None if none does."""
    return {gauge.name: gauge.unit for gauge in experiment.readings if gauge.unit} or None


def fit_fields(part: ExperimentIterate, solution: Solution) -> dict[str, Any]:
    """Return RMS residuals, stated σ and units by name; None without sensors."""
    experiment = part.transcription.experiment
    rms = custom_sensor_rms(experiment, solution.readings[experiment.name])
    sigma = {gauge.name: gauge.sigma for gauge in experiment.readings}
    return {
        "reading_rms": rms or None,
        "reading_sigma": sigma or None,
        "reading_unit": units_by_name(experiment),
    }


def fit_lines(name: str, fitted: FittedExperiment, _: bool) -> Iterator[str]:
    """Yield the RMS residual of each sensor with its σ."""
    for reading, rms in (fitted.reading_rms or {}).items():
        unit = _unit_text(fitted.reading_unit, reading)
        sigma = short((fitted.reading_sigma or {})[reading])
        yield (f"{reading} of '{name}': {short(rms)}{unit} RMS (sigma {sigma}{unit})")


def error_texts(error: PredictionErrors, units: Units) -> Iterator[str]:
    """Yield the RMS difference of each sensor."""
    for reading, rms in (error.reading_rms or {}).items():
        yield f"{reading} {rms:.2g}{_unit_text(units, reading)} RMS"


def brief_texts(error: PredictionErrors) -> Iterator[str]:
    """Yield the RMS difference of each sensor, without its unit."""
    for name, rms in (error.reading_rms or {}).items():
        yield f"{name}: {number(rms, 3)} RMS"


def _unit_text(units: Units, reading: str) -> str:
    """Return the unit of the custom sensor `reading` after a space; "" if it states none or `units`
    is None.
    """
    unit = (units or {}).get(reading, "")
    return f" {unit}" if unit else ""


CUSTOM_SENSORS = Feature(
    "custom sensors",
    picture_kinds=[
        PictureKind(
            "reading",
            "Custom sensor: measured, fitted and simulated.",
            before="error",
            is_leading=True,
        )
    ],
    instruments=instruments,
    samples=samples,
    predict=predict,
    fitted=fitted,
    copied=copied,
    copied_times_s=copied_times_s,
    reason_against_copy=reason_against_copy,
    errors=errors,
    misfits=misfits,
    step_differences=step_differences,
    recorded=recorded,
    simulated_series=simulated_series,
    prediction_residuals=prediction_residuals,
    fit_rms=fit_rms,
    fit_fields=fit_fields,
    fit_lines=fit_lines,
    error_texts=error_texts,
    brief_texts=brief_texts,
)
