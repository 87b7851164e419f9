"""Rows of likely mistakes of wrenches and custom sensors that a fit misses: sign, unit and axes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy.linalg import orthogonal_procrustes

from ..common.array_types import Array
from ..errors import InputError, SimulationError
from ..methods.reduced_space import ReducedSpace
from ..program.measured_motion import fitted_values
from ..recording.custom_sensor import CustomSensor
from ..recording.experiment import Experiment
from ..recording.measured_wrench import Wrench
from ..recording.measurement import Measurement, root_mean
from ..recording.nuisance import KINDS, TOOL_CENTRE, TOOL_MASS
from ..statistics.budget.consider_analysis import changes_of_nuisances
from ..statistics.scale_identifiability import relative_moduli
from ..statistics.thresholds import BETTER, NOISE
from .doubt import Correction, Doubt
from .fit import Candidate, TestedFit, scaled_residuals

# Factors of wrong units: prefixes, percent, gram-force, degrees, kilograms-force, pounds-force, psi, inches.
FACTORS = (1e6, 1e3, 1e2, 1e1, 101.97162, 180 / np.pi, 9.80665, 4.4482216, 6894.757, 25.4)
# Largest ratio of the size of the prediction and that of the values in another unit.
SAME_SIZE = 3.0
# Most units that are fitted again.
MOST_UNITS = 2
# Most sweeps of a fit of all other measurements.
MOST_SWEEPS = 40


def unknown_tools(fit: TestedFit) -> Iterator[Doubt]:
    """Yield the row of a mass between wrench sensors and the body that the description lacks."""
    nuisance = fit.experiment.nuisance
    if nuisance.tool_kg or not any(grasp.wrench for grasp in fit.experiment.grasps):
        return

    def correct(experiment: Experiment, size: Array) -> Correction:
        tool_kg = float(size.max())
        if tool_kg <= 0:
            return None
        prior = {TOOL_MASS.name: 3 * tool_kg, TOOL_CENTRE.name: TOOL_CENTRE.reference}
        other = replace(experiment, nuisance=replace(experiment.nuisance, **prior))
        return other, {"tool_g": 1e3 * tool_kg}

    exact = dict.fromkeys((row.name for row in KINDS), None) | {TOOL_MASS.name: 1.0}
    changes = changes_of_nuisances(fit.solution.collocation, fit.solution.z, exact).blocks
    yield Doubt("sensor-tool", "kg", correct, changes=changes, mean=0.0, wide=1.0)


def sensor_candidates(fit: TestedFit) -> Iterator[Candidate]:
    """Yield the likely mistakes of the wrenches and custom sensors that miss by more than noise,
    compared with the prediction of all other measurements, which a wrong sensor does not distort.
    """
    measurements = fit.experiment.measurements
    for sensor, ratios in scaled_residuals(fit.part):
        misses = root_mean(ratios[np.isfinite(ratios)] ** 2) > NOISE
        if not misses or sensor.counts_pixels or not isinstance(sensor, CustomSensor | Wrench):
            continue
        predicted = _predicted_by_others(fit, sensor)
        sets_scale = _sets_scale(fit, sensor)
        of = f"{sensor.samples_text or sensor.title} of '{fit.experiment.name}'"

        def squares(values: Array, sensor: Measurement = sensor, own: Array = predicted) -> float:
            return float(np.nansum(((values - own) / sensor.sample_sigmas) ** 2))

        for row in whole_mistakes(sensor, predicted):
            if sets_scale and row.name == "sensor-unit":
                continue
            if (found := row.hypothesis(fit.experiment)) is not None:
                other = found.corrected.measurements[measurements.index(sensor)]
                share = squares(other.measured_values) / squares(sensor.measured_values)
                if share < BETTER**-2:
                    yield share, replace(found, subject=of)


def _sets_scale(fit: TestedFit, sensor: Measurement) -> bool:
    """Whether equilibria have the moduli from this wrench alone: with smaller loads it fits better,
    because its residuals decrease by the same factor as the moduli.
    """
    if not fit.experiment.is_static or not isinstance(sensor, Wrench):
        return False
    blind = _without(fit.experiment, sensor)
    return blind is None or bool(relative_moduli([blind], fit.solution.collocation.parameters))


def _without(experiment: Experiment, sensor: Measurement) -> Experiment | None:
    """Return the experiment with all other measurements; None if there are none."""
    others = [None if each is sensor else each for each in experiment.measurements]
    if not any(each is not None and each.has_samples() for each in others):
        return None
    try:
        return experiment.with_measurements(others)
    except InputError:
        return None


def _predicted_by_others(fit: TestedFit, sensor: Measurement) -> Array:
    """Return the values (S, m) by a fit of all other measurements, else by that of all."""
    part, experiment = fit.part, fit.experiment
    if (other := _without(experiment, sensor)) is None:
        return fit.predictions[sensor]
    collocation = fit.solution.collocation
    try:
        blind = replace(collocation, experiments=(other,))
        solution = ReducedSpace(max_iterations=MOST_SWEEPS)(blind)
    except (InputError, SimulationError):
        return fit.predictions[sensor]
    (own,) = solution.unless_interrupted().parts
    nuisance = part.transcription.nuisance
    known = dict(zip(own.transcription.nuisance.names, own.phi, strict=True))
    # A tare of the wrong sensor is none; a tool may weigh more than the body.
    phi = np.array([known.get(name, 0.0) for name in nuisance.names])
    tools = nuisance.indices_of_rows(TOOL_MASS, TOOL_CENTRE)
    phi[tools] = part.phi[tools]
    iterate = replace(part, q=own.q, phi=phi, x=own.x)
    return np.asarray(fitted_values(iterate)[experiment.measurements.index(sensor)])


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
    kinds = ("forces", "torques") if isinstance(sensor, Wrench) else ("values",)
    for what, columns in zip(
        kinds, np.split(np.arange(measured.shape[1]), len(kinds)), strict=True
    ):
        own = known & np.isin(np.arange(measured.shape[1]), columns)
        size = root_mean((measured / sigmas)[own] ** 2) if own.any() else 0.0
        ratio = root_mean((predicted / sigmas)[own] ** 2) / max(size, 1e-300) if size else 0.0
        units = sorted(
            (max(ratio / factor, factor / ratio), factor)
            for each in (FACTORS if ratio > 0 else ())
            for factor in (each, 1 / each)
        )
        for apart, factor in units[:MOST_UNITS]:
            if apart < SAME_SIZE:
                other = measured.copy()
                other[:, columns] *= factor
                yield mistake("sensor-unit", other, what=what, factor=factor)
    if measured.shape[1] % 3 == 0:
        pairs = np.stack([measured / sigmas, predicted / sigmas]).reshape(2, -1, 3)
        stated, real = pairs[:, np.isfinite(pairs).all(axis=(0, 2))]
        axes, _ = orthogonal_procrustes(stated, real)
        left, *others = (np.sum((stated @ q - real) ** 2) for q in (axes, np.eye(3), -np.eye(3)))
        if BETTER**2 * left < min(others):
            turned = (measured.reshape(-1, 3) @ axes).reshape(measured.shape)
            yield mistake("sensor-axes", turned, axes=str((axes.round(2) + 0.0).tolist()))
