"""Small experiments with instrumented grasps, and their wrenches at the true parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from collocation_sysid.model.parameters import Parameters
from collocation_sysid.program.collocation import Collocation, ExperimentIterate
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.simulation import with_wrenches
from collocation_sysid.program.wrench_residual import WrenchResidual
from collocation_sysid.recording import Experiment, Nuisance, Wrench
from kit.problems import TRUTH, as_theta, hung_cube, measured_with

SIGMA_N, SIGMA_NM = 1e-3, 1e-4
POINT_M = (0.02, -0.01, 0.12)
EVERYTHING = Nuisance(
    gravity_rad=0.03,
    hand_eye_m=0.002,
    hand_eye_rad=0.02,
    sensor_time_s=0.001,
    sensor_lag_s=0.003,
    tool_kg=0.01,
    tool_m=0.02,
)


def sensing(experiment: Experiment, t_s: np.ndarray | None = None, **changes) -> Experiment:
    """The experiment with a sensor of all components at every grasp, not measured yet."""
    times = experiment.t_s if t_s is None else t_s
    given = {"sigma_nm": SIGMA_NM, "point_m": POINT_M} | changes
    sensor = Wrench(times, np.zeros((len(times), 6)), SIGMA_N, **given)
    grasps = [replace(grasp, wrench=sensor) for grasp in experiment.grasps]
    return replace(experiment, grasps=grasps)


def fitted(
    experiment: Experiment, parameters: Parameters, scheme: str = "midpoint", **options
) -> Collocation:
    """The problem of one experiment."""
    return Collocation([experiment], parameters, scheme, **options)


def felt(experiment: Experiment) -> Experiment:
    """The experiment with wrenches that nobody would measure, a tenth of them missing."""
    rng = np.random.default_rng(3)
    values = [
        np.where(rng.random(w.values.shape) < 0.1, np.nan, 0.01 * rng.normal(size=w.values.shape))
        for w in (grasp.wrench for grasp in experiment.grasps)
        if w is not None
    ]
    return with_wrenches(experiment, values)


def sensed(
    experiment: Experiment, truth: Mapping[str, float] = TRUTH, scheme: str = "midpoint"
) -> Experiment:
    """The experiment with the tracks, and the wrenches, that parameters give it in a scheme."""
    made = measured_with(experiment, truth, scheme)
    collocation = fitted(made, Parameters.from_mapping(dict(truth)), scheme)
    (transcription,) = collocation.transcriptions
    x = simulate_scheme(experiment, transcription.dynamics.with_theta(as_theta(truth)))
    (part,) = collocation.iterates_at(np.zeros(collocation.nphi), [x])
    return with_wrenches(made, predicted_wrenches(part))


def predicted_wrenches(part: ExperimentIterate) -> list[np.ndarray]:
    """What each sensor of an experiment reads by the model."""
    return [
        each.numbers(each.predict_motion(part.motion_for(each.observable), part.phi))
        for each in part.transcription.residuals_of(WrenchResidual)
    ]


def wristed_cube(steps: int = 12, nuisance: Nuisance | None = None, **changes) -> Experiment:
    """The hung cube in a hand with a sensor."""
    cube = hung_cube(steps) if nuisance is None else hung_cube(steps, nuisance=nuisance)
    return sensing(cube, **changes)


def without_grasp_sensors(experiment: Experiment) -> Experiment:
    """The experiment without the sensors of grasps."""
    at_grasp = {*experiment.wrenches, *(g for g in experiment.readings if g.grasp is not None)}
    return experiment.with_measurements(
        None if each in at_grasp else each for each in experiment.measurements
    )
