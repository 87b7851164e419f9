"""Time whole identifications: simulation alone, reduced space, and interior point where it can run.

A cylinder of table1's material is hung, swung, and "measured" by the midpoint scheme itself;
every run starts from table1's guess in a process of its own. Writes a table, JSON and plots.

    python scripts/benchmark_methods.py                      # the paper's size, both methods
    python scripts/benchmark_methods.py --scaling            # T = 50 … 1600, 95 … 5000 nodes
    python scripts/benchmark_methods.py --mesh 4x32 --steps 1000 --methods reduced-space
    python scripts/benchmark_methods.py --cluster --mesh 3x12 --steps 50   # one and two workers
    python scripts/benchmark_methods.py --unknown --mesh 2x4 --steps 50    # what is not known costs
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

BOTH = ["interior-point", "reduced-space"]
TRUTH = {
    "lambda_pa": 200.0,
    "mu_pa": 300.0,
    "gamma_r_s": 0.009,
    "gamma_m_1_s": 1.0,
}
PARAMETERS = Parameters(
    (
        Parameter("lambda_pa", 400.0, 10.0, 1e5),
        Parameter("mu_pa", 150.0, 10.0, 1e5),
        Parameter("gamma_r_s", 0.02, 1e-5, 1.0),
        Parameter("gamma_m_1_s", 0.5, 1e-3, 100.0),
    )
)
STEP_S = 0.01
PAPER_SIZE = ("2x8", 100)
# Rings x layers of the cylinder: 95 to about 5,000 nodes.
MESHES = ("2x4", "2x8", "3x12", "4x16", "4x32", "6x38")
STEPS = (50, 100, 200, 400, 800, 1600)


@dataclass(frozen=True)
class Row:
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
        """Cost of the whole solve over nodes and steps."""
        return 1e6 * self.total_s / self.nodes / self.steps


def experiment_of(
    mesh: str, steps: int, seed: int = 0, noise_m: float = 0.0
) -> Experiment:
    """A hung and swung cylinder with tracks from the midpoint scheme."""
    body = Body(cylinder(mesh), density_kg_m3=20.0, damping="rayleigh")
    experiment = swung(body, steps)
    tracks = simulate(experiment, TRUTH, "midpoint", substeps=1).markers_m
    tracks = tracks + noise_m * np.random.default_rng(seed).normal(
        size=tracks.shape
    )
    return with_markers(experiment, tracks)


def cylinder(mesh: str) -> TetMesh:
    """The cylinder of so many rings and layers."""
    rings, layers = map(int, mesh.split("x"))
    return cylinder_mesh(0.04, 0.16, rings, layers)


def swung(body: Body, steps: int) -> Experiment:
    """A cylinder hung by its base and swung, its markers still to be seen."""
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
    places = np.column_stack(
        [0.035 * np.cos(angle), 0.035 * np.sin(angle), height]
    )
    placement = place_markers(places, body.nodes_m, body, "vertex")
    markers = Markers(t_s, np.zeros((steps, 8, 3)), 0.001, placement=placement)
    held = np.flatnonzero(body.nodes_m[:, 2] < 1e-9)
    grasp = Grasp(held, poses)
    ideal = Nuisance.none()
    return Experiment(body, t_s, [grasp], markers, name="swing", nuisance=ideal)


def measure(mesh: str, steps: int, method: str) -> Row:
    """One identification from the guess; kernels are warm, the process is fresh."""
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
    # The full Jacobian of a large problem would take more memory than its solution did.
    small = collocation.variable_count < 500_000
    return Row(
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
        kkt_residual=solution.kkt_residual if small else float("nan"),
        theta_error=float(np.abs(solution.theta / truth - 1).max()),
    )


def in_own_process(mesh: str, steps: int, method: str) -> Row:
    """`measure` in a fresh interpreter, so that peak memory is its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(measure, (mesh, steps, method))


# What may not be known, each beside the same with nothing unknown but the parameters.
UNKNOWN = (
    "clock, gravity, grasp",
    "places as well",
    "with a wrench",
    "with memory",
)
MEMORY = {"prony_1.share": 0.3, "prony_1.tau_s": 0.05}
WRENCH_SIGMAS = 0.01, 0.001


