"""Predictions of measurements and their errors, as simulations and `result.json` contain them.

The fields of each class name the kinds of measurements; which functions compute them is declared by
the features, see `feature`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..common.array_types import Array
from ..common.serialisation import optional
from ..model.contact.contact_summary import FrictionSummary
from ..program.depth.depth_comparison import DepthError, SurfaceComparison
from ..recording.experiment import Experiment
from ..recording.sample_times import TIME_TOLERANCE_S


@dataclass(frozen=True)
class PredictionErrors:
    """Differences between a prediction and the measurements; None for what is not measured.

    Attributes
    ----------
    rms_m, max_m : float or None
        RMS and largest distance of the markers from their measurements.
    wrench_rms_n, wrench_rms_nm : float or None
        Root mean square of the components of force and torque.
    reading_rms : mapping of name to float, or None
        RMS difference of custom sensors, in their units.
    depth : mapping of the camera's name to DepthError, or None
        Distances of the points of depth cameras from the predicted surface.
    """

    rms_m: float | None = None
    max_m: float | None = None
    wrench_rms_n: float | None = None
    wrench_rms_nm: float | None = None
    reading_rms: Mapping[str, float] | None = None
    depth: Mapping[str, DepthError] | None = None


@dataclass(frozen=True)
class CopyError:
    """Differences between the measurements of a recording and those of a fitted one.

    Attributes
    ----------
    copied : str
        The name of the fitted recording that is nearest.
    error : PredictionErrors
        Errors of its measurements as a prediction.
    """

    copied: str
    error: PredictionErrors


@dataclass(frozen=True)
class InstrumentPrediction:
    """Predictions of a recording's instruments by a simulation, or by another recording.

    Attributes
    ----------
    markers_m : (T, M, 3)
        Marker positions; NaN where nothing is predicted.
    wrenches : sequence of (S, 6)
        Force [N] and torque [N m] of each sensor, at its own times.
    readings : mapping of name to (S, m)
        Values of custom sensors.
    surfaces : mapping of the name of a depth camera to SurfaceComparison
        Points of depth cameras against the predicted surface; empty for another recording.
    """

    markers_m: Array
    wrenches: Sequence[Array] = ()
    readings: Mapping[str, Array] = field(default_factory=dict)
    surfaces: Mapping[str, SurfaceComparison] = field(default_factory=dict)


@dataclass(frozen=True)
class FittedExperiment:
    """Residuals of the fit of an experiment.

    Attributes
    ----------
    rms_m : float
        RMS distance of the markers from the fit [m]; 0 without markers.
    samples, missing : int
        Numbers of marker samples that are present, and that are missing.
    static : bool
        Whether it is a series of equilibria.
    notes : tuple of str
        Sentences on the nuisance parameters of this recording.
    wrench_rms_n, wrench_rms_nm : float or None
        RMS differences of forces [N] and torques [N m]; None if not measured.
    reading_rms : mapping of name to float, or None
        RMS differences of custom sensors in their units; None without any.
    wrench_sigma_n, wrench_sigma_nm : float or None
        Stated standard deviations of the noise of forces [N] and torques [N m]; None if not
        measured.
    reading_sigma : mapping of name to float, or None
        Stated standard deviations of the noise of custom sensors; None without any.
    reading_unit : mapping of name to str, or None
        Units of the custom sensors that state one; None if none does.
    friction : mapping of obstacle to FrictionSummary, or None
        Friction of the obstacles that have some; None without any.
    depth : mapping of depth camera to DepthError, or None
        Distances of its points from the fitted surface; None without depth cameras.
    air_density_kg_m3 : float
        Density of the air around the body in the model; zero in a vacuum.
    test : str or None
        Kind of material test of a specimen without a mesh; None for other experiments.
    """

    rms_m: float
    samples: int
    missing: int
    static: bool
    notes: tuple[str, ...]
    wrench_rms_n: float | None = optional()
    wrench_rms_nm: float | None = optional()
    reading_rms: Mapping[str, float] | None = optional()
    wrench_sigma_n: float | None = optional()
    wrench_sigma_nm: float | None = optional()
    reading_sigma: Mapping[str, float] | None = optional()
    reading_unit: Mapping[str, str] | None = optional()
    friction: Mapping[str, FrictionSummary] | None = optional()
    depth: Mapping[str, DepthError] | None = optional()
    air_density_kg_m3: float = 0.0
    test: str | None = optional()


@dataclass(frozen=True)
class FitResult:
    """Residuals of the fit of all experiments.

    Attributes
    ----------
    rms_m, noise_rms_m : float
        RMS distance of all markers, and that expected from the stated noise.
    experiments : mapping of name to FittedExperiment
        Residuals of each fitted experiment.
    wrench_rms_n, wrench_rms_nm : float or None
        RMS differences of all forces and torques.
    symmetry : mapping of experiment to int, optional
        Of experiments whose loads are reported for the whole specimen: ratio of these to the loads
        of the modelled part. Energies of friction and nuisance parameters are those of the modelled
        part.
    """

    rms_m: float
    noise_rms_m: float
    experiments: Mapping[str, FittedExperiment]
    wrench_rms_n: float | None = optional()
    wrench_rms_nm: float | None = optional()
    symmetry: Mapping[str, int] | None = optional()


@dataclass(frozen=True)
class SimulatedExperiment:
    """Errors of the forward simulation of an experiment; if `failed` is set, all else but `fitted`
    is None.

    Attributes
    ----------
    fitted : bool
        Whether the experiment was fitted, not only predicted.
    failed : str or None
        Why there is no simulation; None if there is one.
    rms_m, max_m : float or None
        RMS and largest distance of the markers [m]; 0 without markers.
    wrench_rms_n, wrench_rms_nm : float or None
        RMS differences of forces [N] and torques [N m]; None if not measured.
    reading_rms : mapping of name to float, or None
        RMS differences of custom sensors in their units; None without any.
    reading_unit : mapping of name to str, or None
        Units of the custom sensors that state one; None if none does.
    nuisance, places_m : mapping or None
        Nuisance parameters and marker places with which a recording for validation was predicted:
        those of the fitted recordings, and its own onsets where they are declared as unknown; empty
        for fitted experiments.
    depth : mapping of depth camera to DepthError, or None
        Distances of its points from the simulated surface; None without depth cameras.
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

    fitted: bool
    failed: str | None = optional()
    rms_m: float | None = optional()
    max_m: float | None = optional()
    reading_unit: Mapping[str, str] | None = optional()
    nuisance: Mapping[str, float] | None = optional()
    places_m: Mapping[str, tuple[float, ...]] | None = optional()
    wrench_rms_n: float | None = optional()
    wrench_rms_nm: float | None = optional()
    reading_rms: Mapping[str, float] | None = optional()
    depth: Mapping[str, DepthError] | None = optional()
    own: PredictionErrors | None = optional()  # noqa: RUF009, it returns a field
    own_deviations: Mapping[str, float] | None = optional()
    own_onsets: Mapping[str, float] | None = optional()
    copied: CopyError | None = optional()  # noqa: RUF009, it returns a field
    not_copied: str | None = optional()


