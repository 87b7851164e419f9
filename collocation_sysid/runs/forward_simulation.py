"""Forward simulations with the estimates, and their comparison with the measurements."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..common.array_types import Array
from ..common.step_counting import StepUnit, complete_steps, counted_phase
from ..errors import InputError, SimulationError
from ..fem.kernels import map_experiments
from ..methods.complementarity import with_contact_energy
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution
from ..model.schemes import MOST_STEPS, as_scheme
from ..problem import Problem
from ..program.collocation import ExperimentIterate
from ..program.custom_sensor_residual import custom_sensor_residuals
from ..program.depth.depth_comparison import DepthError, SurfaceComparison
from ..program.observables import ObservedMotion, ReactionForces
from ..program.simulation import Trajectory, simulate
from ..program.transcription import Transcription
from ..program.wrench.wrench_observable import ReactionGrid
from ..recording import Experiment
from ..statistics.budget.discretisation_error import (
    Refinement,
    change_in_observations,
    discretisation_errors,
)
from ..statistics.estimates import Estimate
from ..statistics.linearised import LinearisedFit, parameter_values
from .prediction import (
    CopyError,
    InstrumentMisfit,
    InstrumentPrediction,
    PredictionErrors,
    instrument_misfits,
    nearest_recording_error,
    nuisance_of_fitted_recordings,
    prediction_error,
)

# Least ratio of grid step and simulation step for an estimate of the step's error: half, rounded.
LEAST_STEP_RATIO = 1.99


@dataclass(frozen=True, eq=False)
class ForwardSimulation:
    """A forward simulation with the estimated parameters, compared with the measurements.

    Attributes
    ----------
    rms_m, max_m : float
        RMS and largest distance of the markers from the measurements [m]; zero without markers.
    trajectory : Trajectory
        Its markers are predicted with the experiment's nuisance parameters.
    nuisance : mapping of name to value
        Nuisance parameters of an experiment for validation, fitted to it at the estimated material;
        those of places are displacements from their start. Empty for fitted experiments.
    places_m : mapping of marker to place [x, y, z]
        Marker places on the undeformed body, fitted likewise; empty for fitted experiments.
    wrenches : sequence of (S, 6)
        Predicted forces [N] and torques [N m] of the sensors of grasps; NaN where unknown.
    wrench_rms : (force, torque)
        RMS difference of force [N] and torque [N m]; None where there is none.
    readings : mapping of name to (S, m)
        Predicted values of custom sensors.
    reading_rms : mapping of name to float
        RMS difference of each custom sensor.
    depth_surfaces : mapping of the name of a depth camera to SurfaceComparison
        Its points against the simulated surface.
    misfits : tuple of InstrumentMisfit
        Differences of each instrument over its stated σ.
    blind_error : PredictionErrors or None
        Of an experiment for validation: the error with the nuisance parameters of the fitted
        recordings in place of its own; None where that cannot be simulated.
    copy_error : CopyError or str
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
    depth_surfaces: Mapping[str, SurfaceComparison] = field(
        default_factory=dict
    )
    misfits: tuple[InstrumentMisfit, ...] = ()
    blind_error: PredictionErrors | None = None
    copy_error: CopyError | str = ""

    @property
    def depth(self) -> dict[str, DepthError]:
        """Distances of depth cameras' points from the simulated surface, by camera."""
        return {
            name: surface.error for name, surface in self.depth_surfaces.items()
        }


def simulate_experiments(
    problem: Problem, solution: Solution
) -> dict[str, ForwardSimulation | str]:
    """Simulate all experiments of a problem, also those for validation, in parallel threads with
    the estimates of a solution, and return the results by experiment name; text is the reason why a
    simulation failed, see `simulate_experiment`.

    The progress is reported to the counters of `counted_phase`.

    Raises
    ------
    KeyboardInterrupt
        If the fit of the nuisance parameters of a validation experiment is interrupted.
    """
    threads = solution.collocation.threads

    def simulate_counted(experiment: Experiment) -> ForwardSimulation | str:
        """Simulate an experiment, and report its completed share."""
        completed = 0.0

        def report(share: float) -> None:
            """Add the increase of the completed share, from 0 to 1, to the counter of the phase."""
            nonlocal completed
            complete_steps(StepUnit.SIMULATION, share - completed)
            completed = share

        return simulate_experiment(
            problem, experiment, solution=solution, report=report
        )

    with counted_phase(StepUnit.SIMULATION, len(problem.experiments)):
        rollouts = map_experiments(
            simulate_counted, problem.experiments, threads=threads
        )
    return {
        e.name: each
        for e, each in zip(problem.experiments, rollouts, strict=True)
    }


