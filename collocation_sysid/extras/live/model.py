"""Model of the recording of a problem that is estimated live, and the batch solution at its end.

Problems with features that live estimation does not support are refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ...errors import InputError
from ...features.image_tracks.tracks import ImageTracks
from ...methods.reduced_space import ReducedSpace
from ...methods.starts.stiffness_scan import typical_parameters
from ...model.point_forces import law_function
from ...pipeline import Run, run
from ...problem import Problem
from ...program.streaming import LoggedRow, StreamingModel
from ...recording.custom_sensor import FollowingSensor
from ...recording.experiment import Experiment
from ...recording.measurement import Measurement
from ...recording.poses import PoseSequence
from ...recording.sample_times import STEP_TOLERANCE
from .frame_buffer import FrameBuffer

# Young's modulus at which a search without a guess starts [Pa].
MIDDLE_PA = 1e4
# Smallest number of samples of a motion.
FEWEST = 3


def model_from_problem(problem: Problem) -> StreamingModel:
    """Return the model for live estimation of a problem with one fitted experiment; held-out
    experiments are ignored, and the problem is not modified.

    Parameters without a guess take typical values for the stiffness `MIDDLE_PA`; those with a guess
    keep it.

    Raises
    ------
    InputError
        If not exactly one experiment is fitted, or if it has a feature that live estimation does
        not support.
    """
    experiment = _only_experiment(problem)
    collocation = problem.collocation()
    if collocation.parameters.names_without_guess:
        usual = typical_parameters(collocation.parameters, MIDDLE_PA)
        collocation = replace(collocation, parameters=usual)
    return StreamingModel.from_collocation(experiment, collocation)


def _only_experiment(problem: Problem) -> Experiment:
    """Return the single fitted experiment of a problem."""
    fitted = [each for each in problem.experiments if not each.validation]

    if len(fitted) != 1:
        raise InputError(
            f"found {len(fitted)} experiments that are fitted; expected one, because a live "
            "estimate has one: remove the others, or give them validation = true",
            problem.path,
            where="experiment",
        )
    (experiment,) = fitted
    for feature, is_present, expected in _unsupported_features(experiment):
        if is_present:
            where = f"experiment '{experiment.name}'"
            message = f"live estimates do not support {feature}"
            raise InputError(f"{message}; expected {expected}", problem.path, where=where)
    return experiment


def _unsupported_features(experiment: Experiment) -> Iterator[tuple[str, object, str]]:
    """Yield for each feature that live estimation lacks, whether the experiment has it or not: its
    description, a value that is true if the experiment has the feature, and the supported
    alternative.
    """
    body = experiment.body
    grasps = experiment.grasps
    nuisance = experiment.nuisance
    yield "a static experiment", experiment.is_static, "a motion"
    has_declared_start = experiment.start == "given"
    yield ('start = "given"', has_declared_start, 'start = "equilibrium" or "undeformed"')
    yield ("a material with memory", body.has_memory, "one without Prony branches")
    yield ("a mesh made under gravity", body.scan_conditions is not None, "a stress-free one")
    has_internal_variables = any(
        placed.force.internal_variable_count for placed in body.placed_forces
    )
    yield "a force with internal variables", has_internal_variables, "none"
    yield (
        "tendons and pressures, because frames do not contain their values",
        experiment.actuators,
        "none",
    )
    yield ("depth cameras, because frames do not contain their images", experiment.depths, "none")
    tracks = [each for each in experiment.readings if isinstance(each, ImageTracks)]
    filmed = [each for each in experiment.readings if each.counts_pixels]
    outlines = len(filmed) > len(tracks)
    yield "outlines, because frames do not contain masks", outlines, "image tracks or markers"
    carried = any(each.camera.poses is not None for each in tracks)
    yield "a camera that moves, because frames do not contain its poses", carried, "one at rest"
    drifts = any(each.drift_px(experiment) for each in tracks)
    yield "drifts of tracks that are estimated", drifts, "drift_sigma_px = 0"
    following = [each for each in experiment.readings if isinstance(each, FollowingSensor)]
    yield "sensors whose nodes follow the estimates", following, "sensors of fixed points"
    delayed = experiment.obstacles and nuisance.obstacle_time_s
    yield ("an obstacle whose delay is estimated", delayed, "one whose clock is known")
    filtered = nuisance.sensor_lag_s and experiment.sensors_by_grasp
    yield "a sensor with a low-pass (sensor_lag)", filtered, "one without"
    laws = (law_function(each.force, each.points.dofs) for each in body.placed_forces)
    depends_on_time = any(law.depends_on_datum(0) for law in laws)
    yield "a force that depends on time", depends_on_time, "one that does not"
    nothing = not experiment.markers.names and not experiment.readings
    yield "an experiment of wrenches alone", nothing, "markers, image tracks or readings"
    is_temporary = any(np.isfinite([g.from_s, g.until_s]).any() for g in grasps)
    yield (
        "a grasp that holds during a part of the recording",
        is_temporary,
        ("grasps that hold throughout"),
    )
    has_zero = any(grasp.zero for grasp in grasps)
    yield "a grasp whose zero is estimated", has_zero, "one whose zero is known"
    moves = any(len(grasp.poses.t_s) > 1 for grasp in grasps)
    yield ("an experiment whose grasps never move", not moves, "a pose that moves")
    loads = (
        each(experiment.t_s)
        for each in (experiment.point_mass_at_nodes_kg, experiment.declared_node_forces_n)
    )
    changing = not all(np.allclose(each, each[:1]) for each in loads)
    yield "a load that changes in time", changing, "constant loads"


def recording_from_log(
    model: StreamingModel, intake: FrameBuffer, log: Sequence[LoggedRow]
) -> Experiment | None:
    """Return the model's experiment with the poses, markers and samples of all rows.

    Its times are those of the model's experiment at the same interval, whatever the times of the
    frames. Samples of a custom sensor or grasp sensor replace its stated series; if fewer than
    three are within the rows, or all are NaN, the sensor is left out. Missing markers are NaN.
    Samples after the last row are left out.

    None if there are fewer than three sample times or nothing is measured, or if markers were
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
    if len(t_s) < FEWEST:
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
    has_markers = np.isfinite(tracks_m).any()
    if not has_markers and (
        experiment.markers.names or not any(each is not None for each in measurements)
    ):
        return None
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
