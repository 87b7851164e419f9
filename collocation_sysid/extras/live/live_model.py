"""Model of the recording of a problem that is estimated live: `model_from_problem`.

Problems with features that live estimation does not support are refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ...errors import InputError
from ...methods.starts.stiffness_scan import typical_parameters
from ...model.point_forces import law_function
from ...problem import Problem
from ...program.streaming import StreamingModel
from ...recording.custom_sensor import FollowingSensor
from ...recording.experiment import Experiment

# Young's modulus at which a search without a guess starts [Pa].
MIDDLE_PA = 1e4


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
    if collocation.parameters.list_names_without_guess():
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
    following = [each for each in experiment.readings if isinstance(each, FollowingSensor)]
    yield "sensors whose nodes follow the estimates", following, "sensors of fixed points"
    delayed = experiment.obstacles and nuisance.obstacle_time_s
    yield ("an obstacle whose delay is estimated", delayed, "one whose clock is known")
    filtered = nuisance.sensor_lag_s and experiment.sensors_by_grasp
    yield "a sensor with a low-pass (sensor_lag)", filtered, "one without"
    laws = (law_function(each.force, each.points.dofs) for each in body.placed_forces)
    depends_on_time = any(law.depends_on_datum(0) for law in laws)
    yield "a force that depends on time", depends_on_time, "one that does not"
    yield ("an experiment without markers", not experiment.markers.names, "markers")
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
