"""Forward simulations with the estimates, and their comparison with the measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..arrays import Array
from ..errors import InputError, SimulationError
from ..fem.kernels import side_by_side
from ..methods.complementarity import with_energy
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution
from ..model.schemes import MOST_STEPS, as_scheme
from ..problem import Problem
from ..program.channel import Forced, Motion
from ..program.collocation import Part
from ..program.depth_comparison import DepthError, SurfaceComparison
from ..program.gauge import gauge_readings
from ..program.segment import Segment
from ..program.simulation import Trajectory, simulate
from ..program.wrench_channel import Grid
from ..recording import Experiment
from ..statistics.estimates import Estimate
from ..statistics.linearised import LinearisedFit, values_of
from ..statistics.numerical import Refinement, changes_towards, numerical_errors
from .prediction import (
    CopyError,
    Misfit,
    Predicted,
    PredictionError,
    blind_phi,
    copy_error,
    misfits,
    prediction_error,
)

# Least ratio of grid step and simulation step for an estimate of the step's error: half, rounded.
LEAST_FINER = 1.99


@dataclass(frozen=True, eq=False)
class Rollout:
    """A forward simulation with the estimated parameters, compared with the measurements.

    Attributes
    ----------
    rms_m, max_m : float
        RMS and largest distance of the markers from the measurements; zero without markers.
    trajectory : Trajectory
        Its markers are predicted with the experiment's nuisance parameters.
    nuisance : mapping of name to value
        Nuisance parameters of an experiment for validation, fitted to it at the estimated material;
        those of places are displacements from their start. Empty for fitted experiments.
    places_m : mapping of marker to place [x, y, z]
        Marker places, for validation likewise.
    wrenches : tuple of (S, 6)
        Predicted wrenches of the sensors of its grasps; NaN where unknown.
    wrench_rms : (force, torque)
        RMS difference of force [N] and torque [N m]; None where there is none.
    readings : mapping of name to (S, m)
        Predicted values of custom sensors.
    reading_rms : mapping of name to float
        RMS difference of each custom sensor.
    surfaces : mapping of the name of a depth camera to SurfaceComparison
        Its points against the simulated surface.
    misfits : tuple of Misfit
        Differences of each instrument over its stated σ.
    blind : PredictionError or None
        Of an experiment for validation: the error with the nuisance parameters of the fitted
        recordings in place of its own; None where that cannot be simulated.
    copied : CopyError or str
        Of an experiment for validation: the error of a fitted recording's measurements, or why
        there is none. Empty for fitted experiments.
    """

    rms_m: float
    max_m: float
    trajectory: Trajectory
    nuisance: Mapping[str, float]
    places_m: Mapping[str, list[float]]
    wrenches: Sequence[Array] = ()
    wrench_rms: tuple[float | None, float | None] = (None, None)
    readings: Mapping[str, Array] = field(default_factory=dict)
    reading_rms: Mapping[str, float] = field(default_factory=dict)
    surfaces: Mapping[str, SurfaceComparison] = field(default_factory=dict)
    misfits: tuple[Misfit, ...] = ()
    blind: PredictionError | None = None
    copied: CopyError | str = ""

    @property
    def depth(self) -> dict[str, DepthError]:
        """Distances of depth cameras' points from the simulated surface, by camera."""
        return {name: surface.error for name, surface in self.surfaces.items()}


def roll_outs(problem: Problem, solution: Solution) -> dict[str, Rollout | str]:
    """Simulate all experiments in parallel threads; results by experiment name, see `roll_out`."""
    threads = solution.collocation.threads
    rollouts = side_by_side(lambda e: roll_out(problem, e, solution), problem.experiments, threads)
    return {e.name: each for e, each in zip(problem.experiments, rollouts, strict=True)}


def roll_out(problem: Problem, experiment: Experiment, solution: Solution) -> Rollout | str:
    """Simulate an experiment with a solution's parameters; return the reason if that fails."""
    try:
        segment, phi = _seen(experiment, solution)
        trajectory = _simulated(problem, segment, phi, solution)
    except (InputError, SimulationError) as error:
        # A density that leaves a node without mass is input of who simulates, but found here.
        return str(error)
    predicted, surfaces = _predicted(segment, trajectory, phi)
    error = prediction_error(experiment, predicted)
    rollout = Rollout(
        rms_m=error.rms_m or 0.0,
        max_m=error.max_m or 0.0,
        trajectory=replace(trajectory, markers_m=predicted.markers_m),
        nuisance={},
        places_m={},
        wrenches=predicted.wrenches,
        wrench_rms=(error.wrench_rms_n, error.wrench_rms_nm),
        readings=predicted.readings,
        reading_rms=error.reading_rms or {},
        surfaces=surfaces,
        misfits=tuple(misfits(experiment, predicted)),
    )
    if not experiment.validation:
        return rollout
    nuisance = segment.nuisance
    places_m = segment.places_m(phi).tolist()
    fitted = [part.segment.experiment for part in solution.parts]
    return replace(
        rollout,
        nuisance=dict(zip(nuisance.names, (phi * nuisance.scales).tolist(), strict=True)),
        places_m=dict(zip(experiment.markers.names, places_m, strict=True)),
        blind=_blind(problem, segment, solution),
        copied=copy_error(experiment, fitted),
    )


