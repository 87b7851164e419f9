"""Coverage of the 95 % intervals with the errors of a real laboratory, for twins with one error
each.

A cylinder hangs from a swung hand, as in `coverage_twins`. The tracks are simulated with the scheme
of the fit and have white noise. Each twin has one error of the recording, a random number of the
stated size, and is identified with every option at its default: nuisance parameters, noise and
covariance. The solve starts from the true values. In `study_effects` all errors are drawn at once.

    python scripts study_faults [--twins 200] [--only "gravity 1°"] [--seed 0] [--workers 2]
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from coverage_twins import QUANTITIES, SCHEME, intervals_with_truth, reference, truth
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from script_arguments import make_parser
from studies import markdown, run_in_processes
from study_starts import TRUTH, parameters

from collocation_sysid import Problem
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.pipeline import solve
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Grasp, Nuisance, PoseSequence
from collocation_sysid.statistics.pose_noise import uncertainty_at
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
    """Results of one twin, by quantity (`QUANTITIES`)."""

    converged: bool  # whether the solve converged
    # (6,): 1 if the statistical interval contains the truth, 0 if not, NaN without interval.
    contains_truth: Array
    relative: Array  # (6,): standard errors over the true values; NaN without standard error


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--twins", type=int, default=200, help="of each fault")
    parser.add_argument("--only", nargs="*", choices=list(FAULTS), default=list(FAULTS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1, help="processes")
    arguments = parser.parse_args()
    rows = []
    for fault in arguments.only:
        seeds = [(arguments.seed, *fault.encode(), twin) for twin in range(arguments.twins)]
        jobs = [(fault, seed) for seed in seeds]
        rows.append(table_row(fault, run_in_processes(run, jobs, arguments.workers)))
    print(markdown(HEADS, rows))


# One twin -----------------------------------------------------------------------------------------


def run(fault: str, seed: Sequence[int]) -> FaultOutcome:
    """Draw a twin with a fault (a key of `FAULTS`), identify it, and compare the answer with the
    truth.
    """
    rng = np.random.default_rng(seed)
    true_recording, described = FAULTS[fault](exact_recording(), rng)
    tracks = true_recording.markers.positions_m
    tracks = tracks + true_recording.markers.sigma_m[:, None] * rng.standard_normal(tracks.shape)
    return identified(with_markers(described, tracks))


@cache
def exact_recording() -> Experiment:
    """Return the experiment with exact tracks and with the default nuisance parameters."""
    experiment = replace(reference(SIGMA_M)[0], nuisance=Nuisance())
    return with_markers(experiment, experiment.markers.predict_positions(positions_m()))


def positions_m() -> Array:
    """Return the exact node positions (T, n, 3) of the experiment [m]."""
    _, x = reference(SIGMA_M)
    return x.reshape(len(x), -1, 3)


def identified(experiment: Experiment) -> FaultOutcome:
    """Identify an experiment with default options, starting from the truth."""
    problem = Problem([experiment], parameters(np.array(list(TRUTH.values()))))
    solution = solve(problem, ReducedSpace(tolerance=1e-6, ladder=(1.0,)))
    uncertainty = uncertainty_at(solution.collocation, solution.z)
    return FaultOutcome(
        solution.status.converged,
        np.array(intervals_with_truth(uncertainty)),
        relative_errors(uncertainty),
    )


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


def tilted_gravity(experiment: Experiment, rng: Generator) -> Experiment:
    """Return the experiment with gravity tilted by random angles of about 1° about x and y."""
    angles = np.radians(rng.standard_normal(2))
    down = np.array([*angles, -1.0])
    gravity_m_s2 = 9.81 * down / np.linalg.norm(down)
    return replace(experiment, gravity_m_s2=tuple(gravity_m_s2.tolist()))


def misplaced_in_gripper(experiment: Experiment, rng: Generator) -> TrueAndStated:
    """Return a recording of a body that is misplaced in the gripper by 1 mm and 0.5° per axis."""
    return simulated(displaced(experiment, 1e-3, np.radians(0.5), rng)), experiment


def displaced(experiment: Experiment, size_m: float, size_rad: float, rng: Generator) -> Experiment:
    """Return the experiment with the body displaced in the gripper by random errors per axis."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(size_rad * rng.standard_normal(3)).as_matrix()
    matrix[:3, 3] = size_m * rng.standard_normal(3)
    (grasp,) = experiment.grasps
    return replace(experiment, grasps=(Grasp(grasp.nodes, grasp.poses.after(matrix)),))


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


FAULTS: dict[str, Callable[[Experiment, Generator], TrueAndStated]] = {
    "none": without_fault,
    "clock 2 ms late": late(0.002),
    "poses 0.5 mm, 0.3°, given": noisy_poses(5e-4, 0.3, is_stated=True),
    "poses 0.5 mm, 0.3°, estimated": noisy_poses(5e-4, 0.3, is_stated=False),
    "gravity 1°": lambda recording, rng: (simulated(tilted_gravity(recording, rng)), recording),
    "pose in the gripper 1 mm, 0.5°": misplaced_in_gripper,
    "sigma_m 0.3 of the true value": with_stated_sigma(0.3),
    "one marker 3 times as noisy": with_noisy_marker,
    "marker positions 1 mm": misplaced,
    "marker positions unknown": unplaced,
}


# Table --------------------------------------------------------------------------------------------


HEADS = (
    "fault",
    *(f"{column} {kind}, %" for kind in ("coverage", "standard error") for column in COLUMNS),
    "not converged",
)


def table_row(fault: str, outcomes: Sequence[FaultOutcome]) -> tuple[str, ...]:
    """Return a row of the table: coverages, and median standard errors over the true values."""
    converged = [outcome for outcome in outcomes if outcome.converged]
    contained = np.array([o.contains_truth for o in converged])
    widths = np.array([o.relative for o in converged])
    return (
        fault,
        *(_cell(each, np.mean, ".3g") for each in contained.T),
        *(_cell(each, np.median, ".2g") for each in widths.T),
        str(len(outcomes) - len(converged)),
    )


def _cell(shares: Array, middle: Callable[[Array], float], form: str) -> str:
    """Return mean or median in percent of the twins that have an interval (not NaN)."""
    known = shares[np.isfinite(shares)]
    return format(100 * middle(known), form) if len(known) else "-"


if __name__ == "__main__":
    main()
