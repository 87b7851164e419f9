"""Make problems/wrist_sensor: a foam block of unknown density swung by a hand with a force sensor.

The data are simulated by Newmark's scheme at 1 ms with the analytic motion: scheme and
interpolation of the poses differ from those of the fit. The noise is 1 mm on the markers at 100 Hz,
and 0.05 N and 2 mN m on the wrench at 500 Hz.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from script_arguments import require_no_arguments
from synthetic import Swing

from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import Grasp, write_markers_csv, write_poses_csv, write_wrench_csv

FOLDER = Path(__file__).parents[2] / "problems" / "wrist_sensor"
TRUTH = {
    "young_pa": 2.5e4,
    "poisson": 0.3,
    "gamma_r_s": 0.006,
    "gamma_m_1_s": 0.5,
    "density_kg_m3": 120.0,
}
# Standard deviations of marker coordinates [m], force [N] and torque [N m].
NOISE_M = 1e-3
NOISE_N = 0.05
NOISE_NM = 2e-3
SWING = Swing(
    duration_s=0.6,
    amplitude_m=(0.05, 0.04, 0.03),
    amplitude_rad=(0.35, 0.4, 0.5),
    frequency_hz=(1.6, 2.0, 2.4),
    rise_s=0.1,
)
# Cameras at 100 Hz, the sensor at 500 Hz; the robot logs its poses at 200 Hz.
STEP_S = 0.01
SENSOR_STEP_S = 0.002
POSE_STEP_S = 0.005
# Time step of the simulation [s].
FINE_S = 0.001


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    box_mesh((0.06, 0.06, 0.18), (2, 2, 5)).write(FOLDER / "block.vtu")
    for old_file in FOLDER.glob("swing_*.csv"):
        old_file.unlink()
    write_poses_csv(FOLDER / "swing_poses.csv", SWING.poses(POSE_STEP_S))
    (experiment,) = Problem.read(FOLDER / "problem.toml", simulation=True).experiments
    (grasp,) = experiment.grasps
    times_s = SENSOR_STEP_S * np.arange(round(SWING.duration_s / SENSOR_STEP_S) + 1)
    assert grasp.wrench is not None
    sensor = replace(grasp.wrench, t_s=times_s, values=np.zeros((len(times_s), 6)))
    fine_grasp = Grasp(grasp.nodes, SWING.poses(FINE_S), wrench=sensor)
    simulation = simulate(replace(experiment, grasps=[fine_grasp]), TRUTH, timestep_s=FINE_S)
    rng = np.random.default_rng(1)
    frames = slice(None, None, round(STEP_S / POSE_STEP_S))
    tracks = simulation.markers_m[frames]
    tracks = tracks + NOISE_M * rng.normal(size=tracks.shape)
    names = experiment.markers.names
    t_s = experiment.t_s[frames]
    write_markers_csv(FOLDER / "swing_markers.csv", t_s, names, tracks)
    deviations = np.repeat([NOISE_N, NOISE_NM], 3)
    wrench = simulation.wrenches[0] + deviations * rng.normal(size=(len(times_s), 6))
    write_wrench_csv(FOLDER / "swing_wrench.csv", times_s, wrench)


if __name__ == "__main__":
    require_no_arguments(__doc__)
    main()
