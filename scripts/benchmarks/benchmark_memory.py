"""Cost of viscoelastic branches in a sweep of the paper's size: 171 nodes, 100 time steps.

Sweeps with no, one and two branches alternate in one run on one thread and are timed by processor
time, so that other work on the machine changes the ratios little. A branch has two parameters, each
of which adds a column of sensitivities; in the second table the parameters of the branches are
fixed.

    python scripts benchmark_memory
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from collocation_sysid import Body, Collocation, Experiment, Parameters, Problem, Unknown
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.sweep import Sweep

# Problem with the size of the paper, and true constants without and with two Prony terms.
FILE = Path(__file__).parents[2] / "problems/table1/problem.toml"
TRUTH = {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0}
MEMORY = {"prony_1.share": 0.3, "prony_1.tau_s": 0.1, "prony_2.share": 0.2, "prony_2.tau_s": 0.4}


def main() -> None:
    parser = argparse.ArgumentParser(description="Cost of viscoelastic branches in a sweep.")
    parser.add_argument("--repeats", type=int, default=15)
    repeats = parser.parse_args().repeats
    (experiment,) = Problem.read(FILE).experiments
    for is_estimated in (True, False):
        print(f"parameters of the branches {'estimated' if is_estimated else 'fixed'}")
        sweeps = [make_sweep(experiment, branches, is_estimated) for branches in range(3)]
        seconds = np.array([[processor_time_s(run) for run, _ in sweeps] for _ in range(repeats)])
        best_s = seconds.min(axis=0)
        relative = np.median(seconds / seconds[:, :1], axis=0)
        for branches, (_, columns) in enumerate(sweeps):
            print(
                f"  {branches} branches, {columns} columns: {1e3 * best_s[branches]:6.1f} ms at best, "
                f"{best_s[branches] / best_s[0]:.2f} times that without branches; "
                f"median ratio {relative[branches]:.2f}"
            )


def make_sweep(
    experiment: Experiment, branches: int, is_estimated: bool
) -> tuple[Callable[[], object], int]:
    """Return a function that sweeps over the experiment, and its number of right-hand sides.

    `branches` is the number of Prony terms, whose parameters are estimated or fixed.
    """
    plain_body = experiment.body
    names = [f"prony_{k + 1}" for k in range(branches)]
    body = Body(
        plain_body.mesh, density_kg_m3=plain_body.parts[0].density_kg_m3, prony=names, threads=1
    )
    memory = {n: v for n, v in MEMORY.items() if n.partition(".")[0] in names}
    values: dict[str, Unknown | float] = {name: Unknown(guess=v) for name, v in TRUTH.items()}
    values |= {name: Unknown(guess=v) if is_estimated else v for name, v in memory.items()}
    collocation = Collocation([replace(experiment, body=body)], Parameters.from_mapping(values))
    (transcription,) = collocation.transcriptions
    equations = transcription.equations_at(
        collocation.guess_p, np.zeros(transcription.nuisance.size)
    )
    x = simulate_scheme(experiment=transcription.experiment, dynamics=equations.dynamics)
    solver = Sweep(transcription)
    solver.forward(x, equations)
    return partial(solver.forward, x, equations), 1 + len(transcription.dynamic_parameters)


def processor_time_s(run: Callable[[], object]) -> float:
    """Call a function, and return its processor time [s]."""
    began = time.process_time()
    run()
    return time.process_time() - began


if __name__ == "__main__":
    main()
