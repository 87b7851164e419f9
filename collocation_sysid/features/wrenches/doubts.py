"""Misspecification hypotheses for measured wrenches: signs, axes, units, frames, points, clocks.

A measured wrench is compared with the prediction of a fit to the markers alone, which a wrong
wrench cannot distort. Each common mistake is corrected in turn. Tares are allowed for by their
priors. A tool between sensor and body that is estimated has the values of the solve: it often
weighs more than the body, and without it a correct wrench would seem to be wrong by a factor.
Before a solve nothing is known of it, so that its sensor is not compared. Where neither a density
nor a load is known, the predicted wrench is known up to one positive factor, which is estimated in
each comparison.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ...common.array_types import Array
from ...errors import InputError, SimulationError
from ...judge.contradictions import load_sign_hypotheses
from ...judge.doubt import Doubt, accepted
from ...judge.fit import Candidate, TestedFit
from ...judge.sensors import measurement_mistake
from ...judge.source import SimulatedCheck, Source
from ...methods.reduced_space import ReducedSpace
from ...methods.solution import Solution
from ...methods.starts.continuation import first_samples
from ...program.collocation import Collocation, ExperimentIterate
from ...program.markers.residual import MarkerResidual
from ...program.observables import ObservedMotion, ReactionForces
from ...program.transcription import Transcription
from ...program.wrench_residual import WrenchResidual, without_grasp_sensors
from ...recording.experiment import Experiment
from ...recording.measured_wrench import Wrench
from ...recording.nuisance import TOOL_CENTRE, TOOL_MASS
from ...recording.poses import Frame
from ...statistics.axes import with_other_axes
from ...statistics.hypothesis import Hypothesis, rank
from ...statistics.thresholds import BETTER, FITTED, NOISE_LEVEL, ONE_OF_MANY
from .at_guess import wrench_deviations

# Longest fit of the first samples to the markers that needs no request [s].
LONGEST_FIT_S = 10.0
# RMS residual of the markers in standard deviations above which the prediction is useless.
MARKERS_MISFIT = 3.0
# Largest number of sweeps of the fit to the markers, after a solve.
MOST_SWEEPS = 40
# Samples of the fit before a solve.
CHECKED_SAMPLES = 100
# Its largest number of sweeps.
CHECKED_SWEEPS = 15
# Length of its last step of a parameter's logarithm.
CHECKED_TOLERANCE = 1e-2
# Largest clock shift that is tried, over the length of the recording.
LATEST = 0.25
# Number of intervals of the clock shifts that are tried.
SHIFTS = 60
# Nuisance parameters of a tool between sensor and body.
TOOL = (TOOL_MASS, TOOL_CENTRE)
# Columns of the forces.
FORCES = slice(0, 3)
# Columns of the torques.
TORQUES = slice(3, 6)
# Columns of forces and torques.
BOTH = slice(0, 6)
# Wrong units of forces and of torques that are tried, with their factors.
UNITS = (
    (
        "forces",
        {
            "kilograms-force": 9.80665,
            "grams-force": 9.80665e-3,
            "millinewtons": 1e-3,
            "pounds-force": 4.4482216,
        },
        FORCES,
    ),
    ("torques", {"newton millimetres": 1e-3, "kilogram-force metres": 9.80665}, TORQUES),
)
# Prior of a tare that any offset satisfies, in standard deviations of the noise.
FREE_TARE = 1e9
# Offset over the standard deviation of the tare's prior from which on the sensor was not zeroed.
LARGEST_TARE = 3.0
# Error of a calibration that gives no concern.
SAME_GAIN = 0.05
# Error of the reference point that gives no concern [m].
SAME_POINT_M = 0.005


def wrench_candidates(fit: TestedFit) -> Iterator[Candidate]:
    """Yield likely mistakes of the wrenches of a recording with markers that the fit misses, by the
    prediction of a fit to the markers alone.
    """
    transcription = fit.part.transcription
    if not transcription.experiment.markers.sample_count or not _misses(fit.part):
        return
    method = ReducedSpace(max_iterations=MOST_SWEEPS)
    for part in _from_markers(fit.solution.collocation, [transcription], method=method):
        of_markers = _with_tools(part, fit.part)
        for sensor in transcription.residuals_of(WrenchResidual):
            compared = _OneSensor(of_markers, sensor, forced=of_markers.reactions)
            for each in rank(compared.accepted()):
                if (each.remaining or 0.0) < MARKERS_MISFIT:
                    yield each.strength**-2, each


def wrench_mistakes(collocation: Collocation) -> tuple[list[Hypothesis], list[str]]:
    """Return hypotheses about wrongly described wrenches before any solve, and the names of the
    experiments whose markers a fit explains; only these are compared.

    The first samples of the experiments with markers and wrenches are fitted to their markers
    alone. Experiments whose markers that fit does not explain, and those in which a tool is
    estimated, are not compared. The collocation is not modified.
    """
    with_both = [
        s
        for s in collocation.transcriptions
        if s.experiment.wrenches
        and s.experiment.markers.sample_count
        and not len(s.nuisance.indices_of_rows(*TOOL))
    ]
    shorter = [first_samples(s.experiment, CHECKED_SAMPLES) for s in with_both]
    if not shorter:
        return [], []
    beginning = replace(collocation, experiments=shorter)
    method = ReducedSpace(max_iterations=CHECKED_SWEEPS, tolerance=CHECKED_TOLERANCE)
    parts = _from_markers(beginning, beginning.transcriptions, method=method)
    explained = [part for part in parts if _markers_misfit(part) < MARKERS_MISFIT]
    return _of_parts(explained), [part.transcription.experiment.name for part in explained]


def _misses(part: ExperimentIterate) -> bool:
    return any(
        float(np.sum(sensor.residuals(observation, part.phi) ** 2))
        > NOISE_LEVEL**2 * sensor.is_compared.reshape(-1, 6).sum()
        for sensor, observation in part.residuals_of(WrenchResidual)
    )


def _markers_misfit(part: ExperimentIterate) -> float:
    """RMS of the markers' residuals in σ; 0 without samples."""
    ((markers, positions),) = part.residuals_of(MarkerResidual)
    residuals = markers.residuals(positions, part.phi)
    return float(
        np.sqrt(
            np.sum(residuals**2) / max(1, 3 * part.transcription.experiment.markers.sample_count)
        )
    )


