"""Rows of likely mistakes of sensors that a fit misses: sign, unit, axes, zero and clock.

Of recordings with markers, `features.wrenches.doubts` compares wrenches with the prediction of the
markers. Here nothing else may be measured.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from ..common.array_types import Array, root_mean
from ..errors import InputError
from ..recording.custom_sensor import CustomSensor
from ..recording.experiment import Experiment
from ..recording.measured_wrench import Wrench
from ..recording.measurement import Measurement
from ..statistics.axes import with_other_axes
from ..statistics.thresholds import BETTER, NOISE
from .doubt import Correction, Doubt
from .fit import TestedFit, scaled_residuals

# Factors of wrong units: prefixes, percent, degrees, kilograms-force, pounds-force, psi, inches.
FACTORS = (1e6, 1e3, 1e2, 1e1, 180 / np.pi, 9.80665, 4.4482216, 6894.757, 25.4)
# Largest ratio of the size of the prediction and that of the values in another unit.
SAME_SIZE = 3.0
# Most units that are fitted again.
MOST_UNITS = 2
# Largest lag over the length of the recording.
LATEST = 0.25


def sensor_rows(fit: TestedFit) -> Iterator[Doubt]:
    """Yield the rows of the sensors that miss by more than noise: of custom sensors, and of wrenches
    without markers.
    """
    for sensor, ratios in scaled_residuals(fit.part):
        has_markers = bool(fit.experiment.markers.sample_count)
        is_alone = isinstance(sensor, Wrench) and not has_markers
        misses = root_mean(ratios[np.isfinite(ratios)] ** 2) > NOISE
        if misses and (isinstance(sensor, CustomSensor) or is_alone):
            yield from _rows_of(fit, sensor)


def _rows_of(fit: TestedFit, sensor: Measurement) -> Iterator[Doubt]:
    predicted = fit.predictions[sensor]
    of = f"{sensor.samples_text or sensor.title} of '{fit.experiment.name}'"
    sigmas = sensor.sample_sigmas
    measured = sensor.measured_values
    t_s = sensor.sample_times_s

    def row(code: str, columns: list[Array], correct: Callable[..., Correction], **keys: object):
        changes = fit.blocks_of({sensor: columns}, len(columns))
        return Doubt(code, sensor.unit, correct, changes=changes, subject=of, **keys)  # type: ignore

    if not sensor.counts_pixels:
        for each in whole_mistakes(sensor, predicted):
            other = each.hypothesis(fit.experiment)
            if other is not None:
                place = fit.experiment.measurements.index(sensor)
                values = other.corrected.measurements[place].measured_values
                yield row(each.name, [(measured - values) / sigmas], each.correct)
        used = np.flatnonzero(np.isfinite(measured).any(axis=0))
        units = np.broadcast_to(1 / sigmas, measured.shape)
        zeros = [np.eye(measured.shape[1])[k] * units for k in used]

        def zeroed(experiment: Experiment, size: Array) -> Correction:
            offset = np.zeros(measured.shape[1])
            offset[used] = size
            shown = f"{', '.join(f'{each:.3g}' for each in size)} {sensor.unit}".rstrip()
            return _changed(experiment, sensor, t_s, measured - offset, offset=shown)

        axes = " ".join(map(str, used))
        yield row("sensor-zero", zeros, zeroed, axes=axes, mean=0.0, wide=np.inf)
    if fit.experiment.is_static or len(t_s) < 3:
        return

    def delayed(experiment: Experiment, size: Array) -> Correction:
        (lag_s,) = size.tolist()
        data = {"by_ms": 1e3 * abs(lag_s), "when": "later" if lag_s > 0 else "earlier"}
        if not 0 < abs(lag_s) < LATEST * float(np.ptp(t_s)):
            return None
        return _changed(experiment, sensor, t_s + lag_s, measured, **data)

    rates = np.gradient(predicted, t_s, axis=0) / sigmas
    yield row("sensor-clock", [rates], delayed, mean=0.0, wide=np.inf)


def measurement_mistake(
    code: str, stated: Measurement, without: Callable[[Measurement], Measurement], **data: object
) -> Doubt:
    """Return the row of a measurement that is described wrongly; its name is the code of the
    hypothesis, and `without` returns the measurement without the mistake.
    """

    def correct(experiment: Experiment, _: Array) -> Correction:
        try:
            other = experiment.with_measurements(
                without(each) if each is stated else each for each in experiment.measurements
            )
        except InputError:
            return None
        return other, data

    return Doubt(code, stated.unit, correct)


def _changed(
    experiment: Experiment, sensor: Measurement, t_s: Array, values: Array, **data: object
) -> Correction:
    """Return the experiment with a sensor that measured other values (S, m) at times (S,)."""
    row = measurement_mistake("", sensor, lambda each: each.with_samples(t_s, values), **data)
    return row.correct(experiment, np.ones(1))


def whole_mistakes(sensor: Measurement, predicted: Array) -> Iterator[Doubt]:
    """Yield wrong signs, units and axes of a sensor."""
    measured = sensor.measured_values
    sigmas = sensor.sample_sigmas
    t_s = sensor.sample_times_s

    def mistake(code: str, values: Array, **data: object) -> Doubt:
        return measurement_mistake(
            code, sensor, lambda each: each.with_samples(t_s, values), **data
        )

    yield mistake("sensor-sign", -measured)
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
            yield mistake("sensor-unit", factor * measured, factor=factor)
    if measured.shape[1] % 3 == 0:

        def misfit(values: Array) -> float:
            off = (values - predicted) / sigmas
            return root_mean(off[np.isfinite(off)] ** 2) if np.isfinite(off).any() else np.inf

        turned = dict(with_other_axes(measured, has_sign=False))
        axes = min(turned, key=lambda each: misfit(turned[each]))
        if BETTER * misfit(turned[axes]) < misfit(measured):
            yield mistake("sensor-axes", turned[axes], axes=axes)
