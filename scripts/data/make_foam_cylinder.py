"""Make problems/foam_cylinder: a foam cylinder, clamped at one end and swung, with 0.5 mm of noise.

The data are simulated by Newmark's scheme at 1 ms with the analytic motion: scheme and
interpolation of the poses differ from those of the fit.
"""

from __future__ import annotations

from pathlib import Path

from script_arguments import require_no_arguments
from synthetic import Swing, prepare_experiment, simulate_tracks

from collocation_sysid.fem.meshes.structured import cylinder_mesh
from collocation_sysid.recording import write_markers_csv

FOLDER = Path(__file__).parents[2] / "problems" / "foam_cylinder"
TRUTH = {"lambda_pa": 800.0, "mu_pa": 600.0, "gamma_r_s": 0.006, "gamma_m_1_s": 1.5}
# Standard deviation of each marker coordinate [m].
NOISE_M = 0.0005
SWING = Swing(
    duration_s=0.4,
    amplitude_m=(0.05, 0.04, 0.03),
    amplitude_rad=(0.35, 0.4, 0.6),
    frequency_hz=(1.6, 2.0, 2.4),
    rise_s=0.1,
)
# Cameras at 100 Hz; the robot logs its poses at 200 Hz.
STEP_S = 0.01
POSE_STEP_S = 0.005
# Time step of the simulation [s].
FINE_S = 0.001


def main() -> None:
    cylinder_mesh(radius_m=0.03, height_m=0.16, rings=1, layers=11).write(
        FOLDER / "foam_cylinder.vtu"
    )
    experiment = prepare_experiment(
        FOLDER / "problem.toml", "swing_poses.csv", SWING.poses(POSE_STEP_S)
    )
    tracks = simulate_tracks(experiment, SWING.poses(FINE_S), TRUTH, NOISE_M, seed=1)
    frames = slice(None, None, round(STEP_S / POSE_STEP_S))
    write_markers_csv(
        FOLDER / "swing_markers.csv",
        experiment.t_s[frames],
        experiment.markers.names,
        tracks[frames],
    )


if __name__ == "__main__":
    require_no_arguments(__doc__)
    main()
