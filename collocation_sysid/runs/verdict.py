"""Concerns about a finished run, from which its verdict follows, see `statistics.assessment`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from ..common.array_types import Array
from ..errors import SimulationError
from ..features.registry import present
from ..fem.schemes import as_scheme
from ..judge.posterior import Posterior
from ..kinds.specimen.concerns import as_specimen_concerns
from ..methods.solution import Solution, Status
from ..problem import Problem
from ..program.correspondences import CorrespondenceResidual
from ..program.modes.stability import find_instabilities
from ..program.transcription import Transcription
from ..recording.measurement import root_mean
from ..statistics.assessment import (
    DOUBTFUL_ANGLE_RAD,
    InstrumentMisfit,
    fit_concerns,
    forward_simulation_concerns,
    impact_step_concerns,
    nuisance_concerns,
    onset_concerns,
    outlier_share_concerns,
    parameter_concerns,
    prediction_concerns,
    rms_expected_from_noise_m,
    rotation_step_concerns,
    scheme_concerns,
    stability_concerns,
    validation_concerns,
)
from ..statistics.concerns import Concern, Grade
from ..statistics.plausibility import density_concerns, material_hypothesis
from ..statistics.stability_concerns import branch_concerns, strain_stability_concerns
from ..statistics.uncertainty import Uncertainty
from .check.modes import ModesCheck, check_modes
from .forward_simulation import ForwardSimulation, fit_misfits

# Largest noise of cameras, relative to the size of the body.
LARGEST_CAMERA_NOISE = 0.01


def solution_concerns(
    solution: Solution,
    rollouts: Mapping[str, ForwardSimulation | str],
    motions: Iterable[ModesCheck],
    uncertainty: Uncertainty | None,
    posterior: Posterior | None = None,
    surprise: Grade | None = None,
    is_step_known: bool = False,
) -> Iterator[Concern]:
    """Yield the concerns about a solution and its forward simulations.

    If the search failed, only concerns about the bodies and about this failure.

    Parameters
    ----------
    solution : Solution
        Solution, converged or not.
    rollouts : mapping of experiment name to ForwardSimulation or str
        Forward simulations, or the reason why there is none.
    motions : iterable of ModesCheck
        Natural modes at the estimates.
    uncertainty : Uncertainty or None
        Statistical uncertainty; None without error bars, which is a concern of its own if there
        are parameters.
    posterior : Posterior, optional
        Posterior with all effects, whose nuisance parameters are judged; by default those of the
        solution.
    surprise : {"check", "doubtful"} or None
        Grade of the effects that the residuals need; None if they need none. Without free constants
        the stated ones may as well be wrong, so that the prediction is as grave.
    is_step_known : bool
        Whether the error of the time step, by which forward simulations of motions deviate, is an
        effect of a consistent posterior, which corrects for it and contains it.
    """
    status = solution.status
    yield from body_concerns(solution)
    if not status.converged:
        for transcription in solution.collocation.transcriptions:
            yield from impact_step_concerns(transcription.experiment, solution.collocation.substeps)
        yield Concern("solve/lost", "doubtful", data={"why": solution.message})
        return
    if status is Status.ACCEPTABLE:
        yield Concern("solve/acceptable")
    transcriptions = solution.collocation.transcriptions
    fitted_experiments = [each.experiment for each in transcriptions]
    collocation = solution.collocation
    unknowns = unknown_concerns(solution, posterior)
    if not solution.collocation.nq:
        yield from _prediction_concerns(solution, rollouts, surprise)
    if uncertainty is not None:
        misfits = fit_concerns(uncertainty)
        of_parameters = parameter_concerns(uncertainty, solution.collocation.parameters)
        of_fit = [*misfits, *of_parameters, *unknowns]
        are_specimens = all(each.specimen for each in fitted_experiments)
        if are_specimens:  # which learn no other effect than a toe
            of_fit = as_specimen_concerns(of_fit, fitted_experiments, surprise is not None)
        yield from of_fit
    else:
        if solution.collocation.nq:
            yield Concern("solve/no-error-bars", "doubtful")
        yield from unknowns
    yield from allowance_concerns(solution)
    yield from outlier_share_concerns(*_outlier_counts(solution))
    yield from stability_concerns(find_instabilities(solution.collocation, solution.z))
    yield from strain_stability_concerns(solution.parts)
    yield from branch_concerns(solution.parts)
    for kind in present(fitted_experiments):
        yield from kind.concerns(solution.parts)
    fitted = fit_misfits(solution)
    static = [each.experiment.name for each in transcriptions if each.experiment.is_static]
    for name, rollout in rollouts.items():
        if isinstance(rollout, ForwardSimulation):
            for kind in present([rollout.trajectory.experiment]):
                yield from kind.simulation_concerns(name, rollout)
        is_static = name in static
        is_contained = is_step_known and not is_static
        yield from _forward_concerns(name, rollout, fitted, is_static, is_contained)
    for transcription in collocation.transcriptions:
        yield from rotation_step_concerns(
            transcription.experiment,
            collocation.substeps,
            limit_rad=DOUBTFUL_ANGLE_RAD,
            code="scheme/turn",
        )
    for motion in motions:
        if motion.first_mode is not None and motion.first_mode.damping_ratio < 1:
            yield from scheme_concerns(
                motion.experiment,
                motion.first_mode.damping_ratio,
                added_ratio=motion.first_mode.numerical_damping_ratio,
                period_error=motion.first_mode.period_error,
            )


def unknown_concerns(solution: Solution, posterior: Posterior | None) -> list[Concern]:
    """Return the concerns about nuisance parameters, by default those of the solution."""
    collocation = solution.collocation
    if posterior is None:
        phi = collocation.parameters_from(solution.z)[collocation.nq :]
        expected = np.ones_like(phi)
    else:
        phi, expected = posterior.phi, posterior.expected_phi
    found: list[Concern] = []
    for each in collocation.transcriptions:
        at = each.nuisance_indices.indices - collocation.nq
        found += _nuisance_concerns(each, phi[at], expected[at])
    return found


def _nuisance_concerns(
    transcription: Transcription, phi: Array, expected: Array
) -> Iterator[Concern]:
    nuisance = transcription.nuisance
    experiment = transcription.experiment
    low, high = nuisance.bounds(transcription.association.clock_samples)
    # Zero is a plausible value of a lag or a tool's mass, although it is a bound.
    low = np.where(low == 0, -np.inf, low)
    yield from nuisance_concerns(
        nuisance.names,
        phi,
        low=low,
        high=high,
        expected=expected,
        is_specimen=experiment.specimen is not None,
        rows=[entry.row for entry in nuisance.entries],
        scales=nuisance.scales.tolist(),
    )


def _outlier_counts(solution: Solution) -> tuple[int, int]:
    """Points of depth cameras do not count, because edges always require this loss."""
    huber = solution.collocation.huber or np.inf
    wild = samples = 0
    for part in solution.parts:
        pairs = zip(part.transcription.residuals, part.observables, strict=True)
        for model, values in pairs:
            if isinstance(model, CorrespondenceResidual):
                continue
            lengths = np.linalg.norm(model.residuals(values, part.phi), axis=2)
            wild += int(np.sum(lengths > huber))
            samples += int(model.is_compared.any(axis=2).sum())
    return wild, samples


def body_concerns(solution: Solution) -> Iterator[Concern]:
    """Yield concerns about an implausible stiffness at the estimates of each fitted body, which are
    doubtful, and about densities that are unusual for the way in which a body was made.
    """
    for body in dict.fromkeys(
        transcription.body for transcription in solution.collocation.transcriptions
    ):
        theta = body.theta_from_values(solution.parameters)
        if (metal := material_hypothesis(body, theta)) is not None:
            yield metal.concern("doubtful")
        yield from density_concerns(body)


def allowance_concerns(solution: Solution) -> Iterator[Concern]:
    """Yield a concern for each static experiment whose `sigma_m`, relative to the size of the body,
    is larger than the noise of cameras.

    In motions the autocorrelation of the residuals shows this; static experiments have none.
    """
    for experiment in (
        transcription.experiment for transcription in solution.collocation.transcriptions
    ):
        if not experiment.is_static or not experiment.markers.sample_count:
            continue
        sigma_m = float(np.max(experiment.markers.sigma_m))
        share = sigma_m / float(np.ptp(experiment.body.nodes_m, axis=0).max())
        if share > LARGEST_CAMERA_NOISE:
            yield Concern("noise/allowance", data={"sigma_mm": 1e3 * sigma_m, "share": share})


def _prediction_concerns(
    solution: Solution, rollouts: Mapping[str, ForwardSimulation | str], surprise: Grade | None
) -> Iterator[Concern]:
    for name, rollout in rollouts.items():
        if isinstance(rollout, ForwardSimulation) and solution.part_of(name) is not None:
            for misfit in rollout.misfits:
                yield from prediction_concerns(name, **vars(misfit), surprise=surprise)


def _forward_concerns(
    name: str,
    rollout: ForwardSimulation | str,
    fitted: Mapping[str, Sequence[InstrumentMisfit]],
    is_static: bool,
    is_contained: bool,
) -> Iterator[Concern]:
    """A simulation failed, or misses measurements by more than the noise and the fit, and than what
    intervals contain.
    """
    if not isinstance(rollout, ForwardSimulation):
        yield Concern("roll-out/failed", "doubtful", data={"experiment": name, "why": rollout})
        return
    if name in fitted:
        of_fit = {each.what: each for each in fitted[name]}
        for simulated in rollout.misfits:
            # The simulated surface may be near points of a camera that the fitted one is not.
            if simulated.what in of_fit and not is_contained:
                yield from forward_simulation_concerns(
                    name, simulated, of_fit[simulated.what], is_static=is_static
                )
        return
    for label, deviation in (rollout.own_onsets or {}).items():
        yield from onset_concerns(name, label, deviation)
    levels: dict[str, list[float]] = {}
    for misfit in (each for row in fitted.values() for each in row):
        levels.setdefault(misfit.what, []).append(misfit.robust_sigmas)
    # An error within what the description leaves open is no contradiction.
    for misfit in rollout.judged_misfits:
        level = root_mean(np.square(levels.get(misfit.what, [1.0])))
        yield from validation_concerns(
            name, misfit, level=level, deviations=rollout.own_deviations or {}
        )


def expected_rms_m(solution: Solution, uncertainty: Uncertainty | None) -> float:
    """Return the RMS distance [m] of the fitted markers that is expected from noise with the stated
    σ, less what the fitted parameters absorb; 0 without markers.

    Parameters
    ----------
    uncertainty : Uncertainty or None
        Its degrees of freedom say how much the parameters absorb; for None they absorb nothing.
    """
    markers = [
        transcription.experiment.markers for transcription in solution.collocation.transcriptions
    ]
    samples = np.concatenate([each.is_present.sum(axis=0) for each in markers]).astype(float)
    sigma_m = np.concatenate([each.sigma_m for each in markers])
    measured = solution.collocation.measurement_count
    fitted = 0.0 if uncertainty is None else measured - uncertainty.degrees_of_freedom
    numbers = np.concatenate([each.is_measured.sum(axis=(0, 2)) for each in markers]).astype(float)
    return rms_expected_from_noise_m(sigma_m, samples, numbers, parameter_count=float(fitted))


def modes_by_experiment(problem: Problem, solution: Solution) -> dict[str, ModesCheck]:
    """Return the natural modes of each body at the estimates of `solution`, by name of the
    experiment; empty if the search failed.

    The search failed if its status is not that of convergence. All moving experiments of the
    problem count, also those for validation; those whose modes cannot be computed, as without a
    stress-free shape, are left out. Without an equilibrium the modes are those about the undeformed
    shape, see `check_modes`.
    """
    motions = {}
    substeps = solution.collocation.substeps
    scheme = as_scheme(solution.collocation.scheme)
    moving = [experiment for experiment in problem.experiments if not experiment.is_static]
    for experiment in moving if solution.status.converged else ():
        theta = experiment.body.theta_from_values(solution.parameters)
        try:
            motions[experiment.name] = check_modes(
                experiment, scheme, step_s=experiment.timestep_s / substeps, theta=theta
            )
        except SimulationError:
            continue
    return motions
