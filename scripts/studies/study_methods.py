"""Success of each method from distant initial guesses, on a small problem.

A cylinder hangs from a swung hand. Its tracks are simulated with the scheme of the fit, without
noise. Every method starts from the same guesses, log-uniform within a factor of 10 of the true
values in all four parameters. A run succeeds if all four estimates are within 1 % of the true
values, whatever its status.

    python scripts study_methods                     # all methods, 40 starts
    python scripts study_methods --methods shooting reduced-space --starts 100
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from script_arguments import make_parser
from studies import TRUTH, Variant, markdown, number, run_variants, save, worst_error
from synthetic import swing

from collocation_sysid.extras.studies.rows import Row, wilson_interval
from collocation_sysid.fem.meshes.structured import cylinder_mesh
from collocation_sysid.problem import Problem
from collocation_sysid.recording import write_poses_csv
from collocation_sysid.result.synthesis import Recipe, write_data

# Largest relative error of a parameter in a successful run.
SUCCESS_SHARE = 0.01
# Radius and height of the cylinder [m].
RADIUS_M = 0.04
HEIGHT_M = 0.16

# Options of methods: inner Levenberg–Marquardt solver.
LM = {"inner": "levenberg-marquardt"}
# Initial trajectories are simulated at the guess, not taken from a coarse solution by reduced
# space.
FROM_SIMULATION = {"initial": "simulation"}
# A growing horizon whose stages are solved by shooting.
SHOOTING_STAGES = {"stage.method": "shooting"}
VARIANTS = (
    Variant("reduced-space", "reduced-space"),
    Variant("shooting", "shooting"),
    Variant("shooting, growing horizon", "continuation", SHOOTING_STAGES),
    Variant("penalty, LM", "penalty", LM),
    Variant(
        "augmented-lagrangian, LM, first ρ = 1e2", "augmented-lagrangian", {"rho": 1e2}, share=0.5
    ),
    Variant("augmented-lagrangian, LM, first ρ = 1e5", "augmented-lagrangian", share=0.5),
    Variant("interior-point", "interior-point", FROM_SIMULATION, share=0.25),
)

PROBLEM = """\
title = "A small cylinder, hung and swung"

[object]
mesh = "cylinder.vtu"
density_kg_m3 = 20.0
damping = "rayleigh"

[parameters]
lambda_pa   = { guess = 400.0, lower = 10.0, upper = 1e5 }
mu_pa       = { guess = 150.0, lower = 10.0, upper = 1e5 }
gamma_r_s   = { guess = 0.02, lower = 1e-5, upper = 1.0 }
gamma_m_1_s = { guess = 0.5, lower = 1e-3, upper = 100.0 }

[[experiment]]
name = "swing"
nuisance = "none"
grasp = { nodes = { box_m = [[-1, -1, -0.001], [1, 1, 0.001]] }, poses = "motion.csv" }
gravity_m_s2 = [0.0, 0.0, -9.81]

[experiment.markers]
file = "swing_markers.csv"
reference_m = REFERENCES

[environment]
air_density_kg_m3 = "none"

[transcription]
scheme = "midpoint"
substeps = 1

[rollout]
integrator = "scheme"
"""


@dataclass(frozen=True)
class MethodScore:
    """Successes and times of a method."""

    name: str
    # Numbers of runs, of successes, of runs that report convergence, and of runs that report
    # convergence at wrong parameters.
    runs: int
    successes: int
    converged: int
    misled: int
    time_s: float  # median time of all runs, including those that were stopped [s]

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the success rate."""
        return wilson_interval(self.successes, self.runs)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--starts", type=int, default=40)
    parser.add_argument("--spread", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--layers", type=int, default=7, help="7 (layers + 1) nodes")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--step-s", type=float, default=0.02)
    parser.add_argument("--time-s", type=float, default=40.0, help="limit of a run")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--methods", nargs="*", choices=[v.name for v in VARIANTS])
    parser.add_argument("--out", type=Path, default=Path("results/study_methods"))
    arguments = parser.parse_args()
    path = write_problem(arguments.out, arguments.layers, arguments.steps, arguments.step_s)
    rows = run_variants(
        path,
        [v for v in VARIANTS if not arguments.methods or v.name in arguments.methods],
        arguments.out,
        starts=arguments.starts,
        spread=arguments.spread,
        seed=arguments.seed,
        time_s=arguments.time_s,
        workers=arguments.workers,
    )
    save(arguments.out, "study_methods", table([score(name, each) for name, each in rows.items()]))


def write_problem(folder: Path, layers: int, steps: int, step_s: float) -> Path:
    """Write the problem of a swung cylinder with exact tracks of the midpoint rule; return its
    path.
    """
    folder.mkdir(parents=True, exist_ok=True)
    mesh = cylinder_mesh(RADIUS_M, HEIGHT_M, rings=1, layers=layers)
    mesh.write(folder / "cylinder.vtu")
    poses = swing(
        step_s * np.arange(steps, dtype=np.float64),
        amplitude_m=(0.05, 0.04, 0.03),
        amplitude_rad=(0.1, 0.1, 0.6),
        frequency_hz=(0.9, 1.1, 1.3),
        rise_s=0.3,
        start=Rotation.from_rotvec([np.pi, 0, 0]),  # the cylinder hangs
    )
    write_poses_csv(folder / "motion.csv", poses)
    on_side = np.linalg.norm(mesh.points_m[:, :2], axis=1) > RADIUS_M / 2
    marker_places_m = mesh.points_m[on_side & (mesh.points_m[:, 2] > 0.2 * HEIGHT_M)][::5]
    places = ", ".join(f"m{k} = {point.tolist()}" for k, point in enumerate(marker_places_m))
    path = folder / "problem.toml"
    path.write_text(PROBLEM.replace("REFERENCES", f"{{ {places} }}"), encoding="utf-8")
    truth_overrides = [f"parameters.{name}.guess={value}" for name, value in TRUTH.items()]
    (folder / "swing_markers.csv").unlink(missing_ok=True)
    write_data(Problem.read(path, truth_overrides, simulation=True), folder, Recipe("midpoint"))
    return path


def score(name: str, rows: Sequence[Row]) -> MethodScore:
    """Return the counts and the median time of the runs of one variant of a method."""
    has_succeeded = [worst_error(row) <= SUCCESS_SHARE for row in rows]
    converged = [bool(row["converged"]) for row in rows]
    times = [row["total_s"] if row["total_s"] is not None else row["wall_s"] for row in rows]
    misled = sum(c and not n for c, n in zip(converged, has_succeeded, strict=True))
    return MethodScore(
        name, len(rows), sum(has_succeeded), sum(converged), misled, float(np.median(times))
    )


def table(scores: Sequence[MethodScore]) -> str:
    """Return a Markdown table of the success rates."""
    heads = (
        "method",
        "runs that found the truth",
        "success rate [%]",
        "its 95 % interval",
        "runs that converged",
        "converged at wrong parameters",
        "median time [s]",
    )
    lines = []
    for each in scores:
        low, high = each.interval
        lines.append(
            (
                each.name,
                f"{each.successes} of {each.runs}",
                f"{100 * each.successes / each.runs:.0f}",
                f"{100 * low:.0f}–{100 * high:.0f}",
                str(each.converged),
                str(each.misled),
                number(each.time_s, digits=2),
            )
        )
    return markdown(heads, lines)


if __name__ == "__main__":
    main()
