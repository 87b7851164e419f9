"""Coverage of the 95 % intervals with the errors of a real laboratory, for twins with one error each.

A cylinder hangs from a swung hand, as in study_coverage.py. The tracks are simulated with the scheme
of the fit and have white noise. Each twin has one error of the recording, a random number of the
stated size, and is identified with every option at its default: nuisance parameters, noise and
covariance. The solve starts from the true values. The table has the coverage of the intervals and the
median standard errors; for twins without errors also the ratio of standard errors with and without
nuisance parameters. In the rows "assumed", the body deviates from an assumption of the budget by a
random number with the standard deviation of this assumption; these rows have the coverage of the
combined interval too, of a budget with this assumption or with all of them.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from assumed_twins import wrong
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from scipy.stats import binom
from study_coverage import QUANTITIES, SCHEME, held, reference, truth
from study_starts import TRUTH, parameters

from collocation_sysid import Problem
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.pipeline import solve
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import (
    Experiment,
    Grasp,
    Nuisance,
    PoseSequence,
)
from collocation_sysid.statistics.budget.consider_analysis import (
    changed_residuals,
)
from collocation_sysid.statistics.budget.systematic_effects import (
    ASSUMPTIONS,
    Assumption,
)
from collocation_sysid.statistics.budget.uncertainty_budget import (
    BudgetLine,
    VarianceSources,
    budget,
)
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.uncertainty import Uncertainty, uncertainty_at

Array = NDArray[np.float64]
Generator = np.random.Generator
# The truth with its tracks, before noise, and what the user states.
Pair = tuple[Experiment, Experiment]

SIGMA_M = 1e-3
COLUMNS = ("λ", "μ", "γ_r", "γ_m", "E", "ν")


@dataclass(frozen=True, eq=False)
class Outcome:
    """One twin.

    Attributes
    ----------
    held : (6,) one where an interval holds the truth, zero where not, NaN without one
    whole : (6,) the same of the whole interval
    relative : (6,) standard errors over the true values, NaN where there is none
    without : (6,) standard errors without nuisance parameters over the true values, or NaN
    correlated : bool
        Whether error bars are for correlated errors.
    """

    converged: bool
    held: Array
    whole: Array
    relative: Array
    without: Array
    correlated: bool


@dataclass(frozen=True, eq=False)
class Fit:
    """Error bars and budget of one twin's fit, and whether the fit converged."""

    uncertainty: Uncertainty
    lines: Mapping[str, BudgetLine]
    converged: bool


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--twins", type=int, default=200, help="of each fault")
    parser.add_argument(
        "--only", nargs="*", choices=list(FAULTS), default=list(FAULTS)
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1, help="processes")
    arguments = parser.parse_args()
    # Workers start afresh and find one thread each.
    os.environ |= {
        "OPENBLAS_NUM_THREADS": "1",
        "COLLOCATION_SYSID_THREADS": "1",
    }
    start = multiprocessing.get_context("spawn")
    notes = []
    began = time.perf_counter()
    print(header(arguments.twins), table_head(), sep="\n\n", flush=True)
    with ProcessPoolExecutor(arguments.workers, mp_context=start) as pool:
        for fault in arguments.only:
            seeds = [
                (arguments.seed, *fault.encode(), twin)
                for twin in range(arguments.twins)
            ]
            outcomes = list(
                pool.map(run, [fault] * len(seeds), seeds, chunksize=5)
            )
            print(table_row(fault, outcomes), flush=True)
            if fault == "none":
                notes.append(loss_of_precision(outcomes))
    print("", *notes, f"{time.perf_counter() - began:.0f} s", sep="\n")


# One twin -----------------------------------------------------------------------------------------


def run(fault: str, seed: Sequence[int]) -> Outcome:
    """Draw a twin, identify it, and compare with the truth."""
    rng = np.random.default_rng(seed)
    actual, stated = FAULTS[fault](measured(), rng)
    tracks = actual.markers.positions_m
    tracks = tracks + actual.markers.sigma_m[:, None] * rng.standard_normal(
        tracks.shape
    )
    found, whole, converged = identified(
        with_markers(stated, tracks), ROWS.get(fault, ())
    )
    without = np.full(len(QUANTITIES), np.nan)
    if actual is stated:
        ideal = replace(with_markers(stated, tracks), nuisance=Nuisance.none())
        without = relative_errors(identified(ideal)[0])
    return Outcome(
        converged,
        np.array(held(found)),
        whole,
        relative_errors(found),
        without,
        found.errors == "autocorrelated",
    )


@cache
def measured() -> Experiment:
    """The experiment with its tracks, without noise, and with the default nuisance parameters."""
    experiment = replace(reference(SIGMA_M)[0], nuisance=Nuisance())
    return with_markers(
        experiment, experiment.markers.predict_positions(positions_m())
    )


def positions_m() -> Array:
    """(T, n, 3) of its nodes."""
    _, x = reference(SIGMA_M)
    return x.reshape(len(x), -1, 3)


