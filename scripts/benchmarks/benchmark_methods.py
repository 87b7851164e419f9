"""Time of complete identifications: one simulation, reduced space, and interior point.

A cylinder with the material of table1 hangs and is swung; its tracks are simulated with the
midpoint scheme. Every run starts from the guess of table1, in a separate process. Writes a table,
JSON and plots.

    python scripts benchmark_methods                      # the paper's size, both methods
    python scripts benchmark_methods --scaling            # T = 50 … 1600, 95 … 5000 nodes
    python scripts benchmark_methods --mesh 4x32 --steps 1000 --methods reduced-space
    python scripts benchmark_methods --cluster --mesh 3x12 --steps 50   # one and two workers
    python scripts benchmark_methods --unknown --mesh 2x4 --steps 50    # cost of nuisance
    parameters
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import resource
import sys
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation
from synthetic import swing

from collocation_sysid import (
    Body,
    Collocation,
    Experiment,
    Grasp,
    Markers,
    Parameter,
    Parameters,
    simulate,
)
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import cylinder_mesh
from collocation_sysid.methods import METHODS
from collocation_sysid.methods.experiment_executors import DaskExecutor
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.parameters import Unknown
from collocation_sysid.pipeline import solve
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import with_markers, with_wrenches
from collocation_sysid.recording import Nuisance, Wrench, place_markers

DEFAULT_METHODS = ["interior-point", "reduced-space"]
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
# Rings x layers of the cylinder and number of steps, as in the paper.
PAPER_SIZE = ("2x8", 100)
# Rings x layers of the cylinder: 95 to about 5,000 nodes.
MESHES = ("2x4", "2x8", "3x12", "4x16", "4x32", "6x38")
# Numbers of time steps with --scaling.
STEPS = (50, 100, 200, 400, 800, 1600)


@dataclass(frozen=True)
class MethodRow:
    """Measurements of one run of one method: sizes, iterations, times [s] and peak memory [MB]."""

    method: str
    nodes: int
    elements: int
    steps: int
    status: str
    iterations: int
    simulation_s: float
    build_s: float
    evaluations_s: float
    linear_algebra_s: float
    total_s: float
    peak_mb: float
    kkt_residual: float
    theta_error: float

    @property
    def us_per_node_and_step(self) -> float:
        """Time of the solve per node and step [µs]."""
        return 1e6 * self.total_s / self.nodes / self.steps


def experiment_of(mesh: str, steps: int, seed: int = 0, noise_m: float = 0.0) -> Experiment:
    """Return the swung cylinder with tracks of the midpoint scheme and noise [m].

    `mesh` has the numbers of rings and layers, such as 2x8; `steps` is the number of samples.
    """
    body = Body(cylinder(mesh), density_kg_m3=20.0, damping="rayleigh")
    experiment = swung_cylinder(body, steps)
    tracks = simulate(experiment, TRUTH, "midpoint", substeps=1).markers_m
    tracks = tracks + noise_m * np.random.default_rng(seed).normal(size=tracks.shape)
    return with_markers(experiment, tracks)


def cylinder(mesh: str) -> TetMesh:
    """Return the mesh of a cylinder with numbers of rings and layers, such as 2x8."""
    rings, layers = map(int, mesh.split("x"))
    return cylinder_mesh(0.04, 0.16, rings, layers)


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


def measure(mesh: str, steps: int, method: str) -> MethodRow:
    """Identify once from the guess with compiled kernels; call this in a new process for its
    memory.
    """
    experiment = experiment_of(mesh, steps)
    began = time.perf_counter()
    simulate(experiment, TRUTH, "midpoint", substeps=1)
    simulation_s = time.perf_counter() - began
    began = time.perf_counter()
    collocation = Collocation([experiment], PARAMETERS)
    build_s = time.perf_counter() - began
    body = experiment.body
    truth = experiment.body.theta_from_values(TRUTH)
    body.linearise(body.nodes_m, 0 * body.nodes_m, truth)
    began = time.perf_counter()
    solution = METHODS[method]()(collocation)
    total_s = time.perf_counter() - began
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    # The complete Jacobian of a large problem would need more memory than the solve.
    is_small = collocation.variable_count < 500_000
    return MethodRow(
        method=method,
        nodes=len(experiment.body.nodes_m),
        elements=len(experiment.body.cells),
        steps=steps,
        status=solution.status.value,
        iterations=solution.iterations,
        simulation_s=simulation_s,
        build_s=build_s + solution.timing.build,
        evaluations_s=solution.timing.evaluations,
        linear_algebra_s=solution.timing.linear_algebra,
        total_s=total_s,
        peak_mb=peak_mb,
        kkt_residual=solution.kkt_residual if is_small else float("nan"),
        theta_error=float(np.abs(solution.theta / truth - 1).max()),
    )


def measure_in_own_process(mesh: str, steps: int, method: str) -> MethodRow:
    """Call `measure` in a new interpreter, so that the peak memory is that of this run."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(measure, (mesh, steps, method))


