"""What all frames say together: a recording that is solved as any other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..methods.reduced_space import ReducedSpace
from ..pipeline import Run, run
from ..problem import Problem
from ..recording.clock import STEP_TOLERANCE
from ..recording.experiment import Experiment
from ..recording.gauge import Gauge
from ..recording.poses import PoseSequence
from .intake import Intake
from .model import Model
from .sweep import LoggedRow

# A motion has no fewer samples.
FEWEST = 3


def recording_of(model: Model, intake: Intake, log: Sequence[LoggedRow]) -> Experiment | None:
    """The experiment with the poses and markers of all rows, from the first frame on.

    None where there are too few, or where markers were seen between samples.
    """
    experiment, at_samples = model.experiment, log[:: model.substeps]
    t_s = experiment.t_s[0] + model.interval_s * np.arange(len(at_samples))
    tracks_m = np.full((len(t_s), len(experiment.markers.names), 3), np.nan)
    for when, tracks in intake.seen(log):
        if abs(when - round(when)) > STEP_TOLERANCE:
            return None
        if round(when) < len(t_s):
            tracks_m[round(when)] = tracks
    if len(t_s) < FEWEST or np.isnan(tracks_m).all():
        return None
    grasps = [replace(grasp, wrench=None) for grasp in experiment.grasps]
    for k, number in enumerate(model.moved_grasps):
        matrices = np.tile(np.eye(4), (len(t_s), 1, 1))
        for matrix, row in zip(matrices, at_samples, strict=True):
            matrix[:3, :3], matrix[:3, 3] = row.poses[k]
        smooth = grasps[number].poses.interpolation
        poses = PoseSequence.from_matrices(t_s, matrices, smooth)
        grasps[number] = replace(grasps[number], poses=poses)
    markers, readings = replace(experiment.markers, t_s=t_s, positions_m=tracks_m), []
    for number, gauge in enumerate((*experiment.readings, *model.wrenches), 1):
        told = {when: values for of, when, values in intake.told(log) if of == number}
        inside = [when for when in sorted(told) if when <= len(t_s) - 1]
        values = np.array([told[when] for when in inside])
        if len(inside) < FEWEST or not np.isfinite(values).any():
            continue
        seen = {"t_s": t_s[0] + model.interval_s * np.array(inside), "values": values}
        if isinstance(gauge, Gauge):
            readings.append(replace(gauge, **seen))
        else:
            wrench = replace(model.wrenches[gauge], **seen)
            grasps[gauge - 1] = replace(grasps[gauge - 1], wrench=wrench)
    return replace(experiment, t_s=t_s, grasps=grasps, markers=markers, readings=readings)


def solved(problem: Problem, recording: Experiment) -> Run:
    """The batch's run of a recording.

    Raises
    ------
    InputError
        Where it is refused, see `run`.
    """
    options = replace(problem.uncertainty, profile=())
    whole = replace(problem, experiments=[recording], uncertainty=options)
    return run(whole, problem.solver(ReducedSpace.name), seek_causes=False)