def simulate_experiment(
    problem: Problem,
    experiment: Experiment,
    solution: Solution,
    report: Callable[[float], None] | None = None,
) -> ForwardSimulation | str:
    """Simulate an experiment with the parameters of a solution, and compare it with the
    measurements; return the reason as text if that fails.

    For a validation experiment the nuisance parameters are fitted to it first, and the result has
    these, and the errors of a blind prediction and of a copy of the nearest recording.

    Parameters
    ----------
    problem : Problem
        Problem with the options of forward simulations.
    experiment : Experiment
        Fitted experiment or one for validation.
    solution : Solution
        Solution of the problem.
    report : callable, optional
        Called with the completed share of the simulation, from 0 to 1.

    Raises
    ------
    KeyboardInterrupt
        If the fit of the nuisance parameters is interrupted.
    """
    try:
        segment, phi = transcription_and_nuisance(experiment, solution)
        rollout = simulate_with_parameters(
            problem,
            experiment,
            segment=segment,
            phi=phi,
            parameters=solution.parameters,
            report=report,
        )
    except (InputError, SimulationError) as error:
        # An InputError here is, for example, an estimated density that leaves a node without mass.
        return str(error)
    if not experiment.validation:
        return rollout
    nuisance = segment.nuisance
    places_m = segment.marker_places_m(phi).tolist()
    fitted = [part.segment.experiment for part in solution.parts]
    return replace(
        rollout,
        nuisance=dict(
            zip(nuisance.names, (phi * nuisance.scales).tolist(), strict=True)
        ),
        places_m=dict(zip(experiment.markers.names, places_m, strict=True)),
        blind_error=_blind_error(problem, segment, solution=solution),
        copy_error=nearest_recording_error(experiment, fitted),
    )


def simulate_with_parameters(
    problem: Problem,
    experiment: Experiment,
    *,
    segment: Transcription,
    phi: Array,
    parameters: Mapping[str, float],
    report: Callable[[float], None] | None = None,
) -> ForwardSimulation:
    """Simulate a recording with given parameters, and compare it with the measurements.

    Parameters
    ----------
    problem : Problem
        Its integrator and step are used.
    experiment : Experiment
        The recording, with which the simulation is compared.
    segment : Transcription
        The recording as it was fitted, see `transcription_and_nuisance`.
    phi : (k,) array
        Nuisance parameters of the recording.
    parameters : mapping of name to value
        All parameters of the problem.
    report : callable, optional
        Called with the completed share, from 0 to 1.

    Returns
    -------
    ForwardSimulation
        Without what concerns validation.

    Raises
    ------
    InputError, SimulationError
        Where the simulation fails.
    """
    trajectory = _simulate(
        problem, segment, phi=phi, parameters=parameters, report=report
    )
    predicted, surfaces = _predict_instruments(segment, trajectory, phi=phi)
    error = prediction_error(experiment, predicted)
    return ForwardSimulation(
        rms_m=error.rms_m or 0.0,
        max_m=error.max_m or 0.0,
        trajectory=replace(trajectory, markers_m=predicted.markers_m),
        nuisance={},
        places_m={},
        wrenches=predicted.wrenches,
        wrench_rms=(error.wrench_rms_n, error.wrench_rms_nm),
        readings=predicted.readings,
        reading_rms=error.reading_rms or {},
        depth_surfaces=surfaces,
        misfits=tuple(instrument_misfits(experiment, predicted)),
    )


def _simulate(
    problem: Problem,
    segment: Transcription,
    phi: Array,
    parameters: Mapping[str, float],
    report: Callable[[float], None] | None = None,
) -> Trajectory:
    """Simulate a recording with its nuisance parameters φ (k,), in units of their priors, and the
    values of the parameters.

    Integrator and step are those of `problem.rollout`: Newmark's scheme by default, and a finer
    step than in the fit. `parameters` are in SI units by name. `report` is called with the
    completed share, from 0 to 1.

    Raises
    ------
    InputError, SimulationError
        Where that fails.
    """
    integrator = (
        problem.scheme if problem.rollout.integrator == "scheme" else "newmark"
    )
    return simulate(
        with_contact_energy(segment.corrected_experiment(phi)),
        segment.body.theta_from_values(parameters),
        integrator=integrator,
        timestep_s=_step_s(problem, segment),
        substeps=segment.substeps,
        progress=report,
    )


