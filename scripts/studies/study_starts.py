"""Convergence from distant initial guesses, and without any, for three bodies.

The guess of every parameter is log-uniform within a factor of the true value, or there is no guess.
The bodies are the paper's cylinder, which hangs; a soft bar, which sags by as much as its length;
and a block of silicone, so stiff that it moves almost as the hand does. A start succeeds if every
parameter is within 1 %, or within three standard errors, of the best answer of all starts. It also
succeeds with an equal fit, as where the data do not determine a parameter: the likelihood ratio of
both answers is within three standard deviations; the number of these successes is printed. Without
a guess every run has its own noise, and an answer succeeds if its misfit is not larger than that of
the true values. The cost is counted in sweeps, that is in factorisations of the blocks of all time
steps, including those of simulations and of the initial equilibrium.

With --methods, every method solves a small cylinder without noise from the same guesses; a solve
succeeds if all estimates are within 1 % of the true values, whatever its status.

    python scripts study_starts [--bodies cylinder] [--starts 20] [--factor 30] [--unplaced]
    python scripts study_starts --unguessed
    python scripts study_starts --methods --starts 40 --factor 10
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest
from script_arguments import make_parser
from synthetic import HANGING, Swing, swing

from collocation_sysid.errors import InputError, SimulationError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.structured import box_mesh, cylinder_mesh
from collocation_sysid.methods.comparison.penalty import AugmentedLagrangian, Penalty
from collocation_sysid.methods.comparison.shooting import Shooting
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.parameters import Parameter, Parameters, Unknown
from collocation_sysid.pipeline import solve
from collocation_sysid.problem import Problem
from collocation_sysid.program.linear_algebra.factorisation import Factor, Factoriser
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Grasp, Markers, Nuisance
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.uncertainty import ErrorModel, uncertainty_from_fit

TRUTH = {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0}
BOUNDS = {
    "lambda_pa": (10.0, 1e5),
    "mu_pa": (10.0, 1e5),
    "gamma_r_s": (1e-5, 1.0),
    "gamma_m_1_s": (1e-3, 100.0),
}
# Radius and height of the cylinder [m].
RADIUS_M = 0.04
HEIGHT_M = 0.16
# Sampling interval [s], and standard deviation of each marker coordinate [m].
STEP_S = 0.01
SIGMA_M = 1e-3
# A start succeeds within this share of the best answer, or within this number of standard errors.
SUCCESS_SHARE = 0.01
STANDARD_ERRORS = 3.0
# Statuses of a solve whose answer can be a success.
SOLVED_STATUSES = ("converged", "acceptable")


@dataclass(frozen=True, eq=False)
class SwungBody:
    """Recording of a swung body, and its true parameters."""

    experiment: Experiment
    truth: Mapping[str, float]
    scheme: str = "midpoint"  # scheme of simulation and fit
    # Standard deviation of each marker coordinate [m], which is also the stated one.
    noise_m: float = SIGMA_M


@dataclass(frozen=True)
class StartOutcome:
    """Result of one start, compared with the best answer of all starts."""

    number: int  # number of the start, from 0 on; without a guess the seed of the noise
    status: str  # status of the solve; "refused" if the problem was rejected
    sweeps: float  # factorisations divided by the number of time steps
    loss: float
    estimates: tuple[float, ...]  # NaN without one
    message: str
    # Whether the start succeeds, and only because its fit is equally good.
    success: bool = False
    same_fit: bool = False


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--bodies", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--factor", type=float, default=30.0)
    parser.add_argument("--unguessed", action="store_true", help="no guess, and other noise each")
    parser.add_argument("--unplaced", action="store_true", help="unknown places of the markers")
    parser.add_argument("--methods", action="store_true", help="all methods, a small cylinder")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.methods:
        compare_methods(guesses(arguments.starts, arguments.factor, arguments.seed))
        return
    for body in arguments.bodies:
        case = described(CASES[body](), arguments.unplaced)
        if arguments.unguessed:
            outcomes = [solve_without_guess(case, seed) for seed in range(arguments.starts)]
        else:
            starts = guesses(arguments.starts, arguments.factor, arguments.seed, case.truth)
            outcomes = study(with_noise(case, arguments.seed), starts)
        print(f"{body}: {summary(outcomes)}", flush=True)


# Bodies -------------------------------------------------------------------------------------------


def cylinder() -> SwungBody:
    """Return the cylinder of the paper: 171 nodes of foam, 100 steps of 10 ms."""
    return SwungBody(hanging_cylinder(layers=8, steps=100, scheme="midpoint", rings=2), TRUTH)


def soft_bar() -> SwungBody:
    """Return a clamped bar of 220 × 35 × 50 mm with E = 2 kPa and 95 kg/m³, whose tip hangs down."""
    body = Body(box_mesh((0.22, 0.035, 0.05), (11, 2, 3)), density_kg_m3=95.0, damping="rayleigh")
    motion = Swing(
        duration_s=1.0,
        amplitude_m=(0.03, 0.04, 0.03),
        amplitude_rad=(0.2, 0.3, 0.3),
        frequency_hz=(1.1, 1.4, 1.7),
        rise_s=0.3,
        start=Rotation.identity(),
    )
    clamped_nodes = np.flatnonzero(body.nodes_m[:, 0] < 1e-9)
    return swung_body(
        body, clamped_nodes, motion, moduli(2e3, 0.3) | {"gamma_r_s": 0.01, "gamma_m_1_s": 0.5}
    )


def silicone_block() -> SwungBody:
    """Return a hanging block of 60 × 60 × 100 mm with E = 500 kPa and 1100 kg/m³.

    The block deforms by some tenths of a millimetre. The noise of its markers is therefore 0.1 mm:
    with 1 mm the data would not determine the damping.
    """
    body = Body(box_mesh((0.06, 0.06, 0.1), (3, 3, 5)), density_kg_m3=1100.0, damping="rayleigh")
    motion = Swing(
        duration_s=1.0,
        amplitude_m=(0.05, 0.04, 0.03),
        amplitude_rad=(0.1, 0.1, 0.6),
        frequency_hz=(1.4, 1.7, 2.0),
        rise_s=0.3,
        start=HANGING,
    )
    clamped_nodes = np.flatnonzero(body.nodes_m[:, 2] < 1e-9)
    truth = moduli(5e5, 0.45) | {"gamma_r_s": 2e-3, "gamma_m_1_s": 0.5}
    return swung_body(body, clamped_nodes, motion, truth, noise_m=1e-4)


def moduli(young_pa: float, poisson: float) -> dict[str, float]:
    """Return λ and μ [Pa]."""
    shear = young_pa / (2 * (1 + poisson))
    return {"lambda_pa": 2 * shear * poisson / (1 - 2 * poisson), "mu_pa": shear}


def swung_body(
    body: Body,
    clamped_nodes: NDArray[np.int64],
    motion: Swing,
    truth: Mapping[str, float],
    noise_m: float = SIGMA_M,
) -> SwungBody:
    """Return the recording of a swung body, with exact tracks of every fifth node of its surface.

    `clamped_nodes` are the nodes in the gripper, `noise_m` is the noise that the markers state [m].
    """
    poses = motion.poses(STEP_S)
    nodes = body.nodes_m
    at_side = (nodes == nodes.min(axis=0)) | (nodes == nodes.max(axis=0))
    marked_nodes = np.setdiff1d(np.flatnonzero(at_side.any(axis=1)), clamped_nodes)[::5]
    no_tracks = np.zeros((len(poses.t_s), len(marked_nodes), 3))
    markers = Markers(poses.t_s, no_tracks, noise_m, places_m=body.nodes_m[marked_nodes])
    grasp = Grasp(clamped_nodes, poses)
    ideal = Nuisance.none()
    experiment = Experiment(body, poses.t_s, [grasp], markers, name="swing", nuisance=ideal)
    tracks = simulate(experiment, truth, "midpoint", substeps=1).markers_m
    return SwungBody(with_markers(experiment, tracks), truth, noise_m=noise_m)


def described(case: SwungBody, unplaced: bool) -> SwungBody:
    """Return the body with the default nuisance parameters, and with markers at unknown places if
    `unplaced`.
    """
    experiment = replace(case.experiment, nuisance=Nuisance())
    if unplaced:
        markers = experiment.markers
        unknown = Markers(markers.t_s, markers.positions_m, markers.sigma_m, markers.names)
        experiment = replace(experiment, markers=unknown)
    return replace(case, experiment=experiment)


def with_noise(case: SwungBody, seed: int) -> SwungBody:
    """Return the recording with its noise on the tracks."""
    tracks = case.experiment.markers.positions_m
    noise = np.random.default_rng(seed).normal(size=tracks.shape) * case.noise_m
    return replace(case, experiment=with_markers(case.experiment, tracks + noise))


CASES: dict[str, Callable[[], SwungBody]] = {
    "cylinder": cylinder,
    "soft-bar": soft_bar,
    "silicone-block": silicone_block,
}


def hanging_cylinder(
    layers: int, steps: int, scheme: str, rings: int = 1, step_s: float = STEP_S
) -> Experiment:
    """Return the recording of a hanging, swung cylinder with exact tracks of a scheme.

    `layers` and `rings` are numbers of elements, `steps` is the number of samples at intervals of
    `step_s` [s].
    """
    shape = cylinder_mesh(RADIUS_M, HEIGHT_M, rings, layers)
    body = Body(shape, density_kg_m3=20.0, damping="rayleigh")
    t_s = step_s * np.arange(steps, dtype=np.float64)
    poses = swing(
        t_s,
        amplitude_m=(0.05, 0.04, 0.03),
        amplitude_rad=(0.1, 0.1, 0.6),
        frequency_hz=(0.9, 1.1, 1.3),
        rise_s=0.3,
        start=Rotation.from_rotvec([np.pi, 0, 0]),  # the cylinder hangs
    )
    heights = body.nodes_m[:, 2]
    on_side = np.linalg.norm(body.nodes_m[:, :2], axis=1) > RADIUS_M / 2
    marked_nodes = np.flatnonzero(on_side & (heights > 0.2 * HEIGHT_M))[::5]
    no_tracks = np.zeros((steps, len(marked_nodes), 3))
    markers = Markers(t_s, no_tracks, SIGMA_M, places_m=body.nodes_m[marked_nodes])
    grasp = Grasp(np.flatnonzero(heights < 1e-9), poses)
    ideal = Nuisance.none()
    experiment = Experiment(body, t_s, [grasp], markers, name="swing", nuisance=ideal)
    return with_markers(experiment, simulate(experiment, TRUTH, scheme, substeps=1).markers_m)


# Starts -------------------------------------------------------------------------------------------


def guesses(
    count: int, factor: float, seed: int, truth: Mapping[str, float] = TRUTH
) -> NDArray[np.float64]:
    """Return guesses (count, p), log-uniform within a factor of the truth."""
    spread = np.random.default_rng(seed).uniform(-1, 1, (count, len(truth)))
    return np.array(list(truth.values())) * factor**spread


def study(case: SwungBody, starts: NDArray[np.float64]) -> list[StartOutcome]:
    """Solve from the truth and from every start (S, p), and compare with the best answer."""
    best = solve(problem_of(case, np.array(list(case.truth.values()))))
    if not best.status.converged:
        raise SystemExit(f"from the truth: {best.message}")
    fit = linearise_fit(best.collocation, best.z)
    uncertainty = uncertainty_from_fit(
        fit, best.collocation.parameters, best.q, ErrorModel("given", "independent")
    )
    std_errors = np.array(
        [uncertainty.estimates[name].statistical_std_error or np.nan for name in case.truth]
    )
    outcomes = [attempt(case, number, guess) for number, guess in enumerate(starts)]
    answers = [(best.history[-1].loss, tuple(best.parameters[name] for name in case.truth))]
    answers += [(each.loss, each.estimates) for each in outcomes if each.status in SOLVED_STATUSES]
    loss, estimates = min(answers)
    return [with_success(each, np.array(estimates), loss, std_errors) for each in outcomes]


def solve_without_guess(case: SwungBody, seed: int) -> StartOutcome:
    """Solve a recording with the noise of a seed without a guess, and compare with the loss of the
    truth.
    """
    noisy = with_noise(case, seed)
    outcome = attempt(noisy, seed, np.full(len(case.truth), np.nan))
    noise_m = noisy.experiment.markers.positions_m - case.experiment.markers.positions_m
    loss_of_truth = float(((noise_m / noisy.experiment.markers.sigma_m[:, None]) ** 2).sum())
    is_solved = outcome.status in SOLVED_STATUSES
    return replace(outcome, success=is_solved and outcome.loss < loss_of_truth)


def attempt(case: SwungBody, number: int, guess: NDArray[np.float64]) -> StartOutcome:
    """Solve from one initial guess (p,); success is set later, by `with_success`."""
    with counted_factorisations() as count:
        try:
            solution = solve(problem_of(case, guess))
        except InputError as error:
            return StartOutcome(number, "refused", 0.0, np.inf, (np.nan,) * len(guess), str(error))
    return StartOutcome(
        number,
        solution.status.value,
        count[0] / len(case.experiment.t_s),
        solution.history[-1].loss if solution.history else np.inf,
        tuple(solution.parameters[name] for name in case.truth),
        solution.message,
    )


def with_success(
    outcome: StartOutcome,
    best: NDArray[np.float64],
    smallest_loss: float,
    std_errors: NDArray[np.float64],
) -> StartOutcome:
    """Return the outcome with its success, by comparison with the best answer.

    `best` (p,) are the estimates of the best answer, `smallest_loss` is its loss, and `std_errors`
    (p,) are their standard errors.
    """
    estimates = np.array(outcome.estimates)
    ratios = np.abs(np.log(estimates / best))
    errors = np.abs(estimates - best) / std_errors
    is_close = bool(((ratios < SUCCESS_SHARE) | (errors < STANDARD_ERRORS)).all())
    # The loss follows a χ² distribution, so that this difference is that of as many standard
    # deviations.
    fits_equally = outcome.loss - smallest_loss < STANDARD_ERRORS**2
    return replace(
        outcome,
        success=(is_close or fits_equally) and outcome.status in SOLVED_STATUSES,
        same_fit=fits_equally and not is_close,
    )


def problem_of(case: SwungBody, guess: NDArray[np.float64]) -> Problem:
    """Return the problem with initial guesses (p,); NaN for no guess."""
    unknowns = {
        name: Unknown(float(value) if np.isfinite(value) else None)
        for name, value in zip(case.truth, guess, strict=True)
    }
    return Problem([case.experiment], unknowns, scheme=case.scheme, substeps=1)


def parameters(values: NDArray[np.float64]) -> Parameters:
    """Return the four parameters with guesses (4,) and `BOUNDS`."""
    return Parameters(
        tuple(
            Parameter(name, float(value), *BOUNDS[name])
            for name, value in zip(TRUTH, values, strict=True)
        )
    )


# Methods with a time limit, and the shares of the guesses from which they are run.
TIME_LIMIT_S = 40.0
METHODS = {
    "reduced space": (ReducedSpace(), 1.0),
    "shooting": (Shooting(max_time_s=TIME_LIMIT_S), 1.0),
    "penalty, Levenberg–Marquardt": (
        Penalty(inner="levenberg-marquardt", max_time_s=TIME_LIMIT_S),
        1.0,
    ),
    "augmented Lagrangian, first ρ = 1e2": (
        AugmentedLagrangian(rho=1e2, max_time_s=TIME_LIMIT_S),
        0.5,
    ),
    "augmented Lagrangian, first ρ = 1e5": (AugmentedLagrangian(max_time_s=TIME_LIMIT_S), 0.5),
    "interior point": (InteriorPoint(initial="simulation", max_time_s=TIME_LIMIT_S), 0.25),
}


def compare_methods(starts: NDArray[np.float64]) -> None:
    """Print successes with their 95 % intervals, and median times, of each method from guesses (S, 4)."""
    experiment = hanging_cylinder(layers=7, steps=40, scheme="midpoint", step_s=0.02)
    truth = np.array(list(TRUTH.values()))
    for name, (method, share) in METHODS.items():
        successes, times_s = 0, []
        for guess in starts[: max(1, round(share * len(starts)))]:
            problem = Problem([experiment], parameters(guess), scheme="midpoint", substeps=1)
            began_s = time.perf_counter()
            try:
                found = solve(problem, method).parameters
            except (InputError, SimulationError) as error:
                print(f"{name}: {error}", flush=True)
            else:
                ratios = np.array([found[key] for key in TRUTH]) / truth
                successes += bool((np.abs(ratios - 1) <= SUCCESS_SHARE).all())
            times_s.append(time.perf_counter() - began_s)
        low, high = binomtest(successes, len(times_s)).proportion_ci(method="wilson")
        print(
            f"{name}: {successes} of {len(times_s)}, {100 * low:.0f}–{100 * high:.0f} %, "
            f"median time {np.median(times_s):.2g} s",
            flush=True,
        )


@contextmanager
def counted_factorisations() -> Iterator[list[int]]:
    """Count the factorised matrices in the body of a with statement; the list has the current
    number.
    """
    count = [0]
    original = Factoriser.factorise

    def counting(self: Factoriser, *matrix: Any, **room: Any) -> Factor:
        count[0] += 1
        return original(self, *matrix, **room)

    Factoriser.factorise = counting
    try:
        yield count
    finally:
        Factoriser.factorise = original


def summary(outcomes: list[StartOutcome]) -> str:
    """Return numbers of successes and sweeps, and one line for each failure."""
    sweeps = [outcome.sweeps for outcome in outcomes if outcome.success]
    equal = sum(outcome.success and outcome.same_fit for outcome in outcomes)
    lines = [f"success: {len(sweeps)} of {len(outcomes)}, of which by an equal fit only: {equal}"]
    if sweeps:
        lines.append(f"sweeps: median {np.median(sweeps):.1f}, max {np.max(sweeps):.1f}")
    lines += [f"  {o.number}: {o.status}, {o.message}" for o in outcomes if not o.success]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
