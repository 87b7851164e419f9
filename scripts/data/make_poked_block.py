"""Make problems/poked_block: a ball of 3.2 mm pokes a gel block at twelve places.

The onset of contact at each place is unknown. Only the force is measured, every 0.4 mm with 1 mN of
noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from script_arguments import require_no_arguments

from collocation_sysid.common.files import write_text_file
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import Experiment, PoseSequence, Wrench

FOLDER = Path(__file__).parents[2] / "problems" / "poked_block"
TRUTH = {"young_pa": 2e4, "poisson": 0.4, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
# Number of places, and number of quarters of the block, of which one is modelled.
PLACES = 12
QUARTERS = 4
# Standard deviations of the force [N] and of the position of the surface [m].
NOISE_N = 1e-3
ONSET_M = 1e-4
# Displacements of the tip [m].
DEPTHS_M = 4e-4 * np.arange(6)
# Coordinates of the nodes across and downwards [m]: small elements below the ball.
ACROSS_M = np.array([0.0, 1.5, 3.0, 10.0]) / 1e3
DOWN_M = np.array([0.0, 1.5, 4.5, 15.0]) / 1e3


def graded(*edges_m: np.ndarray) -> TetMesh:
    """Return the mesh of a box with planes of nodes at the given coordinates along x, y and z [m]."""
    uniform_mesh = box_mesh((1.0,) * 3, [len(edge_m) - 1 for edge_m in edges_m])
    coordinates_m = [
        np.interp(uniform_mesh.points_m[:, k], np.linspace(0, 1, len(edge_m)), edge_m)
        for k, edge_m in enumerate(edges_m)
    ]
    return TetMesh(np.column_stack(coordinates_m), uniform_mesh.tetrahedra)


def quarter() -> TetMesh:
    """Return the mesh of a quarter of the block around a poked point, which is the origin."""
    return graded(ACROSS_M, ACROSS_M, -DOWN_M)


def forces_n(experiment: Experiment, depths_m: np.ndarray) -> np.ndarray:
    """Return the exact force on the complete ball at successive depths [N]."""
    t_s = np.arange(len(depths_m), dtype=float)
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
    tip_poses = PoseSequence(t_s, np.outer(depths_m, [0.0, 0.0, -1.0]), upright, "linear")
    *grasps, tip = experiment.grasps
    sensor = Wrench(t_s, np.zeros((len(t_s), 3)), NOISE_N)
    poking_experiment = replace(
        experiment,
        t_s=t_s,
        grasps=[*grasps, replace(tip, poses=tip_poses, wrench=sensor)],
        markers=None,
    )
    return -QUARTERS * simulate(poking_experiment, TRUTH).wrenches[0][:, 2]


def noisy_forces_n(experiment: Experiment, seed: int) -> Iterator[np.ndarray]:
    """Yield the noisy forces (6,) [N] at each place, whose surface has a random height."""
    rng = np.random.default_rng(seed)
    for onset_m in ONSET_M * rng.normal(size=PLACES):
        yield forces_n(experiment, DEPTHS_M - onset_m) + NOISE_N * rng.normal(size=len(DEPTHS_M))


def write_place(place: int, force_n: np.ndarray) -> None:
    """Write the forces [N] at a place, numbered from 1, as the table of a test bench."""
    rows = [
        f"{t},{1e3 * d:.3f},{f:.5f}" for t, (d, f) in enumerate(zip(DEPTHS_M, force_n, strict=True))
    ]
    table = "\n".join(["Time (s),Displacement (mm),Force (N)", *rows, ""])
    write_text_file(FOLDER / f"place_{place:02d}.csv", table)


def main() -> None:
    quarter().write(FOLDER / "quarter.vtu")
    for place in range(1, PLACES + 1):
        write_place(place, np.zeros(len(DEPTHS_M)))
    experiment = Problem.read(FOLDER / "problem.toml", simulation=True).experiments[0]
    for place, force_n in enumerate(noisy_forces_n(experiment, seed=1), 1):
        write_place(place, force_n)


if __name__ == "__main__":
    require_no_arguments(__doc__)
    main()
