"""Why a measured wrench is missed: what is tried on it, and fits far better, is the likely cause.

The wrench that the model has comes from a fit to the markers alone, which a wrong wrench has not
bent. Tares are allowed for by their priors.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..errors import InputError, SimulationError
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution
from ..program.channel import Forced
from ..program.collocation import Collocation, Part
from ..program.wrench import WrenchReading, without_sensors
from ..recording.wrench import Frame, Wrench
from .hypothesis import Hypothesis, Trial

# Residuals up to so many standard deviations need no cause; what is right leaves so much less.
MISFIT, BETTER = 1.3, 1.5
MOST_SWEEPS = 40
# Clocks may be off by this share of a recording.
LATEST, SHIFTS = 0.25, 60
# What forces, and torques, are written in by mistake.
UNITS = (
    (
        "forces",
        {"kilograms-force": 9.80665, "millinewtons": 1e-3, "pounds-force": 4.4482216},
        slice(0, 3),
    ),
    ("torques", {"newton millimetres": 1e-3, "kilogram-force metres": 9.80665}, slice(3, 6)),
)


def wrench_causes(solution: Solution) -> list[Hypothesis]:
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


def _of_sensor(part: Part, sensor: WrenchReading, forced: Forced) -> Iterator[Hypothesis]:
    def left(without: tuple[Wrench, float]) -> float:
        return _misfit(part, sensor.told(without[0]), forced, without[1])

    tare = part.segment.experiment.nuisance.tare or 0.0
    misfit, of = left((sensor.wrench, tare)), f"the wrench of '{part.segment.experiment.name}'"
    if misfit > MISFIT:
        yield from Trial(misfit, left, BETTER, least=1.0).of(_mistakes(of, sensor.wrench, tare))


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


def _mistakes(of: str, wrench: Wrench, tare: float) -> Iterator[Hypothesis]:
    """Each undone: the wrench, and how many sigmas its tare may have."""
    opposite = replace(wrench, values=-wrench.values)
    yield Hypothesis("wrench-sign", of, without=(opposite, tare))
    other: Frame = "grasp" if wrench.frame == "world" else "world"
    turned = replace(wrench, frame=other)
    yield Hypothesis("wrench-frame", of, {"other": other}, (turned, tare))
    for what, units, columns in UNITS:
        for unit, factor in units.items():
            data = {"what": what, "unit": unit, "factor": factor}
            yield Hypothesis("wrench-unit", of, data, (_scaled(wrench, columns, factor), tare))
    span_s = LATEST * float(np.ptp(wrench.t_s))
    for shift_s in np.linspace(-span_s, span_s, SHIFTS + 1):
        data = {"by_ms": 1e3 * abs(shift_s), "when": "later" if shift_s < 0 else "earlier"}
        shifted = replace(wrench, t_s=wrench.t_s + shift_s)
        yield Hypothesis("wrench-clock", of, data, (shifted, tare))
    yield Hypothesis("wrench-tare", of, without=(wrench, np.inf))


def _scaled(wrench: Wrench, columns: slice, factor: float) -> Wrench:
    """With components in another unit, and their noise, which is no smaller than stated."""
    values: Array = np.array(wrench.values)
    values[:, columns] *= factor
    sigma = "sigma_n" if columns.start == 0 else "sigma_nm"
    stated = getattr(wrench, sigma)
    larger = None if stated is None else stated * max(1.0, factor)
    return replace(wrench, values=values, **{sigma: larger})