def identified(
    experiment: Experiment, assumed: Sequence[Assumption] = ()
) -> tuple[Uncertainty, Array, bool]:
    """With every option left to its default, from the truth."""
    fit = fitted(experiment, assumed)
    true = truth()
    lines = fit.lines
    whole = [
        float(lines[n].combined95[0] <= true[n] <= lines[n].combined95[1])
        if n in lines
        else np.nan
        for n in QUANTITIES
    ]
    return fit.uncertainty, np.array(whole), fit.converged


def fitted(experiment: Experiment, assumed: Sequence[Assumption]) -> Fit:
    """Return the fit of an experiment from the truth, with a budget of some assumptions."""
    problem = Problem([experiment], parameters(np.array(list(TRUTH.values()))))
    solution = solve(problem, ReducedSpace(tolerance=1e-6, ladder=(1.0,)))
    collocation = solution.collocation
    z = solution.z
    found = uncertainty_at(collocation, z)
    deviations = [(row, row.sigma) for row in assumed if row.sigma is not None]
    changes = changed_residuals(collocation, z, deviations)
    fit = linearise_fit(collocation, z)
    sources = VarianceSources.from_fit(
        fit, changes, collocation.parameters, solution.q, found
    )
    lines = budget(sources, found, {}, problem.parameters)
    return Fit(found, lines, solution.status.converged)


def relative_errors(found: Uncertainty) -> Array:
    estimates = {**found.estimates, **found.derived}
    true = truth()
    errors = [estimates[name].statistical_std_error for name in QUANTITIES]
    return np.array([np.nan if e is None else e for e in errors]) / [
        true[n] for n in QUANTITIES
    ]


# Faults -------------------------------------------------------------------------------------------


def faultless(experiment: Experiment, rng: Generator) -> Pair:
    return experiment, experiment


def late(late_s: float) -> Callable[..., Pair]:
    """The markers' clock is late; the body rests before the start."""

    def fault(experiment: Experiment, rng: Generator) -> Pair:
        tracks = CubicSpline(experiment.t_s, experiment.markers.positions_m)
        seen = tracks(np.maximum(experiment.t_s - late_s, 0.0))
        return with_markers(experiment, seen), experiment

    return fault


def noisy_poses(
    size_m: float, degrees: float, stated: bool
) -> Callable[..., Pair]:
    """Every pose has noise of its own."""
    size_rad = np.radians(degrees)

    def fault(experiment: Experiment, rng: Generator) -> Pair:
        (grasp,) = experiment.grasps
        poses = grasp.poses
        turns = Rotation.from_rotvec(
            size_rad * rng.standard_normal((len(poses.t_s), 3))
        )
        noisy = PoseSequence(
            poses.t_s,
            poses.positions_m
            + size_m * rng.standard_normal(poses.positions_m.shape),
            (turns * Rotation.from_quat(poses.quaternions_xyzw)).as_quat(),
        )
        sigmas = {"sigma_m": size_m, "sigma_rad": size_rad} if stated else {}
        return experiment, replace(
            experiment, grasps=(Grasp(grasp.nodes, noisy, **sigmas),)
        )

    return fault


def tilted(experiment: Experiment, rng: Generator) -> Pair:
    """Gravity is off by 1° about both axes."""
    angles = np.radians(rng.standard_normal(2))
    down = np.array([*angles, -1.0])
    gravity_m_s2 = 9.81 * down / np.linalg.norm(down)
    tilt = replace(experiment, gravity_m_s2=tuple(gravity_m_s2.tolist()))
    return simulated(tilt), experiment


