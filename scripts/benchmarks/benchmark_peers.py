"""Time to the answer of this project and of other tools, for one recording.

A soft cylinder (95 nodes, 288 tetrahedra, simulated by MuJoCo's flex) hangs from a hand and is
swung for half a second. Six markers with 0.1 mm of noise are measured; Young's modulus, Poisson's
ratio and the damping time are unknown. Every candidate has the same recording, mesh, guess and
bounds, one core and a separate process. The answer is reached when all parameters stay within
1 % of the best answer, the least-squares estimate at sixteen time steps per sample. Times are
computing times: unlike elapsed times they do not depend on what else the machine does.

    python scripts benchmark_peers
    python scripts benchmark_peers --only reduced-space mujoco-sysid --out peers.md

MuJoCo is required, because it simulates the recording: ``pip install 'mujoco[sysid]'``, whose extra
its own candidates need. Other tools are optional; a row of the table names those that are not
installed.
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
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

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
from peer_simulators import MUJOCO_STEP_S, RECORDING_STEP_S, UnstableSimulationError, simulate_flex
from scipy.optimize import least_squares, minimize
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
# Computing time after which a candidate is stopped [s].
LIMIT_S = 600.0
# Step of forward differences of simulations that are solved to about 1e-8 [relative].
DIFFERENCE_STEP = 1e-4
# Step of MuJoCo's implicit integrator; a simulation takes two thirds of
# the time of one with explicit steps [s].
DISCRETE_STEP_S = 5e-4


class LimitReachedError(Exception):
    """The computing time of a candidate is over."""


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
        """Count a simulation, and append an entry if its loss is the smallest so far.

        Raises LimitReachedError when the computing time is over.
        """
        self.simulations += 1
        if loss < self.best_loss:
            self.best_loss = loss
            self.append(values, self.passed_s)
        if self.passed_s > LIMIT_S:
            raise LimitReachedError

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
    has_ended: bool  # False: the candidate was stopped at the limit of computing time


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


def descend_with_warp(experiment: cs.Experiment, progress: Progress) -> None:
    """Minimise the loss by L-BFGS-B, with gradients through a simulation in Warp.

    The loss is scaled so that the first step changes the logarithms of the parameters by
    `peer_gradient.FIRST_CHANGE`; without a scale, the first step ends at the bounds.
    """
    from peer_gradient import FIRST_CHANGE, WarpCylinder

    body = WarpCylinder(np.asarray(experiment.markers.positions_m))
    start = np.log(list(GUESS.values()))
    first = body.evaluate(start)
    progress.record(GUESS, first.loss)
    scale = FIRST_CHANGE / float(np.linalg.norm(first.gradient))

    def evaluate(x: Array) -> tuple[float, Array]:
        evaluation = body.evaluate(x)
        if not np.isfinite(evaluation.loss):
            progress.record(parameter_values(x), np.inf)
            loss = FAILED_RESIDUAL**2 * experiment.markers.positions_m.size
            return scale * loss, np.zeros(len(x))
        progress.record(parameter_values(x), evaluation.loss)
        return scale * evaluation.loss, scale * evaluation.gradient

    bounds = [tuple(np.log(limits)) for limits in BOUNDS.values()]
    minimize(
        evaluate,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"ftol": 1e-12, "gtol": 1e-12},
    )


def solve_with_mujoco(
    experiment: cs.Experiment,
    progress: Progress,
    *,
    step_s: float,
    integrator: str,
    backend: Literal["scipy", "mujoco"],
) -> None:
    """Search by a backend of `mujoco.sysid` with MuJoCo's own simulation."""
    from mujoco import sysid

    mesh = cylinder()

    def simulate(values: dict[str, float]) -> Array:
        return simulate_flex(mesh, values, step_s=step_s, integrator=integrator)

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


@dataclass(frozen=True)
class Candidate:
    """Tool that identifies the parameters."""

    title: str
    # Function of the experiment and a `Progress`, in which it records its search.
    run: Callable[[cs.Experiment, Progress], None]
    package: str | None = None  # distribution that it needs; None: none
    module: str | None = None  # module of the distribution, or None where both names are the same
    is_compiled: bool = False  # True: the first run compiles code, and the second one is measured

    def missing_requirement(self) -> str | None:
        """Return how to install what is missing, or None."""
        module = self.module or self.package
        if module is not None and find_spec(module) is None:
            return f"`pip install {self.package}`"
        return None

    def version(self) -> str | None:
        """Return the name and version of the distribution, or None if not needed."""
        if self.package is not None:
            return f"{self.package} {version(self.package)}"
        return None


