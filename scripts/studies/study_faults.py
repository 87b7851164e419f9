"""Coverage of the 95 % intervals with the errors of a real laboratory, for twins with one error
each.

A cylinder hangs from a swung hand, as in study_coverage.py. The tracks are simulated with the
scheme of the fit and have white noise. Each twin has one error of the recording, a random number of
the stated size, and is identified with every option at its default: nuisance parameters, noise and
covariance. The solve starts from the true values. The table has the coverage of the intervals and
the median standard errors; for twins without errors also the ratio of standard errors with and
without nuisance parameters. In the rows "assumed", the body deviates from an assumption of the
budget by a random number with the standard deviation of this assumption; these rows have the
coverage of the combined interval too, of a budget with this assumption or with all of them. In the
rows "every effect" all default assumptions and nuisance parameters are wrong at once. If the damping
law is wrong too, the intervals of γ_r and γ_m need not contain the true values, because both are
constants of the stated law.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from assumed_twins import with_wrong_assumptions
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from scipy.stats import binom
from study_coverage import QUANTITIES, SCHEME, intervals_with_truth, reference, truth
from study_starts import TRUTH, parameters

from collocation_sysid import Problem
from collocation_sysid.errors import SimulationError
from collocation_sysid.fem.body import Body
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.pipeline import solve
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Grasp, Nuisance, PoseSequence
from collocation_sysid.recording.deviation import Deviation
from collocation_sysid.recording.nuisance import CALIBRATION_SCALE
from collocation_sysid.statistics.budget.consider_analysis import (
    changed_residuals,
    changes_of_assumptions,
)
from collocation_sysid.statistics.budget.systematic_effects import ASSUMPTIONS
from collocation_sysid.statistics.budget.variance_sources import BudgetLine, VarianceSources, budget
from collocation_sysid.statistics.curved_intervals import uncertainty_at
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.uncertainty import Uncertainty

Array = NDArray[np.float64]
Generator = np.random.Generator
# The true recording with its exact tracks, and the recording as the problem describes it.
TrueAndStated = tuple[Experiment, Experiment]

# Standard deviation of each marker coordinate [m].
SIGMA_M = 1e-3
COLUMNS = ("λ", "μ", "γ_r", "γ_m", "E", "ν")


@dataclass(frozen=True, eq=False)
class FaultOutcome:
    """Results of one twin, by quantity (`QUANTITIES`).

    Attributes
    ----------
    converged : bool
        Whether the solve converged.
    contains_truth : (6,)
        1 if the statistical interval contains the truth, 0 if not, NaN without interval.
    combined_contains_truth : (6,)
        As `contains_truth`, for the combined interval.
    half_widths : (6,)
        Half widths of the combined intervals over the true values; NaN without interval.
    relative : (6,)
        Standard errors over the true values; NaN without standard error.
    without : (6,)
        As `relative`, of a fit without nuisance parameters; NaN in twins with an error.
    correlated : bool
        Whether the standard errors are those of correlated errors.
    redrawn : int
        Number of bodies that were drawn before and could not be simulated.
    """

    converged: bool
    contains_truth: Array
    combined_contains_truth: Array
    half_widths: Array
    relative: Array
    without: Array
    correlated: bool
    redrawn: int


@dataclass(frozen=True, eq=False)
class BudgetedFit:
    """Error bars and budget of one twin's fit, and whether the fit converged."""

    uncertainty: Uncertainty
    lines: Mapping[str, BudgetLine]
    converged: bool


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--twins", type=int, default=200, help="of each fault")
    parser.add_argument("--only", nargs="*", choices=list(FAULTS), default=list(FAULTS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1, help="processes")
    arguments = parser.parse_args()
    # Worker processes read these variables when they start: one thread each.
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "COLLOCATION_SYSID_THREADS": "1"}
    start = multiprocessing.get_context("spawn")
    notes = []
    began = time.perf_counter()
    print(header(arguments.twins), table_head(), sep="\n\n", flush=True)
    with ProcessPoolExecutor(arguments.workers, mp_context=start) as pool:
        for fault in arguments.only:
            seeds = [(arguments.seed, *fault.encode(), twin) for twin in range(arguments.twins)]
            outcomes = list(pool.map(run, [fault] * len(seeds), seeds, chunksize=5))
            print(table_row(fault, outcomes), flush=True)
            if fault == "none":
                notes.append(loss_of_precision(outcomes))
    print("", *notes, f"{time.perf_counter() - began:.0f} s", sep="\n")


# One twin -----------------------------------------------------------------------------------------


