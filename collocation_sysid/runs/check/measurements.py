"""Check of recordings: duration, rate, and each marker's samples and place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...common.array_types import Array
from ...recording.experiment import Experiment
from ...recording.specimen_files import moduli_of
from ...statistics.concerns import Concern, concern_if
from .body import BodyCheck

# Distance of a marker from the body, in mean edges, above which its place is mostly extrapolated.
LARGEST_DISTANCE_EDGES = 0.5
# Distance of a marker's first sample from the simulation at the guess, in diagonals of the body,
# above which its frame, unit or place is likely wrong.
LARGEST_START_MISS_DIAGONALS = 0.5
# Share of missing samples of a marker above which there is a warning.
LARGEST_MISSING_SHARE = 0.5


@dataclass(frozen=True)
class MarkerCheck:
    """One marker of a recording."""

    name: str
    distance_m: float  # distance from the body, or from the node it was attached to
    # Numbers of samples that are present, and that are missing.
    samples: int
    missing: int
    # Distance from its first sample to its position in the simulation at the guess; None without
    # one.
    start_miss_m: float | None


@dataclass(frozen=True)
class RecordingCheck:
    """Measurements of one experiment."""

    experiment: str
    # Whether it is for validation, and whether it is a series of equilibria.
    validation: bool
    static: bool
    # Duration, and samples per second.
    duration_s: float
    rate_hz: float
    frames: int  # number of sample times
    # Numbers of marker samples that are present, and that are missing.
    samples: int
    missing: int
    markers: tuple[MarkerCheck, ...]  # one for each marker; empty without markers
    instruments: tuple[str, ...]  # other instruments, in words
    # Density of the air around the body in the model; zero in a vacuum.
    air_density_kg_m3: float = 0.0
    test: str = ""  # kind of material test of a specimen without a mesh; "" for other recordings
    # Number of markers without a stated place, which are attached at the point of the body that is
    # nearest to their first sample, so that their distance says nothing about the poses.
    unplaced: int = 0

    @property
    def farthest_marker(self) -> MarkerCheck:
        """Marker farthest from the body; `ValueError` without markers."""
        return max(self.markers, key=lambda marker: marker.distance_m)

    @property
    def most_missing_marker(self) -> MarkerCheck:
        """Marker with most samples missing; `ValueError` without markers."""
        return max(self.markers, key=lambda marker: marker.missing)


def check_recording(experiment: Experiment, positions_m: Array | None) -> RecordingCheck:
    """Return a summary of the measurements of an experiment.

    Parameters
    ----------
    positions_m : (T, n, 3) array or None
        Its node positions in the simulation at the guess [m], at all samples or the first T; None
        without a simulation, and then no `start_miss_m` is known.
    """
    markers = experiment.markers
    miss = np.zeros((0, len(markers.names)))
    if positions_m is not None:
        apart_m = markers.predict_positions(positions_m) - markers.positions_m[: len(positions_m)]
        miss = np.sqrt(np.nansum(apart_m**2, axis=2))
    findings = []
    missing = markers.missing_count
    for k, name in enumerate(markers.names):
        present = np.flatnonzero(markers.is_present[:, k])
        findings.append(
            MarkerCheck(
                name,
                float(markers.placement.distance_m[k]),
                samples=len(present),
                missing=int(missing[k]),
                start_miss_m=float(miss[present[0], k])
                if len(present) and present[0] < len(miss)
                else None,
            )
        )
    moduli = moduli_of(experiment)
    frames = [int(np.isfinite(each).sum()) for each in moduli.values()]
    return RecordingCheck(
        experiment.name,
        experiment.validation,
        static=experiment.is_static,
        duration_s=experiment.duration_s,
        rate_hz=1 / experiment.timestep_s,
        frames=max(frames, default=len(experiment.t_s)),
        samples=markers.sample_count,
        missing=int(missing.sum()),
        markers=tuple(findings),
        instruments=tuple(moduli)
        or tuple(
            dict.fromkeys(filter(None, (each.instrument_text for each in experiment.measurements)))
        ),
        air_density_kg_m3=experiment.air_density_kg_m3,
        test=_specimen_text(experiment),
        unplaced=int((~markers.located).sum()),
    )


def _specimen_text(experiment: Experiment) -> str:
    if experiment.specimen is None:
        return ""
    steady = "harmonic " if experiment.body.memory.oscillates else ""
    return f"{steady}{experiment.specimen.test} specimen"


def recording_concerns(recording: RecordingCheck, body: BodyCheck) -> list[Concern]:
    """Return up to four concerns about the markers of a recording; each names the worst marker
    only. Empty without markers.

    Parameters
    ----------
    body : BodyCheck
        Its body, which gives the scale of distances.
    """
    if not recording.markers:
        return []

    def marker_data(marker: MarkerCheck, distance_m: float | None = 0.0) -> dict[str, Any]:
        return {
            "marker": marker.name,
            "experiment": recording.experiment,
            "by_mm": 1e3 * (distance_m or 0.0),
            "missing": marker.missing,
            "frames": recording.frames,
        }

    farthest = recording.farthest_marker
    most_missing = recording.most_missing_marker
    worst = max(recording.markers, key=lambda marker: marker.start_miss_m or 0.0)
    unseen = most_missing.samples == 0
    missing = not unseen and most_missing.missing > LARGEST_MISSING_SHARE * recording.frames
    astray = (worst.start_miss_m or 0.0) > LARGEST_START_MISS_DIAGONALS * float(
        np.linalg.norm(body.size_m)
    )
    off = farthest.distance_m > LARGEST_DISTANCE_EDGES * body.edges_m[1]
    return [
        *concern_if(off, False, code="markers/off", **marker_data(farthest, farthest.distance_m)),
        *concern_if(unseen, False, code="markers/unseen", **marker_data(most_missing)),
        *concern_if(missing, False, code="markers/missing", **marker_data(most_missing)),
        *concern_if(astray, False, code="markers/astray", **marker_data(worst, worst.start_miss_m)),
    ]
