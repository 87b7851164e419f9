"""Make problems/wrist_sensor: a foam block of unknown density swung by a hand with a force sensor.

The data come from Newmark at 1 ms on the analytic motion, so neither the integrator nor the
interpolation of the poses is the one the problem is solved with: 1 mm noise on the markers at
100 Hz, 0.05 N and 2 mN m on the wrench at 500 Hz.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from synthetic import Swing

from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import (
    Grasp,
    write_markers_csv,
    write_poses_csv,
    write_wrench_csv,
)

FOLDER = Path(__file__).parents[1] / "problems" / "wrist_sensor"
TRUTH = {
    "young_pa": 2.5e4,
    "poisson": 0.3,
    "gamma_r_s": 0.006,
    "gamma_m_1_s": 0.5,
    "density_kg_m3": 120.0,
}
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
SENSOR_S = 0.002
POSE_STEP_S = 0.005
FINE_S = 0.001


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    box_mesh((0.06, 0.06, 0.18), (2, 2, 5)).write(FOLDER / "block.vtu")
    for old in FOLDER.glob("swing_*.csv"):
        old.unlink()
    write_poses_csv(FOLDER / "swing_poses.csv", SWING.poses(POSE_STEP_S))
    (experiment,) = Problem.read(
        FOLDER / "problem.toml", simulation=True
    ).experiments
    (grasp,) = experiment.grasps
    times = SENSOR_S * np.arange(round(SWING.duration_s / SENSOR_S) + 1)
    assert grasp.wrench is not None
    sensor = replace(grasp.wrench, t_s=times, values=np.zeros((len(times), 6)))
    moved = Grasp(grasp.nodes, SWING.poses(FINE_S), wrench=sensor)
    found = simulate(
        replace(experiment, grasps=[moved]), TRUTH, timestep_s=FINE_S
    )
    rng = np.random.default_rng(1)
    frames = slice(None, None, round(STEP_S / POSE_STEP_S))
    tracks = found.markers_m[frames]
    tracks = tracks + NOISE_M * rng.normal(size=tracks.shape)
    names = experiment.markers.names
    t_s = experiment.t_s[frames]
    write_markers_csv(FOLDER / "swing_markers.csv", t_s, names, tracks)
    sizes = np.repeat([NOISE_N, NOISE_NM], 3)
    wrench = found.wrenches[0] + sizes * rng.normal(size=(len(times), 6))
    write_wrench_csv(FOLDER / "swing_wrench.csv", times, wrench)


if __name__ == "__main__":
    main()
