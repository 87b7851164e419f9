"""Coverage of the 95 % intervals of viscoelastic materials, for twins with different noise.

A block projects from a hand that swings it and then holds it still. The tracks are simulated with
the scheme of the fit and have white noise. The table has the coverage for each parameter and for
the instantaneous modulus. Before it, the error of the estimates without noise is printed.

    python scripts study_memory --twins 200 --branches 1 2
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import cache

import numpy as np
from scipy.stats import binom

from collocation_sysid import (
    Body,
    Collocation,
    Experiment,
    Grasp,
    Markers,
    Nuisance,
    Parameters,
    PoseSequence,
    ReducedSpace,
    Unknown,
    simulate,
    with_markers,
)
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.uncertainty import uncertainty_from_fit

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
    rng = np.random.default_rng(seed)
    instantaneous_pa = true_values["young_pa"] * (
        1 + sum(v for n, v in true_values.items() if n.endswith("share"))
    )
    true_values |= {"instantaneous_young_pa": instantaneous_pa}
    contains_truth = {name: 0 for name in true_values}
    intervals = dict.fromkeys(true_values, 0)
    for _ in range(twins):
        tracks = exact_recording.markers.positions_m
        noisy = with_markers(exact_recording, tracks + rng.normal(scale=NOISE_M, size=tracks.shape))
        collocation = Collocation([noisy], parameters)
        answer = ReducedSpace()(collocation)
        fit = linearise_fit(collocation, answer.z)
        uncertainty = uncertainty_from_fit(fit, parameters, answer.q)
        for name, estimate in {**uncertainty.estimates, **uncertainty.derived}.items():
            if name in true_values and estimate.statistical95 is not None:
                contains_truth[name] += (
                    estimate.statistical95[0] <= true_values[name] <= estimate.statistical95[1]
                )
                intervals[name] += 1
    low, high = binom.interval(0.95, twins, 0.95)
    print(
        f"  {twins} twins; the coverage of exact intervals is {100 * low / twins:.1f} to "
        f"{100 * high / twins:.1f} % with a probability of 95 %"
    )
    for name, count in contains_truth.items():
        share = 100 * count / max(1, intervals[name])
        print(f"  {name:24} coverage {share:6.1f} % of {intervals[name]} intervals", flush=True)


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
