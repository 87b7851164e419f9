"""Make problems/table1: size and true parameters of the problem in the paper, without noise.

There are two data sets of the same motion: `newmark_markers.csv` is simulated by Newmark's scheme
at 1 ms with the analytic motion, `scheme_markers.csv` by the scheme of the paper, backward Euler at
10 ms. `small.toml` has 28 nodes and the first 40 samples, simulated by the scheme: with it all methods
end within a minute.
"""

from __future__ import annotations

from pathlib import Path

from script_arguments import require_no_arguments
from synthetic import Swing, prepare_experiment, simulate_tracks

from collocation_sysid.fem.meshes.structured import cylinder_mesh
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import write_markers_csv

FOLDER = Path(__file__).parents[2] / "problems" / "table1"
TRUTH = {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0}
SWING = Swing(
    duration_s=0.99,
    amplitude_m=(0.05, 0.04, 0.03),
    amplitude_rad=(0.1, 0.1, 0.6),
    frequency_hz=(0.9, 1.1, 1.3),
    rise_s=0.3,
)
# Sampling interval, and time step of Newmark's scheme [s].
STEP_S = 0.01
FINE_S = 0.001


SMALL_SAMPLES = 40


def main() -> None:
    cylinder_mesh(radius_m=0.04, height_m=0.16, rings=2, layers=8).write(FOLDER / "cylinder.vtu")
    cylinder_mesh(radius_m=0.04, height_m=0.16, rings=1, layers=3).write(FOLDER / "small.vtu")
    experiment = prepare_experiment(FOLDER / "problem.toml", "poses.csv", SWING.poses(STEP_S))
    tracks = {
        "newmark": simulate_tracks(experiment, SWING.poses(FINE_S), TRUTH, noise_m=0.0, seed=0),
        "scheme": simulate(experiment, TRUTH, "backward-euler", substeps=1).markers_m,
    }
    small = Problem.read(FOLDER / "small.toml", simulation=True).experiments[0]
    motion = simulate(small, TRUTH, "backward-euler", substeps=1)
    tracks["small"] = motion.markers_m[:SMALL_SAMPLES]
    for data, positions in tracks.items():
        t_s = experiment.t_s[: len(positions)]
        write_markers_csv(FOLDER / f"{data}_markers.csv", t_s, experiment.markers.names, positions)


if __name__ == "__main__":
    require_no_arguments(__doc__)
    main()
