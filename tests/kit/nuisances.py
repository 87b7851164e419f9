"""Experiments whose markers are simulated with given nuisance parameters."""

from __future__ import annotations

import numpy as np

from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment
from kit.problems import GUESS, TRUTH


def alone(experiment: Experiment, **options) -> Collocation:
    return Collocation([experiment], GUESS, **options)


def readings(experiment: Experiment, phi: np.ndarray) -> np.ndarray:
    """What the markers read at the truth with φ; the scheme's own trajectory."""
    collocation = alone(experiment)
    followed, p = collocation.follow_estimates(np.append(GUESS.guess_q, phi))
    (transcription,) = followed.transcriptions
    motion = simulate(transcription.corrected_experiment(phi), TRUTH, "midpoint", substeps=1)
    return transcription.markers.predict_samples(motion.sampled, p[followed.nq :])


def seen_with(experiment: Experiment, phi: np.ndarray) -> Experiment:
    tracks = readings(experiment, phi)
    present = experiment.markers.is_present[:, :, None]
    return with_markers(experiment, np.where(present, tracks, np.nan))
