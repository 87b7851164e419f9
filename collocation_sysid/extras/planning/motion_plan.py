"""A planned motion of the hand, with the motion of the body that it is predicted to cause.

Use `plan_motion`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from ...common.array_types import Array
from ...common.validated_classes import validated
from ...errors import InputError, SimulationError
from ...problem import Problem
from ...problem.code_loader import CodeLoader
from ...program.simulation import Trajectory, simulate
from ...recording import Experiment, PoseSequence
from ...runs.solved_problem import SolvedProblem
from ...statistics.budget.combined_intervals import NORMAL_95
from .band import point_deviations
from .durations import shortest, shortest_of_hand
from .full_program import require_full_program, solve_full
from .hand_limits import REACHED, Limits
from .planned_body import PlannedBody
from .planned_program import POSES_PER_SAMPLE, PlannedProgram
from .reduced_solver import (
    HandLimitsExcludeTask,
    PlanAnswer,
    ReducedTolerances,
    Watch,
    informative_motion,
    solve_reduced,
)
from .spline_motion import PoseLimit, SplineMotion
from .task import Reference, Task

Solver = Literal["reduced-space", "interior-point"]
# Share of a limit, tightened by its margin, from which it binds.
BINDING = 1 - 1e-4
# Limits of a hand that does not move.
STANDING = Limits(
    **{
        "workspace_m": ((-1e3,) * 3, (1e3,) * 3),
        "speed_m_s": 1.0,
        "acceleration_m_s2": 1.0,
        "rotation_deg": 90.0,
        "angular_speed_deg_s": 90.0,
        "angular_acceleration_deg_s2": 90.0,
    }
)
# Time steps of the simulation that checks a plan, for each of the plan's.
FINER = 4


@dataclass(frozen=True)
class TrackingError:
    """Deviation of a point from its reference, over the times and coordinates that count."""

    # Root mean square and largest distance from the reference [m]; NaN if only velocities count.
    rms_m: float
    largest_m: float
    at_waypoints_m: float  # largest distance at the stated times [m]
    # Largest distance with which the point follows its reference [m]: what the task states, or else
    # half of the way of the point (of the hand, if the point is held), and not more than the band,
    # but at least `Reference.sigma_m`; NaN if only velocities count.
    accepted_m: float
    # Largest half width of the 95 % band of a coordinate [m], see `MotionPlan.half_widths_m`; None
    # if that is not known.
    band_m: float | None


class BandContribution(NamedTuple):
    """Contribution to the band of a plan."""

    source: str  # effect of the budget, grip, description, or others together
    share: float  # share of the variance of the tracked coordinates


class BindingLimit(NamedTuple):
    """Limit of the hand that a plan reaches."""

    name: str
    spans_s: tuple[tuple[float, float], ...]  # tuple of (from, until): times at which it binds [s]
    # Share of the objective by which the plan would improve, to first order, if the limit were
    # wider by one percent.
    gain_per_percent: float


@dataclass(frozen=True, eq=False, repr=False)
class MotionPlan:
    """Planned motion.

    Attributes
    ----------
    program : PlannedProgram
        The optimal-control problem.
    answer : PlanAnswer
        Solution on the time grid of the plan.
    fine : Trajectory
        Simulation of the plan with `FINER` time steps for each of the plan's.
    seconds : float
        Time of the search [s].
    sufficient_duration_s : float or None
        Duration with which the error would be as small as the task accepts [s]; None if it is as
        small, or no such duration was found.
    """

    program: PlannedProgram
    answer: PlanAnswer
    fine: Trajectory
    seconds: float
    sufficient_duration_s: float | None = None

    def __repr__(self) -> str:
        if self.intervals:
            found = f"widest interval ± {100 * max(self.intervals.values()):.3g} %"
            return f"<MotionPlan of {self.program.task.duration_s:.3g} s, {self.answer.status}, {found}>"
        errors = (self.tracking_error(each) for each in self.program.references)
        return (
            f"<MotionPlan of {self.program.task.duration_s:.3g} s, {self.answer.status}, largest error "
            f"{1e3 * max((each.largest_m for each in errors), default=0.0):.3g} mm>"
        )

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended the search."""
        return self.answer.status == "interrupted"

    @property
    def is_complete(self) -> bool:
        """Whether the search ended at a stationary point, flat, or with intervals as narrow as
        wanted.
        """
        return self.answer.status in ("converged", "flat", "reached")

    @cached_property
    def intervals(self) -> dict[str, float]:
        """Half widths of the 95 % intervals of the wanted constants after a recording of this
        motion, relative to the values, by name; empty without information in the task.
        """
        criterion = self.program.criterion
        if criterion is None:
            return {}
        found = criterion.half_widths(self.answer.c, self.answer.x)
        return dict(zip(criterion.section.constants, found.tolist(), strict=True))

    @cached_property
    def motion(self) -> SplineMotion:
        """Motion of the hand."""
        return self.program.space.motion(self.answer.c)

    @cached_property
    def shares(self) -> Mapping[str, float]:
        """Largest value over each limit of the robot, by name of the limit."""
        return self.program.bounds.shares(self.motion.derivatives(self.motion.grid_s))

    @property
    def active_limits(self) -> list[str]:
        """Names of the limits of which the motion uses more than `REACHED`."""
        return [name for name, share in self.shares.items() if share > REACHED]

    @property
    def t_s(self) -> Array:
        """Times (T,) of the samples since the start [s]."""
        return self.program.experiment.t_s - self.program.experiment.t_s[0]

    def poses(self, t_s: Array) -> PoseSequence:
        """Return the poses in the format of the problem at any times since the start [s]; they are
        values of a curve with two continuous derivatives.
        """
        poses = self.program.body.gripper_poses(self.program.poses(self.answer.c, np.asarray(t_s)))
        start_s = self.program.experiment.t_s[0]
        return PoseSequence(
            poses.t_s - start_s, poses.positions_m, quaternions_xyzw=poses.quaternions_xyzw
        )

    def commands(self, t_s: Array) -> dict[str, Array]:
        """Return the planned tensions [N] and pressures [Pa] (T,), before their lag, at any times
        since the start [s], by name.
        """
        return self.program.commands(self.answer.c, np.asarray(t_s))

    def execution(
        self, t_s: Array, tracks_m: Array, poses: PoseSequence | None = None
    ) -> Experiment:
        """Return the recording of an execution, to be compared with the prediction (a problem with
        fixed parameters) or to be identified from beside the first recording.

        Parameters
        ----------
        t_s : (T,) array
            Times since the start of the motion [s]; the body is in equilibrium at the first.
        tracks_m : (T, M, 3) array
            Positions of the markers of the recording, in their order [m]; NaN where missing.
        poses : PoseSequence, optional
            Measured poses over the times since the start, in the format of the problem; those of
            the plan by default.
        """
        body = self.program.body
        markers = body.template.markers
        held = body.template.grasps[body.grasp_number].poses.first_motion
        times = np.asarray(t_s, dtype=np.float64)
        moved = replace((poses or self.poses(times)).after(held), first_motion=held)
        places = body.marker_places_m
        fine_s = np.linspace(times[0], times[-1], POSES_PER_SAMPLE * (len(times) - 1) + 1)
        commands = {name: (fine_s, values) for name, values in self.commands(fine_s).items()}
        experiment = body.experiment(moved, times, places, commands)
        seen = replace(experiment.markers, positions_m=tracks_m, sigma_m=markers.sigma_m)
        return replace(experiment, name="execution", markers=seen)

    @cached_property
    def points_m(self) -> dict[str, Array]:
        """Predicted positions (T, 3) of the points of the references, by name [m]."""
        markers = self.program.experiment.markers
        predicted = markers.predict_positions(self.fine.positions_m)
        return {name: predicted[:, k] for k, name in enumerate(markers.names)}

    @property
    def time_step_error_m(self) -> float:
        """Largest distance of a point between the time grid of the plan and finer steps [m]."""
        return float(np.linalg.norm(self._change_by_steps_m, axis=2).max(initial=0.0))

    @cached_property
    def _change_by_steps_m(self) -> Array:
        program = self.program
        coarse = self.answer.x[program.sample_rows].reshape(len(self.t_s), -1, 3)
        on_grid = program.experiment.markers.predict_positions(coarse)
        return np.stack([*self.points_m.values()], axis=1) - on_grid

    @cached_property
    def _deviations(self) -> tuple[Array, dict[str, Array]] | None:
        """Those of all points, see `point_deviations`; None if they are not known."""
        try:
            moved = self.program.moved_experiment(self.answer.c)
            return point_deviations(
                self.program.body, moved, self.answer.x, self._change_by_steps_m
            )
        except (SimulationError, InputError, np.linalg.LinAlgError):  # must not lose the plan
            return None

    @cached_property
    def expected_m(self) -> dict[str, Array]:
        """Middle (T, 3) of the band of each point [m], by name: prediction, and mean of the deviation
        from it, if it is known.
        """
        if self._deviations is None:
            return self.points_m
        return {
            name: each + self._deviations[0][:, k]
            for k, (name, each) in enumerate(self.points_m.items())
        }

    @cached_property
    def half_widths_m(self) -> dict[str, Array] | None:
        """Half width (T, 3) of the 95 % band of each point about `expected_m` [m], by name: at each
        time each coordinate is inside with a probability of 95 %. None if it is not known.
        """
        if self._deviations is None:
            return None
        half_m = NORMAL_95 * np.sqrt(sum(self._deviations[1].values()))
        return {name: half_m[:, k] for k, name in enumerate(self.points_m)}

    @cached_property
    def band_contributions(self) -> tuple[BandContribution, ...]:
        """Contributions to the variance of the tracked coordinates, the largest first; empty if the
        uncertainty is not known.
        """
        if self._deviations is None:
            return ()
        weights, points = 0 * self._deviations[0], [*self.points_m]
        for each in self.program.references:
            counted = np.isfinite(each.position_m)
            weights[:, points.index(each.name)] += counted / each.sigma_m**2
        parts = {name: float(np.sum(weights * v)) for name, v in self._deviations[1].items()}
        total = sum(parts.values())
        found = [BandContribution(name, part / total) for name, part in parts.items() if part > 0]
        return tuple(sorted(found, key=lambda each: -each.share))

    def tracking_error(self, reference: Reference) -> TrackingError:
        """Return the predicted deviation of a point from its reference."""
        counted = np.isfinite(reference.position_m)
        if not counted.any():
            return TrackingError(np.nan, np.nan, np.nan, np.nan, None)
        path_m = self.points_m[reference.name]
        deviation = np.where(counted, path_m - reference.position_m, 0.0)
        distance = np.linalg.norm(deviation, axis=1)
        rms = float(np.sqrt(np.mean(distance[counted.any(axis=1)] ** 2)))
        largest, at_waypoints = (float(d.max()) for d in (distance, distance[reference.waypoints]))
        way_m = _farthest(np.where(counted, reference.position_m - path_m[0], 0.0))
        if way_m < reference.sigma_m:
            way_m = _farthest(self.motion.derivatives(self.t_s).value[:, :3])
        half_m = max(way_m / 2, reference.sigma_m)
        stated_m = self.program.task.largest_error_m
        if self.half_widths_m is None:
            return TrackingError(rms, largest, at_waypoints, stated_m or half_m, None)
        band_m = float(self.half_widths_m[reference.name][counted].max())
        accepted_m = stated_m or min(half_m, max(band_m, reference.sigma_m))
        return TrackingError(rms, largest, at_waypoints, accepted_m, band_m)

    @cached_property
    def residual_vibration_m(self) -> float | None:
        """Largest distance of a node from its mean position after the motion [m]; None if the body
        need not be at rest.
        """
        positions = self.fine.positions_m
        return self.program.residual_vibration_m(positions.reshape(len(positions), -1))

    @cached_property
    def body_extremes(self) -> dict[str, float]:
        """Largest stretch, and smallest distance from obstacles [m], at the samples, by the name of
        the limit; of those that the task limits.
        """
        limits = self.program.body_limits
        positions = self.fine.positions_m
        return {} if limits is None else limits.extremes(positions.reshape(len(positions), -1))

    @property
    def exceeds_body_limits(self) -> bool:
        """Whether the largest stretch, the clearance or a `PathLimit` of the task is not kept."""
        if self.program.exceeds_path_limits(self.answer.x):
            return True
        avoid, found = self.program.task.avoid, self.body_extremes
        stretch, clearance_m = avoid.largest_stretch, avoid.clearance_m
        return (stretch is not None and found["largest_stretch"] > stretch) or (
            clearance_m is not None and found["clearance_m"] < clearance_m
        )

    @property
    def exceeds_width(self) -> bool:
        """Whether an interval of a constant is wider than the task wants."""
        section = self.program.task.information
        return section is not None and max(self.intervals.values()) > section.half_width

    @property
    def exceeds_error(self) -> bool:
        """Whether the error is larger than the task accepts; if it states nothing, whether a point
        misses its reference, see `TrackingError.accepted_m`.
        """
        accepted_m = self.program.task.largest_error_m
        if accepted_m is not None:
            return self.largest_error_m > accepted_m
        errors = map(self.tracking_error, self.program.references)
        return any(each.largest_m > each.accepted_m for each in errors)

    @cached_property
    def largest_error_m(self) -> float:
        """Largest distance of a point from its reference, or of a node from rest, on the time grid
        of the plan [m].
        """
        return self.program.largest_error_m(self.answer.x)

    @cached_property
    def binding_limits(self) -> tuple[BindingLimit, ...]:
        """Limits of the hand that the motion reaches, those first whose widening would improve the
        plan most.
        """
        limits = self.program.hand_limits
        value = self.answer.history[-1]
        found = []
        for name in dict.fromkeys(limits.names):
            chosen = np.array([each == name for each in limits.names])
            # Of the objective, twice that of the steps, by one percent of the limit.
            multipliers = self.answer.multipliers[: len(chosen)][chosen]
            gain = 0.02 * float(multipliers.sum()) / max(value, 1e-300)
            binds = np.zeros(len(limits.t_s), dtype=bool)
            at = np.searchsorted(limits.t_s, limits.times_s[chosen] - 1e-12)
            np.logical_or.at(binds, at, limits.shares(self.answer.c)[chosen] > BINDING)
            if binds.any():
                ends = np.flatnonzero(np.diff(np.concatenate([[0], binds.astype(int), [0]])))
                spans = [
                    (float(limits.t_s[i]), float(limits.t_s[j - 1])) for i, j in ends.reshape(-1, 2)
                ]
                found.append(BindingLimit(name, tuple(spans), gain))
        return tuple(sorted(found, key=lambda each: -each.gain_per_percent))


