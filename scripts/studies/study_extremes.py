"""Extreme problems in small form: whether each ends in time, and with what answer.

    nice python scripts study_extremes [--only nearly-incompressible …] [--limit-s 120]

A bar of 2 × 2 × 3 cells with quadratic elements (175 nodes) hangs from a gripper that sways it; 24
samples of eight markers have a noise of 0.2 mm. Each case changes one thing to an extreme value: a
Poisson's ratio near one half, a modulus at which nothing moves, a body of two metres, a thousand
samples a second. A case runs in a process of its own with one thread, which is ended after the
limit of time of the processor. The table states the time, the status, the verdict and its first
reason, and the estimates beside the true values.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from script_arguments import make_parser

# Standard deviation of each marker coordinate [m].
SIGMA_M = 2e-4
TRUTH = {"young_pa": 2e4, "poisson": 0.45, "gamma_r_s": 5e-3, "gamma_m_1_s": 0.1}


@dataclass(frozen=True)
class Extreme:
    """One extreme problem.

    Attributes
    ----------
    element : str
        Element of body and fit.
    truth : mapping
        True constants that differ from `TRUTH`.
    free : tuple of str
        Constants that are estimated without a guess; the others are fixed at the truth.
    size : float
        Factor on all lengths of the bar and of its motion.
    rate_hz : float
        Sampling rate.
    duration_s : float
        Length of the recording.
    """

    element: str = "tet10-p0"
    truth: Mapping[str, float] | None = None
    free: tuple[str, ...] = ("young_pa", "gamma_r_s")
    size: float = 1.0
    rate_hz: float = 60.0
    duration_s: float = 0.4

    def run(self, max_time_s: float) -> dict[str, Any]:
        """Simulate the recording, identify it with a limit of time, and return what the table
        shows.
        """
        import numpy as np

        import collocation_sysid as cs

        truth = TRUTH | dict(self.truth or {})
        size_m = tuple(self.size * side for side in (0.03, 0.03, 0.12))
        body = cs.Body(cs.box_mesh(size_m, (2, 2, 3)), density_kg_m3=1000.0, element=self.element)
        t_s = np.arange(round(self.duration_s * self.rate_hz) + 1) / self.rate_hz
        sway_m = 0.03 * self.size * (1 - np.cos(20 * t_s))
        poses = cs.PoseSequence(
            t_s, np.outer(sway_m, [1.0, 0.5, 0.3]), np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
        )
        z_m = body.nodes_m[:, 2]
        grasp = cs.Grasp(np.flatnonzero(z_m > z_m.max() - 1e-9), poses)
        x_m, y_m, height_m = size_m
        places_m = [
            [x, y, z] for x in (0.0, x_m) for y in (0.0, y_m) for z in (0.0, 0.4 * height_m)
        ]
        unseen_m = np.zeros((len(t_s), len(places_m), 3))
        markers = cs.Markers(t_s, unseen_m, SIGMA_M, places_m=places_m)
        experiment = cs.Experiment(body, t_s, [grasp], markers, nuisance=cs.Nuisance.none())
        simulated = cs.simulate(experiment, truth, substeps=4).markers_m
        noise_m = SIGMA_M * np.random.default_rng(0).normal(size=simulated.shape)
        recorded = cs.with_markers(experiment, simulated + noise_m)
        unknown = truth | {name: cs.Unknown() for name in self.free}
        problem = cs.Problem([recorded], unknown)
        before_s = _cpu_s()
        try:
            answer = cs.run(problem, cs.ReducedSpace(max_time_s=max_time_s))
        except cs.InputError as refusal:
            reason = str(refusal)
            return {
                "cpu_s": _cpu_s() - before_s,
                "status": "refused",
                "verdict": "",
                "reason": reason,
                "estimates": {},
            }
        lines = str(answer).splitlines()
        return {
            "cpu_s": _cpu_s() - before_s,
            "status": str(answer.solution.status),
            "verdict": lines[0],
            "reason": lines[1].strip() if len(lines) > 1 else "",
            "estimates": {
                name: [answer.parameters[name], truth[name], answer.interval(name)]
                for name in self.free
            },
        }


CASES = {
    "ordinary": Extreme(),
    "nearly-incompressible": Extreme(truth={"poisson": 0.4999}),
    "nearly-incompressible-tet10": Extreme("tet10", truth={"poisson": 0.4999}),
    "free-poisson": Extreme(truth={"poisson": 0.4999}, free=("young_pa", "poisson", "gamma_r_s")),
    "stiff": Extreme(truth={"young_pa": 1e9, "gamma_r_s": 1e-5}),
    # A softer body of this size would not carry its own weight.
    "two-metres": Extreme(truth={"young_pa": 3e5}, size=2.0 / 0.12),
    "fast": Extreme(rate_hz=1000.0, duration_s=1.2),
}


def _cpu_s() -> float:
    """Return the time of the processor that this process has used [s]."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _outcome(name: str, limit_s: int, max_time_s: float) -> dict[str, Any]:
    """Return what a case in a process of its own has printed, or how it ended."""
    environment = os.environ | {"COLLOCATION_SYSID_THREADS": "1", "OMP_NUM_THREADS": "1"}
    ended = subprocess.run(
        [
            sys.executable,
            str(Path(__file__).resolve().parents[1]),
            "study_extremes",
            "--run",
            name,
            "--max-time-s",
            str(max_time_s),
        ],
        env=environment,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s)),
    )
    if ended.returncode == 0:
        return json.loads(ended.stdout.splitlines()[-1])
    last = ended.stderr.strip().splitlines()[-1:] or [""]
    return {
        "cpu_s": float(limit_s) if ended.returncode < 0 else 0.0,
        "status": "ended by the limit" if ended.returncode < 0 else "error",
        "verdict": "",
        "reason": last[0],
        "estimates": {},
    }


def main() -> None:
    """Run the cases that the command line names, and print a line for each."""
    parser: argparse.ArgumentParser = make_parser(__doc__)
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--limit-s", type=int, default=120)
    parser.add_argument("--max-time-s", type=float, default=1e6, help="max_time_s of the method")
    parser.add_argument("--run", choices=list(CASES), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.run:
        print(json.dumps(CASES[arguments.run].run(arguments.max_time_s)))
        return
    print("case | CPU [s] | status | verdict | first reason | estimate, truth, 95 % interval")
    for name in arguments.only:
        found = _outcome(name, arguments.limit_s, arguments.max_time_s)
        estimates = "; ".join(
            f"{key} {value:.5g}, {true:.5g}, {'none' if ends is None else [float(f'{e:.4g}') for e in ends]}"
            for key, (value, true, ends) in found["estimates"].items()
        )
        print(
            f"{name} | {found['cpu_s']:.1f} | {found['status']} | {found['verdict']} | "
            f"{found['reason'][:300]} | {estimates}",
            flush=True,
        )


if __name__ == "__main__":
    main()
