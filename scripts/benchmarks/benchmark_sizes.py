"""Time and memory of a simulation and a sweep of bodies with 500 to 20,000 nodes.

The body is a swung cylinder with the default damping law. Each line is measured in a separate
process, so that the peak memory is that of the line. On one thread, times are
processor times, which other work on the machine changes little; on more threads they are wall
times. A sweep consists of a feasibility step and the sensitivities to four parameters; a few time
steps are enough to measure the cost of one.

    python scripts benchmark_sizes                 # all sizes, one and two threads
    python scripts benchmark_sizes --size 5000
"""

from __future__ import annotations

import multiprocessing
import resource
import time
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from script_arguments import make_parser
from synthetic import swing

from collocation_sysid import Body, Collocation, Experiment, Grasp, Markers, Parameter, Parameters
from collocation_sysid.fem.meshes.structured import cylinder_mesh
from collocation_sysid.program.forward.newton_solver import NewtonOptions
from collocation_sysid.program.forward.scheme_simulation import continue_simulation
from collocation_sysid.program.stopwatch import Stopwatch
from collocation_sysid.program.sweep import Sweep
from collocation_sysid.recording import Nuisance, place_markers

TRUTH = {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0}
PARAMETERS = Parameters(
    (
        Parameter("lambda_pa", 400.0, 10.0, 1e5),
        Parameter("mu_pa", 150.0, 10.0, 1e5),
        Parameter("gamma_r_s", 0.02, 1e-5, 1.0),
        Parameter("gamma_m_1_s", 0.5, 1e-3, 100.0),
    )
)
# Sampling interval [s].
STEP_S = 0.01
# Rings x layers of the cylinder, element, and a sufficient number of time steps, by number of
# nodes.
SIZES = {
    "500": ("3x12", "tet4", 40),
    "2000": ("4x32", "tet4", 20),
    "2000-tet10": ("2x16", "tet10", 20),
    "5000": ("6x38", "tet4", 10),
    "20000": ("10x60", "tet4", 3),
}


@dataclass(frozen=True)
class PartCost:
    """Total time of one part [s], and the stopwatch with its shares."""

    total_s: float
    stopwatch: Stopwatch

    def as_text(self, steps: int) -> str:
        """Return the time per step and the shares of evaluation and linear algebra, as text."""
        stopwatch = self.stopwatch
        shares = (stopwatch.evaluations / self.total_s, stopwatch.linear_algebra / self.total_s)
        return (
            f"{1e3 * self.total_s / steps:8.1f} ms per step (elements {shares[0]:4.0%}, "
            f"linear algebra {shares[1]:4.0%})"
        )


def main() -> None:
    """Run the benchmark with the options of the command line, and print its table."""
    parser = make_parser(__doc__)
    parser.add_argument("--size", nargs="+", choices=[*SIZES], default=[*SIZES])
    arguments = parser.parse_args()
    for size in arguments.size:
        for threads in (1, 2):
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                print(pool.apply(measure_size, (size, threads)), flush=True)


def swung_cylinder(body: Body, steps: int) -> Experiment:
    """Return the recording of a hanging, swung cylinder without tracks, with `steps` samples."""
    t_s = np.arange(steps, dtype=np.float64) * STEP_S
    poses = swing(
        t_s,
        amplitude_m=(0.05, 0.04, 0.03),
        amplitude_rad=(0.1, 0.1, 0.6),
        frequency_hz=(0.9, 1.1, 1.3),
        rise_s=0.3,
        start=Rotation.from_rotvec([np.pi, 0, 0]),
    )
    angle = np.arange(8) * 2.4
    height = np.linspace(0.04, 0.16, 8)
    places_m = np.column_stack([0.035 * np.cos(angle), 0.035 * np.sin(angle), height])
    placement = place_markers(places_m, body.nodes_m, body, "vertex")
    markers = Markers(t_s, np.zeros((steps, 8, 3)), 0.001, placement=placement)
    clamped_nodes = np.flatnonzero(body.nodes_m[:, 2] < 1e-9)
    grasp = Grasp(clamped_nodes, poses)
    no_nuisance = Nuisance.none()
    return Experiment(body, t_s, [grasp], markers, name="swing", nuisance=no_nuisance)


def measure_size(size: str, threads: int) -> str:
    """Measure simulation and sweep of one body (a key of `SIZES`), and return a line of the table."""
    mesh, element, steps = SIZES[size]
    rings, layers = map(int, mesh.split("x"))
    shape = cylinder_mesh(0.04, 0.16, rings, layers)
    body = Body(shape, density_kg_m3=20.0, element=element, threads=threads)
    collocation = Collocation([swung_cylinder(body, steps + 1)], PARAMETERS)
    (transcription,) = collocation.transcriptions
    equations = transcription.equations_at(
        np.log([TRUTH[name] for name in PARAMETERS.names]), np.zeros(0)
    )
    clock = time.perf_counter if threads > 1 else time.process_time
    began = clock()
    stopwatch = Stopwatch(clock)
    x, failure = continue_simulation(
        transcription.experiment,
        equations.dynamics,
        options=NewtonOptions(tolerance=1e-6),
        stopwatch=stopwatch,
    )
    if failure:
        raise failure
    simulation_cost = PartCost(clock() - began, stopwatch)
    stopwatch = Stopwatch(clock)
    solver = Sweep(transcription, stopwatch=stopwatch)
    # The symbolic factorisation is computed once for all sweeps; accessing this computes it.
    solver.estimate_chunk_bytes()
    began = clock()
    solver.forward(x, equations)
    sweep_cost = PartCost(clock() - began, stopwatch)
    return (
        f"{len(body.nodes_m):6d} nodes {element:5s} {steps:4d} steps {threads} threads "
        f"{factorisation_name(solver):10s} simulation {simulation_cost.as_text(steps)}  "
        f"sweep {sweep_cost.as_text(steps)}  "
        f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB"
    )


def factorisation_name(solver: Sweep) -> str:
    """Return the name of the factorisation that a sweep uses."""
    factoriser = solver.factoriser
    if factoriser.skyline:
        return "skyline"
    return (
        "band" if factoriser.is_banded else "supernodal" if factoriser.is_supernodal else "sparse"
    )


if __name__ == "__main__":
    main()
