"""Solution of a plan in the reduced space of the hand's unknowns, by Gauss–Newton steps.

At each iteration one forward sweep gives the derivatives Z of the motion by the unknowns c. With the
residuals S x − b of the body and the affine residual of the jerk, the step minimises the
linearised sum of squares with Levenberg's damping, subject to the limits of the hand. Limits of
translations are convex and enter as they are (second-order cones), those of rotations linearised.
Every iterate respects all limits of the hand. Limits of the body are linearised where they are
near; iterates respect them once they do so. A step counts only if the simulated motion is better.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.linalg import solve_triangular

from ...common.array_types import Array
from ...errors import SimulationError
from .body_limits import NEAR
from .hand_limits import WITHIN
from .path_terms import AugmentedCosts
from .planned_program import LinearisedLimits, PlannedProgram

# Tolerance of the conic program of a step, relative.
SOLVER_TOLERANCE = 1e-12
# Largest number of linearisations of the limits in the search for the smoothest motion.
MOST_LINEARISATIONS = 10
# Motions from which the search for information begins.
RANDOM_MOTIONS = 8
# Largest share of a limit that an iterate may use: limits are tightened by `WITHIN`, so that it
# respects the limits themselves.
LARGEST_SHARE = 1 + 0.5 * (1 / WITHIN - 1)
# Augmented Lagrangian of limits that are functions of the motion: first weight over the objective,
# its growth if an iteration leaves more than this share of the excess, and most iterations.
FIRST_WEIGHT, WEIGHT_GROWTH, SLOW_EXCESS, MOST_MULTIPLIERS = 0.01, 10.0, 0.25, 30
# Called with the iteration and the objective.
Watch = Callable[[int, float], None]


@dataclass(frozen=True)
class ReducedTolerances:
    """Tolerances of the search."""

    # Largest change of an unknown (in units of the workspace) at convergence. Two solvers agree to
    # 1e-6 if both steps end far below it.
    step: float = 1e-9
    # Largest predicted decrease of the objective, relative to it, at convergence.
    decrease: float = 1e-11
    # Share of the objective by which three iterations together must improve it; 0 searches until
    # convergence. Motions that differ by redundant coordinates of the hand are nearly as good as
    # one another, and the search among them is slow.
    progress: float = 1e-2
    iterations: int = 60  # largest number of iterations
    failures: int = 12  # largest number of steps in a row that are not better
    path: float = 1e-3  # largest excess of a limit of the path, relative to its scale


# A search for information ends when three iterations make the intervals narrower by less than 5 %.
INFORMATIVE = ReducedTolerances(progress=0.1)


@dataclass(eq=False)
class PlanAnswer:
    """Result of the search."""

    c: Array  # (c,): unknowns
    x: Array  # (N, 3n): motion [m]
    multipliers: Array  # (k,): multipliers of the limits
    # How the search ended; "flat": three iterations did not improve the plan by
    # `ReducedTolerances.progress`; "reached": all intervals are as narrow as wanted.
    status: str
    history: list[float] = field(default_factory=list)  # objective at each iterate


class HandLimitsExcludeTask(Exception):
    """No motion of the hand satisfies its limits and its given end."""


def triangular(matrix: Array, residual: Array) -> tuple[Array, Array]:
    """Return the triangle R (c, c) and the vector q (c,) with ‖matrix d + residual‖² = ‖R d + q‖² +
    constant, for a matrix (m, c) of full rank with m > c.

    Normal equations would square the condition number, and lose the effort of the hand beside
    residuals with small deviations.
    """
    count = matrix.shape[1]
    factor = np.asarray(np.linalg.qr(np.column_stack([matrix, residual]), mode="r"))
    return factor[:count, :count], factor[:count, count]


def minimise_within_limits(
    root: Array, offset: Array, limits: LinearisedLimits
) -> tuple[Array, Array]:
    """Return the step d (c,) that minimises ½ ‖R d + q‖² within linearised limits, and the
    multipliers of these: of each vector's norm, then of each row.

    Limits of norms are second-order cones; Clarabel solves the conic program.

    Parameters
    ----------
    root : (c, c) array
        Triangle R.
    offset : (c,) array
        Vector q.

    Raises
    ------
    HandLimitsExcludeTask
        If no step satisfies the limits.
    LinAlgError
        If the conic program is not solved.
    """
    count = len(offset)
    vectors = len(limits.vectors)
    free = -solve_triangular(root, offset)
    norms = np.linalg.norm(limits.vectors + limits.vector_slopes @ free, axis=1)
    most = max(norms.max(initial=0.0), 1 + (limits.rows + limits.row_slopes @ free).max(initial=-1))
    if most <= 1.0:
        return free, np.zeros(vectors + len(limits.rows))
    size = float(np.linalg.norm(offset))
    slopes = np.zeros((vectors, 4, count))
    slopes[:, 1:] = -limits.vector_slopes
    values = np.ones((vectors, 4))
    # About the free minimum.
    values[:, 1:] = limits.vectors + limits.vector_slopes @ free
    rows = sp.csc_array(np.concatenate([limits.row_slopes, slopes.reshape(-1, count)]))
    # The unknowns d and u = R d, in units of the present residual: R itself, not RᵀR.
    matrix = sp.block_array([[sp.csc_array(root) / size, -sp.eye_array(count)], [rows, None]])
    bounds = np.concatenate(
        [np.zeros(count), -(limits.rows + limits.row_slopes @ free), values.ravel()]
    )
    objective = sp.diags_array(np.repeat([0.0, 1.0], count), format="csc")
    clarabel: Any = import_module("clarabel")  # a compiled module without types
    cones = [clarabel.ZeroConeT(count), clarabel.NonnegativeConeT(len(limits.rows))]
    cones += [clarabel.SecondOrderConeT(4)] * vectors
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = SOLVER_TOLERANCE
    solver = clarabel.DefaultSolver(
        sp.csc_matrix(objective),
        np.zeros(2 * count),
        sp.csc_matrix(matrix),
        bounds,
        cones,
        settings,
    )
    answer = solver.solve()
    status = str(answer.status)
    if "Infeasible" in status:
        raise HandLimitsExcludeTask
    if status not in ("Solved", "AlmostSolved", "InsufficientProgress"):
        raise np.linalg.LinAlgError(
            f"no motion within the limits of the hand was found: Clarabel ended with {status}"
        )
    duals = size**2 * np.array(answer.z)[count:]
    of_rows = duals[: len(limits.rows)]
    of_norms = duals[len(limits.rows) :].reshape(vectors, 4)[:, 0]
    return free + np.array(answer.x)[:count], np.concatenate([of_norms, of_rows])


def smoothest_motion(program: PlannedProgram, wanted: Array | None = None) -> Array:
    """Return the unknowns of the motion with the least jerk within the limits: no motion, unless
    the end of the hand is given. With `wanted` unknowns (c,), those within the limits nearest to
    these.

    Raises
    ------
    HandLimitsExcludeTask
        If no motion satisfies the limits.
    """
    matrix, constant = program.effort if wanted is None else (np.eye(len(wanted)), -wanted)
    scale = 1.0 / max(float(np.abs(matrix).max()), 1e-300)
    matrix, constant = scale * matrix, scale * constant
    c = np.zeros(matrix.shape[1])
    for _ in range(MOST_LINEARISATIONS):
        root, offset = triangular(matrix, matrix @ c + constant)
        step, _ = minimise_within_limits(root, offset, program.hand_limits.linearise(c))
        c = c + step
        if np.abs(step).max() < 1e-8:
            break
    return c


def informative_motion(program: PlannedProgram) -> Array:
    """Return the unknowns of the most informative one of random motions within the limits.

    Raises
    ------
    HandLimitsExcludeTask
        If no motion satisfies the limits.
    SimulationError
        If none can be simulated.
    """
    rng = np.random.default_rng(0)
    best, least = smoothest_motion(program), np.inf
    for _ in range(RANDOM_MOTIONS):
        c = smoothest_motion(program, rng.normal(size=program.space.size))
        if program.hand_limits.shares(c).max() > LARGEST_SHARE:
            continue
        with suppress(SimulationError):
            x = program.simulate(c)
            if _violation(program, [x]) <= LARGEST_SHARE - 1:
                value = program.objective(c, x)
                if value < least:
                    best, least = c, value
    return best


def solve_reduced(
    program: PlannedProgram,
    start: Array | None = None,
    scenarios: Sequence[PlannedProgram] = (),
    tolerances: ReducedTolerances | None = None,
    watch: Watch | None = None,
) -> PlanAnswer:
    """Solve a plan; Ctrl-C ends the search with the best plan so far.

    Parameters
    ----------
    program : PlannedProgram
        The problem.
    start : (c,) array, optional
        Initial unknowns within the limits; those of the smoothest motion by default.
    scenarios : sequence of PlannedProgram
        Programs with other parameters: the objective is the mean of theirs.
    tolerances : ReducedTolerances, optional
        Tolerances of the search.
    watch : callable, optional
        Called with the number of each iterate and its objective.

    Raises
    ------
    HandLimitsExcludeTask
        If no motion satisfies the limits.
    SimulationError
        If the first motion cannot be simulated.
    """
    usual = ReducedTolerances() if program.criterion is None else INFORMATIVE
    limits = tolerances or usual
    c = smoothest_motion(program) if start is None else start
    programs = scenarios or (program,)
    if program.path_limits is None:
        return _search(program, c, programs, limits, watch)
    return _within_path_limits(program, c, programs, limits, watch)


def _within_path_limits(
    program: PlannedProgram,
    c: Array,
    programs: Sequence[PlannedProgram],
    limits: ReducedTolerances,
    watch: Watch | None,
) -> PlanAnswer:
    """Return the plan within limits that are functions of the motion, by an augmented Lagrangian."""
    path = program.path_limits
    assert path is not None
    motions = [each.simulate(c) for each in programs]
    multipliers = [np.zeros_like(path.evaluate(x)) for x in motions]
    # The first search shall leave the start: limits of squares have no slope at rest.
    weight = FIRST_WEIGHT * _mean_objective(programs, c, motions) or 1.0
    history: list[float] = []
    excess, before = np.inf, np.inf
    numbers = itertools.count()

    def count(_: int, value: float) -> None:
        if watch is not None:
            watch(next(numbers), value)

    while True:
        terms = [
            AugmentedCosts(p.path_costs, path, m, weight)
            for p, m in zip(programs, multipliers, strict=True)
        ]
        augmented = [p.with_path_costs(t) for p, t in zip(programs, terms, strict=True)]
        answer = _search(program, c, augmented, limits, count)
        motions = [each.simulate(answer.c) for each in programs]
        history.append(_mean_objective(programs, answer.c, motions))
        answer.history = history
        updated = [each.updated(x) for each, x in zip(terms, motions, strict=True)]
        changes = np.abs(np.array(updated) - np.array(multipliers))
        before, excess = excess, float(changes.max()) / weight
        if excess <= limits.path or answer.status == "interrupted":
            return answer
        if len(history) == MOST_MULTIPLIERS:
            answer.status = "iteration limit"
            return answer
        c, multipliers = answer.c, updated
        if excess > SLOW_EXCESS * before:
            weight *= WEIGHT_GROWTH


def _search(
    program: PlannedProgram,
    c: Array,
    programs: Sequence[PlannedProgram],
    limits: ReducedTolerances,
    watch: Watch | None,
) -> PlanAnswer:
    """Return the plan without limits that are functions of the motion."""
    drive = program.drive(c)
    motions = [each.simulate(c, drive=drive) for each in programs]
    value = _mean_objective(programs, c, motions)
    violation = _violation(program, motions)
    multipliers = np.zeros(len(program.hand_limits.names))
    answer = PlanAnswer(c, motions[0], multipliers, "iteration limit", [value])
    damping, failures = 0.0, 0
    try:
        while len(answer.history) <= limits.iterations:
            if watch is not None:
                watch(len(answer.history) - 1, value)
            if program.criterion is not None and program.criterion.suffices(c, motions[0]):
                answer.status = "reached"
                break
            slopes = [p.driven.respond(drive, x) for p, x in zip(programs, motions, strict=True)]
            undamped, present = _linearised(programs, c, motions, slopes)
            near = program.hand_limits.linearise(c)
            while True:
                root, offset = _damped(undamped, present, damping)
                step, trial_multipliers = _step(program, root, offset, near, motions, slopes)
                trial = c + step
                predicted = _predicted_decrease(undamped, present, step)
                size = float(np.abs(step).max())
                allowed = violation <= LARGEST_SHARE - 1
                is_flat = allowed and predicted <= limits.decrease * (value + 1e-300)
                if size <= limits.step or is_flat:
                    answer.multipliers = trial_multipliers
                    answer.status = "converged" if damping < 1e-3 and allowed else "stalled"
                    if damping < 1e-3:
                        return answer
                moved, decrease, excess = motions, -np.inf, violation
                if program.hand_limits.shares(trial).max() <= LARGEST_SHARE:
                    with suppress(SimulationError):
                        drive = program.drive(trial)
                        moved = [
                            p.simulate(trial, near=x + by_c @ step, drive=drive)
                            for p, x, by_c in zip(programs, motions, slopes, strict=True)
                        ]
                        excess = _violation(program, moved)
                        if excess <= max(violation, LARGEST_SHARE - 1):
                            decrease = value - _mean_objective(programs, trial, moved)
                # While a limit of the body is exceeded, the violation decreases instead.
                if decrease > (1e-4 * predicted if allowed else -np.inf):
                    break
                failures += 1
                if failures > limits.failures or answer.status == "stalled":
                    answer.status = "stalled"
                    return answer
                damping = max(4 * damping, 1e-3)
            damping = damping / 5 if decrease > 0.5 * predicted else damping
            damping = 0.0 if damping < 1e-6 else damping
            failures = 0
            c, motions, value, violation = trial, moved, value - decrease, excess
            answer.c, answer.x, answer.multipliers = c, motions[0], trial_multipliers
            answer.history.append(value)
            past = answer.history[-4:]
            if allowed and len(past) == 4 and past[0] - value < limits.progress * past[0]:
                answer.status = "flat"
                break
    except np.linalg.LinAlgError:  # the best plan remains
        answer.status = "stalled"
    except HandLimitsExcludeTask:
        if program.body_limits is None:
            raise
        answer.status = "stalled"
    except KeyboardInterrupt:
        answer.status = "interrupted"
    return answer


def _linearised(
    programs: Sequence[PlannedProgram], c: Array, motions: list[Array], slopes: list[Array]
) -> tuple[Array, Array]:
    """Return the least-squares problem of a step, without limits, as in `triangular`."""
    by_jerk, jerk = programs[0].effort
    share = 1 / np.sqrt(len(motions))
    pairs = [p.linearise(c, x, s) for p, x, s in zip(programs, motions, slopes, strict=True)]
    rows = np.vstack([*(share * by_c for by_c, _ in pairs), by_jerk])
    residual = np.concatenate([*(share * values for _, values in pairs), by_jerk @ c + jerk])
    return triangular(rows, residual)


def _damped(undamped: Array, present: Array, damping: float) -> tuple[Array, Array]:
    """Return a least-squares problem with rows that keep the unknowns small."""
    if not damping:
        return undamped, present
    lengths = np.sqrt(damping) * np.linalg.norm(undamped, axis=0)
    return triangular(
        np.vstack([undamped, np.diag(lengths)]),
        np.concatenate([present, np.zeros(undamped.shape[1])]),
    )


def _predicted_decrease(undamped: Array, present: Array, step: Array) -> float:
    change = undamped @ step
    return -float(change @ (2 * present + change))


def _step(
    program: PlannedProgram,
    root: Array,
    offset: Array,
    near: LinearisedLimits,
    motions: list[Array],
    slopes: list[Array],
) -> tuple[Array, Array]:
    """Return the step within the limits `near` of the hand and those of the body, and the
    multipliers, see `minimise_within_limits`; the last are of those limits of the body that entered.
    """
    body = program.body_limits
    if body is None:
        return minimise_within_limits(root, offset, near)
    enters = [body.values(x[body.sample_rows]) > NEAR for x in motions]
    for _ in range(MOST_LINEARISATIONS):
        pairs = [body.linearise(*each) for each in zip(motions, slopes, enters, strict=True)]
        values, by_c = (np.concatenate(each) for each in zip(*pairs, strict=True))
        # Of what is exceeded, half is asked for, so that there is a step within the other limits.
        values = np.where(values > LARGEST_SHARE - 1, values / 2, values)
        step, multipliers = minimise_within_limits(
            root,
            offset,
            near._replace(
                rows=np.concatenate([near.rows, values]),
                row_slopes=np.concatenate([near.row_slopes, by_c]),
            ),
        )
        expected = [(x + z @ step)[body.sample_rows] for x, z in zip(motions, slopes, strict=True)]
        exceeded = [
            ~known & (body.values(x) > 0) for known, x in zip(enters, expected, strict=True)
        ]
        if not any(each.any() for each in exceeded):
            break
        enters = [known | more for known, more in zip(enters, exceeded, strict=True)]
    return step, multipliers


def _violation(program: PlannedProgram, motions: list[Array]) -> float:
    """Return the largest value of a limit of the body, negative if all are respected."""
    body = program.body_limits
    if body is None:
        return -np.inf
    return max(float(body.values(x[body.sample_rows]).max()) for x in motions)


def _mean_objective(programs: Sequence[PlannedProgram], c: Array, motions: list[Array]) -> float:
    values = [each.objective(c, x) for each, x in zip(programs, motions, strict=True)]
    return sum(values) / len(values)
