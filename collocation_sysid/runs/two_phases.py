"""Solving a problem with a two-phase field: a smooth field first, then phases and parameters.

1. The problem with a smooth field in place of the two phases is solved.
2. At that solution the measurements are linearised in the logarithm of every element. Their
total-variation estimate gives first phases.
3. From these on, phases, contrast and parameters are sampled from their posterior, see
`phase_posterior`, with linearised measurements that simulations of some samples correct. This is
repeated at the mean of the samples until the contrast settles.
4. The problem is solved by the chosen method with the phases that represent the samples.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..common.array_types import Array
from ..errors import InputError, SimulationError
from ..fem.body import Body
from ..fem.laws.constants import CONTRAST, field_coefficient
from ..fem.two_phase import ElementLogarithms, PhaseSamples, TwoPhaseModes
from ..methods.solution import Solution
from ..problem import Problem
from ..program.association import Association
from ..program.collocation import Collocation
from ..recording.experiment import Experiment
from ..statistics.field_estimates import mean_logarithm
from ..statistics.linearised import LinearisedFit, factorise_information, linearise_fit
from ..statistics.phase_sampling import USUAL, InternalFaces, initial_phases
from .phase_posterior import (
    FEWEST_SIMULATED,
    FIRST_EXPONENT,
    ContrastPrior,
    ElementSurrogate,
    PhasePosterior,
)
from .warm_start import WarmStart

SolveOnce = Callable[[Problem, str | Path | WarmStart | None], Solution]

# Most elements of a two-phase field: the sampler stores two dense square matrices of this size.
MOST_ELEMENTS = 4000
# Most linearisations.
MOST_ROUNDS = 5
# Fewest linearisations: the first is at the smooth field, not at the mean of samples.
FEWEST_ROUNDS = 2
# Change of the mean logarithm of the contrast in a round, over its standard deviation, below which
# the samples are final.
SETTLED_DEVIATIONS = 0.5
# Fewest elements of an inclusion: a single element is noise.
FEWEST_ELEMENTS = 2
# Standard deviation of the logarithm of a contrast that is given.
GIVEN_DEVIATION = 1e-6


@dataclass(frozen=True, eq=False)
class _PhaseSearch:
    """Two-phase field of a problem, and the names of its parameters."""

    name: str  # name of its constant, with the region in front
    contrast: str
    modes: TwoPhaseModes  # shapes of the field
    number: int  # index of the part in the body
    elements: tuple[str, ...]  # names of the coefficients of `ElementLogarithms`


def solve_two_phases(
    problem: Problem, start: str | Path | WarmStart | None, solve_once: SolveOnce
) -> Solution:
    """Solve a problem with a two-phase field; the body of the solution has the phases and their
    samples.

    If the solve with the smooth field or that with phases does not converge, its solution is
    returned, without samples. History, counts and times of the result are those of its own solve
    alone.

    Parameters
    ----------
    problem : Problem
        Problem with exactly one two-phase field.
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
    solution = solve_once(problem.with_fields({search.name: search.modes.to_smooth_field()}), start)
    if not solution.status.converged:
        return solution
    fit = linearise_fit(solution.collocation, solution.z)
    posterior, temperature, rounds, is_simulated = _sample_posterior(problem, search, solution, fit)
    phase = _representative_phases(posterior.draws.probability, search.modes.volumes_m3)
    best = solve_once(
        problem.with_fields({search.name: replace(search.modes, phase=phase)}),
        WarmStart.of(solution),
    )
    if not best.status.converged:
        return best
    samples = _samples(posterior, is_simulated, search=search, solution=best)
    misfit = _chi_squared_per_measurement(fit)
    best = _with_samples(best, replace(samples, smooth_misfit=misfit))
    note = (
        f"two phases of {search.name}: started from a smooth field (χ² per measurement "
        f"{misfit:.3g}), {rounds} rounds of samples; the inclusion has "
        f"{int(phase.sum())} of {len(phase)} elements; the posterior is tempered by "
        f"{temperature:.3g}, the lack of fit per shape of the smooth field"
    )
    return replace(best, notes=(note, *best.notes))


