"""Solving a problem whose field has two phases: a smooth field first, then phases and parameters.

1. The problem with a smooth field in place of the two phases is solved.
2. At that answer the measurements are linearised in the logarithm of every element, and phases are
   drawn from their posterior, see `statistics.phases`.
3. With the likelier phase of every element the problem is solved for the contrast and all other
   parameters by the method that was asked for. 2 and 3 repeat from there until no more than a
   small share of the volume changes its phase.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..fem.body import Body
from ..fem.constants import CONTRAST
from ..fem.field import FieldModes
from ..fem.two_phase import ElementLogarithms, PhaseSamples, TwoPhaseModes, inclusion
from ..methods.solution import Solution
from ..problem import Problem
from ..program.charts import Chart
from ..program.collocation import Collocation
from ..recording.experiment import Experiment
from ..statistics.fields import mean_logarithm
from ..statistics.linearised import LinearisedFit, linearised_fit
from ..statistics.phases import ElementInformation, Faces, PhaseDraws, draw_phases, start_phases
from .warm_start import Earlier

Solved = Callable[[Problem, str | Path | Earlier | None], Solution]

# Elements of a two-phase field: the sampler has two dense matrices of their square.
MOST_ELEMENTS = 4000
# Rounds of phases and parameters at most.
ROUNDS = 4
# Phases are final where less than this share of the inclusion's volume changes in a round.
SETTLED = 0.02
# An inclusion of fewer elements is noise of a single element.
FEWEST_ELEMENTS = 2


@dataclass(frozen=True, eq=False)
class _Search:
    """The two-phase field of a problem.

    Attributes
    ----------
    name : str
        Name of its constant, with the region in front.
    contrast : str
        Name of the contrast.
    modes : TwoPhaseModes
    number : int
        Index of the part in the body.
    """

    name: str
    contrast: str
    modes: TwoPhaseModes
    number: int


def solve_two_phases(
    problem: Problem, start: str | Path | Earlier | None, solved: Solved
) -> Solution:
    """Solve a problem with a two-phase field; the answer's body has the phases and their samples.

    Parameters
    ----------
    problem : Problem
        With exactly one two-phase field.
    start : str, Path or Earlier, optional
        Where the solve with the smooth field starts.
    solved : callable
        Solves a problem without a two-phase search.

    Raises
    ------
    InputError
        For several two-phase fields, or too many elements.
    """
    search = _search_of(problem)
    solution = solved(problem.with_fields({search.name: search.modes.smooth}), start)
    if not solution.status.converged:
        return solution
    smooth_misfit = _misfit(linearised_fit(solution.collocation, solution.z))
    phase: Array | None = None
    accepted: list[float] = []
    for _ in range(ROUNDS):
        draws, samples = _draws(problem, search, solution, phase, smooth_misfit)
        accepted.append(draws.accepted)
        if phase is not None:
            solution = _with_samples(solution, search, samples)
        likelier = inclusion(draws.probability).astype(float)
        if likelier.sum() < FEWEST_ELEMENTS or likelier.sum() > len(likelier) - FEWEST_ELEMENTS:
            likelier = _likeliest_elements(draws.probability)
        if phase is not None:
            volumes_m3 = search.modes.volumes_m3
            changed = volumes_m3 @ np.abs(likelier - phase) / (volumes_m3 @ phase)
            if changed < SETTLED:
                break
        following = problem.with_fields({search.name: replace(search.modes, phase=likelier)})
        guess = {search.contrast: float(np.exp(np.median(draws.contrasts)))}
        earlier = Earlier.of(solution)
        known = {k: v for k, v in earlier.values.items() if k != search.contrast}
        phase = likelier
        solution = solved(following, replace(earlier, values=known | guess))
        if not solution.status.converged:
            return solution
    else:
        draws, samples = _draws(problem, search, solution, phase, smooth_misfit)
        accepted.append(draws.accepted)
        solution = _with_samples(solution, search, samples)
    assert phase is not None
    note = (
        f"two phases of {search.name}: started from a smooth field (χ² per measurement "
        f"{smooth_misfit:.3g}), then {len(accepted)} rounds of phases; the inclusion has "
        f"{int(phase.sum())} of {len(phase)} elements; the sampler accepted {accepted[-1]:.0%}"
    )
    return replace(solution, notes=(note, *solution.notes))


def _search_of(problem: Problem) -> _Search:
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
    parts = next(body.parts for body in problem.bodies if name in body.lengths_m)
    number = next(k for k, part in enumerate(parts) if part.field_name == name)
    return _Search(name, parts[number].full_name(CONTRAST.name), modes, number)


def _likeliest_elements(probability: Array) -> Array:
    """Return phases (E,) of the few likeliest elements, where one class would be empty."""
    found = np.zeros(len(probability))
    found[np.argsort(probability)[-FEWEST_ELEMENTS:]] = 1.0
    return found


def _draws(
    problem: Problem,
    search: _Search,
    solution: Solution,
    phase: Array | None,
    smooth_misfit: float,
) -> tuple[PhaseDraws, PhaseSamples]:
    """Return draws of the phases by the measurements linearised at a solution, and as samples."""
    body = next(s.body for s in solution.collocation.segments if search.name in s.body.lengths_m)
    part = body.parts[search.number]
    assert part.field is not None
    theta = body.theta(solution.parameters)
    base = part.field.logarithms(theta[body.mode_places[search.number]])
    elements = ElementLogarithms.about(search.modes, base)
    names = [part.full_name(constant.name) for constant in elements.constants]
    fit = _by_elements(problem.with_fields({search.name: elements}), solution, set(names))
    of_z = np.array([fit.names.index(name) for name in names])
    data = _information(fit, of_z, base, search.modes.field.deviation)
    faces = Faces.of(body.mesh, part.cells)
    first = start_phases(data, faces, search.modes.volumes_m3) if phase is None else phase
    draws = draw_phases(data, faces, first)
    others = np.delete(np.arange(len(fit.names)), of_z)
    shared = [int(k) for k in others if k < fit.shared]
    own_names = tuple(fit.names[k] for k in shared)
    # Mean of ln c in the surroundings, by the parameters.
    mean, slopes = mean_logarithm(
        body, solution.collocation.parameters, solution.q, number=search.number, names=own_names
    )
    by_parameters = draws.changes[:, : len(shared)] @ slopes
    logarithms = mean + by_parameters[:, None] + draws.contrasts[:, None] * draws.phases
    both = np.column_stack([draws.means[:, : len(shared)], draws.means[:, -1]])
    return draws, PhaseSamples(
        logarithms=logarithms,
        contrasts=draws.contrasts,
        volumes_m3=draws.phases @ search.modes.volumes_m3,
        names=(*own_names, search.contrast),
        deviations=np.atleast_2d(np.cov(both, rowvar=False)),
        misfit=_misfit(fit),
        smooth_misfit=smooth_misfit,
    )


def _by_elements(problem: Problem, solution: Solution, names: Collection[str]) -> LinearisedFit:
    """Return the fit at a solution, linearised in the logarithm of every element.

    `names` are those of the elements' coefficients, which are zero there.
    """
    found = solution.collocation
    collocation = replace(
        found,
        experiments=problem.experiments,
        parameters=problem.parameters,
        charts=_charts(found, problem.experiments),
        explicit=False,
    )
    p, positions = found.unpack(solution.z)
    values = dict(zip((item.name for item in found.parameters.free), p, strict=False))
    q = [
        0.0 if item.name in names else values[item.name] for item in collocation.parameters.free
    ]
    both = np.concatenate([q, p[found.nq :]])
    return linearised_fit(collocation, collocation.pack(both, positions))


def _misfit(fit: LinearisedFit) -> float:
    """χ² per measurement."""
    return fit.chi_squared / max(1, fit.measurements)


def _information(
    fit: LinearisedFit, of_z: Array, base: Array, deviation: float
) -> ElementInformation:
    """Return the normal equations, with the columns `of_z` those of the elements."""
    size = len(fit.names)
    normal = np.zeros((size, size))
    score = np.zeros(size)
    for block in fit.blocks:
        residual, slope, _ = block.channels
        flat = slope.reshape(residual.size, size)
        normal += flat.T @ flat
        score += flat.T @ residual.ravel()
    temperature = max(1.0, _misfit(fit))
    normal /= temperature
    score /= temperature
    of_p = np.delete(np.arange(size), of_z)
    priors = fit.prior_slope[of_p]
    return ElementInformation(
        of_p=normal[np.ix_(of_p, of_p)] + np.diag(priors**2),
        mixed=normal[np.ix_(of_z, of_p)],
        of_z=normal[np.ix_(of_z, of_z)],
        score_p=score[of_p] + priors * fit.prior_residual[of_p],
        score_z=score[of_z],
        base=base,
        deviation=deviation,
    )


def _with_samples(solution: Solution, search: _Search, samples: PhaseSamples) -> Solution:
    """Return the solution whose body has the samples of the phases."""
    collocation = solution.collocation
    found: dict[int, Body] = {}

    def sampled(modes: FieldModes | None) -> FieldModes | None:
        return replace(modes, samples=samples) if isinstance(modes, TwoPhaseModes) else modes

    for segment in collocation.segments:
        body = segment.body
        if id(body) not in found:
            fields = {p.field_name: sampled(p.field) for p in body.parts if p.field}
            found[id(body)] = body.with_fields({n: f for n, f in fields.items() if f is not None})
    experiments = [replace(e, body=found[id(e.body)]) for e in collocation.experiments]
    charts = _charts(collocation, experiments)
    sampled_collocation = replace(collocation, experiments=experiments, charts=charts)
    return replace(solution, collocation=sampled_collocation)


def _charts(collocation: Collocation, experiments: Sequence[Experiment]) -> dict[str, Chart]:
    """Return where recordings are read, for bodies that differ in their fields only."""
    bodies = {experiment.name: experiment.body for experiment in experiments}
    return {
        segment.experiment.name: replace(segment.chart, body=bodies[segment.experiment.name])
        for segment in collocation.segments
    }
