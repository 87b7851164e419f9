"""Parameters while the recording is being made: one frame in, one estimate out.

All frames are linearised near one p; the estimate is the Gauss–Newton step from there, within
bounds and a trust region. When it has moved, what the window holds is passed again at the
estimate, in what is left of each frame's time, until that pass has caught up: it takes the place
of the first where the sum of squares is less, and else the trust region shrinks. So each pass is
an iteration of the reduced-space method on all that has come, and what they converge to is the
batch's answer.

The estimate does not wait for that: both passes turn to where it is now, and go on from a state
that has moved along its slopes, as in an extended Kalman filter; another pass then follows.
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

# Standard deviation of a prior about the last pass for where the next one is, until many samples
# tell of it.
STAY = 0.5
# Estimates this far from where all is linearised, in standard errors, begin another pass.
MOVED = 0.1
# Passes turn where the estimate is so far from them: one that is catching up, and the first.
TURN, TURN_FIRST = 1.0, 3.0
# First and widest trust region, see `methods.search`, and what a rejected step leaves of it.
TRUST, WIDEST, SHRINK = 1.0, 2.0, 0.25
# A pass is accepted where the sum of squares is no more than so many times, and this above, what it
# was or what was to be expected of it: rows that came since then are fitted by the next.
TIMES, SLACK = 1.25, 1.0
# Share of the time between samples that a frame may take, and blocks that a window has.
SHARE, BLOCKS = 0.8, 12
# After so many passes that were rejected in a row another start is sought.
REJECTED = 3
# So often the window is passed at most when frames have ended.
PASSES = 50
# Times that rows are timed before frames come.
TIMED = 3
# Residuals this many times the usual are no noise. So many sizes of the body from where its grasp
# carries it there is nothing of it, whatever it is made of, nor does a grasp go so far in a sample.
JUMP, FAR = 6.0, 5.0
# Frames between two looks at all residuals.
LOOK_EVERY = 5


@dataclass(frozen=True)
class LiveOptions(Options):
    """What live estimation may take.

    Attributes
    ----------
    budget_s : float, optional
        Time of a frame; 80 % of the time between samples by default. The frame itself is taken
        whatever it costs.
    window_s : float
        Frames that are passed again when the estimate moves.
    rows : int, optional
        Rows of the grid that are passed again a frame, whatever time that takes: estimates are the
        same on any machine then.
    """

    name: ClassVar[str] = "live"

    budget_s: Positive | None = None
    window_s: Positive = 3.0
    rows: AtLeastOne | None = None


@dataclass(frozen=True, eq=False)
class Update:
    """What is known after a frame.

    Attributes
    ----------
    t_s : float
        Of the frame.
    estimates : by name, value, standard error and 95 % interval
    trust : Trust
    marker_rms_m : float
        Distance of the markers of this frame from where the estimate has them; NaN without any.
    notes : tuple of str
        What was odd about the frame, or happened now.
    latency_s : float
        Time the frame took.
    relinearised : int
        Rows that were passed again.
    """

    t_s: float
    estimates: Mapping[str, Estimate]
    trust: Trust
    marker_rms_m: float
    notes: tuple[str, ...]
    latency_s: float
    relinearised: int

    def __repr__(self) -> str:
        found = ", ".join(f"{name} = {each.value:.4g}" for name, each in self.estimates.items())
        return f"Update(t = {self.t_s:.4g} s: {found}; {self.trust.verdict})"


def _require_phases(problem: Problem) -> None:
    """Refuse a two-phase field without phases, which no stream can search for.

    Raises
    ------
    InputError
        If there is one.
    """
    for name, modes in problem.two_phase_fields.items():
        if not modes.has_phases:
            raise InputError(
                f"the phases of {name} are not known, and are not searched for while live; "
                "expected the problem of an answer, `cs.run(problem).problem`, or prior = 'smooth'"
            )


class Estimator:
    """Estimates a problem's parameters from frames, one after another.

    Parameters
    ----------
    problem : Problem
        One experiment; its recording only says which grasps and markers there are, and how many
        samples a second.
    options : LiveOptions
    clock : callable
        Seconds that the budget is taken from; `time.thread_time` does not count what others take.

    Raises
    ------
    InputError
        Where the problem has what cannot be live.
    """

    def __init__(
        self,
        problem: Problem,
        options: LiveOptions = LiveOptions(),
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.problem, self.options, self.clock = problem, options, clock
        _require_phases(problem)
        self.model = Model.of(problem)
        model, self.names = self.model, self.model.experiment.markers.names
        far_m, around = FAR * model.size_m, model.samples_around
        self._reach_m = far_m + float(np.linalg.norm(model.segment.body.nodes_m.mean(axis=0)))
        arounds = [each.around for each in model.instruments]
        self.intake = Intake(model.interval_s, model.substeps, around, far_m, arounds)
        self.counts, self.samples = self.intake.counts, 0
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
        self._trust, self._rejected, self.budget = TRUST, 0, Budget()
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
        """Take a frame.

        Parameters
        ----------
        t_s : float
        pose : 4×4 matrix, (position, quaternion x y z w), or None
            Of the grasp that moves, None where it is not seen; of several by number from "1" on,
            or by the order of the problem.
        markers : (M, 3) array, or mapping of name to (3,)
            NaN, or left out, where missing.
        wrench : (6,) or (3,) array, optional
            What the grasp gives: fx, fy, fz [N], tx, ty, tz [N m], at the time of the frame; or a
            mapping with ``t_s`` and ``values``, or a list of such; of several sensors by the number
            of their grasp. NaN, or None, where missing.
        readings : mapping of name to numbers, optional
            Of readings of one's own, at the time of the frame; or a mapping with ``t_s`` and
            ``values``, or a list of such. NaN, or None, where missing.

        Raises
        ------
        InputError
            For values that are no frame; the estimator is as it was before.
        """
        poses = as_pose(pose, self.model.moved_grasps + 1)
        tracks = as_tracks(markers, self.names)
        gauges = self.model.experiment.readings
        told = as_readings(readings, gauges, as_time(t_s))
        told += as_wrenches(wrench, self.model.wrenches, len(gauges), as_time(t_s))
        return self.take(Frame(as_time(t_s), poses, tracks, wrench is not None, told))

    @one_blas_thread()
    def take(self, frame: Frame) -> Update:
        """Take a frame that was read."""
        began = self.clock()
        frame, notes = self._of_frame(frame)
        if self.intake.is_lost(frame.t_s):
            if frame.pose is None:
                notes.append("the grasp is lost: nothing is read until its pose is back")
            else:
                self._begin_anew()
                notes.append("nothing was seen for long: begun anew, as if at rest here")
        rows, readings, said = self.intake.take(frame.t_s, frame.pose, frame.tracks_m, frame.told)
        notes += said
        self.budget.forget()
        caught = self._catch_up(began, notes)
        squares, before = [], self.clock()
        while rows:
            done, said = self._go_on(rows, squares)
            notes, rows = notes + said, rows[done:]
        notes += self._read(readings, squares)
        self._estimate()
        if self.track is not None and not self.track.failed and self.search is None:
            self._turn(self.track, self.track, began, TURN_FIRST)
        self.budget.frame_s = self.clock() - before
        done = self._pass_again(began, notes, caught)
        before = self.clock()
        self._shorten()
        near = np.concatenate([*squares, np.zeros(0)])
        rms_m = float(np.sqrt(near.mean())) if len(near) else float("nan")
        estimates, trust = self._known(frame.t_s)
        self.budget.ended(self.clock() - before)
        latency_s = self.clock() - began
        self.last = Update(frame.t_s, estimates, trust, rms_m, tuple(notes), latency_s, done)
        return self.last

    @one_blas_thread()
    def settle(self) -> Update | None:
        """What all frames say together, however long that takes; for when they have ended.

        Where the window holds the recording, that is the batch's run of it. Else, and where
        markers were seen between samples, the window is passed again until the estimate stays. The
        update is that of the last frame, with the distance of all markers where there was a run;
        None where there was no frame.
        """
        began, notes = self.clock(), ["settled after the last frame"]
        if self.last is None or self.track is None:
            return self.last
        last, found = self.last, self._run_of_all(self.track, notes)
        if found is None:
            rows = self._pass_to_the_end(began, notes)
            estimates, trust = self._known(last.t_s)
        else:
            rows = len(found.solution.history) * len(self.log)
            estimates = {name: found.estimates[name] for name in last.estimates}
            left_out = Trust.of(data_concerns(Scatter(), self.counts, self.samples))
            trust = found.trust.joined(left_out)
            last = replace(last, marker_rms_m=found.solution.rms_m)
        return replace(
            last,
            estimates=estimates,
            trust=trust,
            notes=tuple(notes),
            latency_s=self.clock() - began,
            relinearised=rows,
        )

    def _run_of_all(self, track: Track, notes: list[str]) -> Run | None:
        """The batch's run, None where the window does not hold what it needs."""
        whole = None if track.prior.rows else recording_of(self.model, self.intake, self.log)
        try:
            return None if whole is None else solved(self.problem, whole)
        except InputError as error:
            notes.append(f"the recording cannot be solved as a whole: {error.message}")
            return None

    def _pass_to_the_end(self, began: float, notes: list[str]) -> int:
        hurried, self.rows = self.rows, PASSES * len(self.log)
        try:
            return self._pass_again(began, notes)
        finally:
            self.rows = hurried

    def _of_frame(self, frame: Frame) -> tuple[Frame, list[str]]:
        """What of a frame can be read."""
        notes = []
        if frame.has_wrench and not self.model.wrenches:
            self.counts["with a wrench"] += 1
            if self.counts["with a wrench"] == 1:
                notes.append("wrenches are left out: no grasp of the problem has a sensor")
        if frame.pose is not None:
            self._held_m = frame.pose[0]
        away_m = np.linalg.norm(frame.tracks_m[:, None] - self._held_m, axis=2)
        self.samples += int(np.isfinite(frame.tracks_m[:, 0]).sum())
        nowhere = (away_m > self._reach_m).all(axis=1)
        if nowhere.any():
            notes.append(self._left_out(nowhere))
            frame = replace(frame, tracks_m=np.where(nowhere[:, None], np.nan, frame.tracks_m))
        return frame, notes

    def _left_out(self, wild: NDArray[np.bool_]) -> str:
        """Count samples (M,) that are left out."""
        self.counts["wild"] += int(wild.sum())
        names = ", ".join(self.names[m] for m in np.flatnonzero(wild))
        return f"left out, far from where they can be: {names}"

    def _go_on(self, rows: Sequence[LoggedRow], squares: list[Array]) -> tuple[int, list[str]]:
        """Take rows and log them, as many as it does at once; how many, and what is said."""
        done, said, track = 1, [], self.track
        try:
            if track is None:
                self._begin(rows[0])
            elif not track.failed:
                done = track.advance([row.poses for row in rows[: track.together]])
        except SimulationError as error:
            if track is None:
                self.intake.begin_anew()
                return 1, [f"there is no start: {error}"]
            track.failed = True
            said = [f"the body cannot be simulated with these parameters: {error}"]
        for k, row in enumerate(rows[:done], 1):
            self.log.append(LoggedRow(row.poses, []))
            said += self._read(row.readings, squares, done - k)
        return done, said

    def _read(self, readings: Sequence[Sample], squares: list[Array], rows: int = 0) -> list[str]:
        """Take what is read so many rows before the last one, without samples that jump."""
        track = self.track
        if track is None:
            return []
        notes, sigma_m = [], self.model.segment.experiment.markers.sigma_m[:, None]
        if track.failed:
            self.log[-1].readings.extend(readings)
            return notes
        each_says = track.sweep.linearised([(reading, rows) for reading in readings])
        for reading, said in zip(readings, each_says, strict=True):
            if not reading.of:
                here = said.at(self.model.flat(self.p))
                wild = self._wild(here)
                if wild.any():
                    notes.append(self._left_out(wild))
                    seen = np.where(wild[:, None], np.nan, reading.values)
                    reading = reading._replace(values=seen)
                    said.at_zero[wild] = here[wild] = np.nan
                near = np.sum((here * sigma_m) ** 2, axis=1)
                squares.append(near[np.isfinite(near)])
            self.log[-1].readings.append(reading)
        track.read(each_says)
        return notes

    def _wild(self, residual: Array) -> NDArray[np.bool_]:
        """(M,) samples that the estimate cannot explain while it explains the others."""
        if self.moved > UNSETTLED or not 0 < self.scatter.rms < GROSS_MISFIT:
            return np.zeros(len(residual), dtype=bool)
        length = np.sqrt(np.sum(residual**2, axis=1) / 3)
        wild = length > JUMP * max(1.0, self.scatter.rms)
        if wild.sum() > np.isfinite(length).sum() / 2:
            return np.zeros_like(wild)
        return wild

    # Beginnings -------------------------------------------------------------------------------

    def _bounds(self) -> None:
        self.lower, self.upper = self.model.collocation.bounds_p

    def _search(self) -> Search:
        return Search(self.model, self.p[self.model.collocation.nq :])

    def _warmed_up(self) -> tuple[Poses, Array] | None:
        """Have the kernels compiled before frames come; the body at rest, and where it is held."""
        poses = self.model.first_poses
        moved = tuple(poses[k] for k in self.model.moved_grasps)
        nowhere = np.full((len(self.names), 3), np.nan)
        nowhere[0] = 0.0
        try:
            trial = Track(self.model, self.p, self.prior, self._block_rows)
            row = LoggedRow(moved, [Sample(0.0, nowhere)])
            for _ in range(self.model.rows + 2):
                trial.again([row])
        except SimulationError:
            return None
        self._estimates_at(trial.information, self.p)
        self.budget = self._timed(trial, row)
        return poses, trial.blocks[0].kept[0].x

    def _timed(self, trial: Track, row: LoggedRow) -> Budget:
        """How long rows take that are passed again, the shortest times."""
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
        model, guesses = self.model, []
        poses = model.poses_of(row.poses)
        if self._rest is not None and len(poses) == 1:
            (was_turned, was_at), x = self._rest[0][0], self._rest[1]
            (turned, at) = poses[0]
            guesses = [((x.reshape(-1, 3) - was_at) @ was_turned @ turned.T + at).ravel()]
        track = Track(model, self.p, self.prior, self._block_rows)
        track.advance([row.poses], guesses)
        seen = [reading.values for reading in row.readings if not reading.of]
        first = seen[0] if seen else np.full((len(self.names), 3), np.nan)
        self.model = model.placed(first, track.blocks[0].kept[0].x)
        if self.model is not model:
            self._bounds()
            places = self.model.collocation.guess_p[model.collocation.nq :]
            self.p = np.concatenate([self.p[: model.collocation.nq], places])
            self.prior = LeastSquares.none(self.model.size)
            track = Track(self.model, self.p, self.prior, self._block_rows)
            track.advance([row.poses], guesses)
        self.track, self._joined = track, JoinedPasses.of(track, None)

    def _begin_anew(self) -> None:
        """Keep what is known, and wait for a start."""
        if self.track is not None:
            self.prior = self.track.measured
        self.track = self.again = None
        self.log.clear()
        self.intake.begin_anew()
        self.counts["begun anew"] += 1

    # Estimates --------------------------------------------------------------------------------

    @property
    def moved(self) -> float:
        """How far the estimate is from where all is linearised, in standard errors."""
        if self.track is None or self.track.failed:
            return np.inf
        return self._apart(self.track, self.p, self._joined.points)

    def _apart(self, track: Track, p: Array, points: Sequence[Array]) -> float:
        """How far p is at most from points, in the standard errors of a pass."""
        nq = self.model.collocation.nq
        apart = np.abs(np.array(points) - self.model.flat(p))[:, :nq]
        return float(np.max(apart / track.information.errors[:nq], initial=0.0))

    def _estimate(self) -> None:
        if self.track is not None and not self.track.failed:
            self._joined = JoinedPasses.of(self.track, self.again)
            self.p = self._best(self.track, self._joined.information)

    def _best(self, track: Track, known: LeastSquares) -> Array:
        reach = self._trust * self.model.collocation.reach_p
        low, high = np.maximum(self.lower, track.p - reach), np.minimum(self.upper, track.p + reach)
        best = known.best(self.model.flat(low), self.model.flat(high))
        return np.clip(self.model.curved(best), low, high)

    def _next(self, track: Track) -> Array:
        """Where to pass again: what is hardly known yet stays near where it was."""
        size, samples = self.model.size, len(self.log) / self.model.substeps
        stay = STAY * max(1.0, samples / SEEN)
        slopes = np.diag(1 / (stay * self.model.collocation.reach_p * track.sweep.rates))
        known = self._joined.information.add(np.zeros(size), slopes, track.sweep.flat)
        return self._best(track, known)

    def _known(self, t_s: float) -> tuple[Mapping[str, Estimate], Trust]:
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
            told = {name: Estimate(v) for name, v in values.items() if not is_mode(name)}
            return told, Trust.of(grave)
        if self.counts["looked"] % LOOK_EVERY == 0:
            self.scatter = self._joined.scatter(self.model.flat(self.p))
        self.counts["looked"] += 1
        estimates = self._estimates_at(self._joined.information, self.p)
        grave += data_concerns(self.scatter, self.counts, self.samples)
        grave += estimate_concerns(estimates, self.moved)
        return estimates, Trust.of(grave)

    def _estimates_at(self, known: LeastSquares, p: Array) -> dict[str, Estimate]:
        collocation, nq = self.model.collocation, self.model.collocation.nq
        flat, fitted = self.model.flat(p), self.model.size
        factor, quantile = widened(known, flat, fitted, self.scatter)
        rates = self.model.rates(flat)[:nq]
        of_q = factor * known.covariance()[:nq, :nq] / np.outer(rates, rates)
        bounded = ((p - self.lower < AT_BOUND) | (self.upper - p < AT_BOUND))[:nq]
        quantiles = np.full(nq, quantile)
        return user_estimates(collocation.parameters, p[:nq], of_q, bounded, quantiles)

    # Passing again ----------------------------------------------------------------------------

    def _pass_again(self, began: float, notes: list[str], done: int = 0) -> int:
        """Go on with a pass in what is left of the budget; how many rows are done then."""
        while self.track is not None:
            begins = self.clock()
            if self.again is None and self._left(done, begins - began + self.budget.turn_s):
                self.again = self._wanted(self.track, notes)
                self.budget.turned(self.clock() - begins)
            again = self.again
            if again is None:
                break
            if not done and again.base is not None:
                self._turn(self.track, again, began, TURN)
            left = min(self._left(done, self.clock() - began), again.left)
            if not left:
                break
            done += self._advance(again, left, notes)
        return done

    def _catch_up(self, began: float, notes: list[str]) -> int:
        """End a pass that lags by few rows before others come: they are then rows of it."""
        again = self.again
        if again is None or again.base is None:
            return 0
        lag = len(self.log) - again.rows
        elapsed_s = self.clock() - began
        if lag > min(again.left, self._left(0, elapsed_s + self.budget.frame_s)):
            return 0
        return self._advance(again, lag, notes)

    def _advance(self, again: Track, count: int, notes: list[str]) -> int:
        """Go on with a pass by rows, and judge it where it has caught up; how many it did."""
        before, were = self.clock(), again.rows
        try:
            again.again(self.log[were : were + count])
        except SimulationError:
            again.failed = True
        self.budget.took(count, self.clock() - before)
        if self.search is not None and not self.search.done:
            if again.failed or again.rows >= min(self.search.rows, len(self.log)):
                self.search.compare(again)
                self.again = None
        elif (again.failed or again.rows == len(self.log)) and self.track is not None:
            self._judge(self.track, again, notes)
        return again.rows - were

    def _left(self, done: int, elapsed_s: float) -> int:
        """Rows that there is time for."""
        if self.rows is not None:
            return self.rows - done
        return self.budget.rows(self.budget_s - elapsed_s)

    def _wanted(self, track: Track, notes: list[str]) -> Track | None:
        """Begin a pass where one is wanted."""
        search = self.search
        at_start = track.start[0] is None
        if search is None and track.failed and at_start:
            search = self.search = self._search()
            notes.append("a start is sought among stiffnesses")
        p, base = self.p, track
        if search is not None:
            if not search.done and (len(self.log) < search.rows or not at_start):
                return None
            p, base = search.best if search.done else search.next(), None
            if p is None:
                self.search = None
                notes.append("no start was found among stiffnesses")
                return None
        elif track.failed:
            return None
        else:
            p = self._next(track)
            if self._apart(track, p, track.points) <= MOVED and not track.sweep.is_rough:
                return None
        return Track(self.model, p, track.prior, self._block_rows, base)

    def _turn(self, track: Track, turned: Track, began: float, far: float) -> None:
        """Go on with a pass where the estimate is now, if that is far, and time is left then."""
        here = [turned.sweep.flat]
        if turned.rows < turned.turned + TOGETHER or self._apart(track, self.p, here) <= far:
            return
        before = self.clock()
        if self.rows is None and not self._left(0, before - began + self.budget.turn_s):
            return
        p = self._next(track)
        if self._apart(track, p, here) > far:
            turned.turn(p)
            self.budget.turned(self.clock() - before)

    def _judge(self, track: Track, again: Track, notes: list[str]) -> None:
        """Take a pass that has caught up in place of the first, or not."""
        self.again = None
        sought, self.search = self.search is not None, None
        points = [*track.points, again.points[0]]
        expected = max(track.information.loss(point) for point in points)
        # Of a pass that turned the sum of squares is not that of a simulation.
        near = track.turned and self._apart(track, track.p, again.points) <= MOVED
        fits = track.failed or near or again.loss <= TIMES * expected + SLACK
        if not again.failed and fits:
            again.base, self.track = None, again
            self._trust = TRUST if sought else min(2 * self._trust, WIDEST)
            self._rejected = 0
            if sought:
                notes.append("begun from another stiffness")
            self.scatter = JoinedPasses.of(again, None).scatter(again.sweep.flat)
        else:
            reach = self.model.collocation.reach_p
            length = float(np.abs((again.p - track.p) / reach).max())
            self._trust = max(SHRINK * length, 1e-6)
            self._rejected += 1
            lost = self._rejected >= REJECTED and self.scatter.rms > GROSS_MISFIT
            if lost and not sought and not self.counts["searched"] and track.start[0] is None:
                self.counts["searched"] += 1
                self.search = self._search()
                notes.append("the search is stuck: another start is sought among stiffnesses")
        self._estimate()

    def _shorten(self) -> None:
        """Let the oldest rows leave when the window is full."""
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
