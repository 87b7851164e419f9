"""The search of the reduced-space method: trust region, acceptance, and the ladder of horizons."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ..arrays import Array
from ..checked import Count, Options, Positive
from ..errors import SimulationError
from ..program.factorisation import Choice
from .curvature import exact_curvature, updated, with_curvature
from .horizon import Horizon, Iterate
from .options import FEWEST, SHARES, Shares, part_of
from .recorder import Recorder
from .solution import Iteration, Status
from .trajectory import Seen

if TYPE_CHECKING:
    from ..program.collocation import Collocation
    from .workers import Workers

# A trial's infeasibility may be this share of its step's length, or this share of an edge of
# the mesh: the strain it causes is then small enough for Newton's next step to remove it.
CONTRACTION, SMALL_STRAIN = 0.5, 0.1
# Share of the predicted decrease a trial must reach.
DECREASE = 1e-3
# Shorter than this over the body's size, feasibility is at rounding; shorter than the second,
# it is where steps no longer change the parameters and it does not decrease any more.
FEASIBLE, NEARLY_FEASIBLE = 1e-12, 1e-8
# Longer than this over the body's size, it is refined before steps are judged too harshly.
INFEASIBLE = 1e-6
# A rejected step is tried again at this share of its length, down to the shortest.
SHRINK, SMALLEST_TRUST = 0.25, 1e-10
# The last step is taken without another sweep when its error, judged by the rate at which steps
# shrink, is this share of the tolerance, and no equation is violated by more than this in the
# scaling of the NLP.
SAFETY, FEASIBLE_FORCE = 0.3, 1e-10
# The trust region is never wider, nor where there are depth cameras.
WIDEST, SEEING = 4.0, 0.25
# With these, shorter steps that make nothing better are the last.
SEEN = 1e-3
# A step may lose so few of the points that were seen, and points may be so much farther off by what
# looking anew changes.
STILL_SEEN, AS_NEAR = 0.97, 1.01
# Steps shorter than this tell about the curvature at the answer.
LOCAL = 0.1
# Estimates of places may change the elements they are read in so often.
REREADINGS = 40


@dataclass(frozen=True)
class SearchOptions(Options):
    """How parameters are searched for.

    Attributes
    ----------
    tolerance : float
        Largest last step of a parameter's logarithm.
    max_iterations : int
        Sweeps over all rungs of the ladder; a rejected trial counts.
    trust : float
        First trust region: longest step of a parameter's logarithm.
    ladder : tuple of float
        Shares of the recording solved one after another, ending with 1; a start needs none.
    rung_decrease : float
        All rungs but the last end when a step promises to lower the loss by less than this share.
    rung_prior : float
        On them a prior of this standard deviation of the logarithm holds each parameter near its
        guess: a short horizon says nothing about some, and would let them run to their bounds.
    hessian : {"gauss-newton", "exact"}
        Once a step moves no parameter by more than 10 %, what Gauss–Newton leaves out is learned
        from the steps, or computed exactly from the Lagrangian: a second sweep an iteration, for
        large residuals. Before, both are Gauss–Newton.
    factorisation : {"auto", "band", "sparse", "supernodal"}
        Banded Cholesky, SuperLU, supernodal Cholesky (extra `large`), or whichever is estimated
        to cost least.
    """

    tolerance: Positive = 1e-8
    max_iterations: Count = 200
    trust: Positive = 1.0
    ladder: Shares = SHARES
    rung_decrease: Positive = 0.05
    rung_prior: Positive = 2.3
    hessian: Literal["gauss-newton", "exact"] = "gauss-newton"
    factorisation: Choice = "auto"


class ReducedSearch:
    """The state of a solve: the best point, the trust region, and the budget."""

    def __init__(
        self,
        options: SearchOptions,
        recorder: Recorder,
        start: Array | None,
        workers: Workers | None = None,
    ) -> None:
        self.options, self.recorder = options, recorder
        self.collocation = collocation = recorder.collocation
        self.sweeps = 0
        # Points that depth cameras see belong to what is near: they tell of no long step.
        self.seeing = any(segment.depths for segment in collocation.segments)
        self.widest = SEEING if self.seeing else WIDEST
        self.trust = min(options.trust, self.widest)
        self.indefinite = 0
        self.lower, self.upper = collocation.bounds_p
        self.rereadings, self.most_seen, self.placed = 0, 0, True
        self.reach = collocation.reach_p
        self.p: Array = collocation.guess_p
        # Kept by the workers, see `trajectory.positions`.
        self.x: list[Any] | None = None
        self.workers = workers
        if start is not None:
            start = np.clip(start, *collocation.bounds())
            self.p = collocation.parameters_of(start)
            self.x = [part.segment.grasped(part.x, part.phi) for part in collocation.parts(start)]
        self.point: Iterate | None = None
        # The last trial, where cameras have looked anew.
        self.looked: Any = None, None, None
        nodes = [segment.body.nodes_m for segment in collocation.segments]
        self.edge_m = min(segment.length_m for segment in collocation.segments)
        self.size_m = max(float(np.ptp(points, axis=0).max()) for points in nodes)

    # The ladder -------------------------------------------------------------------------------

    def run(self) -> tuple[Status, str]:
        """Solve the whole from the positions given, or rung after rung.

        Raises
        ------
        SimulationError
            Where not even the rows that were reached help to reach more.
        """
        status = self._whole() or self._climb()
        return status, status.sentence

    def _whole(self) -> Status | None:
        """Solve the whole where positions are given, unless they lead nowhere."""
        if self.x is None:
            return None
        try:
            rows = [segment.grid_rows for segment in self.collocation.segments]
            return self._descend(self._horizon(rows, last=True), last=True)
        except SimulationError:
            self.x = self.point = None
            return None

    def _climb(self) -> Status:
        """Solve rung after rung."""
        status = Status.CONVERGED
        for share in self.options.ladder:
            last = share == self.options.ladder[-1]
            rows = [part_of(segment.grid_rows, share) for segment in self.collocation.segments]
            rung = self._horizon(rows, last)
            self._reach(rung)
            status = self._descend(rung, last)
            if status is Status.ITERATION_LIMIT:
                break
        return status

    def _horizon(self, rows: list[int], last: bool) -> Horizon:
        prior = None if last else self.options.rung_prior
        watch, choice = self.recorder.stopwatch, self.options.factorisation
        return Horizon(self.collocation, rows, prior, watch, choice, self.workers)

    def _reach(self, rung: Horizon) -> None:
        """Extend the trajectories to a rung's length; where that fails, first solve what is."""
        furthest = 0
        while True:
            known = self.x
            reached, failure = rung.extend(self.p, known)
            self.sweeps += 1
            if failure is not None and known is not None:
                # Rows that only nearly satisfy the equations may lead nowhere; simulated ones do.
                afresh, failure_afresh = rung.extend(self.p)
                self.sweeps += 1
                if sum(rung.lengths(afresh)) > sum(rung.lengths(reached)):
                    reached, failure = afresh, failure_afresh
            if failure is None:
                self.x = reached
                self._place(rung, first=known is None)
                return
            rows = rung.lengths(reached)
            fewest = min(FEWEST, *rung.rows)
            nothing = known is None and min(rows) < fewest
            if nothing or sum(rows) <= furthest or self.sweeps >= self.options.max_iterations:
                raise failure
            furthest = sum(rows)
            self.x = reached
            self._place(rung, first=known is None)
            self._descend(self._horizon(rows, last=False), last=False)

    # One rung ---------------------------------------------------------------------------------

    def _descend(self, rung: Horizon, last: bool) -> Status:
        """Gauss–Newton steps on one rung until they promise no more."""
        assert self.x is not None
        tolerance = self.options.tolerance
        self.trust = min(self.options.trust, self.widest)
        point = self._accepted(rung, rung.evaluate(self.p, self.x, self.point))
        rejections, curvature = 0, np.zeros((len(point.p), len(point.p)))
        previous = np.inf
        while True:
            step = self._step(point, curvature)
            length = self._length(step)
            # A step that the trust region cuts short says nothing about the distance to go.
            whole = length < 0.99 * self.trust
            short = whole and length <= tolerance
            if short and point.feasibility_m <= FEASIBLE * self.size_m:
                return Status.CONVERGED
            rate = min(1.0, length / previous)
            if last and whole and length * rate <= SAFETY * tolerance:
                final = rung.moved(point, step)
                seen = rung.seen(point.p + step, final)
                if self._are_feasible(seen):
                    self._record(point.p + step, final, point.predicted_loss(step), seen)
                    return Status.CONVERGED
            promised = 1.0 - point.predicted_loss(step) / max(point.loss, 1e-300)
            if not last and promised < self.options.rung_decrease:
                return Status.CONVERGED
            if self.sweeps >= self.options.max_iterations:
                return Status.ITERATION_LIMIT
            trial = self._try(rung, point, step)
            better = trial is not None and self._is_better(point, step, trial)
            if trial is not None and better and self._is_seen_better(rung, point, trial):
                if last and length <= LOCAL:
                    curvature = self._curvature(curvature, point, trial)
                point, rejections, previous = self._accepted(rung, trial), 0, length
                continue
            if short and point.feasibility_m <= NEARLY_FEASIBLE * self.size_m:
                return Status.CONVERGED  # rounding keeps it from getting better
            if self.seeing and length <= SEEN:
                return Status.CONVERGED  # what is seen changes by more than such a step gains
            if length <= max(SMALLEST_TRUST, 0.1 * tolerance):
                return Status.STALLED
            self.trust = SHRINK * length
            rejections += 1
            if rejections == 1 and point.feasibility_m > INFEASIBLE * self.size_m:
                point = self._refined(rung, point)

    def _curvature(self, curvature: Array, before: Iterate, after: Iterate) -> Array:
        """What Gauss–Newton leaves out at `after`, the secant's or the exact."""
        if self.options.hessian == "exact":
            return exact_curvature(self.collocation, after, self.recorder.stopwatch)
        return updated(curvature, before, after)

    def _length(self, step: Array) -> float:
        """Largest step of a parameter, in what a trust region of one allows it."""
        return float(np.abs(step / self.reach).max(initial=0.0))

    def _step(self, point: Iterate, curvature: Array) -> Array:
        low = np.maximum(self.lower - point.p, -self.trust * self.reach)
        high = np.minimum(self.upper - point.p, self.trust * self.reach)
        # Rounding may leave a parameter on its bound by a hair.
        low, high = np.minimum(low, 0.0) - 1e-15, np.maximum(high, 0.0) + 1e-15
        return with_curvature(point.fit, curvature).best(low, high)

    def _try(self, rung: Horizon, point: Iterate, step: Array) -> Iterate | None:
        self.sweeps += 1
        p = np.clip(point.p + step, self.lower, self.upper)
        try:
            trial = rung.tried(p, point, step)
        except SimulationError:
            return None
        return trial if trial.finite else None

    def _is_better(self, point: Iterate, step: Array, trial: Iterate) -> bool:
        """Judge a trial, and widen or narrow the trust region after it."""
        predicted = point.loss - point.predicted_loss(step)
        actual = point.loss - trial.loss
        if trial.feasibility_m > max(CONTRACTION * trial.moved_m, SMALL_STRAIN * self.edge_m):
            return False
        noise = 1e-12 * point.loss + 1e-20
        if actual < DECREASE * predicted - noise:
            return False
        length = self._length(step)
        if actual > 0.75 * predicted and length > 0.9 * self.trust:
            self.trust = min(2.0 * self.trust, self.widest)
        elif actual < 0.25 * predicted - noise:
            self.trust = max(0.5 * length, SMALLEST_TRUST)
        return True

    def _refined(self, rung: Horizon, point: Iterate) -> Iterate:
        """The point after its feasibility step, or with a simulated trajectory.

        The loss of the projected trajectory is then exact to a higher order: trials that were
        judged against too low a loss get another chance.
        """
        refined = self._try(rung, point, np.zeros(len(point.p)))
        if refined is None or refined.feasibility_m > CONTRACTION * point.feasibility_m:
            return self._restored(rung, point)
        return self._accepted(rung, refined)

    def _restored(self, rung: Horizon, point: Iterate) -> Iterate:
        """The point with a simulated trajectory, where that exists."""
        self.sweeps += 1
        x, failure = rung.extend(point.p, near=point)
        if failure is not None:
            return point
        try:
            restored = rung.evaluate(point.p, x)
        except SimulationError:
            return point
        return self._accepted(rung, restored) if restored.finite else point

    def _are_feasible(self, seen: list[Seen]) -> bool:
        """Whether trajectories satisfy the equations of motion well within the tolerance."""
        return all(
            each.violation_n <= FEASIBLE_FORCE * segment.force_n
            for each, segment in zip(seen, self.collocation.segments, strict=True)
        )

    # Where recordings are read ----------------------------------------------------------------

    def _place(self, rung: Horizon, first: bool) -> None:
        """Start unknown places where the first samples lie on what was simulated first."""
        if (first or not self.placed) and self.x is not None:
            counts = [segment.rows_to_place for segment in self.collocation.segments]
            if any(counts):
                rows = rung.first_rows(self.x, counts)
                # What cameras see later is not there yet.
                self.placed = not self.seeing or [*map(len, rows)] == counts
                self._read_in(rung, *self.collocation.placed(self.p, rows))

    def _read_in(self, rung: Horizon, collocation: Collocation, p: Array) -> None:
        self.collocation = self.recorder.collocation = collocation
        rung.read_in(collocation)
        self.lower, self.upper = collocation.bounds_p
        self.p = p

    def _follow(self, rung: Horizon, point: Iterate) -> Iterate:
        """The point read where its estimates are."""
        trial, collocation, after = self.looked
        known = trial is point
        if known:
            p = after.p
        else:
            counts = [segment.rows_to_follow for segment in self.collocation.segments]
            rows = rung.first_rows(point.trajectories, counts)
            collocation, p = self.collocation.following(point.p, rows)
        if collocation is self.collocation or self.rereadings >= REREADINGS:
            return point
        self.rereadings += 1
        self._read_in(rung, collocation, p)
        return after if known else rung.reread(p, point)

    def _is_seen_better(self, rung: Horizon, point: Iterate, trial: Iterate) -> bool:
        """Whether it is better where depth cameras look anew, too.

        What points belonged to may be another part of the surface there, or nothing any more.
        """
        before = self.collocation
        if not self.seeing:
            return True
        if self.rereadings >= REREADINGS:
            return False
        self.most_seen = max(self.most_seen, before.measurements)
        after = self._follow(rung, trial)
        self.rereadings -= self.collocation is not before
        self.looked = trial, self.collocation, after
        seen = self.collocation.measurements
        each, before_each = after.loss / max(1, seen), point.loss / max(1, before.measurements)
        self._read_in(rung, before, point.p)
        return seen >= STILL_SEEN * self.most_seen and each <= AS_NEAR * before_each

    def _accepted(self, rung: Horizon, point: Iterate) -> Iterate:
        self.point = point = self._follow(rung, point)
        self.indefinite = sum(report.indefinite for report in point.reports)
        seen = [report.seen for report in point.reports]
        self._record(point.p, point.trajectories, point.loss, seen)
        return point

    def _record(self, p: Array, x: list[Any], loss: float, seen: list[Seen]) -> None:
        """Make it the answer so far."""
        self.p, self.x = p, x
        squares_m2 = sum(each.squares_m2 for each in seen)
        rms_m = float(np.sqrt(squares_m2 / max(1, sum(each.samples for each in seen))))
        violation_n = max(each.violation_n for each in seen)
        values = self.collocation.values(p)
        time_s = self.recorder.elapsed_s
        share = sum(each.rows for each in seen) / sum(
            s.grid_rows for s in self.collocation.segments
        )
        self.recorder.add(Iteration(self.sweeps, loss, rms_m, violation_n, values, time_s, share))
