"""Coverage of the 95 % intervals of viscoelastic materials, for twins with different noise.

A block projects from a hand that swings it and then holds it still. The tracks are simulated with the
scheme of the fit and have white noise. The table has the coverage for each parameter and for the
instantaneous modulus. Before it, the error of the estimates without noise is printed.

    python scripts/study_memory.py --twins 200 --branches 1 2
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

SIZE_M = (0.1, 0.03, 0.03)
DIVISIONS = (4, 1, 1)
NOISE_M = 2e-4
STEPS = 120
STEP_S = 0.01
MOVED_S = 0.4
TRUTH = {
    "young_pa": 2e4,
    "poisson": 0.3,
    "gamma_r_s": 0.003,
    "gamma_m_1_s": 0.5,
}
BRANCHES = (
    {"prony_1.share": 0.4, "prony_1.tau_s": 0.3},
    {"prony_2.share": 0.3, "prony_2.tau_s": 0.03},
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description="Coverage of intervals with memory."
    )
    parser.add_argument("--twins", type=int, default=200)
    parser.add_argument(
        "--branches", type=int, nargs="+", choices=(1, 2), default=[1, 2]
    )
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    for branches in arguments.branches:
        report(branches, arguments.twins, arguments.seed)


def report(branches: int, twins: int, seed: int) -> None:
    """Find the truth without noise, then count."""
    exact = recording(branches)
    parameters = unknowns(branches)
    solution = ReducedSpace()(Collocation([exact], parameters))
    true = truth(branches)
    worst = max(
        abs(solution.parameters[name] / value - 1)
        for name, value in true.items()
    )
    print(
        f"{branches} branches; without noise all parameters are right to {worst:.1e}"
    )
    rng = np.random.default_rng(seed)
    at_once = true["young_pa"] * (
        1 + sum(v for n, v in true.items() if n.endswith("share"))
    )
    true |= {"instantaneous_young_pa": at_once}
    held = {name: 0 for name in true}
    wide = dict.fromkeys(true, 0)
    for _ in range(twins):
        tracks = exact.markers.positions_m
        noisy = with_markers(
            exact, tracks + rng.normal(scale=NOISE_M, size=tracks.shape)
        )
        collocation = Collocation([noisy], parameters)
        found = ReducedSpace()(collocation)
        fit = linearise_fit(collocation, found.z)
        uncertainty = uncertainty_from_fit(fit, parameters, found.q)
        for name, estimate in {
            **uncertainty.estimates,
            **uncertainty.derived,
        }.items():
            if name in true and estimate.statistical95 is not None:
                held[name] += (
                    estimate.statistical95[0]
                    <= true[name]
                    <= estimate.statistical95[1]
                )
                wide[name] += 1
    low, high = binom.interval(0.95, twins, 0.95)
    print(
        f"  {twins} twins; by chance {100 * low / twins:.1f} to {100 * high / twins:.1f} %"
    )
    for name, count in held.items():
        share = 100 * count / max(1, wide[name])
        print(
            f"  {name:24}{share:6.1f} % of {wide[name]} intervals", flush=True
        )


def truth(branches: int) -> dict[str, float]:
    """All parameters with so many branches."""
    return TRUTH | {
        name: v for branch in BRANCHES[:branches] for name, v in branch.items()
    }


def unknowns(branches: int) -> Parameters:
    """All to be estimated, from guesses near the truth."""
    return Parameters.from_mapping(
        {n: Unknown(guess=1.1 * v) for n, v in truth(branches).items()}
    )


@cache
def recording(branches: int) -> Experiment:
    """The block with the tracks that the truth gives it."""
    names = [f"prony_{k + 1}" for k in range(branches)]
    body = Body(box_mesh(SIZE_M, DIVISIONS), density_kg_m3=200.0, prony=names)
    t_s = np.asarray(STEP_S * np.arange(STEPS + 1), dtype=np.float64)
    moving = np.minimum(t_s, MOVED_S)
    share = 1 - np.cos(4 * np.pi * moving / MOVED_S)
    turn = np.sin(np.pi * moving / (2 * MOVED_S)) ** 2
    half = np.outer(turn, [0.0, 0.6, 0.3])
    quaternions = np.column_stack([half, np.sqrt(1 - np.sum(half**2, axis=1))])
    poses = PoseSequence(t_s, np.outer(share, [0.0, 0.01, 0.015]), quaternions)
    held = np.flatnonzero(body.nodes_m[:, 0] < 1e-9)
    seen = np.flatnonzero(body.nodes_m[:, 0] > 0.049)
    nowhere = np.zeros((len(t_s), len(seen), 3))
    markers = Markers(t_s, nowhere, NOISE_M, places_m=body.nodes_m[seen])
    experiment = Experiment(
        body,
        t_s,
        [Grasp(held, poses)],
        markers,
        name="block",
        nuisance=Nuisance.none(),
    )
    tracks = simulate(
        experiment, truth(branches), "midpoint", substeps=1
    ).markers_m
    return replace(experiment, markers=with_markers(experiment, tracks).markers)


if __name__ == "__main__":
    main()
