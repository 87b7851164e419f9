"""Solving a problem with a two-phase field: a smooth field first, then phases and parameters in
turn.

1. The problem with a smooth field in place of the two phases is solved.
2. At that solution the measurements are linearised in the logarithm of every element, and phases
are sampled from their posterior, see `statistics.phase_sampling`.
3. With the more likely phase of every element the problem is solved for the contrast and all other
parameters by the chosen method. Steps 2 and 3 repeat until only a small share of the volume changes
its phase.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..common.array_types import Array, Index
from ..errors import InputError
from ..fem.body import Body
from ..fem.laws.constants import CONTRAST, field_coefficient
from ..fem.two_phase import (
    ElementLogarithms,
    PhaseSamples,
    TwoPhaseModes,
    is_inclusion,
)
from ..methods.solution import Solution
from ..problem import Problem
from ..program.association import Association
from ..program.collocation import Collocation
from ..recording.experiment import Experiment
from ..statistics.field_estimates import mean_logarithm
from ..statistics.linearised import (
    LinearisedFit,
    factorise_information,
    linearise_fit,
)
from ..statistics.phase_sampling import (
    USUAL,
    ElementInformation,
    InternalFaces,
    PosteriorDraws,
    initial_phases,
    sample_phases,
)
from .warm_start import WarmStart

SolveOnce = Callable[[Problem, str | Path | WarmStart | None], Solution]

# Most elements of a two-phase field: the sampler stores two dense square matrices of this size.
MOST_ELEMENTS = 4000
# Most rounds of phases and parameters.
MOST_ROUNDS = 6
# Share of the inclusion's volume that changes in a round, below which the phases are final.
SETTLED_VOLUME_SHARE = 0.02
# Fewest elements of an inclusion: a single element is noise.
FEWEST_ELEMENTS = 2


@dataclass(frozen=True, eq=False)
class _PhaseSearch:
    """Two-phase field of a problem, and the names of its parameters.

    Attributes
    ----------
    name : str
        Name of its constant, with the region in front.
    contrast : str
        Name of the contrast.
    modes : TwoPhaseModes
        Shapes of the field.
    number : int
        Index of the part in the body.
    elements : tuple of str
        Names of the coefficients of `ElementLogarithms`.
    """

    name: str
    contrast: str
    modes: TwoPhaseModes
    number: int
    elements: tuple[str, ...]


@dataclass(frozen=True)
class _SmoothFitQuality:
    """Quality of the fit with the smooth field.

    Attributes
    ----------
    chi_squared : float
        χ² of the measurements.
    misfit : float
        χ² per measurement.
    determined : float
        Effective number of parameters and shapes that the data determine; one that is determined by
        its prior in part counts in part.
    """

    chi_squared: float
    misfit: float
    determined: float

    def lack_of_fit(self, chi_squared: float) -> float:
        """Return the temperature T of `statistics.phase_sampling` for a fit with phases of this χ²:
        its excess over the smooth fit per determined parameter, at least one.
        """
        return max(
            1.0, (chi_squared - self.chi_squared) / max(1.0, self.determined)
        )


def _smooth_fit(fit: LinearisedFit) -> _SmoothFitQuality:
    """Return the quality of the fit with the smooth field: its χ² and the number of parameters that
    it determines, from `fit`, linearised at its solution.
    """
    return _SmoothFitQuality(
        fit.chi_squared,
        _chi_squared_per_measurement(fit),
        determined=factorise_information(fit).determined_count,
    )


def solve_two_phases(
    problem: Problem,
    start: str | Path | WarmStart | None,
    solve_once: SolveOnce,
) -> Solution:
    """Solve a problem with a two-phase field; the body of the solution has the phases and their
    samples.

    If the smooth field or the first solve with phases does not converge, that solution is returned,
    without samples. A later round that does not converge or does not decrease χ² ends the rounds,
    and the best solution counts.

    Parameters
    ----------
    problem : Problem
        With exactly one two-phase field.
    start : str, Path or WarmStart, optional
        Start of the solve with the smooth field.
    solve_once : callable
        ``solve_once(problem, start)``, the solution of a problem with given phases or a smooth
        field.

    Raises
    ------
    InputError
        For several two-phase fields, or too many elements.
    SimulationError
        If the equations of motion are singular at a solution.
    """
    search = _two_phase_search(problem)
    solution = solve_once(
        problem.with_fields({search.name: search.modes.smooth_field}), start
    )
    if not solution.status.converged:
        return solution
    smooth = _smooth_fit(linearise_fit(solution.collocation, solution.z))
    at_smooth = _linearise_in_elements(problem, search, solution=solution)
    phase = initial_phases(
        at_smooth.normal_equations(1.0),
        at_smooth.faces,
        volumes_m3=search.modes.volumes_m3,
    )
    best: Solution | None = None
    at_best = at_smooth
    rounds = 0
    for _ in range(MOST_ROUNDS):
        candidate = _solve_with_phases(
            problem,
            search,
            phase=phase,
            warm_start=WarmStart.of(best or solution),
            solve_once=solve_once,
        )
        if not candidate.status.converged and best is None:
            return candidate
        rounds += 1
        if not candidate.status.converged:
            break
        at_candidate = _linearise_in_elements(
            problem, search, solution=candidate
        )
        if (
            best is not None
            and at_candidate.fit.chi_squared >= at_best.fit.chi_squared
        ):
            break
        best = candidate
        at_best = at_candidate
        draws = sample_phases(
            at_best.normal_equations(1.0), at_best.faces, start=phase
        )
        next_phase = _likelier_phases(draws.probability)
        volumes_m3 = search.modes.volumes_m3
        if volumes_m3 @ np.abs(next_phase - phase) < SETTLED_VOLUME_SHARE * (
            volumes_m3 @ phase
        ):
            break
        phase = next_phase
    assert best is not None
    final = _phases_of_solution(best, search)
    temperature = smooth.lack_of_fit(at_best.fit.chi_squared)
    # The whole posterior is tempered, its prior too: with the data alone tempered the prior would
    # shrink inclusions.
    settings = replace(USUAL, face_nats=USUAL.face_nats / temperature)
    draws = sample_phases(
        at_best.normal_equations(temperature),
        at_best.faces,
        start=final,
        settings=settings,
    )
    samples = _samples(draws, at_best.fit, search=search, solution=best)
    best = _with_samples(best, replace(samples, smooth_misfit=smooth.misfit))
    note = (
        f"two phases of {search.name}: started from a smooth field (χ² per measurement "
        f"{smooth.misfit:.3g}), {rounds} rounds of phases and parameters; the inclusion has "
        f"{int(final.sum())} of {len(final)} elements; the posterior is tempered by "
        f"{temperature:.3g}, the lack of fit per shape of the smooth field"
    )
    return replace(best, notes=(note, *best.notes))


def _phases_of_solution(solution: Solution, search: _PhaseSearch) -> Array:
    """Return the phases (E,) of the two-phase field in a solution, for the E elements of the part
    that has the field: 1 in inclusions, 0 elsewhere.

    It is the array of the field itself, not a copy.
    """
    modes = _two_phase_body(solution, search).parts[search.number].field
    assert isinstance(modes, TwoPhaseModes)
    return modes.phase


def _two_phase_body(solution: Solution, search: _PhaseSearch) -> Body:
    """Return the body, among those of a solution, that has the two-phase field of `search`."""
    segments = solution.collocation.transcriptions
    return next(
        s.body for s in segments if search.name in s.body.field_lengths_m
    )


def _solve_with_phases(
    problem: Problem,
    search: _PhaseSearch,
    phase: Array,
    warm_start: WarmStart,
    solve_once: SolveOnce,
) -> Solution:
    """Return the solution of a problem with given phases, from the parameters of an earlier answer.

    Parameters
    ----------
    problem : Problem
    search : _PhaseSearch
        Its two-phase field.
    phase : (E,) array
        Phases of the elements: 1 in inclusions, 0 elsewhere.
    warm_start : WarmStart
        Estimates to start from.
    solve_once : callable
        See `solve_two_phases`.
    """
    own = replace(search.modes, phase=phase)
    return solve_once(problem.with_fields({search.name: own}), warm_start)


def _two_phase_search(problem: Problem) -> _PhaseSearch:
    """Return the two-phase field of a problem, of which there is at least one.

    Raises
    ------
    InputError
        For several fields, or too many elements.
    """
    fields = problem.two_phase_fields
    if len(fields) > 1:
        raise InputError(
            f"{len(fields)} two-phase fields ({', '.join(fields)}); expected one: give the others "
            "prior = 'smooth', or regions"
        )
    ((name, modes),) = fields.items()
    if len(modes.phase) > MOST_ELEMENTS:
        raise InputError(
            f"the two-phase field of {name} has {len(modes.phase)} elements; expected at most "
            f"{MOST_ELEMENTS}: take a coarser mesh, or a region around the inclusion"
        )
    parts = next(
        body.parts for body in problem.bodies if name in body.field_lengths_m
    )
    number = next(k for k, part in enumerate(parts) if part.field_name == name)
    part = parts[number]
    elements = tuple(
        part.full_name(field_coefficient(k).name)
        for k in range(len(modes.phase))
    )
    return _PhaseSearch(
        name,
        part.full_name(CONTRAST.name),
        modes=modes,
        number=number,
        elements=elements,
    )


def _likelier_phases(probability: Array) -> Array:
    """Return the likelier phase (E,) of every element, 1.0 for an inclusion and 0.0 otherwise, from
    the probability (E,) of an inclusion.

    Each phase has at least `FEWEST_ELEMENTS` elements: if necessary, those that are nearest to it
    in probability are added.
    """
    phase = is_inclusion(probability).astype(float)
    order = np.argsort(probability)
    if phase.sum() < FEWEST_ELEMENTS:
        phase[order[-FEWEST_ELEMENTS:]] = 1.0
    elif phase.sum() > len(phase) - FEWEST_ELEMENTS:
        phase[order[:FEWEST_ELEMENTS]] = 0.0
    return phase


@dataclass(frozen=True, eq=False)
class _LinearisedMeasurements:
    """Measurements linearised in the logarithm of every element.

    Attributes
    ----------
    fit : LinearisedFit
        Fit with the elements' logarithms as further parameters.
    columns : (E,) int array
        Columns of the elements' logarithms in the fit.
    base : (E,) array
        Logarithms relative to the mean at which the measurements are linearised.
    faces : InternalFaces
        Faces between elements of the part.
    deviation : float
        Prior standard deviation of the logarithm of the contrast.
    """

    fit: LinearisedFit
    columns: Index
    base: Array
    faces: InternalFaces
    deviation: float

    def normal_equations(self, temperature: float) -> ElementInformation:
        """Return the normal equations, with those of the measurements divided by the
        temperature T.
        """
        return _normal_equations(
            self.fit,
            self.columns,
            base=self.base,
            deviation=self.deviation,
            temperature=temperature,
        )


def _linearise_in_elements(
    problem: Problem, search: _PhaseSearch, solution: Solution
) -> _LinearisedMeasurements:
    """Return the measurements linearised at a solution with the logarithm of the constant in every
    element as a parameter, instead of the shapes of the field.

    Parameters
    ----------
    problem : Problem
        Problem with the two-phase field `search`.
    search : _PhaseSearch
    solution : Solution
        Solution with a smooth field or with phases.

    Raises
    ------
    SimulationError
        If the equations of motion are singular at a solution.
    """
    body = _two_phase_body(solution, search)
    part = body.parts[search.number]
    assert part.field is not None
    theta = body.theta_from_values(solution.parameters)
    base = part.field.logarithms(theta[body.field_slices[search.number]])
    elements = ElementLogarithms.relative_to(search.modes, base)
    fit = _fit_with_elements(
        problem.with_fields({search.name: elements}), solution, search=search
    )
    return _LinearisedMeasurements(
        fit=fit,
        columns=_columns(fit, search),
        base=base,
        faces=InternalFaces.from_mesh(body.mesh, part.cells),
        deviation=search.modes.field.deviation,
    )


def _columns(fit: LinearisedFit, search: _PhaseSearch) -> Index:
    """Return the column (E,) in a fit of the logarithm of each element of the part that has the
    field.

    Raises
    ------
    KeyError
        If the fit does not have these parameters, as that of the two-phase field itself.
    """
    places = {name: k for k, name in enumerate(fit.names)}
    return np.array([places[name] for name in search.elements])


def _samples(
    draws: PosteriorDraws,
    fit: LinearisedFit,
    search: _PhaseSearch,
    solution: Solution,
) -> PhaseSamples:
    """Return draws of the phases as samples of the logarithms in the elements of the part with the
    field.

    Parameters
    ----------
    draws : PosteriorDraws
        Draws of phases and contrasts.
    fit : LinearisedFit
        Fit with the elements' logarithms as further parameters.
    search : _PhaseSearch
        The two-phase field.
    solution : Solution
        Its estimates are the mean of the other parameters.

    Returns
    -------
    PhaseSamples
        `smooth_misfit` is NaN: the caller sets it.
    """
    others = np.delete(np.arange(len(fit.names)), _columns(fit, search))
    shared = [int(k) for k in others if k < fit.shared_count]
    names = tuple(fit.names[k] for k in shared)
    mean, slopes = mean_logarithm(
        _two_phase_body(solution, search),
        solution.collocation.parameters,
        q=solution.q,
        part_index=search.number,
        names=names,
    )
    by_parameters = draws.changes[:, : len(shared)] @ slopes
    means = np.column_stack([draws.means[:, : len(shared)], draws.means[:, -1]])
    return PhaseSamples(
        logarithms=mean
        + by_parameters[:, None]
        + draws.contrasts[:, None] * draws.phases,
        contrasts=draws.contrasts,
        volumes_m3=draws.phases @ search.modes.volumes_m3,
        names=(*names, search.contrast),
        deviations=np.atleast_2d(np.cov(means, rowvar=False)),
        misfit=_chi_squared_per_measurement(fit),
        smooth_misfit=np.nan,
    )


def _fit_with_elements(
    problem: Problem, solution: Solution, search: _PhaseSearch
) -> LinearisedFit:
    """Return the linearised fit at a solution, with the elements' logarithms as further parameters,
    whose values are zero.

    Parameters
    ----------
    problem : Problem
        Problem whose field is an `ElementLogarithms`.
    solution : Solution
        Solution that gives positions and all other parameters.
    search : _PhaseSearch
        Names of the elements' logarithms.

    Raises
    ------
    SimulationError
        If the equations of motion are singular at a solution.
    """
    solved = solution.collocation
    elements = set(search.elements)
    collocation = replace(
        solved,
        experiments=problem.experiments,
        parameters=problem.parameters,
        associations=_associations(solved, problem.experiments),
    )
    p, positions = solved.unpack(solution.z)
    values = dict(
        zip((item.name for item in solved.parameters.free), p, strict=False)
    )
    q = [
        0.0 if item.name in elements else values[item.name]
        for item in collocation.parameters.free
    ]
    both = np.concatenate([q, p[solved.nq :]])
    return linearise_fit(collocation, collocation.pack(both, positions))


def _chi_squared_per_measurement(fit: LinearisedFit) -> float:
    """Return χ² per measurement of a linearised fit."""
    return fit.chi_squared / max(1, fit.measurement_count)


def _normal_equations(
    fit: LinearisedFit,
    of_z: Index,
    *,
    base: Array,
    deviation: float,
    temperature: float,
) -> ElementInformation:
    """Return the blocks of the normal equations of a linearised fit, for the logarithms of the
    elements and for all other parameters.

    Nothing is eliminated. Priors of the other parameters are included; the prior of the elements is
    not, but its deviation is copied to the result.

    Parameters
    ----------
    fit : LinearisedFit
    of_z : (E,) int array
        Columns of the elements' logarithms.
    base : (E,) array
        Logarithms relative to the mean at which the fit is linearised.
    deviation : float
        Prior standard deviation of the logarithm of the contrast.
    temperature : float
        Divides the information of the measurements, not that of the priors.
    """
    size = len(fit.names)
    normal = np.zeros((size, size))
    score = np.zeros(size)
    for block in fit.blocks:
        residual, slope, _ = block.channels
        matrix = slope.reshape(residual.size, size)
        normal += matrix.T @ matrix
        score += matrix.T @ residual.ravel()
    normal /= temperature
    score /= temperature
    of_p = np.delete(np.arange(size), of_z)
    priors = fit.prior_jacobian[of_p]
    return ElementInformation(
        of_p=normal[np.ix_(of_p, of_p)] + np.diag(priors**2),
        mixed=normal[np.ix_(of_z, of_p)],
        of_z=normal[np.ix_(of_z, of_z)],
        score_p=score[of_p] + priors * fit.prior_residual[of_p],
        score_z=score[of_z],
        base=base,
        deviation=deviation,
    )


def _with_samples(solution: Solution, samples: PhaseSamples) -> Solution:
    """Return a copy of the solution with bodies whose two-phase fields have these samples;
    variables and associations are the same.
    """
    collocation = solution.collocation
    bodies: dict[int, Body] = {}
    for body in dict.fromkeys(
        segment.body for segment in collocation.transcriptions
    ):
        fields = {
            part.field_name: replace(part.field, samples=samples)
            for part in body.parts
            if isinstance(part.field, TwoPhaseModes)
        }
        bodies[id(body)] = body.with_fields(fields)
    experiments = [
        replace(each, body=bodies.get(id(each.body), each.body))
        for each in collocation.experiments
    ]
    charts = _associations(collocation, experiments)
    return replace(
        solution,
        collocation=replace(
            collocation, experiments=experiments, associations=charts
        ),
    )


def _associations(
    collocation: Collocation, experiments: Sequence[Experiment]
) -> dict[str, Association]:
    """Return new associations of the measurements of a program, by name of the fitted experiment,
    that refer to the bodies of `experiments`.

    The associations themselves are unchanged: the bodies differ from those of the program in their
    fields only. `experiments` must contain every fitted experiment.
    """
    bodies = {experiment.name: experiment.body for experiment in experiments}
    return {
        segment.experiment.name: segment.association.on_body(
            bodies[segment.experiment.name]
        )
        for segment in collocation.transcriptions
    }
