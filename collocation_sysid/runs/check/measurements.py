"""What was recorded: how long, how often, and each marker's samples and place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...arrays import Array
from ...recording.experiment import Experiment
from ...statistics.concern import Concern, concerned
from .body import BodyFinding

# Of the mean edge length: beyond this, a marker's place is mostly extrapolation.
FAR = 0.5
# Of the body's diagonal: a marker that starts farther from where the guess puts it is in another
# frame or unit, or on another place.
ASTRAY = 0.5
MOSTLY_MISSING = 0.5


@dataclass(frozen=True)
class MarkerFinding:
    """One marker of a recording.

    Attributes
    ----------
    name : str
    distance_m : float
        From the body, or from the node it was attached to.
    samples, missing : int
    start_miss_m : float or None
        From its first sample to where the simulation at the guess has it then; None without one.
    """

    name: str
    distance_m: float
    samples: int
    missing: int
    start_miss_m: float | None


@dataclass(frozen=True)
class Recording:
    """One experiment's measurements.

    Attributes
    ----------
    air_density_kg_m3 : float
        Of the air around the body in the model; zero in a vacuum.
    """

    experiment: str
    validation: bool
    static: bool
    duration_s: float
    rate_hz: float
    frames: int
    samples: int
    missing: int
    markers: tuple[MarkerFinding, ...]
    instruments: tuple[str, ...]
    air_density_kg_m3: float = 0.0

    @property
    def farthest(self) -> MarkerFinding:
        """The marker farthest from the body."""
        return max(self.markers, key=lambda marker: marker.distance_m)

    @property
    def least_seen(self) -> MarkerFinding:
        """The marker with most samples missing."""
        return max(self.markers, key=lambda marker: marker.missing)


def recording_of(experiment: Experiment, positions_m: Array | None) -> Recording:
    """What an experiment measured.

    Parameters
    ----------
    experiment : Experiment
    positions_m : (T, n, 3) or None
        Its simulation at the guess, at the samples or the first of them.
    """
    markers = experiment.markers
    miss = np.zeros((0, len(markers.names)))
    if positions_m is not None:
        seen_m = markers.positions_m[: len(positions_m)]
        miss = np.linalg.norm(markers.observe(positions_m) - seen_m, axis=2)
    findings, missing = [], markers.missing
    for k, name in enumerate(markers.names):
        seen = np.flatnonzero(markers.present[:, k])
        findings.append(
            MarkerFinding(
                name,
                float(markers.placement.distance_m[k]),
                len(seen),
                int(missing[k]),
                float(miss[seen[0], k]) if len(seen) and seen[0] < len(miss) else None,
            )
        )
    return Recording(
        experiment.name,
        experiment.validation,
        experiment.static,
        experiment.duration_s,
        1 / experiment.timestep_s,
        len(experiment.t_s),
        markers.samples,
        int(missing.sum()),
        tuple(findings),
        (
            *["the wrench"] * bool(experiment.wrenches),
            *(gauge.name for gauge in experiment.readings),
            *(f"{sum(map(len, d.clouds)):,} points of '{d.name}'" for d in experiment.depths),
        ),
        experiment.air_density_kg_m3,
    )


def recording_concerns(recording: Recording, body: BodyFinding) -> list[Concern]:
    """What is wrong with the measurements; the worst marker stands for all."""
    if not recording.markers:
        return []

    def of(marker: MarkerFinding, distance_m: float | None = 0.0) -> dict[str, Any]:
        by_mm, frames = 1e3 * (distance_m or 0.0), recording.frames
        named = {"marker": marker.name, "experiment": recording.experiment}
        return named | {"by_mm": by_mm, "missing": marker.missing, "frames": frames}

    far, lost = recording.farthest, recording.least_seen
    worst = max(recording.markers, key=lambda marker: marker.start_miss_m or 0.0)
    unseen = lost.samples == 0
    missing = not unseen and lost.missing > MOSTLY_MISSING * recording.frames
    astray = (worst.start_miss_m or 0.0) > ASTRAY * body.diagonal_m
    off = far.distance_m > FAR * body.edges_m[1]
    return [
        *concerned(off, False, "markers/off", **of(far, far.distance_m)),
        *concerned(unseen, False, "markers/unseen", **of(lost)),
        *concerned(missing, False, "markers/missing", **of(lost)),
        *concerned(astray, False, "markers/astray", **of(worst, worst.start_miss_m)),
    ]
