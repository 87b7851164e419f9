"""Make problems/noisy_cylinder: a horizontal, shaken foam cylinder with typical motion-capture
errors.

As in foam_cylinder, the data are simulated by Newmark's scheme at 1 ms with the analytic motion.
Noise of 1 mm, two exchanges of labels and occlusions are added, and the place of one marker differs
from that in the problem file.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from script_arguments import require_no_arguments
from synthetic import Swing, exchanged, occluded, prepare_experiment, simulate_tracks

from collocation_sysid.fem.meshes.structured import cylinder_mesh
from collocation_sysid.recording import Experiment, place_markers, write_markers_csv

FOLDER = Path(__file__).parents[2] / "problems" / "noisy_cylinder"
TRUTH = {"lambda_pa": 2500.0, "mu_pa": 1500.0, "gamma_r_s": 0.005, "gamma_m_1_s": 1.5}
# Standard deviation of each marker coordinate [m].
NOISE_M = 0.001
SWING = Swing(
    duration_s=0.8,
    amplitude_m=(0.01, 0.02, 0.02),
    amplitude_rad=(0.25, 0.05, 0.05),
    frequency_hz=(5.0, 1.6, 2.0),
    rise_s=0.1,
    start=Rotation.from_rotvec([0, np.pi / 2, 0]),  # horizontal axis; x of the mesh points down
)
# Cameras at 100 Hz; the robot logs its poses at 200 Hz.
STEP_S = 0.01
POSE_STEP_S = 0.005
# Time step of the simulation [s].
FINE_S = 0.001
# Misplaced marker and its true place [m], labels that are exchanged, and occluded frames.
MISPLACED = "tip_2"
TRUE_PLACE_M = (0.006, 0.02598, 0.155)
SWAPS = (("low_1", "mid_1", slice(25, 33)), ("tip_1", "tip_3", slice(48, 60)))
OCCLUSIONS = (("mid_2", slice(10, 24)), ("low_3", slice(40, 50)), ("tip_1", slice(64, 81)))
# Share of single samples that are missing.
MISSING_SHARE = 0.03


def main() -> None:
    cylinder_mesh(radius_m=0.03, height_m=0.16, rings=1, layers=3).write(
        FOLDER / "noisy_cylinder.vtu"
    )
    experiment = prepare_experiment(
        FOLDER / "problem.toml", "swing_poses.csv", SWING.poses(POSE_STEP_S)
    )
    names = experiment.markers.names
    simulated = simulate_tracks(
        with_true_places(experiment), SWING.poses(FINE_S), TRUTH, NOISE_M, seed=1
    )
    frames = slice(None, None, round(STEP_S / POSE_STEP_S))
    tracks = simulated[frames]
    for first_name, second_name, frame_range in SWAPS:
        tracks = exchanged(tracks, (names.index(first_name), names.index(second_name)), frame_range)
    blocks = [(names.index(name), frame_range) for name, frame_range in OCCLUSIONS]
    tracks = occluded(tracks, blocks, MISSING_SHARE, seed=2)
    write_markers_csv(FOLDER / "swing_markers.csv", experiment.t_s[frames], names, tracks)


def with_true_places(experiment: Experiment) -> Experiment:
    """Return the experiment with the misplaced marker at its true place."""
    body = experiment.body
    markers = experiment.markers
    places_m = markers.predict_positions(body.nodes_m)
    places_m[markers.names.index(MISPLACED)] = TRUE_PLACE_M
    placement = place_markers(places_m, body.nodes_m, body)
    return replace(experiment, markers=replace(markers, placement=placement))


if __name__ == "__main__":
    require_no_arguments(__doc__)
    main()
