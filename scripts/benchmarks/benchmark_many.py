"""Processor time of many simulations at once over that of as many single ones.

A bar of 100 nodes hangs from a hand that swings it, for 50 rows, with random constants. The single
simulations are a sample of the same constants, between parts of the joint ones.
"""

from __future__ import annotations

import time

import numpy as np
from script_arguments import make_parser

import collocation_sysid as cs
from collocation_sysid.common.array_types import Array

# The middle of the constants; their logarithms have the standard deviation 0.2.
MIDDLE = {"lambda_pa": 3e5, "mu_pa": 7e4, "gamma_r_s": 0.01, "gamma_m_1_s": 0.01}
PARTS = 10


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--bodies", type=int, default=1000)
    parser.add_argument("--singles", type=int, default=100)
    arguments = parser.parse_args()
    experiment = swung_bar()
    rng = np.random.default_rng(0)
    values = {
        name: middle * np.exp(0.2 * rng.standard_normal(arguments.bodies))
        for name, middle in MIDDLE.items()
    }
    for scheme in ("newmark", "midpoint", "bdf2", "backward-euler"):
        measure(experiment, values, scheme, arguments.singles // PARTS)


def swung_bar() -> cs.Experiment:
    """Return the experiment: 100 nodes, 50 rows."""
    body = cs.Body(
        cs.box_mesh((0.04, 0.04, 0.24), (1, 1, 24)), density_kg_m3=1000.0, damping="rayleigh"
    )
    t_s = np.linspace(0.0, 0.49, 50)
    z = body.nodes_m[:, 2]
    sway_m = np.outer(0.02 * (1 - np.cos(10 * t_s)), [1, 0, 0])
    hand = cs.PoseSequence(t_s, sway_m, np.tile([0, 0, 0, 1.0], (50, 1)))
    low_m = body.nodes_m[z < 1e-3]
    markers = cs.Markers(t_s, np.zeros((50, len(low_m), 3)), 1e-4, places_m=low_m)
    held = cs.Grasp(np.flatnonzero(z > 0.2399), hand)
    return cs.Experiment(
        body, t_s, [held], markers, nuisance=cs.Nuisance.none(), air_density_kg_m3="none"
    )


def measure(experiment: cs.Experiment, values: dict[str, Array], scheme: str, count: int) -> None:
    """Print the processor times of a body, in a joint simulation and by itself."""
    rows = [dict(zip(values, row, strict=True)) for row in zip(*values.values(), strict=True)]

    def together(some: dict[str, Array]) -> None:
        cs.simulate_each(experiment, some, scheme, is_measured=False)

    def alone(row: dict[str, float]) -> None:
        cs.simulate(experiment, row, scheme, substeps=1, is_measured=False)

    together({name: each[:32] for name, each in values.items()})
    alone(rows[0])
    joint_s = single_s = 0.0
    for part in np.array_split(np.arange(len(rows)), PARTS):
        began = time.process_time()
        together({name: each[part] for name, each in values.items()})
        joint_s += time.process_time() - began
        began = time.process_time()
        for k in part[:count]:
            alone(rows[k])
        single_s += time.process_time() - began
    single_ms = 1e3 * single_s / (PARTS * count)
    joint_ms = 1e3 * joint_s / len(rows)
    ratio = single_ms / joint_ms
    print(f"{scheme:15s} single {single_ms:6.1f} ms, joint {joint_ms:6.1f} ms: {ratio:4.1f} times")


if __name__ == "__main__":
    main()