def run(fault: str, seed: Sequence[int]) -> FaultOutcome:
    """Draw a twin with a fault (a key of `FAULTS`), identify it, and compare the answer with the
    truth.
    """
    rng = np.random.default_rng(seed)
    recordings: TrueAndStated | None = None
    redrawn = -1
    while recordings is None:
        redrawn += 1
        # Some soft bodies with many errors collapse, and nobody would record them.
        with suppress(SimulationError):
            recordings = FAULTS[fault](exact_recording(), rng)
    true_recording, described = recordings
    tracks = true_recording.markers.positions_m
    tracks = tracks + true_recording.markers.sigma_m[:, None] * rng.standard_normal(tracks.shape)
    uncertainty, combined_contains_truth, half_widths, converged = identified(
        with_markers(described, tracks), BUDGETS.get(fault, ROWS.get(fault, ()))
    )
    errors_without_nuisance = np.full(len(QUANTITIES), np.nan)
    if true_recording is described:
        ideal = replace(with_markers(described, tracks), nuisance=Nuisance.none())
        errors_without_nuisance = relative_errors(identified(ideal)[0])
    return FaultOutcome(
        converged,
        np.array(intervals_with_truth(uncertainty)),
        combined_contains_truth,
        half_widths,
        relative_errors(uncertainty),
        errors_without_nuisance,
        uncertainty.errors == "autocorrelated",
        redrawn,
    )


@cache
def exact_recording() -> Experiment:
    """Return the experiment with exact tracks and with the default nuisance parameters."""
    experiment = replace(reference(SIGMA_M)[0], nuisance=Nuisance())
    return with_markers(experiment, experiment.markers.predict_positions(positions_m()))


def positions_m() -> Array:
    """Return the exact node positions (T, n, 3) of the experiment [m]."""
    _, x = reference(SIGMA_M)
    return x.reshape(len(x), -1, 3)


def identified(
    experiment: Experiment, assumed: Sequence[Deviation] | Mapping[str, None] = ()
) -> tuple[Uncertainty, Array, Array, bool]:
    """Identify an experiment with default options, starting from the truth.

    Parameters
    ----------
    experiment : Experiment
    assumed : sequence of Deviation, or mapping of str to None
        Rows of the uncertainty budget, or the names of rows that the default budget lacks.

    Returns
    -------
    uncertainty : Uncertainty
    combined_contains_truth : (6,) array
        1 if the combined interval contains the truth, 0 if not, NaN without interval.
    half_widths : (6,) array
        Half widths of the combined intervals over the true values.
    converged : bool
    """
    fit = fit_from_truth(experiment, assumed)
    true = truth()
    lines = fit.lines
    combined_contains_truth = [
        float(lines[n].combined95[0] <= true[n] <= lines[n].combined95[1]) if n in lines else np.nan
        for n in QUANTITIES
    ]
    half_widths = [
        np.ptp(lines[n].combined95) / 2 / true[n] if n in lines else np.nan for n in QUANTITIES
    ]
    contained = np.array(combined_contains_truth)
    return fit.uncertainty, contained, np.array(half_widths), fit.converged


def fit_from_truth(
    experiment: Experiment, assumed: Sequence[Deviation] | Mapping[str, None]
) -> BudgetedFit:
    """Return the fit of an experiment from the truth, with a budget as in `identified`."""
    problem = Problem([experiment], parameters(np.array(list(TRUTH.values()))))
    solution = solve(problem, ReducedSpace(tolerance=1e-6, ladder=(1.0,)))
    collocation = solution.collocation
    z = solution.z
    uncertainty = uncertainty_at(collocation, z)
    if isinstance(assumed, Mapping):
        changes = changes_of_assumptions(collocation, z, assumed)
    else:
        deviations = [(row, row.considered) for row in assumed if row.considered is not None]
        changes = changed_residuals(collocation, z, deviations)
    fit = linearise_fit(collocation, z)
    sources = VarianceSources.from_fit(
        fit, changes, collocation.parameters, solution.q, uncertainty
    )
    lines = budget(sources, uncertainty, {}, problem.parameters)
    return BudgetedFit(uncertainty, lines, solution.status.converged)


def relative_errors(uncertainty: Uncertainty) -> Array:
    """Return the standard errors (6,) over the true values; NaN without standard error."""
    estimates = {**uncertainty.estimates, **uncertainty.derived}
    true = truth()
    errors = [estimates[name].statistical_std_error for name in QUANTITIES]
    return np.array([np.nan if e is None else e for e in errors]) / [true[n] for n in QUANTITIES]