def _predict_instruments(
    segment: Transcription, trajectory: Trajectory, phi: Array
) -> tuple[InstrumentPrediction, dict[str, SurfaceComparison]]:
    """Return the predictions of a recording's instruments for a simulated motion.

    Parameters
    ----------
    segment : Transcription
        Recording with its instruments.
    trajectory : Trajectory
        Simulated motion at its samples.
    phi : (k,) array
        Nuisance parameters of the recording.

    Returns
    -------
    predicted : InstrumentPrediction
    surfaces : mapping of the name of a depth camera to SurfaceComparison
    """
    grid, forced = trajectory.reactions
    positions_m = trajectory.positions_m
    x = positions_m.reshape(len(positions_m), -1)
    gauged = zip(
        segment.custom_sensors,
        _predict_sensors(segment, x, reactions=trajectory.reactions, phi=phi),
        strict=True,
    )
    surfaces = {
        reading.correspondences.camera.depth.name: SurfaceComparison.from_motion(
            reading, trajectory.t_s, positions_m=positions_m, phi=phi
        )
        for reading in segment.depths
    }
    predicted = InstrumentPrediction(
        markers_m=segment.markers.predict_samples(positions_m, phi),
        wrenches=[
            sensor.on_grid(grid).predict_reactions(forced, phi)
            for sensor in segment.sensors
        ],
        readings={
            gauge.sensor.name: gauge.without_padding(each)
            for gauge, each in gauged
        },
        depth={name: surface.error for name, surface in surfaces.items()},
    )
    return predicted, surfaces


def _blind_error(
    problem: Problem, segment: Transcription, solution: Solution
) -> PredictionErrors | None:
    """Return the errors of a prediction of a recording with the nuisance parameters of the fitted
    recordings; None if the simulation fails.

    Parameters
    ----------
    problem : Problem
        Its integrator and step are used.
    segment : Transcription
        Recording to be predicted, with its measurements.
    solution : Solution
        Solution of the fitted recordings.
    """
    phi = nuisance_of_fitted_recordings(segment, solution)
    try:
        trajectory = _simulate(
            problem, segment, phi=phi, parameters=solution.parameters
        )
    except (InputError, SimulationError):
        return None
    predicted, _ = _predict_instruments(segment, trajectory, phi=phi)
    return prediction_error(segment.experiment, predicted)


def transcription_and_nuisance(
    experiment: Experiment, solution: Solution
) -> tuple[Transcription, Array]:
    """Return an experiment's transcription and its nuisance parameters φ (k,) in units of their
    priors; k is 0 without any.

    For a fitted experiment φ is the estimate; for validation φ is fitted to its measurements in
    reduced space, with the material at its estimate. Whether that solve converged is not checked.

    Raises
    ------
    KeyboardInterrupt
        If that solve is interrupted.
    """
    if (part := solution.part_of(experiment.name)) is not None:
        return part.segment, part.phi
    values = solution.parameters
    body = experiment.body
    alone = replace(
        solution.collocation,
        experiments=[replace(experiment, validation=False)],
        parameters=solution.collocation.parameters.only_fixed(
            {name: values[name] for name in body.used_names(list(values))}
        ),
    )
    (segment,) = alone.transcriptions
    # All that is left to estimate is φ.
    if not alone.nphi:
        return segment, np.zeros(0)
    return segment, alone.parameters_from(
        ReducedSpace()(alone).unless_interrupted().z
    )


def step_error(
    problem: Problem,
    solution: Solution,
    fit: LinearisedFit,
    rollouts: Mapping[str, ForwardSimulation | str],
    estimates: Mapping[str, Estimate],
) -> Refinement | None:
    """Return the effect of the time step on every parameter and modulus, to first order.

    A Gauss–Newton step is taken towards the forward simulations, which have finer steps.

    Parameters
    ----------
    problem : Problem
    solution : Solution
        Converged solution.
    fit : LinearisedFit
        The measurements linearised at the solution.
    rollouts : mapping of experiment name to ForwardSimulation or str
        Forward simulations, or why there is none.
    estimates : mapping of name to Estimate
        Estimates at the solution, with their statistical intervals.

    Returns
    -------
    Refinement or None
        None if a simulation is missing or no finer, if all is static, and with obstacles in a
        motion: impacts within a step are not of first order, and oscillate in the forward
        simulation.
    """
    differences: list[Array] = []
    collocation = solution.collocation
    moving = [
        s.experiment
        for s in collocation.transcriptions
        if not s.experiment.is_static
    ]
    if not moving or any(experiment.obstacles for experiment in moving):
        return None
    for part, readings in zip(solution.parts, solution.readings_m, strict=True):
        segment = part.segment
        experiment = part.segment.experiment
        rollout = rollouts.get(experiment.name)
        share = _step_error_share(problem, segment)
        if not isinstance(rollout, ForwardSimulation) or share is None:
            return None
        way = share * (rollout.trajectory.markers_m - readings)
        differences.append(
            np.nan_to_num(way / experiment.markers.sigma_m[:, None])
        )
        fitted = solution.wrenches.get(experiment.name, [])
        for sensor, read, rolled in zip(
            segment.sensors, fitted, rollout.wrenches, strict=True
        ):
            way = share * np.nan_to_num((rolled - read) / sensor.wrench.sigmas)
            differences.append(way.reshape(-1, 2, 3))
        differences += _sensor_differences(
            part, rollout.trajectory, share=share
        )
        differences += _depth_differences(part, rollout.trajectory, share=share)
    change = change_in_observations(fit, differences)[: collocation.nq]
    q = np.clip(solution.q + change, *collocation.parameters.bounds_q)
    linear = problem.parameters.linear_names
    order = as_scheme(problem.scheme).order
    return Refinement(
        discretisation_errors(
            estimates,
            [parameter_values(collocation, q)],
            by_mesh=[],
            step_order=order,
            linear=linear,
        )
    )


