"""Time a forward simulation and a sweep with a tenth of the surface in contact.

A cube of foam on a swaying foot and a plate that comes down upon a part of its top, against the
same cube without the plate. Rounds alternate, times are of the processor, the best are compared.

    python scripts/benchmark_contact.py [divisions] [steps] [rounds]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np

import collocation_sysid as cs
from collocation_sysid.model.contact.contact_force import contact_terms
from collocation_sysid.model.dynamics import Dynamics
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.sweep import Sweep

EDGE_M = 0.1
STEP_S = 0.01
SCHEME = "bdf2"
UP = np.array([0.0, 0.0, 1.0])
TRUTH = {"lambda_pa": 2e3, "mu_pa": 3e3, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0}
UNKNOWN = cs.Parameters(
    tuple(cs.Parameter(n, v, v / 100, v * 100) for n, v in TRUTH.items())
)
CASES: dict[str, float | None] = {
    "without": None,
    "smooth": 0.0,
    "rubbing": 0.3,
}


def pressed(
    divisions: int, steps: int, friction: float | None
) -> cs.Experiment:
    """A cube with a plate that has so much friction, or none."""
    body = cs.Body(
        cs.box_mesh((EDGE_M,) * 3, (divisions,) * 3),
        density_kg_m3=30.0,
        threads=1,
    )
    t_s = STEP_S * np.arange(steps + 1)
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
    sway = 1 - np.cos(10 * t_s)
    foot = cs.PoseSequence(t_s, np.outer(0.004 * sway, [1.0, 0.0, 0.0]), still)
    grasps: list[cs.Grasp] = [
        cs.Grasp(np.flatnonzero(body.nodes_m[:, 2] < 1e-9), foot)
    ]
    if friction is not None:
        down = cs.PoseSequence(t_s, np.outer(-0.001 - 0.002 * sway, UP), still)
        corners = np.array([(-1.0, -1.0, EDGE_M), (0.6 * EDGE_M, 1.0, 1.0)])
        grasps.append(
            cs.Obstacle(poses=down, shape=cs.Cuboid(corners), friction=friction)
        )
    top = np.flatnonzero(body.nodes_m[:, 2] > EDGE_M - 1e-9)
    nowhere = np.zeros((len(t_s), len(top), 3))
    markers = cs.Markers(
        t_s, nowhere, 1e-3, [f"m{k}" for k in top], body.nodes_m[top]
    ).on_body(body)
    return cs.Experiment(
        body, t_s, grasps, markers, nuisance=cs.Nuisance.none()
    )


def prepared(
    divisions: int, steps: int, friction: float | None
) -> dict[str, Callable[[], object]]:
    """A forward simulation, and a sweep along it; what touches is printed."""
    experiment = pressed(divisions, steps, friction)
    collocation = cs.Collocation([experiment], UNKNOWN, SCHEME)
    (segment,) = collocation.transcriptions
    dynamics = Dynamics.from_experiment(experiment, SCHEME).with_theta(
        experiment.body.theta_from_values(TRUTH)
    )
    x = simulate_scheme(experiment, dynamics)
    (part,) = collocation.iterates_at(collocation.guess_p, [x])
    for term in contact_terms(experiment):
        area_m2 = term.law_of_contact.surface.area_m2
        nothing = np.zeros((0, len(x), term.points.count))
        gap_m = term.law_of_contact.gap_function.evaluate(
            term.points.vectors(x), nothing
        )[0]
        touched = (
            (gap_m < term.law_of_contact.largest_width_m)
            @ area_m2
            / area_m2.sum()
        )
        print(
            f"{100 * touched.mean():.0f} % of the surface is in contact, at friction {friction}"
        )
    return {
        "forward simulation": lambda: simulate_scheme(experiment, dynamics),
        "sweep": lambda: Sweep(segment).forward(part.x, part.equations),
    }


def main(divisions: int = 6, steps: int = 30, rounds: int = 7) -> None:
    """Print best times and their ratios."""
    cases = {
        name: prepared(divisions, steps, friction)
        for name, friction in CASES.items()
    }
    best: dict[tuple[str, str], float] = {}
    for _ in range(rounds):
        for name, works in cases.items():
            for what, work in works.items():
                began = time.process_time()
                work()
                spent_s = time.process_time() - began
                best[name, what] = min(spent_s, best.get((name, what), np.inf))
    for (name, what), spent_s in best.items():
        ratio = spent_s / best["without", what]
        print(
            f"{name:>8}, {what}: {1e3 * spent_s / steps:.1f} ms a step, {ratio:.2f} times"
        )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