# Faults: each returns the true recording, and the recording as the problem describes it -----------


def without_fault(experiment: Experiment, rng: Generator) -> TrueAndStated:
    """Return the exact recording, correctly described."""
    return experiment, experiment


def late(late_s: float) -> Callable[..., TrueAndStated]:
    """Return a fault by which the marker clock is late by `late_s` [s]; before the start the body
    rests.
    """

    def fault(experiment: Experiment, rng: Generator) -> TrueAndStated:
        tracks = CubicSpline(experiment.t_s, experiment.markers.positions_m)
        delayed_tracks_m = tracks(np.maximum(experiment.t_s - late_s, 0.0))
        return with_markers(experiment, delayed_tracks_m), experiment

    return fault


def noisy_poses(size_m: float, degrees: float, is_stated: bool) -> Callable[..., TrueAndStated]:
    """Return a fault by which poses have independent noise, which the problem states or not."""
    size_rad = np.radians(degrees)

    def fault(experiment: Experiment, rng: Generator) -> TrueAndStated:
        (grasp,) = experiment.grasps
        poses = grasp.poses
        rotations = Rotation.from_rotvec(size_rad * rng.standard_normal((len(poses.t_s), 3)))
        noisy = PoseSequence(
            poses.t_s,
            poses.positions_m + size_m * rng.standard_normal(poses.positions_m.shape),
            (rotations * Rotation.from_quat(poses.quaternions_xyzw)).as_quat(),
        )
        sigmas = {"sigma_m": size_m, "sigma_rad": size_rad} if is_stated else {}
        return experiment, replace(experiment, grasps=(Grasp(grasp.nodes, noisy, **sigmas),))

    return fault


def tilted(experiment: Experiment, rng: Generator) -> TrueAndStated:
    """Return a recording whose gravity is tilted by random angles of about 1° about x and y."""
    return simulated(tilted_gravity(experiment, rng)), experiment


def tilted_gravity(experiment: Experiment, rng: Generator) -> Experiment:
    """Return the experiment with gravity tilted by random angles of about 1° about x and y."""
    angles = np.radians(rng.standard_normal(2))
    down = np.array([*angles, -1.0])
    gravity_m_s2 = 9.81 * down / np.linalg.norm(down)
    return replace(experiment, gravity_m_s2=tuple(gravity_m_s2.tolist()))


