"""Start on a coarser mesh, compared with the direct start: time, sweeps and difference of results.

The recording is the swung cylinder of `benchmark_sizes.py` with noise; four parameters have no
guess. Both solves run one after the other in one process on one thread. Other work on the machine
changes the processor time little, but it increases the wall time.

    python scripts benchmark_coarse_start                        # 2,013 nodes, 40 steps
    python scripts benchmark_coarse_start --size 5000 --steps 100
    python scripts benchmark_coarse_start --size 20000 --steps 50 --only auto   # peak memory
"""

from __future__ import annotations

import resource
import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
from benchmark_sizes import TRUTH, cylinder, swung_cylinder
from script_arguments import make_parser

from collocation_sysid import Body, Problem, Unknown, simulate
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.methods.solution import Solution
from collocation_sysid.pipeline import solve
from collocation_sysid.program.simulation import with_markers

# Rings x layers of the cylinder by nodes.
SIZES = {"500": "3x12", "2000": "4x32", "5000": "6x38", "20000": "10x60"}
# Standard deviation of the noise of the markers [m].
NOISE_M = 1e-3
# Starts by the values of the option, with their description.
STARTS = {"auto": "coarse", "false": "direct"}


@dataclass(frozen=True)
class Measurement:
    """One solve with its cost."""

    solution: Solution
    # Processor and wall time of the solve [s].
    processor_s: float
    wall_s: float


def main() -> None:
    """Run the benchmark with the options of the command line, and print its table."""
    parser = make_parser(__doc__)
    parser.add_argument("--size", choices=[*SIZES], default="2000")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--only", choices=[*STARTS])
    parser.add_argument("--nodes", type=int, default=1500)
    options = parser.parse_args()
    problem = swung_problem(SIZES[options.size], options.steps)
    starts = [options.only] if options.only else ["auto", "false"]
    measurements = {start: measure(problem, start, nodes=options.nodes) for start in starts}
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"peak memory {peak_mb:.0f} MB")
    if len(measurements) == 2:
        print_ratios(measurements["auto"], measurements["false"])


def swung_problem(mesh: str, steps: int) -> Problem:
    """Return the problem of a swung cylinder with noisy markers and no guess."""
    body = Body(cylinder(mesh), density_kg_m3=20.0, damping="rayleigh", threads=1)
    experiment = swung_cylinder(body, steps)
    tracks = simulate(experiment, TRUTH, "midpoint", substeps=1).markers_m
    noise_m = NOISE_M * np.random.default_rng(0).normal(size=tracks.shape)
    print(f"{len(body.nodes_m):,} nodes, {steps} samples", flush=True)
    return Problem(
        [with_markers(experiment, tracks + noise_m)], {name: Unknown() for name in TRUTH}
    )


def measure(problem: Problem, start: str, nodes: int) -> Measurement:
    """Return a solve with its times, and print them."""
    option: Literal["auto", False] = "auto" if start == "auto" else False
    method = ReducedSpace(coarse_start=option, coarse_start_nodes=nodes)
    began_s = time.perf_counter()
    began_processor_s = time.process_time()
    solution = solve(problem, method)
    measurement = Measurement(
        solution,
        processor_s=time.process_time() - began_processor_s,
        wall_s=time.perf_counter() - began_s,
    )
    print(
        f"{STARTS[start]:7} {solution.status.value} after {solution.iterations} sweeps on the "
        f"given mesh: {measurement.processor_s:.1f} s processor, {measurement.wall_s:.1f} s wall",
        *solution.notes,
        sep="\n  ",
        flush=True,
    )
    return measurement


def print_ratios(coarse: Measurement, direct: Measurement) -> None:
    """Print the ratios of the coarse start to the direct one, and the difference of the results."""
    difference = np.abs(coarse.solution.q - direct.solution.q).max()
    print(
        f"coarse start over direct start: {coarse.processor_s / direct.processor_s:.2f} processor time, "
        f"{coarse.wall_s / direct.wall_s:.2f} wall time, "
        f"{coarse.solution.iterations / direct.solution.iterations:.2f} sweeps; "
        f"logarithms of the parameters differ by at most {difference:.1e}"
    )


if __name__ == "__main__":
    main()
