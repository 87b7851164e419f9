"""From how far away the reduced-space method converges: many starts on a small hanging cylinder.

Every parameter is guessed log-uniformly within a factor of the truth. Without noise a start
succeeds when all four parameters come out within 1 %; with noise, when they agree with the
optimum that the search finds from the truth. The cost is counted in sweeps: one factorisation
of every timestep's block, those of simulations and of the rest state included.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from synthetic import swing

from collocation_sysid.experiment import Experiment, Grasp, Markers
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.structured import cylinder_mesh
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.nlp.collocation import Collocation
from collocation_sysid.nlp.factorisation import Factoriser
from collocation_sysid.nlp.parameters import Parameter, Parameters
from collocation_sysid.nlp.simulation import simulate, with_markers

TRUTH = {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0}
BOUNDS = {
    "lambda_pa": (10.0, 1e5),
    "mu_pa": (10.0, 1e5),
    "gamma_r_s": (1e-5, 1.0),
    "gamma_m_1_s": (1e-3, 100.0),
}
RADIUS_M, HEIGHT_M, STEP_S, SIGMA_M = 0.04, 0.16, 0.01, 1e-3
TOLERANCE = 0.01


@dataclass(frozen=True)
class Outcome:
    """One start."""

    number: int
    status: str
    success: bool
    sweeps: float
    time_s: float
    rms_m: float
    worst_ratio: float
    guess: tuple[float, ...]
    found: tuple[float, ...]
    message: str


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--factor", type=float, default=10.0)
    parser.add_argument("--layers", type=int, default=11, help="7 (layers + 1) nodes")
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--scheme", default="midpoint")
    parser.add_argument("--noise-m", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, nargs="*", help="numbers of the starts to run")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    experiment = hanging_cylinder(
        arguments.layers, arguments.steps, arguments.scheme, arguments.noise_m
    )
    outcomes = study(
        experiment,
        arguments.scheme,
        guesses(arguments.starts, arguments.factor, arguments.seed),
        arguments.noise_m > 0,
        arguments.only,
    )
    if arguments.json:
        print(json.dumps([asdict(outcome) for outcome in outcomes], indent=1))
    else:
        print(summary(outcomes))


def hanging_cylinder(layers: int, steps: int, scheme: str, noise_m: float = 0.0) -> Experiment:
    """A cylinder held at one end, hanging and swung, with tracks of its own scheme."""
    body = Body(cylinder_mesh(RADIUS_M, HEIGHT_M, rings=1, layers=layers), density_kg_m3=20.0)
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
    experiment = Experiment(body, t_s, [grasp], markers, name="swing")
    tracks = simulate(experiment, TRUTH, scheme).markers_m
    noise = np.random.default_rng(1).normal(size=tracks.shape) * noise_m
    return with_markers(experiment, tracks + noise)


def guesses(count: int, factor: float, seed: int) -> NDArray[np.float64]:
    """(count, 4) log-uniform within a factor of the truth."""
    spread = np.random.default_rng(seed).uniform(-1, 1, (count, len(TRUTH)))
    return np.array(list(TRUTH.values())) * factor**spread


def study(
    experiment: Experiment,
    scheme: str,
    starts: NDArray[np.float64],
    noisy: bool,
    only: list[int] | None = None,
) -> list[Outcome]:
    """Solve from every start."""
    expected = np.array(list(TRUTH.values()))
    if noisy:
        optimum = ReducedSpace()(Collocation([experiment], parameters(expected), scheme))
        if not optimum.status.converged:
            raise SystemExit(f"from the truth: {optimum.message}")
        expected = optimum.theta
    outcomes = []
    for number, guess in enumerate(starts):
        if only and number not in only:
            continue
        collocation = Collocation([experiment], parameters(guess), scheme)
        with counted_factorisations() as count:
            solution = ReducedSpace()(collocation)
        ratios = np.abs(np.log(solution.theta / expected))
        close = 1e-4 if noisy else TOLERANCE
        outcomes.append(
            Outcome(
                number,
                solution.status.value,
                bool(solution.status.converged and ratios.max() < close),
                count[0] / len(experiment.t_s),
                solution.timing.total,
                solution.rms_m,
                float(np.exp(ratios.max())),
                tuple(guess.tolist()),
                tuple(solution.theta.tolist()),
                solution.message,
            )
        )
    return outcomes


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
    count, original = [0], Factoriser.factorise

    def counting(self: Factoriser, values: NDArray[np.float64]):
        count[0] += 1
        return original(self, values)

    Factoriser.factorise = counting
    try:
        yield count
    finally:
        Factoriser.factorise = original


def summary(outcomes: list[Outcome]) -> str:
    sweeps = [outcome.sweeps for outcome in outcomes if outcome.success]
    failures = [outcome for outcome in outcomes if not outcome.success]
    lines = [
        f"success: {len(sweeps)} of {len(outcomes)}",
        f"sweeps: median {np.median(sweeps):.1f}, max {np.max(sweeps):.1f}" if sweeps else "",
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
            f"rms {1e3 * outcome.rms_m:.3g} mm: {outcome.message}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
