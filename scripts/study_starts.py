"""Convergence from distant initial guesses, and without any, for three bodies.

The guess of every parameter is log-uniform within a factor of the true value, or there is no guess.
The bodies are the paper's cylinder, which hangs; a soft bar, which sags by as much as its length; and
a block of silicone, so stiff that it moves almost as the hand does. A start succeeds if every
parameter is within 1 %, or within three standard errors, of the best answer of all starts. It also
succeeds with an equal fit, as where the data do not determine a parameter: the likelihood ratio of
both answers is within three standard deviations; the number of these successes is printed. Without a
guess every run has its own noise, and an answer succeeds if its misfit is not larger than that of the
true values. The cost is counted in sweeps, that is in factorisations of the blocks of all time steps,
including those of simulations and of the initial equilibrium.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from synthetic import HANGING, Swing, swing

from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.structured import box_mesh, cylinder_mesh
from collocation_sysid.model.parameters import Parameter, Parameters, Unknown
from collocation_sysid.pipeline import solve
from collocation_sysid.problem import Problem
from collocation_sysid.program.linear_algebra.factorisation import (
    Factor,
    Factoriser,
)
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Grasp, Markers, Nuisance
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.uncertainty import (
    ErrorModel,
    uncertainty_from_fit,
)

TRUTH = {
    "lambda_pa": 200.0,
    "mu_pa": 300.0,
    "gamma_r_s": 0.009,
    "gamma_m_1_s": 1.0,
}
BOUNDS = {
    "lambda_pa": (10.0, 1e5),
    "mu_pa": (10.0, 1e5),
    "gamma_r_s": (1e-5, 1.0),
    "gamma_m_1_s": (1e-3, 100.0),
}
RADIUS_M = 0.04
HEIGHT_M = 0.16
STEP_S = 0.01
SIGMA_M = 1e-3
TOLERANCE = 0.01
ERRORS = 3.0
ENDED = ("converged", "acceptable")


@dataclass(frozen=True, eq=False)
class Case:
    """A body that was swung, and the parameters that its tracks were made with.

    Noise of `noise_m` is what its markers have, and are said to have.
    """

    experiment: Experiment
    truth: Mapping[str, float]
    scheme: str = "midpoint"
    noise_m: float = SIGMA_M


@dataclass(frozen=True)
class Outcome:
    """One start; the ratio and the errors are to the best answer of all, of the worst parameter.

    `excess` is by how much its loss is higher, `same_fit` whether that alone makes it a success.
    """

    number: int
    status: str
    success: bool
    same_fit: bool
    sweeps: float
    time_s: float
    loss: float
    excess: float
    rms_m: float
    worst_ratio: float
    worst_errors: float
    guess: tuple[float, ...]
    found: tuple[float, ...]
    notes: tuple[str, ...]
    message: str


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--bodies", nargs="*", default=list(CASES), choices=list(CASES)
    )
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--factor", type=float, default=30.0)
    parser.add_argument(
        "--unguessed",
        action="store_true",
        help="no guess at all, and other noise every time",
    )
    parser.add_argument(
        "--unplaced",
        action="store_true",
        help="markers' places are unknown too",
    )
    parser.add_argument(
        "--ideal", action="store_true", help="no nuisance parameters"
    )
    parser.add_argument("--method", default="reduced-space")
    parser.add_argument("--noise-m", type=float, help="other than the case's")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--only", type=int, nargs="*", help="numbers of the starts to run"
    )
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    found = {}
    for body in arguments.bodies:
        case = described(CASES[body](), arguments.unplaced, arguments.ideal)
        noise_m = (
            case.noise_m if arguments.noise_m is None else arguments.noise_m
        )
        starts = guesses(
            arguments.starts, arguments.factor, arguments.seed, case.truth
        )
        if arguments.unguessed:
            seeds = arguments.only or range(arguments.starts)
            found[body] = [
                unguessed(case, noise_m, seed, arguments.method)
                for seed in seeds
            ]
        else:
            noisy = with_noise(case, noise_m, arguments.seed)
            found[body] = study(noisy, starts, arguments.method, arguments.only)
        if not arguments.json:
            print(f"{body}: {summary(found[body])}", flush=True)
    if arguments.json:
        listed = {
            body: [asdict(each) for each in outcomes]
            for body, outcomes in found.items()
        }
        print(json.dumps(listed, indent=1))


# Bodies -------------------------------------------------------------------------------------------


def cylinder() -> Case:
    """The paper's: 171 nodes of foam, 100 steps of 10 ms."""
    return Case(
        hanging_cylinder(layers=8, steps=100, scheme="midpoint", rings=2), TRUTH
    )


