"""Make problems/laid_block: a gripper sets a foam block on a plate that weighs, and lets it go.

The data are simulated by BDF2 at 0.25 ms and sampled at 100 Hz, with noise of 0.3 mm on the markers
and of 5 mN on the force of the plate.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from script_arguments import require_no_arguments

from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import (
    PoseSequence,
    write_markers_csv,
    write_poses_csv,
    write_wrench_csv,
)

FOLDER = Path(__file__).parents[2] / "problems" / "laid_block"
TRUTH = {
    "young_pa": 2e4,
    "poisson": 0.3,
    "gamma_r_s": 0.006,
    "gamma_m_1_s": 0.5,
    "density_kg_m3": 100.0,
}
# Standard deviations of marker coordinates [m] and of the force of the plate [N].
NOISE_M = 3e-4
NOISE_N = 5e-3
# Sampling intervals of the cameras and of the plate, and time step of the simulation [s].
STEP_S = 0.01
PLATE_STEP_S = 0.01
FINE_S = 0.00025
# Duration of the recording and of the descent of the gripper [s], and length of the descent [m]; at
# its end the gripper presses the block on the plate.
DURATION_S = 0.8
DESCENT_S = 0.4
DESCENT_M = 0.0154


def gripper_poses(t_s: np.ndarray) -> PoseSequence:
    """Return the poses of the gripper at times `t_s` [s]: a smooth descent, then rest."""
    elapsed_share = np.clip(t_s / DESCENT_S, 0.0, 1.0)
    descent_m = DESCENT_M * (10 * elapsed_share**3 - 15 * elapsed_share**4 + 6 * elapsed_share**5)
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
    return PoseSequence(t_s, np.outer(descent_m, [0.0, 0.0, -1.0]), upright)


def grid(step_s: float) -> np.ndarray:
    """Return the times of the recording at a distance of `step_s` [s]."""
    return step_s * np.arange(round(DURATION_S / step_s) + 1)


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    box_mesh((0.06, 0.06, 0.04), (4, 4, 3)).write(FOLDER / "block.vtu")
    for old_file in FOLDER.glob("setting_*.csv"):
        old_file.unlink()
    write_poses_csv(FOLDER / "setting_poses.csv", gripper_poses(grid(STEP_S)))
    (experiment,) = Problem.read(FOLDER / "problem.toml", simulation=True).experiments
    gripper, plate = experiment.grasps
    assert plate.wrench is not None
    times_s = grid(PLATE_STEP_S)
    force_sensor = replace(plate.wrench, t_s=times_s, values=np.zeros((len(times_s), 3)))
    fine_gripper = replace(gripper, poses=gripper_poses(grid(FINE_S)))
    exact = replace(experiment, grasps=[fine_gripper, replace(plate, wrench=force_sensor)])
    simulation = simulate(exact, TRUTH, "bdf2", substeps=round(STEP_S / FINE_S))
    rng = np.random.default_rng(1)
    tracks = simulation.markers_m + NOISE_M * rng.normal(size=simulation.markers_m.shape)
    names = experiment.markers.names
    write_markers_csv(FOLDER / "setting_markers.csv", experiment.t_s, names, tracks)
    forces = simulation.wrenches[0][:, :3] + NOISE_N * rng.normal(size=(len(times_s), 3))
    is_measured = np.isfinite(forces).all(axis=1)
    write_wrench_csv(FOLDER / "setting_plate.csv", times_s[is_measured], forces[is_measured])


if __name__ == "__main__":
    require_no_arguments(__doc__)
    main()
