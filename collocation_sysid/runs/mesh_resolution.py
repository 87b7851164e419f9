"""Error of the estimates by the meshes of a solved problem, and whether the meshes are fine enough.

Every solve estimates the change of the estimates on a finer mesh to first order, see `mesh_error`.
`check` warns of a mesh that is too coarse before the solve; the verdict and the notes of an answer
contain the same warning.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from ..common.array_types import Array
from ..common.display import LARGEST_CHANGE
from ..errors import InputError, SimulationError
from ..fem.body import Body
from ..fem.laws.constants import YOUNG, without_region
from ..fem.laws.moduli import ELASTIC
from ..methods.solution import Solution
from ..problem import Problem
from ..statistics.budget.discretisation_error import Refinement, estimate_changes
from ..statistics.budget.mesh_error import LARGEST_NODE_COUNT, mesh_residual_changes
from ..statistics.concerns import Concern
from ..statistics.linearised import LinearisedFit, parameter_values
from .check.body import LINEAR, bending_concerns, slenderness

# Value of `RefinementLevel.refined` of a solve on a finer mesh.
MESH = "mesh"
# Code of the concern about a large estimated error of the mesh.
MESH_ERROR = "mesh/error"
# Largest change of a logarithm: a larger one is no estimate.
LARGEST_STEP = 2.0
# Moduli of which a larger change shows that the estimate to first order does not hold.
CHECKED_MODULI = (YOUNG.name, "mu_pa")


def mesh_changes(
    problem: Problem, solution: Solution, fit: LinearisedFit
) -> tuple[Sequence[Array], dict[str, float] | None, str]:
    """Return the changes (T, M, 3, 1) of the residuals of each block of a fit, to first order, on a
    mesh with elements of half the size, those of the estimates over their values, by name, and a
    note why they are unknown, or "".

    Empty and None for recordings that are declared to be simulated, for specimens without a mesh,
    and where the effect cannot be computed.

    Parameters
    ----------
    fit : LinearisedFit
        The measurements linearised at the solution.
    """
    collocation = solution.collocation
    fitted = [each.experiment for each in collocation.transcriptions]
    bodies = list(dict.fromkeys(each.body for each in fitted if each.specimen is None))
    if not bodies or problem.is_declared_simulated:
        return (), None, ""
    nodes = max(len(body.nodes.points_m) for body in bodies)
    if nodes > LARGEST_NODE_COUNT:
        reason = f"a body has {nodes:,} nodes, more than {LARGEST_NODE_COUNT:,}"
        return (), None, _unknown_note(reason)
    try:
        changes = mesh_residual_changes(collocation, solution.z)
    except (InputError, SimulationError, np.linalg.LinAlgError) as error:
        return (), None, _unknown_note(str(error))
    change = estimate_changes(fit, changes)[: collocation.nq, 0]
    before = parameter_values(collocation, solution.q)
    values = parameter_values(collocation, solution.q + change)
    modulus = next(_modulus_beyond_first_order(before, values), "")
    if modulus:
        reason = f"to first order, {modulus} would change by more than half"
        return (), None, _unknown_note(reason)
    shares = {name: (values[name] - value) / abs(value) for name, value in before.items() if value}
    return changes, shares, ""


def _unknown_note(reason: str) -> str:
    return f"the intervals contain no error of the mesh: {reason}; `refine` measures it"


def _modulus_beyond_first_order(
    before: Mapping[str, float], after: Mapping[str, float]
) -> Iterator[str]:
    """Yield the moduli that change by more than `LARGEST_STEP` of the logarithm, or their sign."""
    for name, value in after.items():
        if without_region(name) in CHECKED_MODULI:
            ratio = value / before[name]
            if not np.exp(-LARGEST_STEP) < ratio < np.exp(LARGEST_STEP):
                yield name


def mesh_resolution_concerns(
    problem: Problem, refinement: Refinement | None, by_mesh: Mapping[str, float] | None
) -> list[Concern]:
    """Return a "check" concern for each body whose mesh is too coarse for its bending: of linear
    tetrahedra, and of other elements where the error of the mesh could not be estimated.

    Empty if the recordings are declared to be simulated (`Problem.is_declared_simulated`), or if a solve on
    a finer mesh has measured the error.

    Parameters
    ----------
    refinement : Refinement or None
        Measured discretisation errors of the estimates.
    by_mesh : mapping of str to float or None
        Changes of the estimates over their values by elements of half the size; None if unknown.
    """
    levels = () if refinement is None else refinement.levels
    if problem.is_declared_simulated or any(level.refined == MESH for level in levels):
        return []
    few = [each for each in _coarse_mesh_concerns(problem) if _is_reason(each, by_mesh)]
    return [*_large_error_concerns(problem, by_mesh or {}), *few]


def _is_reason(few: Concern, by_mesh: Mapping[str, float] | None) -> bool:
    """Return whether too few elements are a reason of the verdict, and not a note."""
    return few.data["element"] == LINEAR or by_mesh is None


def _large_error_concerns(problem: Problem, by_mesh: Mapping[str, float]) -> Iterator[Concern]:
    """Constants on a linear scale may be near zero, and λ changes without limit near ν = ½."""
    bodies = dict.fromkeys(e.body for e in problem.experiments if e.specimen is None)
    elastic = set().union(*map(_elastic_names, bodies))
    linear = problem.parameters.linear_names
    judged = {item.name for item in problem.parameters.free if item.name not in linear}
    changes = {
        name: abs(change)
        for name, change in by_mesh.items()
        if without_region(name) == YOUNG.name
        or (name in judged and without_region(name) in elastic)
    }
    name = max(changes, key=changes.__getitem__, default="")
    if name and changes[name] > LARGEST_CHANGE:
        yield Concern(MESH_ERROR, "check", data={"name": name})


def mesh_resolution_notes(
    problem: Problem, by_mesh: Mapping[str, float] | None = None
) -> list[str]:
    """Return the same sentences as notes where they are no concerns: for recordings that are
    declared to be simulated, and for other elements with a known error of the mesh.
    """
    is_simulated = problem.is_declared_simulated
    return [
        concern.message
        for concern in _coarse_mesh_concerns(problem)
        if is_simulated or not _is_reason(concern, by_mesh)
    ]


def _coarse_mesh_concerns(problem: Problem) -> Iterator[Concern]:
    """Yield each fitted body with an elastic estimate that is too coarse for bending."""
    fitted = [each for each in problem.experiments if not each.validation]
    estimated = {without_region(item.name) for item in problem.parameters.free}
    bodies = dict.fromkeys(each.body for each in fitted if each.specimen is None)
    for body in bodies:
        if estimated.isdisjoint(_elastic_names(body)):
            continue
        names = [repr(each.name) for each in fitted if each.body is body]
        of = f"in the body of {', '.join(names)}" if len(bodies) > 1 else ""
        for concern in bending_concerns(body, *slenderness(body.mesh)):
            yield Concern(concern.code, concern.grade, data={**concern.data, "of": of})


def _elastic_names(body: Body) -> set[str]:
    constants = (constant.name for part in body.parts for constant in part.material.constants)
    return {*ELASTIC, *constants}
