"""Reduced space: given θ the trajectory is determined, so only θ is searched for.

Each iteration is a Gauss–Newton step on the same NLP as interior point's, with the same optimum.
One factorisation a timestep gives the feasibility step p and the sensitivities Z (`nlp.tangent`);
the step of all variables is (p + Z dq, dq), and dq solves a bounded least-squares problem in the
few parameters,

    min ‖r + S_p + S dq‖² + priors,   |dq| ≤ trust region,

with r the markers' residuals and S_p, S the markers' parts of p and Z.

A trial is accepted when the loss of its own projected trajectory (r + S_p there) has decreased,
and when its remaining infeasibility, measured by the length of p in metres, is short against
the step. That converges from where trajectories can be simulated; a ladder of horizons, the
first quarter, half and whole of the recording, widens it to where only the start can be.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from ..errors import SimulationError
from ..nlp.collocation import Collocation
from ..nlp.marching import march_on
from ..nlp.segment import Segment
from ..nlp.tangent import BlockSolver, Tangent
from ..results.solution import Iteration, Solution, Status, Timing

Array = NDArray[np.float64]
Watch = Callable[[Iteration], None]


@dataclass(frozen=True)
class ReducedSpaceOptions:
    """Options of the reduced-space method.

    Attributes
    ----------
    tolerance : float
        Largest last step of a parameter's logarithm.
    max_iterations : int
        Sweeps over all rungs of the ladder; a rejected trial counts.
    trust : float
        First trust region: longest step of a parameter's logarithm.
    ladder : tuple of float
        Shares of the recording solved one after another, ending with 1.
    rung_decrease : float
        All rungs but the last end when a step promises to lower the loss by less than this share.
    rung_prior : float
        On them a prior of this standard deviation of the logarithm holds each parameter near its
        guess: a short horizon says nothing about some, and would let them run to their bounds.
    """

    tolerance: float = 1e-8
    max_iterations: int = 200
    trust: float = 1.0
    ladder: tuple[float, ...] = (0.25, 0.5, 1.0)
    rung_decrease: float = 0.05
    rung_prior: float = 2.3


# Fewest grid rows of a rung.
MIN_ROWS = 8
# A trial's infeasibility may be this share of its step's length.
CONTRACTION = 0.5
# Share of the predicted decrease a trial must reach.
DECREASE = 1e-3
# Shorter than this over the body's size, feasibility is at rounding.
FEASIBLE = 1e-12
SMALLEST_TRUST = 1e-10


@dataclass(frozen=True, eq=False)
class _Point:
    """Parameters and trajectories of a rung, with what one sweep found there.

    Attributes
    ----------
    q : (nq,)
    x : list of (rows, 3n), one per experiment
    tangents : list of Tangent
    residual : (M,) r + S_p and prior residuals
    slope : (M, nq) S and prior slopes
    feasibility_m : float, longest coordinate of p
    """

    q: Array
    x: list[Array]
    tangents: list[Tangent]
    residual: Array
    slope: Array
    feasibility_m: float

    @property
    def loss(self) -> float:
        """Loss of the projected trajectory, priors included."""
        return float(self.residual @ self.residual)


class _Rung:
    """The NLP on the first rows of every experiment."""

    def __init__(self, collocation: Collocation, share: float, prior: float | None = None) -> None:
        self.collocation = collocation
        self.segments = collocation.segments
        self.prior = prior
        self.solvers = []
        for segment in self.segments:
            rows = min(segment.grid_rows, max(MIN_ROWS, round(share * segment.grid_rows)))
            self.solvers.append(BlockSolver(segment, rows))

    @property
    def rows(self) -> list[int]:
        return [solver.dynamics.rows for solver in self.solvers]

    def evaluate(self, q: Array, x: list[Array]) -> _Point:
        """One sweep.

        Raises
        ------
        SimulationError
            Where it is singular or not finite.
        """
        parameters = self.collocation.parameters
        theta = parameters.theta(q)
        theta_q, _ = parameters.theta_derivatives(q)
        tangents, residuals, slopes = [], [], []
        for segment, solver, x_k in zip(self.segments, self.solvers, x, strict=True):
            tangent = solver.forward(x_k, theta, theta_q)
            residual, slope = segment.observation.linearised(x_k, tangent.step, tangent.by_q)
            tangents.append(tangent)
            residuals.append(residual)
            slopes.append(slope)
        prior, prior_slopes = parameters.prior(q)
        if self.prior is not None:
            residuals.append((q - parameters.guess_q) / self.prior)
            slopes.append(np.eye(len(q)) / self.prior)
        return _Point(
            q,
            x,
            tangents,
            np.concatenate([*residuals, prior]),
            np.concatenate([*slopes, np.diag(prior_slopes)]),
            max(float(np.abs(tangent.step).max()) for tangent in tangents),
        )

    def extend(self, q: Array, x: list[Array] | None) -> list[Array]:
        """Trajectories of this rung's length at q, continuing those of the last rung.

        Raises
        ------
        SimulationError
            At the first step that cannot be made.
        """
        theta = self.collocation.parameters.theta(q)
        extended = []
        for k, (segment, solver) in enumerate(zip(self.segments, self.solvers, strict=True)):
            known = None if x is None else x[k]
            rows, failure = march_on(segment.experiment, solver.dynamics, theta, known)
            if failure is not None:
                raise failure
            extended.append(rows)
        return extended


class _Search:
    """The state of a solve: budget, history, and the trust region."""

    def __init__(
        self, collocation: Collocation, options: ReducedSpaceOptions, watch: Watch | None
    ) -> None:
        self.collocation = collocation
        self.options = options
        self.watch = watch
        self.began = time.perf_counter()
        self.sweeps = 0
        self.trust = options.trust
        self.history: list[Iteration] = []
        self.lower, self.upper = collocation.parameters.bounds_q

    def descend(self, rung: _Rung, point: _Point, last: bool) -> tuple[_Point, Status]:
        """Gauss–Newton steps on one rung until they promise no more."""
        tolerance = self.options.tolerance
        size_m = float(np.ptp(point.x[0].reshape(-1, 3), axis=0).max())
        self._record(point)
        while True:
            step = self._step(point)
            length = float(np.abs(step).max(initial=0.0))
            feasible = point.feasibility_m <= max(FEASIBLE, 1e-3 * tolerance) * size_m
            if length <= tolerance and feasible:
                return point, Status.CONVERGED
            promised = 1.0 - self._predicted_loss(point, step) / max(point.loss, 1e-300)
            if not last and promised < self.options.rung_decrease:
                return point, Status.CONVERGED
            if self.sweeps >= self.options.max_iterations:
                return point, Status.ITERATION_LIMIT
            trial = self._try(rung, point, step)
            if trial is not None and self._accept(point, step, trial, size_m):
                point = trial
                self._record(point)
                continue
            if length <= SMALLEST_TRUST:
                return point, Status.STALLED
            self.trust = 0.25 * length

    def _step(self, point: _Point) -> Array:
        if len(point.q) == 0:
            return np.zeros(0)
        low = np.maximum(self.lower - point.q, -self.trust)
        high = np.minimum(self.upper - point.q, self.trust)
        # Rounding may leave q on its bound by a hair.
        low, high = np.minimum(low, 0.0) - 1e-15, np.maximum(high, 0.0) + 1e-15
        _, triangle = np.linalg.qr(np.column_stack([point.slope, point.residual]))
        answer = lsq_linear(triangle[:, :-1], -triangle[:, -1], (low, high), method="bvls")
        return np.clip(answer.x, low, high)

    def _try(self, rung: _Rung, point: _Point, step: Array) -> _Point | None:
        moved = [
            x + tangent.step + tangent.by_q @ step
            for x, tangent in zip(point.x, point.tangents, strict=True)
        ]
        self.sweeps += 1
        try:
            trial = rung.evaluate(point.q + step, moved)
        except SimulationError:
            return None
        return trial if np.isfinite(trial.loss) and np.isfinite(trial.feasibility_m) else None

    def _accept(self, point: _Point, step: Array, trial: _Point, size_m: float) -> bool:
        """Judge a trial, and widen or narrow the trust region after it."""
        predicted = point.loss - self._predicted_loss(point, step)
        actual = point.loss - trial.loss
        moved_m = max(
            float(np.abs(after - before).max())
            for before, after in zip(point.x, trial.x, strict=True)
        )
        if trial.feasibility_m > max(CONTRACTION * moved_m, FEASIBLE * size_m):
            return False
        noise = 1e-12 * point.loss + 1e-20
        if actual < DECREASE * predicted - noise:
            return False
        length = float(np.abs(step).max(initial=0.0))
        if actual > 0.75 * predicted and length > 0.9 * self.trust:
            self.trust = min(2.0 * self.trust, 4.0)
        elif actual < 0.25 * predicted:
            self.trust = max(0.5 * length, SMALLEST_TRUST)
        return True

    @staticmethod
    def _predicted_loss(point: _Point, step: Array) -> float:
        linear = point.residual + point.slope @ step
        return float(linear @ linear)

    def _record(self, point: _Point) -> None:
        squares = np.concatenate(
            [
                segment.observation.squared_distances_m2(x + tangent.step)
                for segment, x, tangent in zip(
                    self.collocation.segments, point.x, point.tangents, strict=True
                )
            ]
        )
        line = Iteration(
            number=self.sweeps,
            loss=point.loss,
            rms_m=float(np.sqrt(squares.mean())) if len(squares) else 0.0,
            violation_n=max(tangent.violation_n for tangent in point.tangents),
            theta=self.collocation.parameters.theta(point.q),
            time_s=time.perf_counter() - self.began,
        )
        self.history.append(line)
        if self.watch is not None:
            self.watch(line)


def solve(
    collocation: Collocation,
    options: ReducedSpaceOptions | None = None,
    watch: Watch | None = None,
) -> Solution:
    """Solve the NLP in the reduced space.

    Parameters
    ----------
    collocation : Collocation
    options : ReducedSpaceOptions, optional
    watch : callable, optional
        Called with every accepted `Iteration`; its number counts sweeps.

    Returns
    -------
    Solution
        With the multipliers of the whole NLP. Also when it did not converge or was interrupted.
    """
    options = options or ReducedSpaceOptions()
    search = _Search(collocation, options, watch)
    q, x, notes = collocation.parameters.guess_q, None, []
    status, why = Status.CONVERGED, ""
    try:
        for share in options.ladder:
            last = share == options.ladder[-1]
            rung = _Rung(collocation, share, None if last else options.rung_prior)
            x = rung.extend(q, x)
            search.sweeps += 1
            point, status = search.descend(rung, rung.evaluate(q, x), last)
            q, x = point.q, point.x
            if status is Status.ITERATION_LIMIT:
                break
            search.trust = options.trust
    except SimulationError as error:
        status, why = Status.NOT_SIMULABLE, f" {error}."
    except KeyboardInterrupt:
        status = Status.INTERRUPTED
    return _solution(collocation, search, status, why, q, x, notes)


def _solution(
    collocation: Collocation,
    search: _Search,
    status: Status,
    why: str,
    q: Array,
    x: list[Array] | None,
    notes: list[str],
) -> Solution:
    whole = [
        _filled(segment, x[k] if x else None) for k, segment in enumerate(collocation.segments)
    ]
    z = collocation.pack(q, whole)
    multipliers = np.zeros(collocation.constraints)
    if status.converged:
        multipliers = constraint_multipliers(collocation, z)
    total = time.perf_counter() - search.began
    return Solution(
        status=status,
        message=f"{status.sentence}{why}",
        method="reduced-space",
        collocation=collocation,
        z=z,
        multipliers=multipliers,
        iterations=search.sweeps,
        history=tuple(search.history),
        timing=Timing(total=total),
        notes=tuple(notes),
    )


def _filled(segment: Segment, x: Array | None) -> Array:
    """All rows of a trajectory; those not reached are carried rigidly by the grasp."""
    rigid = segment.experiment.rigid_positions(segment.dynamics.t_s).reshape(segment.grid_rows, -1)
    if x is not None:
        rigid[: len(x)] = x
    return rigid


def constraint_multipliers(collocation: Collocation, z: Array) -> Array:
    """Multipliers (constraints,) that make the Lagrangian stationary in the positions.

    From c_xᵀ y = −∂L/∂x, one backward sweep in time, in the scaling of the NLP.
    """
    q, positions = collocation.unpack(z)
    theta = collocation.parameters.theta(q)
    parts = []
    for segment, x in zip(collocation.segments, positions, strict=True):
        gradient = collocation.loss_scale * segment.observation.gradient(x)
        y = BlockSolver(segment).backward(x, theta, gradient) * segment.force_n
        parts.append(y[segment.dynamics.first_row :, segment.row_dofs].ravel())
    multipliers = np.concatenate(parts)
    if collocation.segments[0].explicit_grasps:
        # The grasp rows are unit rows: they take what is left.
        slope = collocation.gradient(z) + collocation.jacobian(z).T @ multipliers
        _, left = collocation.unpack(slope)
        start = 0
        for segment, rest in zip(collocation.segments, left, strict=True):
            rows = multipliers[start : start + segment.constraints].reshape(
                segment.constraint_times, -1
            )
            held = rest[segment.dynamics.first_row :, segment.held_dofs] / segment.length_m
            rows[:, segment.held_dofs] = -held
            start += segment.constraints
    return multipliers
