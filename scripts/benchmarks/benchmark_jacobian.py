"""Time of the assembled derivatives of the nonlinear program, by evaluator.

The values of the final sparse matrix are computed for the size of the paper (about 176 nodes × 100
steps). The
baseline is the same expressions through `casadi.Function.map`; the paper quotes 57 ms (minimum)
and 82 ms (median) for its Jacobian on its own machine.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from script_arguments import make_parser

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.kernels import available_threads
from collocation_sysid.problem import Problem
from collocation_sysid.program.collocation import Collocation

PROBLEM = Path(__file__).parents[2] / "problems" / "table1" / "problem.toml"
# Smallest time that the paper states for the Jacobian [ms].
PAPER_JACOBIAN_MS = 57.0


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--repeats", type=int, default=21)
    measure(parser.parse_args().repeats)


def measure(repeats: int) -> None:
    """Print the median times of Jacobian and Hessian by evaluator [ms]; evaluators alternate in one
    run.
    """
    problem = Problem.read(PROBLEM)
    threads = max(2, available_threads())
    evaluators = {"simd_1_ms": ("simd", 1), f"simd_{threads}_ms": ("simd", threads)}
    evaluators["casadi_map_ms"] = ("casadi", 1)
    collocations: dict[str, Collocation] = {}
    for evaluator_name, (evaluator, thread_count) in evaluators.items():
        body = Body(
            problem.bodies[0].mesh,
            density_kg_m3=problem.bodies[0].mass_kg / problem.bodies[0].mesh.volume_m3,
            damping="rayleigh",
            evaluator=evaluator,
            threads=thread_count,
        )
        experiments = [replace(e, body=body) for e in problem.experiments]
        collocations[evaluator_name] = Collocation(
            experiments, problem.parameters, "backward-euler"
        )
    first = collocations["simd_1_ms"]
    rng = np.random.default_rng(0)
    rest_positions_m = [s.experiment.rigid_positions(s.dynamics.t_s) for s in first.transcriptions]
    z = first.pack(first.parameters.guess_q, rest_positions_m)
    z[first.nq :] += 1e-3 * rng.normal(size=len(z) - first.nq)
    multipliers = rng.normal(size=first.constraint_count)
    jacobian = np.empty(len(first.jacobian_structure[1]))
    hessian = np.empty(len(first.hessian_structure[1]))

    def residual_and_jacobian(collocation: Collocation) -> None:
        collocation.constraints_and_jacobian(z, jacobian)

    def lagrangian(collocation: Collocation) -> None:
        collocation.hessian_values(z, 1.0, multipliers, hessian)

    steps = sum(s.grid_times for s in first.transcriptions)
    print(f"{len(problem.bodies[0].nodes_m)} nodes, {steps} steps, backward Euler; medians")
    for name, evaluate, values in (
        ("Jacobian", residual_and_jacobian, jacobian),
        ("Hessian", lagrangian, hessian),
    ):
        print(f"\n{name}, {len(values):,} nonzeros in the final sparse matrix")
        times_ms = _median_times_ms(collocations, evaluate, repeats)
        for evaluator_name, time_ms in times_ms.items():
            ratio = times_ms["casadi_map_ms"] / time_ms
            print(f"  {evaluator_name[:-3]:12s} {time_ms:8.1f} ms   {ratio:6.1f} × Function.map")
    print(f"\nThe paper states {PAPER_JACOBIAN_MS:.0f} ms for its Jacobian.")


def _median_times_ms(
    collocations: dict[str, Collocation], evaluate: Callable[[Collocation], None], repeats: int
) -> dict[str, float]:
    for collocation in collocations.values():
        evaluate(collocation)
    seconds: dict[str, list[float]] = {evaluator_name: [] for evaluator_name in collocations}
    for repeat in range(repeats):
        for evaluator_name, collocation in collocations.items():
            if "casadi" in evaluator_name and repeat >= 3:
                continue  # CasADi takes a hundred times as long, and its times vary little
            began = time.perf_counter()
            evaluate(collocation)
            seconds[evaluator_name].append(time.perf_counter() - began)
    return {
        evaluator_name: 1e3 * statistics.median(values)
        for evaluator_name, values in seconds.items()
    }


if __name__ == "__main__":
    main()
