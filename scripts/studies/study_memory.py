"""Coverage of the 95 % intervals of viscoelastic materials, for twins with different noise.

A block projects from a hand that swings it and then holds it still. The tracks are simulated with
the scheme of the fit and have white noise. The table has the coverage for each parameter and for
the instantaneous modulus. Before it, the error of the estimates without noise is printed.

    python scripts study_memory --twins 200 --branches 1 2
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache

import numpy as np
from coverage_runner import Intervals, count_coverage, statistical_intervals

from collocation_sysid import (
    Body,
    Collocation,
    Experiment,
    Grasp,
    Markers,
    Nuisance,
    Parameters,
    PoseSequence,
    Problem,
    ReducedSpace,
    Unknown,
    simulate,
    with_markers,
)
from collocation_sysid.fem.meshes.structured import box_mesh

# Edges [m] and numbers of elements of the block.
SIZE_M = (0.1, 0.03, 0.03)
DIVISIONS = (4, 1, 1)
# Standard deviation of each marker coordinate [m].
NOISE_M = 2e-4
# Number and length [s] of the time steps, and duration of the motion [s], after which the hand
# rests.
STEPS = 120
STEP_S = 0.01
MOTION_S = 0.4
TRUTH = {"young_pa": 2e4, "poisson": 0.3, "gamma_r_s": 0.003, "gamma_m_1_s": 0.5}
BRANCHES = (
    {"prony_1.share": 0.4, "prony_1.tau_s": 0.3},
    {"prony_2.share": 0.3, "prony_2.tau_s": 0.03},
)


def main() -> None:
    parser = argparse.ArgumentParser(description="Coverage of intervals with memory.")
    parser.add_argument("--twins", type=int, default=200)
    parser.add_argument("--branches", type=int, nargs="+", choices=(1, 2), default=[1, 2])
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    for branches in arguments.branches:
        print_coverage(branches, arguments.twins, arguments.seed)


def print_coverage(branches: int, twins: int, seed: int) -> None:
    """Print the error of the estimates without noise, then the coverage over twins with noise.

    `branches` is the number of Prony terms, `twins` that of recordings.
    """
    exact_recording = recording(branches)
    parameters = unknowns(branches)
    solution = ReducedSpace()(Collocation([exact_recording], parameters))
    true_values = truth(branches)
    largest_error = max(
        abs(solution.parameters[name] / value - 1) for name, value in true_values.items()
    )
    print(f"{branches} Prony terms; largest relative error without noise {largest_error:.1e}")
    shares = [value for name, value in true_values.items() if name.endswith("share")]
    true_values["instantaneous_young_pa"] = true_values["young_pa"] * (1 + sum(shares))
    rng = np.random.default_rng(seed)

    def noisy_recordings() -> Iterator[tuple[Experiment, Mapping[str, float]]]:
        """Yield the recordings with noise."""
        for _ in range(twins):
            tracks = exact_recording.markers.positions_m
            noise = rng.normal(scale=NOISE_M, size=tracks.shape)
            yield with_markers(exact_recording, tracks + noise), true_values

    def intervals(noisy: Experiment) -> Intervals:
        """Return the intervals of the parameters and of the instantaneous modulus."""
        every = statistical_intervals(Problem([noisy], parameters, substeps=1))
        return {name: every[name] for name in true_values if name in every}

    print(count_coverage(noisy_recordings(), intervals).table(), flush=True)


def truth(branches: int) -> dict[str, float]:
    """Return the true parameters of a material with this number of Prony terms."""
    return TRUTH | {name: v for branch in BRANCHES[:branches] for name, v in branch.items()}


def unknowns(branches: int) -> Parameters:
    """Return all parameters as unknowns, with guesses 10 % above the truth."""
    return Parameters.from_mapping({n: Unknown(guess=1.1 * v) for n, v in truth(branches).items()})


@cache
def recording(branches: int) -> Experiment:
    """Return the recording of the block with exact tracks."""
    names = [f"prony_{k + 1}" for k in range(branches)]
    body = Body(box_mesh(SIZE_M, DIVISIONS), density_kg_m3=200.0, prony=names)
    t_s = np.asarray(STEP_S * np.arange(STEPS + 1), dtype=np.float64)
    motion_time_s = np.minimum(t_s, MOTION_S)
    shift_share = 1 - np.cos(4 * np.pi * motion_time_s / MOTION_S)
    rotation_share = np.sin(np.pi * motion_time_s / (2 * MOTION_S)) ** 2
    half_axis = np.outer(rotation_share, [0.0, 0.6, 0.3])
    quaternions = np.column_stack([half_axis, np.sqrt(1 - np.sum(half_axis**2, axis=1))])
    poses = PoseSequence(t_s, np.outer(shift_share, [0.0, 0.01, 0.015]), quaternions)
    clamped_nodes = np.flatnonzero(body.nodes_m[:, 0] < 1e-9)
    marked_nodes = np.flatnonzero(body.nodes_m[:, 0] > 0.049)
    no_tracks = np.zeros((len(t_s), len(marked_nodes), 3))
    markers = Markers(t_s, no_tracks, NOISE_M, places_m=body.nodes_m[marked_nodes])
    experiment = Experiment(
        body, t_s, [Grasp(clamped_nodes, poses)], markers, name="block", nuisance=Nuisance.none()
    )
    tracks = simulate(experiment, truth(branches), "midpoint", substeps=1).markers_m
    return replace(experiment, markers=with_markers(experiment, tracks).markers)


if __name__ == "__main__":
    main()