def problem_of(mesh: str, steps: int, case: str, ideal: bool) -> Problem:
    """A recording with noise and what is unknown by default, or nothing."""
    noise = np.random.default_rng(0).normal
    memory = MEMORY if case == "with memory" else {}
    body = Body(
        cylinder(mesh), density_kg_m3=20.0, prony=["prony_1"] if memory else []
    )
    experiment = swung(body, steps)
    if case == "with a wrench":
        sensor = Wrench(experiment.t_s, np.zeros((steps, 6)), *WRENCH_SIGMAS)
        grasps = [replace(grasp, wrench=sensor) for grasp in experiment.grasps]
        experiment = replace(experiment, grasps=grasps)
    made = simulate(experiment, TRUTH | memory, "midpoint", substeps=1)
    markers = experiment.markers
    sigmas = np.repeat(WRENCH_SIGMAS, 3)
    felt = [
        wrench + sigmas * noise(size=wrench.shape) for wrench in made.wrenches
    ]
    placement = (
        None if case == "places as well" and not ideal else markers.placement
    )
    tracks = made.markers_m + 1e-3 * noise(size=made.markers_m.shape)
    seen = Markers(markers.t_s, tracks, markers.sigma_m, placement=placement)
    nuisance = Nuisance.none() if ideal else Nuisance()
    experiment = replace(
        with_wrenches(experiment, felt), markers=seen, nuisance=nuisance
    )
    guesses = {
        item.name: Unknown(item.guess, item.lower, item.upper)
        for item in PARAMETERS.scalars
    }
    return Problem([experiment], guesses | memory, scheme="midpoint")


def identified(
    mesh: str, steps: int, case: str, ideal: bool
) -> tuple[float, int, float]:
    """Processor time and iterations of interior point, and how far reduced space ends from it."""
    expected = solve(problem_of(mesh, steps, case, ideal), ReducedSpace())
    began = time.process_time()
    found = InteriorPoint()(expected.collocation)  # where its markers are read
    spent_s = time.process_time() - began
    if not found.status.converged:
        raise SystemExit(f"{case}: {found.message}")
    return spent_s, found.iterations, float(np.abs(found.q - expected.q).max())


def show_unknown(mesh: str, steps: int) -> None:
    """Print the time of interior point with nuisance parameters, divided by the time without."""
    for case in UNKNOWN:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            ideal, whole = (
                pool.apply(identified, (mesh, steps, case, e))
                for e in (True, False)
            )
        print(
            f"{case:22} {mesh}, {steps} steps: {ideal[0]:7.2f} s, {ideal[1]} iterations without; "
            f"{whole[0]:7.2f} s, {whole[1]} with: {whole[0] / ideal[0]:.2f} times; "
            f"log parameters off reduced space's by {max(ideal[2], whole[2]):.1e}",
            flush=True,
        )


def shared_out(
    mesh: str, steps: int, experiments: int = 4, repeats: int = 3
) -> None:
    """Print how much faster two workers, and two threads, are than one, in turns.

    Beside the wall's time stands processor time, of the busiest worker and of this process, which
    other work on the machine lengthens little. Bodies and recordings are there already, as threads
    have them, and so are the kernels.
    """
    from distributed import Client, LocalCluster

    first = experiment_of(mesh, steps)
    recordings = []
    for k in range(experiments):
        noise_m = 1e-3 * np.random.default_rng(k).normal(
            size=first.markers.positions_m.shape
        )
        made = with_markers(first, first.markers.positions_m + noise_m)
        recordings.append(replace(made, name=f"swing {k}"))

    collocation = Collocation(recordings, PARAMETERS)

    def solve(
        workers: DaskExecutor | None, threads: int
    ) -> tuple[float, float, float]:
        first.body.threads = threads
        busy_s = workers.client.run(time.process_time) if workers else {}
        here_s = time.process_time()
        began = time.perf_counter()
        solution = ReducedSpace()(collocation, workers=workers)
        wall_s = time.perf_counter() - began
        here_s = time.process_time() - here_s
        busiest_s = 0.0
        if workers:
            after_s = workers.client.run(time.process_time)
            busiest_s = max(
                after_s[address] - spent_s
                for address, spent_s in busy_s.items()
            )
        print(
            f"  {solution.status.value} after {solution.iterations} sweeps: {wall_s:.2f} s"
        )
        return wall_s, busiest_s, here_s

    with ExitStack() as stack:
        clusters: list[DaskExecutor] = []
        for count in (1, 2):
            cluster = LocalCluster(
                n_workers=count, threads_per_worker=1, dashboard_address=":0"
            )
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
        f"{experiments} experiments, {mesh}, {steps} samples, {os.getloadavg()[0]:.1f} at work"
    )
    for name, found in times.items():
        wall_s, busiest_s, here_s = np.median(found, axis=0)
        print(
            f"{name:12} {wall_s:6.2f} s; processors {busiest_s:6.2f} s there {here_s:6.2f} s here"
        )


