"""Differences between a simulated motion and a recording, in units and in stated standard
deviations.

They are evaluated for forward simulations of fitted recordings, and for predictions of others. A
prediction is compared with two references: the same prediction with the nuisance parameters of the
fitted recordings (blind), and the measurements of a fitted recording (copy).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..common.array_types import Array, root_mean
from ..methods.solution import Solution, custom_sensor_rms, wrench_rms
from ..program.depth.depth_comparison import DepthError
from ..program.transcription import Transcription
from ..recording import Experiment
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
class InstrumentMisfit:
    """Differences between a prediction and the measurements of one kind, in stated σ.

    Attributes
    ----------
    what : str
        What is measured, for people.
    sigma_key : str
        Key of σ in the problem, for people.
    sigmas : float
        Root mean square of the differences over σ.
    robust_sigmas : float
        The same without outliers of depth, see `DepthError`; predictions are judged by it.
    count : int
        Number of measured values.
    size : str
        Root mean square in a unit, for people; empty if units differ.
    """

    what: str
    sigma_key: str
    sigmas: float
    robust_sigmas: float
    count: int
    size: str = ""


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
    depth : mapping of the camera's name to DepthError
        Distances of the points of depth cameras from the predicted surface.
    """

    markers_m: Array
    wrenches: Sequence[Array] = ()
    readings: Mapping[str, Array] = field(default_factory=dict)
    depth: Mapping[str, DepthError] = field(default_factory=dict)


def prediction_error(
    experiment: Experiment, predicted: InstrumentPrediction
) -> PredictionErrors:
    """Return RMS and maximum differences between a prediction and the measurements of its
    recording, for each kind of instrument.

    Values that are not measured, or not predicted (NaN), are left out; a kind without values has
    None.

    Parameters
    ----------
    experiment : Experiment
        Recording with the measurements.
    predicted : InstrumentPrediction
        Prediction at the same samples and for the same instruments, in the same order.
    """
    distance_m = np.linalg.norm(
        predicted.markers_m - experiment.markers.positions_m, axis=2
    )
    present_m = distance_m[
        experiment.markers.is_present & np.isfinite(distance_m)
    ]
    force_n, torque_nm = wrench_rms(experiment, predicted.wrenches)
    return PredictionErrors(
        rms_m=root_mean(present_m**2) if present_m.size else None,
        max_m=float(present_m.max()) if present_m.size else None,
        wrench_rms_n=force_n,
        wrench_rms_nm=torque_nm,
        reading_rms=custom_sensor_rms(experiment, predicted.readings) or None,
        depth=dict(predicted.depth) or None,
    )


def instrument_misfits(
    experiment: Experiment, predicted: InstrumentPrediction
) -> list[InstrumentMisfit]:
    """Return the RMS of (prediction − measurement) / σ of each instrument, with the stated σ.

    The order is markers, wrenches, custom sensors, depth cameras. Markers and depth cameras without
    measurements are left out; values that are NaN, measured or predicted, do not count.

    Parameters
    ----------
    experiment : Experiment
        Recording with the measurements.
    predicted : InstrumentPrediction
        Prediction at the same samples and for the same instruments, in the same order.
    """
    results = []
    markers = experiment.markers
    if markers.is_present.any():
        difference_m = (predicted.markers_m - markers.positions_m)[
            markers.is_present
        ]
        sigma_m = np.broadcast_to(markers.sigma_m, markers.is_present.shape)[
            markers.is_present
        ]
        rms_m = root_mean(np.sum(difference_m**2, axis=1))
        ratio = difference_m / sigma_m[:, None]
        results.append(
            _misfit(
                "the markers",
                "sigma_m",
                ratio=ratio,
                size=f"{1e3 * rms_m:.3g} mm RMS",
            )
        )
    for read, sensor in zip(
        predicted.wrenches, experiment.wrenches, strict=True
    ):
        ratio = (read - sensor.values) / sensor.sigmas
        results.append(_misfit("the wrench", "sigma_n", ratio=ratio))
    for gauge in experiment.readings:
        ratio = (
            predicted.readings[gauge.name] - gauge.measured_values
        ) / gauge.sigma
        results.append(_misfit(gauge.name, "its sigma", ratio=ratio))
    for name, error in predicted.depth.items():
        if error.rms_m is not None:
            size = f"{1e3 * error.rms_m:.3g} mm RMS"
            what = f"the depth of {name}"
            results.append(
                InstrumentMisfit(
                    what,
                    "its sigma_m",
                    sigmas=error.sigmas,
                    robust_sigmas=error.tame_sigmas,
                    count=error.points,
                    size=size,
                )
            )
    return results


def _misfit(
    what: str, declared_size: str, ratio: Array, size: str = ""
) -> InstrumentMisfit:
    """Return the misfit of one instrument; its RMS is that of the values that are finite.

    Parameters
    ----------
    what : str
        The instrument, for messages.
    declared_size : str
        Name of its stated σ, for messages.
    ratio : array
        Differences over σ; NaN is ignored.
    size : str
        RMS with its unit, for messages; "" if there is none.
    """
    known = ratio[np.isfinite(ratio)]
    sigmas = root_mean(known**2)
    return InstrumentMisfit(
        what,
        declared_size,
        sigmas=sigmas,
        robust_sigmas=sigmas,
        count=known.size,
        size=size,
    )


