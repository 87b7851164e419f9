"""Whether the meshes of a solved problem are fine enough for bodies that bend.

`check` warns of a mesh that is too coarse before the solve; these functions give the verdict and
the notes of an answer the same warning.
"""

from __future__ import annotations

from collections.abc import Iterator

from ..fem.body import Body
from ..fem.laws.constants import without_region
from ..fem.laws.moduli import ELASTIC
from ..problem import Problem
from ..statistics.budget.discretisation_error import Refinement
from ..statistics.concerns import Concern
from .check.body_check import LINEAR, bending_concerns, slenderness
from .check.declared_simulation import is_declared_simulated

# Value of `RefinementLevel.refined` of a solve on a finer mesh.
MESH = "mesh"


def mesh_resolution_concerns(problem: Problem, refinement: Refinement | None) -> list[Concern]:
    """Return a "check" concern for each body of linear tetrahedra whose mesh is too coarse for its
    bending.

    Empty if the recordings are declared to be simulated (`is_declared_simulated`), or if a solve on
    a finer mesh has measured the error.

    Parameters
    ----------
    problem : Problem
    refinement : Refinement or None
        Discretisation errors of the estimates.
    """
    levels = () if refinement is None else refinement.levels
    if is_declared_simulated(problem) or any(level.refined == MESH for level in levels):
        return []
    return [
        concern for concern in _coarse_mesh_concerns(problem) if concern.data["element"] == LINEAR
    ]


def mesh_resolution_notes(problem: Problem) -> list[str]:
    """Return the same sentences as notes where they are no concerns: for recordings that are
    declared to be simulated, and for other elements, whose error is smaller.
    """
    is_simulated = is_declared_simulated(problem)
    return [
        concern.message
        for concern in _coarse_mesh_concerns(problem)
        if is_simulated or concern.data["element"] != LINEAR
    ]


def _coarse_mesh_concerns(problem: Problem) -> Iterator[Concern]:
    """Yield a concern for each fitted body with a mesh that is too coarse for its bending, and of
    which an elastic constant is estimated.

    Cells of specimens are left out: their deformation is homogeneous.
    """
    fitted = [each for each in problem.experiments if not each.validation]
    estimated = {without_region(item.name) for item in problem.parameters.free}
    bodies = dict.fromkeys(each.body for each in fitted if each.specimen is None)
    for body in bodies:
        if estimated.isdisjoint(_elastic_names(body)):
            continue
        names = [repr(each.name) for each in fitted if each.body is body]
        of = f"in the body of {', '.join(names)}" if len(bodies) > 1 else ""
        for concern in bending_concerns(body, slenderness(body.mesh)):
            yield Concern(concern.code, concern.grade, data={**concern.data, "of": of})


def _elastic_names(body: Body) -> set[str]:
    """Return the names of the moduli and of the constants of the materials of a body, without
    regions.
    """
    constants = (constant.name for part in body.parts for constant in part.material.constants)
    return {*ELASTIC, *constants}
