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
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...common.array_types import Array
from ...common.validated_classes import validated
from ...common.validated_types import AtLeastOne, Positive
from ...errors import InputError, SimulationError
from ...features.image_tracks.places import TrackedPlaces
from ...features.image_tracks.tracks import ImageTracks
from ...pipeline import Run
from ...problem import Problem
from ...program.streaming import LoggedRow, Sample, SquareRootInformation, one_blas_thread
from ...recording.poses import Poses
from ...statistics.assessment import GROSS_MISFIT, Assessment
from ...statistics.concerns import concern_if
from ...statistics.estimates import Estimate, user_estimates
from ...statistics.linearised import AT_BOUND
from .frame_buffer import LARGEST_GAP, TIME_TOLERANCE_SAMPLES, BufferedFrame, FrameBuffer
from .frames import (
    Frame,
    Pose,
    parse_custom_readings,
    parse_markers,
    parse_pose,
    parse_time,
    parse_wrenches,
)
from .initial_rest import InitialRest
from .model import model_from_problem, recording_from_log, solve_recording
from .stiffness_search import TRIAL_SAMPLES, StiffnessSearch
from .time_budget import TimeBudget
from .trust import (
    LARGEST_SETTLED_DISTANCE,
    ResidualScatter,
    data_concerns,
    estimate_concerns,
    variance_factor,
)
from .window_pass import CombinedPasses, WindowPass

# Standard deviation, in steps of the trust region, of a prior that keeps the next linearisation
# point near the last one until many samples are available.
POINT_PRIOR_DEVIATION = 0.5
# Distance of the estimate from the linearisation point, in standard errors, that starts a new pass.
REPEAT_DISTANCE = 0.1
# Distance, in standard errors, at which a pass that is catching up changes its linearisation point.
RELINEARISE_DISTANCE = 1.0
# The same distance for the first pass, which receives the frames.
RELINEARISE_DISTANCE_FIRST = 3.0
# Largest number of passes that begin in one frame: impacts may let each pass ask for another one.
MOST_PASSES = 100
# Initial radius of the trust region, see `methods.minimise`.
INITIAL_RADIUS = 1.0
# Largest radius of the trust region.
LARGEST_RADIUS = 2.0
# Factor of the radius after a rejected step.
RADIUS_REDUCTION = 0.25
# A pass is accepted if its sum of squares is at most TIMES · expected + SLACK: rows that arrived in
# the meantime are fitted by the next pass.
ACCEPTED_RATIO = 1.25
# Slack of this sum of squares, for passes of few rows.
ACCEPTED_EXCESS = 1.0
# Default of the computing time of a frame, as a fraction of the time between samples.
BUDGET_FRACTION = 0.8
# Number of blocks of a window.
WINDOW_BLOCKS = 12
# Number of consecutively rejected passes after which other initial values are searched for.
LARGEST_REJECTIONS = 3
# Largest number of passes over the window after the last frame.
FINAL_PASSES = 50
# Number of timing measurements before the first frame.
TIMING_REPETITIONS = 3
# Ratio of a residual to the usual one above which a sample is an outlier.
OUTLIER_RATIO = 6.0
# Distance, in body sizes, from the grasp beyond which no marker can be, and beyond which no grasp
# moves between two samples.
REACH_BODY_SIZES = 5.0
# Number of frames between two evaluations of all residuals.
SCATTER_INTERVAL_FRAMES = 5


@validated
class LiveOptions:
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


# Default options.
USUAL_OPTIONS = LiveOptions()


@dataclass(frozen=True, eq=False)
class LiveUpdate:
    """Result after a frame.

    Attributes
    ----------
    t_s : float
        Time of the frame.
    estimates : mapping of name to Estimate
        Value, standard error and 95 % interval of each parameter.
    trust : Assessment
        Verdict with its reasons.
    marker_rms_m : float
        Root mean square distance of this frame's markers from the estimate's; NaN without markers.
    notes : tuple of str
        Irregularities of the frame, and events.
    latency_s : float
        Computing time of the frame.
    relinearised : int
        Number of rows that were computed again.
    marker_distances_m : (M,) array
        Distance of each marker of the last sample from the estimate's; NaN where missing, empty if
        there is no sample.
    pixel_rms : float
        Root mean square of a coordinate of the residuals of image tracks [pixels]; NaN without any.
    """

    t_s: float
    estimates: Mapping[str, Estimate]
    trust: Assessment
    marker_rms_m: float
    notes: tuple[str, ...]
    latency_s: float
    relinearised: int
    marker_distances_m: Array = field(default_factory=lambda: np.zeros(0))
    pixel_rms: float = float("nan")

    def __repr__(self) -> str:
        values = ", ".join(f"{name} = {each.value:.4g}" for name, each in self.estimates.items())
        return f"Update(t = {self.t_s:.4g} s: {values}; {self.trust.verdict})"