@validated
def plan_motion(
    source: str | Path | Problem | SolvedProblem,
    task: Task | str | Path,
    limits: Limits | str | Path | None = None,
    *,
    experiment: str | None = None,
    allow_code: bool = False,
    pose_limits: PoseLimit | None = None,
    solver: Solver = "reduced-space",
    robust: bool = False,
    tolerances: ReducedTolerances | None = None,
    watch: Watch | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> MotionPlan:
    """Return the motion of the hand with which points of the body follow their references.

    Ctrl-C ends the search with the best plan so far, which respects all limits but those
    of a `PathLimit`.

    Parameters
    ----------
    source : path, Problem or Run
        Run folder or run, whose estimates are used, or problem (file), whose guesses are used.
    task : Task or path
        What the points shall do; task.toml.
    limits : Limits or path, optional
        What the hand may do; limits.toml. Only a hand that does not move,
        ``free = []``, needs none.
    experiment : str, optional
        Name of the recording whose grasp, loads and surroundings the plan keeps; by default the
        first that moves.
    allow_code : bool
        Whether Python files that the problem or the task names may run.
    pose_limits : callable, optional
        ``pose_limits(position_m, rotation) -> margins``: expressions in CasADi operations that must
        not be positive, of the position (3,) and the rotation matrix (3, 3) of the hand in the
        frame of the poses, such as limits of joints; by default those of the task.
    solver : {"reduced-space", "interior-point"}
        Gauss–Newton steps in the space of the hand's unknowns, or IPOPT after these, with the
        positions of all nodes as variables.
    robust : bool
        Whether the objective is its mean over the noise of the constants; a run is needed.
    tolerances : ReducedTolerances, optional
        Tolerances of the search in the reduced space.
    watch : callable, optional
        Called with the number of each iterate and its objective.
    say : callable, optional
        Called with the present activity, a text.

    Raises
    ------
    InputError
        For mistakes in the files, a task that does not fit the body, and limits that exclude every
        motion.
    SimulationError
        If the body has no initial equilibrium, or the motion cannot be simulated.
    """
    if not isinstance(task, Task):
        task = Task.read(task)
    if limits is None and task.hand.free:
        raise InputError(
            "missing; expected the limits of the hand, or free = [] in [hand] of the task, with which "
            "only tendons and pressures act",
            None,
            where="--limits",
        )
    if not isinstance(limits, Limits):
        limits = STANDING if limits is None else Limits.read(limits)
    say("reading the body")
    body = PlannedBody.read(source, experiment, allow_code=allow_code)
    if task.hand.joint_limits is not None and pose_limits is None:
        code = task.hand.joint_limits
        loader = CodeLoader(Path(), is_allowed=allow_code)
        _, pose_limits = loader.function(code.file, code.function, "hand.joint_limits.file")
    if robust and (body.statistical_covariance is None or solver != "reduced-space"):
        raise InputError(
            "a robust plan needs a run with uncertainties, and the solver reduced-space",
            None,
            where="--robust",
        )
    began_s = time.perf_counter()

    def solve(duration_s: float) -> tuple[PlannedProgram, PlanAnswer]:
        """Return the plan of the task with a duration."""
        say(f"searching for a motion of {duration_s:.3g} s")
        of_duration = task if duration_s == task.duration_s else task.stretched(duration_s)
        program = PlannedProgram.from_task(body, of_duration, limits, pose_limits)
        if solver == "interior-point":
            require_full_program(program)
        scenarios = program.scenarios() if robust else ()
        start = None if program.criterion is None else informative_motion(program)
        answer = solve_reduced(program, start, scenarios, tolerances=tolerances, watch=watch)
        if robust:
            answer.x = program.simulate(answer.c)
        if solver == "interior-point" and answer.status != "interrupted":
            say("improving the motion by IPOPT")
            answer = solve_full(program, answer, watch=watch)
        return program, answer

    def suffices(program: PlannedProgram, answer: PlanAnswer) -> bool:
        if program.exceeds_path_limits(answer.x):
            return False
        if program.criterion is not None:
            return program.criterion.suffices(answer.c, answer.x)
        return task.largest_error_m is None or (
            program.largest_error_m(answer.x) <= task.largest_error_m
        )

    def attempt(duration_s: float) -> tuple[PlannedProgram, PlanAnswer] | None:
        """Return the plan with a duration; None if its error is too large, or there is none: the
        plan of another duration must not be lost.
        """
        try:
            found = solve(duration_s)
        except (HandLimitsExcludeTask, SimulationError, InputError, np.linalg.LinAlgError):
            return None
        if found[1].status == "interrupted":
            raise KeyboardInterrupt
        return found if suffices(*found) else None

    sufficient_s = None
    try:
        program, answer = solve(task.duration_s)
    except HandLimitsExcludeTask as error:
        program = PlannedProgram.from_task(body, task, limits, pose_limits)
        raise InputError(_contradiction(program), None, where="hand") from error
    except np.linalg.LinAlgError as error:
        raise InputError(f"{error}; state wider limits", None, where="hand") from error
    is_enough = suffices(program, answer)
    has_error = not is_enough and task.information is None and task.largest_error_m is not None
    if answer.status != "interrupted" and (task.shortest or has_error):
        with suppress(KeyboardInterrupt):  # the plan of the stated duration remains
            first = (program, answer) if is_enough else None
            found = shortest(attempt, task.duration_s, first)
            if found is not None and task.shortest:
                program, answer = found[1]
            elif found is not None:
                sufficient_s = found[0]
    seconds = time.perf_counter() - began_s
    say("simulating the plan with fine time steps")
    return MotionPlan(program, answer, _finely_simulated(program, answer.c), seconds, sufficient_s)


def _farthest(displacements_m: Array) -> float:
    return float(np.linalg.norm(displacements_m, axis=1).max())


def _finely_simulated(program: PlannedProgram, c: Array) -> Trajectory:
    """Return the simulation of a plan with `FINER` time steps for each of the plan's."""
    problem = program.body.problem
    values = problem.parameters.values(program.body.q)
    substeps = FINER * program.driven.transcription.substeps
    experiment = program.moved_experiment(c)
    return simulate(experiment, values, integrator=problem.scheme, substeps=substeps)


def _contradiction(program: PlannedProgram) -> str:
    """Return the message that no motion of the hand respects its limits."""
    hand = program.task.hand
    ends = [
        f"{key} = {list(value)}"
        for key, value in (("end_m", hand.end_m), ("end_rotation_deg", hand.end_rotation_deg))
        if value is not None
    ]
    enough_s = shortest_of_hand(program)
    longer = "" if enough_s is None else f" ({enough_s:.3g} s suffice)"
    return (
        f"no motion of {program.task.duration_s:g} s from rest to rest respects the limits with "
        f"{' and '.join(ends) or 'the joint limits'}; expected a longer duration_s{longer}, a nearer "
        "end, or wider limits of speed and acceleration"
    )