def _from_markers(
    collocation: Collocation, transcriptions: Sequence[Transcription], method: ReducedSpace
) -> list[ExperimentIterate]:
    if not transcriptions:
        return []
    without_wrenches = [
        without_grasp_sensors(transcription.experiment) for transcription in transcriptions
    ]
    try:
        solution = method(replace(collocation, experiments=without_wrenches))
    except (InputError, SimulationError):
        return []
    solution.unless_interrupted()
    parts = []
    for transcription, part in zip(transcriptions, solution.parts, strict=True):
        values = dict(zip(part.transcription.nuisance.names, part.phi, strict=True))
        phi = np.array([values.get(name, 0.0) for name in transcription.nuisance.names])
        parts.append(ExperimentIterate(transcription, part.q, phi=phi, x=part.x))
    return parts


def _with_tools(part: ExperimentIterate, estimated: ExperimentIterate) -> ExperimentIterate:
    tools = part.transcription.nuisance.indices_of_rows(*TOOL)
    phi = np.array(part.phi)
    phi[tools] = estimated.phi[tools]
    return replace(part, phi=phi)


def _of_parts(parts: Sequence[ExperimentIterate]) -> list[Hypothesis]:
    hypotheses: list[Hypothesis] = []
    for part in parts:
        forced = part.reactions
        for sensor in part.transcription.residuals_of(WrenchResidual):
            hypotheses += _OneSensor(part, sensor, forced=forced).causes()
    return hypotheses