def soft_bar() -> Case:
    """A bar of 220 × 35 × 50 mm of E = 2 kPa and 95 kg/m³, clamped: its tip hangs down."""
    body = Body(
        box_mesh((0.22, 0.035, 0.05), (11, 2, 3)),
        density_kg_m3=95.0,
        damping="rayleigh",
    )
    motion = Swing(
        duration_s=1.0,
        amplitude_m=(0.03, 0.04, 0.03),
        amplitude_rad=(0.2, 0.3, 0.3),
        frequency_hz=(1.1, 1.4, 1.7),
        rise_s=0.3,
        start=Rotation.identity(),
    )
    held = np.flatnonzero(body.nodes_m[:, 0] < 1e-9)
    return measured(
        body,
        held,
        motion,
        moduli(2e3, 0.3) | {"gamma_r_s": 0.01, "gamma_m_1_s": 0.5},
    )


def silicone_block() -> Case:
    """A block of 60 × 60 × 100 mm that hangs, of E = 500 kPa and 1100 kg/m³.

    It sways by some tenths of a millimetre, so its markers are seen as well as that: noise of 1 mm
    would tell nothing of its damping.
    """
    body = Body(
        box_mesh((0.06, 0.06, 0.1), (3, 3, 5)),
        density_kg_m3=1100.0,
        damping="rayleigh",
    )
    motion = Swing(
        duration_s=1.0,
        amplitude_m=(0.05, 0.04, 0.03),
        amplitude_rad=(0.1, 0.1, 0.6),
        frequency_hz=(1.4, 1.7, 2.0),
        rise_s=0.3,
        start=HANGING,
    )
    held = np.flatnonzero(body.nodes_m[:, 2] < 1e-9)
    truth = moduli(5e5, 0.45) | {"gamma_r_s": 2e-3, "gamma_m_1_s": 0.5}
    return measured(body, held, motion, truth, noise_m=1e-4)


def moduli(young_pa: float, poisson: float) -> dict[str, float]:
    shear = young_pa / (2 * (1 + poisson))
    return {
        "lambda_pa": 2 * shear * poisson / (1 - 2 * poisson),
        "mu_pa": shear,
    }


def measured(
    body: Body,
    held: NDArray[np.int64],
    motion: Swing,
    truth: Mapping[str, float],
    noise_m: float = SIGMA_M,
) -> Case:
    """A body swung from its rest state, with tracks of every fifth node outside."""
    poses = motion.poses(STEP_S)
    nodes = body.nodes_m
    at_side = (nodes == nodes.min(axis=0)) | (nodes == nodes.max(axis=0))
    marked = np.setdiff1d(np.flatnonzero(at_side.any(axis=1)), held)[::5]
    nowhere = np.zeros((len(poses.t_s), len(marked), 3))
    markers = Markers(
        poses.t_s, nowhere, noise_m, places_m=body.nodes_m[marked]
    )
    grasp = Grasp(held, poses)
    ideal = Nuisance.none()
    experiment = Experiment(
        body, poses.t_s, [grasp], markers, name="swing", nuisance=ideal
    )
    tracks = simulate(experiment, truth, "midpoint", substeps=1).markers_m
    return Case(with_markers(experiment, tracks), truth, noise_m=noise_m)


def described(case: Case, unplaced: bool, ideal: bool) -> Case:
    """The case with the default nuisance parameters or none, maybe without its markers' places."""
    experiment = case.experiment
    if unplaced:
        markers = experiment.markers
        unknown = Markers(
            markers.t_s, markers.positions_m, markers.sigma_m, markers.names
        )
        experiment = replace(experiment, markers=unknown)
    nuisance = Nuisance.none() if ideal else Nuisance()
    return replace(case, experiment=replace(experiment, nuisance=nuisance))


