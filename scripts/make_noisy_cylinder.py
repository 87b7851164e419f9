"""Make problems/noisy_cylinder: a foam cylinder held level and shaken, as motion capture sees it.

As in foam_cylinder the data come from Newmark at 1 ms on the analytic motion. Then 1 mm of noise,
two swaps of labels and occlusions are added, and one marker is glued elsewhere than the problem
file says.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from synthetic import (
    Swing,
    exchanged,
    occluded,
    prepare_experiment,
    simulate_tracks,
)

from collocation_sysid.fem.meshes.structured import cylinder_mesh
from collocation_sysid.recording import (
    Experiment,
    place_markers,
    write_markers_csv,
)

FOLDER = Path(__file__).parents[1] / "problems" / "noisy_cylinder"
TRUTH = {
    "lambda_pa": 2500.0,
    "mu_pa": 1500.0,
    "gamma_r_s": 0.005,
    "gamma_m_1_s": 1.5,
}
NOISE_M = 0.001
SWING = Swing(
    duration_s=0.8,
    amplitude_m=(0.01, 0.02, 0.02),
    amplitude_rad=(0.25, 0.05, 0.05),
    frequency_hz=(5.0, 1.6, 2.0),
    rise_s=0.1,
    start=Rotation.from_rotvec(
        [0, np.pi / 2, 0]
    ),  # held level, the mesh's x pointing down
)
# Cameras at 100 Hz; the robot logs its poses at 200 Hz.
STEP_S = 0.01
POSE_STEP_S = 0.005
FINE_S = 0.001
MISPLACED = "tip_2"
GLUED_M = (0.006, 0.02598, 0.155)
SWAPS = (("low_1", "mid_1", slice(25, 33)), ("tip_1", "tip_3", slice(48, 60)))
OCCLUSIONS = (
    ("mid_2", slice(10, 24)),
    ("low_3", slice(40, 50)),
    ("tip_1", slice(64, 81)),
)
LOST_SHARE = 0.03


def main() -> None:
    cylinder_mesh(radius_m=0.03, height_m=0.16, rings=1, layers=3).write(
        FOLDER / "noisy_cylinder.vtu"
    )
    experiment = prepare_experiment(
        FOLDER / "problem.toml", "swing_poses.csv", SWING.poses(POSE_STEP_S)
    )
    names = experiment.markers.names
    simulated = simulate_tracks(
        as_glued(experiment), SWING.poses(FINE_S), TRUTH, NOISE_M, seed=1
    )
    frames = slice(None, None, round(STEP_S / POSE_STEP_S))
    tracks = simulated[frames]
    for first, second, when in SWAPS:
        tracks = exchanged(
            tracks, (names.index(first), names.index(second)), when
        )
    blocks = [(names.index(name), when) for name, when in OCCLUSIONS]
    tracks = occluded(tracks, blocks, LOST_SHARE, seed=2)
    write_markers_csv(
        FOLDER / "swing_markers.csv", experiment.t_s[frames], names, tracks
    )


def as_glued(experiment: Experiment) -> Experiment:
    """The experiment with the misplaced marker where it is."""
    body = experiment.body
    markers = experiment.markers
    places = markers.predict_positions(body.nodes_m)
    places[markers.names.index(MISPLACED)] = GLUED_M
    placement = place_markers(places, body.nodes_m, body)
    return replace(experiment, markers=replace(markers, placement=placement))


if __name__ == "__main__":
    main()