CANDIDATES = {
    "reduced-space": Candidate(
        "this project, reduced space", partial(solve_with, "reduced-space"), is_compiled=True
    ),
    "interior-point": Candidate(
        "this project, interior point (IPOPT)",
        partial(solve_with, "interior-point"),
        is_compiled=True,
    ),
    "scipy-ours": Candidate(
        "SciPy `least_squares` with the simulation of this project",
        search_with_own_simulation,
        is_compiled=True,
    ),
    "mujoco-sysid": Candidate(
        "`mujoco.sysid`, SciPy's trust region, explicit steps of 0.05 ms",
        partial(solve_with_mujoco, step_s=MUJOCO_STEP_S, integrator="Euler", backend="scipy"),
        package="mujoco",
    ),
    "mujoco-sysid-implicit": Candidate(
        "`mujoco.sysid`, SciPy's trust region, implicit steps of 0.5 ms",
        partial(solve_with_mujoco, step_s=DISCRETE_STEP_S, integrator="discrete", backend="scipy"),
        package="mujoco",
    ),
    "mujoco-sysid-default": Candidate(
        "`mujoco.sysid`, its default optimiser, explicit steps of 0.05 ms",
        partial(solve_with_mujoco, step_s=MUJOCO_STEP_S, integrator="Euler", backend="mujoco"),
        package="mujoco",
    ),
    "warp": Candidate(
        "L-BFGS-B, gradients through a simulation in Warp",
        descend_with_warp,
        package="warp-lang",
        module="warp",
        is_compiled=True,
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
    has_ended = True
    try:
        if name == BEST:
            solve_with(
                "reduced-space", experiment, progress, steps_per_sample=BEST_STEPS_PER_SAMPLE
            )
        else:
            CANDIDATES[name].run(experiment, progress)
    except LimitReachedError:
        has_ended = False
    return Track(
        progress.times_s,
        progress.values,
        progress.counts,
        progress.passed_s,
        progress.simulations,
        has_ended,
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


def row(
    name: str, track: Track, best: Mapping[str, float], reduced_space_s: float | None
) -> tuple[str, ...]:
    """Return a row of the table."""
    entry = reached_entry(track, best)
    reached_s = None if entry is None else track.times_s[entry]
    ratio = reached_s / reduced_space_s if reached_s and reduced_space_s else None
    last = track.values[-1] if track.values else {}
    return (
        CANDIDATES[name].title,
        "–" if ratio is None else f"{ratio:.3g}",
        "not reached" if reached_s is None else f"{reached_s:.3g}",
        "–" if entry is None else str(track.counts[entry]),
        f"{track.total_s:.3g}" + ("" if track.has_ended else " (limit)"),
        str(track.simulations),
        *(f"{100 * (last[each] / best[each] - 1):+.2f} %" if last else "–" for each in best),
    )


def table(
    tracks: Mapping[str, Track], failures: Mapping[str, str], best: Mapping[str, float]
) -> str:
    """Return the results as a Markdown table."""
    heads = (
        "candidate",
        "time to 1 % over that of this project",
        "time to 1 %, s",
        "simulations to 1 %",
        "time until it stops, s",
        "simulations until it stops",
        *best,
    )
    reduced_space_track = tracks.get("reduced-space")
    entry = None if reduced_space_track is None else reached_entry(reduced_space_track, best)
    reduced_space_s = (
        None if reduced_space_track is None or entry is None else reduced_space_track.times_s[entry]
    )
    rows = [row(name, track, best, reduced_space_s) for name, track in tracks.items()]
    empty = [""] * (len(heads) - 2)
    rows += [(CANDIDATES[name].title, reason, *empty) for name, reason in failures.items()]
    return markdown(heads, rows)


def report(
    tracks: Mapping[str, Track], failures: Mapping[str, str], best: Mapping[str, float]
) -> str:
    """Return the table with the best answer and the versions of the tools."""
    errors = ", ".join(f"{name} {100 * (best[name] / TRUTH[name] - 1):+.2f} %" for name in best)
    tool_versions = [CANDIDATES[name].version() for name in tracks]
    versions = dict.fromkeys(each for each in tool_versions if each is not None)
    common_versions = (f"{each} {version(each)}" for each in ("scipy", "casadi"))
    return (
        f"{table(tracks, failures, best)}\n\n"
        f"Errors of the best answer: {errors}.\n"
        f"Versions: {', '.join((*common_versions, *versions))}.\n"
    )


def compare(names: list[str], out: Path | None) -> None:
    """Run candidates one after the other, and print the table after each."""
    best = measure_in_own_process(BEST).values[-1]
    tracks = {}
    failures = {}
    for name in names:
        installation = CANDIDATES[name].missing_requirement()
        if installation is not None:
            failures[name] = f"not installed: {installation}"
            continue
        try:
            if CANDIDATES[name].is_compiled:
                measure_in_own_process(name)
            tracks[name] = measure_in_own_process(name)
        except subprocess.CalledProcessError as error:
            failures[name] = f"failed with exit code {error.returncode}"
            continue
        print(table(tracks, failures, best), flush=True)
    text = report(tracks, failures, best)
    print(text)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text, encoding="utf-8")


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; return the exit code, 2 if MuJoCo is missing."""
    parser = make_parser(__doc__)
    parser.add_argument("--only", nargs="+", choices=list(CANDIDATES), default=list(CANDIDATES))
    parser.add_argument("--out", type=Path, help="file for the table; without it, only print")
    parser.add_argument("--candidate", choices=[*CANDIDATES, BEST], help=argparse.SUPPRESS)
    options: Any = parser.parse_args(arguments)
    if find_spec("mujoco") is None:
        print(
            "benchmark_peers: MuJoCo simulates the recording but is not "
            "installed; run: pip install mujoco",
            file=sys.stderr,
        )
        return 2
    if options.candidate:
        print(json.dumps(asdict(measure(options.candidate))))
        return 0
    compare(options.only, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
