"""Live estimation of parameters: one frame in, one estimate out.

All frames are linearised at one point p; the estimate is the Gauss–Newton step from there, within
bounds and a trust region. When the estimate has moved away from p, the rows in the window are
computed again at the estimate, in what is left of each frame's time, until this second pass has
caught up. It replaces the first pass if its sum of squares is acceptable; otherwise the trust
region shrinks. Each pass is thus an iteration of the reduced-space method on all data so far, and
the iterations converge to the result of the batch.

In the meantime both passes change their linearisation point to the current estimate and continue
from a state that is moved along its derivatives, as in an extended Kalman filter; another pass then
follows.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import Array
from ..checked import AtLeastOne, Options, Positive
from ..errors import InputError, SimulationError
from ..fem.constants import is_mode
from ..pipeline import Run
from ..problem import Problem
from ..program.lapack import one_blas_thread
from ..program.least_squares import LeastSquares
from ..statistics.concern import concerned
from ..statistics.estimates import Estimate, user_estimates
from ..statistics.linearised import AT_BOUND
from ..statistics.trust import GROSS_MISFIT, Trust
from .budget import Budget
from .frames import Frame, Pose, as_pose, as_readings, as_time, as_tracks, as_wrenches
from .intake import LONGEST, Intake
from .model import TOGETHER, Model, Poses
from .search import SEEN, Search
from .sweep import LoggedRow, Sample
from .track import JoinedPasses, Track
from .trust import UNSETTLED, Scatter, data_concerns, estimate_concerns, widened
from .whole import recording_of, solved

# Standard deviation, in steps of the trust region, of a prior that keeps the next linearisation
# point near the last one until many samples are available.
STAY = 0.5
# Distance of the estimate from the linearisation point, in standard errors, that starts a new pass.
MOVED = 0.1
# Distance, in standard errors, at which a pass that is catching up changes its linearisation point.
TURN = 1.0
# The same distance for the first pass, which receives the frames.
TURN_FIRST = 3.0
# Initial radius of the trust region, see `methods.search`.
TRUST = 1.0
# Largest radius of the trust region.
WIDEST = 2.0
# Factor of the radius after a rejected step.
SHRINK = 0.25
# A pass is accepted if its sum of squares is at most TIMES · expected + SLACK: rows that arrived in
# the meantime are fitted by the next pass.
TIMES = 1.25
SLACK = 1.0
# Default of the computing time of a frame, as a fraction of the time between samples.
SHARE = 0.8
# Number of blocks of a window.
BLOCKS = 12
# Number of consecutively rejected passes after which other initial values are searched for.
REJECTED = 3
# Largest number of passes over the window after the last frame.
PASSES = 50
# Number of timing measurements before the first frame.
TIMED = 3
# Ratio of a residual to the usual one above which a sample is an outlier.
JUMP = 6.0
# Distance, in body sizes, from the grasp beyond which no marker can be, and beyond which no grasp
# moves between two samples.
FAR = 5.0
# Number of frames between two evaluations of all residuals.
LOOK_EVERY = 5


@dataclass(frozen=True)
class LiveOptions(Options):
    """Options of live estimation.

    Attributes
    ----------
    budget_s : float, optional
        Computing time of a frame; 80 % of the time between samples by default. The rows of the
        frame itself are computed even if they take longer.
    window_s : float
        Duration of the window of frames that are computed again when the estimate moves.
    rows : int, optional
        Number of rows of the grid that are computed again in each frame, in place of the time
        limit: estimates are then the same on any machine.
    """

    name: ClassVar[str] = "live"

    budget_s: Positive | None = None
    window_s: Positive = 3.0
    rows: AtLeastOne | None = None


@dataclass(frozen=True, eq=False)
class Update:
    """Result after a frame.

    Attributes
    ----------
    t_s : float
        Time of the frame.
    estimates : mapping of name to Estimate
        Value, standard error and 95 % interval of each parameter.
    trust : Trust
        Verdict with its reasons.
    marker_rms_m : float
        Root mean square distance of this frame's markers from the estimate's; NaN without markers.
    notes : tuple of str
        Irregularities of the frame, and events.
    latency_s : float
        Computing time of the frame.
    relinearised : int
        Number of rows that were computed again.
    """

    t_s: float
    estimates: Mapping[str, Estimate]
    trust: Trust
    marker_rms_m: float
    notes: tuple[str, ...]
    latency_s: float
    relinearised: int

    def __repr__(self) -> str:
        values = ", ".join(f"{name} = {each.value:.4g}" for name, each in self.estimates.items())
        return f"Update(t = {self.t_s:.4g} s: {values}; {self.trust.verdict})"


def _require_phases(problem: Problem) -> None:
    """Raise an `InputError` for a two-phase field without phases, which live estimation cannot
    find.
    """
    for name, modes in problem.two_phase_fields.items():
        if not modes.has_phases:
            raise InputError(
                f"the phases of {name} are not known, and are not searched for while live; "
                "expected the problem of an answer, `cs.run(problem).problem`, or prior = 'smooth'"
            )


class Estimator:
    """Estimator of a problem's parameters from frames, one after another.

    Parameters
    ----------
    problem : Problem
        One experiment; of its recording only the grasps, the markers and the sampling rate are
        used.
    options : LiveOptions
    clock : callable
        Time in seconds for the budget; `time.thread_time` excludes the time of other processes.

    Attributes
    ----------
    p : (P,)
        Current estimate of the parameters, in the solver's coordinates.
    counts : Counter
        Numbers of irregularities of frames, by kind.
    last : Update or None
        Result after the last frame; None before the first one.

    Raises
    ------
    InputError
        If the problem has a feature that live estimation does not support.
    """

    def __init__(
        self,
        problem: Problem,
        options: LiveOptions = LiveOptions(),
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.problem = problem
        self.options = options
        self.clock = clock
        _require_phases(problem)
        self.model = Model.of(problem)
        model = self.model
        self.names = self.model.experiment.markers.names
        far_m = FAR * model.size_m
        neighbours = model.samples_around
        self._reach_m = far_m + float(np.linalg.norm(model.segment.body.nodes_m.mean(axis=0)))
        stencils = [each.around for each in model.instruments]
        self.intake = Intake(model.interval_s, model.substeps, neighbours, far_m, stencils)
        self.counts = self.intake.counts
        self.samples = 0
        self.budget_s = options.budget_s or SHARE * model.interval_s
        self.rows = options.rows
        samples = max(LONGEST, round(options.window_s / model.interval_s / BLOCKS))
        self._block_rows = samples * model.substeps
        self._blocks = max(2, round(options.window_s / model.interval_s / samples))
        self._bounds()
        self.p = np.clip(model.collocation.guess_p, self.lower, self.upper)
        self.prior = LeastSquares.none(model.size)
        self.track: Track | None = None
        self._joined = JoinedPasses(self.prior, [], [])
        self._held_m = np.full((1, 3), np.nan)
        self.again: Track | None = None
        self.log: list[LoggedRow] = []
        self.search = self._search() if problem.parameters.unguessed else None
        self.scatter = Scatter()
        self._trust = TRUST
        self._rejected = 0
        self.budget = Budget()
        self.last: Update | None = None
        self._rest = self._warmed_up()

    # Frames -----------------------------------------------------------------------------------

    def update(
        self,
        t_s: float,
        pose: Pose | Mapping[str, Pose] | None,
        markers: ArrayLike | Mapping[str, ArrayLike],
        wrench: Any = None,
        readings: Mapping[str, Any] | None = None,
    ) -> Update:
        """Process a frame and return the result.

        Parameters
        ----------
        t_s : float
            Time of the frame.
        pose : 4×4 matrix, (position, quaternion x y z w), or None
            Pose of the moving grasp, None if it is missing; for several grasps a mapping by their
            number from "1" on, or a list in the order of the problem.
        markers : (M, 3) array, or mapping of name to (3,)
            Marker positions; NaN, or omitted, where missing.
        wrench : (6,) or (3,) array, optional
            Wrench of the grasp on the body: fx, fy, fz [N], tx, ty, tz [N m], at the time of the
            frame; or a mapping with ``t_s`` and ``values``, or a list of such mappings; for several
            sensors a mapping by the number of their grasp. NaN, or None, where missing.
        readings : mapping of name to numbers, optional
            Values of custom sensors at the time of the frame; or mappings with ``t_s`` and
            ``values``, or lists of such mappings. NaN, or None, where missing.

        Raises
        ------
        InputError
            If the values are not a valid frame; the estimator is then unchanged.
        """
        poses = as_pose(pose, self.model.moved_grasps + 1)
        tracks = as_tracks(markers, self.names)
        gauges = self.model.experiment.readings
        instrument_samples = as_readings(readings, gauges, as_time(t_s))
        instrument_samples += as_wrenches(wrench, self.model.wrenches, len(gauges), as_time(t_s))
        return self.take(Frame(as_time(t_s), poses, tracks, wrench is not None, instrument_samples))

    @one_blas_thread()
    def take(self, frame: Frame) -> Update:
        """Process a validated frame and return the result."""
        began = self.clock()
        frame, notes = self._of_frame(frame)
        if self.intake.is_lost(frame.t_s):
            if frame.pose is None:
                notes.append("the grasp is lost: nothing is read until its pose is back")
            else:
                self._begin_anew()
                notes.append("begun anew after a gap: the body is assumed to be at rest here")
        rows, readings, new_notes = self.intake.take(
            frame.t_s, frame.pose, frame.tracks_m, frame.told
        )
        notes += new_notes
        self.budget.forget()
        caught_up = self._catch_up(began, notes)
        squares = []
        before = self.clock()
        while rows:
            done, new_notes = self._go_on(rows, squares)
            notes = notes + new_notes
            rows = rows[done:]
        notes += self._read(readings, squares)
        self._estimate()
        if self.track is not None and not self.track.failed and self.search is None:
            self._turn(self.track, self.track, began, TURN_FIRST)
        self.budget.frame_s = self.clock() - before
        done = self._pass_again(began, notes, caught_up)
        before = self.clock()
        self._shorten()
        squared_distances = np.concatenate([*squares, np.zeros(0)])
        rms_m = float(np.sqrt(squared_distances.mean())) if len(squared_distances) else float("nan")
        estimates, trust = self._known(frame.t_s)
        self.budget.ended(self.clock() - before)
        latency_s = self.clock() - began
        self.last = Update(frame.t_s, estimates, trust, rms_m, tuple(notes), latency_s, done)
        return self.last

    @one_blas_thread()
    def settle(self) -> Update | None:
        """Return the final result of all frames, however long that takes.

        Call it after the last frame.

        If the window holds the whole recording, this is the run of the batch. Otherwise, and if
        markers were measured between samples, the rows in the window are computed again until the
        estimate stays.

        Returns
        -------
        Update or None
            The update of the last frame with new estimates and, after a batch run, the root mean
            square distance of all markers. None if there was no frame.
        """
        began = self.clock()
        notes = ["settled after the last frame"]
        if self.last is None or self.track is None:
            return self.last
        last = self.last
        batch_run = self._run_of_all(self.track, notes)
        if batch_run is None:
            rows = self._pass_to_the_end(began, notes)
            estimates, trust = self._known(last.t_s)
        else:
            rows = len(batch_run.solution.history) * len(self.log)
            estimates = {name: batch_run.estimates[name] for name in last.estimates}
            left_out = Trust.of(data_concerns(Scatter(), self.counts, self.samples))
            trust = batch_run.trust.joined(left_out)
            last = replace(last, marker_rms_m=batch_run.solution.rms_m)
        return replace(
            last,
            estimates=estimates,
            trust=trust,
            notes=tuple(notes),
            latency_s=self.clock() - began,
            relinearised=rows,
        )

    def _run_of_all(self, track: Track, notes: list[str]) -> Run | None:
        """Return the run of the batch; None if the window does not hold the whole recording."""
        recording = None if track.prior.rows else recording_of(self.model, self.intake, self.log)
        try:
            return None if recording is None else solved(self.problem, recording)
        except InputError as error:
            notes.append(f"the recording cannot be solved as a whole: {error.message}")
            return None

    def _pass_to_the_end(self, began: float, notes: list[str]) -> int:
        """Compute the rows in the window again until the estimate stays.

        Return the number of rows.
        """
        rows_per_frame, self.rows = self.rows, PASSES * len(self.log)
        try:
            return self._pass_again(began, notes)
        finally:
            self.rows = rows_per_frame

    def _of_frame(self, frame: Frame) -> tuple[Frame, list[str]]:
        """Return the frame without implausible markers, and notes."""
        notes = []
        if frame.has_wrench and not self.model.wrenches:
            self.counts["with a wrench"] += 1
            if self.counts["with a wrench"] == 1:
                notes.append("wrenches are left out: no grasp of the problem has a sensor")
        if frame.pose is not None:
            self._held_m = frame.pose[0]
        distances_m = np.linalg.norm(frame.tracks_m[:, None] - self._held_m, axis=2)
        self.samples += int(np.isfinite(frame.tracks_m[:, 0]).sum())
        is_implausible = (distances_m > self._reach_m).all(axis=1)
        if is_implausible.any():
            notes.append(self._left_out(is_implausible))
            frame = replace(
                frame, tracks_m=np.where(is_implausible[:, None], np.nan, frame.tracks_m)
            )
        return frame, notes

    def _left_out(self, wild: NDArray[np.bool_]) -> str:
        """Count outliers given by a mask (M,) of the markers; return a note."""
        self.counts["wild"] += int(wild.sum())
        names = ", ".join(self.names[m] for m in np.flatnonzero(wild))
        return f"left out, far from where they can be: {names}"

    def _go_on(self, rows: Sequence[LoggedRow], squares: list[Array]) -> tuple[int, list[str]]:
        """Compute and log new rows, as many as possible at once; return their number and notes."""
        done = 1
        notes = []
        track = self.track
        try:
            if track is None:
                self._begin(rows[0])
            elif not track.failed:
                done = track.advance([row.poses for row in rows[: track.together]])
        except SimulationError as error:
            if track is None:
                self.intake.begin_anew()
                return 1, [f"the start of the motion cannot be computed: {error}"]
            track.failed = True
            notes = [f"the body cannot be simulated with these parameters: {error}"]
        for k, row in enumerate(rows[:done], 1):
            self.log.append(LoggedRow(row.poses, []))
            notes += self._read(row.readings, squares, done - k)
        return done, notes

    def _read(self, readings: Sequence[Sample], squares: list[Array], rows: int = 0) -> list[str]:
        """Add samples without outliers to the pass and to the log; return notes.

        Parameters
        ----------
        readings : sequence of Sample
        squares : list
            Squared marker residuals [m²] of the frame; extended in place.
        rows : int
            Number of rows computed since the row after which the samples are evaluated.
        """
        track = self.track
        if track is None:
            return []
        notes = []
        sigma_m = self.model.segment.experiment.markers.sigma_m[:, None]
        if track.failed:
            self.log[-1].readings.extend(readings)
            return notes
        all_linearised = track.sweep.linearised([(reading, rows) for reading in readings])
        for reading, linearised in zip(readings, all_linearised, strict=True):
            if not reading.of:
                residual = linearised.at(self.model.flat(self.p))
                outliers = self._wild(residual)
                if outliers.any():
                    notes.append(self._left_out(outliers))
                    remaining = np.where(outliers[:, None], np.nan, reading.values)
                    reading = reading._replace(values=remaining)
                    linearised.at_zero[outliers] = residual[outliers] = np.nan
                squared = np.sum((residual * sigma_m) ** 2, axis=1)
                squares.append(squared[np.isfinite(squared)])
            self.log[-1].readings.append(reading)
        track.read(all_linearised)
        return notes

    def _wild(self, residual: Array) -> NDArray[np.bool_]:
        """Return a mask (M,) of samples that the estimate does not explain while it explains the
        others.
        """
        if self.moved > UNSETTLED or not 0 < self.scatter.rms < GROSS_MISFIT:
            return np.zeros(len(residual), dtype=bool)
        length = np.sqrt(np.sum(residual**2, axis=1) / 3)
        outliers = length > JUMP * max(1.0, self.scatter.rms)
        if outliers.sum() > np.isfinite(length).sum() / 2:
            return np.zeros_like(outliers)
        return outliers

    # Beginnings -------------------------------------------------------------------------------

    def _bounds(self) -> None:
        """Set the bounds of p from the model."""
        self.lower, self.upper = self.model.collocation.bounds_p

    def _search(self) -> Search:
        """Return a new search for initial values."""
        return Search(self.model, self.p[self.model.collocation.nq :])

    def _warmed_up(self) -> tuple[Poses, Array] | None:
        """Compile the kernels before the first frame.

        Return poses and positions (3n,) of the start.

        None if the start cannot be computed.
        """
        poses = self.model.first_poses
        moving_poses = tuple(poses[k] for k in self.model.moved_grasps)
        no_markers = np.full((len(self.names), 3), np.nan)
        no_markers[0] = 0.0
        try:
            trial = Track(self.model, self.p, self.prior, self._block_rows)
            row = LoggedRow(moving_poses, [Sample(0.0, no_markers)])
            for _ in range(self.model.rows + 2):
                trial.again([row])
        except SimulationError:
            return None
        self._estimates_at(trial.information, self.p)
        self.budget = self._timed(trial, row)
        return poses, trial.blocks[0].kept[0].x

    def _timed(self, trial: Track, row: LoggedRow) -> Budget:
        """Return the computing times of repeated rows, the shortest of several measurements."""
        took_s: dict[int, float] = {}
        most = min(trial.rows - 1, TOGETHER, self._block_rows - 1)
        for count in (1, most) * TIMED:
            again = Track(self.model, self.p, self.prior, self._block_rows, trial)
            again.again([row])
            began = self.clock()
            again.again([row] * count)
            took_s[count] = min(took_s.get(count, np.inf), self.clock() - began)
        return Budget.of(took_s[1], took_s[most], most)

    def _begin(self, row: LoggedRow) -> None:
        """Start the first pass with the first row, and set unknown marker places from its
        markers.
        """
        model = self.model
        guesses = []
        poses = model.poses_of(row.poses)
        if self._rest is not None and len(poses) == 1:
            old_rotation, old_position = self._rest[0][0]
            x = self._rest[1]
            (rotation, position) = poses[0]
            guesses = [
                ((x.reshape(-1, 3) - old_position) @ old_rotation @ rotation.T + position).ravel()
            ]
        track = Track(model, self.p, self.prior, self._block_rows)
        track.advance([row.poses], guesses)
        marker_samples = [reading.values for reading in row.readings if not reading.of]
        first = marker_samples[0] if marker_samples else np.full((len(self.names), 3), np.nan)
        self.model = model.placed(first, track.blocks[0].kept[0].x)
        if self.model is not model:
            self._bounds()
            places = self.model.collocation.guess_p[model.collocation.nq :]
            self.p = np.concatenate([self.p[: model.collocation.nq], places])
            self.prior = LeastSquares.none(self.model.size)
            track = Track(self.model, self.p, self.prior, self._block_rows)
            track.advance([row.poses], guesses)
        self.track = track
        self._joined = JoinedPasses.of(track, None)

    def _begin_anew(self) -> None:
        """Keep the information so far as a prior, and wait for a new start."""
        if self.track is not None:
            self.prior = self.track.measured
        self.track = self.again = None
        self.log.clear()
        self.intake.begin_anew()
        self.counts["begun anew"] += 1

    # Estimates --------------------------------------------------------------------------------

    @property
    def moved(self) -> float:
        """Largest distance of the estimate from the linearisation points, in standard errors.

        Infinite if there is no pass, or if it failed.
        """
        if self.track is None or self.track.failed:
            return np.inf
        return self._apart(self.track, self.p, self._joined.points)

    def _apart(self, track: Track, p: Array, points: Sequence[Array]) -> float:
        """Return the largest distance of p from some points, in the standard errors of a pass."""
        nq = self.model.collocation.nq
        distances = np.abs(np.array(points) - self.model.flat(p))[:, :nq]
        return float(np.max(distances / track.information.errors[:nq], initial=0.0))

    def _estimate(self) -> None:
        """Update the estimate p from the joint information of both passes."""
        if self.track is not None and not self.track.failed:
            self._joined = JoinedPasses.of(self.track, self.again)
            self.p = self._best(self.track, self._joined.information)

    def _best(self, track: Track, known: LeastSquares) -> Array:
        """Return the minimum of a quadratic loss within bounds and the trust region about a
        pass.
        """
        reach = self._trust * self.model.collocation.reach_p
        low = np.maximum(self.lower, track.p - reach)
        high = np.minimum(self.upper, track.p + reach)
        best = known.best(self.model.flat(low), self.model.flat(high))
        return np.clip(self.model.curved(best), low, high)

    def _next(self, track: Track) -> Array:
        """Return the next linearisation point.

        Poorly determined parameters stay near their last value.
        """
        size = self.model.size
        samples = len(self.log) / self.model.substeps
        deviation = STAY * max(1.0, samples / SEEN)
        slopes = np.diag(1 / (deviation * self.model.collocation.reach_p * track.sweep.rates))
        information = self._joined.information.add(np.zeros(size), slopes, track.sweep.flat)
        return self._best(track, information)

    def _known(self, t_s: float) -> tuple[Mapping[str, Estimate], Trust]:
        """Return estimates and verdict at a time."""
        code = ""
        if self.track is None:
            code = "solve/no-start"
        elif self.track.failed:
            code = "solve/not-simulable"
        elif self.intake.is_lost(t_s):
            code = "solve/grasp-lost"
        elif self.search is not None:
            code = "solve/seeking"
        grave = concerned(bool(code), True, code)
        if self.track is None or self.track.failed:
            values = self.model.collocation.parameters.values(self.p[: self.model.collocation.nq])
            estimates_only = {name: Estimate(v) for name, v in values.items() if not is_mode(name)}
            return estimates_only, Trust.of(grave)
        if self.counts["looked"] % LOOK_EVERY == 0:
            self.scatter = self._joined.scatter(self.model.flat(self.p))
        self.counts["looked"] += 1
        estimates = self._estimates_at(self._joined.information, self.p)
        grave += data_concerns(self.scatter, self.counts, self.samples)
        grave += estimate_concerns(estimates, self.moved)
        return estimates, Trust.of(grave)

    def _estimates_at(self, known: LeastSquares, p: Array) -> dict[str, Estimate]:
        """Return the estimates with intervals from given information, at p."""
        collocation = self.model.collocation
        nq = self.model.collocation.nq
        transformed = self.model.flat(p)
        parameter_count = self.model.size
        factor, quantile = widened(known, transformed, parameter_count, self.scatter)
        rates = self.model.rates(transformed)[:nq]
        of_q = factor * known.covariance()[:nq, :nq] / np.outer(rates, rates)
        bounded = ((p - self.lower < AT_BOUND) | (self.upper - p < AT_BOUND))[:nq]
        quantiles = np.full(nq, quantile)
        return user_estimates(collocation.parameters, p[:nq], of_q, bounded, quantiles)

    # Passing again ----------------------------------------------------------------------------

    def _pass_again(self, began: float, notes: list[str], done: int = 0) -> int:
        """Continue or start a second pass within the rest of the budget.

        Parameters
        ----------
        began : float
            Time at which the frame began.
        notes : list of str
            Extended in place.
        done : int
            Number of rows that were already computed again in this frame.

        Returns
        -------
        int
            Number of rows computed again in this frame.
        """
        while self.track is not None:
            pass_began = self.clock()
            if self.again is None and self._left(done, pass_began - began + self.budget.turn_s):
                self.again = self._wanted(self.track, notes)
                self.budget.turned(self.clock() - pass_began)
            again = self.again
            if again is None:
                break
            if not done and again.base is not None:
                self._turn(self.track, again, began, TURN)
            affordable = min(self._left(done, self.clock() - began), again.left)
            if not affordable:
                break
            done += self._advance(again, affordable, notes)
        return done

    def _catch_up(self, began: float, notes: list[str]) -> int:
        """Complete a second pass that lags by few rows before new rows come.

        Return the number of rows.
        """
        again = self.again
        if again is None or again.base is None:
            return 0
        lag = len(self.log) - again.rows
        elapsed_s = self.clock() - began
        if lag > min(again.left, self._left(0, elapsed_s + self.budget.frame_s)):
            return 0
        return self._advance(again, lag, notes)

    def _advance(self, again: Track, count: int, notes: list[str]) -> int:
        """Continue a second pass by some rows and judge it if it has caught up.

        Return the number of rows.
        """
        before = self.clock()
        first_row = again.rows
        try:
            again.again(self.log[first_row : first_row + count])
        except SimulationError:
            again.failed = True
        self.budget.took(count, self.clock() - before)
        if self.search is not None and not self.search.done:
            if again.failed or again.rows >= min(self.search.rows, len(self.log)):
                self.search.compare(again)
                self.again = None
        elif (again.failed or again.rows == len(self.log)) and self.track is not None:
            self._judge(self.track, again, notes)
        return again.rows - first_row

    def _left(self, done: int, elapsed_s: float) -> int:
        """Return the number of rows that fit into the rest of the budget."""
        if self.rows is not None:
            return self.rows - done
        return self.budget.rows(self.budget_s - elapsed_s)

    def _wanted(self, track: Track, notes: list[str]) -> Track | None:
        """Return a new second pass if one is needed, otherwise None."""
        search = self.search
        at_start = track.start[0] is None
        if search is None and track.failed and at_start:
            search = self.search = self._search()
            notes.append("searching for initial values over a range of stiffness")
        p = self.p
        base = track
        if search is not None:
            if not search.done and (len(self.log) < search.rows or not at_start):
                return None
            p = search.best if search.done else search.next()
            base = None
            if p is None:
                self.search = None
                notes.append("found no initial values over a range of stiffness")
                return None
        elif track.failed:
            return None
        else:
            p = self._next(track)
            if self._apart(track, p, track.points) <= MOVED and not track.sweep.is_rough:
                return None
        return Track(self.model, p, track.prior, self._block_rows, base)

    def _turn(self, track: Track, turned: Track, began: float, far: float) -> None:
        """Move the linearisation point of a pass to the estimate if it is far and there is time.

        Parameters
        ----------
        track : Track
            First pass, which gives the standard errors.
        turned : Track
            Pass to change.
        began : float
            Time at which the frame began.
        far : float
            Distance in standard errors.
        """
        current_point = [turned.sweep.flat]
        if (
            turned.rows < turned.turned + TOGETHER
            or self._apart(track, self.p, current_point) <= far
        ):
            return
        before = self.clock()
        if self.rows is None and not self._left(0, before - began + self.budget.turn_s):
            return
        p = self._next(track)
        if self._apart(track, p, current_point) > far:
            turned.turn(p)
            self.budget.turned(self.clock() - before)

    def _judge(self, track: Track, again: Track, notes: list[str]) -> None:
        """Replace the first pass by a second one that has caught up, or reject it."""
        self.again = None
        was_search = self.search is not None
        self.search = None
        points = [*track.points, again.points[0]]
        expected = max(track.information.loss(point) for point in points)
        # Of a pass that turned the sum of squares is not that of a simulation.
        is_near = track.turned and self._apart(track, track.p, again.points) <= MOVED
        fits = track.failed or is_near or again.loss <= TIMES * expected + SLACK
        if not again.failed and fits:
            again.base = None
            self.track = again
            self._trust = TRUST if was_search else min(2 * self._trust, WIDEST)
            self._rejected = 0
            if was_search:
                notes.append("restarted from another stiffness")
            self.scatter = JoinedPasses.of(again, None).scatter(again.sweep.flat)
        else:
            reach = self.model.collocation.reach_p
            length = float(np.abs((again.p - track.p) / reach).max())
            self._trust = max(SHRINK * length, 1e-6)
            self._rejected += 1
            is_stuck = self._rejected >= REJECTED and self.scatter.rms > GROSS_MISFIT
            if (
                is_stuck
                and not was_search
                and not self.counts["searched"]
                and track.start[0] is None
            ):
                self.counts["searched"] += 1
                self.search = self._search()
                notes.append(
                    "the estimation does not converge: searching for other initial values over a "
                    "range of stiffness"
                )
        self._estimate()

    def _shorten(self) -> None:
        """Remove the oldest rows if the window is full."""
        if self.track is None:
            return
        most = self._blocks * self._block_rows
        if self.again is not None and len(self.log) > 2 * most:
            self.again = None
        if self.track.failed and len(self.log) > 2 * most:
            self._begin_anew()
        while self.again is None and self.track is not None and not self.track.failed:
            if len(self.log) <= most:
                break
            del self.log[: self.track.drop_oldest()]
