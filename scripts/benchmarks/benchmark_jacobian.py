"""Time of the assembled derivatives of the nonlinear program, by evaluator.

The values of the final sparse matrix are computed for the size of the paper (about 176 nodes × 100
steps). The
baseline is the same expressions through `casadi.Function.map`; the paper quotes 57 ms (minimum)
and 82 ms (median) for its Jacobian on its own machine.
"""

from __future__ import annotations

import json
import statistics
import time
import tracemalloc
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
    parser.add_argument("--problem", type=Path, default=PROBLEM)
    parser.add_argument("--scheme", default="backward-euler", help="the paper's by default")
    parser.add_argument("--repeats", type=int, default=21)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    measurements = measure(arguments.problem, arguments.scheme, arguments.repeats)
    if arguments.json:
        print(json.dumps(measurements, indent=1))
    else:
        report(measurements)


def measure(path: Path, scheme: str, repeats: int) -> dict:
    """Return the median times of Jacobian and Hessian by evaluator [ms]; evaluators alternate in
    one run.
    """
    problem = Problem.read(path)
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
        collocations[evaluator_name] = Collocation(experiments, problem.parameters, scheme)
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

    return {
        "problem": {
            "nodes": len(problem.bodies[0].nodes_m),
            "elements": len(problem.bodies[0].cells),
            "steps": sum(s.grid_times for s in first.transcriptions),
            "scheme": scheme,
        },
        "jacobian": _median_times_ms(collocations, residual_and_jacobian, repeats)
        | {
            "nonzeros": len(jacobian),
            "extra_memory_ratio": _extra_memory_ratio(first, z, jacobian),
        },
        "hessian": _median_times_ms(collocations, lagrangian, repeats) | {"nonzeros": len(hessian)},
        "paper_jacobian_ms": PAPER_JACOBIAN_MS,
    }


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


def _extra_memory_ratio(collocation: Collocation, z: np.ndarray, values: np.ndarray) -> float:
    """Return the peak memory of residual and Jacobian without the values, over the size of the
    values.

    Arrays that are kept between calls count as well.
    """
    buffer_bytes = sum(
        transcription.linearisation_buffer.nbytes for transcription in collocation.transcriptions
    )
    tracemalloc.start()
    collocation.constraints_and_jacobian(z, values)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return (peak + buffer_bytes) / values.nbytes


def report(measurements: dict) -> None:
    """Print the result of `measure`."""
    sizes = measurements["problem"]
    print(
        f"{sizes['nodes']} nodes, {sizes['elements']} elements, {sizes['steps']} steps, "
        f"{sizes['scheme']}; medians"
    )
    for name in ("jacobian", "hessian"):
        row = measurements[name]
        baseline = row["casadi_map_ms"]
        print(f"\n{name}, {row['nonzeros']:,} nonzeros in the final sparse matrix")
        for evaluator_name, value in row.items():
            if evaluator_name.endswith("_ms"):
                print(
                    f"  {evaluator_name[:-3]:12s} {value:8.1f} ms   {baseline / value:6.1f} × Function.map"
                )
        if name == "jacobian":
            print(
                f"  {'paper':12s} {measurements['paper_jacobian_ms']:8.1f} ms   "
                "(on the machine of its authors)"
            )
            print(f"  peak extra memory {row['extra_memory_ratio']:.2f} × the sparse values")


if __name__ == "__main__":
    main()