# Cases with nuisance parameters; each is compared with the same recording without them.
UNKNOWN_CASES = ("clock, gravity, grasp", "places as well", "with a wrench", "with memory")
MEMORY = {"prony_1.share": 0.3, "prony_1.tau_s": 0.05}
# Standard deviations of force [N] and torque [N m].
WRENCH_SIGMAS = 0.01, 0.001


def problem_with_unknowns(mesh: str, steps: int, case: str, is_ideal: bool) -> Problem:
    """Return the noisy problem of a case of `UNKNOWN_CASES`.

    If `is_ideal`, no nuisance parameters are estimated, and the places of the markers are known.
    """
    draw_noise = np.random.default_rng(0).normal
    memory = MEMORY if case == "with memory" else {}
    body = Body(cylinder(mesh), density_kg_m3=20.0, prony=["prony_1"] if memory else [])
    experiment = swung_cylinder(body, steps)
    if case == "with a wrench":
        sensor = Wrench(experiment.t_s, np.zeros((steps, 6)), *WRENCH_SIGMAS)
        grasps = [replace(grasp, wrench=sensor) for grasp in experiment.grasps]
        experiment = replace(experiment, grasps=grasps)
    simulation = simulate(experiment, TRUTH | memory, "midpoint", substeps=1)
    markers = experiment.markers
    sigmas = np.repeat(WRENCH_SIGMAS, 3)
    noisy_wrenches = [
        wrench + sigmas * draw_noise(size=wrench.shape) for wrench in simulation.wrenches
    ]
    placement = None if case == "places as well" and not is_ideal else markers.placement
    tracks = simulation.markers_m + 1e-3 * draw_noise(size=simulation.markers_m.shape)
    noisy_markers = Markers(markers.t_s, tracks, markers.sigma_m, placement=placement)
    nuisance = Nuisance.none() if is_ideal else Nuisance()
    experiment = replace(
        with_wrenches(experiment, noisy_wrenches), markers=noisy_markers, nuisance=nuisance
    )
    guesses = {
        item.name: Unknown(item.guess, item.lower, item.upper) for item in PARAMETERS.scalars
    }
    return Problem([experiment], guesses | memory, scheme="midpoint")


def measure_interior_point(
    mesh: str, steps: int, case: str, is_ideal: bool
) -> tuple[float, int, float]:
    """Return processor time [s] and iterations of interior point, and its difference from reduced
    space.

    The difference is the largest one of the transformed parameters.

    Raises
    ------
    SystemExit
        If interior point does not converge.
    """
    reference = solve(problem_with_unknowns(mesh, steps, case, is_ideal), ReducedSpace())
    began = time.process_time()
    solution = InteriorPoint()(reference.collocation)  # with the same association of the markers
    spent_s = time.process_time() - began
    if not solution.status.converged:
        raise SystemExit(f"{case}: {solution.message}")
    return (spent_s, solution.iterations, float(np.abs(solution.q - reference.q).max()))


def show_unknown(mesh: str, steps: int) -> None:
    """Print the time of interior point with nuisance parameters, divided by the time without."""
    for case in UNKNOWN_CASES:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            without, with_nuisance = (
                pool.apply(measure_interior_point, (mesh, steps, case, e)) for e in (True, False)
            )
        print(
            f"{case:22} {mesh}, {steps} steps: {without[0]:7.2f} s, {without[1]} iterations without; "
            f"{with_nuisance[0]:7.2f} s, {with_nuisance[1]} with: {with_nuisance[0] / without[0]:.2f} times; "
            f"log parameters differ from reduced space by {max(without[2], with_nuisance[2]):.1e}",
            flush=True,
        )


def print_parallel_speed(mesh: str, steps: int, experiments: int = 4, repeats: int = 3) -> None:
    """Print the times of a solve with one and two workers, and with one and two threads, in turns.

    The processor times are those of the busiest worker and of this process, which other work on the
    machine changes little. Workers have bodies, recordings and kernels before the first solve.
    """
    from distributed import Client, LocalCluster

    first_recording = experiment_of(mesh, steps)
    recordings = []
    for k in range(experiments):
        noise_m = 1e-3 * np.random.default_rng(k).normal(
            size=first_recording.markers.positions_m.shape
        )
        noisy_recording = with_markers(
            first_recording, first_recording.markers.positions_m + noise_m
        )
        recordings.append(replace(noisy_recording, name=f"swing {k}"))

    collocation = Collocation(recordings, PARAMETERS)

    def solve(workers: DaskExecutor | None, threads: int) -> tuple[float, float, float]:
        first_recording.body.threads = threads
        busy_s = workers.client.run(time.process_time) if workers else {}
        own_s = time.process_time()
        began = time.perf_counter()
        solution = ReducedSpace()(collocation, workers=workers)
        wall_s = time.perf_counter() - began
        own_s = time.process_time() - own_s
        busiest_s = 0.0
        if workers:
            after_s = workers.client.run(time.process_time)
            busiest_s = max(after_s[address] - spent_s for address, spent_s in busy_s.items())
        print(f"  {solution.status.value} after {solution.iterations} sweeps: {wall_s:.2f} s")
        return wall_s, busiest_s, own_s

    with ExitStack() as stack:
        clusters: list[DaskExecutor] = []
        for count in (1, 2):
            cluster = LocalCluster(n_workers=count, threads_per_worker=1, dashboard_address=":0")
            client = stack.enter_context(Client(stack.enter_context(cluster)))
            clusters.append(DaskExecutor(client))
        cases = {
            "one worker": (clusters[0], 1),
            "two workers": (clusters[1], 1),
            "one thread": (None, 1),
            "two threads": (None, 2),
        }
        for case in cases.values():
            solve(*case)  # compiles
        times = {name: [] for name in cases}
        for _ in range(repeats):
            for name, case in cases.items():
                times[name].append(solve(*case))
    print(
        f"{experiments} experiments, {mesh}, {steps} samples, load average {os.getloadavg()[0]:.1f}"
    )
    for name, measured_s in times.items():
        wall_s, busiest_s, own_s = np.median(measured_s, axis=0)
        print(
            f"{name:12} wall time {wall_s:6.2f} s; processor time "
            f"{busiest_s:6.2f} s of the busiest worker, {own_s:6.2f} s of this process"
        )