def with_noise(case: Case, noise_m: float, seed: int) -> Case:
    tracks = case.experiment.markers.positions_m
    noise = np.random.default_rng(seed).normal(size=tracks.shape) * noise_m
    return replace(
        case, experiment=with_markers(case.experiment, tracks + noise)
    )


CASES: dict[str, Callable[[], Case]] = {
    "cylinder": cylinder,
    "soft-bar": soft_bar,
    "silicone-block": silicone_block,
}


def hanging_cylinder(
    layers: int, steps: int, scheme: str, rings: int = 1
) -> Experiment:
    """A cylinder held at one end, hanging and swung, with tracks of its own scheme."""
    shape = cylinder_mesh(RADIUS_M, HEIGHT_M, rings, layers)
    body = Body(shape, density_kg_m3=20.0, damping="rayleigh")
    t_s = STEP_S * np.arange(steps, dtype=np.float64)
    poses = swing(
        t_s,
        amplitude_m=(0.05, 0.04, 0.03),
        amplitude_rad=(0.1, 0.1, 0.6),
        frequency_hz=(0.9, 1.1, 1.3),
        rise_s=0.3,
        start=Rotation.from_rotvec([np.pi, 0, 0]),  # it hangs
    )
    heights = body.nodes_m[:, 2]
    on_side = np.linalg.norm(body.nodes_m[:, :2], axis=1) > RADIUS_M / 2
    marked = np.flatnonzero(on_side & (heights > 0.2 * HEIGHT_M))[::5]
    nowhere = np.zeros((steps, len(marked), 3))
    markers = Markers(t_s, nowhere, SIGMA_M, places_m=body.nodes_m[marked])
    grasp = Grasp(np.flatnonzero(heights < 1e-9), poses)
    ideal = Nuisance.none()
    experiment = Experiment(
        body, t_s, [grasp], markers, name="swing", nuisance=ideal
    )
    return with_markers(
        experiment, simulate(experiment, TRUTH, scheme, substeps=1).markers_m
    )


# Starts -------------------------------------------------------------------------------------------


def guesses(
    count: int, factor: float, seed: int, truth: Mapping[str, float] = TRUTH
) -> NDArray[np.float64]:
    """(count, p) log-uniform within a factor of the truth."""
    spread = np.random.default_rng(seed).uniform(-1, 1, (count, len(truth)))
    return np.array(list(truth.values())) * factor**spread


def study(
    case: Case,
    starts: NDArray[np.float64],
    method: str = "reduced-space",
    only: list[int] | None = None,
) -> list[Outcome]:
    """Solve from the truth, for the best answer, and from every start; NaN is no guess."""
    truth = np.array(list(case.truth.values()))
    best = solve(problem_of(case, truth), method)
    if not best.status.converged:
        raise SystemExit(f"from the truth: {best.message}")
    fit = linearise_fit(best.collocation, best.z)
    found = uncertainty_from_fit(
        fit,
        best.collocation.parameters,
        best.q,
        ErrorModel("given", "independent"),
    )
    std_errors = [
        found.estimates[name].statistical_std_error or np.nan
        for name in case.truth
    ]
    outcomes = []
    for number, guess in enumerate(starts):
        if not only or number in only:
            outcomes.append(attempt(case, number, guess, method))
            print(end=".", file=sys.stderr, flush=True)
    losses = [best.history[-1].loss, *(each.loss for each in outcomes)]
    answers = [
        tuple(best.parameters[name] for name in case.truth),
        *(e.found for e in outcomes),
    ]
    ended = [True, *(each.status in ENDED for each in outcomes)]
    first = min(np.flatnonzero(ended), key=lambda k: losses[k])
    least = losses[first]
    reference = np.array(answers[first])
    return [
        judged(each, reference, least, np.array(std_errors))
        for each in outcomes
    ]


def unguessed(case: Case, noise_m: float, seed: int, method: str) -> Outcome:
    """Solve without a guess, with noise of its own, and compare with the fit of the truth."""
    noisy = with_noise(case, noise_m, seed)
    outcome = attempt(noisy, seed, np.full(len(case.truth), np.nan), method)
    print(end=".", file=sys.stderr, flush=True)
    excess = outcome.loss - loss_of_truth(noisy, case)
    ratios = np.abs(np.log(np.array(outcome.found) / list(case.truth.values())))
    return replace(
        outcome,
        success=excess < 0 and outcome.status in ENDED,
        excess=excess,
        worst_ratio=float(np.exp(ratios.max())),
        worst_errors=np.nan,
    )