def _simulated(problem: Problem, segment: Segment, phi: Array, solution: Solution) -> Trajectory:
    """Simulate a recording with its nuisance parameters φ (k,) and a solution's parameters.

    Raises
    ------
    InputError, SimulationError
        Where that fails.
    """
    integrator = problem.scheme if problem.rollout.integrator == "scheme" else "newmark"
    return simulate(
        with_energy(segment.corrected(phi)),
        segment.body.theta(solution.parameters),
        integrator,
        timestep_s=_step_s(problem, segment),
        substeps=segment.substeps,
    )


def _predicted(
    segment: Segment, trajectory: Trajectory, phi: Array
) -> tuple[Predicted, dict[str, SurfaceComparison]]:
    """Return the predictions of a recording's instruments for a simulated motion.

    Parameters
    ----------
    segment : Segment
    trajectory : Trajectory
    phi : (k,) array
        Nuisance parameters of the recording.

    Returns
    -------
    predicted : Predicted
    surfaces : mapping of the name of a depth camera to SurfaceComparison
    """
    grid, forced = trajectory.reactions
    positions_m = trajectory.positions_m
    x = positions_m.reshape(len(positions_m), -1)
    gauged = zip(segment.gauges, _gauged(segment, x, trajectory.reactions, phi), strict=True)
    surfaces = {
        reading.sighting.view.depth.name: SurfaceComparison.from_motion(
            reading, trajectory.t_s, positions_m, phi
        )
        for reading in segment.depths
    }
    predicted = Predicted(
        markers_m=segment.markers.of_samples(positions_m, phi),
        wrenches=[sensor.on(grid).of_forced(forced, phi) for sensor in segment.sensors],
        readings={gauge.gauge.name: gauge.said(each) for gauge, each in gauged},
        depth={name: surface.error for name, surface in surfaces.items()},
    )
    return predicted, surfaces


def _blind(problem: Problem, segment: Segment, solution: Solution) -> PredictionError | None:
    """Predict a recording with the nuisance parameters of the fitted ones; None if that fails."""
    phi = blind_phi(segment, solution)
    try:
        trajectory = _simulated(problem, segment, phi, solution)
    except (InputError, SimulationError):
        return None
    predicted, _ = _predicted(segment, trajectory, phi)
    return prediction_error(segment.experiment, predicted)


def _seen(experiment: Experiment, solution: Solution) -> tuple[Segment, Array]:
    """Return an experiment's transcription and its nuisance parameters φ (k,).

    For a fitted experiment φ is the estimate; for validation it is fitted at the estimated
    material.
    """
    if (part := solution.part_of(experiment.name)) is not None:
        return part.segment, part.phi
    values = solution.parameters
    body = experiment.body
    alone = replace(
        solution.collocation,
        experiments=[replace(experiment, validation=False)],
        parameters=solution.collocation.parameters.fixed_at(
            {name: values[name] for name in body.used_names(list(values))}
        ),
    )
    (segment,) = alone.segments
    # All that is left to estimate is φ.
    if not alone.nphi:
        return segment, np.zeros(0)
    return segment, alone.parameters_of(ReducedSpace()(alone).unless_interrupted().z)


