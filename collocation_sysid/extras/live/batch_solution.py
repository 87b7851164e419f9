"""Batch solution of a live recording after its last frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...methods.reduced_space import ReducedSpace
from ...pipeline import Run, run
from ...problem import Problem
from ...program.streaming import LoggedRow, StreamingModel
from ...recording.experiment import Experiment
from ...recording.measurement import Measurement
from ...recording.poses import PoseSequence
from ...recording.sample_times import STEP_TOLERANCE
from .frame_buffer import FrameBuffer

# Smallest number of samples of a motion.
FEWEST = 3


def recording_from_log(
    model: StreamingModel, intake: FrameBuffer, log: Sequence[LoggedRow]
) -> Experiment | None:
    """Return the model's experiment with the poses, markers and samples of all rows.

    Its times are those of the model's experiment at the same interval, whatever the times of the
    frames. Samples of a custom sensor or grasp sensor replace its stated series; if fewer than
    three are within the rows, or all are NaN, the sensor is left out. Missing markers are NaN.
    Samples after the last row are left out.

    None if there are fewer than three sample times or no measured marker, or if markers were
    measured between samples.

    Parameters
    ----------
    model : StreamingModel
        Model whose experiment gives everything but the measurements.
    intake : FrameBuffer
        Buffer with the samples that still wait for rows, which are included.
    log : sequence of LoggedRow
        All rows, substeps included, with their samples.
    """
    experiment = model.experiment
    at_samples = log[:: model.collocation.substeps]
    t_s = experiment.t_s[0] + model.experiment.timestep_s * np.arange(len(at_samples))
    tracks_m = np.full((len(t_s), len(experiment.markers.names), 3), np.nan)
    for when, tracks in intake.marker_samples(log):
        if abs(when - round(when)) > STEP_TOLERANCE:
            return None
        if round(when) < len(t_s):
            tracks_m[round(when)] = tracks
    if len(t_s) < FEWEST or np.isnan(tracks_m).all():
        return None
    grasps = list(experiment.grasps)
    for k, number in enumerate(model.moving_grasps):
        matrices = np.tile(np.eye(4), (len(t_s), 1, 1))
        for matrix, row in zip(matrices, at_samples, strict=True):
            matrix[:3, :3], matrix[:3, 3] = row.poses[k]
        smooth = grasps[number].poses.interpolation
        poses = PoseSequence.from_matrices(t_s, matrices, interpolation=smooth)
        grasps[number] = replace(grasps[number], poses=poses)
    # Instruments are numbered from 1: custom sensors first, then the sensors of grasps.
    count = len(experiment.readings)
    numbers = iter([*range(count + 1, count + len(experiment.wrenches) + 1), *range(1, count + 1)])
    measurements: list[Measurement | None] = []
    for sensor in experiment.measurements:
        if sensor is experiment.markers:
            measurements.append(sensor.with_samples(t_s, tracks_m))
            continue
        number = next(numbers)
        samples = {when: values for of, when, values in intake.all_samples(log) if of == number}
        inside = [when for when in sorted(samples) if when <= len(t_s) - 1]
        values = np.array([samples[when] for when in inside])
        is_measured = len(inside) >= FEWEST and bool(np.isfinite(values).any())
        at_s = t_s[0] + model.experiment.timestep_s * np.array(inside)
        measurements.append(sensor.with_samples(at_s, values) if is_measured else None)
    return experiment.with_measurements(measurements, t_s=t_s, grasps=grasps)


def solve_recording(problem: Problem, recording: Experiment) -> Run:
    """Return the run of a recording, solved as a batch by reduced space, without profile
    likelihoods and search for causes.

    Parameters
    ----------
    problem : Problem
        Problem with parameters, scheme and options; its experiments are not used, and it is not
        modified.
    recording : Experiment
        The only experiment to fit.

    Raises
    ------
    InputError
        If the recording is refused, see `run`.
    """
    options = replace(problem.uncertainty, profile=())
    batch_problem = replace(problem, experiments=[recording], uncertainty=options)
    return run(batch_problem, problem.solver(ReducedSpace.name), seek_causes=False)
