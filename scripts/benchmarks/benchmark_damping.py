"""Time of one sweep of the size of the paper with both damping laws, measured in one run.

A sweep is the cost of one iteration of reduced space: all time steps are evaluated, their blocks
are factorised, and the feasibility step and the sensitivities are computed. The blocks of the
Kelvin–Voigt law are not symmetric. Rounds of both laws alternate; the best times are compared.

    python scripts benchmark_damping
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from benchmark_methods import PAPER_SIZE, PARAMETERS, TRUTH, experiment_of
from benchmark_ogden import timed_sweep

from collocation_sysid import Body, Collocation
from collocation_sysid.fem.meshes.structured import cylinder_mesh

LAWS = ("rayleigh", "kelvin-voigt")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mesh", default=PAPER_SIZE[0], help="rings x layers of the cylinder")
    parser.add_argument("--steps", type=int, default=PAPER_SIZE[1])
    parser.add_argument("--element", default="tet4")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    times_ms = measure(
        arguments.mesh, arguments.steps, arguments.element, arguments.threads, arguments.rounds
    )
    if arguments.json:
        print(json.dumps(times_ms, indent=1))
        return
    for law in LAWS:
        print(f"{law:>13}: " + ", ".join(f"{k} {v:.1f} ms" for k, v in times_ms[law].items()))
    print(f"time of a sweep with kelvin-voigt over that with rayleigh: {times_ms['ratio']:.2f}")


def measure(mesh: str, steps: int, element: str, threads: int, rounds: int) -> dict:
    """Return the best times of each law by part of the sweep [ms], and the ratio of both sweeps.

    The best of all rounds depends least on other work of the machine. For the arguments see the
    options of the command line.
    """
    sweeps = {law: make_sweep(mesh, steps, element, threads, law) for law in LAWS}
    measured_s: dict[str, list[tuple[float, ...]]] = {law: [] for law in LAWS}
    for _ in range(rounds):
        for law in LAWS:
            measured_s[law].append(sweeps[law]())
    names = ("sweep", "evaluation", "linear algebra")
    times_ms: dict = {
        law: {
            name: 1e3 * min(times)
            for name, times in zip(names, zip(*measured_s[law], strict=True), strict=True)
        }
        for law in LAWS
    }
    return times_ms | {"ratio": times_ms[LAWS[1]]["sweep"] / times_ms[LAWS[0]]["sweep"]}


def make_sweep(
    mesh: str, steps: int, element: str, threads: int, law: str
) -> Callable[[], tuple[float, ...]]:
    """Return a function that sweeps over the swung cylinder at the true parameters.

    It returns the times of the sweep, of its evaluations and of its linear algebra [s].
    """
    rings, layers = map(int, mesh.split("x"))
    recording = experiment_of(mesh, steps)
    shape = cylinder_mesh(0.04, 0.16, rings, layers)
    body = Body(shape, density_kg_m3=20.0, element=element, damping=law, threads=threads)
    is_clamped = body.nodes_m[:, 2] < 1e-9
    grasp = replace(recording.grasps[0], nodes=np.flatnonzero(is_clamped))
    experiment = replace(
        recording, body=body, grasps=(grasp,), markers=recording.markers.on_body(body)
    )
    return timed_sweep(Collocation([experiment], PARAMETERS), body.theta_from_values(TRUTH))


if __name__ == "__main__":
    main()