@dataclass(frozen=True)
class ForwardResult:
    """Forward simulations with the estimates.

    Attributes
    ----------
    rms_m, max_m : float or None
        RMS and largest distance of the markers of all fitted experiments; None without any.
    experiments : mapping of name to SimulatedExperiment
        Results of each experiment, also of those for validation.
    """

    rms_m: float | None
    max_m: float | None
    experiments: Mapping[str, SimulatedExperiment]


@dataclass(frozen=True, eq=False)
class Samples:
    """Numbers of one measurement that are present.

    Attributes
    ----------
    what : str
        The measurement, for people.
    names : sequence of K str
        Names of its numbers.
    is_present : (S, K) array of bool
        Which of them are present at its S samples.
    """

    what: str
    names: Sequence[str]
    is_present: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class SensorSeries:
    """Numbers of one sensor over time: measured, fitted and simulated.

    Attributes
    ----------
    kind : str
        Kind of the sensor, with which names of pictures begin.
    number : int
        Number of the sensor among those of its kind, from 1.
    columns : (S, 1 + 3m)
        Time [s], and m numbers as measured, fitted and simulated; NaN where one is missing.
    names : sequence of m str
        Names of the numbers.
    units : sequence of m str
        Units of the numbers; empty if they are not stated.
    """

    kind: str
    number: int
    columns: Array
    names: Sequence[str]
    units: Sequence[str] = ()


