"""Interior point by sweeps: the collocation program with limits of positions, compared with IPOPT.

    nice python scripts benchmark_inequalities [--repeats 3]

A bar of 20 nodes is swung. Its four lower nodes are measured with noise, and may not pass a plane
that the best fit without limits passes. Both methods solve the same program,
positions, parameters and all, with these limits from a simulation at the same guess.

The linear system of a primal-dual iteration is solved in the null space of the linearised equations
of motion: one forward sweep with p + 1 right-hand sides gives the feasibility step and the
sensitivities Z, one backward sweep the multipliers of the equations. What remains has p unknowns:
slacks s and multipliers ν of the limits A x ≤ b are eliminated, as the matrix is
H + (A Z)ᵀ diag(ν / s) (A Z) with the reduced Hessian H of the Lagrangian.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from script_arguments import make_parser

import collocation_sysid as cs
from collocation_sysid.methods.horizon import Horizon, Iterate
from collocation_sysid.methods.interior_point import InteriorPoint
from collocation_sysid.methods.starts.initial_trajectories import simulate_trajectories
from collocation_sysid.program.sweep import Sweep

TRUTH = {"young_pa": 2e4, "poisson": 0.4, "gamma_r_s": 0.01, "gamma_m_1_s": 0.1}
SIGMA_M = 5e-4
# Share of the largest deflection of the best fit at which the plane stands.
SHARE = 0.97
# Smallest barrier parameter, and largest error of the optimality conditions at the end.
BARRIER, TOLERANCE = 1e-12, 1e-9
# Share of the way to a limit that a step may go.
BOUNDARY = 0.995
MOST_ITERATIONS = 200


class LimitedCollocation(cs.Collocation):
    """Program of which some variables must not exceed a limit."""

    limited: ClassVar[np.ndarray] = np.zeros(0, dtype=np.int64)
    limit: ClassVar[float] = np.inf

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = super().bounds()
        upper[self.limited] = np.minimum(upper[self.limited], self.limit)
        return lower, upper


@dataclass
class Answer:
    z: np.ndarray
    iterations: int
    seconds: float


def swung_bar() -> tuple[cs.Problem, np.ndarray]:
    """Return the problem without limits, and the indices of its lower nodes."""
    body = cs.Body(cs.box_mesh((0.02, 0.02, 0.12), (1, 1, 4)), density_kg_m3=800.0)
    t_s = np.arange(25) * 0.02
    sway_m = 0.02 * (1 - np.cos(12 * t_s))
    hand = cs.PoseSequence(t_s, np.outer(sway_m, [1, 0.3, 0]), np.tile([0, 0, 0, 1.0], (25, 1)))
    z_m = body.nodes_m[:, 2]
    grasp = cs.Grasp(np.flatnonzero(z_m > z_m.max() - 1e-9), hand)
    lower = np.flatnonzero(z_m < z_m.min() + 1e-9)
    seen = cs.Markers(t_s, np.zeros((25, 4, 3)), SIGMA_M, places_m=body.nodes_m[lower])
    swing = cs.Experiment(
        body, t_s, [grasp], seen, nuisance=cs.Nuisance.none(), air_density_kg_m3="none"
    )
    noise_m = SIGMA_M * np.random.default_rng(0).normal(size=(25, 4, 3))
    swing = cs.with_markers(
        swing, cs.simulate(swing, TRUTH, "midpoint", substeps=1).markers_m + noise_m
    )
    unknown = {name: cs.Unknown(0.7 * TRUTH[name]) for name in ("young_pa", "gamma_r_s")}
    unknown["poisson"] = cs.Unknown(0.35)
    return cs.Problem([swing], TRUTH | unknown, substeps=1), lower


def limited_program(problem: cs.Problem, lower: np.ndarray) -> LimitedCollocation:
    """Return the program whose lower nodes stay behind the plane, a limit of the first coordinate
    at every time but the first.
    """
    free = problem.collocation()
    best = cs.solve(problem)
    dofs = 3 * lower
    marks = np.zeros_like(best.parts[0].x)
    marks[1:, dofs] = 1.0
    limited = np.flatnonzero(free.pack(np.zeros(free.nq), [marks]))
    start_m, ends_m = best.parts[0].x[0, dofs].max(), best.parts[0].x[:, dofs].max()
    plane_m = start_m + SHARE * (ends_m - start_m)
    LimitedCollocation.limited = limited
    LimitedCollocation.limit = plane_m / free.transcriptions[0].length_m
    values = {name: getattr(free, name) for name in free.__dataclass_fields__}
    return LimitedCollocation(**values)


def by_sweeps(program: LimitedCollocation) -> Answer:
    """Solve the program by a primal-dual interior point whose systems are solved by sweeps."""
    began_s = time.process_time()
    (transcription,) = program.transcriptions
    horizon = Horizon(program, [transcription.grid_times])
    p = program.guess_p
    (x,), failure = simulate_trajectories(program, p)
    assert failure is None
    scale, limited, limit = program.loss_scale, program.limited, program.limit
    s = np.maximum(limit - program.pack(p, [x])[limited], 1e-2)
    barrier = 0.1
    nu = barrier / s
    previous = np.inf
    for iteration in range(MOST_ITERATIONS):
        iterate = horizon.evaluate(p, [x])
        swept = iterate.trajectories[0]
        projected = x + swept.step
        z = program.pack(p, [projected])
        by_p = np.stack(
            [program.pack(np.zeros(program.nq), [swept.by_p[..., k]]) for k in range(program.nq)],
            axis=1,
        )
        G = by_p[limited]
        gap = z[limited] - limit
        gradient = 2 * scale * iterate.fit.score
        error = max(
            np.abs(gradient + G.T @ nu).max(),
            np.abs(gap + s).max(),
            iterate.feasibility_m / transcription.length_m,
        )
        if max(error, (s * nu).max()) <= TOLERANCE:
            return Answer(z, iteration, time.process_time() - began_s)
        while barrier > BARRIER and max(error, np.abs(s * nu - barrier).max()) <= 10 * barrier:
            barrier = max(BARRIER, min(0.2 * barrier, barrier**1.5))
        information = 2 * scale * iterate.fit.information
        hessian = information
        if previous < 0.1:
            hessian = reduced_hessian(program, iterate, projected, nu, by_p)
        weighted = G.T * (nu / s)
        matrix = hessian + weighted @ G
        if np.linalg.eigvalsh(matrix)[0] <= 0:
            matrix = information + weighted @ G
        right = gradient + G.T @ ((barrier + nu * (gap + s)) / s)
        dq = -np.linalg.solve(matrix, right)
        ds = -(gap + s) - G @ dq
        dnu = (barrier - nu * s - nu * ds) / s
        shorten = min(1.0, np.log(2.0) / np.abs(dq).max(), to_boundary(s, ds))
        p, s = p + shorten * dq, s + shorten * ds
        nu = nu + min(1.0, to_boundary(nu, dnu)) * dnu
        x = projected + swept.by_p @ (shorten * dq)
        previous = shorten * np.abs(dq).max()
    raise RuntimeError(f"no convergence within {MOST_ITERATIONS} iterations")


def to_boundary(values: np.ndarray, step: np.ndarray) -> float:
    """Return the share of a step after which positive values have kept a part of their size."""
    falling = step < 0
    return float((-BOUNDARY * values[falling] / step[falling]).min(initial=np.inf))


def reduced_hessian(
    program: LimitedCollocation, iterate: Iterate, x: np.ndarray, nu: np.ndarray, by_p: np.ndarray
) -> np.ndarray:
    """Return the Hessian of the Lagrangian along the equations of motion; the multipliers of these
    follow from one backward sweep, limits included.
    """
    (transcription,) = program.transcriptions
    z = program.pack(iterate.p, [x])
    (part,) = program.iterates(z)
    pull = np.zeros(program.variable_count)
    pull[program.limited] = nu
    (pull_m,) = program.unpack(pull)[1]
    # The limits are those of scaled variables.
    pull_m /= transcription.length_m**2
    gradient = program.loss_scale * part.gradient()[0] + pull_m
    y = transcription.force_n * Sweep(transcription).backward(
        part.x, part.equations, gradient=gradient
    )
    multipliers = transcription.select_rows(y)
    directions = by_p + np.vstack(
        [np.eye(program.nq), np.zeros((len(by_p) - program.nq, program.nq))]
    )
    hessian = directions.T @ (program.hessian(z, 1.0, multipliers=multipliers) @ directions)
    return (hessian + hessian.T) / 2


def by_ipopt(program: LimitedCollocation) -> Answer:
    """Solve the program by IPOPT, from a simulation at the guess."""
    options = {"bound_relax_factor": 0.0, "honor_original_bounds": "yes"}
    method = InteriorPoint(initial="simulation", tolerance=TOLERANCE, proximal=0.0, ipopt=options)
    began_s = time.process_time()
    solution = method(program)
    seconds = time.process_time() - began_s
    if not solution.status.converged:
        raise RuntimeError(f"IPOPT: {solution.message}")
    return Answer(solution.z, solution.iterations, seconds)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    repeats = parser.parse_args().repeats
    problem, lower = swung_bar()
    free = cs.solve(problem)
    program = limited_program(problem, lower)
    methods = {"sweeps": by_sweeps, "IPOPT": by_ipopt}
    answers = [{name: solve(program) for name, solve in methods.items()} for _ in range(repeats)]
    values = {name: program.parameter_values(each.z) for name, each in answers[-1].items()}
    ours, theirs = (answers[-1][name].z for name in methods)
    active = int((program.limit - ours[program.limited] < 1e-7).sum())
    print(f"{program.variable_count} variables, {len(program.limited)} limits, {active} active")
    print("without limits:", {name: f"{v:.6g}" for name, v in free.parameters.items()})
    for name, each in values.items():
        print(
            f"{name}: {answers[-1][name].iterations} iterations,",
            {k: f"{v:.8g}" for k, v in each.items()},
        )
    print(f"largest difference of a scaled variable {np.abs(ours - theirs).max():.2g}")
    ratios = [
        (each["IPOPT"].seconds / each["IPOPT"].iterations)
        / (each["sweeps"].seconds / each["sweeps"].iterations)
        for each in answers
    ]
    totals = [each["IPOPT"].seconds / each["sweeps"].seconds for each in answers]
    print(
        f"time of an iteration, IPOPT over sweeps: {np.median(ratios):.2f}; "
        f"of the solve: {np.median(totals):.2f}"
    )


if __name__ == "__main__":
    main()
