"""Draw the picture of the README: shapes of the foam cylinder over time, with measured markers."""

from __future__ import annotations

from pathlib import Path

from script_arguments import require_no_arguments

from collocation_sysid import Problem, simulate
from collocation_sysid.result.pictures import save_pictures, shapes_picture
from collocation_sysid.result.replay import MotionRecord

ROOT = Path(__file__).parents[2]
TRUTH = {"lambda_pa": 800.0, "mu_pa": 600.0, "gamma_r_s": 0.006, "gamma_m_1_s": 1.5}


def main() -> None:
    problem = Problem.read(ROOT / "problems" / "foam_cylinder" / "problem.toml")
    experiment = problem.experiments[0]
    trajectory = simulate(experiment, TRUTH)
    motion = MotionRecord.from_experiment(
        experiment, (trajectory.positions_m, trajectory.markers_m)
    )
    save_pictures(ROOT / "docs", {"swing": shapes_picture(motion)})


if __name__ == "__main__":
    require_no_arguments(__doc__)
    main()
