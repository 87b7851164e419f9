"""Contact as complementarity: what presses does not come near, and what is apart does not press.

Pressure times gap is brought down in a few solves, each from the one before, and the first from the
answer with the contact's energy. Only faces that came within an edge's length of an obstacle there
have pressures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..errors import InputError
from ..fem.selection import Indices
from ..model.contact import contacts
from ..program.collocation import Collocation
from ..program.touches import nearest
from ..recording.experiment import Experiment
from ..recording.obstacle import Obstacle
from .solution import Solution

# Pressure times gap of each solve, in κδ².
RELAXED = (1e-2, 1e-3, 1e-4)
# Faces that came so near may touch, in edges.
REACH = 1.0
# Solves a collocation from variables of it, as it is made explicit.
Solve = Callable[[Collocation, Array], Solution]


def require_smooth(obstacles: Iterable[Obstacle]) -> None:
    """Refuse friction.

    Raises
    ------
    InputError
        If an obstacle has some.
    """
    for each in obstacles:
        if each.rubs:
            raise InputError(
                f"{each.name} has friction, which contact as complementarity leaves out; expected "
                'friction = 0, or contact = "energy" of the method interior-point'
            )


def hardened(first: Solution, solve: Solve) -> Solution:
    """The answer with contact as complementarity, from that with the contact's energy."""
    near = {
        segment.experiment.name: within_reach(segment.experiment, x.reshape(len(x), -1))
        for segment, x in zip(first.collocation.segments, first.positions_m, strict=True)
    }
    found, relaxed = first, _relaxed(first.collocation, near, 0.0)
    for share in RELAXED:
        # Its pressures are those of the solve before, not such as the smaller product asks for.
        z = relaxed.made_explicit().pack(*found.collocation.unpack(found.z))
        relaxed = _relaxed(first.collocation, near, share)
        found = replace(solve(relaxed, z).after(found, ""), notes=first.notes)
        if not found.status.converged:
            break
    note = (
        f"contact as complementarity: {len(RELAXED)} solves after that with its energy bring "
        f"pressure times gap down to {share:g} κδ²"
    )
    # Multipliers that balance pressures which follow from gaps: the solver's leave its rounding.
    return replace(found, given_multipliers=None, notes=(*found.notes, note))


def within_reach(experiment: Experiment, x: Array) -> list[Obstacle]:
    """Obstacles that touch no faces but those that came near in a motion x (T, 3n)."""
    found, mesh = [], experiment.body.mesh
    for contact, obstacle in zip(contacts(experiment), experiment.obstacles, strict=True):
        surface = contact.contact.surface
        faces = mesh.surface[surface.faces]
        gaps = nearest(contact, x).reshape(-1, surface.a_face).min(axis=1)
        if len(touched := np.unique(faces[gaps < REACH * surface.edge_m])):
            obstacle = replace(obstacle, faces=Indices(mesh.file_index[touched].tolist()))
        found.append(obstacle)
    return found


def with_energy(experiment: Experiment) -> Experiment:
    """An experiment whose obstacles all have the contact's energy."""
    return experiment.with_obstacles([replace(o, relaxed=None) for o in experiment.obstacles])


def _relaxed(
    collocation: Collocation, near: Mapping[str, list[Obstacle]], share: float
) -> Collocation:
    """The program with obstacles that touch what is near, at a share of κδ²."""
    experiments = [
        each.with_obstacles([replace(o, relaxed=share) for o in near[each.name]])
        if each.name in near
        else each
        for each in collocation.experiments
    ]
    return replace(collocation, experiments=experiments)
