"""Time one sweep of the paper's size under both damping laws, side by side in one run.

A sweep is what an iteration of reduced space costs: all timesteps evaluated, their blocks
factorised, the feasibility step and the sensitivities solved for. Kelvin and Voigt's blocks are not
symmetric. Rounds of both laws alternate; the best times are compared.

    python scripts/benchmark_damping.py
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from benchmark_methods import PAPER_SIZE, PARAMETERS, TRUTH, experiment_of

from collocation_sysid import Body, Collocation
from collocation_sysid.fem.meshes.structured import cylinder_mesh
from collocation_sysid.model.dynamics import Dynamics
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.stopwatch import Stopwatch
from collocation_sysid.program.sweep import Sweep

LAWS = ("rayleigh", "kelvin-voigt")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--mesh", default=PAPER_SIZE[0], help="rings x layers of the cylinder"
    )
    parser.add_argument("--steps", type=int, default=PAPER_SIZE[1])
    parser.add_argument("--element", default="tet4")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    found = measure(
        given.mesh, given.steps, given.element, given.threads, given.rounds
    )
    if given.json:
        print(json.dumps(found, indent=1))
        return
    for law in LAWS:
        print(
            f"{law:>13}: "
            + ", ".join(f"{k} {v:.1f} ms" for k, v in found[law].items())
        )
    print(
        f"a sweep of kelvin-voigt takes {found['ratio']:.2f} of one of rayleigh"
    )


def measure(
    mesh: str, steps: int, element: str, threads: int, rounds: int
) -> dict:
    """Best times in milliseconds, which a busy machine disturbs least, and the sweeps' ratio."""
    sweeps = {law: sweep_of(mesh, steps, element, threads, law) for law in LAWS}
    taken: dict[str, list[tuple[float, ...]]] = {law: [] for law in LAWS}
    for _ in range(rounds):
        for law in LAWS:
            taken[law].append(sweeps[law]())
    names = ("sweep", "evaluation", "linear algebra")
    found: dict = {
        law: {
            name: 1e3 * min(times)
            for name, times in zip(
                names, zip(*taken[law], strict=True), strict=True
            )
        }
        for law in LAWS
    }
    return found | {"ratio": found[LAWS[1]]["sweep"] / found[LAWS[0]]["sweep"]}


def sweep_of(
    mesh: str, steps: int, element: str, threads: int, law: str
) -> Callable[[], tuple[float, ...]]:
    """A sweep of the swung cylinder, at the truth."""
    rings, layers = map(int, mesh.split("x"))
    made = experiment_of(mesh, steps)
    shape = cylinder_mesh(0.04, 0.16, rings, layers)
    body = Body(
        shape, density_kg_m3=20.0, element=element, damping=law, threads=threads
    )
    held = body.nodes_m[:, 2] < 1e-9
    grasp = replace(made.grasps[0], nodes=np.flatnonzero(held))
    experiment = replace(
        made, body=body, grasps=(grasp,), markers=made.markers.on_body(body)
    )
    collocation = Collocation([experiment], PARAMETERS)
    (segment,) = collocation.transcriptions
    x = simulate_scheme(
        experiment,
        Dynamics.from_experiment(experiment, "midpoint").with_theta(
            body.theta_from_values(TRUTH)
        ),
    )
    (part,) = collocation.iterates_at(collocation.guess_p, [x])

    def sweep() -> tuple[float, ...]:
        watch = Stopwatch()
        began = time.perf_counter()
        Sweep(segment, stopwatch=watch).forward(part.x, part.equations)
        return (
            time.perf_counter() - began,
            watch.evaluations,
            watch.linear_algebra,
        )

    sweep()
    return sweep


if __name__ == "__main__":
    main()