def print_row(row: MethodRow) -> None:
    """Print one row."""
    print(
        f"{row.method:15s} {row.nodes:5d} nodes {row.steps:5d} steps  {row.status:10s} "
        f"{row.iterations:3d} iterations  total {row.total_s:8.2f} s "
        f"(build {row.build_s:.2f}, evaluations {row.evaluations_s:.2f}, "
        f"linear algebra {row.linear_algebra_s:.2f})  "
        f"simulation {row.simulation_s:.2f} s  {row.us_per_node_and_step:8.1f} µs/node/step  "
        f"{row.peak_mb:6.0f} MB  KKT {row.kkt_residual:.1e}  θ error {row.theta_error:.1e}",
        flush=True,
    )


def plot(rows: list[MethodRow], folder: Path) -> None:
    """Write a figure of the times over steps and over nodes to `benchmark_methods.png`."""
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    for panel, (key, fixed) in enumerate((("steps", "nodes"), ("nodes", "steps"))):
        axes = figure.add_subplot(1, 2, panel + 1)
        for method in sorted({row.method for row in rows}):
            method_rows = [row for row in rows if row.method == method]
            values = [getattr(row, fixed) for row in method_rows]
            common_value = max(set(values), key=values.count)
            chosen = sorted(
                (row for row in method_rows if getattr(row, fixed) == common_value),
                key=lambda row: getattr(row, key),
            )
            x = [getattr(row, key) for row in chosen]
            axes.loglog(
                x, [row.total_s for row in chosen], "o-", label=f"{method}, {common_value} {fixed}"
            )
            axes.loglog(x, [row.simulation_s for row in chosen], ":", color="0.5")
        axes.set(xlabel=key, ylabel="s (dotted: one simulation)")
        axes.legend(frameon=False, fontsize=8)
    figure.savefig(folder / "benchmark_methods.png", dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--mesh", nargs="*", default=[PAPER_SIZE[0]], help="rings x layers")
    parser.add_argument("--steps", nargs="*", type=int, default=[PAPER_SIZE[1]])
    parser.add_argument("--methods", nargs="*", default=DEFAULT_METHODS, choices=list(METHODS))
    parser.add_argument(
        "--scaling",
        action="store_true",
        help="reduced space with several numbers of steps and meshes",
    )
    parser.add_argument("--out", type=Path, default=Path("results"))
    parser.add_argument("--json", action="store_true")
    parser.add_argument(
        "--cluster", action="store_true", help="four experiments on one and two workers"
    )
    parser.add_argument(
        "--unknown",
        action="store_true",
        help="cost of nuisance parameters, unknown places, wrench and memory",
    )
    arguments = parser.parse_args()
    if arguments.unknown:
        show_unknown(arguments.mesh[0], arguments.steps[0])
        return
    if arguments.cluster:
        print_parallel_speed(arguments.mesh[0], arguments.steps[0])
        return
    cases = [(m, t, k) for m in arguments.mesh for t in arguments.steps for k in arguments.methods]
    if arguments.scaling:
        cases = [(PAPER_SIZE[0], steps, "reduced-space") for steps in STEPS]
        cases += [(mesh, PAPER_SIZE[1], "reduced-space") for mesh in MESHES if mesh != "2x8"]
    rows = []
    for case in cases:
        rows.append(measure_in_own_process(*case))
        if not arguments.json:
            print_row(rows[-1])
    arguments.out.mkdir(parents=True, exist_ok=True)
    content = json.dumps([asdict(row) for row in rows], indent=1)
    (arguments.out / "benchmark_methods.json").write_text(content + "\n")
    plot(rows, arguments.out)
    if arguments.json:
        sys.stdout.write(content + "\n")


if __name__ == "__main__":
    main()
