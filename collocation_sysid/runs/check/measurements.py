"""Check of recordings: duration, rate, and each marker's samples and place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...arrays import Array
from ...recording.experiment import Experiment
from ...statistics.concern import Concern, concerned
from .body import BodyFinding

# Distance of a marker from the body, in mean edges, above which its place is mostly extrapolated.
FAR = 0.5
# Distance of a marker's first sample from the simulation at the guess, in diagonals of the body,
# above which its frame, unit or place is likely wrong.
ASTRAY = 0.5
# Share of missing samples of a marker above which there is a warning.
MOSTLY_MISSING = 0.5


@dataclass(frozen=True)
class MarkerFinding:
    """One marker of a recording.

    Attributes
    ----------
    name : str
    distance_m : float
        Distance from the body, or from the node it was attached to.
    samples, missing : int
        Numbers of samples that are present, and that are missing.
    start_miss_m : float or None
        Distance from its first sample to its position in the simulation at the guess; None without
        one.
    """

    name: str
    distance_m: float
    samples: int
    missing: int
    start_miss_m: float | None


@dataclass(frozen=True)
class Recording:
    """Measurements of one experiment.

    Attributes
    ----------
    experiment : str
    validation, static : bool
    duration_s, rate_hz : float
    frames : int
        Number of sample times.
    samples, missing : int
        Numbers of marker samples that are present, and that are missing.
    markers : tuple of MarkerFinding
    instruments : tuple of str
        Other instruments, in words.
    air_density_kg_m3 : float
        Density of the air around the body in the model; zero in a vacuum.
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
    """Return a summary of the measurements of an experiment.

    Parameters
    ----------
    experiment : Experiment
    positions_m : (T, n, 3) or None
        Its simulation at the guess, at the samples or the first of them.
    """
    markers = experiment.markers
    miss = np.zeros((0, len(markers.names)))
    if positions_m is not None:
        measured_m = markers.positions_m[: len(positions_m)]
        miss = np.linalg.norm(markers.observe(positions_m) - measured_m, axis=2)
    findings = []
    missing = markers.missing
    for k, name in enumerate(markers.names):
        present = np.flatnonzero(markers.present[:, k])
        findings.append(
            MarkerFinding(
                name,
                float(markers.placement.distance_m[k]),
                len(present),
                int(missing[k]),
                float(miss[present[0], k]) if len(present) and present[0] < len(miss) else None,
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
    """Return concerns about the markers of a recording; each names the worst marker only."""
    if not recording.markers:
        return []

    def of(marker: MarkerFinding, distance_m: float | None = 0.0) -> dict[str, Any]:
        by_mm = 1e3 * (distance_m or 0.0)
        frames = recording.frames
        named = {"marker": marker.name, "experiment": recording.experiment}
        return named | {"by_mm": by_mm, "missing": marker.missing, "frames": frames}

    farthest = recording.farthest
    least_seen = recording.least_seen
    worst = max(recording.markers, key=lambda marker: marker.start_miss_m or 0.0)
    unseen = least_seen.samples == 0
    missing = not unseen and least_seen.missing > MOSTLY_MISSING * recording.frames
    astray = (worst.start_miss_m or 0.0) > ASTRAY * body.diagonal_m
    off = farthest.distance_m > FAR * body.edges_m[1]
    return [
        *concerned(off, False, "markers/off", **of(farthest, farthest.distance_m)),
        *concerned(unseen, False, "markers/unseen", **of(least_seen)),
        *concerned(missing, False, "markers/missing", **of(least_seen)),
        *concerned(astray, False, "markers/astray", **of(worst, worst.start_miss_m)),
    ]
