"""Measured wrenches of grasps and obstacles in checks and runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..common.array_types import Array, root_mean
from ..common.display import number, short
from ..methods.solution import Solution, pooled_wrench_rms, wrench_rms
from ..program.collocation import ExperimentIterate
from ..program.simulation import Trajectory
from ..program.transcription import Transcription
from ..program.wrench_residual import predict_wrenches
from ..recording import write_wrench_csv
from ..recording.experiment import Experiment
from ..recording.measured_wrench import COMPONENTS, UNITS
from ..statistics.instrument_misfit import InstrumentMisfit, misfit
from ..statistics.misspecification.misspecification_hypothesis import Hypothesis, rank
from ..statistics.misspecification.plausibility import load_sign_hypotheses
from .feature import Feature, SimulatedCheck, Units
from .measurement_results import (
    FittedExperiment,
    InstrumentPrediction,
    PictureKind,
    PredictionErrors,
    PredictionResiduals,
    Samples,
    SensorSeries,
    SeriesKind,
    comparison_columns,
    during,
)
from .wrench_at_guess import MESSAGE_OF_OFFSET, wrench_deviations
from .wrench_causes import CHECKED_SAMPLES, MESSAGES, wrench_causes, wrench_mistakes

# Longest fit of the first samples to the markers that needs no request [s].
LONGEST_FIT_S = 10.0
# File of a predicted wrench.
PREDICTED_FILE = "predicted_wrench.csv"
# Keys of a wrench that describe its file.
KEYS_OF_FILE = ("columns", "axis", "sign", "area_m2", "symmetry")
SERIES_KIND = SeriesKind("wrench", COMPONENTS, units=UNITS)


def instruments(experiment: Experiment) -> list[str]:
    """Return one text if any wrench is measured."""
    return ["the wrench"] * bool(experiment.wrenches)


def samples(experiment: Experiment) -> Iterator[Samples]:
    """Yield the measured components of each sensor during the recording."""
    for k, sensor in enumerate(experiment.wrenches, 1):
        what = "the wrench" if len(experiment.wrenches) == 1 else f"wrench {k}"
        measured = np.flatnonzero(sensor.is_measured.any(axis=0))
        is_present = sensor.is_measured & during(experiment, sensor.t_s)[:, None]
        yield Samples(what, [COMPONENTS[j] for j in measured], is_present[:, measured])


def predict(transcription: Transcription, trajectory: Trajectory, phi: Array) -> dict[str, Any]:
    """Return the predicted force and torque (S, 6) of each sensor."""
    grid, reactions = trajectory.reactions
    return {
        "wrenches": [
            sensor.on_grid(grid).predict_reactions(reactions, phi)
            for sensor in transcription.sensors
        ]
    }


def fitted(part: ExperimentIterate, solution: Solution) -> dict[str, Any]:
    """Return the fitted force and torque (S, 6) of each sensor."""
    return {"wrenches": solution.wrenches.get(part.transcription.experiment.name, ())}


def copied(_: Experiment, other: Experiment) -> dict[str, Any]:
    """Return the measured wrenches of another recording."""
    return {"wrenches": [each.values for each in other.wrenches]}


def copied_times_s(experiment: Experiment, other: Experiment) -> Iterable[tuple[Array, Array]]:
    """Return the sample times of each sensor in both recordings."""
    pairs = zip(experiment.wrenches, other.wrenches, strict=True)
    return [(own.t_s, theirs.t_s) for own, theirs in pairs]


def reason_against_copy(experiment: Experiment, other: Experiment) -> str:
    """Return that the recordings have different numbers of sensors; "" if the same."""
    differ = len(experiment.wrenches) != len(other.wrenches)
    return "other wrenches" if differ else ""


def errors(experiment: Experiment, predicted: InstrumentPrediction) -> dict[str, Any]:
    """Return the RMS differences of force [N] and torque [N m]; None where not measured."""
    force_n, torque_nm = wrench_rms(experiment, predicted.wrenches)
    return {"wrench_rms_n": force_n, "wrench_rms_nm": torque_nm}


def misfits(experiment: Experiment, predicted: InstrumentPrediction) -> Iterator[InstrumentMisfit]:
    """Yield the differences of each sensor over its σ."""
    pairs = zip(predicted.wrenches, experiment.wrenches, strict=True)
    for k, (values, sensor) in enumerate(pairs, 1):
        what = "the wrench" if len(experiment.wrenches) == 1 else f"wrench {k}"
        difference = values - sensor.values
        force_n = sensor.symmetry * difference[:, :3]
        size = (
            f"{root_mean(force_n[np.isfinite(force_n)] ** 2):.3g} N RMS"
            if np.isfinite(force_n).any()
            else ""
        )
        yield misfit(what, "sigma_n", ratio=difference / sensor.stack_sigmas(), size=size)


def step_differences(
    part: ExperimentIterate, _: Trajectory, predicted: InstrumentPrediction, share: float
) -> Iterator[Array]:
    """Yield the changes (S, 2, 3) of the residuals of each sensor, force and torque; zero where not
    predicted.
    """
    sensors = part.transcription.sensors
    fitted = predict_wrenches(sensors, part.reactions, part.phi) if sensors else []
    rows = zip(sensors, fitted, predicted.wrenches, strict=True)
    for sensor, of_fit, of_simulation in rows:
        way = share * np.nan_to_num((of_simulation - of_fit) / sensor.wrench.stack_sigmas())
        yield way.reshape(-1, 2, 3)


def simulated_hypotheses(check: SimulatedCheck) -> tuple[Sequence[Hypothesis], Sequence[str]]:
    """Return likely errors of wrenches, and notes with the deviation of each from the simulation.

    The first samples are fitted to the markers, unless another error is likely or the fit takes
    long, which a note says. Wrenches that no such fit predicts are compared with the simulation at
    the guess instead. Nothing is compared if the simulation failed.
    """
    deviations = wrench_deviations(check.parts) if check.is_simulated else []
    notes = [deviation.note() for deviation in deviations]
    if check.causes:
        return (), notes
    unpredicted = {each.experiment for each in deviations}
    hypotheses: list[Hypothesis] = []
    has_both = any(
        each.wrenches and each.markers.count_samples() for each in check.problem.experiments
    )
    fit_s = check.fit_s(CHECKED_SAMPLES) if has_both else 0.0
    if has_both and not check.is_full and fit_s > LONGEST_FIT_S:
        notes.append(
            "the wrenches were not compared with the prediction from the markers, which would "
            f"take about {fit_s:.2g} s; check --full does it"
        )
    elif has_both:
        check.report_progress("comparing the wrenches with the prediction from the markers")
        comparison = wrench_mistakes(check.collocation)
        hypotheses = list(comparison.hypotheses)
        unpredicted -= set(comparison.predicted)
        notes += [
            f"no fit explains the markers of '{name}', so that its wrench was compared with the "
            "simulation at the guess alone"
            for name in sorted(unpredicted)
        ]
    for deviation in deviations:
        if deviation.experiment in unpredicted:
            hypotheses += deviation.hypotheses()
    return rank(hypotheses), notes


def fit_hypotheses(solution: Solution) -> list[Hypothesis]:
    """Return likely errors of wrenches, by the residuals of a fit and by the signs of loads."""
    return [
        *wrench_causes(solution),
        *(
            hypothesis
            for transcription in solution.collocation.transcriptions
            for hypothesis in load_sign_hypotheses(transcription.experiment)
        ),
    ]


def recorded(
    experiment: Experiment, solution: Solution, predicted: InstrumentPrediction | None, _: Array
) -> dict[str, Any]:
    """Return an array (S, 19) for each sensor: time [s], and the wrench measured, fitted and
    simulated.

    The wrenches are those of the whole specimen also where symmetry reduces the model to a part of
    it. NaN where the experiment was not fitted or not simulated.
    """
    sensors = experiment.wrenches
    unknown = [None] * len(sensors)
    fitted = solution.wrenches.get(experiment.name, unknown)
    simulated = unknown if predicted is None else predicted.wrenches
    series = []
    for sensor, *models in zip(sensors, fitted, simulated, strict=True):
        columns = comparison_columns(sensor.t_s, sensor.values, *models)
        columns[:, 1:] *= sensor.symmetry
        series.append(columns)
    return {"sensor_columns": {SERIES_KIND.name: series}}


def simulated_series(
    experiment: Experiment, predicted: InstrumentPrediction
) -> Iterator[SensorSeries]:
    """Yield the measured and simulated wrench of each sensor, of the whole specimen."""
    pairs = zip(experiment.wrenches, predicted.wrenches, strict=True)
    for k, (sensor, simulated) in enumerate(pairs, 1):
        columns = comparison_columns(sensor.t_s, sensor.values, None, simulated)
        columns[:, 1:] *= sensor.symmetry
        yield SERIES_KIND.series(k, columns)


def write_predicted(experiment: Experiment, trajectory: Trajectory, folder: Path) -> None:
    """Write the predicted wrench into a folder; the experiment has at most one sensor."""
    for sensor, wrench in zip(experiment.wrenches, trajectory.wrenches, strict=True):
        write_wrench_csv(folder / PREDICTED_FILE, sensor.t_s, values=wrench)


def read_predicted(table: dict[str, Any]) -> None:
    """Let the table of an experiment read the predicted wrench, in place, if its first grasp has a
    sensor: in newtons and for the modelled part of the body.

    The keys of the original file (`KEYS_OF_FILE`), among them its columns and "symmetry", are left
    out; `sigma_n` and `sigma_nm` are divided by "symmetry".
    """
    grasps = table["grasp"]
    grasp = grasps[0] if isinstance(grasps, list) else grasps
    if "wrench" not in grasp:
        return
    wrench = grasp["wrench"]
    parts = wrench.get("symmetry", 1)
    sigmas = {key: wrench[key] / parts for key in ("sigma_n", "sigma_nm") if key in wrench}
    remaining = {key: value for key, value in wrench.items() if key not in KEYS_OF_FILE}
    grasp["wrench"] = remaining | sigmas | {"file": PREDICTED_FILE}


def prediction_residuals(
    experiment: Experiment, _: Trajectory, predicted: InstrumentPrediction
) -> PredictionResiduals | None:
    """Return the differences of the forces [N] on the complete specimen; None without sensors."""
    sensors = experiment.wrenches
    if not sensors:
        return None
    pairs = zip(predicted.wrenches, sensors, strict=True)
    return PredictionResiduals.in_order_of_time(
        np.concatenate([sensor.t_s for sensor in sensors]),
        np.concatenate([sensor.symmetry * (read - sensor.values)[:, :3] for read, sensor in pairs]),
        unit="N",
    )


def fit_rms(solution: Solution) -> dict[str, float | None]:
    """Return the RMS residual of the forces [N]; None if none is measured."""
    return {"N": pooled_wrench_rms(solution)[0]}


def fit_fields(part: ExperimentIterate, solution: Solution) -> dict[str, Any]:
    """Return RMS residuals and stated σ of force [N] and torque [N m], of the whole specimen."""
    name = part.transcription.experiment.name
    force_n, torque_nm = solution.wrench_rms.get(name, (None, None))
    squares = [
        (sensor.wrench.symmetry * sensor.wrench.stack_sigmas()) ** 2
        * np.where(sensor.wrench.measured_components, 1.0, np.nan)
        for sensor in part.transcription.sensors
    ]
    of_force, of_torque = (
        root_mean(each[np.isfinite(each)]) or None
        for each in np.array(squares).reshape(-1, 2, 3).swapaxes(0, 1)
    )
    return {
        "wrench_rms_n": force_n,
        "wrench_rms_nm": torque_nm,
        "wrench_sigma_n": of_force,
        "wrench_sigma_nm": of_torque,
    }


def pooled_fields(solution: Solution) -> dict[str, Any]:
    """Return the RMS residuals of all forces [N] and torques [N m]."""
    force_n, torque_nm = pooled_wrench_rms(solution)
    return {"wrench_rms_n": force_n, "wrench_rms_nm": torque_nm}


def fit_lines(name: str, fitted: FittedExperiment, _: bool) -> Iterator[str]:
    """Yield RMS residuals with σ; nothing without sensors."""
    if sizes := _forces_text(fitted.wrench_rms_n, fitted.wrench_rms_nm):
        sigma = _forces_text(fitted.wrench_sigma_n, fitted.wrench_sigma_nm)
        yield f"wrench of '{name}': {sizes} RMS (sigma {sigma})"


def error_texts(error: PredictionErrors, _: Units) -> Iterator[str]:
    """Yield the RMS differences of force and torque; nothing without any."""
    if forces := _forces_text(error.wrench_rms_n, error.wrench_rms_nm):
        yield f"{forces} RMS"


def brief_texts(error: PredictionErrors) -> Iterator[str]:
    """Yield the RMS difference of the force; nothing without any."""
    if error.wrench_rms_n is not None:
        yield f"force: {number(error.wrench_rms_n, 3)} N RMS"


def _forces_text(*sizes: float | None) -> str:
    """Return RMS or σ of a force [N] and a torque [N m], in this order, in words; sizes that are
    None or zero are left out.
    """
    pairs = zip(sizes, ("N", "N m"), strict=True)
    return ", ".join(f"{short(size)} {unit}" for size, unit in pairs if size)


WRENCH = Feature(
    "wrench",
    messages={**MESSAGES, **MESSAGE_OF_OFFSET},
    picture_kinds=[
        PictureKind(
            "wrench",
            "Wrench of a grasp: measured, fitted and simulated.",
            before="error",
            is_leading=True,
        ),
        PictureKind(
            "force_displacement",
            "Force over displacement: measured, fitted and simulated.",
            before="shapes",
            is_leading=True,
        ),
    ],
    series_kind=SERIES_KIND,
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
    simulated_hypotheses=simulated_hypotheses,
    fit_hypotheses=fit_hypotheses,
    recorded=recorded,
    simulated_series=simulated_series,
    write_predicted=write_predicted,
    read_predicted=read_predicted,
    prediction_residuals=prediction_residuals,
    fit_rms=fit_rms,
    fit_fields=fit_fields,
    pooled_fields=pooled_fields,
    fit_lines=fit_lines,
    error_texts=error_texts,
    brief_texts=brief_texts,
)
