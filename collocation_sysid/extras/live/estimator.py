"""Estimation while a recording is made: the recording so far is solved again and again."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ...common.array_types import Array
from ...common.validated_classes import validated
from ...errors import InputError, SimulationError
from ...fem.laws.constants import unit_of
from ...kinds.image_tracks.tracks import ImageTracks
from ...methods.reduced_space import ReducedSpace
from ...methods.solution import Status
from ...model.point_forces import law_function
from ...pipeline import Run, run
from ...problem import Problem
from ...recording.alignment import align
from ...recording.experiment import Experiment
from ...recording.marker_files import MarkerTable
from ...recording.measurement import Measurement
from ...recording.poses import PoseSequence
from ...recording.sample_times import TIME_TOLERANCE_S
from ...recording.time_tables import FEWEST_SHARED_SAMPLES as FEWEST
from ...runs.solving import solve
from ...runs.warm_start import WarmStart
from ...statistics.estimates import Estimate
from ...statistics.linearised import linearise_fit
from ...statistics.uncertainty import uncertainty_from_fit
from .frames import KEYS, Frame, FrameReader, moving_grasps


@dataclass(frozen=True, eq=False)
class LiveUpdate:
    """Answer of one solve of the recording so far."""

    t_s: float  # time of the last frame
    estimates: Mapping[str, Estimate]  # value and statistical uncertainty of each parameter
    # Root mean square of the residuals in standard deviations of the noise; NaN without intervals.
    misfit: float
    latency_s: float  # computing time of the solve
    note: str = ""  # why there are no intervals

    def __str__(self) -> str:
        estimates = []
        for name, each in self.estimates.items():
            low, high = each.statistical95 or (np.nan, np.nan)
            interval = f" ({low:.4g} to {high:.4g})" if each.statistical95 else ""
            estimates.append(f"{name} {each.value:.4g} {unit_of(name)}".rstrip() + interval)
        end = self.note or f"misfit {self.misfit:.2f} σ"
        solved = f"{end}; solved in {self.latency_s:.2f} s"
        return f"t = {self.t_s:.2f} s: {', '.join(estimates)}; {solved}"


class LiveEstimator:
    """Estimator that collects frames and solves the recording so far.

    Parameters
    ----------
    problem : Problem
        One fitted experiment. What its grasps, markers, cameras and sensors are is used, their
        samples are not.

    Raises
    ------
    InputError
        If the problem has a feature that frames cannot describe.
    """

    @validated
    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.experiment = _only_experiment(problem)
        self._reader = FrameReader(self.experiment, problem)
        self._frames: dict[float, Frame] = {}
        self._start: WarmStart | None = None

    def add(
        self,
        t_s: float,
        pose: Any,
        markers: ArrayLike | Mapping[str, Any] | None = None,
        wrench: Any = None,
        readings: Mapping[str, Any] | None = None,
    ) -> None:
        """Add a frame. A frame of a time that is present already is ignored.

        What is missing is None, NaN, or omitted from a mapping.

        Parameters
        ----------
        t_s : float
            Time of the frame [s].
        pose : 4×4 matrix, or (position, quaternion x y z w)
            Pose of the body in the moving grasp; for several grasps a mapping by their number, as
            text from "1" on.
        markers : (M, 3) array, or mapping of name to (3,), optional
            Marker positions [m].
        wrench : (6,) or (3,) array, optional
            Wrench of the grasp on the body, fx, fy, fz [N], tx, ty, tz [N m]; for several sensors a
            mapping by the number of their grasp, as text.
        readings : mapping of name to numbers, optional
            Values of custom sensors, and pixels (N, 2) of image tracks or mappings of point to
            pixel. These and wrenches are samples at the time of the frame, or mappings with ``t_s``
            and ``values``, or lists of such mappings.

        Raises
        ------
        InputError
            If the values are not a valid frame.
        """
        values = (t_s, pose, markers, wrench, readings)
        self.add_frame(self._reader.frame(dict(zip(KEYS, values, strict=True))))

    def add_frame(self, frame: Frame) -> None:
        """Add a frame of the experiment, as `add` does."""
        self._frames.setdefault(frame.t_s, frame)

    def solve(self) -> LiveUpdate:
        """Solve the recording so far from the last answer, and return the new one.

        Constants that the last answer did not determine start from the guesses of the problem.

        Raises
        ------
        InputError
            If the frames are no recording, such as fewer than three.
        """
        began_s = time.perf_counter()
        problem = self._recorded_problem()
        solution = solve(problem, problem.solver(ReducedSpace.name), start=self._start)
        if solution.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        self._start = None
        parameters = solution.collocation.parameters
        values = parameters.scalar_values(solution.q)
        estimates: Mapping[str, Estimate] = {name: Estimate(each) for name, each in values.items()}
        misfit, note = np.nan, "" if solution.status.converged else solution.message
        if not note:
            try:
                fit = linearise_fit(solution.collocation, solution.z)
                known = uncertainty_from_fit(fit, parameters, solution.q, problem.uncertainty)
            except (InputError, SimulationError) as error:
                note = f"no intervals: {error}"
            else:
                estimates, misfit = known.estimates, float(np.sqrt(known.reduced_chi_squared))
                start = WarmStart.of(solution)
                # A search could not leave the bound of a constant that is not determined.
                determined = {
                    n: value
                    for n, value in start.values.items()
                    if n not in estimates or estimates[n].statistical_std_error is not None
                }
                if any(item.name in determined for item in problem.parameters.free):
                    self._start = replace(start, values=determined)
        latency_s = time.perf_counter() - began_s
        return LiveUpdate(max(self._frames), estimates, misfit, latency_s, note)

    def finish(self) -> Run:
        """Return the run of the complete recording, from the guesses of the problem, without
        profile likelihoods and hypotheses about misfits; errors as of `solve` and `run`.
        """
        problem = self._recorded_problem()
        return run(problem, problem.solver(ReducedSpace.name), seek_causes=False)

    def _recorded_problem(self) -> Problem:
        options = replace(self.problem.uncertainty, profile=())
        return replace(self.problem, experiments=[self._recording()], uncertainty=options)

    def _recording(self) -> Experiment:
        """Return the experiment with the frames so far, whose times begin at zero; sensors with
        fewer than three samples are left out.
        """
        experiment = self.experiment
        frames = [self._frames[t_s] for t_s in sorted(self._frames)]
        origin_s = min(self._frames, default=0.0)
        grasps = list(experiment.grasps)
        numbers = moving_grasps(experiment)
        poses = []
        for number in numbers:
            known = {f.t_s - origin_s: f.poses[number] for f in frames if number in f.poses}
            if len(known) < FEWEST:
                raise InputError(
                    f"found {len(known)} poses of grasp {number}; expected at least {FEWEST}"
                )
            how = grasps[number - 1].poses.interpolation
            poses.append(PoseSequence.from_matrices([*known], [*known.values()], how))
        t_s = np.array([frame.t_s for frame in frames]) - origin_s
        tracks_m = np.array([frame.tracks_m for frame in frames])
        aligned = align(poses, MarkerTable(t_s, experiment.markers.names, tracks_m))
        t_s = aligned.t_s
        for number, sequence in zip(numbers, aligned.poses, strict=True):
            grasps[number - 1] = replace(grasps[number - 1], poses=sequence)
        samples: dict[str | int, dict[float, Array]] = {}
        for frame in frames:
            for key, at_s, sample in frame.samples:
                samples.setdefault(key, {})[at_s - origin_s] = sample
        keys = iter([*experiment.sensors_by_grasp, *(each.name for each in experiment.readings)])
        measurements: list[Measurement | None] = []
        for sensor in experiment.measurements:
            if sensor is experiment.markers:
                markers = experiment.markers.with_samples(t_s, aligned.table.positions_m)
                measurements.append(replace(markers, offsets_s=aligned.table.offsets_s))
                continue
            of_sensor = samples.get(next(keys), {})
            first_s, last_s = t_s[0] - TIME_TOLERANCE_S, t_s[-1] + TIME_TOLERANCE_S
            times = [each for each in sorted(of_sensor) if first_s <= each <= last_s]
            values = np.array([of_sensor[each] for each in times])
            has_enough = len(times) >= FEWEST and np.isfinite(values).any()
            measurements.append(sensor.with_samples(times, values) if has_enough else None)
        return experiment.with_measurements(measurements, t_s=t_s, grasps=grasps)


def _only_experiment(problem: Problem) -> Experiment:
    """Return the single fitted experiment of a problem, which frames can describe."""
    fitted = [each for each in problem.experiments if not each.validation]
    if len(fitted) != 1:
        raise InputError(
            f"found {len(fitted)} experiments that are fitted; expected one: remove the others, or "
            "give them validation = true",
            problem.path,
            where="experiment",
        )
    (experiment,) = fitted
    tracks = [each for each in experiment.readings if isinstance(each, ImageTracks)]
    filmed = [each for each in experiment.readings if each.counts_pixels]
    holds_s = [(grasp.from_s, grasp.until_s) for grasp in experiment.grasps]
    loads = (experiment.point_mass_at_nodes_kg, experiment.declared_node_forces_n)
    is_constant = all(
        np.ptp(each, axis=0).max(initial=0.0) <= 1e-6 * np.abs(each).max(initial=0.0)
        for each in (f(experiment.t_s) for f in loads)
    )
    laws = [law_function(each.force, each.points.dofs) for each in experiment.body.placed_forces]
    is_constant &= not any(law.depends_on_first_datum for law in laws)
    unsupported = {
        "a static experiment": experiment.is_static,
        'start = "given"': experiment.start == "given",
        "tendons and pressures": experiment.actuators,
        "depth cameras": experiment.depths,
        "outlines": len(filmed) > len(tracks),
        "a camera that moves": any(each.camera.poses is not None for each in tracks),
        "a grasp that holds during a part of the recording": np.isfinite(holds_s).any(),
        "an experiment whose grasps never move": not moving_grasps(experiment),
        "loads that change in time": not is_constant,
    }
    for feature, is_present in unsupported.items():
        if is_present:
            raise InputError(
                f"found {feature}; expected none, because frames cannot describe it",
                problem.path,
                where=f"experiment '{experiment.name}'",
            )
    return experiment