def step_error(
    problem: Problem,
    solution: Solution,
    fit: LinearisedFit,
    rollouts: Mapping[str, Rollout | str],
    estimates: Mapping[str, Estimate],
) -> Refinement | None:
    """Return the effect of the time step on every parameter and modulus, to first order.

    A Gauss–Newton step is taken towards the forward simulations, which have finer steps.

    Parameters
    ----------
    problem : Problem
    solution : Solution
    fit : LinearisedFit
        The measurements linearised at the solution.
    rollouts : mapping of experiment name to Rollout or str
    estimates : mapping of name to Estimate

    Returns
    -------
    Refinement or None
        None if a simulation is missing or no finer, if all is static, and with obstacles in a
        motion: impacts within a step are not of first order, and oscillate in the forward
        simulation.
    """
    differences: list[Array] = []
    collocation = solution.collocation
    moving = [s.experiment for s in collocation.segments if not s.experiment.static]
    if not moving or any(experiment.obstacles for experiment in moving):
        return None
    for part, readings in zip(solution.parts, solution.readings_m, strict=True):
        segment = part.segment
        experiment = part.segment.experiment
        rollout = rollouts.get(experiment.name)
        share = _share(problem, segment)
        if not isinstance(rollout, Rollout) or share is None:
            return None
        way = share * (rollout.trajectory.markers_m - readings)
        differences.append(np.nan_to_num(way / experiment.markers.sigma_m[:, None]))
        fitted = solution.wrenches.get(experiment.name, [])
        for sensor, read, rolled in zip(segment.sensors, fitted, rollout.wrenches, strict=True):
            way = share * np.nan_to_num((rolled - read) / sensor.wrench.sigmas)
            differences.append(way.reshape(-1, 2, 3))
        differences += _of_gauges(part, rollout.trajectory, share)
        differences += _of_depths(part, rollout.trajectory, share)
    change = changes_towards(fit, differences)[: collocation.nq]
    q = np.clip(solution.q + change, *collocation.parameters.bounds_q)
    linear = problem.parameters.linear
    order = as_scheme(problem.scheme).order
    return Refinement(numerical_errors(estimates, [values_of(collocation, q)], [], order, linear))


def _of_gauges(part: Part, trajectory: Trajectory, share: float) -> list[Array]:
    """Return a share of the difference between simulated and fitted custom sensors, over σ.

    Of each sensor (S, G, 3).
    """
    if not (segment := part.segment).gauges:
        return []
    fitted = part.x[segment.markers.grid_rows], (Grid.of(segment.dynamics), part.motion.forced)
    rolled = trajectory.positions_m.reshape(len(fitted[0]), -1), trajectory.reactions
    here, there = (_gauged(segment, *each, part.phi) for each in (fitted, rolled))
    return [
        share * np.nan_to_num(simulated_values - fitted_values) / gauge.sigmas[:, None]
        for gauge, fitted_values, simulated_values in zip(segment.gauges, here, there, strict=True)
    ]


def _of_depths(part: Part, trajectory: Trajectory, share: float) -> list[Array]:
    """Return a share of the difference between simulated and fitted depth residuals.

    Of each camera (S, M, 3), at the correspondences of the fit.
    """
    if not (sights := part.surface_sights):
        return []
    known_s = part.segment.experiment.t_s
    rows_s = part.segment.dynamics.t_s
    fitted = part.x[part.segment.markers.grid_rows]
    way_m = share * (trajectory.positions_m.reshape(len(fitted), -1) - fitted)
    way_rows_m = np.array([np.interp(rows_s, known_s, each) for each in way_m.T])
    displacements_m = way_rows_m.T.reshape(len(rows_s), -1, 3, 1)
    return [
        reading.changes(looked, displacements_m[:, reading.sighting.skin.nodes], part.phi)[..., 0]
        for reading, looked in sights
    ]


def _gauged(segment: Segment, x: Array, reactions: tuple[Grid, Forced], phi: Array) -> list[Array]:
    """Return the predictions (S, G, 3) of custom sensors for positions x (T, 3n) at the samples."""
    grid = reactions[0]

    def forced() -> Forced:
        return reactions[1]

    motion = Motion(x, forced)
    gauges = gauge_readings(segment.experiment, segment.experiment.t_s, grid, segment.nuisance)
    return [gauge.of_motion(motion, phi) for gauge in gauges]


def _share(problem: Problem, segment: Segment) -> float | None:
    """Return the share of the difference to a forward simulation that half the step would make.

    None if the simulation is no finer than the fit; 1 for static experiments.
    """
    experiment = segment.experiment
    options = problem.rollout
    if experiment.static:
        return 1.0
    steps = experiment.timestep_s / _step_s(problem, segment) / segment.substeps
    if options.integrator != "newmark" or steps < LEAST_FINER:
        return None
    order = as_scheme(problem.scheme).order
    # Newmark's own error is of second order: beside one of the first it is none.
    remaining = steps**-order if order > 1 else 0.0
    return (1 - 0.5**order) / (1 - remaining)


def _step_s(problem: Problem, segment: Segment) -> float:
    """Return the step of the forward simulation [s]: as stated, or finer than the grid of the fit.

    By default at most a quarter of the sample interval and half the grid step.
    """
    count = min(max(4, 2 * segment.substeps), MOST_STEPS - 1)
    return problem.rollout.timestep_s or segment.experiment.timestep_s / count