def misplaced_in_gripper(experiment: Experiment, rng: Generator) -> TrueAndStated:
    """Return a recording of a body that is misplaced in the gripper by 1 mm and 0.5° per axis."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(np.radians(0.5) * rng.standard_normal(3)).as_matrix()
    matrix[:3, 3] = 1e-3 * rng.standard_normal(3)
    (grasp,) = experiment.grasps
    shifted_grasp = Grasp(grasp.nodes, grasp.poses.after(matrix))
    return simulated(replace(experiment, grasps=(shifted_grasp,))), experiment


def simulated(experiment: Experiment) -> Experiment:
    """Return the experiment with exact simulated tracks."""
    return with_markers(experiment, simulate(experiment, TRUTH, SCHEME, substeps=1).markers_m)


def with_stated_sigma(factor: float) -> Callable[..., TrueAndStated]:
    """Return a fault by which the stated sigma_m is `factor` times the true value."""

    def fault(experiment: Experiment, rng: Generator) -> TrueAndStated:
        markers = experiment.markers
        stated_markers = replace(markers, sigma_m=factor * markers.sigma_m)
        return experiment, replace(experiment, markers=stated_markers)

    return fault


def with_noisy_marker(experiment: Experiment, rng: Generator) -> TrueAndStated:
    """Return a recording whose first marker has three times the stated noise."""
    sigma_m = experiment.markers.sigma_m.copy()
    sigma_m[0] *= 3
    return replace(experiment, markers=replace(experiment.markers, sigma_m=sigma_m)), experiment


def misplaced(experiment: Experiment, rng: Generator) -> TrueAndStated:
    """Return a recording whose markers are misplaced on the body by 1 mm per axis."""
    places_m = experiment.markers.predict_positions(experiment.body.nodes_m)
    with_true_places = at_places(experiment, places_m + 1e-3 * rng.standard_normal(places_m.shape))
    return with_markers(
        experiment, with_true_places.markers.predict_positions(positions_m())
    ), experiment


def unplaced(experiment: Experiment, rng: Generator) -> TrueAndStated:
    """Return a description in which the positions of the markers are unknown."""
    places_m = np.full((len(experiment.markers.names), 3), np.nan)
    return experiment, at_places(experiment, places_m)


def at_places(experiment: Experiment, places_m: Array) -> Experiment:
    """Return the experiment with markers at other positions (M, 3) on the body [m]; NaN if unknown."""
    markers = replace(
        experiment.markers, placement=None, located=None, places_m=places_m, attach="embedded"
    )
    return replace(experiment, markers=markers)


def draw_assumption_errors(names: Sequence[str]) -> Callable[..., TrueAndStated]:
    """Return a fault that draws deviations from the named assumptions, each at its standard
    deviation.
    """

    def fault(experiment: Experiment, rng: Generator) -> TrueAndStated:
        return with_wrong_assumptions(experiment, true_values(), _errors(names, rng)), experiment

    return fault


def _errors(names: Sequence[str], rng: Generator) -> dict[str, float]:
    errors = {}
    for row in (row for row in ASSUMPTIONS if row.name in names):
        for name in row.components:
            error = (row.considered or 0.0) * rng.standard_normal()
            # Coefficients of the air are not negative, and a negative share of either damping law
            # would add energy where the body is stretched.
            errors[name] = max(error, -0.99) if row.name in AIR else error
            if row.name == "damping_law":
                errors[name] = min(abs(error), 1.0)
    return errors


def true_values() -> dict[str, float]:
    """Return E, ν and the damping constants of the twins."""
    return {name: truth()[name] for name in ("young_pa", "poisson", *list(TRUTH)[2:])}


def draw_every_error(names: Sequence[str]) -> Callable[..., TrueAndStated]:
    """Return a fault that draws deviations from the named assumptions of a body with the default
    damping law, and all nuisance parameters that are estimated or considered by default.
    """

    def fault(experiment: Experiment, rng: Generator) -> TrueAndStated:
        described = replace(experiment, body=body_with_default_damping())
        nuisance = described.nuisance
        turned, (grasp,) = tilted_gravity(described, rng), described.grasps
        matrix = np.eye(4)
        turn_rad = (nuisance.hand_eye_rad or 0.0) * rng.standard_normal(3)
        matrix[:3, :3] = Rotation.from_rotvec(turn_rad).as_matrix()
        matrix[:3, 3] = (nuisance.hand_eye_m or 0.0) * rng.standard_normal(3)
        held = replace(turned, grasps=(Grasp(grasp.nodes, grasp.poses.after(matrix)),))
        moved = with_wrong_assumptions(held, true_values(), _errors(names, rng))
        late_s = (nuisance.time_shift_s or 0.0) * rng.standard_normal()
        seen_s = np.clip(described.t_s - late_s, 0.0, described.t_s[-1])
        tracks_m = CubicSpline(described.t_s, moved.markers.positions_m)(seen_s)
        pivot_m = tracks_m[0].mean(axis=0)
        scale = 1 + (CALIBRATION_SCALE.considered or 0.0) * rng.standard_normal()
        places_m = described.markers.predict_positions(described.body.nodes_m)
        off_m = (nuisance.marker_offset_m or 0.0) * rng.standard_normal(places_m.shape)
        return (
            with_markers(described, pivot_m + scale * (tracks_m - pivot_m)),
            at_places(described, places_m + off_m),
        )

    return fault


@cache
def body_with_default_damping() -> Body:
    """Return the body of the twins with the default damping law."""
    body = exact_recording().body
    return Body(body.mesh, density_kg_m3=body.mass_kg / body.mesh.volume_m3)


AIR = ("air_drag", "added_mass", "buoyancy")
SINGLE = (
    *(
        "body_scale",
        "mass",
        "density_gradient",
        "stiffness_gradient",
        "anisotropy",
        "stiffness_drift",
        "time_scale",
    ),
    *AIR,
)
# Names of the assumptions that are wrong in each fault, and the rows of the budget for them.
ASSUMED = {f"assumed: {name}": (name,) for name in SINGLE}
ASSUMED |= {"assumed: air": AIR, "assumed: all of these": SINGLE}
ROWS = {f: tuple(r for r in ASSUMPTIONS if r.name in names) for f, names in ASSUMED.items()}
# All effects of the default budget, and the nuisance parameters; the budget has what is drawn.
WITHOUT_LAW = (*SINGLE, "surface", "grip_layer_m", "grasp_edge_m")
EVERY = {
    "every effect": (*WITHOUT_LAW, "damping_law"),
    "every effect but the damping law": WITHOUT_LAW,
}
BUDGETS: dict[str, Mapping[str, None]] = {
    name: {} if "damping_law" in names else {"damping_law": None} for name, names in EVERY.items()
}

FAULTS: dict[str, Callable[[Experiment, Generator], TrueAndStated]] = {
    "none": without_fault,
    "clock 2 ms late": late(0.002),
    "poses 0.5 mm, 0.3°, given": noisy_poses(5e-4, 0.3, is_stated=True),
    "poses 0.5 mm, 0.3°, estimated": noisy_poses(5e-4, 0.3, is_stated=False),
    "poses 0.1 mm, 0.06°, given": noisy_poses(1e-4, 0.06, is_stated=True),
    "poses 0.1 mm, 0.06°, estimated": noisy_poses(1e-4, 0.06, is_stated=False),
    "gravity 1°": tilted,
    "pose in the gripper 1 mm, 0.5°": misplaced_in_gripper,
    "sigma_m 0.3 of the true value": with_stated_sigma(0.3),
    "one marker 3 times as noisy": with_noisy_marker,
    "marker positions 1 mm": misplaced,
    "marker positions unknown": unplaced,
}
FAULTS |= {fault: draw_assumption_errors(names) for fault, names in ASSUMED.items()}
FAULTS |= {fault: draw_every_error(names) for fault, names in EVERY.items()}


# Table --------------------------------------------------------------------------------------------


def header(twins: int) -> str:
    """Return the size of the problem, and the range of coverages of exact intervals, as text."""
    experiment = exact_recording()
    low, high = binom.interval(0.95, twins, 0.95)
    return (
        f"{len(experiment.body.nodes_m)} nodes x {len(experiment.t_s)} steps, "
        f"{len(experiment.markers.names)} markers, sigma {1e3 * SIGMA_M:g} mm; {twins} twins of "
        f"each fault; the coverage of exact intervals is {100 * low / twins:.1f}-"
        f"{100 * high / twins:.1f} % with a probability of 95 % (* is outside)"
    )


def table_head() -> str:
    """Return the two lines of the head of the table."""
    columns = [
        f"{c} {kind}, %"
        for kind in ("coverage", "combined coverage", "combined half width", "standard error")
        for c in COLUMNS
    ]
    cells = ["fault", *columns, "correlated errors, %", "not converged", "not simulated"]
    return _line(cells) + "\n" + _line(["---"] * len(cells))


def table_row(fault: str, outcomes: Sequence[FaultOutcome]) -> str:
    """Return a row of the table: coverages, and median standard errors over the true values."""
    converged_outcomes = [outcome for outcome in outcomes if outcome.converged]
    columns = np.array(
        [
            [*outcome.contains_truth, *outcome.combined_contains_truth]
            for outcome in converged_outcomes
        ]
    ).T
    half_widths = [outcome.half_widths for outcome in converged_outcomes]
    errors = 100 * np.nanmedian([outcome.relative for outcome in converged_outcomes], axis=0)
    correlated = 100 * np.mean([outcome.correlated for outcome in converged_outcomes])
    failures = len(outcomes) - len(converged_outcomes)
    return _line(
        [
            fault,
            *map(_coverage_cell, columns),
            *map(_median_cell, np.array(half_widths).T),
            *map("{:.2g}".format, errors),
            f"{correlated:.0f}",
            f"{failures}",
            f"{sum(outcome.redrawn for outcome in outcomes)}",
        ]
    )


def _coverage_cell(contained: Array) -> str:
    """Return the coverage in percent, with a star if exact intervals would have it in less than 5 %
    of cases.

    `contained` has 1, 0 or NaN for each twin; NaN (no interval) does not count.
    """
    contained = contained[np.isfinite(contained)]
    if not len(contained):
        return "-"
    low, high = binom.interval(0.95, len(contained), 0.95)
    return f"{100 * contained.mean():.3g}{'' if low <= contained.sum() <= high else '*'}"


def _median_cell(shares: Array) -> str:
    """Return the median in percent of those that are not NaN."""
    known = shares[np.isfinite(shares)]
    return f"{100 * np.median(known):.2g}" if len(known) else "-"


def loss_of_precision(outcomes: Sequence[FaultOutcome]) -> str:
    """Return the ratios of standard errors with and without nuisance parameters, without errors."""
    ratios = np.nanmedian([outcome.relative / outcome.without for outcome in outcomes], axis=0)
    shown_ratios = ", ".join(f"{c} {ratio:.2f}" for c, ratio in zip(COLUMNS, ratios, strict=True))
    return f"Without faults: standard errors with nuisance parameters over those without: {shown_ratios}"


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
