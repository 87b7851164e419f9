"""Comparison of measured wrenches with the simulation at the guess.

Use this comparison where no fit to the markers predicts the wrenches. If one gripper swings the
body, the wrench is its weight and inertia, which hardly depend on its stiffness, so that the
simulation at the guess shows a wrong sign, exchanged axes and an offset. It does not show delays,
points or frames, which a wrong stiffness imitates. Loads of a body that is deformed between grasps
or obstacles are proportional to its stiffness, so that nothing is concluded from them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...common.array_types import Array
from ...program.collocation import ExperimentIterate
from ...program.wrench_residual import WrenchResidual
from ...recording.experiment import Experiment
from ...recording.measured_wrench import COMPONENTS, UNITS
from ...statistics.axes import with_other_axes
from ...statistics.hypothesis import Hypothesis

# RMS deviation in standard deviations of the noise below which nothing is tested: guesses err.
SMALLEST_MISFIT = 5.0
# Share of the variance of the measured wrench that a corrected description must explain.
EXPLAINED_SHARE = 0.6
# Largest share that the stated description may explain, relative to the corrected one.
LARGEST_STATED_SHARE = 0.5
# Smallest share of the stated description that counts in the strength of a hypothesis.
SMALLEST_STATED_SHARE = 0.02
# Least additional share for one of many exchanged axes, beside a sign alone.
ONE_OF_MANY_SHARE = 0.1
# Share of the mean square deviation from which on the offset is its largest part.
OFFSET_SHARE = 0.5
# Offset over the standard deviation of the tare's prior from which on it is no usual tare.
LARGEST_TARE = 3.0


@dataclass(frozen=True, eq=False)
class WrenchDeviation:
    """Deviation of one measured wrench from the simulation at the guess."""

    experiment: str
    # (S, 6): wrenches over the standard deviations of the noise; NaN in the same places.
    measured: Array
    simulated: Array
    sigmas: Array  # (6,): standard deviations of the components [N, N m]
    tare: float  # standard deviation of each tare, in standard deviations of the noise
    # Whether the wrench is the weight and inertia of the body, see `has_inertial_wrenches`.
    is_inertial: bool

    @property
    def subject(self) -> str:
        """Beginning of messages about the wrench."""
        return f"the wrench of '{self.experiment}'"

    @property
    def rms_sigmas(self) -> float:
        """RMS deviation over all components, in standard deviations of the noise."""
        return _rms(self.measured - self.simulated)

    @property
    def rms_n(self) -> float:
        """RMS deviation of the components of the force [N]; NaN if no force is measured."""
        difference = (self.measured - self.simulated) * self.sigmas
        return _rms(difference[:, :3])

    @property
    def offset(self) -> Array:
        """(6,) mean of measured minus simulated components [N, N m]; NaN where not measured."""
        return _column_means(self.measured - self.simulated) * self.sigmas

    def note(self) -> str:
        """Return a sentence with the deviation and its mean."""
        mean = ", ".join(
            f"{name} {value:+.3g} {unit}"
            for name, value, unit in zip(COMPONENTS, self.offset, UNITS, strict=True)
            if np.isfinite(value)
        )
        force = f"{self.rms_n:.3g} N RMS, " if np.isfinite(self.rms_n) else ""
        return (
            f"{self.subject} deviates from the simulation at the guess by {force}"
            f"{self.rms_sigmas:.3g} standard deviations of its noise; mean of measured minus "
            f"simulated: {mean}"
        )

    def hypotheses(self) -> list[Hypothesis]:
        """Return a wrong sign or exchanged axes, with which the variation of the wrench agrees, and
        an offset that is the largest part of what remains; empty if the deviation is small, or if
        the wrench depends on the stiffness.
        """
        if self.rms_sigmas < SMALLEST_MISFIT or not self.is_inertial:
            return []
        hypotheses: list[Hypothesis] = []
        corrected = self.measured
        if (other := self._other_axes()) is not None:
            hypothesis, corrected = other
            hypotheses.append(hypothesis)
        return [*hypotheses, *self._offset_hypotheses(corrected)]

    def _other_axes(self) -> tuple[Hypothesis, Array] | None:
        """Return clearly better signs or axes, and the corrected wrench."""
        stated = self._explained_share(self.measured)
        trials = [(Hypothesis("wrench-sign", self.subject), -self.measured, 0.0)]
        for axes, turned in with_other_axes(self.measured, has_sign=False):
            hypothesis = Hypothesis("wrench-axes", self.subject, data={"axes": axes})
            trials.append((hypothesis, turned, ONE_OF_MANY_SHARE))
        shares = [self._explained_share(values) - handicap for _, values, handicap in trials]
        best = int(np.argmax(shares))
        if shares[best] < EXPLAINED_SHARE or stated > LARGEST_STATED_SHARE * shares[best]:
            return None
        strength = shares[best] / max(stated, SMALLEST_STATED_SHARE)
        return replace(trials[best][0], strength=strength), trials[best][1]

    def _explained_share(self, values: Array) -> float:
        """Return the share of variance explained with the best gain ≥ 0."""
        measured = _centred(values)
        simulated = np.where(np.isfinite(measured), _centred(self.simulated), np.nan)
        products = np.nansum(measured * simulated)
        squares = np.nansum(measured**2) * np.nansum(simulated**2)
        return float(products**2 / squares) if products > 0 and squares else 0.0

    def _offset_hypotheses(self, corrected: Array) -> Iterator[Hypothesis]:
        """Yield the offset, if it dominates and exceeds a usual tare."""
        difference = corrected - self.simulated
        if not np.isfinite(difference).any():
            return
        means = _column_means(difference)
        remaining = _rms(difference - means)
        total = _rms(difference)
        largest = float(np.nanmax(np.abs(means)))
        if (
            total < SMALLEST_MISFIT
            or remaining**2 > (1 - OFFSET_SHARE) * total**2
            or largest < LARGEST_TARE * max(self.tare, 1.0)
        ):
            return
        k = int(np.nanargmax(np.abs(means)))
        is_corrected = corrected is not self.measured
        data = {
            "after": ", with sign or axes corrected," if is_corrected else "",
            "component": COMPONENTS[k],
            "offset": f"{means[k] * self.sigmas[k]:+.3g} {UNITS[k]}",
            "deviations": abs(float(means[k])),
            "prior": max(10, int(np.ceil(largest / 10) * 10)),
        }
        yield Hypothesis(
            "wrench-offset",
            self.subject,
            data=data,
            strength=largest / (LARGEST_TARE * max(self.tare, 1.0)),
        )


def wrench_deviations(parts: Sequence[ExperimentIterate]) -> list[WrenchDeviation]:
    """Return the deviations of all wrenches of simulated experiments, without nuisance parameters;
    those without a common sample are left out.

    Parameters
    ----------
    parts : sequence of ExperimentIterate
        Experiments simulated at the guess.
    """
    deviations = []
    for part in parts:
        transcription = part.transcription
        for sensor in transcription.residuals_of(WrenchResidual):
            wrench = sensor.wrench
            motion = part.motion_for(sensor.observable)
            phi = np.zeros(transcription.nuisance.size)
            predicted = sensor.numbers(sensor.predict_motion(motion, phi))
            simulated = np.where(wrench.is_measured, predicted, np.nan)
            measured = np.where(np.isfinite(simulated), wrench.values, np.nan)
            if np.isfinite(measured).any():
                deviations.append(
                    WrenchDeviation(
                        transcription.experiment.name,
                        measured / wrench.value_sigmas,
                        simulated=simulated / wrench.value_sigmas,
                        sigmas=wrench.value_sigmas,
                        tare=transcription.experiment.nuisance.tare or 0.0,
                        is_inertial=has_inertial_wrenches(transcription.experiment),
                    )
                )
    return deviations


def has_inertial_wrenches(experiment: Experiment) -> bool:
    """Return whether the wrenches of an experiment are the weight and inertia of the body: one
    gripper moves it, and neither other grasps, obstacles nor given loads act on it.
    """
    return (
        not experiment.is_static
        and len(experiment.grasps) == 1
        and not experiment.forces
        and not experiment.pressures
    )


def _column_means(values: Array) -> Array:
    """NaN is ignored."""
    is_measured = np.isfinite(values)
    counts = is_measured.sum(axis=0)
    sums = np.nansum(values, axis=0)
    return np.where(counts, sums / np.maximum(counts, 1), np.nan)


def _centred(values: Array) -> Array:
    """NaN is ignored."""
    return values - _column_means(values)


def _rms(values: Array) -> float:
    """NaN is ignored."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else np.nan
