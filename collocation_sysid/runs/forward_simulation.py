"""Forward simulations with the estimates, and their comparison with the measurements.

A prediction is compared with two references: the same prediction with the nuisance parameters of the
fitted recordings (blind), and the measurements of a fitted recording (copy).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ..common.array_types import Array, Index
from ..common.step_counting import StepUnit, complete_steps, counted_phase
from ..errors import InputError, SimulationError
from ..features.measurements import (
    CopyError,
    SimulatedExperiment,
    copied,
    copied_times_s,
    instrument_misfits,
    prediction_error,
    reason_against_copy,
    units_by_name,
)
from ..fem.kernels import map_experiments
from ..fem.schemes import MOST_STEPS, as_scheme
from ..methods.complementarity import with_contact_energy
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution
from ..problem import Problem
from ..program.measured_motion import residual_changes, simulated_values
from ..program.simulation import Trajectory, simulate
from ..program.transcription import Transcription
from ..recording import Experiment
from ..recording.nuisance import CLOCK_RATE, DEPTH_TIME, JOINING, OBSTACLE_TIME, SENSOR_TIME, TIME
from ..recording.sample_times import TIME_TOLERANCE_S
from ..statistics.assessment import InstrumentMisfit
from ..statistics.budget.discretisation_error import (
    Refinement,
    change_in_observations,
    discretisation_errors,
)
from ..statistics.distributions import largest_deviation
from ..statistics.estimates import Estimate
from ..statistics.linearised import LinearisedFit, parameter_values
from ..statistics.thresholds import RARE
from .smaller_problem import sample_distance

# Least ratio of grid step and simulation step for an estimate of the step's error: half, rounded.
LEAST_STEP_RATIO = 1.99
# Samples of a smooth motion from which two steps per sample suffice: a fifth of the time of an
# identification with 1,200 samples were four.
SMOOTH_SAMPLES = 4


@dataclass(frozen=True, eq=False, kw_only=True)
class ForwardSimulation(SimulatedExperiment):
    """A forward simulation with the estimated parameters, compared with the measurements."""

    trajectory: Trajectory  # its measurements are predicted with the nuisance parameters
    # Differences of each instrument over its stated σ, also of an experiment for validation.
    misfits: tuple[InstrumentMisfit, ...] = ()
    # The same with nuisance parameters that are fitted to an experiment for validation.
    own_misfits: tuple[InstrumentMisfit, ...] = ()

    @property
    def judged_misfits(self) -> tuple[InstrumentMisfit, ...]:
        """Misfits by which an experiment for validation is judged: those with its own nuisance
        parameters if no deviation is larger than chance allows for so many.
        """
        deviations = {**(self.own_deviations or {}), **(self.own_onsets or {})}
        largest = max(map(abs, deviations.values()), default=np.inf)
        return (
            self.own_misfits
            if largest <= largest_deviation(len(deviations), RARE)
            else self.misfits
        )


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
    experiments = problem.experiments
    with counted_phase(StepUnit.SIMULATION, len(experiments)):
        rollouts = map_experiments(
            partial(simulate_experiment, problem, solution),
            experiments,
            [_report_completed_share() for _ in experiments],
            threads=solution.collocation.threads,
        )
    return {e.name: each for e, each in zip(experiments, rollouts, strict=True)}


def _report_completed_share() -> Callable[[float], None]:
    completed = 0.0

    def report(share: float) -> None:
        nonlocal completed
        complete_steps(StepUnit.SIMULATION, share - completed)
        completed = share

    return report


def simulate_experiment(
    problem: Problem,
    solution: Solution,
    experiment: Experiment,
    report: Callable[[float], None] | None = None,
) -> ForwardSimulation | str:
    """Simulate an experiment with the parameters of a solution, and compare it with the
    measurements; return the reason as text if that fails.

    A validation experiment is predicted blind, see `predicted_nuisance`; the result also has the
    errors with its own nuisance parameters, and of a copy of the nearest recording.

    Parameters
    ----------
    problem : Problem
        Problem with the options of forward simulations.
    experiment : Experiment
        Fitted experiment or one for validation.
    report : callable, optional
        Called with the completed share of the simulation, from 0 to 1.

    Raises
    ------
    KeyboardInterrupt
        If the fit of the nuisance parameters is interrupted.
    """
    try:
        transcription, own_phi = fitted_nuisance(experiment, solution)
        phi = predicted_nuisance(transcription, own_phi, solution=solution)
        simulated = partial(
            simulate_with_parameters,
            problem,
            experiment,
            transcription=transcription,
            parameters=solution.parameters,
        )
        rollout = simulated(phi=phi, report=report)
    except (InputError, SimulationError) as error:
        # An InputError here is, for example, an estimated density that leaves a node without mass.
        return str(error)
    if not experiment.validation:
        return rollout
    nuisance = transcription.nuisance
    places_m = transcription.marker_places_m(phi).tolist()
    fitted = [part.transcription.experiment for part in solution.parts]
    known: dict[str, Any] = {}
    if nuisance.size:
        try:
            with_own = simulated(phi=own_phi)
        except (InputError, SimulationError):
            pass
        else:
            onsets = unknown_onsets(transcription)
            changes = dict(enumerate((own_phi - phi).tolist()))
            known = {
                "own": prediction_error(experiment, with_own.trajectory.predicted),
                "own_misfits": with_own.misfits,
                "own_onsets": {nuisance.names[k]: float(own_phi[k]) for k in onsets},
                "own_deviations": {
                    nuisance.names[k]: each for k, each in changes.items() if k not in onsets
                },
            }
    copied = nearest_recording_error(experiment, fitted)
    return replace(
        rollout,
        nuisance=dict(zip(nuisance.names, (phi * nuisance.scales).tolist(), strict=True)),
        places_m=dict(zip(experiment.markers.names, places_m, strict=True)),
        copied=copied if isinstance(copied, CopyError) else None,
        not_copied=copied if isinstance(copied, str) else None,
        **known,
    )


def simulate_with_parameters(
    problem: Problem,
    experiment: Experiment,
    *,
    transcription: Transcription,
    phi: Array,
    parameters: Mapping[str, float],
    report: Callable[[float], None] | None = None,
) -> ForwardSimulation:
    """Simulate a recording with given parameters, and compare it with the measurements.

    Parameters
    ----------
    problem : Problem
        The integrator and step of `problem.rollout` are used: Newmark's scheme by default, and a
        finer step than in the fit.
    experiment : Experiment
        The recording, with which the simulation is compared.
    transcription : Transcription
        The recording as it was fitted, or as it is predicted.
    phi : (k,) array
        Nuisance parameters of the recording, in units of their prior standard deviations.
    parameters : mapping of name to value
        All parameters of the problem, in SI units.
    report : callable, optional
        Called with the completed share, from 0 to 1.

    Returns
    -------
    ForwardSimulation
        `nuisance` and `places_m` are empty, `own` and `copied` are None.

    Raises
    ------
    InputError, SimulationError
        Where the simulation fails.
    """
    integrator = problem.scheme if problem.rollout.integrator == "scheme" else "newmark"
    corrected = transcription.corrected_experiment(phi)
    if corrected.obstacles:
        corrected = with_contact_energy(corrected)
    trajectory = simulate(
        corrected,
        transcription.body.theta_from_values(parameters),
        integrator=integrator,
        timestep_s=_step_s(problem, transcription),
        substeps=transcription.substeps,
        progress=report,
        is_measured=False,
    )
    predicted = simulated_values(transcription, trajectory, phi)
    errors = prediction_error(experiment, predicted)
    return ForwardSimulation(
        **vars(replace(errors, rms_m=errors.rms_m or 0.0, max_m=errors.max_m or 0.0)),
        fitted=not experiment.validation,
        reading_unit=units_by_name(experiment),
        nuisance={},
        places_m={},
        not_copied="",
        trajectory=replace(trajectory, predicted=predicted),
        misfits=tuple(instrument_misfits(experiment, predicted)),
    )


def predicted_nuisance(transcription: Transcription, own_phi: Array, solution: Solution) -> Array:
    """Return the nuisance parameters φ (k,) with which a recording is simulated: `own_phi`, which
    are fitted to it, of a fitted recording.

    One for validation is predicted blind, with those of the fitted recordings, because its own
    would absorb the error that the prediction is to show. Only its onsets that the description
    declares as unknown are its own.
    """
    if solution.part_of(transcription.experiment.name) is not None:
        return own_phi
    phi = nuisance_of_fitted_recordings(transcription, solution)
    onsets = unknown_onsets(transcription)
    phi[onsets] = own_phi[onsets]
    return phi


def fitted_nuisance(experiment: Experiment, solution: Solution) -> tuple[Transcription, Array]:
    """Return an experiment's transcription and nuisance parameters φ (k,) that are fitted to it:
    the estimate, or for validation by a solve in reduced space with the material at its estimate.

    k is 0 without any. Whether that solve converged is not checked.

    Raises
    ------
    KeyboardInterrupt
        If that solve is interrupted.
    """
    if (part := solution.part_of(experiment.name)) is not None:
        return part.transcription, part.phi
    values = solution.parameters
    body = experiment.body
    alone = replace(
        solution.collocation,
        experiments=[replace(experiment, validation=False)],
        parameters=solution.collocation.parameters.only_fixed(
            {name: values[name] for name in body.used_names(list(values))}
        ),
    )
    (transcription,) = alone.transcriptions
    # All that is left to estimate is φ.
    if not alone.nphi:
        return transcription, np.zeros(0)
    return transcription, alone.parameters_from(ReducedSpace()(alone).unless_interrupted().z)


def step_changes(
    problem: Problem, solution: Solution, rollouts: Mapping[str, ForwardSimulation | str]
) -> list[Array] | None:
    """Return the changes (T, M, 3) of the residuals with half the time step, of each block of a fit,
    from the forward simulations, which have finer steps.

    None if a simulation is missing or no finer, if all is static, and with obstacles in a motion:
    impacts within a step are not of first order, and oscillate in the forward simulation.

    Parameters
    ----------
    rollouts : mapping of experiment name to ForwardSimulation or str
        Forward simulations, or why there is none.
    """
    differences: list[Array] = []
    collocation = solution.collocation
    moving = [s.experiment for s in collocation.transcriptions if not s.experiment.is_static]
    if not moving or any(experiment.obstacles for experiment in moving):
        return None
    for part in solution.parts:
        rollout = rollouts.get(part.transcription.experiment.name)
        share = _step_error_share(problem, part.transcription)
        if not isinstance(rollout, ForwardSimulation) or share is None:
            return None
        differences += residual_changes(part, rollout.trajectory, share)
    return differences


def step_error(
    problem: Problem,
    solution: Solution,
    fit: LinearisedFit,
    changes: Sequence[Array],
    estimates: Mapping[str, Estimate],
) -> Refinement:
    """Return the effect of the time step on every parameter and modulus, to first order.

    Parameters
    ----------
    fit : LinearisedFit
        The measurements linearised at the solution.
    changes : sequence of (T, M, 3) arrays
        Result of `step_changes`.
    estimates : mapping of name to Estimate
        Estimates at the solution, with their statistical intervals.
    """
    collocation = solution.collocation
    change = change_in_observations(fit, changes)[: collocation.nq]
    q = np.clip(solution.q + change, *collocation.parameters.bounds_q)
    return Refinement(
        discretisation_errors(
            estimates,
            [parameter_values(collocation, q)],
            by_mesh=[],
            step_order=as_scheme(problem.scheme).order,
            linear=problem.parameters.linear_names,
        )
    )


def _step_error_share(problem: Problem, transcription: Transcription) -> float | None:
    """Half the step removes a share by the orders of both schemes; None unless it is comparable."""
    experiment = transcription.experiment
    options = problem.rollout
    if experiment.is_static:
        return 1.0
    steps = experiment.timestep_s / _step_s(problem, transcription) / transcription.substeps
    if options.integrator != "newmark" or steps < LEAST_STEP_RATIO:
        return None
    order = as_scheme(problem.scheme).order
    # Newmark's own error is of second order: beside one of the first it is none.
    remaining = steps**-order if order > 1 else 0.0
    return (1 - 0.5**order) / (1 - remaining)


def _step_s(problem: Problem, transcription: Transcription) -> float:
    """Return the step of the simulation [s], by default finer than that of the fit."""
    is_smooth = sample_distance(transcription.experiment) >= SMOOTH_SAMPLES
    count = min(max(2 if is_smooth else 4, 2 * transcription.substeps), MOST_STEPS - 1)
    return problem.rollout.timestep_s or transcription.experiment.timestep_s / count


def fit_misfits(solution: Solution) -> dict[str, list[InstrumentMisfit]]:
    """Return the RMS of (fit − measurement) / σ of each measurement, by name of the recording."""
    return {
        part.transcription.experiment.name: instrument_misfits(
            part.transcription.experiment,
            solution.fitted_values[part.transcription.experiment.name],
        )
        for part in solution.parts
    }


# Blind predictions --------------------------------------------------------------------------------


def nuisance_of_fitted_recordings(transcription: Transcription, solution: Solution) -> Array:
    """Return nuisance parameters φ (k,) for a recording that is not fitted, from the fitted ones,
    in units of the prior standard deviations of that recording.

    Each is the mean of the estimates, in physical units, of the parameters with the same label in
    the fitted recordings, divided by its own prior standard deviation. The place of a marker that
    is estimated is the mean of its places on the body [m] in the fitted recordings that have a
    marker of this name, estimated or exact; its entries in φ are the displacement from the
    recording's own place at φ = 0 to that mean, along the directions of its own prior. Where no
    fitted recording has the label or the marker, φ is zero, the mean of the prior. The recording's
    own measurements are not compared, and φ is not limited to its bounds.

    Parameters
    ----------
    transcription : Transcription
        Transcription of the recording to be predicted.
    """
    nuisance = transcription.nuisance
    places = transcription.markers.observable.coordinate_parameters
    known: dict[str, list[float]] = {}
    for part in solution.parts:
        for entry, _, value in part.transcription.nuisance.iterate_values(part.phi):
            known.setdefault(entry.label, []).append(value)
    phi = np.zeros(nuisance.size)
    for k, entry in enumerate(nuisance.entries):
        phi[k] = np.mean(known.get(entry.label, [0.0])) / entry.sigma
    association = transcription.association.markers
    means_m = transcription.marker_places_m(np.zeros(nuisance.size))
    for number in association.estimated.tolist():
        name = transcription.experiment.markers.names[number]
        places_m = [
            part.transcription.marker_places_m(part.phi)[
                part.transcription.experiment.markers.names.index(name)
            ]
            for part in solution.parts
            if name in part.transcription.experiment.markers.names
        ]
        if places_m:
            means_m[number] = np.mean(places_m, axis=0)
    estimated = association.estimated
    phi[places[estimated]] = association.coordinates(means_m)[estimated]
    return phi


# Times of a recording that are its own: when it, a load or an obstacle began, and by which clock.
ONSETS = (TIME, CLOCK_RATE, OBSTACLE_TIME, JOINING, SENSOR_TIME, DEPTH_TIME)


def unknown_onsets(transcription: Transcription) -> Index:
    """Return the indices in φ, ascending, of onsets and clocks that the description of a recording
    declares as unknown: their prior is stated, and is not the default.
    """
    stated = transcription.experiment.nuisance
    own = [row for row in stated.own if row.clock is not None]
    declared = [row for row in ONSETS if stated.sigma(row) not in (None, row.sigma)]
    return transcription.nuisance.indices_of_rows(*declared, *own)


# Copies of other recordings -----------------------------------------------------------------------


def nearest_recording_error(
    experiment: Experiment, fitted: Iterable[Experiment]
) -> CopyError | str:
    """Return how well the nearest fitted recording's measurements predict a recording.

    Measurements are compared sample by sample, at equal times after the start. The nearest one has
    the smallest RMS of the markers, or of the forces if no markers are compared.

    Parameters
    ----------
    experiment : Experiment
        Recording to predict.
    fitted : iterable of Experiment
        Fitted recordings; may be empty.

    Returns
    -------
    CopyError or str
        Name and errors of the nearest recording; a text with the reasons if no fitted recording has
        the same instruments and times.
    """
    reasons = {}
    copies = []
    for other in fitted:
        reason = _reason_against_copy(experiment, other)
        if reason:
            reasons[other.name] = reason
            continue
        error = prediction_error(experiment, copied(experiment, other))
        copies.append(CopyError(other.name, error))
    if not copies:
        explanation = "; ".join(f"{name}: {reason}" for name, reason in reasons.items())
        return f"no fitted recording has the same samples ({explanation})"
    return min(copies, key=lambda each: each.error.main)


def _reason_against_copy(experiment: Experiment, other: Experiment) -> str:
    """Return why `other` is no prediction of a recording, such as other markers, or ""."""
    if reason := reason_against_copy(experiment, other):
        return reason
    starts_s = experiment.t_s[0], other.t_s[0]
    for here_s, there_s in copied_times_s(experiment, other):
        if len(here_s) != len(there_s):
            return f"{len(there_s)} samples instead of {len(here_s)}"
        if np.abs((here_s - starts_s[0]) - (there_s - starts_s[1])).max() > TIME_TOLERANCE_S:
            return "other times"
    return ""