def _sensor_differences(
    part: ExperimentIterate, trajectory: Trajectory, share: float
) -> list[Array]:
    """Return `share` times the difference (simulated − fitted) of each custom sensor, (S, G, 3),
    over σ; zero where a value is NaN. Empty without custom sensors.

    Parameters
    ----------
    part : ExperimentIterate
        Fitted experiment at the solution.
    trajectory : Trajectory
        Its forward simulation.
    share : float
        Factor on all differences.
    """
    if not (segment := part.segment).custom_sensors:
        return []
    fitted = (
        part.x[segment.markers.sample_rows],
        (ReactionGrid.from_dynamics(segment.dynamics), part.reactions),
    )
    rolled = (
        trajectory.positions_m.reshape(len(fitted[0]), -1),
        trajectory.reactions,
    )
    here, there = (
        _predict_sensors(segment, *each, part.phi) for each in (fitted, rolled)
    )
    return [
        share
        * np.nan_to_num(simulated_values - fitted_values)
        / gauge.sigmas[:, None]
        for gauge, fitted_values, simulated_values in zip(
            segment.custom_sensors, here, there, strict=True
        )
    ]


def _depth_differences(
    part: ExperimentIterate, trajectory: Trajectory, share: float
) -> list[Array]:
    """Return the change of each depth camera's residuals, (S, M, 3) in σ, for `share` times the
    difference between simulated and fitted positions, at the correspondences of the fit; empty
    without depth cameras.
    """
    if not (sights := part.surface_residuals):
        return []
    known_s = part.segment.experiment.t_s
    rows_s = part.segment.dynamics.t_s
    fitted = part.x[part.segment.markers.sample_rows]
    way_m = share * (trajectory.positions_m.reshape(len(fitted), -1) - fitted)
    way_rows_m = np.array(
        [np.interp(rows_s, known_s, each) for each in way_m.T]
    )
    displacements_m = way_rows_m.T.reshape(len(rows_s), -1, 3, 1)
    return [
        reading.residual_changes(
            observation,
            displacements_m[:, reading.correspondences.surface.nodes],
            phi=part.phi,
        )[..., 0]
        for reading, observation in sights
    ]


def _predict_sensors(
    segment: Transcription,
    x: Array,
    reactions: tuple[ReactionGrid, ReactionForces],
    phi: Array,
) -> list[Array]:
    """Return the predictions of custom sensors, for each (S, G, 3) at S samples of G points or
    wrenches.

    Parameters
    ----------
    segment : Transcription
    x : (T, 3n) array
        Positions at the samples [m].
    reactions : (ReactionGrid, ReactionForces)
        Grid and values of the reactions of grasps, for sensors of forces.
    phi : (k,) array
        Nuisance parameters of the recording.
    """
    grid = reactions[0]
    motion = ObservedMotion(x, reactions[1])
    gauges = custom_sensor_residuals(
        segment.experiment,
        segment.experiment.t_s,
        grid=grid,
        nuisance=segment.nuisance,
    )
    return [gauge.predict_motion(motion, phi) for gauge in gauges]


def _step_error_share(problem: Problem, segment: Transcription) -> float | None:
    """Return the share of the difference between forward simulation and fit that half the time step
    would remove, from the orders of both schemes.

    None if the simulation is not Newmark's or its step is not at most half as large; 1 for static
    experiments.
    """
    experiment = segment.experiment
    options = problem.rollout
    if experiment.is_static:
        return 1.0
    steps = experiment.timestep_s / _step_s(problem, segment) / segment.substeps
    if options.integrator != "newmark" or steps < LEAST_STEP_RATIO:
        return None
    order = as_scheme(problem.scheme).order
    # Newmark's own error is of second order: beside one of the first it is none.
    remaining = steps**-order if order > 1 else 0.0
    return (1 - 0.5**order) / (1 - remaining)


def _step_s(problem: Problem, segment: Transcription) -> float:
    """Return the step of the forward simulation of a recording [s]: the stated one, by default
    finer than the grid of the fit.

    The default is the sample interval over four, or over twice the substeps of the fit if these are
    more, unless that makes more than the largest number of steps.
    """
    count = min(max(4, 2 * segment.substeps), MOST_STEPS - 1)
    return problem.rollout.timestep_s or segment.experiment.timestep_s / count
