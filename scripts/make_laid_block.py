"""Make problems/laid_block: a gripper sets a foam block on a plate that weighs, and lets it go.

The data come from BDF2 at 0.25 ms: at 100 Hz, 0.3 mm noise on the markers, 5 mN on the force of the
plate.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import (
    PoseSequence,
    write_markers_csv,
    write_poses_csv,
    write_wrench_csv,
)

FOLDER = Path(__file__).parents[1] / "problems" / "laid_block"
TRUTH = {
    "young_pa": 2e4,
    "poisson": 0.3,
    "gamma_r_s": 0.006,
    "gamma_m_1_s": 0.5,
    "density_kg_m3": 100.0,
}
NOISE_M = 3e-4
NOISE_N = 5e-3
STEP_S = 0.01
PLATE_S = 0.01
FINE_S = 0.00025
# The gripper comes down until the block is pressed by the last of it.
DURATION_S = 0.8
LOWERED_S = 0.4
LOWERED_M = 0.0154


def lowered(t_s: np.ndarray) -> PoseSequence:
    """Poses of the gripper: down smoothly, then still."""
    u = np.clip(t_s / LOWERED_S, 0.0, 1.0)
    way_m = LOWERED_M * (10 * u**3 - 15 * u**4 + 6 * u**5)
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
    return PoseSequence(t_s, np.outer(way_m, [0.0, 0.0, -1.0]), upright)


def grid(step_s: float) -> np.ndarray:
    """Return the times of the recording at a distance of `step_s` [s]."""
    return step_s * np.arange(round(DURATION_S / step_s) + 1)


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    box_mesh((0.06, 0.06, 0.04), (4, 4, 3)).write(FOLDER / "block.vtu")
    for old in FOLDER.glob("setting_*.csv"):
        old.unlink()
    write_poses_csv(FOLDER / "setting_poses.csv", lowered(grid(STEP_S)))
    (experiment,) = Problem.read(
        FOLDER / "problem.toml", simulation=True
    ).experiments
    gripper, plate = experiment.grasps
    assert plate.wrench is not None
    times = grid(PLATE_S)
    force = replace(plate.wrench, t_s=times, values=np.zeros((len(times), 3)))
    moved = replace(gripper, poses=lowered(grid(FINE_S)))
    exact = replace(experiment, grasps=[moved, replace(plate, wrench=force)])
    found = simulate(exact, TRUTH, "bdf2", substeps=round(STEP_S / FINE_S))
    rng = np.random.default_rng(1)
    tracks = found.markers_m + NOISE_M * rng.normal(size=found.markers_m.shape)
    names = experiment.markers.names
    write_markers_csv(
        FOLDER / "setting_markers.csv", experiment.t_s, names, tracks
    )
    forces = found.wrenches[0][:, :3] + NOISE_N * rng.normal(
        size=(len(times), 3)
    )
    known = np.isfinite(forces).all(axis=1)
    write_wrench_csv(FOLDER / "setting_plate.csv", times[known], forces[known])


if __name__ == "__main__":
    main()
