"""Interior point from distant initial guesses, and from the answer of reduced space.

A soft bar (90 nodes, 91 samples) is clamped at one end and swung. Its nine markers have unknown
places, the nuisance parameters are those that are estimated by default, the number of time steps
per sample is chosen by the run, and the four parameters are guessed wrong by factors of 3, 3, 3.6
and 3. Prints processor time, iterations of IPOPT (of all solves together, where the run solves
again with more steps), and the largest difference of the logarithm of a parameter from that of
reduced space.

    python scripts benchmark_distant_guesses                    # the full size, all cases
    python scripts benchmark_distant_guesses --cells 5 2 2 --samples 41 --cases distant warm
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from synthetic import Swing

from collocation_sysid import pipeline
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.parameters import Unknown
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Grasp, Markers, Nuisance

TRUTH = {"lambda_pa": 1300.0, "mu_pa": 870.0, "gamma_r_s": 0.01, "gamma_m_1_s": 0.5}
# Initial guesses over true values.
GUESS_FACTORS = {"lambda_pa": 1 / 3, "mu_pa": 1 / 3, "gamma_r_s": 3.6, "gamma_m_1_s": 3.0}
BOUNDS = {
    "lambda_pa": (1.0, 1e6),
    "mu_pa": (1.0, 1e6),
    "gamma_r_s": (1e-5, 1.0),
    "gamma_m_1_s": (1e-3, 100.0),
}
# Edges of the bar [m].
SIZE_M = (0.22, 0.035, 0.05)
DENSITY_KG_M3 = 95.0
# Sampling interval [s], and standard deviation of each marker coordinate [m].
STEP_S = 0.01
NOISE_M = 5e-4
MARKER_COUNT = 9
# Seed of the choice of marked nodes and of the noise.
SEED = 1
# "none": without nuisance parameters; "distant": with the default ones; "warm": as "distant",
# started from the run folder of reduced space.
CASES = ("none", "distant", "warm")


def bar(divisions: Sequence[int], samples: int, *, ideal: bool) -> Problem:
    """Return the soft bar with noisy markers of unknown places and distant guesses.

    Parameters
    ----------
    divisions : tuple of int
        Cells of the mesh along the three edges; (9, 2, 2) has 90 nodes.
    samples : int
        Camera frames, `STEP_S` apart.
    ideal : bool
        Without nuisance parameters, and with markers at known places.
    """
    body = Body(box_mesh(SIZE_M, divisions), density_kg_m3=DENSITY_KG_M3)
    motion = Swing(
        duration_s=(samples - 1) * STEP_S,
        amplitude_m=(0.03, 0.04, 0.03),
        amplitude_rad=(0.2, 0.3, 0.3),
        frequency_hz=(1.1, 1.4, 1.7),
        rise_s=0.3,
        start=Rotation.identity(),
    )
    poses = motion.poses(STEP_S)
    clamped_nodes = np.flatnonzero(body.nodes_m[:, 0] < 1e-9)
    free_nodes = np.flatnonzero(body.nodes_m[:, 0] >= 1e-9)
    rng = np.random.default_rng(SEED)
    places_m = body.nodes_m[np.sort(rng.choice(free_nodes, MARKER_COUNT, replace=False))]
    markers = Markers(poses.t_s, np.zeros((samples, MARKER_COUNT, 3)), NOISE_M, places_m=places_m)
    experiment = Experiment(
        body, poses.t_s, [Grasp(clamped_nodes, poses)], markers, name="soft bar"
    )
    tracks = simulate(experiment, TRUTH, timestep_s=STEP_S / 8).markers_m
    tracks = tracks + NOISE_M * rng.normal(size=tracks.shape)
    if ideal:
        description = replace(with_markers(experiment, tracks), nuisance=Nuisance.none())
    else:
        unplaced_markers = Markers(poses.t_s, tracks, NOISE_M, markers.names)
        description = replace(experiment, markers=unplaced_markers, nuisance=Nuisance())
    guesses = {
        name: Unknown(value * GUESS_FACTORS[name], *BOUNDS[name]) for name, value in TRUTH.items()
    }
    return Problem([description], guesses, scheme="midpoint")


def print_comparison(case: str, divisions: Sequence[int], samples: int) -> None:
    """Solve one of `CASES` by reduced space and by interior point, and print times and differences.

    `divisions` and `samples` are those of `bar`.
    """
    problem = bar(divisions, samples, ideal=case == "none")
    began_s = time.process_time()
    reference = pipeline.run(problem, ReducedSpace(), seek_causes=False)
    reference_s = time.process_time() - began_s
    with tempfile.TemporaryDirectory() as folder:
        start = reference.save(Path(folder) / "reduced-space") if case == "warm" else None
        began_s = time.process_time()
        answer = pipeline.run(problem, InteriorPoint(), start=start, seek_causes=False)
        answer_s = time.process_time() - began_s
    solution = answer.solution
    log_differences = np.log(
        [solution.parameters[n] / reference.solution.parameters[n] for n in TRUTH]
    )
    print(
        f"{case}: {solution.status.value}, {solution.iterations} iterations of IPOPT, "
        f"{solution.collocation.substeps} time steps per sample, {answer_s:.1f} s of processor time; "
        f"reduced space {reference.solution.iterations} sweeps, {reference_s:.1f} s; "
        f"log parameters differ by {np.abs(log_differences).max():.1e}",
        flush=True,
    )
    for note in solution.notes:
        print(f"    {note}")


def main() -> None:
    """Run the cases that the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--cells",
        nargs=3,
        type=int,
        default=[9, 2, 2],
        help="cells of the mesh along the three edges",
    )
    parser.add_argument("--samples", type=int, default=91)
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=CASES)
    arguments = parser.parse_args()
    for case in arguments.cases:
        print_comparison(case, arguments.cells, arguments.samples)


if __name__ == "__main__":
    main()
