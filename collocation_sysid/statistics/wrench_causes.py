"""Why a measured wrench is missed: what is tried on it, and fits far better, is the likely cause.

The wrench that the model has comes from a fit to the markers alone, which a wrong wrench has not
bent. Tares are allowed for by their priors.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..arrays import Array
from ..errors import InputError, SimulationError
from ..experiment.wrench import Wrench
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution
from ..nlp.channel import Forced
from ..nlp.collocation import Collocation, Part
from ..nlp.wrench import WrenchReading, without_sensors
from .cause import Cause

# Residuals up to so many standard deviations need no cause; what is right leaves so much less.
MISFIT, BETTER = 1.3, 1.5
MOST_SWEEPS = 40
# Clocks may be off by this share of a recording.
LATEST, SHIFTS = 0.25, 60
# What forces, and torques, are written in by mistake.
FORCE_UNITS = {"kilograms-force": 9.80665, "millinewtons": 1e-3, "pounds-force": 4.4482216}
TORQUE_UNITS = {"newton millimetres": 1e-3, "kilogram-force metres": 9.80665}


@dataclass(frozen=True, eq=False)
class _Trial:
    cause: str
    said: str
    wrench: Wrench


def wrench_causes(solution: Solution) -> list[Cause]:
    """What is likely described wrongly of the wrenches; empty where they fit."""
    if not any(map(_missed, solution.collocation.parts(solution.z))):
        return []
    found = []
    for part in _from_markers(solution.collocation):
        forced = part.motion.forced
        for sensor in part.segment.sensors:
            found += _of_sensor(part, sensor, forced)
    return found


def _missed(part: Part) -> bool:
    pairs = zip(part.segment.readings, part.looked, strict=True)
    return any(
        float(np.sum(sensor.residuals(looked, part.phi) ** 2)) > MISFIT**2 * sensor.present.sum()
        for sensor, looked in pairs
        if isinstance(sensor, WrenchReading)
    )


def _from_markers(collocation: Collocation) -> list[Part]:
    """Every experiment with markers where these alone have it; none where that cannot be found."""
    seen = [s for s in collocation.segments if s.experiment.markers.samples]
    if not seen:
        return []
    blind = [without_sensors(segment.experiment) for segment in seen]
    try:
        alone = replace(collocation, experiments=blind)
        solution = ReducedSpace(max_iterations=MOST_SWEEPS)(alone)
    except (InputError, SimulationError):
        return []
    found = []
    pairs = zip(seen, solution.collocation.parts(solution.z), strict=True)
    for segment, part in pairs:
        known = dict(zip(part.segment.nuisance.names, part.phi, strict=True))
        phi = np.array([known.get(name, 0.0) for name in segment.nuisance.names])
        found.append(Part(segment, part.q, phi, part.x))
    return found


def _of_sensor(part: Part, sensor: WrenchReading, forced: Forced) -> list[Cause]:
    tare = part.segment.experiment.nuisance.tare or 0.0
    misfit = _misfit(part, sensor, forced, tare)
    if misfit <= MISFIT:
        return []
    tried = [(trial, trial.wrench, tare) for trial in _trials(sensor.wrench)]
    zeroed = "it seems zeroed with the body in hand: zero it before, or widen nuisance.tare"
    tried.append((_Trial("wrench-tare", zeroed, sensor.wrench), sensor.wrench, np.inf))
    found, name = [], part.segment.experiment.name
    for trial, wrench, allowed in tried:
        left = _misfit(part, sensor.told(wrench), forced, allowed)
        strength = misfit / max(1.0, left)
        if strength > BETTER:
            sentence = f"the wrench of '{name}': {trial.said} ({strength:.2g} times nearer)"
            found.append(Cause(trial.cause, sentence, strength))
    return found


def _misfit(part: Part, sensor: WrenchReading, forced: Forced, tare: float) -> float:
    """RMS of the residuals in standard deviations, tares of so many sigmas allowed for."""
    nuisance = part.segment.nuisance
    read = sensor.of_forced(forced, np.zeros(nuisance.size))
    # Sigmas are those of what is measured, whatever a trial makes of it.
    apart = (read - sensor.wrench.values) / sensor.wrench.sigmas
    there = np.isfinite(apart)
    if not there.any():
        return np.inf
    counts, sums = there.sum(axis=0), np.nansum(apart, axis=0)
    held = 0.0 if np.isinf(tare) else np.inf if not tare else 1 / tare**2
    offsets = sums / np.maximum(counts + held, 1e-12)
    return float(np.sqrt(np.nanmean((apart - offsets) ** 2)))


def _trials(wrench: Wrench) -> Iterator[_Trial]:
    yield _Trial(
        "wrench-sign",
        "all of it fits with the other sign: it is what the body gives the grasp; change its sign",
        replace(wrench, values=-wrench.values),
    )
    other = "grasp" if wrench.frame == "world" else "world"
    yield _Trial(
        "wrench-frame",
        f'it is in the frame of the {other}: set frame = "{other}"',
        replace(wrench, frame=other),
    )
    for units, columns in ((FORCE_UNITS, slice(0, 3)), (TORQUE_UNITS, slice(3, 6))):
        for unit, factor in units.items():
            yield _Trial(
                "wrench-unit",
                f"its {'forces' if columns.start == 0 else 'torques'} seem to be in {unit}: "
                f"multiply by {factor:g}",
                _scaled(wrench, columns, factor),
            )
    span_s = LATEST * float(np.ptp(wrench.t_s))
    for shift_s in np.linspace(-span_s, span_s, SHIFTS + 1):
        when = "later" if shift_s < 0 else "earlier"
        yield _Trial(
            "wrench-clock",
            f"it was measured about {1e3 * abs(shift_s):.2g} ms {when} than its times say: its "
            "clock is not that of the poses",
            replace(wrench, t_s=wrench.t_s + shift_s),
        )


def _scaled(wrench: Wrench, columns: slice, factor: float) -> Wrench:
    values: Array = np.array(wrench.values)
    values[:, columns] *= factor
    if columns.start == 0:
        return replace(wrench, values=values, sigma_n=wrench.sigma_n * max(1.0, factor))
    sigma_nm = None if wrench.sigma_nm is None else wrench.sigma_nm * max(1.0, factor)
    return replace(wrench, values=values, sigma_nm=sigma_nm)
