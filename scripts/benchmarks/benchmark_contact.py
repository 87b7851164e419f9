"""Time of a forward simulation and a sweep with a tenth of the surface in contact.

A cube of foam is on a foot that moves to and fro, and a plate descends on a part of its top; it is
compared with the same cube without the plate. Rounds of all cases alternate; the best processor
times are compared.

    python scripts benchmark_contact [--divisions 6] [--steps 30] [--rounds 7]
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import numpy as np
from script_arguments import make_parser

import collocation_sysid as cs
from collocation_sysid.model.contact.force import contact_terms
from collocation_sysid.model.dynamics import Dynamics
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.sweep import Sweep

# Edge of the cube [m], and time step [s].
EDGE_M = 0.1
STEP_S = 0.01
SCHEME = "bdf2"
UP = np.array([0.0, 0.0, 1.0])
TRUTH = {"lambda_pa": 2e3, "mu_pa": 3e3, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0}
UNKNOWN = cs.Parameters(tuple(cs.Parameter(n, v, v / 100, v * 100) for n, v in TRUTH.items()))
# Friction coefficient of the plate; None for no plate.
FRICTION_BY_CASE: dict[str, float | None] = {"without": None, "smooth": 0.0, "friction": 0.3}


def pressed_cube(divisions: int, steps: int, friction: float | None) -> cs.Experiment:
    """Return the recording of the cube with a plate of this friction coefficient; None for no
    plate.
    """
    body = cs.Body(cs.box_mesh((EDGE_M,) * 3, (divisions,) * 3), density_kg_m3=30.0, threads=1)
    t_s = STEP_S * np.arange(steps + 1)
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
    sway_share = 1 - np.cos(10 * t_s)
    foot_poses = cs.PoseSequence(t_s, np.outer(0.004 * sway_share, [1.0, 0.0, 0.0]), upright)
    grasps: list[cs.Grasp] = [cs.Grasp(np.flatnonzero(body.nodes_m[:, 2] < 1e-9), foot_poses)]
    if friction is not None:
        plate_poses = cs.PoseSequence(t_s, np.outer(-0.001 - 0.002 * sway_share, UP), upright)
        corners = np.array([(-1.0, -1.0, EDGE_M), (0.6 * EDGE_M, 1.0, 1.0)])
        grasps.append(cs.Obstacle(poses=plate_poses, shape=cs.Cuboid(corners), friction=friction))
    top = np.flatnonzero(body.nodes_m[:, 2] > EDGE_M - 1e-9)
    no_tracks = np.zeros((len(t_s), len(top), 3))
    markers = cs.Markers(t_s, no_tracks, 1e-3, [f"m{k}" for k in top], body.nodes_m[top]).on_body(
        body
    )
    return cs.Experiment(body, t_s, grasps, markers, nuisance=cs.Nuisance.none())


def make_timed_functions(
    divisions: int, steps: int, friction: float | None
) -> dict[str, Callable[[], object]]:
    """Return functions that simulate forward, and that sweep; print the share of the surface in
    contact.
    """
    experiment = pressed_cube(divisions, steps, friction)
    collocation = cs.Collocation([experiment], UNKNOWN, SCHEME)
    (transcription,) = collocation.transcriptions
    dynamics = Dynamics.from_experiment(experiment, SCHEME).with_theta(
        experiment.body.theta_from_values(TRUTH)
    )
    x = simulate_scheme(experiment, dynamics)
    (part,) = collocation.iterates_at(collocation.guess_p, [x])
    for term in contact_terms(experiment):
        area_m2 = term.law_of_contact.surface.area_m2
        no_parameters = np.zeros((0, len(x), term.points.count))
        gap_m = term.law_of_contact.gap_function.evaluate(term.points.vectors(x), no_parameters)[0]
        contact_share = (gap_m < term.law_of_contact.largest_width_m) @ area_m2 / area_m2.sum()
        print(
            f"{100 * contact_share.mean():.0f} % of the surface is in contact, "
            f"friction coefficient {friction}"
        )

    def sweep() -> object:
        return Sweep(transcription).forward(part.x, part.equations)

    return {"forward simulation": partial(simulate_scheme, experiment, dynamics), "sweep": sweep}


def main(divisions: int = 6, steps: int = 30, rounds: int = 7) -> None:
    """Print the best times per step, and their ratios to those without contact."""
    cases = {
        name: make_timed_functions(divisions, steps, friction)
        for name, friction in FRICTION_BY_CASE.items()
    }
    best: dict[tuple[str, str], float] = {}
    for _ in range(rounds):
        for name, functions in cases.items():
            for part, function in functions.items():
                began = time.process_time()
                function()
                spent_s = time.process_time() - began
                best[name, part] = min(spent_s, best.get((name, part), np.inf))
    for (name, part), spent_s in best.items():
        ratio = spent_s / best["without", part]
        print(
            f"{name:>8}, {part}: {1e3 * spent_s / steps:.1f} ms per step, "
            f"{ratio:.2f} times that without contact"
        )


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("--divisions", type=int, default=6, help="elements along an edge")
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--rounds", type=int, default=7)
    options = parser.parse_args()
    main(options.divisions, options.steps, options.rounds)
