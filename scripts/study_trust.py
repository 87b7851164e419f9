"""How often the verdict on an answer is right: faultless twins, and twins with one hidden fault.

Two small bodies, soft and stiffer, moved at random, with white noise and nuisance parameters as
they are by default. Faultless twins are to be called good, at least 95 of 100; of those whose
problem is described wrongly (`wrong_twins`) at most 2 of 100. What is refused before it is solved
counts as recognised.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from functools import cache

import numpy as np
from study_starts import moduli
from twins import random_poses
from wrong_twins import FAULTS

from collocation_sysid import run
from collocation_sysid.errors import InputError, SimulationError
from collocation_sysid.experiment import Experiment, Grasp, Markers
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.plausible import oddities
from collocation_sysid.fem.structured import box_mesh, cylinder_mesh
from collocation_sysid.methods.scan import usual_constants
from collocation_sysid.nlp.parameters import Unknown
from collocation_sysid.nlp.simulation import simulate, with_markers
from collocation_sysid.problem import Problem
from collocation_sysid.problem.recording import refuse_other_scale

SAMPLES, STEP_S, SIGMA_M = 100, 0.01, 1e-3
DAMPING = {"gamma_r_s": 0.01, "gamma_m_1_s": 1.0}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--twins", type=int, default=200, help="faultless ones")
    parser.add_argument("--faulty", type=int, default=9, help="of each fault")
    parser.add_argument("--only", nargs="*", choices=["none", *FAULTS], default=["none", *FAULTS])
    parser.add_argument("--first", type=int, default=0, help="first seed")
    arguments = parser.parse_args()
    total = Counter()
    for name in arguments.only:
        began, counts, reasons = time.perf_counter(), Counter(), Counter()
        count = arguments.twins if name == "none" else arguments.faulty
        for seed in range(arguments.first, arguments.first + count):
            verdict, said = judged(name, seed)
            counts[verdict] += 1
            reasons.update(said[:1])
        total.update(counts if name != "none" else {})
        print(f"{name}: {dict(counts)}, {time.perf_counter() - began:.0f} s", flush=True)
        for reason, often in reasons.most_common(3):
            print(f"  {often} × {reason}", flush=True)
    print(f"with a fault: {dict(total)}")


def judged(fault: str, seed: int) -> tuple[str, tuple[str, ...]]:
    """Verdict and reasons on one twin; "refused" where the problem is not even read or solved."""
    problem = swung(seed)
    try:
        if fault != "none":
            problem = FAULTS[fault](problem, np.random.default_rng((seed, *fault.encode())))
        for body in problem.bodies:
            oddities(body)
        for experiment in problem.experiments:
            refuse_other_scale(experiment, usual_constants(problem.parameters))
        found = run(problem)
    except (InputError, SimulationError) as error:
        return "refused", (str(error),)
    return found.trust.verdict, found.trust.reasons


@cache
def bodies() -> tuple[tuple[Body, float], ...]:
    """Each with its Young's modulus [Pa] where it is soft."""
    cylinder, box = cylinder_mesh(0.04, 0.16, 1, 5), box_mesh((0.04, 0.05, 0.15), (2, 2, 5))
    return (
        (Body(cylinder, density_kg_m3=20.0, damping="rayleigh"), 700.0),
        (Body(box, density_kg_m3=100.0, damping="rayleigh"), 5e3),
    )


def swung(seed: int) -> Problem:
    """A body moved at random, described rightly and guessed wrongly."""
    rng = np.random.default_rng(seed)
    body, young_pa = bodies()[seed % 2]
    truth = moduli(young_pa * (1, 3)[seed // 2 % 2], 0.3) | DAMPING
    t_s = STEP_S * np.arange(SAMPLES)
    nodes, length_m = body.nodes_m, np.ptp(body.nodes_m[:, 2])
    held = np.flatnonzero(nodes[:, 2] < 1e-9)
    outside = np.setdiff1d(
        np.unique(body.mesh.surface), np.flatnonzero(nodes[:, 2] < 0.3 * length_m)
    )
    places = nodes[rng.choice(outside, 8, replace=False)]
    markers = Markers(t_s, np.zeros((SAMPLES, 8, 3)), SIGMA_M, None, places)
    grasp = Grasp(held, random_poses(t_s, rng))
    experiment = Experiment(body, t_s, [grasp], markers, name="swing")
    tracks = simulate(experiment, truth).markers_m
    seen = with_markers(experiment, tracks + rng.normal(scale=SIGMA_M, size=tracks.shape))
    guesses = {name: Unknown(float(value * rng.uniform(0.3, 3))) for name, value in truth.items()}
    return Problem([seen], guesses)


if __name__ == "__main__":
    main()
