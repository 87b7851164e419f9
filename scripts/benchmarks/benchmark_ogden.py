"""Time of sweeps with materials in powers of the stretches over that with neo-Hookean material.

A sweep is the cost of one iteration of reduced space: all time steps are evaluated, their blocks
are factorised, and the feasibility step and the sensitivities are computed. Rounds of all materials
alternate; the ratios of the best times are printed.

    python scripts benchmark_ogden
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from benchmark_methods import PAPER_SIZE, experiment_of

from collocation_sysid import Body, Collocation, Parameters, Unknown
from collocation_sysid.common.array_types import Array
from collocation_sysid.fem.meshes.structured import cylinder_mesh
from collocation_sysid.model.dynamics import Dynamics
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.stopwatch import Stopwatch
from collocation_sysid.program.sweep import Sweep

REFERENCE = "neo-hookean"
# Constants of one small-strain stiffness: G = 300 Pa, κ = 400 Pa.
LAME = {"lambda_pa": 200.0, "mu_pa": 300.0}
BULK = {"kappa_pa": 400.0}
ONE_TERM = {"mu_1_pa": 200.0, "alpha_1": 3.0}
TWO_TERMS = {"mu_1_pa": 160.0, "alpha_1": 2.5, "mu_2_pa": -100.0, "alpha_2": -2.0}
THREE_TERMS = {
    "mu_1_pa": 300.0,
    "alpha_1": 1.3,
    "mu_2_pa": 18.0,
    "alpha_2": 5.0,
    "mu_3_pa": -60.0,
    "alpha_3": -2.0,
}
FOAM = {"mu_1_pa": 300.0, "alpha_1": 4.0, "beta_1": 1 / 3}
MATERIALS = {
    REFERENCE: LAME,
    "mooney-rivlin": {"c10_pa": 110.0, "c01_pa": 40.0, **BULK},
    "ogden-1": {**ONE_TERM, **BULK},
    "ogden-2": {**TWO_TERMS, **BULK},
    "ogden-3": {**THREE_TERMS, **BULK},
    "hyperfoam-1": FOAM,
}
DAMPING = {"gamma_r_s": 0.009, "gamma_m_1_s": 1.0}


def main() -> None:
    """Parse the arguments and print the ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mesh", default=PAPER_SIZE[0], help="rings x layers of the cylinder")
    parser.add_argument("--steps", type=int, default=PAPER_SIZE[1])
    parser.add_argument("--damping", default="kelvin-voigt")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    ratios = measure(arguments)
    if arguments.json:
        print(json.dumps(ratios, indent=1))
        return
    for material, values in ratios.items():
        text = ", ".join(f"{name} {value:.2f}" for name, value in values.items())
        print(f"{material:>13}: {text} times {REFERENCE}")


def measure(arguments: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Return the best times of each material over those of the reference, by part of a sweep."""
    sweeps = {material: make_sweep(material, arguments) for material in MATERIALS}
    part_names = ("sweep", "evaluation", "linear algebra")
    best = {material: np.full(len(part_names), np.inf) for material in MATERIALS}
    for _ in range(arguments.rounds):
        for material, sweep in sweeps.items():
            best[material] = np.minimum(best[material], sweep())
    return {
        material: dict(zip(part_names, (times / best[REFERENCE]).tolist(), strict=True))
        for material, times in best.items()
    }


def make_sweep(material: str, arguments: argparse.Namespace) -> Callable[[], tuple[float, ...]]:
    """Return a function that sweeps over the swung cylinder, and returns times [s].

    All constants are estimated, so that their sensitivities are part of the sweep.
    """
    rings, layers = map(int, arguments.mesh.split("x"))
    recording = experiment_of(arguments.mesh, arguments.steps)
    body = Body(
        cylinder_mesh(0.04, 0.16, rings, layers),
        material,
        density_kg_m3=20.0,
        damping=arguments.damping,
        threads=arguments.threads,
    )
    clamped_nodes = np.flatnonzero(body.nodes_m[:, 2] < 1e-9)
    grasp = replace(recording.grasps[0], nodes=clamped_nodes)
    markers = recording.markers.on_body(body)
    experiment = replace(recording, body=body, grasps=(grasp,), markers=markers)
    values = {**MATERIALS[material], **DAMPING}
    unknowns = {
        name: Unknown(value, scale="linear" if value < 0 else None, typical=abs(value))
        for name, value in values.items()
    }
    collocation = Collocation([experiment], Parameters.from_mapping(unknowns))
    return timed_sweep(collocation, body.theta_from_values(values))


def timed_sweep(collocation: Collocation, theta: Array) -> Callable[[], tuple[float, ...]]:
    """Return a function that sweeps over the motion of the only experiment at θ, and returns times
    [s].
    """
    (transcription,) = collocation.transcriptions
    experiment = transcription.experiment
    dynamics = Dynamics.from_experiment(experiment, "midpoint").with_theta(theta)
    (part,) = collocation.iterates_at(collocation.guess_p, [simulate_scheme(experiment, dynamics)])

    def sweep() -> tuple[float, ...]:
        """Return the times of a sweep, of its evaluations and of its linear algebra [s]."""
        watch = Stopwatch()
        began = time.perf_counter()
        Sweep(transcription, stopwatch=watch).forward(part.x, part.equations)
        return (time.perf_counter() - began, watch.evaluations, watch.linear_algebra)

    sweep()
    return sweep


if __name__ == "__main__":
    main()
