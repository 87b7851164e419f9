"""Time the assembled derivatives of the collocation NLP, evaluator against evaluator.

Values in the final sparse matrix, for the paper's size (about 176 nodes × 100 steps). The
baseline is the same expressions through `casadi.Function.map`; the paper quotes 57 ms (minimum)
and 82 ms (median) for its Jacobian on its own machine.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.kernels import available_threads
from collocation_sysid.problem import Problem
from collocation_sysid.program.collocation import Collocation

PROBLEM = Path(__file__).parents[1] / "problems" / "table1" / "problem.toml"
PAPER_MS = 57.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--problem", type=Path, default=PROBLEM)
    parser.add_argument(
        "--scheme", default="backward-euler", help="the paper's by default"
    )
    parser.add_argument("--repeats", type=int, default=21)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    measured = measure(arguments.problem, arguments.scheme, arguments.repeats)
    if arguments.json:
        print(json.dumps(measured, indent=1))
    else:
        report(measured)


def measure(path: Path, scheme: str, repeats: int) -> dict:
    """Medians in milliseconds, sides of one run interleaved."""
    problem = Problem.read(path)
    threads = max(2, available_threads())
    sides = {"simd_1_ms": ("simd", 1), f"simd_{threads}_ms": ("simd", threads)}
    sides["casadi_map_ms"] = ("casadi", 1)
    collocations = {}
    for side, (evaluator, count) in sides.items():
        body = Body(
            problem.bodies[0].mesh,
            density_kg_m3=problem.bodies[0].mass_kg
            / problem.bodies[0].mesh.volume_m3,
            damping="rayleigh",
            evaluator=evaluator,
            threads=count,
        )
        experiments = [replace(e, body=body) for e in problem.experiments]
        collocations[side] = Collocation(
            experiments, problem.parameters, scheme
        )
    first = collocations["simd_1_ms"]
    rng = np.random.default_rng(0)
    shape = [
        s.experiment.rigid_positions(s.dynamics.t_s) for s in first.segments
    ]
    z = first.pack(first.parameters.guess_q, shape)
    z[first.nq :] += 1e-3 * rng.normal(size=len(z) - first.nq)
    multipliers = rng.normal(size=first.constraints)
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
            "steps": sum(s.grid_rows for s in first.segments),
            "scheme": scheme,
        },
        "jacobian": _times(collocations, residual_and_jacobian, repeats)
        | {
            "nonzeros": len(jacobian),
            "extra_memory_ratio": _extra(first, z, jacobian),
        },
        "hessian": _times(collocations, lagrangian, repeats)
        | {"nonzeros": len(hessian)},
        "paper_jacobian_ms": PAPER_MS,
    }


def _times(
    collocations: dict[str, Collocation],
    call: Callable[[Collocation], None],
    repeats: int,
) -> dict[str, float]:
    for collocation in collocations.values():
        call(collocation)
    seconds: dict[str, list[float]] = {side: [] for side in collocations}
    for repeat in range(repeats):
        for side, collocation in collocations.items():
            if "casadi" in side and repeat >= 3:
                continue  # it takes a hundred times as long and varies little
            began = time.perf_counter()
            call(collocation)
            seconds[side].append(time.perf_counter() - began)
    return {
        side: 1e3 * statistics.median(values)
        for side, values in seconds.items()
    }


def _extra(
    collocation: Collocation, z: np.ndarray, values: np.ndarray
) -> float:
    """Peak memory of residual and Jacobian beside the values, over the size of the values.

    Counts the arrays kept between calls as well.
    """
    kept = sum(
        segment.linearisation_buffer.nbytes
        for segment in collocation.transcriptions
    )
    tracemalloc.start()
    collocation.constraints_and_jacobian(z, values)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return (peak + kept) / values.nbytes


def report(measured: dict) -> None:
    sizes = measured["problem"]
    print(
        f"{sizes['nodes']} nodes, {sizes['elements']} elements, {sizes['steps']} steps, "
        f"{sizes['scheme']}; medians"
    )
    for name in ("jacobian", "hessian"):
        row = measured[name]
        baseline = row["casadi_map_ms"]
        print(
            f"\n{name}, {row['nonzeros']:,} nonzeros in the final sparse matrix"
        )
        for side, value in row.items():
            if side.endswith("_ms"):
                print(
                    f"  {side[:-3]:12s} {value:8.1f} ms   {baseline / value:6.1f} × Function.map"
                )
        if name == "jacobian":
            print(
                f"  {'paper':12s} {measured['paper_jacobian_ms']:8.1f} ms   (its own machine)"
            )
            print(
                f"  peak extra memory {row['extra_memory_ratio']:.2f} × the sparse values"
            )


if __name__ == "__main__":
    main()
