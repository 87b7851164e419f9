"""Misspecification hypotheses for sensors that a fit misses: sign, unit, axes, zero and clock of
custom sensors, and of wrenches in recordings without markers.

Of recordings with markers, `features.wrenches.mistakes` compares wrenches with the prediction of the
markers. Here nothing else may be measured, so that each mistake is corrected in a refit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from ..common.array_types import Array, root_mean
from ..errors import InputError
from ..methods.solution import Solution
from ..recording.custom_sensor import CustomSensor
from ..recording.experiment import Experiment
from ..recording.measured_wrench import Wrench
from ..recording.measurement import Measurement
from ..statistics.axes import with_other_axes
from ..statistics.hypothesis import Hypothesis
from ..statistics.linearised import LinearisedFit, linearise_fit
from ..statistics.thresholds import BETTER, LEAST_DECREASE
from .bodies import linear_step, projected_gram
from .doubt import Correction, Doubt

# Factors of wrong units: prefixes, percent, degrees, kilograms-force, pounds-force, psi, inches.
FACTORS = (1e6, 1e3, 1e2, 1e1, 180 / np.pi, 9.80665, 4.4482216, 6894.757, 25.4)
# Largest ratio of the size of the prediction and that of the values in another unit.
SAME_SIZE = 3.0
# Most units that are fitted again.
MOST_UNITS = 2
# Largest lag over the length of the recording.
LATEST = 0.25


def sensor_misfits(solution: Solution, number: int) -> dict[Measurement, float]:
    """Return the RMS residual in σ of each measurement with numbers of a fitted experiment (index);
    values that are not measured or not predicted do not count.
    """
    experiment = solution.parts[number].transcription.experiment
    return {
        each: root_mean(ratio[np.isfinite(ratio)] ** 2)
        for each, values in zip(
            experiment.measurements, solution.fitted_values[experiment.name], strict=True
        )
        if isinstance(values, np.ndarray) and each.has_samples()
        for ratio in [(values - each.measured_values) / each.sample_sigmas]
    }


def sensor_hypotheses(
    stated: Solution, least_misfit: float, declared: Experiment | None = None
) -> Iterator[Hypothesis]:
    """Yield hypotheses about the sensors of a fit of one experiment that miss by more than
    `least_misfit` σ, with the experiment without the mistake as `corrected`.

    `declared` is the experiment as it was stated, if the fitted one is already corrected: only
    zeros and clocks, of which a correction follows from a linear step, are corrected again.
    """
    (part,) = stated.parts
    experiment = part.transcription.experiment
    origins = (declared or experiment).measurements
    missed = [
        each
        for each, misfit in sensor_misfits(stated, 0).items()
        if misfit > least_misfit
        and (
            isinstance(each, CustomSensor)
            or (isinstance(each, Wrench) and not experiment.markers.sample_count)
        )
    ]
    if not missed:
        return
    fit = linearise_fit(stated.collocation, stated.z)
    fitted = stated.fitted_values[experiment.name]
    predictions = {
        each: values
        for each, values in zip(experiment.measurements, fitted, strict=True)
        if isinstance(values, np.ndarray)
    }
    models = dict(zip(experiment.measurements, part.transcription.main_residuals, strict=True))
    numbers = {id(each): k for k, each in enumerate(part.transcription.residuals)}
    for sensor in missed:
        own = numbers[id(models[sensor])]
        origin = origins[experiment.measurements.index(sensor)]
        linear = _linear_mistakes(sensor, predictions[sensor], fit, own, origin)
        is_plain = not declared and not sensor.counts_pixels
        whole = whole_mistakes(sensor, predictions[sensor]) if is_plain else ()
        title = sensor.samples_text or sensor.title
        for row in (*whole, *linear):
            if hypothesis := row.hypothesis(experiment):
                yield replace(hypothesis, subject=f"{title} of '{experiment.name}'")


def measurement_mistake(
    code: str, stated: Measurement, without: Callable[[Measurement], Measurement], **data: object
) -> Doubt:
    """Return the row of a measurement that is described wrongly; its name is the code of the
    hypothesis, and `without` returns the measurement without the mistake.
    """

    def corrected(experiment: Experiment, _: Array) -> Correction:
        try:
            other = experiment.with_measurements(
                without(each) if each is stated else each for each in experiment.measurements
            )
        except InputError:
            return None
        return other, data

    return Doubt(code, stated.unit, correct=corrected, is_whole=True)


def _mistake(
    code: str, sensor: Measurement, values: Array, t_s: Array | None = None, **data: object
) -> Doubt:
    """Return the row of a sensor that measured other values (S, m), or at other times (S,)."""
    times_s = sensor.sample_times_s if t_s is None else t_s
    return measurement_mistake(
        code, sensor, lambda each: each.with_samples(times_s, values), **data
    )


def whole_mistakes(sensor: Measurement, predicted: Array) -> Iterator[Doubt]:
    """Yield wrong signs, units and axes of a sensor."""
    measured = sensor.measured_values
    sigmas = sensor.sample_sigmas
    yield _mistake("sensor-sign", sensor, -measured)
    known = np.isfinite(measured + predicted)
    size = root_mean((measured / sigmas)[known] ** 2)
    ratio = root_mean((predicted / sigmas)[known] ** 2) / max(size, 1e-300)
    units = sorted(
        (max(ratio / factor, factor / ratio), factor)
        for each in (FACTORS if ratio > 0 else ())
        for factor in (each, 1 / each)
    )
    for apart, factor in units[:MOST_UNITS]:
        if apart < SAME_SIZE:
            yield _mistake("sensor-unit", sensor, factor * measured, factor=factor)
    if measured.shape[1] % 3 == 0:
        yield from _other_axes(sensor, predicted)


def _other_axes(sensor: Measurement, predicted: Array) -> Iterator[Doubt]:
    measured = sensor.measured_values

    def misfit(values: Array) -> float:
        ratio = (values - predicted) / sensor.sample_sigmas
        return root_mean(ratio[np.isfinite(ratio)] ** 2) if np.isfinite(ratio).any() else np.inf

    turned = dict(with_other_axes(measured, has_sign=False))
    axes = min(turned, key=lambda each: misfit(turned[each]))
    if BETTER * misfit(turned[axes]) < misfit(measured):
        yield _mistake("sensor-axes", sensor, turned[axes], axes=axes)


def _linear_mistakes(
    sensor: Measurement, predicted: Array, fit: LinearisedFit, own: int, origin: Measurement
) -> Iterator[Doubt]:
    """Yield a wrong zero and a wrong clock of a sensor, by the amounts that explain its residuals,
    the block `own` of the fit, best. Messages state the differences from `origin`, the sensor as it
    was stated.
    """
    measured = sensor.measured_values
    t_s = sensor.sample_times_s
    used = np.flatnonzero(np.isfinite(measured).any(axis=0))
    units = np.broadcast_to(1 / sensor.sample_sigmas, measured.shape)
    columns = [np.eye(measured.shape[1])[k] * units for k in used]
    zeros = np.zeros(measured.shape[1])
    decrease, zeros[used] = _linear_step(fit, columns, own)
    whole = np.nanmean((origin.measured_values - measured)[:, used] + zeros[used], axis=0)
    shown = ", ".join(f"{each:.3g}" for each in whole)
    if decrease > LEAST_DECREASE and not sensor.counts_pixels:
        offset = f"{shown} {sensor.unit}".rstrip()
        yield _mistake("sensor-zero", sensor, measured - zeros, offset=offset)
    if fit.blocks[own].is_static or len(t_s) < 3:
        return
    rates = np.nan_to_num(np.gradient(predicted, t_s, axis=0))
    decrease, (more_s,) = _linear_step(fit, [rates / sensor.sample_sigmas], own)
    lag_s = float(np.mean(t_s - origin.sample_times_s) + more_s)
    if decrease > LEAST_DECREASE and 0 < abs(lag_s) < LATEST * float(np.ptp(t_s)):
        named = {"by_ms": 1e3 * abs(lag_s), "when": "later" if lag_s > 0 else "earlier"}
        yield _mistake("sensor-clock", sensor, measured, t_s + more_s, **named)


def _linear_step(fit: LinearisedFit, columns: Sequence[Array], own: int) -> tuple[float, Array]:
    """Return decrease of χ² and amplitudes of changes (S, m) that explain a block best."""
    blocks = [np.zeros((*each.residual.shape, len(columns))) for each in fit.blocks]
    samples, groups, each = fit.blocks[own].residual.shape
    changes = np.zeros((samples, groups * each, len(columns)))
    for k, column in enumerate(columns):
        changes[:, : column.shape[1], k] = column
    blocks[own] = changes.reshape(blocks[own].shape)
    return linear_step(projected_gram(fit, blocks), range(1, 1 + len(columns)))
