"""Comparison of predictions with the measurements of a recording, for all kinds of measurements.

Predictions are tuples in the order of `Experiment.measurements`, see `program.measured_motion`; None
stands for a measurement that is not predicted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array
from ..common.display import quantity, short
from ..common.serialisation import optional
from ..errors import InputError
from ..methods.solution import Solution, pooled_wrench_rms, wrench_rms
from ..model.contact.summary import FrictionSummary
from ..program.depth.surface_comparison import DepthError, SurfaceComparison
from ..program.measured_motion import Predicted
from ..recording.custom_sensor import CustomSensor
from ..recording.experiment import Experiment
from ..recording.markers import Markers
from ..recording.measured_wrench import Wrench
from ..recording.measurement import Measurement, root_mean
from ..recording.sample_times import TIME_TOLERANCE_S
from ..recording.specimen import STRESS_NAME
from ..recording.specimen_files import moduli_of
from ..statistics.assessment import InstrumentMisfit, misfit

# Share of the samples below which a note says what is missing, and most names in it.
LEAST_SHARE = 0.5
MOST_SHOWN = 3

# Factor of values that are shown as they are.
ONE = np.ones((1, 1))

Predictions = Sequence[Predicted | None]


def _predicted_numbers(
    experiment: Experiment, predicted: Predictions, kind: type = Measurement
) -> list[tuple[Any, Array]]:
    """Return the measurements of one kind whose numbers are predicted, each with these (S, m)."""
    pairs = zip(experiment.measurements, predicted, strict=True)
    return [
        (each, values)
        for each, values in pairs
        if isinstance(each, kind) and isinstance(values, np.ndarray)
    ]


def surfaces(experiment: Experiment, predicted: Predictions) -> dict[str, SurfaceComparison]:
    """Return the comparisons of depth cameras with a predicted surface, by name of the camera."""
    views = (each for each in predicted if isinstance(each, SurfaceComparison))
    return dict(zip(experiment.camera_names, views, strict=False))


def titles(measurements: Sequence[Measurement]) -> Iterator[str]:
    """Yield the title of each measurement, numbered where several have the same one."""
    counts = Counter(each.title for each in measurements)
    numbers: Counter[str] = Counter()
    for each in measurements:
        numbers[each.title] += 1
        is_alone = counts[each.title] == 1
        number = numbers[each.title]
        yield each.title if is_alone else f"{each.title.removeprefix('the ')} {number}"


def lost_samples(experiment: Experiment) -> list[str]:
    """Return a note for each measurement of which less than half is present.

    Raises
    ------
    InputError
        If nothing of a measurement is present within the recording.
    """
    notes = []
    first_s, last_s = experiment.t_s[[0, -1]]
    measurements = experiment.measurements
    for title, measurement in zip(titles(measurements), measurements, strict=True):
        what = measurement.samples_text or title
        t_s = measurement.sample_times_s
        is_within = (t_s >= first_s - TIME_TOLERANCE_S) & (t_s <= last_s + TIME_TOLERANCE_S)
        shares = {name: np.mean(mask & is_within) for name, mask in measurement.presence.items()}
        if not any(shares.values()):
            raise InputError(
                f"nothing of {what} of '{experiment.name}' is measured between "
                f"{first_s:.6g} s and {last_s:.6g} s; expected at least one "
                "sample: check columns, labels and times, or leave it out",
                where="experiment",
            )
        few = [name for name, share in shares.items() if share < LEAST_SHARE]
        if few:
            shown = ", ".join(f"{name} ({shares[name]:.0%})" for name in few[:MOST_SHOWN])
            more = ", …" if len(few) > MOST_SHOWN else ""
            notes.append(
                f"experiment '{experiment.name}': of {what}, {len(few)} of {len(shares)} "
                f"columns are present in less than half of the samples: {shown}{more}; what is "
                "present is used"
            )
    return notes


# Differences --------------------------------------------------------------------------------------


def prediction_error(experiment: Experiment, predicted: Predictions) -> PredictionErrors:
    """Return RMS and maximum differences between a prediction and the measurements of its
    recording, for each kind of measurement.

    Values that are not measured, or not predicted (NaN), are left out; a kind without values has
    None.
    """
    distances_m = np.zeros(0)
    for markers, values in _predicted_numbers(experiment, predicted, Markers):
        distances_m = markers.distances_m(values - markers.measured_values)
    wrenches = [values for _, values in _predicted_numbers(experiment, predicted, Wrench)]
    force_n, torque_nm = wrench_rms(experiment, wrenches) if wrenches else (None, None)
    readings = {}
    for gauge, values in _predicted_numbers(experiment, predicted, CustomSensor):
        for name, factor in _shown_as(experiment, gauge).items():
            squares = (factor * (values - gauge.measured_values)) ** 2
            if factor is ONE or np.isfinite(squares).any():
                readings[name] = float(np.sqrt(np.nanmean(squares)))
    depth = {name: surface.error for name, surface in surfaces(experiment, predicted).items()}
    return PredictionErrors(
        rms_m=root_mean(distances_m**2) if distances_m.size else None,
        max_m=float(distances_m.max()) if distances_m.size else None,
        wrench_rms_n=force_n,
        wrench_rms_nm=torque_nm,
        reading_rms=readings or None,
        depth=depth or None,
    )


def instrument_misfits(experiment: Experiment, predicted: Predictions) -> list[InstrumentMisfit]:
    """Return the RMS of (prediction − measurement) / σ of each measurement with its stated σ.

    Measurements without samples are left out; values that are NaN, measured or predicted, do not
    count.
    """
    misfits = []
    measurements = experiment.measurements
    named = zip(titles(measurements), measurements, predicted, strict=True)
    for title, measurement, values in named:
        if isinstance(values, SurfaceComparison):
            error = values.error
            if error.rms_m is not None:
                misfits.append(
                    InstrumentMisfit(
                        title,
                        measurement.sigma_text,
                        sigmas=error.sigmas,
                        robust_sigmas=error.tame_sigmas,
                        count=error.points,
                        size=f"{1e3 * error.rms_m:.3g} mm RMS",
                    )
                )
        elif values is not None and measurement.has_samples():
            difference = values - measurement.measured_values
            ratio = difference / measurement.sample_sigmas
            size = measurement.rms_text(difference)
            misfits.append(misfit(title, measurement.sigma_text, ratio=ratio, size=size))
    return misfits


def judged_residuals(experiment: Experiment, predicted: Predictions) -> PredictionResiduals:
    """Return the differences by which a prediction of an experiment is judged: those of the
    markers, without these of the forces on the complete specimen, else of the custom sensors like
    the first one.

    Raises
    ------
    ValueError
        If nothing is measured by which it could be judged.
    """
    numbers = [pair for pair in _predicted_numbers(experiment, predicted) if pair[0].has_samples()]
    if not numbers:
        raise ValueError(f"nothing is measured in '{experiment.name}'")

    def sort(of: Measurement) -> Any:
        return type(of), of.unit, of.measured_values.shape[1]

    first = numbers[0][0]
    same = [(each, values) for each, values in numbers if sort(each) == sort(first)]
    return PredictionResiduals.in_order_of_time(
        np.concatenate([each.sample_times_s for each, _ in same]),
        np.concatenate([each.vectors(values - each.measured_values) for each, values in same]),
        unit=first.unit,
    )


def fit_rms(solution: Solution) -> dict[str, float | None]:
    """Return the RMS residuals of all fitted experiments by unit: distances of markers, forces, and
    custom sensors; None where nothing is measured.
    """
    differences: dict[str, list[Array]] = {}
    for part in solution.parts:
        experiment = part.transcription.experiment
        fitted = solution.fitted_values[experiment.name]
        for gauge, values in _predicted_numbers(experiment, fitted, CustomSensor):
            here = values - gauge.measured_values
            differences.setdefault(gauge.unit, []).append(here.ravel())
    readings = {
        unit: float(np.sqrt(np.nanmean(np.concatenate(each) ** 2)))
        for unit, each in differences.items()
    }
    return readings | {"m": solution.rms_m, "N": pooled_wrench_rms(solution)[0]}


# Copies of other recordings -----------------------------------------------------------------------


def reason_against_copy(experiment: Experiment, other: Experiment) -> str:
    """Return why the measurements of another recording cannot be compared with those of a recording
    as a prediction, such as other markers; "" if they can.
    """
    both = [[m for m in each.measurements if m.value_sigmas.size] for each in (experiment, other)]
    for kind in dict.fromkeys(type(each) for each in (*both[0], *both[1])):
        own, theirs = ([m.identity for m in each if type(m) is kind] for each in both)
        if own != theirs:
            return f"other {kind.other_text}"
    if not any(np.isfinite(each.measured_values).any() for each in both[0]):
        what = experiment.measurements[-1].measurement_text
        return f"{what} cannot be compared between recordings"
    return ""


def copied(experiment: Experiment, other: Experiment) -> Predictions:
    """Return the measurements of another recording as predictions; unlabelled points predict
    nothing. `reason_against_copy` must be empty.
    """
    theirs = iter([each for each in other.measurements if each.value_sigmas.size])
    return [
        each.values_of(next(theirs)) if each.value_sigmas.size else None
        for each in experiment.measurements
    ]


def copied_times_s(experiment: Experiment, other: Experiment) -> Iterator[tuple[Array, Array]]:
    """Yield the sample times of each measurement in both recordings, which must agree for a copy."""
    both = ([m for m in each.measurements if m.value_sigmas.size] for each in (experiment, other))
    for own, theirs in zip(*both, strict=True):
        if own.has_samples():
            yield own.sample_times_s, theirs.sample_times_s


# Results of a fit ---------------------------------------------------------------------------------


def _shown_as(experiment: Experiment, gauge: CustomSensor) -> dict[str, Array]:
    """Return factors, (1, 1) or (S, 1), to moduli that a table states in place of stresses."""
    if gauge.name == STRESS_NAME:
        moduli = moduli_of(experiment)
        if moduli and len(gauge.sample_times_s) == len(experiment.t_s):
            return {name: factor[:, None] for name, factor in moduli.items()}
    return {gauge.name: ONE}


def units_by_name(experiment: Experiment) -> dict[str, str] | None:
    """Return the units of the custom sensors that state one, by name; None if none does."""
    gauges = [gauge for gauge in experiment.readings if gauge.unit]
    return {name: each.unit for each in gauges for name in _shown_as(experiment, each)} or None


def _shown_sigmas(experiment: Experiment) -> dict[str, float] | None:
    sigmas = {}
    for gauge in experiment.readings:
        for name, factor in _shown_as(experiment, gauge).items():
            squares = (factor * gauge.sample_sigmas) ** 2
            of_moduli = float(np.sqrt(np.nanmean(squares)))
            sigmas[name] = gauge.sigma if factor is ONE else of_moduli
    return sigmas or None


def stated_sigmas(experiment: Experiment) -> dict[str, Any]:
    """Return the fields of `FittedExperiment` with the stated noise of the measurements: of force
    and torque on the whole specimen, and of custom sensors with their units.
    """
    squares = [
        np.where(wrench.measured_components, (wrench.symmetry * wrench.value_sigmas) ** 2, np.nan)
        for wrench in experiment.wrenches
    ]
    of_force, of_torque = (
        root_mean(each[np.isfinite(each)]) or None
        for each in np.array(squares).reshape(-1, 2, 3).swapaxes(0, 1)
    )
    return {
        "wrench_sigma_n": of_force,
        "wrench_sigma_nm": of_torque,
        "reading_sigma": _shown_sigmas(experiment),
        "reading_unit": units_by_name(experiment),
        "reading_kind": {
            each.name: each.measurement_text for each in experiment.readings if each.counts_pixels
        }
        or None,
    }


def recorded_series(
    experiment: Experiment, fitted: Predictions | None, simulated: Predictions | None
) -> dict[str, Any]:
    """Return the fields of `MotionRecord` with the numbers of sensors over time.

    Each array (S, 1 + 3m) has the time [s], and the m numbers as measured, fitted and simulated, of
    the whole specimen also where symmetry reduces the model to a part of it; NaN where the
    experiment was not fitted or not simulated.
    """
    models = [
        [None] * len(experiment.measurements) if each is None else each
        for each in (fitted, simulated)
    ]
    wrenches = []
    readings = {}
    for measurement, *predicted in zip(experiment.measurements, *models, strict=True):
        if isinstance(measurement, Wrench):
            wrenches.append(_columns(measurement, predicted))
        elif isinstance(measurement, CustomSensor):
            readings[measurement.name] = _columns(measurement, predicted)
    return {"wrenches": wrenches, "readings": readings}


def _columns(measurement: Measurement, models: Iterable[Any]) -> Array:
    measured = measurement.measured_values
    unknown = np.full_like(measured, np.nan)
    numbers = [measured, *(unknown if each is None else each for each in models)]
    return np.column_stack(
        [measurement.sample_times_s, *(measurement.symmetry * each for each in numbers)]
    )


@dataclass(frozen=True)
class PredictionErrors:
    """Differences between a prediction and the measurements; None for what is not measured."""

    # RMS and largest distance of the markers from their measurements.
    rms_m: float | None = None
    max_m: float | None = None
    # Root mean square of the components of force and torque.
    wrench_rms_n: float | None = None
    wrench_rms_nm: float | None = None
    # mapping of name to float, or None: RMS difference of custom sensors, in their units.
    reading_rms: Mapping[str, float] | None = None
    # mapping of the camera's name to DepthError, or None: distances of the points of depth cameras
    # from the predicted surface.
    depth: Mapping[str, DepthError] | None = None

    @property
    def main(self) -> float:
        """RMS distance of the markers [m], without markers the RMS difference of the forces [N];
        infinity if neither is compared.
        """
        return self.rms_m or self.wrench_rms_n or float("inf")

    def text(self, units: Mapping[str, str] | None) -> str:
        """Return the errors in words; "" if nothing is compared.

        Errors that are None, and errors of markers and forces that are zero, are left out. `units`
        are those of custom sensors by name.
        """
        texts = []
        if self.rms_m:
            largest = "" if self.max_m is None else f", at most {1e3 * self.max_m:.2f} mm"
            texts.append(f"{1e3 * self.rms_m:.3f} mm RMS{largest}")
        if forces := _forces_text(self.wrench_rms_n, self.wrench_rms_nm):
            texts.append(f"{forces} RMS")
        for reading, rms in (self.reading_rms or {}).items():
            texts.append(f"{reading} {quantity(rms, (units or {}).get(reading, ''))} RMS")
        for camera, distances in (self.depth or {}).items():
            whose = "" if camera == "depth" else f" of {camera}"  # which has no name of its own
            texts.append(f"depth{whose} {distances.text}")
        return "; ".join(texts)


def _forces_text(*sizes: float | None) -> str:
    """Zero and None are left out."""
    pairs = zip(sizes, ("N", "N m"), strict=True)
    return ", ".join(f"{short(size)} {unit}" for size, unit in pairs if size)


@dataclass(frozen=True)
class CopyError:
    """Differences between the measurements of a recording and those of a fitted one."""

    copied: str  # the name of the fitted recording that is nearest
    error: PredictionErrors  # errors of its measurements as a prediction


@dataclass(frozen=True, kw_only=True)
class FittedExperiment(PredictionErrors):
    """Residuals of the fit of an experiment; `rms_m` is 0 without markers, and `max_m` is None."""

    OMITS_NONE: ClassVar = True

    # Numbers of marker samples that are present, and that are missing.
    samples: int
    missing: int
    static: bool  # whether it is a series of equilibria
    notes: tuple[str, ...]  # sentences on the nuisance parameters of this recording
    # Stated standard deviations of the noise of forces [N] and torques [N m]; None if not measured.
    wrench_sigma_n: float | None = None
    wrench_sigma_nm: float | None = None
    # mapping of name to float, or None: stated standard deviations of the noise of custom sensors;
    # None without any.
    reading_sigma: Mapping[str, float] | None = None
    # mapping of name to str, or None: units of the custom sensors that state one; None if none
    # does.
    reading_unit: Mapping[str, str] | None = None
    # mapping of name to str, or None: kinds of the sensors that are images of a camera, such as
    # "image tracks"; None without any.
    reading_kind: Mapping[str, str] | None = None
    # mapping of obstacle to FrictionSummary, or None: friction of the obstacles that have some;
    # None without any.
    friction: Mapping[str, FrictionSummary] | None = None
    # Density of the air around the body in the model; zero in a vacuum.
    air_density_kg_m3: float = 0.0
    # Kind of material test of a specimen without a mesh; None for other experiments.
    test: str | None = None

    def lines(self, name: str, is_symmetric: bool) -> Iterator[str]:
        """Yield lines of a summary on the sensors and the friction of the experiment `name`; of a
        symmetric one the energy is that of the modelled part.
        """
        if sizes := _forces_text(self.wrench_rms_n, self.wrench_rms_nm):
            sigma = _forces_text(self.wrench_sigma_n, self.wrench_sigma_nm)
            yield f"wrench of '{name}': {sizes} RMS (sigma {sigma})"
        for reading, rms in (self.reading_rms or {}).items():
            unit = (self.reading_unit or {}).get(reading, "")
            sigma = quantity((self.reading_sigma or {})[reading], unit)
            kind = (self.reading_kind or {}).get(reading)
            what = f"{kind} {reading}" if kind else reading
            yield f"{what} of '{name}': {quantity(rms, unit)} RMS (sigma {sigma})"
        joules = "J in the modelled part" if is_symmetric else "J"
        for obstacle, friction in (self.friction or {}).items():
            yield (
                f"friction of {obstacle} in '{name}': at most {friction.used:.0%} of its limit, "
                f"slip during {friction.slipping:.0%} of the time, "
                f"{short(friction.dissipated_j)} {joules} dissipated"
            )
        for camera, error in (self.depth or {}).items():
            yield f"depth of {camera} in '{name}': {error.text}"


@dataclass(frozen=True)
class FitResult:
    """Residuals of the fit of all experiments."""

    # RMS distance of all markers, and that expected from the stated noise.
    rms_m: float
    noise_rms_m: float
    # mapping of name to FittedExperiment: residuals of each fitted experiment.
    experiments: Mapping[str, FittedExperiment]
    # RMS differences of all forces and torques.
    wrench_rms_n: float | None = optional()
    wrench_rms_nm: float | None = optional()
    # mapping of experiment to int: of experiments whose loads are reported for the whole specimen:
    # ratio of these to the loads of the modelled part. Energies of friction and nuisance parameters
    # are those of the modelled part.
    symmetry: Mapping[str, int] | None = optional()


@dataclass(frozen=True, kw_only=True)
class SimulatedExperiment(PredictionErrors):
    """Errors of the forward simulation of an experiment; if `failed` is set, all else but `fitted`
    is None. `rms_m` and `max_m` are 0 without markers.

    Attributes
    ----------
    fitted : bool
        Whether the experiment was fitted, not only predicted.
    failed : str or None
        Why there is no simulation; None if there is one.
    reading_unit : mapping of name to str, or None
        Units of the custom sensors that state one; None if none does.
    nuisance, places_m : mapping or None
        Nuisance parameters and marker places with which a recording for validation was predicted:
        those of the fitted recordings, and its own onsets where they are declared as unknown; empty
        for fitted experiments. Nuisance parameters of places are displacements from their start;
        places are on the undeformed body.
    own : PredictionErrors or None
        Of an experiment for validation, the errors that remain if its nuisance parameters are
        fitted to it, whatever they absorb; None without any, and for fitted experiments.
    own_deviations : mapping of name to float, or None
        These nuisance parameters less those of the prediction, in standard deviations of their
        priors.
    own_onsets : mapping of name to float, or None
        Times that the prediction takes from its own recording because they are declared as
        unknown, in standard deviations of their priors.
    copied : CopyError or None
        Of an experiment for validation, with the measurements of the nearest fitted recording as
        the prediction; None if there is no such copy.
    not_copied : str or None
        Why there is no such copy; empty for fitted experiments.
    """

    OMITS_NONE: ClassVar = True

    fitted: bool
    failed: str | None = None
    reading_unit: Mapping[str, str] | None = None
    nuisance: Mapping[str, float] | None = None
    places_m: Mapping[str, Sequence[float]] | None = None
    own: PredictionErrors | None = None
    own_deviations: Mapping[str, float] | None = None
    own_onsets: Mapping[str, float] | None = None
    copied: CopyError | None = None
    not_copied: str | None = None


@dataclass(frozen=True)
class ForwardResult:
    """Forward simulations with the estimates."""

    # RMS and largest distance of the markers of all fitted experiments; None without any.
    rms_m: float | None
    max_m: float | None
    # mapping of name to SimulatedExperiment: results of each experiment, also of those for
    # validation.
    experiments: Mapping[str, SimulatedExperiment]


@dataclass(frozen=True, eq=False)
class PredictionResiduals:
    """Differences by which a prediction of held-out measurements is judged, predicted less
    measured.
    """

    t_s: Array  # (S,): times [s], ascending
    values: Array  # (S, K, d): differences of K vectors or numbers
    is_counted: NDArray[np.bool_]  # (S, K) of bool: whether something was measured
    unit: str  # unit of the values

    @classmethod
    def in_order_of_time(cls, t_s: Array, values: Array, unit: str) -> PredictionResiduals:
        """Return the differences (S, K, d) of several sensors together, at times (S,) in any order;
        a vector counts if any of its numbers is finite.
        """
        order = np.argsort(t_s, kind="stable")
        in_order = values[order]
        return cls(
            t_s[order],
            in_order,
            is_counted=np.asarray(np.isfinite(in_order).any(axis=2)),
            unit=unit,
        )
