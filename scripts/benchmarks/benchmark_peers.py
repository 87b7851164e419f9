"""Time to the answer of this project and of other tools, for one recording.

A soft cylinder (95 nodes, 288 tetrahedra, simulated by MuJoCo's flex) hangs from a hand and is
swung for half a second. Six markers with 0.1 mm of noise are measured; Young's modulus, Poisson's
ratio and the damping time are unknown. Every candidate has the same recording, mesh, guess and
bounds, one core and a separate process. The answer is reached when all parameters stay within
1 % of the best answer, the least-squares estimate at sixteen time steps per sample. Times are
computing times: unlike elapsed times they do not depend on what else the machine does. MuJoCo with
its extra is required: ``pip install 'mujoco[sysid]'``.

    python scripts benchmark_peers
    python scripts benchmark_peers --only reduced-space mujoco-sysid
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from peer_case import (
    BOUNDS,
    GUESS,
    MARKED_NODES,
    NOISE_M,
    STEPS_PER_SAMPLE,
    TRUTH,
    cylinder,
    recording,
)
from peer_simulators import RECORDING_STEP_S, UnstableSimulationError, simulate_flex
from scipy.optimize import least_squares
from script_arguments import make_parser
from studies import markdown

import collocation_sysid as cs

Array = NDArray[np.float64]
# Function of the logarithms of the parameters.
Function = Callable[[Array], Array]

# Relative distance from the best answer within which the answer counts as reached.
REACHED_SHARE = 0.01
# Time steps per sample of the best answer, whose time error is negligible.
BEST_STEPS_PER_SAMPLE = 16
# Residuals of a simulation that fails, in standard deviations of the noise.
FAILED_RESIDUAL = 1e3
# Step of forward differences of simulations that are solved to about 1e-8 [relative].
DIFFERENCE_STEP = 1e-4


def computing_time_s() -> float:
    """Return the computing time of this process and of its finished children [s]."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


@dataclass
class Progress:
    """Parameter values of a search over time."""

    # Computing time when the search began [s].
    began_s: float = field(default_factory=computing_time_s)
    # Times of the entries since the beginning [s].
    times_s: list[float] = field(default_factory=list)
    # Best values so far at these times, by parameter name.
    values: list[dict[str, float]] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)  # number of simulated motions at these times
    best_loss: float = np.inf  # sum of squared residuals of the last entry
    simulations: int = 0  # number of simulated motions

    @property
    def passed_s(self) -> float:
        """Computing time since the beginning [s]."""
        return computing_time_s() - self.began_s

    def record(self, values: Mapping[str, float], loss: float) -> None:
        """Count a simulation, and append an entry if its loss is the smallest so far."""
        self.simulations += 1
        if loss < self.best_loss:
            self.best_loss = loss
            self.append(values, self.passed_s)

    def append(self, values: Mapping[str, float], time_s: float) -> None:
        """Append the values of the parameters at a time, with the number of simulations so far."""
        self.times_s.append(time_s)
        self.values.append(dict(values))
        self.counts.append(self.simulations)


@dataclass(frozen=True)
class Track:
    """Result of a candidate."""

    times_s: list[float]  # times of the entries [s]
    values: list[dict[str, float]]  # parameter values of the entries
    counts: list[int]  # simulated motions until the entries; for interior point iterations
    total_s: float  # time until the candidate stops [s]
    simulations: int  # simulated motions until the candidate stops


# Candidates ---------------------------------------------------------------------------------------


def solve_with(
    method: str,
    experiment: cs.Experiment,
    progress: Progress,
    *,
    steps_per_sample: int = STEPS_PER_SAMPLE,
) -> None:
    """Solve by a method of this project."""
    unknown = {name: cs.Unknown(GUESS[name], *BOUNDS[name]) for name in GUESS}
    problem = cs.Problem(
        [experiment], {**unknown, "gamma_m_1_s": 0.0}, substeps=steps_per_sample, method=method
    )

    def watch(entry: cs.Iteration) -> None:
        progress.simulations += 1
        values = {name: entry.parameters[name] for name in GUESS}
        progress.append(values, progress.passed_s)

    solution = cs.solve(problem, watch=watch)
    values = {name: solution.parameters[name] for name in GUESS}
    progress.append(values, progress.passed_s)