class LiveEstimator:
    """Estimator of a problem's parameters from frames, one after another.

    Parameters
    ----------
    problem : Problem
        One experiment; of its recording only the grasps, the sampling rate, and what its markers,
        cameras and sensors are, are used.
    options : LiveOptions
        Window and computing time.
    clock : callable
        Function that returns a time [s] for the budget; `time.thread_time` excludes the time of
        other processes.

    Attributes
    ----------
    p : (P,)
        Current estimate of the parameters, in the solver's coordinates: material parameters, then
        nuisance parameters.
    lower, upper : (P,)
        Bounds of p.
    counts : Counter
        Numbers of irregularities of frames, by kind.
    samples : int
        Number of marker positions measured so far, each marker of each frame counted once.
    log : list of LoggedRow
        Rows in the window of the first pass, with their samples.
    first_pass, second_pass : WindowPass or None
        Pass that receives the frames, None before the first row; and the pass that repeats the
        window, None if there is none.
    search : StiffnessSearch or None
        Search for initial values that goes on; None if there is none.
    last : LiveUpdate or None
        Result after the last frame; None before the first one.

    Raises
    ------
    InputError
        If the problem has a feature that live estimation does not support.
    """

    def __init__(
        self,
        problem: Problem,
        options: LiveOptions = USUAL_OPTIONS,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.problem = problem
        self.options = options
        self.clock = clock
        self.model = model_from_problem(problem)
        model = self.model
        self.names = self.model.experiment.markers.names
        most_motion_m = REACH_BODY_SIZES * model.body_size_m
        neighbours = model.neighbouring_samples
        self._reach_m = most_motion_m + float(
            np.linalg.norm(model.transcription.body.nodes_m.mean(axis=0))
        )
        stencils = [each.stencil for each in model.instruments]
        self.intake = FrameBuffer(
            model.experiment.timestep_s,
            model.collocation.substeps,
            neighbouring_samples=neighbours,
            largest_jump_m=most_motion_m,
            instruments=stencils,
        )
        self.counts = self.intake.counts
        self._initial_rest = InitialRest(model.body_size_m, model.experiment.markers.sigma_m)
        self.samples = 0
        self.budget_s = options.budget_s or BUDGET_FRACTION * model.experiment.timestep_s
        self.rows = options.rows
        samples = max(
            LARGEST_GAP, round(options.window_s / model.experiment.timestep_s / WINDOW_BLOCKS)
        )
        self._block_rows = samples * model.collocation.substeps
        self._blocks = max(2, round(options.window_s / model.experiment.timestep_s / samples))
        self._set_bounds()
        self.p = np.clip(model.collocation.guess_p, self.lower, self.upper)
        self.prior = SquareRootInformation.empty(model.parameter_count)
        self.first_pass: WindowPass | None = None
        self._combined = CombinedPasses(self.prior, [], points=[])
        self._last_positions_m = np.full((1, 3), np.nan)
        self.second_pass: WindowPass | None = None
        self.log: list[LoggedRow] = []
        self.search = self._new_search() if problem.parameters.names_without_guess else None
        self.scatter = ResidualScatter()
        self._trust = INITIAL_RADIUS
        self._rejected = 0
        self.budget = TimeBudget()
        self.last: LiveUpdate | None = None
        self._rest = self._warm_up()

    # Frames -----------------------------------------------------------------------------------

    def update(
        self,
        t_s: float,
        pose: Pose | Mapping[str, Pose] | None,
        markers: ArrayLike | Mapping[str, ArrayLike] | None = None,
        wrench: Any = None,
        readings: Mapping[str, Any] | None = None,
    ) -> LiveUpdate:
        """Process a frame and return the result, which is also stored in `last`.

        Frames should be in order of time; late, doubled and missing ones are allowed, see
        `process_frame`.

        Parameters
        ----------
        t_s : float
            Time of the frame [s].
        pose : 4×4 matrix, (position, quaternion x y z w), or None
            Pose of the moving grasp, None if it is missing; for several grasps a mapping by their
            number, as text from "1" on, or a list in the order of the problem.
        markers : (M, 3) array, or mapping of name to (3,), optional
            Marker positions [m]; NaN, or omitted, where missing.
        wrench : (6,) or (3,) array, optional
            Wrench of the grasp on the body: fx, fy, fz [N], tx, ty, tz [N m], at the time of the
            frame; or a mapping with ``t_s`` and ``values``, or a list of such mappings; for several
            sensors a mapping by the number of their grasp, as text. NaN, or None, where missing.
        readings : mapping of name to numbers, optional
            Values of custom sensors, and pixels (N, 2) of image tracks or mappings of point to
            pixel, at the time of the frame; or mappings with ``t_s`` and ``values``, or lists of
            such mappings. NaN, or None, where missing.

        Raises
        ------
        InputError
            If the values are not a valid frame; the estimator is then unchanged.
        """
        poses = parse_pose(pose, self.model.moving_grasps + 1)
        tracks = parse_markers(markers, self.names)
        gauges = self.model.experiment.readings
        instrument_samples = parse_custom_readings(readings, gauges, t_s=parse_time(t_s))
        instrument_samples += parse_wrenches(
            wrench,
            self.model.experiment.sensors_by_grasp,
            instruments_before=len(gauges),
            t_s=parse_time(t_s),
        )
        return self.process_frame(
            Frame(
                parse_time(t_s),
                poses,
                tracks_m=tracks,
                has_wrench=wrench is not None,
                instrument_samples=instrument_samples,
            )
        )

    @one_blas_thread()
    def process_frame(self, frame: Frame) -> LiveUpdate:
        """Process a validated frame and return the result, which is also stored in `last`.

        Frames that are ignored, and those before the first pose, give a result as well, with a note
        where there is a reason. After a gap in the poses the estimator restarts from rest with the
        information of the samples so far as a prior. When the motion begins after a long rest, it
        starts as if the stream had begun with the last frames at rest, see `InitialRest`. Rows that
        cannot be simulated raise no error: the verdict of the result says so.

        Parameters
        ----------
        frame : Frame
            Frame with the moving grasps, markers and instruments of the problem, in its order.
        """
        began = self.clock()
        frame, notes = self._checked_frame(frame)
        if self.intake.is_motion_unknown(frame.t_s):
            if frame.pose is None:
                notes.append(
                    "the pose of the grasp is missing: frames are ignored until it is back"
                )
            else:
                self._restart()
                notes.append(
                    "the estimation restarted after a gap in the poses, assuming that the body is at rest"
                )
        rows = self._rows_before_motion(frame, notes)
        buffered = self._buffered(frame)
        rows += buffered.rows
        notes += buffered.notes
        self.budget.start_frame()
        caught_up = self._catch_up(began, notes)
        squares, pixel_squares = [], []
        before = self.clock()
        while rows:
            done, new_notes = self._compute_rows(rows, squares, pixel_squares)
            notes = notes + new_notes
            rows = rows[done:]
        notes += self._add_samples(buffered.late_samples, squares, pixel_squares)
        self._update_estimate()
        if self.first_pass is not None and not self.first_pass.has_failed and self.search is None:
            self._relinearise_if_moved(
                self.first_pass, self.first_pass, began=began, distance=RELINEARISE_DISTANCE_FIRST
            )
        self.budget.frame_s = self.clock() - before
        done = self._repeat_rows(began, notes, done=caught_up)
        before = self.clock()
        self._drop_old_rows()
        estimates, trust = self._estimates_and_trust(frame.t_s)
        self.budget.record_remainder(self.clock() - before)
        latency_s = self.clock() - began
        self.last = LiveUpdate(
            frame.t_s,
            estimates,
            trust=trust,
            marker_rms_m=_root_mean(squares),
            notes=tuple(notes),
            latency_s=latency_s,
            relinearised=done,
            marker_distances_m=np.sqrt(squares[-1]) if squares else np.zeros(0),
            pixel_rms=_root_mean(pixel_squares),
        )
        return self.last

    @property
    def node_positions_m(self) -> Array | None:
        """Node positions (n, 3) [m] of the body at the latest row, at the estimate, to first order
        around the linearisation point; None before the first row.
        """
        if self.first_pass is None:
            return None
        x = self.first_pass.latest_positions_at(self.model.transformed(self.p))
        if x is None:
            return None
        node_count = len(self.model.experiment.body.nodes.points_m)
        return x.reshape(-1, 3)[:node_count]

    @one_blas_thread()
    def finish(self) -> LiveUpdate | None:
        """Return the final result of all frames, however long that takes.

        Call it once, after the last frame: the state of the estimator may change, but `last` does
        not.

        If the window holds the whole recording, this is the run of the batch. Otherwise, and if
        markers were measured between samples, the rows in the window are computed again until the
        estimate stays.

        Returns
        -------
        LiveUpdate or None
            The update of the last frame with new estimates, and after a batch run the root mean
            square distance of all markers; its notes are those of this function. The last update
            itself if no row could be computed since the start or a restart, and None if there was
            no frame.
        """
        began = self.clock()
        notes = ["final estimate after the last frame"]
        if self.last is None or self.first_pass is None:
            return self.last
        last = self.last
        batch_run = self._solve_batch(self.first_pass, notes)
        if batch_run is None:
            rows = self._repeat_until_settled(began, notes)
            estimates, trust = self._estimates_and_trust(last.t_s)
        else:
            rows = len(batch_run.solution.history) * len(self.log)
            estimates = {name: batch_run.estimates[name] for name in last.estimates}
            unassessed = Assessment.from_concerns(
                data_concerns(ResidualScatter(), self.counts, samples=self.samples)
            )
            trust = batch_run.trust.combined_with(unassessed)
            last = replace(last, marker_rms_m=batch_run.solution.rms_m)
        return replace(
            last,
            estimates=estimates,
            trust=trust,
            notes=tuple(notes),
            latency_s=self.clock() - began,
            relinearised=rows,
        )

    def _solve_batch(self, first_pass: WindowPass, notes: list[str]) -> Run | None:
        """Return the run of the batch solve of the complete recording.

        None if the window does not hold the whole recording, if that cannot be solved as a batch
        (see `recording_from_log`), or if the solve is refused, which adds a sentence to `notes`, in
        place. The estimator is not changed.
        """
        recording = (
            None
            if first_pass.prior.row_count
            else recording_from_log(self.model, self.intake, log=self.log)
        )
        try:
            return None if recording is None else solve_recording(self.problem, recording)
        except InputError as error:
            notes.append(f"the final estimate from the complete recording failed: {error.message}")
            return None

    def _repeat_until_settled(self, began: float, notes: list[str]) -> int:
        """Compute the rows in the window again, without a time limit, until no further pass is
        needed or `FINAL_PASSES` times as many rows as the window has are computed.
        """
        rows_per_frame, self.rows = self.rows, FINAL_PASSES * len(self.log)
        try:
            return self._repeat_rows(began, notes)
        finally:
            self.rows = rows_per_frame

    def _checked_frame(self, frame: Frame) -> tuple[Frame, list[str]]:
        """Return the frame with NaN for markers that are implausibly far from the last known
        position of every moving grasp, and notes on them; the frame itself is not changed.
        """
        notes = []
        if frame.has_wrench and not self.model.experiment.sensors_by_grasp:
            self.counts["with a wrench"] += 1
            if self.counts["with a wrench"] == 1:
                notes.append("wrenches are ignored: no grasp of the problem has a sensor")
        if frame.pose is not None:
            self._last_positions_m = frame.pose[0]
        distances_m = np.linalg.norm(frame.tracks_m[:, None] - self._last_positions_m, axis=2)
        self.samples += int(np.isfinite(frame.tracks_m[:, 0]).sum())
        is_implausible = (distances_m > self._reach_m).all(axis=1)
        if is_implausible.any():
            notes.append(self._note_outliers(is_implausible))
            frame = replace(
                frame, tracks_m=np.where(is_implausible[:, None], np.nan, frame.tracks_m)
            )
        return frame, notes

    def _note_outliers(self, is_outlier: NDArray[np.bool_]) -> str:
        """Add the number of outliers to the counts, and return a note with their names;
        `is_outlier` (M,) says which markers are, at least one.
        """
        self.counts["wild"] += int(is_outlier.sum())
        names = ", ".join(self.names[m] for m in np.flatnonzero(is_outlier))
        return (
            "markers ignored in this frame, because they are implausibly far from the grasp: "
            f"{names}"
        )

    def _compute_rows(
        self, rows: Sequence[LoggedRow], squares: list[Array], pixel_squares: list[Array]
    ) -> tuple[int, list[str]]:
        """Compute and log new rows with the first pass, as many as possible at once, with their
        samples.

        The first row starts the pass. If the initial state cannot be computed, all frames in the
        buffer are discarded; if a later row cannot be simulated, the pass is marked as failed, and
        rows are only logged.
        """
        done = 1
        notes = []
        first_pass = self.first_pass
        try:
            if first_pass is None:
                notes += self._start_pass(rows)
            elif not first_pass.has_failed:
                done = first_pass.add_rows(
                    [row.poses for row in rows[: first_pass.remaining_row_count]]
                )
        except (SimulationError, InputError) as error:
            if first_pass is None:
                self.intake.reset()
                return 1, [f"the initial state of the motion cannot be computed: {error}"]
            first_pass.has_failed = True
            notes = [f"the body cannot be simulated with these parameters: {error}"]
        for k, row in enumerate(rows[:done], 1):
            self.log.append(LoggedRow(row.poses, []))
            notes += self._add_samples(row.samples, squares, pixel_squares, rows=done - k)
        return done, notes

    def _add_samples(
        self,
        samples: Sequence[Sample],
        squares: list[Array],
        pixel_squares: list[Array],
        rows: int = 0,
    ) -> list[str]:
        """Add samples to the first pass and to the log, and return notes on outliers; squared
        distances of markers and squared residuals of pixels are added to the two lists.
        """
        first_pass = self.first_pass
        if first_pass is None:
            return []
        notes = []
        sigma_m = self.model.transcription.experiment.markers.sigma_m[:, None]
        if first_pass.has_failed:
            self.log[-1].samples.extend(samples)
            return notes
        all_linearised = first_pass.sweep.linearise_samples([(sample, rows) for sample in samples])
        for sample, linearised in zip(samples, all_linearised, strict=True):
            if not sample.instrument:
                residual = linearised.evaluate_at(self.model.transformed(self.p))
                outliers = self._outliers(residual)
                if outliers.any():
                    notes.append(self._note_outliers(outliers))
                    remaining = np.where(outliers[:, None], np.nan, sample.values)
                    sample = sample._replace(values=remaining)
                    linearised.at_zero[outliers] = residual[outliers] = np.nan
                squared = np.sum((residual * sigma_m) ** 2, axis=1)
                squares.append(squared)
            elif (
                sensor := self.model.instruments[sample.instrument - 1].residual
            ).measurement.counts_pixels:
                residual = linearised.evaluate_at(self.model.transformed(self.p))[:, :2]
                pixel_squares.append(np.ravel((residual * sensor.sigmas[:, None]) ** 2))
            self.log[-1].samples.append(sample)
        first_pass.add_residuals(all_linearised)
        return notes

    def _outliers(self, residual: Array) -> NDArray[np.bool_]:
        """Return a mask (M,) of markers whose residuals are far larger than usual
        (`OUTLIER_RATIO`).

        It is false for all markers while the estimate has not settled, the scatter of the residuals
        is unknown or gross, and if most markers would be outliers; and for missing ones. Nothing is
        changed.
        """
        if (
            self.distance_from_linearisation() > LARGEST_SETTLED_DISTANCE
            or not 0 < self.scatter.rms < GROSS_MISFIT
        ):
            return np.zeros(len(residual), dtype=bool)
        length = np.sqrt(np.sum(residual**2, axis=1) / 3)
        outliers = length > OUTLIER_RATIO * max(1.0, self.scatter.rms)
        if outliers.sum() > np.isfinite(length).sum() / 2:
            return np.zeros_like(outliers)
        return outliers

    # Beginnings -------------------------------------------------------------------------------

    def _set_bounds(self) -> None:
        """Set the attributes `lower` and `upper`, bounds (P,) of the parameters p in the solver's
        coordinates, from the model.
        """
        self.lower, self.upper = self.model.collocation.parameter_bounds

    def _new_search(self) -> StiffnessSearch:
        """Return a new search for initial values over a range of stiffness, with the present
        nuisance parameters; it has not begun, and the estimator is not changed.
        """
        return StiffnessSearch(self.model, self.p[self.model.collocation.nq :])

    def _warm_up(self) -> tuple[Poses, Array] | None:
        """Compile the kernels before the first frame with rows at the first pose of the problem's
        recording, and set `budget` to their measured computing times.
        """
        poses = self.model.first_poses
        moving_poses = tuple(poses[k] for k in self.model.moving_grasps)
        no_markers = np.full((len(self.names), 3), np.nan)
        no_markers[:1] = 0.0
        # Points in the middle of the rows that they need.
        pixels = [
            Sample(each.stencil.neighbours // 2, np.zeros(each.residual.measured[0, :, :2].size), k)
            for k, each in enumerate(self.model.instruments, 1)
            if each.residual.measurement.counts_pixels
        ]
        try:
            trial = WindowPass(self.model, self.p, prior=self.prior, block_rows=self._block_rows)
            row = LoggedRow(moving_poses, [Sample(0.0, no_markers)] if self.names else [])
            for _ in range(self.model.template_rows + 2):
                trial.repeat_rows([row])
            trial.repeat_rows([row._replace(samples=[*row.samples, *pixels])])
        except SimulationError:
            return None
        self._estimates_at(trial.sweep.information, self.p)
        self.budget = self._measure_times(trial, row)
        return poses, trial.blocks[0].stored_rows[0].x

    def _measure_times(self, trial: WindowPass, row: LoggedRow) -> TimeBudget:
        """Return the computing times of one and of many repeated rows, each the shortest of
        `TIMING_REPETITIONS` measurements.
        """
        took_s: dict[int, float] = {}
        most = min(trial.rows - 1, self.model.rows_per_chunk, self._block_rows - 1)
        for count in (1, most) * TIMING_REPETITIONS:
            second_pass = WindowPass(
                self.model, self.p, prior=self.prior, block_rows=self._block_rows, base=trial
            )
            second_pass.repeat_rows([row])
            began = self.clock()
            second_pass.repeat_rows([row] * count)
            took_s[count] = min(took_s.get(count, np.inf), self.clock() - began)
        return TimeBudget.from_times(took_s[1], took_s[most], many=most)

    def _start_pass(self, rows: Sequence[LoggedRow]) -> list[str]:
        """Start the first pass with the first of some rows, and set unknown places of markers and
        of points in images, and poses of cameras, from its samples; return notes on them.

        The initial guess of the positions is that of the start of the problem's recording, moved
        rigidly with the pose, if there is a single grasp. If places or poses are set, `model`, the
        bounds, the nuisance parameters in `p` and `prior` are replaced, and the row is computed
        again; they are kept after a restart, whose prior refers to them. `first_pass` is set; the
        samples of the row are not added to it.
        """
        model = self.model
        row, notes = rows[0], []
        guesses = []
        poses = model.all_poses(row.poses)
        if self._rest is not None and len(poses) == 1:
            old_rotation, old_position = self._rest[0][0]
            x = self._rest[1]
            (rotation, position) = poses[0]
            guesses = [
                ((x.reshape(-1, 3) - old_position) @ old_rotation @ rotation.T + position).ravel()
            ]
        first_pass = WindowPass(model, self.p, prior=self.prior, block_rows=self._block_rows)
        first_pass.add_rows([row.poses], guesses)
        if not self.prior.row_count:
            first = {
                of: values
                for of, samples, values in self.intake.all_samples(rows)
                if abs(samples) <= TIME_TOLERANCE_SAMPLES
            }
            for number, camera in enumerate(model.experiment.readings, 1):
                is_seen = number in first and np.isfinite(first[number]).any()
                if isinstance(camera, ImageTracks) and not is_seen:
                    raise InputError(f"the first frame has no pixels of '{camera.name}'")
            tracks_m = first.pop(0, np.full((len(self.names), 3), np.nan))
            x = first_pass.blocks[0].stored_rows[0].x
            self.model = model.with_first_frame(tracks_m, first, x)
        if self.model is not model:
            notes = self._note_unplaced()
            self._set_bounds()
            places = self.model.collocation.guess_p[model.collocation.nq :]
            self.p = np.concatenate([self.p[: model.collocation.nq], places])
            self.prior = SquareRootInformation.empty(self.model.parameter_count)
            first_pass = WindowPass(
                self.model, self.p, prior=self.prior, block_rows=self._block_rows
            )
            first_pass.add_rows([row.poses], guesses)
            if self.search is not None:
                self.search = self._new_search()
        self.first_pass = first_pass
        self._combined = CombinedPasses.from_passes(first_pass, None)
        return notes

    def _note_unplaced(self) -> list[str]:
        """Return a note on the points in images whose first rays do not meet the body."""
        absent = [
            f"{name} in {each.tracks.name}"
            for each in self.model.transcription.association.correspondences
            if isinstance(each, TrackedPlaces)
            for name, is_placed in zip(each.tracks.names, each.is_placed, strict=True)
            if not is_placed
        ]
        words = "points left out, because the first frame does not show them on the body"
        return [f"{words}: {', '.join(absent)}"] if absent else []

    def _restart(self) -> None:
        """Keep the information of all samples so far as a prior, discard passes, log and frames,
        and wait for a new start; the estimate stays. The restart is counted in `counts`, as "begun
        anew".
        """
        if self.first_pass is not None:
            self.prior = self.first_pass.condense_measurements()
        self.first_pass = self.second_pass = None
        self.log.clear()
        self.intake.reset()
        self.counts["begun anew"] += 1

    def _rows_before_motion(self, frame: Frame, notes: list[str]) -> list[LoggedRow]:
        """Start anew if the motion begins with this frame after a long rest, and return the rows of
        the last frames at rest, with their samples.
        """
        frames = self._initial_rest.frames_before_motion(frame)
        if not frames or self.first_pass is None:
            return []
        self._start_anew()
        notes.append(
            "the motion begins after a long rest: the estimate starts again from the last frames "
            "at rest, and earlier frames are left out"
        )
        rows: list[LoggedRow] = []
        for each in frames:
            buffered = self._buffered(each)
            rows += buffered.rows
            if rows:
                rows[-1].samples.extend(buffered.late_samples)
        return rows

    def _buffered(self, frame: Frame) -> BufferedFrame:
        """Add a frame to the buffer, which is changed, and return the rows that it completes, late
        samples and notes; no row is computed.
        """
        return self.intake.add_frame(
            frame.t_s,
            frame.pose,
            tracks_m=frame.tracks_m,
            instrument_samples=frame.instrument_samples,
        )

    def _start_anew(self) -> None:
        """Discard passes, log, frames and information, the prior included, and return to the
        initial guess or to a new search for it.
        """
        model = self.model
        self.first_pass = self.second_pass = None
        self.log.clear()
        self.intake.reset()
        self.prior = SquareRootInformation.empty(model.parameter_count)
        self.p = np.clip(model.collocation.guess_p, self.lower, self.upper)
        self.search = self._new_search() if self.problem.parameters.names_without_guess else None
        self.scatter = ResidualScatter()
        self._trust = INITIAL_RADIUS
        self._rejected = 0
        self.counts["searched"] = 0

    # Estimates --------------------------------------------------------------------------------

    def distance_from_linearisation(self) -> float:
        """Return the largest distance of the estimate from the linearisation points of the rows in
        the window, in standard errors of single material parameters.

        Infinite if there is no pass, or if it failed.
        """
        if self.first_pass is None or self.first_pass.has_failed:
            return np.inf
        return self._largest_distance(self.first_pass, self.p, points=self._combined.points)

    def _largest_distance(self, first_pass: WindowPass, p: Array, points: Sequence[Array]) -> float:
        """Return the largest distance of p from some points, in the standard errors of a pass; 0
        without points.

        It is the largest absolute difference of a single material parameter over its standard
        error; parameters of the recording do not count.
        """
        nq = self.model.collocation.nq
        distances = np.abs(np.array(points) - self.model.transformed(p))[:, :nq]
        return float(
            np.max(distances / first_pass.sweep.information.standard_errors[:nq], initial=0.0)
        )

    def _update_estimate(self) -> None:
        """Set the estimate `p` (P,) to the minimum of the joint quadratic loss of the first and the
        second pass, within bounds and trust region; without effect before the first pass, or if
        that failed.
        """
        if self.first_pass is not None and not self.first_pass.has_failed:
            self._combined = CombinedPasses.from_passes(self.first_pass, self.second_pass)
            self.p = self._constrained_minimum(self.first_pass, self._combined.information)

    def _constrained_minimum(self, first_pass: WindowPass, known: SquareRootInformation) -> Array:
        """Return the parameters p (P,), in the solver's coordinates, that minimise a quadratic loss
        within the bounds and the trust region about the linearisation point of a pass.
        """
        reach = self._trust * self.model.collocation.reach_p
        low = np.maximum(self.lower, first_pass.sweep.p - reach)
        high = np.minimum(self.upper, first_pass.sweep.p + reach)
        best = known.minimiser(self.model.transformed(low), self.model.transformed(high))
        return np.clip(self.model.physical(best), low, high)

    def _next_linearisation_point(self, first_pass: WindowPass) -> Array:
        """Return the next linearisation point p (P,) of a pass, in the solver's coordinates
        (logarithms, or values of linear parameters; not transformed).
        """
        size = self.model.parameter_count
        samples = len(self.log) / self.model.collocation.substeps
        deviation = POINT_PRIOR_DEVIATION * max(1.0, samples / TRIAL_SAMPLES)
        slopes = np.diag(1 / (deviation * self.model.collocation.reach_p * first_pass.sweep.rates))
        information = self._combined.information.with_rows(
            np.zeros(size), slopes, parameters=first_pass.sweep.transformed
        )
        return self._constrained_minimum(first_pass, information)

    def _estimates_and_trust(self, t_s: float) -> tuple[Mapping[str, Estimate], Assessment]:
        """Return estimates by name and the verdict at the time t_s [s].

        Without a successful first pass the estimates are the values at the current p without
        standard errors and intervals, and without coefficients of fields, and the only concern is
        the reason. Otherwise the concerns are those of the data and of the estimates; a pose that
        is missing too long and a search that goes on add one.
        """
        code = ""
        if self.first_pass is None:
            code = "solve/no-start"
        elif self.first_pass.has_failed:
            code = "solve/not-simulable"
        elif self.intake.is_motion_unknown(t_s):
            code = "solve/grasp-lost"
        elif self.search is not None:
            code = "solve/seeking"
        grave = concern_if(bool(code), True, code=code)
        if self.first_pass is None or self.first_pass.has_failed:
            values = self.model.collocation.parameters.scalar_values(
                self.p[: self.model.collocation.nq]
            )
            estimates_only = {name: Estimate(v) for name, v in values.items()}
            return estimates_only, Assessment.from_concerns(grave)
        if self.counts["looked"] % SCATTER_INTERVAL_FRAMES == 0:
            self.scatter = self._combined.scatter(
                self.model.transformed(self.p), self.model.judged_instruments
            )
        self.counts["looked"] += 1
        estimates = self._estimates_at(self._combined.information, self.p)
        judged = self.model.judged_residuals
        grave += data_concerns(
            self.scatter,
            self.counts,
            samples=self.samples,
            sigma_key=judged[0].sigma_key,
            errs_slowly=any(each.errs_slowly for each in judged),
        )
        grave += estimate_concerns(estimates, self.distance_from_linearisation())
        return estimates, Assessment.from_concerns(grave)

    def _estimates_at(self, known: SquareRootInformation, p: Array) -> dict[str, Estimate]:
        """Return estimates with standard errors and 95 % intervals by name, in the units of the
        problem, without the coefficients of fields.
        """
        collocation = self.model.collocation
        nq = self.model.collocation.nq
        transformed = self.model.transformed(p)
        parameter_count = self.model.parameter_count
        factor, quantile = variance_factor(
            known, transformed, parameter_count=parameter_count, scatter=self.scatter
        )
        rates = self.model.transformation_derivatives(transformed)[:nq]
        of_q = factor * known.covariance()[:nq, :nq] / np.outer(rates, rates)
        bounded = ((p - self.lower < AT_BOUND) | (self.upper - p < AT_BOUND))[:nq]
        quantiles = np.full(nq, quantile)
        return user_estimates(
            collocation.parameters, p[:nq], covariance_q=of_q, at_bound=bounded, quantiles=quantiles
        )

    # Passing again ----------------------------------------------------------------------------

    def _repeat_rows(self, began: float, notes: list[str], done: int = 0) -> int:
        """Continue the second pass, or start one, within the rest of the frame's budget."""
        started = 0
        while self.first_pass is not None:
            pass_began = self.clock()
            if (
                self.second_pass is None
                and started < MOST_PASSES
                and self._affordable_rows(done, pass_began - began + self.budget.turn_s)
            ):
                started += 1
                self.second_pass = self._start_second_pass(self.first_pass, notes)
                self.budget.record_relinearisation(self.clock() - pass_began)
            second_pass = self.second_pass
            if second_pass is None:
                break
            if not done and second_pass.base is not None:
                self._relinearise_if_moved(
                    self.first_pass, second_pass, began=began, distance=RELINEARISE_DISTANCE
                )
            affordable = min(
                self._affordable_rows(done, self.clock() - began), second_pass.repeatable_row_count
            )
            if not affordable:
                break
            done += self._advance_second_pass(second_pass, affordable, notes=notes)
        return done

    def _catch_up(self, began: float, notes: list[str]) -> int:
        """Complete a second pass that lags by few rows, if there is time, before new rows come; it
        is then accepted or rejected.
        """
        second_pass = self.second_pass
        if second_pass is None or second_pass.base is None:
            return 0
        lag = len(self.log) - second_pass.rows
        elapsed_s = self.clock() - began
        if lag > min(
            second_pass.repeatable_row_count,
            self._affordable_rows(0, elapsed_s + self.budget.frame_s),
        ):
            return 0
        return self._advance_second_pass(second_pass, lag, notes=notes)

    def _advance_second_pass(self, second_pass: WindowPass, count: int, notes: list[str]) -> int:
        """Compute further rows of the second pass; if it has caught up or failed, accept or reject
        it, or record it as a trial of the search.

        While trials of a search are left, the pass is such a trial, which ends after
        `StiffnessSearch.rows` rows. A row that cannot be solved marks the pass as failed. The
        computing time is recorded in `budget`.
        """
        before = self.clock()
        first_row = second_pass.rows
        try:
            second_pass.repeat_rows(self.log[first_row : first_row + count])
        except SimulationError:
            second_pass.has_failed = True
        self.budget.record_steps(count, self.clock() - before)
        if self.search is not None and not self.search.is_done:
            if second_pass.has_failed or second_pass.rows >= min(self.search.rows, len(self.log)):
                self.search.record_trial(second_pass)
                self.second_pass = None
        elif (
            second_pass.has_failed or second_pass.rows == len(self.log)
        ) and self.first_pass is not None:
            self._accept_or_reject(self.first_pass, second_pass, notes=notes)
        return second_pass.rows - first_row

    def _affordable_rows(self, done: int, elapsed_s: float) -> int:
        """Return how many rows may be computed again: as many as fit into the rest of the time
        budget of the frame, or, if the attribute `rows`, the number per frame, is fixed, these
        minus `done`.
        """
        if self.rows is not None:
            return self.rows - done
        return self.budget.affordable_steps(self.budget_s - elapsed_s)

    def _start_second_pass(self, first_pass: WindowPass, notes: list[str]) -> WindowPass | None:
        """Return a new second pass, without rows yet, if one is needed, otherwise None; the caller
        sets `second_pass`.

        During a search for initial values it is needed for the next trial, once there are enough
        rows, and for the best values at the end; a search begins here, and sets `search`, if the
        first pass failed before rows left the window. If no trial succeeded, the search ends with a
        note. Without a search a pass is needed if the estimate has moved farther than
        `REPEAT_DISTANCE` from a linearisation point of the first pass, or if its sweep needs
        another pass, but not after a failure.
        """
        search = self.search
        at_start = first_pass.start[0] is None
        if search is None and first_pass.has_failed and at_start:
            search = self.search = self._new_search()
            notes.append("searching for initial values over a range of stiffnesses")
        p = self.p
        base = first_pass
        if search is not None:
            if not search.is_done and (len(self.log) < search.rows or not at_start):
                return None
            p = search.find_best() if search.is_done else search.next_trial()
            base = None
            if p is None:
                self.search = None
                notes.append(
                    "no initial values were found over a range of stiffnesses: test the problem file and "
                    "a recording with the command check"
                )
                return None
        elif first_pass.has_failed:
            return None
        else:
            p = self._next_linearisation_point(first_pass)
            if (
                self._largest_distance(
                    first_pass, p, points=first_pass.linearisation_points_from(0)
                )
                <= REPEAT_DISTANCE
                and not first_pass.sweep.needs_another_pass()
            ):
                return None
        return WindowPass(
            self.model, p, prior=first_pass.prior, block_rows=self._block_rows, base=base
        )

    def _relinearise_if_moved(
        self, first_pass: WindowPass, pass_to_move: WindowPass, began: float, distance: float
    ) -> None:
        """Move the linearisation point of a pass towards the estimate if it is far and there is
        time.
        """
        current_point = [pass_to_move.sweep.transformed]
        if (
            pass_to_move.rows < pass_to_move.last_relinearised_row + self.model.rows_per_chunk
            or self._largest_distance(first_pass, self.p, points=current_point) <= distance
        ):
            return
        before = self.clock()
        if self.rows is None and not self._affordable_rows(0, before - began + self.budget.turn_s):
            return
        p = self._next_linearisation_point(first_pass)
        if self._largest_distance(first_pass, p, points=current_point) > distance:
            pass_to_move.relinearise_at(p)
            self.budget.record_relinearisation(self.clock() - before)

    def _accept_or_reject(
        self, first_pass: WindowPass, second_pass: WindowPass, notes: list[str]
    ) -> None:
        """Replace the first pass by the second one if that fits about as well as expected, and
        enlarge the trust region; otherwise discard the second one and shrink the region.

        A pass that has not failed always replaces one that has. A search for initial values ends
        either way. After `LARGEST_REJECTIONS` rejections in a row with grossly large residuals, a
        search begins, once in the life of the estimator. The estimate is updated.
        """
        self.second_pass = None
        was_search = self.search is not None
        self.search = None
        points = [
            *first_pass.linearisation_points_from(0),
            second_pass.linearisation_points_from(0)[0],
        ]
        expected = max(first_pass.sweep.information.loss(point) for point in points)
        # The loss of a pass whose linearisation point was changed is not that of a simulation.
        is_within_trust_region = (
            first_pass.last_relinearised_row
            and self._largest_distance(
                first_pass, first_pass.sweep.p, points=second_pass.linearisation_points_from(0)
            )
            <= REPEAT_DISTANCE
        )
        fits = (
            first_pass.has_failed
            or is_within_trust_region
            or second_pass.compute_loss() <= ACCEPTED_RATIO * expected + ACCEPTED_EXCESS
        )
        if not second_pass.has_failed and fits:
            second_pass.base = None
            self.first_pass = second_pass
            self._trust = INITIAL_RADIUS if was_search else min(2 * self._trust, LARGEST_RADIUS)
            self._rejected = 0
            if was_search:
                notes.append("continued from another initial stiffness")
            self.scatter = CombinedPasses.from_passes(second_pass, None).scatter(
                second_pass.sweep.transformed, self.model.judged_instruments
            )
        else:
            reach = self.model.collocation.reach_p
            length = float(np.abs((second_pass.sweep.p - first_pass.sweep.p) / reach).max())
            self._trust = max(RADIUS_REDUCTION * length, 1e-6)
            self._rejected += 1
            is_stuck = self._rejected >= LARGEST_REJECTIONS and self.scatter.rms > GROSS_MISFIT
            if (
                is_stuck
                and not was_search
                and not self.counts["searched"]
                and first_pass.start[0] is None
            ):
                self.counts["searched"] += 1
                self.search = self._new_search()
                notes.append(
                    "the estimation does not converge: searching for other initial values over a "
                    "range of stiffnesses"
                )
        self._update_estimate()

    def _drop_old_rows(self) -> None:
        """Remove the oldest blocks of rows from the first pass and the log if the window is full;
        their information becomes part of the prior of the pass.
        """
        if self.first_pass is None:
            return
        most = self._blocks * self._block_rows
        if self.second_pass is not None and len(self.log) > 2 * most:
            self.second_pass = None
        if self.first_pass.has_failed and len(self.log) > 2 * most:
            self._restart()
        while (
            self.second_pass is None
            and self.first_pass is not None
            and not self.first_pass.has_failed
        ):
            if len(self.log) <= most:
                break
            del self.log[: self.first_pass.drop_oldest_block()]


def _root_mean(squares: Sequence[Array]) -> float:
    """Return the root of the mean of squares, without missing ones; NaN without any."""
    known = np.concatenate([*squares, np.zeros(0)])
    known = known[np.isfinite(known)]
    return float(np.sqrt(known.mean())) if len(known) else float("nan")
