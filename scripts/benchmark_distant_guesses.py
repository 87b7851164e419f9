"""Interior point from distant initial guesses, and from the answer of reduced space.

A soft bar (90 nodes, 91 samples) is clamped at one end and swung. Its nine markers have unknown places, the nuisance
parameters are those that are estimated by default, and the four parameters are guessed wrong by factors of 3, 3, 3.6 and 3.
Prints iterations, processor time and the distance of the answer from that of reduced space, with the default nuisance
parameters and without any.

    python scripts/benchmark_distant_guesses.py                    # the full size
    python scripts/benchmark_distant_guesses.py --nodes 45 --samples 41
    python scripts/benchmark_distant_guesses.py --cases distant warm
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from synthetic import Swing

from collocation_sysid import pipeline
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.structured import box_mesh
from collocation_sysid.model.parameters import Unknown
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Grasp, Markers, Nuisance

TRUTH = {"lambda_pa": 1300.0, "mu_pa": 870.0, "gamma_r_s": 0.01, "gamma_m_1_s": 0.5}
# By how much the initial guesses are wrong.
FACTORS = {"lambda_pa": 1 / 3, "mu_pa": 3.0, "gamma_r_s": 3.6, "gamma_m_1_s": 3.0}
BOUNDS = {
    "lambda_pa": (1.0, 1e6),
    "mu_pa": (1.0, 1e6),
    "gamma_r_s": (1e-5, 1.0),
    "gamma_m_1_s": (1e-3, 100.0),
}
SIZE_M = (0.22, 0.035, 0.05)
DENSITY_KG_M3 = 95.0
STEP_S = 0.01
NOISE_M = 5e-4
MARKERS = 9
SEED = 1


def bar(divisions: tuple[int, int, int], samples: int, *, ideal: bool) -> Problem:
    """Return the soft bar with noisy markers of unknown places and distant guesses.

    Parameters
    ----------
    divisions : tuple of int
        Cells of the mesh along the three edges; (9, 2, 2) has 90 nodes.
    samples : int
        Camera frames, `STEP_S` apart.
    ideal : bool
        Without nuisance parameters; marker places are then those of the simulation.
    """
    body = Body(box_mesh(SIZE_M, divisions), density_kg_m3=DENSITY_KG_M3)
    motion = Swing(
        duration_s=(samples - 1) * STEP_S,
        amplitude_m=(0.03, 0.04, 0.03),
        amplitude_rad=(0.2, 0.3, 0.3),
        frequency_hz=(1.1, 1.4, 1.7),
        rise_s=0.3,
        start=Rotation.identity(),
    )
    poses = motion.poses(STEP_S)
    held = np.flatnonzero(body.nodes_m[:, 0] < 1e-9)
    free = np.flatnonzero(body.nodes_m[:, 0] >= 1e-9)
    random = np.random.default_rng(SEED)
    places_m = body.nodes_m[np.sort(random.choice(free, MARKERS, replace=False))]
    markers = Markers(poses.t_s, np.zeros((samples, MARKERS, 3)), NOISE_M, places_m=places_m)
    experiment = Experiment(body, poses.t_s, [Grasp(held, poses)], markers, name="soft bar")
    tracks = simulate(experiment, TRUTH, timestep_s=STEP_S / 8).markers_m
    tracks = tracks + NOISE_M * random.normal(size=tracks.shape)
    if ideal:
        measured = replace(with_markers(experiment, tracks), nuisance=Nuisance.none())
    else:
        unplaced = Markers(poses.t_s, tracks, NOISE_M, markers.names)
        measured = replace(experiment, markers=unplaced, nuisance=Nuisance())
    guesses = {name: Unknown(value * FACTORS[name], *BOUNDS[name]) for name, value in TRUTH.items()}
    return Problem([measured], guesses, scheme="midpoint")