def search(
    simulate: Callable[[dict[str, float]], Array], experiment: cs.Experiment, progress: Progress
) -> None:
    """Minimise the residuals of a simulation by SciPy, with forward differences."""
    low, high = np.log(np.array(list(BOUNDS.values()))).T
    least_squares(
        counted_residuals(simulate, experiment, progress),
        np.log(list(GUESS.values())),
        bounds=(low, high),
        diff_step=DIFFERENCE_STEP,
        xtol=1e-6,
        ftol=1e-8,
    )


def counted_residuals(
    simulate: Callable[[dict[str, float]], Array], experiment: cs.Experiment, progress: Progress
) -> Function:
    """Return the residuals as a function that records each simulation.

    The residuals of a simulation that fails are `FAILED_RESIDUAL`.
    """
    measured_m = np.asarray(experiment.markers.positions_m)

    def residuals(x: Array) -> Array:
        try:
            positions_m = simulate(parameter_values(x))
        except (UnstableSimulationError, cs.SimulationError):
            rows = np.full(measured_m.size, FAILED_RESIDUAL)
        else:
            distances_m = positions_m[:, list(MARKED_NODES)] - measured_m
            rows = (distances_m.ravel() / NOISE_M).clip(-FAILED_RESIDUAL, FAILED_RESIDUAL)
        progress.record(parameter_values(x), float(rows @ rows))
        return rows

    return residuals


def parameter_values(x: Array) -> dict[str, float]:
    """Return the parameters of their logarithms (3,)."""
    return dict(zip(GUESS, np.exp(x).tolist(), strict=True))


def search_with_own_simulation(experiment: cs.Experiment, progress: Progress) -> None:
    """Search by SciPy with the simulation of this project."""

    def simulate(values: dict[str, float]) -> Array:
        return cs.simulate(
            experiment, {**values, "gamma_m_1_s": 0.0}, "midpoint", substeps=STEPS_PER_SAMPLE
        ).positions_m

    search(simulate, experiment, progress)


def solve_with_mujoco(
    experiment: cs.Experiment, progress: Progress, *, backend: Literal["scipy", "mujoco"]
) -> None:
    """Search by a backend of `mujoco.sysid` with MuJoCo's own simulation."""
    from mujoco import sysid

    mesh = cylinder()

    def simulate(values: dict[str, float]) -> Array:
        return simulate_flex(mesh, values)

    residuals_of_one = counted_residuals(simulate, experiment, progress)
    parameters = sysid.ParameterDict()
    for name in GUESS:
        low, high = np.log(BOUNDS[name])
        parameters.add(sysid.Parameter(name, np.log(GUESS[name]), low, high))

    def residuals(x: Array, _: object, **__: object) -> tuple:
        if np.ndim(x) == 1:
            return [residuals_of_one(x)], None, None
        columns = [residuals_of_one(column) for column in np.asarray(x).T]
        return [np.stack(columns, axis=1)], None, None

    sysid.optimize(parameters, residuals, optimizer=backend, verbose=False)