class _OneSensor:
    """Comparison of one wrench sensor with the prediction from the markers."""

    scale_known: bool

    def __init__(
        self, part: ExperimentIterate, sensor: WrenchResidual, forced: ReactionForces
    ) -> None:
        transcription = part.transcription
        self.part = part
        self.sensor = sensor
        self.motion = ObservedMotion(part.x, forced)
        blind = without_grasp_sensors(transcription.experiment)
        self.scale_known = not transcription.body.mass_derivatives or blind.has_known_force()
        self._known: dict[tuple[bytes, Frame, bytes], Array] = {}
        self.declared = transcription.experiment
        self._place = self.declared.wrenches.index(sensor.wrench)

    def causes(self) -> Iterator[Hypothesis]:
        """Yield what improves the fit far enough, else a large tare."""
        yield from self.accepted() or self._large_tare()

    def accepted(self) -> list[Hypothesis]:
        """Return what improves the fit far enough."""
        if self.misfit(self.declared) <= NOISE_LEVEL:
            return []
        return [*accepted(self._rows(), self.declared, self.misfit, BETTER, 1.0)]

    def _large_tare(self) -> Iterator[Hypothesis]:
        """Yield a mean difference beyond `LARGEST_TARE` σ of the tare's prior."""
        tare = self.declared.nuisance.tare
        if not tare:
            return
        measured, predicted = self._scaled_by_sigma(self._with_tare(None))
        factor = 1.0 if self.scale_known else _slope(measured, predicted)
        differences = measured - factor * predicted
        is_measured = np.isfinite(differences).any(axis=0)
        largest = (
            np.abs(np.nanmean(differences[:, is_measured], axis=0)).max() / tare
            if is_measured.any()
            else 0.0
        )
        if largest > LARGEST_TARE:
            of = f"the wrench of '{self.part.transcription.experiment.name}'"
            yield Hypothesis("wrench-tare", of, strength=float(largest / LARGEST_TARE))

    def _with_tare(self, tare: float | None) -> Experiment:
        return replace(self.declared, nuisance=replace(self.declared.nuisance, tare=tare))

    def misfit(self, trial: Experiment) -> float:
        """Fit the best tares and, if the scale is unknown, a factor that is not negative."""
        measured, predicted = self._scaled_by_sigma(trial)
        if not np.isfinite(measured).any():
            return np.inf
        factor = 1.0 if self.scale_known else max(0.0, _slope(measured, predicted))
        return float(np.sqrt(np.nanmean((measured - factor * predicted) ** 2)))

    def _scaled_by_sigma(self, trial: Experiment) -> tuple[Array, Array]:
        """Return (S, 6) over σ, without what the tare explains; NaN in the same places."""
        wrench = trial.wrenches[self._place]
        sigmas = wrench.sample_sigmas
        predicted = np.where(wrench.is_measured, self._predicted(wrench), np.nan) / sigmas
        measured = np.where(np.isfinite(predicted), wrench.values / sigmas, np.nan)
        tare = trial.nuisance.tare or 0.0
        return _without_tare(measured, tare), _without_tare(predicted, tare)

    def _predicted(self, wrench: Wrench) -> Array:
        """Return the predicted wrench (S, 6) [N, N m] at the times, in the frame and about the
        point of a wrench, with the tool, without tares and delays; cached. NaN where there is no
        prediction.
        """
        at = (wrench.t_s.tobytes(), wrench.frame, wrench.point_m.tobytes())
        if at not in self._known:
            phi = np.zeros(self.part.transcription.nuisance.size)
            tools = self.part.transcription.nuisance.indices_of_rows(*TOOL)
            phi[tools] = self.part.phi[tools]
            predicted = self.sensor.with_wrench(wrench).predict_motion(self.motion, phi)
            self._known[at] = predicted.reshape(-1, 6)
        return self._known[at]

    def _gain(self, columns: slice) -> float:
        """Fit relative to the other columns if the scale is unknown; NaN if there is no factor."""
        measured, predicted = self._scaled_by_sigma(self.declared)
        slope = _slope(measured[:, columns], predicted[:, columns])
        # A common factor cannot be told where the scale is unknown, that of one kind can.
        if not self.scale_known:
            others = np.delete(np.arange(6), np.arange(6)[columns])
            slope /= _slope(measured[:, others], predicted[:, others]) if len(others) else np.nan
        return 1 / slope if slope > 0 else np.nan

    def _point_shift_m(self) -> Array:
        """About a point shifted by d, a torque is smaller by d × f; zero if unknown."""
        measured, predicted = self._scaled_by_sigma(self.declared)
        if not np.isfinite(measured[:, TORQUES]).any():
            return np.zeros(3)
        factor = 1.0
        if (
            not self.scale_known
            and not (factor := _slope(measured[:, FORCES], predicted[:, FORCES])) > 0
        ):
            return np.zeros(3)
        wrench = self.sensor.wrench
        forces = self._predicted(wrench)[:, FORCES]
        by_shift = (
            np.cross(forces[:, None], np.eye(3)[None]) / wrench.sample_sigmas[:, 3, None, None]
        )  # (S, shift, 3)
        by_shift = np.where(np.isfinite(measured[:, None, TORQUES]), by_shift, np.nan)
        slopes = np.stack(
            [_without_tare(by_shift[:, k], self.declared.nuisance.tare or 0.0) for k in range(3)],
            axis=2,
        )
        differences = (measured - factor * predicted)[:, TORQUES]
        is_measured = np.isfinite(differences)
        solution = np.linalg.lstsq(
            factor * slopes[is_measured], differences[is_measured], rcond=1e-6
        )
        shift_m: Array = np.asarray(solution[0], dtype=np.float64)
        return shift_m

    def _rows(self) -> Iterator[Doubt]:
        wrench = self.sensor.wrench
        subject = f"the wrench of '{self.part.transcription.experiment.name}'"

        def mistake(code: str, without: Wrench, handicap: float = 1.0, **data: Any) -> Doubt:
            """Return the row of a sensor that measured `without`; `data` are for the message."""
            row = measurement_mistake(code, wrench, lambda _: without, **data)
            return replace(row, subject=subject, handicap=handicap)

        values = np.array(wrench.values)
        yield mistake("wrench-sign", replace(wrench, values=-values))
        for what, columns in (("forces", FORCES), ("torques", TORQUES)):
            if wrench.measured_components[columns].any():
                yield mistake(
                    "wrench-sign/part", _multiplied(wrench, columns, factor=-1.0), what=what
                )
        other: Frame = "grasp" if wrench.frame == "world" else "world"
        yield mistake("wrench-frame", replace(wrench, frame=other), other=other)
        for axes, turned in with_other_axes(values, has_sign=False):
            without = replace(wrench, values=turned)
            yield mistake("wrench-axes", without, handicap=ONE_OF_MANY, axes=axes)
        for what, units, columns in UNITS:
            for unit, factor in units.items() if wrench.measured_components[columns].any() else ():
                without = _multiplied(wrench, columns, factor=factor)
                yield mistake("wrench-unit", without, what=what, unit=unit, factor=factor)
        for what, columns in (
            ("forces and torques", BOTH),
            ("forces", FORCES),
            ("torques", TORQUES),
        ):
            factor = self._gain(columns)
            known = [
                1.0,
                *(each for _, units, own in UNITS if own == columns for each in units.values()),
            ]
            if factor > 0 and all(abs(factor / each - 1) > SAME_GAIN for each in known):
                data: dict[str, Any] = {"what": what, "factor": factor}
                code = "wrench-gain"
                without = _multiplied(wrench, columns, factor=factor)
                yield mistake(code, without, handicap=FITTED, **data)
        shift_m = self._point_shift_m()
        if np.linalg.norm(shift_m) > SAME_POINT_M:
            point_m = wrench.point_m + shift_m
            data = {
                "by_mm": 1e3 * np.linalg.norm(shift_m),
                "point": str(np.round(point_m, 3).tolist()),
            }
            without = replace(wrench, point_m=point_m)
            yield mistake("wrench-point", without, handicap=FITTED, **data)
        span_s = LATEST * float(np.ptp(wrench.t_s))
        for shift_s in np.linspace(-span_s, span_s, SHIFTS + 1):
            data = {"by_ms": 1e3 * abs(shift_s), "when": "later" if shift_s < 0 else "earlier"}
            yield mistake("wrench-clock", replace(wrench, t_s=wrench.t_s + shift_s), **data)
        yield Doubt.whole("wrench-tare", self._with_tare(FREE_TARE), subject)