def off_in_gripper(experiment: Experiment, rng: Generator) -> Pair:
    """The body is off in the gripper by 1 mm and 0.5° an axis."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(
        np.radians(0.5) * rng.standard_normal(3)
    ).as_matrix()
    matrix[:3, 3] = 1e-3 * rng.standard_normal(3)
    (grasp,) = experiment.grasps
    moved = Grasp(grasp.nodes, grasp.poses.after(matrix))
    return simulated(replace(experiment, grasps=(moved,))), experiment


def simulated(experiment: Experiment) -> Experiment:
    return with_markers(
        experiment, simulate(experiment, TRUTH, SCHEME, substeps=1).markers_m
    )


def claiming(factor: float) -> Callable[..., Pair]:
    """sigma_m is stated as this many times the truth."""

    def fault(experiment: Experiment, rng: Generator) -> Pair:
        markers = experiment.markers
        claimed = replace(markers, sigma_m=factor * markers.sigma_m)
        return experiment, replace(experiment, markers=claimed)

    return fault


def loose(experiment: Experiment, rng: Generator) -> Pair:
    """The first marker is three times as noisy."""
    sigma_m = experiment.markers.sigma_m.copy()
    sigma_m[0] *= 3
    return replace(
        experiment, markers=replace(experiment.markers, sigma_m=sigma_m)
    ), experiment


def misplaced(experiment: Experiment, rng: Generator) -> Pair:
    """Every marker sits 1 mm an axis off its place."""
    places_m = experiment.markers.predict_positions(experiment.body.nodes_m)
    moved = at_places(
        experiment, places_m + 1e-3 * rng.standard_normal(places_m.shape)
    )
    return with_markers(
        experiment, moved.markers.predict_positions(positions_m())
    ), experiment


def unplaced(experiment: Experiment, rng: Generator) -> Pair:
    """Nobody knows where the markers sit."""
    places_m = np.full((len(experiment.markers.names), 3), np.nan)
    return experiment, at_places(experiment, places_m)


def at_places(experiment: Experiment, places_m: Array) -> Experiment:
    markers = replace(
        experiment.markers,
        placement=None,
        located=None,
        places_m=places_m,
        attach="embedded",
    )
    return replace(experiment, markers=markers)


def drawn(names: Sequence[str]) -> Callable[..., Pair]:
    """Return a fault that draws deviations from the named assumptions, each at its standard deviation."""

    def fault(experiment: Experiment, rng: Generator) -> Pair:
        off = {}
        for row in (row for row in ASSUMPTIONS if row.name in names):
            for name in row.list_components():
                size = (row.sigma or 0.0) * rng.standard_normal()
                # No coefficient of the air is below zero.
                off[name] = max(size, -0.99) if row.name in AIR else size
        values = {
            name: truth()[name]
            for name in ("young_pa", "poisson", *list(TRUTH)[2:])
        }
        return wrong(experiment, values, off), experiment

    return fault


AIR = ("air_drag", "added_mass", "buoyancy")
SINGLE = (
    *(
        "body_scale",
        "mass",
        "density_gradient",
        "anisotropy",
        "stiffness_drift",
        "time_scale",
    ),
    *AIR,
)
# What a budget has of each fault.
ASSUMED = {f"assumed: {name}": (name,) for name in SINGLE}
ASSUMED |= {"assumed: air": AIR, "assumed: all of these": SINGLE}
ROWS = {
    f: tuple(r for r in ASSUMPTIONS if r.name in names)
    for f, names in ASSUMED.items()
}

FAULTS: dict[str, Callable[[Experiment, Generator], Pair]] = {
    "none": faultless,
    "clock 2 ms late": late(0.002),
    "poses 0.5 mm, 0.3°, given": noisy_poses(5e-4, 0.3, stated=True),
    "poses 0.5 mm, 0.3°, judged": noisy_poses(5e-4, 0.3, stated=False),
    "poses 0.1 mm, 0.06°, given": noisy_poses(1e-4, 0.06, stated=True),
    "poses 0.1 mm, 0.06°, judged": noisy_poses(1e-4, 0.06, stated=False),
    "gravity 1°": tilted,
    "in the gripper 1 mm, 0.5°": off_in_gripper,
    "sigma_m 0.3 of the truth": claiming(0.3),
    "one marker 3 times as noisy": loose,
    "places 1 mm": misplaced,
    "places not known": unplaced,
} | {fault: drawn(names) for fault, names in ASSUMED.items()}


# Table --------------------------------------------------------------------------------------------


def header(twins: int) -> str:
    experiment = measured()
    low, high = binom.interval(0.95, twins, 0.95)
    return (
        f"{len(experiment.body.nodes_m)} nodes x {len(experiment.t_s)} steps, "
        f"{len(experiment.markers.names)} markers, sigma {1e3 * SIGMA_M:g} mm; {twins} twins of "
        f"each fault, of which chance keeps a share of {100 * low / twins:.1f}-"
        f"{100 * high / twins:.1f} % with 95 % probability (* is beyond)"
    )


def table_head() -> str:
    columns = [
        f"{c} {what} %" for what in ("held", "whole", "error") for c in COLUMNS
    ]
    cells = ["fault", *columns, "correlated %", "lost"]
    return _line(cells) + "\n" + _line(["---"] * len(cells))


def table_row(fault: str, outcomes: Sequence[Outcome]) -> str:
    """Shares that are held, and median standard errors over the true values."""
    good = [outcome for outcome in outcomes if outcome.converged]
    columns = np.array([[*outcome.held, *outcome.whole] for outcome in good]).T
    errors = 100 * np.nanmedian([outcome.relative for outcome in good], axis=0)
    correlated = 100 * np.mean([outcome.correlated for outcome in good])
    lost = len(outcomes) - len(good)
    return _line(
        [
            fault,
            *map(_share, columns),
            *map("{:.2g}".format, errors),
            f"{correlated:.0f}",
            f"{lost}",
        ]
    )


def _share(held: Array) -> str:
    """Percent of the intervals that there are, starred beyond what chance does to them."""
    held = held[np.isfinite(held)]
    if not len(held):
        return "-"
    low, high = binom.interval(0.95, len(held), 0.95)
    return f"{100 * held.mean():.3g}{'' if low <= held.sum() <= high else '*'}"


def loss_of_precision(outcomes: Sequence[Outcome]) -> str:
    """Return the ratios of standard errors with and without nuisance parameters, without errors."""
    ratios = np.nanmedian(
        [outcome.relative / outcome.without for outcome in outcomes], axis=0
    )
    listed = ", ".join(
        f"{c} {ratio:.2f}" for c, ratio in zip(COLUMNS, ratios, strict=True)
    )
    return f"Faultless, standard errors over those without nuisance parameters: {listed}"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