# Blind predictions --------------------------------------------------------------------------------


def nuisance_of_fitted_recordings(
    segment: Transcription, solution: Solution
) -> Array:
    """Return the nuisance parameters (k,) of a recording by those of the fitted recordings.

    Each is the mean over the fitted recordings that have one of the same label, such as the place
    of a marker by its name, and zero, the mean of its prior, where none has: nothing of the
    recording's own measurements is used.

    Parameters
    ----------
    segment : Transcription
        Of the recording to be predicted.
    solution : Solution
        Of the fitted recordings.
    """
    nuisance = segment.nuisance
    places = segment.markers.coordinate_parameters
    known: dict[str, list[float]] = {}
    for part in solution.parts:
        for entry, _, value in part.segment.nuisance.iterate_values(part.phi):
            known.setdefault(entry.label, []).append(value)
    phi = np.zeros(nuisance.size)
    for k, entry in enumerate(nuisance.entries):
        phi[k] = np.mean(known.get(entry.label, [0.0])) / entry.sigma
    start_m = segment.marker_places_m(np.zeros(nuisance.size))
    for number in segment.association.markers.estimated.tolist():
        name = segment.experiment.markers.names[number]
        places_m = [
            part.segment.marker_places_m(part.phi)[
                part.segment.experiment.markers.names.index(name)
            ]
            for part in solution.parts
            if name in part.segment.experiment.markers.names
        ]
        if places_m:
            directions_m = (
                segment.association.markers.sigma_m[number]
                * segment.association.markers.axes[number]
            )
            way_m = np.mean(places_m, axis=0) - start_m[number]
            phi[places[number]] = np.linalg.pinv(directions_m) @ way_m
    return phi


# Copies of other recordings -----------------------------------------------------------------------


def nearest_recording_error(
    experiment: Experiment, fitted: Iterable[Experiment]
) -> CopyError | str:
    """Return how well the nearest fitted recording's measurements predict a recording.

    Measurements are compared sample by sample, at equal times after the start. The nearest one has
    the smallest RMS of the markers, or of the forces if no markers are compared.

    Parameters
    ----------
    experiment : Experiment
        Recording to predict.
    fitted : iterable of Experiment
        Fitted recordings.

    Returns
    -------
    CopyError or str
        A text with the reasons if no fitted recording has the same instruments and times.
    """
    reasons = {}
    copies = []
    for other in fitted:
        reason = _reason_against_copy(experiment, other)
        if reason:
            reasons[other.name] = reason
            continue
        order = [
            other.markers.names.index(name) for name in experiment.markers.names
        ]
        known_m = np.where(
            other.markers.is_present[..., None],
            other.markers.positions_m,
            np.nan,
        )
        copy = InstrumentPrediction(
            markers_m=known_m[:, order],
            wrenches=[each.values for each in other.wrenches],
            readings={
                gauge.name: gauge.measured_values for gauge in other.readings
            },
        )
        copies.append(CopyError(other.name, prediction_error(experiment, copy)))
    if not copies:
        explanation = "; ".join(
            f"{name}: {reason}" for name, reason in reasons.items()
        )
        return f"no fitted recording can be copied ({explanation})"
    return min(
        copies,
        key=lambda each: each.error.rms_m or each.error.wrench_rms_n or np.inf,
    )


def _reason_against_copy(experiment: Experiment, other: Experiment) -> str:
    """Return why the measurements of `other` cannot be compared with those of a recording as a
    prediction, such as other markers; "" if they can.
    """
    own = experiment.markers
    others = other.markers
    if not (own.sample_count or experiment.wrenches or experiment.readings):
        return "points of depth cameras cannot be compared between recordings"
    if set(own.names) != set(others.names):
        return "other markers"
    if len(experiment.wrenches) != len(other.wrenches):
        return "other wrenches"
    if [g.name for g in experiment.readings] != [
        g.name for g in other.readings
    ]:
        return "other readings"
    times = [(experiment.t_s, other.t_s)] if own.sample_count else []
    times += [
        (a.t_s, b.t_s)
        for a, b in zip(experiment.wrenches, other.wrenches, strict=True)
    ]
    times += [
        (a.sample_times_s, b.sample_times_s)
        for a, b in zip(experiment.readings, other.readings, strict=True)
    ]
    starts_s = experiment.t_s[0], other.t_s[0]
    for here_s, there_s in times:
        if len(here_s) != len(there_s):
            return f"{len(there_s)} samples instead of {len(here_s)}"
        if (
            np.abs((here_s - starts_s[0]) - (there_s - starts_s[1])).max()
            > TIME_TOLERANCE_S
        ):
            return "other times"
    return ""