def loss_of_truth(noisy: Case, clean: Case) -> float:
    """The noise's sum of squares, in its deviations."""
    seen = noisy.experiment.markers
    true = clean.experiment.markers.positions_m
    return float(
        (((seen.positions_m - true) / seen.sigma_m[:, None]) ** 2).sum()
    )


def attempt(
    case: Case, number: int, guess: NDArray[np.float64], method: str
) -> Outcome:
    """Solve a case from one initial guess, and return its errors and its number of sweeps."""
    given = tuple(guess.tolist())
    nothing = (np.nan,) * len(guess)
    with counted_factorisations() as count:
        try:
            solution = solve(problem_of(case, guess), method)
        except InputError as error:
            worst = (np.inf, np.inf, np.nan, np.inf, np.inf)
            return Outcome(
                number,
                "refused",
                False,
                False,
                0.0,
                0.0,
                *worst,
                given,
                nothing,
                (),
                str(error),
            )
    return Outcome(
        number,
        solution.status.value,
        False,
        False,
        count[0] / len(case.experiment.t_s),
        solution.timing.total
        + (solution.scan.time_s if solution.scan else 0.0),
        solution.history[-1].loss if solution.history else np.inf,
        np.inf,
        solution.rms_m,
        np.inf,
        np.inf,
        given,
        tuple(solution.parameters[name] for name in case.truth),
        tuple(solution.notes),
        solution.message,
    )


def judged(
    outcome: Outcome,
    best: NDArray[np.float64],
    least: float,
    std_errors: NDArray[np.float64],
) -> Outcome:
    """The outcome compared with the best answer."""
    found = np.array(outcome.found)
    excess = outcome.loss - least
    ratios = np.abs(np.log(found / best))
    errors = np.abs(found - best) / std_errors
    close = bool(((ratios < TOLERANCE) | (errors < ERRORS)).all())
    # The loss is χ².
    as_well = excess < ERRORS**2
    return replace(
        outcome,
        success=(close or as_well) and outcome.status in ENDED,
        same_fit=as_well and not close,
        excess=excess,
        worst_ratio=float(np.exp(ratios.max())),
        worst_errors=float(np.nanmax(errors, initial=0.0)),
    )


def problem_of(case: Case, guess: NDArray[np.float64]) -> Problem:
    """The problem with guesses where they are numbers."""
    given = {
        name: Unknown(float(value) if np.isfinite(value) else None)
        for name, value in zip(case.truth, guess, strict=True)
    }
    return Problem([case.experiment], given, scheme=case.scheme, substeps=1)


def parameters(values: NDArray[np.float64]) -> Parameters:
    return Parameters(
        tuple(
            Parameter(name, float(value), *BOUNDS[name])
            for name, value in zip(TRUTH, values, strict=True)
        )
    )


@contextmanager
def counted_factorisations() -> Iterator[list[int]]:
    """Count the matrices factorised meanwhile."""
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


def summary(outcomes: list[Outcome]) -> str:
    sweeps = [outcome.sweeps for outcome in outcomes if outcome.success]
    failures = [outcome for outcome in outcomes if not outcome.success]
    lines = [
        f"success: {len(sweeps)} of {len(outcomes)}, of which by an equal fit only: "
        f"{sum(outcome.success and outcome.same_fit for outcome in outcomes)}",
        f"sweeps: median {np.median(sweeps):.1f}, max {np.max(sweeps):.1f}"
        if sweeps
        else "",
        f"time: {sum(outcome.time_s for outcome in outcomes):.1f} s",
        f"failures: {dict(Counter(outcome.status for outcome in failures)) or 'none'}",
    ]
    for outcome in failures:
        guess, found = (
            " ".join(f"{value:.4g}" for value in values)
            for values in (outcome.guess, outcome.found)
        )
        lines.append(
            f"  {outcome.number}: {guess} -> {found}, {outcome.sweeps:.1f} sweeps, "
            f"rms {1e3 * outcome.rms_m:.3g} mm, a factor of {outcome.worst_ratio:.3g} and "
            f"{outcome.worst_errors:.2g} standard errors off, loss {outcome.excess:.3g} higher: "
            f"{outcome.message}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