def _sample_posterior(
    problem: Problem, search: _PhaseSearch, solution: Solution, fit: LinearisedFit
) -> tuple[PhasePosterior, float, int, bool]:
    """Sample phases and parameters from the solution with a smooth field on."""
    in_logarithms = _linearise_at(problem, search, solution=solution)
    phases = initial_phases(
        in_logarithms.information(), in_logarithms.faces, volumes_m3=search.modes.volumes_m3
    )
    surrogate = replace(in_logarithms, exponent=FIRST_EXPONENT)
    least_chi_squared = np.inf
    last_mean = np.inf
    rounds = 0
    while True:
        rounds += 1
        draft = PhasePosterior.sample(surrogate, phases, settings=USUAL, seed=2 * rounds)
        simulated = draft.simulate()
        least_chi_squared = min(least_chi_squared, simulated.least_chi_squared)
        posterior = PhasePosterior.sample(
            simulated.corrected_surrogate(),
            draft.select_last_phases(),
            settings=USUAL,
            seed=2 * rounds + 1,
        )
        phases = posterior.select_last_phases()
        mean = posterior.contrasts.mean()
        change = abs(mean - last_mean) / max(posterior.contrasts.std(), GIVEN_DEVIATION)
        last_mean = mean
        if rounds >= MOST_ROUNDS or (rounds >= FEWEST_ROUNDS and change < SETTLED_DEVIATIONS):
            break
        try:
            surrogate = _linearise_at_mean(problem, search, posterior)
        except SimulationError:
            break
    temperature = 1.0
    if np.isfinite(least_chi_squared):
        # Temperature of `statistics.phase_sampling`: lack of fit per shape of the smooth field.
        determined = max(1.0, factorise_information(fit).determined_count)
        temperature = max(1.0, (least_chi_squared - fit.chi_squared) / determined)
    if temperature > 1:
        posterior = PhasePosterior.sample(
            posterior.surrogate,
            phases,
            settings=USUAL,
            seed=2 * rounds + 2,
            temperature=temperature,
        )
    return posterior, temperature, rounds, len(simulated.p) >= FEWEST_SIMULATED


def _two_phase_body(solution: Solution, search: _PhaseSearch) -> Body:
    """Return the body, among those of a solution, that has the two-phase field of `search`."""
    transcriptions = solution.collocation.transcriptions
    return next(s.body for s in transcriptions if search.name in s.body.field_lengths_m)


def _two_phase_search(problem: Problem) -> _PhaseSearch:
    """Return the two-phase field of a problem, of which there is at least one."""
    fields = problem.find_two_phase_fields()
    if len(fields) > 1:
        raise InputError(
            f"{len(fields)} two-phase fields ({', '.join(fields)}); expected one: give the others "
            "prior = 'smooth', or regions"
        )
    ((name, modes),) = fields.items()
    if len(modes.phase) > MOST_ELEMENTS:
        raise InputError(
            f"the two-phase field of {name} has {len(modes.phase)} elements; expected at most "
            f"{MOST_ELEMENTS}: use a coarser mesh, or a region around the inclusion"
        )
    parts = next(body.parts for body in problem.bodies if name in body.field_lengths_m)
    number = next(k for k, part in enumerate(parts) if part.field_name == name)
    part = parts[number]
    elements = tuple(part.full_name(field_coefficient(k).name) for k in range(len(modes.phase)))
    return _PhaseSearch(
        name, part.full_name(CONTRAST.name), modes=modes, number=number, elements=elements
    )


def _representative_phases(probability: Array, volumes_m3: Array) -> Array:
    """Return phases (E,) that represent samples: the elements of highest probability (E,), whose
    volume is the mean volume of the inclusion (Vorob'ev expectation of a random set).

    The likelier phase of each element would give a smaller inclusion where the probability has
    small values in many elements, and in exchange another contrast. Each phase has at least
    `FEWEST_ELEMENTS` elements.
    """
    order = np.argsort(-probability, kind="stable")
    mean_m3 = volumes_m3 @ probability
    enclosed_m3 = np.cumsum(volumes_m3[order])
    count = int(np.argmin(np.abs(enclosed_m3 - mean_m3))) + 1
    count = min(max(count, FEWEST_ELEMENTS), len(order) - FEWEST_ELEMENTS)
    phase = np.zeros(len(order))
    phase[order[:count]] = 1.0
    return phase


def _linearise_at(problem: Problem, search: _PhaseSearch, solution: Solution) -> ElementSurrogate:
    """Linearise measurements by the logarithm of every element at a solution."""
    solved = solution.collocation
    body = _two_phase_body(solution, search)
    part = body.parts[search.number]
    assert part.field is not None
    theta = body.theta_from_values(solution.parameters)
    base = part.field.logarithms(theta[body.field_slices[search.number]])
    collocation = _collocation_with_elements(problem, search, collocation=solved, base=base)
    p, positions = solved.unpack(solution.z)
    values = dict(zip((item.name for item in solved.parameters.free), p, strict=False))
    # Shapes of a smooth field have the names of elements.
    elements = set(search.elements)
    q = [
        0.0 if item.name in elements else values[item.name] for item in collocation.parameters.free
    ]
    return ElementSurrogate.linearise(
        collocation,
        np.concatenate([q, p[solved.nq :]]),
        element_names=search.elements,
        base=base,
        faces=InternalFaces.from_mesh(body.mesh, part.cells),
        prior=_contrast_prior(problem, search),
        exponent=0.0,
        guess=positions,
    )


