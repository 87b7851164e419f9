"""Coverage of the 95 % intervals of E, ρ and ν with a force sensor, for twins with different noise.

A block projects from a hand that swings it. The tracks and the wrench of the hand are simulated
with the scheme of the fit and have white noise of 1 mm and 0.05 N. Without the sensor, the data
determine only the ratio of E to ρ.

    nice -n 15 python scripts study_wrench --twins 200
"""

from __future__ import annotations

import argparse
from functools import cache

import numpy as np
from coverage_runner import Intervals, count_coverage, statistical_intervals

from collocation_sysid import (
    Body,
    Experiment,
    Grasp,
    Markers,
    Nuisance,
    PoseSequence,
    Problem,
    Unknown,
    Wrench,
    simulate,
    with_markers,
)
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.program.simulation import with_wrenches

# Edges [m] and numbers of elements of the block.
SIZE_M = (0.2, 0.06, 0.06)
DIVISIONS = (4, 1, 1)
# Standard deviations of marker coordinates [m], force [N] and torque [N m].
NOISE_M = 1e-3
NOISE_N = 0.05
NOISE_NM = 0.005
# Number and length [s] of the time steps.
STEPS = 60
STEP_S = 0.01
DENSITY = "density_kg_m3"
TRUTH = {"young_pa": 6e4, "poisson": 0.3, "gamma_r_s": 0.004, "gamma_m_1_s": 0.5, DENSITY: 300.0}
# Parameters whose coverage is counted.
COUNTED_NAMES = ("young_pa", "poisson", DENSITY)


def main() -> None:
    parser = argparse.ArgumentParser(description="Coverage of intervals with a force sensor.")
    parser.add_argument("--twins", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    exact_recording = recording()
    rng = np.random.default_rng(arguments.seed)
    twins = ((noisy_recording(exact_recording, rng), TRUTH) for _ in range(arguments.twins))
    print(count_coverage(twins, intervals).table())


def intervals(experiment: Experiment) -> Intervals:
    """Return the intervals of a fit of all parameters, from guesses 10 % above the truth."""
    unknown = {name: Unknown(guess=1.1 * value) for name, value in TRUTH.items()}
    every = statistical_intervals(Problem([experiment], unknown))
    return {name: every[name] for name in COUNTED_NAMES}


def noisy_recording(exact_recording: Experiment, rng: np.random.Generator) -> Experiment:
    """Return the recording with noise on tracks and wrench."""
    tracks = exact_recording.markers.positions_m
    (grasp,) = exact_recording.grasps
    assert grasp.wrench is not None
    deviations = np.repeat([NOISE_N, NOISE_NM], 3)
    wrench = grasp.wrench.values + deviations * rng.normal(size=grasp.wrench.values.shape)
    with_noisy_tracks = with_markers(
        exact_recording, tracks + rng.normal(scale=NOISE_M, size=tracks.shape)
    )
    return with_wrenches(with_noisy_tracks, [wrench])


@cache
def recording() -> Experiment:
    """Return the recording of the block with exact tracks and wrench; cached."""
    body = Body(box_mesh(SIZE_M, DIVISIONS), density_kg_m3=TRUTH[DENSITY])
    t_s = np.asarray(STEP_S * np.arange(STEPS + 1), dtype=np.float64)
    motion_share = 1 - np.cos(2 * np.pi * t_s / 0.3)
    half_axis = np.outer(motion_share, [0.15, 0.1, 0.2])
    quaternions = np.column_stack([half_axis, np.sqrt(1 - np.sum(half_axis**2, axis=1))])
    poses = PoseSequence(t_s, np.outer(motion_share, [0.01, 0.02, 0.03]), quaternions)
    clamped_nodes = np.flatnonzero(body.nodes_m[:, 0] < 1e-9)
    marked_nodes = np.flatnonzero(body.nodes_m[:, 0] > 0.09)
    markers = Markers(
        t_s,
        np.zeros((len(t_s), len(marked_nodes), 3)),
        NOISE_M,
        places_m=body.nodes_m[marked_nodes],
    )
    sensor = Wrench(t_s, np.zeros((len(t_s), 6)), NOISE_N, NOISE_NM, frame="grasp")
    grasp = Grasp(clamped_nodes, poses, sigma_m=0.0, sigma_rad=0.0, wrench=sensor)
    nuisance = Nuisance.none(tare=10.0)
    experiment = Experiment(body, t_s, [grasp], markers, name="block", nuisance=nuisance)
    values = {name: value for name, value in TRUTH.items() if name in body.constants} | {
        name: TRUTH[name] for name in ("young_pa", "poisson")
    }
    simulation = simulate(experiment, values, "midpoint", substeps=1)
    return with_wrenches(with_markers(experiment, simulation.markers_m), simulation.wrenches)


if __name__ == "__main__":
    main()
