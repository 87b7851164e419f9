"""Time and memory of a simulation and a sweep of bodies with 500 to 20,000 nodes.

The body is the swung cylinder of `benchmark_methods.py`, with the default damping law or with
Rayleigh's. Each line is measured in a process of its own, so that peak memory is that of the line.
On one thread, times are processor times, which other work on the machine changes little; on more
threads they are wall times. A sweep consists of a feasibility step and the sensitivities to four
parameters; a few time steps are enough to measure the cost of one.

    python scripts/benchmark_sizes.py                              # all sizes, one and two threads
    python scripts/benchmark_sizes.py --size 5000 --steps 200      # peak memory of 200 steps
    python scripts/benchmark_sizes.py --size 2000 --factorisation band sparse supernodal
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import time
from dataclasses import dataclass
from typing import get_args

import numpy as np
from benchmark_methods import PARAMETERS, TRUTH, cylinder, swung

from collocation_sysid import Body, Collocation
from collocation_sysid.program.forward.newton_solver import NewtonOptions
from collocation_sysid.program.forward.scheme_simulation import (
    continue_simulation,
)
from collocation_sysid.program.linear_algebra.factorisation import Choice
from collocation_sysid.program.stopwatch import Stopwatch
from collocation_sysid.program.sweep import Sweep

# Rings x layers of the cylinder, element, and steps that are enough to tell, by nodes.
SIZES = {
    "500": ("3x12", "tet4", 40),
    "2000": ("4x32", "tet4", 20),
    "2000-tet10": ("2x16", "tet10", 20),
    "5000": ("6x38", "tet4", 10),
    "20000": ("10x60", "tet4", 3),
}


@dataclass(frozen=True)
class Cost:
    """Seconds of one part, and how they are shared out."""

    total_s: float
    stopwatch: Stopwatch

    def told(self, steps: int) -> str:
        spent = self.stopwatch
        shares = (
            spent.evaluations / self.total_s,
            spent.linear_algebra / self.total_s,
        )
        return (
            f"{1e3 * self.total_s / steps:8.1f} ms a step (elements {shares[0]:4.0%}, "
            f"linear algebra {shares[1]:4.0%})"
        )


def main() -> None:
    """Run the benchmark with the options of the command line, and print its table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", nargs="+", choices=[*SIZES], default=[*SIZES])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument(
        "--factorisation", nargs="+", choices=get_args(Choice), default=["auto"]
    )
    parser.add_argument("--damping", default="kelvin-voigt")
    parser.add_argument("--steps", type=int)
    given = parser.parse_args()
    for size in given.size:
        for choice in given.factorisation:
            for threads in given.threads:
                arguments = size, given.steps, threads, choice, given.damping
                with multiprocessing.get_context("spawn").Pool(1) as pool:
                    print(pool.apply(measured, arguments), flush=True)


def measured(
    size: str, steps: int | None, threads: int, choice: Choice, damping: str
) -> str:
    """A line on one body."""
    mesh, element, few = SIZES[size]
    steps = steps or few
    body = Body(
        cylinder(mesh),
        density_kg_m3=20.0,
        damping=damping,
        element=element,
        threads=threads,
    )
    collocation = Collocation([swung(body, steps + 1)], PARAMETERS)
    (segment,) = collocation.transcriptions
    setting = segment.equations_at(
        np.log([TRUTH[name] for name in PARAMETERS.names]), np.zeros(0)
    )
    before_mb = peak_mb()
    clock = time.perf_counter if threads > 1 else time.process_time
    began = clock()
    spent = Stopwatch(clock)
    x, failure = continue_simulation(
        segment.experiment,
        setting.dynamics,
        options=NewtonOptions(tolerance=1e-6),
        stopwatch=spent,
    )
    if failure:
        raise failure
    march = Cost(clock() - began, spent)
    spent = Stopwatch(clock)
    solver = Sweep(segment, stopwatch=spent, factorisation=choice)
    # The analysis of the pattern is made once for all sweeps.
    numbers = solver.estimate_chunk_bytes()
    began = clock()
    solver.forward(x, setting)
    sweep = Cost(clock() - began, spent)
    return (
        f"{len(body.nodes_m):6d} nodes {element:5s} {steps:4d} steps {threads} threads "
        f"{kind(solver):10s} march {march.told(steps)}  sweep {sweep.told(steps)}  "
        f"at a time {solver.choose_chunk_rows()} steps, {numbers / 1e6:.0f} MB; "
        f"peak {peak_mb():.0f} MB, before {before_mb:.0f} MB"
    )


def kind(solver: Sweep) -> str:
    """Return the name of the factorisation that a sweep uses."""
    chosen = solver.factoriser
    if chosen.skyline:
        return "skyline"
    return (
        "band"
        if chosen.is_banded
        else "supernodal"
        if chosen.is_supernodal
        else "sparse"
    )


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