def _linearise_at_mean(
    problem: Problem, search: _PhaseSearch, posterior: PhasePosterior
) -> ElementSurrogate:
    """Return the measurements linearised at the mean of samples, with the exponent of these."""
    before = posterior.surrogate
    base = posterior.mean_logarithms
    p = before.p.copy()
    p[before.other_columns] += posterior.mean_changes.mean(axis=0)
    return ElementSurrogate.linearise(
        _collocation_with_elements(problem, search, collocation=before.collocation, base=base),
        p,
        element_names=search.elements,
        base=base,
        faces=before.faces,
        prior=before.prior,
        exponent=before.exponent,
        guess=before.positions,
    )


def _collocation_with_elements(
    problem: Problem, search: _PhaseSearch, collocation: Collocation, base: Array
) -> Collocation:
    """Return the program of a problem with the logarithm of each element as a parameter, relative
    to `base` (E,), with the associations of a program that has been solved.
    """
    elements = ElementLogarithms.relative_to(search.modes, base)
    with_elements = problem.with_fields({search.name: elements})
    return replace(
        collocation,
        experiments=with_elements.experiments,
        parameters=with_elements.parameters,
        associations=_associations(collocation, with_elements.experiments),
    )


def _contrast_prior(problem: Problem, search: _PhaseSearch) -> ContrastPrior:
    """Return the prior of ln contrast: the field's, the user's, or the fixed value."""
    (item,) = (item for item in problem.parameters.scalars if item.name == search.contrast)
    if item.is_fixed:
        assert item.guess is not None
        return ContrastPrior(float(np.log(item.guess)), GIVEN_DEVIATION)
    if item.prior is not None and item.scale == "log":
        mean, deviation = item.prior
        return ContrastPrior(float(np.log(mean)), deviation)
    return ContrastPrior(0.0, search.modes.field.deviation)


def _samples(
    posterior: PhasePosterior, is_simulated: bool, search: _PhaseSearch, solution: Solution
) -> PhaseSamples:
    """Return samples of the logarithms in the elements of the part with the field."""
    surrogate = posterior.surrogate
    others = surrogate.other_columns
    is_shared = others < surrogate.fit.shared_count
    shared = others[is_shared]
    names = tuple(surrogate.fit.names[k] for k in shared)
    parameters = solution.collocation.parameters
    free = [item.name for item in parameters.free]
    mean, slopes = mean_logarithm(
        _two_phase_body(solution, search),
        parameters,
        q=solution.q,
        part_index=search.number,
        names=names,
    )
    at_solution = solution.q[[free.index(name) for name in names]]
    shift = surrogate.p[shared] - at_solution
    changes = shift + posterior.draw_changes(seed=0)[:, is_shared]
    departures = np.column_stack(
        [
            shift + posterior.mean_changes[:, is_shared],
            posterior.mean_contrasts - np.log(_contrast_of_solution(solution, search)),
        ]
    )
    fit = linearise_fit(solution.collocation, solution.z)
    return PhaseSamples(
        logarithms=mean
        + (changes @ slopes)[:, None]
        + posterior.contrasts[:, None] * posterior.phases,
        contrasts=posterior.contrasts,
        volumes_m3=posterior.phases @ search.modes.volumes_m3,
        names=(*names, search.contrast),
        deviations=departures.T @ departures / len(departures),
        misfit=_chi_squared_per_measurement(fit),
        smooth_misfit=np.nan,
        scale_reduction=posterior.draws.scale_reduction,
        is_simulated=is_simulated,
    )


def _contrast_of_solution(solution: Solution, search: _PhaseSearch) -> float:
    """Return the contrast of a solution with phases, estimated or given."""
    body = _two_phase_body(solution, search)
    theta = body.theta_from_values(solution.parameters)
    return float(theta[body.field_slices[search.number]][0])


def _chi_squared_per_measurement(fit: LinearisedFit) -> float:
    """Return χ² per measurement of a linearised fit."""
    return fit.chi_squared / max(1, fit.measurement_count)


def _with_samples(solution: Solution, samples: PhaseSamples) -> Solution:
    """Return the solution with bodies whose two-phase fields have these samples."""
    collocation = solution.collocation
    bodies: dict[int, Body] = {}
    for body in dict.fromkeys(transcription.body for transcription in collocation.transcriptions):
        fields = {
            part.field_name: replace(part.field, samples=samples)
            for part in body.parts
            if isinstance(part.field, TwoPhaseModes)
        }
        bodies[id(body)] = body.with_fields(fields)
    experiments = [
        replace(each, body=bodies.get(id(each.body), each.body)) for each in collocation.experiments
    ]
    associations = _associations(collocation, experiments)
    return replace(
        solution,
        collocation=replace(collocation, experiments=experiments, associations=associations),
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
        transcription.experiment.name: transcription.association.on_body(
            bodies[transcription.experiment.name]
        )
        for transcription in collocation.transcriptions
    }
