"""Contact as complementarity: 0 ≤ pressure ⟂ gap ≥ 0.

The product of pressure and gap is decreased in a few solves, each from the previous solution; the
first starts from the solution with the contact energy. Only faces that come within an edge length
of an obstacle in that solution have pressures. Use `solve_complementarity` after a solve with the
contact energy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

import numpy as np

from ..common.array_types import Array
from ..errors import InputError
from ..fem.meshes.selection import Indices
from ..model.contact.force import contact_terms
from ..model.contact.summary import smallest_gaps
from ..program.collocation import Collocation
from ..program.lifted.collocation import with_lifted_variables
from ..recording.experiment import Experiment
from ..recording.obstacle import Obstacle
from .solution import Solution

# Pressure times gap in each of the successive solves, in κδ².
RELAXED = (1e-2, 1e-3, 1e-4)
# Solves a collocation from variables of its form with lifted variables.
Solve = Callable[[Collocation, Array], Solution]


def require_frictionless(obstacles: Iterable[Obstacle]) -> None:
    """Raise `InputError` if an obstacle has friction, with its name and the alternatives."""
    for each in obstacles:
        if each.has_friction:
            raise InputError(
                f'{each.name} has friction, which contact = "complementarity" does not support; '
                'expected friction = 0, or contact = "energy" of the method interior-point'
            )


def solve_complementarity(first: Solution, solve: Solve) -> Solution:
    """Return the solution with contact as complementarity.

    Pressure times gap takes the values `RELAXED` κδ² in turn; each solve starts from the previous
    solution.

    Parameters
    ----------
    first : Solution
        Solution with the contact energy.
    solve : callable
        Function that solves a collocation from variables of its form with lifted variables.

    Returns
    -------
    Solution
        Solution of the last solve, with the history and the times of all; the sequence ends with
        the first solve that does not converge. It has no `initial_multipliers`, and the notes of
        `first` with one on the solves; notes of later solves are left out.
    """
    obstacles_by_experiment = {
        transcription.experiment.name: reachable_obstacles(
            transcription.experiment, x.reshape(len(x), -1)
        )
        for transcription, x in zip(
            first.collocation.transcriptions, first.positions_m, strict=True
        )
    }
    solution = first
    relaxed = _relax(first.collocation, obstacles_by_experiment, share=0.0)
    for share in RELAXED:
        # The pressures are those of the previous solve, not those of the smaller product.
        z = with_lifted_variables(relaxed).pack(*solution.collocation.unpack(solution.z))
        relaxed = _relax(first.collocation, obstacles_by_experiment, share=share)
        solution = replace(solve(relaxed, z).after(solution, ""), notes=first.notes)
        if not solution.status.converged:
            break
    note = (
        "contact as complementarity: after the solve with a contact energy of stiffness κ and "
        f"range δ, {len(RELAXED)} further solves reduced the product of pressure and gap to "
        f"{share:g} κδ²"
    )
    # The multipliers are computed again where needed, as the solver's contain its rounding errors.
    return replace(solution, initial_multipliers=None, notes=(*solution.notes, note))


def reachable_obstacles(experiment: Experiment, x: Array) -> list[Obstacle]:
    """Return the obstacles of an experiment, restricted to faces that come near in a motion.

    Parameters
    ----------
    x : (T, 3n) array
        Positions [m].

    Returns
    -------
    list of Obstacle
        One per obstacle, with the faces that come within a mean edge of it; an obstacle that no face
        comes near is unchanged.
    """
    obstacles = []
    mesh = experiment.body.mesh
    for contact, obstacle in zip(contact_terms(experiment), experiment.obstacles, strict=True):
        surface = contact.law_of_contact.surface
        faces = mesh.surface[surface.faces]
        gaps = smallest_gaps(contact, x).reshape(-1, surface.points_per_face).min(axis=1)
        if len(reachable_faces := np.unique(faces[gaps < surface.edge_m])):
            obstacle = replace(obstacle, faces=Indices(mesh.file_index[reachable_faces].tolist()))
        obstacles.append(obstacle)
    return obstacles


def with_contact_energy(experiment: Experiment) -> Experiment:
    """Return a copy of the experiment with the contact energy for all
    obstacles, `relaxed` = None.
    """
    return experiment.with_obstacles([replace(o, relaxed=None) for o in experiment.obstacles])


def _relax(
    collocation: Collocation, obstacles_by_experiment: Mapping[str, list[Obstacle]], share: float
) -> Collocation:
    experiments = [
        each.with_obstacles([replace(o, relaxed=share) for o in obstacles_by_experiment[each.name]])
        if each.name in obstacles_by_experiment
        else each
        for each in collocation.experiments
    ]
    return replace(collocation, experiments=experiments)
