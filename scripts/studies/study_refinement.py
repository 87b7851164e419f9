"""Coverage of intervals for noise and discretisation, for twins of a finer mesh and time step.

    python scripts study_refinement [--twins 20] [--first 0]

A block of linear and a bar of quadratic elements are moved at random. Their markers are simulated
with random parameters, with every tetrahedron divided into 64 and a quarter of the time step, and
with noise. The twins are fitted on the coarse mesh and refined once. The output has the share of 95
% intervals that contain the truth: for independent noise alone, and with the numerical error.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from coverage_runner import Intervals, count_coverage
from script_arguments import make_parser
from twins import random_poses

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.model.parameters import Unknown
from collocation_sysid.pipeline import solve
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Grasp, Markers, Nuisance
from collocation_sysid.runs.numerical_error import finer_mesh, solve_refined
from collocation_sysid.runs.warm_start import WarmStart
from collocation_sysid.statistics.curved_intervals import uncertainty_at
from collocation_sysid.statistics.uncertainty import ErrorModel

# Standard deviation of each marker coordinate [m]: so small that the numerical error is visible.
NOISE_M = 5e-5
# Number of samples, and the time between them [s].
SAMPLES = 20
STEP_S = 0.01
# Edges [m] and numbers of elements of the bodies; their elements and typical stiffnesses [Pa].
BODIES = {"block": ((0.06, 0.06, 0.09), (2, 2, 2)), "bar": ((0.04, 0.04, 0.06), (1, 1, 1))}
ELEMENTS = {"block": "tet4", "bar": "tet10"}
YOUNG_PA = {"block": 1e3, "bar": 500.0}
NAMES = ("young_pa", "poisson", "gamma_r_s", "gamma_m_1_s")


def random_truth(name: str, rng: np.random.Generator) -> dict[str, float]:
    """Return true parameters of a body, drawn at random around its typical values."""
    young_pa = YOUNG_PA[name] * float(np.exp(rng.uniform(-0.5, 0.5)))
    damping = {"gamma_r_s": 0.004 * np.exp(rng.uniform(-0.5, 0.5)), "gamma_m_1_s": 1.0}
    return {"young_pa": young_pa, "poisson": float(rng.uniform(0.15, 0.4)), **damping}


def unmeasured_problem(name: str, rng: np.random.Generator) -> tuple[Problem, dict[str, float]]:
    """Return a problem without measurements, and its true parameters."""
    size_m, divisions = BODIES[name]
    body = Body(box_mesh(size_m, divisions), density_kg_m3=30.0, element=ELEMENTS[name])
    t_s = STEP_S * np.arange(SAMPLES)
    grasped_nodes = np.flatnonzero(body.nodes_m[:, 2] > size_m[2] - 1e-6)
    free_nodes = np.setdiff1d(np.arange(len(body.nodes_m)), grasped_nodes)
    places_m = body.nodes_m[rng.choice(free_nodes, 6, replace=False)]
    markers = Markers(t_s, np.zeros((SAMPLES, 6, 3)), NOISE_M, places_m=places_m)
    grasp = Grasp(grasped_nodes, random_poses(t_s, rng))
    experiment = Experiment(body, t_s, [grasp], markers, name=name, nuisance=Nuisance.none())
    truth = random_truth(name, rng)
    guess = {
        "young_pa": Unknown(truth["young_pa"], 10.0, 1e6),
        "poisson": Unknown(truth["poisson"], 0.01, 0.499),
        "gamma_r_s": Unknown(truth["gamma_r_s"], 1e-6, 1.0),
        "gamma_m_1_s": truth["gamma_m_1_s"],
    }
    return Problem([experiment], guess), truth


def twin(name: str, seed: int) -> tuple[Problem, dict[str, float]]:
    """Return a coarse problem with tracks of a fine simulation, and its true parameters."""
    rng = np.random.default_rng(seed)
    coarse, truth = unmeasured_problem(name, rng)
    (fine,) = finer_mesh(finer_mesh(coarse)).experiments
    tracks = simulate(fine, truth, "midpoint", substeps=4).markers_m
    noise = rng.normal(scale=NOISE_M, size=tracks.shape)
    return replace(coarse, experiments=[with_markers(coarse.experiments[0], tracks + noise)]), truth


def intervals(problem: Problem) -> Intervals:
    """Return the intervals for independent noise, and with the numerical error by a refinement."""
    solution = solve(problem)
    error_model = ErrorModel(errors="independent")
    estimates = uncertainty_at(solution.collocation, solution.z, error_model).estimates
    errors = solve_refined(problem, WarmStart.of(solution), estimates).errors
    found = {}
    for name in NAMES[:3]:
        error = errors.get(name)
        found[f"{name}, noise"] = estimates[name].statistical95
        found[f"{name}, numerical error"] = None if error is None else error.interval95
    return found


def main(twins: int = 20, first: int = 0) -> None:
    """Print the shares of intervals that contain the truth.

    `twins` is the number of twins of each body, `first` the first seed.
    """
    every = (twin(name, seed) for seed in range(first, first + twins) for name in BODIES)
    print(count_coverage(every, intervals).table())


if __name__ == "__main__":
    parser = make_parser(__doc__)
    parser.add_argument("--twins", type=int, default=20, help="of each body")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    options = parser.parse_args()
    main(options.twins, options.first)