def _without_tare(values: Array, tare: float) -> Array:
    """Leave out the offset that a tare of prior `tare` σ explains; NaN is ignored."""
    is_measured = np.isfinite(values)
    prior_weight = 1 / tare**2 if tare else np.inf
    return values - np.nansum(values, axis=0) / np.maximum(
        is_measured.sum(axis=0) + prior_weight, 1e-12
    )


def _slope(measured: Array, predicted: Array) -> float:
    """Return the least-squares factor of the prediction; NaN if it is zero."""
    square = float(np.nansum(predicted**2))
    return float(np.nansum(measured * predicted)) / square if square else np.nan


def _multiplied(wrench: Wrench, columns: slice, factor: float) -> Wrench:
    """Multiply σ of forces or torques, too, if the absolute factor is above 1."""
    values: Array = np.array(wrench.values)
    values[:, columns] *= factor
    larger = max(1.0, abs(factor))
    of_forces = columns.start == 0
    of_torques = columns.stop == 6
    return replace(
        wrench,
        values=values,
        sigma_n=wrench.sigma_n and wrench.sigma_n * (larger if of_forces else 1.0),
        sigma_nm=wrench.sigma_nm and wrench.sigma_nm * (larger if of_torques else 1.0),
    )


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
        each.wrenches and each.markers.sample_count for each in check.problem.experiments
    )
    fit_s = check.fit_s(CHECKED_SAMPLES) if has_both else 0.0
    if has_both and not check.is_full and fit_s > LONGEST_FIT_S:
        notes.append(
            "the wrenches were not compared with the prediction from the markers, which would "
            f"take about {fit_s:.2g} s; check --full does it"
        )
    elif has_both:
        check.report_progress("comparing the wrenches with the prediction from the markers")
        hypotheses, predicted = wrench_mistakes(check.collocation)
        unpredicted -= set(predicted)
        notes += [
            f"no fit explains the markers of '{name}', so that its wrench was compared with the "
            "simulation at the guess alone"
            for name in sorted(unpredicted)
        ]
    for deviation in deviations:
        if deviation.experiment in unpredicted:
            hypotheses += deviation.hypotheses()
    return rank(hypotheses), notes


def fit_hypotheses(solution: Solution) -> Iterator[Hypothesis]:
    """Yield loads of a wrong sign."""
    for transcription in solution.collocation.transcriptions:
        yield from load_sign_hypotheses(transcription.experiment)


WRENCHES = Source(
    simulated=simulated_hypotheses, fitted=fit_hypotheses, candidates=wrench_candidates
)
