"""Search of the reduced-space method: trust region, acceptance of trials, and increasing horizons.

`SearchOptions` are the options that the user sets; `ReducedSearch` is the search itself. Where
measurements are associated with the body at estimated positions (markers of unknown position,
correspondences of points with the surface), the search also updates the association.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ..common.array_types import Array
from ..common.validated_classes import validated
from ..common.validated_types import Count, NotNegative, Positive, Shares
from ..errors import SimulationError
from ..program.linear_algebra.factorisation import Choice
from .horizon import Horizon, Iterate, motion_shares, rows_of_share
from .loss_curvature import exact_curvature, secant_update, with_curvature
from .options import FEWEST, SHARES, MethodOptions
from .solution import Iteration, Status
from .solve_recorder import Recorder, misfit_of
from .trajectory_sweeps import Feasibility

if TYPE_CHECKING:
    from ..program.collocation import Collocation
    from ..program.transcription import Transcription
    from .experiment_executors import ExperimentExecutor


@dataclass(frozen=True)
class SearchPolicy:
    """When trials are accepted, and when the search ends.

    The shares of the predicted decrease are those of Conn, Gould & Toint, Trust-Region Methods, 2000,
    section 6.1; the bound of the infeasibility is that of a funnel (Gould & Toint, Math. Program.
    122, 2010), and the noise of the loss is recognised as by Sun & Nocedal (Math. Program. 202, 2023).
    """

    # Infeasibility over an edge of the mesh up to which a trial is accepted: the strain that it causes
    # is then small enough for Newton's next step to remove it. One that shrinks makes searches on
    # wrong descriptions simulate every trial.
    funnel: float = 0.1
    # Shares of the predicted decrease: the smallest of an accepted trial, that below which the trust
    # region shrinks, and that above which it grows.
    decrease: float = 1e-3
    poor: float = 0.25
    good: float = 0.75
    shrink: float = 0.25  # length of the next trial over that of a rejected step
    # Rises of the loss by new associations before they are rejected: points that change to other faces
    # make minima without them, and cycles with more.
    most_rises: int = 5
    # Largest trust region with unlabelled points, whose correspondences are valid only nearby.
    seeing: float = 0.25
    # Largest step within which the loss is about quadratic, so that the curvature is learned from it.
    local: float = 0.1
    # Largest decrease of the loss that is insignificant: the step is within 1e-3 standard errors.
    insignificant: float = 1e-6
    # Share of the standard errors within which a smooth loss agrees with its quadratic model: a trial
    # that disagrees by more than a full step can gain there shows the noise of the loss (contact that
    # opens and closes, points that change to other faces, rounding).
    noisy: float = 0.3
    round_off: float = 1e-12  # relative error of the loss by rounding
    # Infeasibility over the body's size of an answer: its loss is accurate to a higher order.
    feasible: float = 1e-6
    # Largest residual of the equations of motion after the last step, in the scaling of the NLP.
    feasible_force: float = 1e-10
    # The search on each share of a recording but the last ends when the next step is predicted to
    # decrease the loss by less than this fraction.
    rung_decrease: float = 0.05
    # Largest number of rows of a share over that of the next one: a longer one would cost a
    # simulation and sweeps, and prepare nothing.
    longest_rung: float = 0.7
    # Standard deviation of a prior of the logarithm of each parameter about its guess on these shares:
    # a short part of a recording does not determine all parameters, and those would move to their
    # bounds.
    rung_prior: float = 2.3


POLICY = SearchPolicy()


@validated
class SearchOptions(MethodOptions):
    """Options of the search for parameters.

    Attributes
    ----------
    tolerance : float
        The search ends when a step changes the logarithm of no parameter by more than this value.
        It ends also when a step is predicted to be within 1e-3 standard errors, or at the noise of
        the loss within 0.3 of them; within less with a tolerance below the default.
    least_decrease : float
        The search ends also when the next step, unless the trust region shortens it, is predicted
        to decrease the loss by less than this fraction times the largest change of a parameter's
        logarithm, if that is below 1; 0 by default. Then constants that change the loss little are
        not found, and the positions satisfy the equations of motion to the accuracy of the last
        step.
    max_iterations : int
        Largest number of sweeps, over all horizons; a rejected trial counts.
    trust : float
        First trust region: longest step of a parameter's logarithm.
    ladder : tuple of float
        Shares of the motion in the recording that are solved one after another, ending with 1.
        Not used if the solve starts from another run.
    largest_loss : float
        The search stalls when the solve of a share of the recording except the last leaves a larger
        loss than this; unlimited by default.
    hessian : {"gauss-newton", "exact"}
        Second derivatives that Gauss–Newton neglects: "gauss-newton" approximates them from the
        previous steps, and "exact" computes them from the Lagrangian, which takes a second sweep
        per iteration and helps if residuals are large. Both options are plain Gauss–Newton until a
        step changes no parameter by more than 10 %.
    factorisation : {"auto", "band", "sparse", "supernodal"}
        Factorisation of the matrix of a time step: banded Cholesky ("band"), SuperLU ("sparse"),
        supernodal Cholesky ("supernodal", extra `large`), or that with the lowest estimated cost
        ("auto").
    """

    tolerance: Positive = 1e-8
    least_decrease: NotNegative = 0.0
    max_iterations: Count = 200
    trust: Positive = 1.0
    ladder: Shares = SHARES
    largest_loss: Positive = 1e100
    hessian: Literal["gauss-newton", "exact"] = "gauss-newton"
    factorisation: Choice = "auto"


def _oscillates(transcription: Transcription) -> bool:
    """Return whether the recording is a table of moduli over frequency, for several branches."""
    body = transcription.body
    return any(len(part.prony) > 1 for part in body.parts) and body.memory.oscillates


@dataclass(frozen=True, eq=False)
class SearchState:
    """State of a search on one horizon."""

    point: Iterate  # best iterate
    curvature: Array  # (np, np): part of the Hessian that Gauss–Newton neglects
    trust: float  # longest step, relative to `ReducedSearch.reach`
    swept: float = np.inf  # step whose sweep is expected to leave the largest infeasibility
    rejections: int = 0  # in a row
    rises: int = 0  # of the loss by new associations
    noise: float = 0.0  # actual less predicted decrease of the trial that was rejected last


class ReducedSearch:
    """Search with the reduced-space method: best parameters and trajectories, number of sweeps.

    Attributes
    ----------
    p : (np,) array
        Best parameters (q, φ).
    trajectories : list or None
        Best trajectories, stored by the workers, see `trajectory_sweeps.trajectory_positions`; None
        before the first.
    point : Iterate or None
        Best iterate, which was accepted last; None before the first.
    sweeps : int
        Number of sweeps and simulations so far.
    reach : (np,) array
        Change of each parameter that counts as a step of one.
    lower, upper : (np,) array
        Bounds of the parameters.
    has_correspondences : bool
        Whether an experiment has measurements with correspondences, as those of cameras have.
    is_associated : bool
        Whether cameras of unknown position have been associated with trajectories of
        sufficient length.
    trust, noise : float
        Trust region of the last trial, and noise of the loss, see `Iteration`.
    indefinite_steps : int
        Time steps with an indefinite matrix at the best point.
    edge_m, size_m : float
        Mesh edge and body size [m].

    Parameters
    ----------
    recorder : Recorder
        Record of the solve; its collocation is replaced when measurements are associated again.
    start : (variables,) array, optional
        Initial variables; None means the guess and simulations.
    workers : ExperimentExecutor, optional
        Where the experiments are processed; None means threads.
    """

    def __init__(
        self,
        options: SearchOptions,
        recorder: Recorder,
        start: Array | None,
        workers: ExperimentExecutor | None = None,
    ) -> None:
        self.options = options
        self.recorder = recorder
        self.collocation = collocation = recorder.collocation
        self.sweeps = 0
        correspondences = [
            each
            for transcription in collocation.transcriptions
            for each in transcription.association.correspondences
        ]
        self.has_correspondences = bool(correspondences)
        is_labelled = all(each.is_labelled for each in correspondences)
        self.largest_trust = np.inf if is_labelled else POLICY.seeing
        self.indefinite_steps = 0
        self.lower, self.upper = collocation.parameter_bounds
        self.is_associated = True
        self.reach = collocation.reach_p
        self.p: Array = collocation.guess_p
        self.trajectories: list[Any] | None = None
        self.workers = workers
        if start is not None:
            start = np.clip(start, *collocation.bounds())
            self.p = collocation.parameters_from(start)
            self.trajectories = [
                part.transcription.with_prescribed_positions(part.x, part.phi)
                for part in collocation.iterates(start)
            ]
        self.point: Iterate | None = None
        nodes = [transcription.body.nodes_m for transcription in collocation.transcriptions]
        self.edge_m = min(transcription.length_m for transcription in collocation.transcriptions)
        self.size_m = max(float(np.ptp(points, axis=0).max()) for points in nodes)

    # Horizons of increasing length ------------------------------------------------------------

    def solve_from_start(self) -> Status | None:
        """Return the status of a solve of the complete problem from the given trajectories.

        None if there are none, or if the search raises a `SimulationError`; trajectories and point
        are then discarded, parameters, associations and the count of sweeps remain.
        """
        if self.trajectories is None:
            return None
        try:
            rows = [transcription.grid_times for transcription in self.collocation.transcriptions]
            horizon = self.horizon(rows, last=True)
            return self.minimise(horizon, is_last=True)
        except SimulationError:
            self.trajectories = self.point = None
            return None

    @cached_property
    def rungs(self) -> list[list[int]]:
        """First rows of each experiment that are solved one after another: those with the shares of
        the motion that the options state, if they differ enough, and at last all. Tables of moduli
        over frequency, of which a part determines few branches, are solved at once.
        """
        *shares, complete = self.options.ladder
        if all(map(_oscillates, self.collocation.transcriptions)):
            shares = []
        motions = motion_shares(self.collocation)
        every = [rows_of_share(motion, complete) for motion in motions]
        rungs: list[list[int]] = []
        for share in shares:
            rows = [rows_of_share(motion, share) for motion in motions]
            shortest = sum(rungs[-1]) / POLICY.longest_rung if rungs else 0.0
            if shortest <= sum(rows) <= POLICY.longest_rung * sum(every):
                rungs.append(rows)
        return [*rungs, every]

    def horizon(self, rows: list[int], last: bool) -> Horizon:
        """Return the problem on the given numbers of first rows of each experiment; unless it is
        the last horizon, with the prior of the options.
        """
        prior = None if last else POLICY.rung_prior
        watch = self.recorder.stopwatch
        choice = self.options.factorisation
        return Horizon(
            self.collocation,
            rows,
            prior=prior,
            stopwatch=watch,
            factorisation=choice,
            workers=self.workers,
        )

    def extend_to(self, horizon: Horizon) -> None:
        """Extend the trajectories to the length of a horizon by simulation, in place.

        If the simulation fails, a simulation from the start is used instead if it reaches further;
        the rows that were reached are fitted, and then extended again. Measurements are associated
        with the first trajectories.

        Raises
        ------
        SimulationError
            If this does not reach further, the first simulation does not reach `FEWEST` rows, or
            the limit of sweeps is reached.
        """
        furthest = 0
        while True:
            previous = self.trajectories
            reached, failure = horizon.simulate(self.p, previous)
            self.sweeps += 1
            if failure is not None and previous is not None:
                # Rows that only nearly satisfy the equations may lead nowhere; simulated ones do.
                restarted, restart_failure = horizon.simulate(self.p)
                self.sweeps += 1
                if sum(horizon.row_counts(restarted)) > sum(horizon.row_counts(reached)):
                    reached = restarted
                    failure = restart_failure
            if failure is None:
                self.trajectories = reached
                self._associate_initially(horizon, is_first=previous is None)
                return
            rows = horizon.row_counts(reached)
            fewest = min(FEWEST, *horizon.rows)
            is_unstarted = previous is None and min(rows) < fewest
            if is_unstarted or sum(rows) <= furthest or self.sweeps >= self.options.max_iterations:
                raise failure
            furthest = sum(rows)
            self.trajectories = reached
            self._associate_initially(horizon, is_first=previous is None)
            self.minimise(self.horizon(rows, last=False), is_last=False)

    # Steps on one horizon ---------------------------------------------------------------------

    def minimise(self, horizon: Horizon, is_last: bool) -> Status:
        """Take Gauss–Newton steps on one horizon until convergence, and return the status.

        It starts at `p` and `trajectories`, which must exist and have the rows of the horizon, and
        resets the trust region. The start and every accepted step become the best point so far:
        associations are renewed there, in the horizon too, and an entry is added to the history.
        Every trial counts as a sweep. The status is that of convergence, of the iteration limit, or
        `STALLED` if steps become tiny without a decrease.

        Parameters
        ----------
        horizon : Horizon
            Problem on the first rows.
        is_last : bool
            Whether it is the complete problem. Otherwise the status is also that of convergence if
            the predicted relative decrease of the loss is less than `SearchPolicy.rung_decrease`.

        Raises
        ------
        SimulationError
            If the sweep at the start fails, or a time step is singular in the exact curvature at an
            accepted step; failed trials are only rejected.
        """
        assert self.trajectories is not None
        start = horizon.evaluate(self.p, self.trajectories, known_iterate=self.point)
        self.trust, self.noise = min(self.options.trust, self.largest_trust), 0.0
        point = self._accept(self._reassociate(horizon, start))
        state = SearchState(point, np.zeros((len(point.p), len(point.p))), trust=self.trust)
        while True:
            step = self._next_step(state, state.trust)
            status = self._outcome(horizon, state, step, is_last)
            if status is not None:
                return status
            state = self._advance(horizon, state, step, is_last)

    def _outcome(
        self, horizon: Horizon, state: SearchState, step: Array, is_last: bool
    ) -> Status | None:
        """Return the status if the search ends at a state with the next step (np,), by the first
        reason that holds.
        """
        point, tolerance = state.point, self.options.tolerance
        length = self._step_length(step)
        # A step that the trust region shortens contains no information on the remaining distance.
        is_full = length < 0.99 * state.trust
        decrease = self._predicted(state, step)
        fraction = decrease / max(point.loss, 1e-300)
        level = min(1.0, point.loss)  # data without noise are fitted more closely than their errors
        share = min(1.0, tolerance / SearchOptions.tolerance)
        insignificant = share**2 * level * POLICY.insignificant
        is_small = is_full and (decrease <= insignificant or length <= tolerance)
        if is_last and is_small and self._ends(horizon, point, step):
            return Status.CONVERGED
        if not is_last and fraction < POLICY.rung_decrease:
            return Status.CONVERGED
        if is_full and fraction < self.options.least_decrease * min(1.0, length):
            return Status.CONVERGED
        if state.rejections:
            farthest = self._next_step(state, self.largest_trust)
            remaining = self._predicted(state, farthest)
            noisy = share * float(np.sqrt(level)) * POLICY.noisy
            is_local = self._step_length(farthest) <= POLICY.local and self._is_near(
                point, farthest, noisy
            )
            is_noise = is_local and remaining <= state.noise
            is_rounding = is_small or remaining <= max(insignificant, POLICY.round_off * point.loss)
            if is_noise or is_rounding or state.trust <= tolerance:
                point = self._settled(horizon, point)
                is_feasible = point.feasibility_m <= POLICY.feasible * self.size_m
                is_near = is_noise or is_rounding or self._is_near(point, farthest, 1.0)
                return Status.CONVERGED if is_feasible and is_near else Status.STALLED
        if self.sweeps >= self.options.max_iterations:
            return Status.ITERATION_LIMIT
        return None

    @staticmethod
    def _predicted(state: SearchState, step: Array) -> float:
        """Return the decrease of the loss by a step (np,) in the model whose minimiser it is."""
        model = with_curvature(state.point.fit, state.curvature)
        return model.loss(np.zeros_like(step)) - model.loss(step)

    def _ends(self, horizon: Horizon, point: Iterate, step: Array) -> bool:
        """Whether a last step satisfies the equations of motion without a sweep; it is recorded."""
        positions = horizon.extrapolate(point, step)
        reached = horizon.feasibilities(point.p + step, positions)
        are_feasible = self._are_feasible(reached)
        if are_feasible:
            loss = point.predicted_loss(step)
            self._record(point.p + step, positions, loss=loss, reached=reached)
        return are_feasible

    def _settled(self, horizon: Horizon, point: Iterate) -> Iterate:
        """Return a point that is feasible: steps of the parameters would disturb it again."""
        for _ in range(2):
            if point.feasibility_m > POLICY.feasible * self.size_m:
                point = self._make_feasible(horizon, point)
        return point

    def _advance(
        self, horizon: Horizon, state: SearchState, step: Array, is_last: bool
    ) -> SearchState:
        """Return the state after the trial of a step (np,), which is accepted or not."""
        point = state.point
        length = self._step_length(step)
        self.trust = state.trust
        trial, swept = self._try(horizon, state, step)
        state = replace(state, swept=swept)
        predicted = self._predicted(state, step)
        actual = -np.inf if trial is None else point.loss - trial.loss
        rounding = POLICY.round_off * point.loss + 1e-20
        if trial is not None and actual >= POLICY.decrease * predicted - rounding:
            trust = state.trust
            if actual > POLICY.good * predicted and length > 0.9 * trust:
                trust = min(2.0 * trust, self.largest_trust)
            elif actual < POLICY.poor * predicted - rounding:
                trust = 0.5 * length
            known, loss = (self.collocation, self.p), point.loss + self.collocation.excluded_loss
            renewed = self._reassociate(horizon, trial)
            actual = loss - renewed.loss - self.collocation.excluded_loss
            has_risen = actual < -rounding
            if not (has_risen and state.rises == POLICY.most_rises):
                curvature = state.curvature
                if is_last and length <= POLICY.local:
                    curvature = self._update_curvature(curvature, point, after=trial)
                return replace(
                    state,
                    point=self._accept(renewed),
                    curvature=curvature,
                    trust=trust,
                    rejections=0,
                    rises=state.rises + has_risen,
                )
            self._set_collocation(horizon, *known)
        self.noise = abs(actual - predicted)
        self._record(point.p, point.trajectories, loss=point.loss, reached=point.reports)
        if not state.rejections and point.feasibility_m > POLICY.feasible * self.size_m:
            point = self._make_feasible(horizon, point)
        return replace(
            state,
            point=point,
            trust=POLICY.shrink * length,
            rejections=state.rejections + 1,
            noise=self.noise,
        )

    def _is_near(self, point: Iterate, step: Array, share: float) -> bool:
        """Whether a step changes each shared parameter by a share of its standard error."""
        count = self.collocation.nq
        return bool((np.abs(step[:count]) <= share * point.fit.standard_errors[:count]).all())

    def _update_curvature(self, curvature: Array, previous: Iterate, after: Iterate) -> Array:
        """Return the part (np, np) that Gauss–Newton neglects: exact, or by a secant update."""
        if self.options.hessian == "exact":
            return exact_curvature(self.collocation, after, stopwatch=self.recorder.stopwatch)
        return secant_update(curvature, previous, after=after)

    def _step_length(self, step: Array) -> float:
        """Return the largest change of a parameter relative to `reach`; 0 without any."""
        return float(np.abs(step / self.reach).max(initial=0.0))

    def _next_step(self, state: SearchState, trust: float) -> Array:
        """Return the step (np,) that minimises the quadratic model within bounds and trust region."""
        point = state.point
        largest = trust * self.reach
        low = np.maximum(self.lower - point.p, -largest)
        high = np.minimum(self.upper - point.p, largest)
        # Rounding may leave a parameter on its bound by a hair.
        low = np.minimum(low, 0.0) - 1e-15
        high = np.maximum(high, 0.0) + 1e-15
        return with_curvature(point.fit, state.curvature).minimiser(low, high)

    def _try(
        self, horizon: Horizon, state: SearchState, step: Array
    ) -> tuple[Iterate | None, float]:
        """Return the point after a step, simulated if a sweep leaves the funnel, None if that fails;
        and the step that is expected to stay in the funnel.
        """
        point, swept = state.point, state.swept
        p = np.clip(point.p + step, self.lower, self.upper)
        length = self._step_length(step)
        trial = None
        if length <= swept:
            self.sweeps += 1
            with suppress(SimulationError):
                trial = horizon.evaluate_step(p, point, step=step)
        if trial is None:
            swept *= 2.0  # what left the funnel once need not leave it again
        elif length and not trial.feasibility_m <= POLICY.funnel * self.edge_m:
            # Infeasibility is of second order in the step.
            share = np.sqrt(POLICY.funnel * self.edge_m / np.fmin(trial.feasibility_m, self.edge_m))
            swept = share * length
            trial = None
        if not state.rejections:  # shorter steps will soon stay in the funnel
            trial = trial or self._simulated(horizon, p, point)
        return (trial if trial is not None and trial.is_finite else None), swept

    def _simulated(self, horizon: Horizon, p: Array, previous: Iterate) -> Iterate | None:
        """Return the point with a simulated trajectory, one sweep; None if that fails."""
        self.sweeps += 1
        x, failure = horizon.simulate(p, guess=previous)
        if failure is not None:
            return None
        try:
            return horizon.evaluate(p, x, previous=previous)
        except SimulationError:
            return None

    def _make_feasible(self, horizon: Horizon, point: Iterate) -> Iterate:
        """Return the point after its feasibility step, or simulated if that is not halved."""
        # The loss of the projected trajectory is accurate to a higher order, so that trials are no
        # longer compared with a loss that is too low.
        self.sweeps += 1
        refined = None
        with suppress(SimulationError):
            refined = horizon.evaluate_step(point.p, point, step=np.zeros(len(point.p)))
        if refined is None or not refined.feasibility_m <= 0.5 * point.feasibility_m:
            return self._resimulated(horizon, point)
        return self._accept(self._reassociate(horizon, refined))

    def _resimulated(self, horizon: Horizon, point: Iterate) -> Iterate:
        """Return the simulated point as the best so far; the point itself if that fails."""
        resimulated = self._simulated(horizon, point.p, point)
        if resimulated is None or not resimulated.is_finite:
            return point
        return self._accept(self._reassociate(horizon, resimulated))

    def _are_feasible(self, reached: list[Feasibility]) -> bool:
        """Whether each largest residual is at most `SearchPolicy.feasible_force` times its `stiffness_n`."""
        return all(
            each.violation_n <= POLICY.feasible_force * transcription.stiffness_n
            for each, transcription in zip(reached, self.collocation.transcriptions, strict=True)
        )

    # Association of the measurements ----------------------------------------------------------

    def _associate_initially(self, horizon: Horizon, is_first: bool) -> None:
        """Associate markers and cameras of unknown position with the first rows, in place."""
        # Once, unless the trajectories were then too short for the cameras.
        if (is_first or not self.is_associated) and self.trajectories is not None:
            counts = [
                transcription.rows_to_place for transcription in self.collocation.transcriptions
            ]
            if any(counts):
                rows = horizon.first_rows(self.trajectories, counts)
                # Images of later rows are associated when the trajectories are long enough.
                self.is_associated = not self.has_correspondences or [*map(len, rows)] == counts
                self._set_collocation(
                    horizon, *self.collocation.place_unknown_markers(self.p, rows)
                )

    def _set_collocation(self, horizon: Horizon, collocation: Collocation, p: Array) -> None:
        """Set another collocation of the same problem in search, recorder and horizon."""
        self.collocation = self.recorder.collocation = collocation
        horizon.set_collocation(collocation)
        self.lower, self.upper = collocation.parameter_bounds
        self.p = p

    def _reassociate(self, horizon: Horizon, point: Iterate) -> Iterate:
        """Return the point with measurements associated anew."""
        counts = [transcription.rows_to_follow for transcription in self.collocation.transcriptions]
        rows = horizon.first_rows(point.trajectories, counts)
        collocation, p = self.collocation.follow_estimates(point.p, rows)
        if collocation is self.collocation:
            return point
        self._set_collocation(horizon, collocation, p=p)
        return horizon.reassociate(p, point)

    def _accept(self, point: Iterate) -> Iterate:
        """Make a point the best so far: store and record it."""
        self.point = point
        self.indefinite_steps = sum(report.indefinite_steps for report in point.reports)
        self._record(point.p, point.trajectories, loss=point.loss, reached=point.reports)
        return point

    def _record(self, p: Array, x: list[Any], loss: float, reached: Sequence[Feasibility]) -> None:
        """Store the best so far, and add an entry to the history."""
        self.p = p
        self.trajectories = x
        violation_n = max(each.violation_n for each in reached)
        values = self.collocation.parameters.scalar_values(p[: self.collocation.nq])
        time_s = self.recorder.measure_elapsed_s()
        share = sum(each.rows for each in reached) / sum(
            s.grid_times for s in self.collocation.transcriptions
        )
        misfit = misfit_of(self.collocation, loss, share)
        self.recorder.add(
            Iteration(
                self.sweeps,
                loss,
                misfit,
                violation_n=violation_n,
                parameters=values,
                time_s=time_s,
                share=share,
                trust=self.trust,
                noise=self.noise,
            )
        )