# Titles of the candidates, functions of the experiment and of a `Progress` in which they record their
# search, and whether the first run compiles code, so that the second one is measured.
CANDIDATES: dict[str, tuple[str, Callable[[cs.Experiment, Progress], None], bool]] = {
    "reduced-space": ("this project, reduced space", partial(solve_with, "reduced-space"), True),
    "interior-point": (
        "this project, interior point (IPOPT)",
        partial(solve_with, "interior-point"),
        True,
    ),
    "scipy-ours": (
        "SciPy `least_squares` around the simulation of this project",
        search_with_own_simulation,
        True,
    ),
    "mujoco-sysid": (
        "`mujoco.sysid`, SciPy's trust region, explicit steps of 0.05 ms",
        partial(solve_with_mujoco, backend="scipy"),
        False,
    ),
    "mujoco-sysid-default": (
        "`mujoco.sysid`, its default optimiser, explicit steps of 0.05 ms",
        partial(solve_with_mujoco, backend="mujoco"),
        False,
    ),
}
# Name of the process that computes the best answer.
BEST = "best-answer"


# Measurement --------------------------------------------------------------------------------------


def reached_entry(track: Track, best: Mapping[str, float]) -> int | None:
    """Return the index of the entry from which on all values are within 1 % of the best answer.

    None: the last entry is not.
    """
    if not track.values:
        return None
    values = np.array([[each[name] for name in best] for each in track.values])
    largest_error = np.abs(values / np.array(list(best.values())) - 1).max(axis=1)
    outside_entries = np.flatnonzero(largest_error > REACHED_SHARE)
    first_inside = int(outside_entries[-1]) + 1 if len(outside_entries) else 0
    return first_inside if first_inside < len(values) else None


def measure(name: str) -> Track:
    """Run a candidate, or the solve of the best answer, in this process."""
    mesh = cylinder()
    truth_m = simulate_flex(mesh, TRUTH, step_s=RECORDING_STEP_S)
    experiment = recording(mesh, truth_m)
    progress = Progress()
    if name == BEST:
        solve_with("reduced-space", experiment, progress, steps_per_sample=BEST_STEPS_PER_SAMPLE)
    else:
        CANDIDATES[name][1](experiment, progress)
    return Track(
        progress.times_s, progress.values, progress.counts, progress.passed_s, progress.simulations
    )


def measure_in_own_process(name: str) -> Track:
    """Run a candidate in a separate process, on one core.

    Raises subprocess.CalledProcessError when it fails; its messages are on standard error.
    """
    limits = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "COLLOCATION_SYSID_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, __file__, "--candidate", name],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        env=os.environ | limits,
    )
    return Track(**json.loads(done.stdout.splitlines()[-1]))


def table(tracks: Mapping[str, Track], best: Mapping[str, float]) -> str:
    """Return the results as a Markdown table; ratios are those to the first row."""
    heads = (
        "tool",
        "time to 1 %, s",
        "relative to the first row",
        "simulations to 1 %",
        "time until the search stops, s",
        "simulations until it stops",
        *best,
    )
    rows = []
    first_s = None
    for name, track in tracks.items():
        entry = reached_entry(track, best)
        reached = ("not reached", "–", "–")
        if entry is not None:
            reached_s = track.times_s[entry]
            first_s = first_s or reached_s
            reached = f"{reached_s:.3g}", f"{reached_s / first_s:.3g}", str(track.counts[entry])
        total = f"{track.total_s:.3g}", str(track.simulations)
        last = track.values[-1] if track.values else {}
        errors = [f"{100 * (last[each] / best[each] - 1):+.2f} %" if last else "–" for each in best]
        rows.append((CANDIDATES[name][0], *reached, *total, *errors))
    return markdown(heads, rows)


def main() -> None:
    """Run candidates one after the other, and print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--only", nargs="+", choices=list(CANDIDATES), default=list(CANDIDATES))
    parser.add_argument("--candidate", choices=[*CANDIDATES, BEST], help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.candidate:
        print(json.dumps(asdict(measure(options.candidate))))
        return
    best = measure_in_own_process(BEST).values[-1]
    tracks = {}
    for name in options.only:
        if CANDIDATES[name][2]:
            measure_in_own_process(name)
        tracks[name] = measure_in_own_process(name)
    print(table(tracks, best))


if __name__ == "__main__":
    main()