@dataclass(frozen=True)
class SeriesKind:
    """Numbers that all sensors of one kind measure over time.

    Attributes
    ----------
    name : str
        Name of the kind, with which names of pictures and stored arrays begin.
    number_names : sequence of m str
        Names of the numbers.
    units : sequence of m str
        Their units.
    """

    name: str
    number_names: Sequence[str]
    units: Sequence[str]

    def series(self, number: int, columns: Array) -> SensorSeries:
        """Return the series of one sensor; number and columns are those of `SensorSeries`."""
        return SensorSeries(self.name, number, columns, self.number_names, units=self.units)


@dataclass(frozen=True)
class PictureKind:
    """Pictures of one kind in the report of a run.

    Attributes
    ----------
    name : str
        Beginning of the names of their files.
    caption : str
        Caption.
    before : str
        Name of the kind before which they stand in a report.
    is_leading : bool
        Whether they show measurement and fit, so that one of them may lead the report.
    """

    name: str
    caption: str
    before: str
    is_leading: bool = False


@dataclass(frozen=True, eq=False)
class PredictionResiduals:
    """Differences by which a prediction of held-out measurements is judged, predicted less
    measured.

    Attributes
    ----------
    t_s : (S,) array
        Times [s], ascending.
    values : (S, K, d) array
        Differences of K vectors or numbers.
    is_counted : (S, K) array of bool
        Whether something was measured.
    unit : str
        Unit of the values.
    """

    t_s: Array
    values: Array
    is_counted: NDArray[np.bool_]
    unit: str

    @classmethod
    def in_order_of_time(cls, t_s: Array, values: Array, unit: str) -> PredictionResiduals:
        """Return the differences (S, d) of several sensors together, at times (S,) in any order; a
        sample counts if any of its numbers is finite.
        """
        order = np.argsort(t_s, kind="stable")
        in_order = values[order, None]
        return cls(
            t_s[order],
            in_order,
            is_counted=np.asarray(np.isfinite(in_order).any(axis=2)),
            unit=unit,
        )


def main_error(error: PredictionErrors) -> float:
    """Return the RMS distance of the markers [m], without markers the RMS difference of the forces
    [N]; infinity if neither is compared.
    """
    return error.rms_m or error.wrench_rms_n or float("inf")


def comparison_columns(t_s: Array, measured: Array, *models: Array | None) -> Array:
    """Return the columns time, measured values and the values of each model, as one array (S, 1 + m
    (1 + number of models)).

    `t_s` is (S,), `measured` and each of `models` (S, m); the columns of a model that is None are
    NaN.
    """
    columns = (np.full_like(measured, np.nan) if each is None else each for each in models)
    return np.column_stack([t_s, measured, *columns])


def during(experiment: Experiment, t_s: Array) -> NDArray[np.bool_]:
    """Return the mask (S,) of the samples at times `t_s` (S,) [s] that are within a recording."""
    first_s, last_s = experiment.t_s[[0, -1]]
    return (t_s >= first_s - TIME_TOLERANCE_S) & (t_s <= last_s + TIME_TOLERANCE_S)