def show(row: Row) -> None:
    print(
        f"{row.method:15s} {row.nodes:5d} nodes {row.steps:5d} steps  {row.status:10s} "
        f"{row.iterations:3d} iterations  total {row.total_s:8.2f} s "
        f"(build {row.build_s:.2f}, evaluations {row.evaluations_s:.2f}, "
        f"linear algebra {row.linear_algebra_s:.2f})  "
        f"simulation {row.simulation_s:.2f} s  {row.us_per_node_and_step:8.1f} µs/node/step  "
        f"{row.peak_mb:6.0f} MB  KKT {row.kkt_residual:.1e}  θ error {row.theta_error:.1e}",
        flush=True,
    )


def plot(rows: list[Row], folder: Path) -> None:
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    for place, (key, fixed) in enumerate(
        (("steps", "nodes"), ("nodes", "steps"))
    ):
        axes = figure.add_subplot(1, 2, place + 1)
        for method in sorted({row.method for row in rows}):
            common = [row for row in rows if row.method == method]
            values = [getattr(row, fixed) for row in common]
            most = max(set(values), key=values.count)
            chosen = sorted(
                (row for row in common if getattr(row, fixed) == most),
                key=lambda row: getattr(row, key),
            )
            x = [getattr(row, key) for row in chosen]
            axes.loglog(
                x,
                [row.total_s for row in chosen],
                "o-",
                label=f"{method}, {most} {fixed}",
            )
            axes.loglog(
                x, [row.simulation_s for row in chosen], ":", color="0.5"
            )
        axes.set(xlabel=key, ylabel="s (dotted: one simulation)")
        axes.legend(frameon=False, fontsize=8)
    figure.savefig(folder / "benchmark_methods.png", dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--mesh", nargs="*", default=[PAPER_SIZE[0]], help="rings x layers"
    )
    parser.add_argument("--steps", nargs="*", type=int, default=[PAPER_SIZE[1]])
    parser.add_argument(
        "--methods", nargs="*", default=BOTH, choices=list(METHODS)
    )
    parser.add_argument(
        "--scaling", action="store_true", help="reduced space over T and meshes"
    )
    parser.add_argument("--out", type=Path, default=Path("results"))
    parser.add_argument("--json", action="store_true")
    parser.add_argument(
        "--cluster",
        action="store_true",
        help="four experiments on 1, 2 workers",
    )
    parser.add_argument(
        "--unknown",
        action="store_true",
        help="nuisances, places, wrench, memory",
    )
    arguments = parser.parse_args()
    if arguments.unknown:
        show_unknown(arguments.mesh[0], arguments.steps[0])
        return
    if arguments.cluster:
        shared_out(arguments.mesh[0], arguments.steps[0])
        return
    cases = [
        (m, t, k)
        for m in arguments.mesh
        for t in arguments.steps
        for k in arguments.methods
    ]
    if arguments.scaling:
        cases = [(PAPER_SIZE[0], steps, "reduced-space") for steps in STEPS]
        cases += [
            (mesh, PAPER_SIZE[1], "reduced-space")
            for mesh in MESHES
            if mesh != "2x8"
        ]
    rows = []
    for case in cases:
        rows.append(in_own_process(*case))
        if not arguments.json:
            show(rows[-1])
    arguments.out.mkdir(parents=True, exist_ok=True)
    content = json.dumps([asdict(row) for row in rows], indent=1)
    (arguments.out / "benchmark_methods.json").write_text(content + "\n")
    plot(rows, arguments.out)
    if arguments.json:
        sys.stdout.write(content + "\n")


if __name__ == "__main__":
    main()
