"""Changes of the forces of obstacles by systematic effects: the size of the body, a rigid contact.

If the body is larger than its mesh, its contact forces grow, and obstacles are displaced such that
first contact is preserved: an indentation counts from first contact, and the prior of an obstacle's
offset refers to the surface of the body. A larger body would penetrate obstacles that do not move,
by its relative size times its distance from the grasps: for an indentation of 1 mm into a block of
15 mm, 15 % of the indentation for a size error of 1 %.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array
from ...model.contact.force import Contact, contact_terms
from ...model.dynamics import Dynamics
from ...model.forces import Forces
from ...program.experiment_iterate import ExperimentIterate
from ...recording.experiment import Experiment
from ...recording.obstacle import Obstacle

# Rows whose gaps are evaluated together.
ROWS_AT_ONCE = 64


@dataclass(frozen=True, eq=False)
class FirstContact:
    """First contact of an obstacle with a body, or its nearest approach."""

    row: int  # index of the row in the grid, from 0
    # (3,): mean of the points in contact, weighted by their pressure, in the row before and at the
    # start [m].
    place_m: Array
    start_place_m: Array
    normal: Array  # (3,): normal of the obstacle there, in the world

    @classmethod
    def from_motion(cls, contact: Contact, x: Array) -> FirstContact:
        """Return the first contact in a motion x (N, 3n) [m], or the nearest approach if there is
        none.

        Contact begins where a gap is less than the width of the contact law. Without pressure in
        that row, the point with the smallest gap counts.
        """
        law = contact.law_of_contact
        nearest_m = np.inf
        row = 0
        for first in range(0, len(x), ROWS_AT_ONCE):
            gaps_m = law.gaps(contact.points.vectors(x[first : first + ROWS_AT_ONCE]))
            touching = np.flatnonzero((gaps_m < law.widths_m).any(axis=1))
            gaps_m = gaps_m.min(axis=1)
            row_in_chunk = int(touching[0]) if len(touching) else int(gaps_m.argmin())
            if gaps_m[row_in_chunk] < nearest_m:
                nearest_m = float(gaps_m[row_in_chunk])
                row = first + row_in_chunk
            if len(touching):
                break
        y = contact.points.vectors(x[row : row + 1])
        gaps_m, slopes = law.gaps_with_slopes(y)
        gaps_m = gaps_m[0]
        weights = law.surface.area_m2 * contact.scaled_pressures(x[row : row + 1])[0, 0]
        if not weights.any():
            weights = (gaps_m == gaps_m.min()).astype(float)
        weights = weights / weights.sum()
        normal = slopes[:3, 0] @ weights
        # The row before has the surface as it is without contact.
        place_m, start_place_m = (
            x[k].reshape(-1, 3)[law.obstacle.nodes[0]]
            + contact.points.vectors(x[k : k + 1])[:3, 0] @ weights
            for k in (max(row - 1, 0), 0)
        )
        unit = normal / max(float(np.linalg.norm(normal)), 1e-9)
        return cls(row, place_m, start_place_m, normal=unit)


def contact_changes_by_size_n(dynamics: Dynamics, x: Array) -> Iterator[Array]:
    """Yield for each contact force with an energy its change per relative size of the body at the
    evaluations, (evaluations, 3n) [N]; nothing without obstacles.

    Contact areas grow with the square of the size; a contact stiffness that is not stated falls
    with the size, as it follows the edges of the mesh.

    Parameters
    ----------
    dynamics : Dynamics
        Equations of motion at the parameters.
    x : (N, 3n) array
        Positions [m].
    """
    forces = dynamics.select_evaluated_forces()
    states_of = forces.states_of_terms(*dynamics.evaluation_states(x))
    for contact in _contacts_with_energy(forces):
        obstacle = contact.law_of_contact.obstacle
        power = 1.0 if obstacle.stiffness_pa_m is None else 2.0
        yield power * contact.force(states_of(contact))


def rigid_contact_change_n(experiment: Experiment, dynamics: Dynamics, x: Array) -> Array | None:
    """Return the change of the contact forces at the evaluations, (evaluations, 3n) [N], if contact
    were rigid instead of obeying the pressure law, to first order; None without contact that has an
    energy (with complementarity contact is rigid already).

    Parameters
    ----------
    experiment : Experiment
        The experiment, whose pressures are not averaged over time steps here.
    dynamics : Dynamics
        Equations of motion at the parameters.
    x : (N, 3n) array
        Positions [m].
    """
    forces = dynamics.select_evaluated_forces()
    if not _contacts_with_energy(forces):
        return None
    xi, nu = dynamics.evaluation_states(x)
    change_n = np.zeros_like(xi)
    for contact in contact_terms(experiment):
        if not contact.is_complementarity:
            change_n += contact.rigid_limit_n(forces.states_of_terms(xi, nu)(contact))
    return change_n


def _contacts_with_energy(forces: Forces) -> list[Contact]:
    """Return the contact forces with an energy, without those of complementarity."""
    return [
        term
        for term in forces.external_terms
        if isinstance(term, Contact) and not term.is_complementarity
    ]


def obstacle_shifts_m(iterate: ExperimentIterate) -> Iterator[tuple[Obstacle, Array]]:
    """Yield each obstacle with the shift (N, 3) per relative size that preserves first contact [m].

    The body scales about the middle of its grasps. Along axes that no grasp prescribes, it scales
    about the place of its first contact; if several obstacles touch it at the same time, about that
    of the one that moves least.

    Notes
    -----
    Nothing is yielded without obstacles. The shift is along the obstacle's normal at first contact,
    moves with the rotation of the obstacle, and is in world axes at the N grid times.
    """
    experiment = iterate.transcription.experiment
    t_s = iterate.equations.dynamics.t_s[: len(iterate.x)]
    contacts, first_contacts, support = _first_contacts(iterate)
    if support is None:
        return
    free = _free_axes(experiment)
    for contact, each in zip(contacts, first_contacts, strict=True):
        obstacle = contact.law_of_contact.obstacle
        turn, shift = (values[0] for values in experiment.rigid_motion(t_s[each.row]))
        pivot_m = turn @ iterate.transcription.nuisance.grasp_pivot_m + shift
        pivot_m = np.where(free, support.place_m, pivot_m)
        way_m = each.normal * (each.normal @ (each.place_m - pivot_m))
        rotations, _ = obstacle.poses.at(t_s)
        yield obstacle, rotations @ (rotations[each.row].T @ way_m)


def scaled_start_m(iterate: ExperimentIterate) -> Array:
    """Return the change (3n,) of given start positions per relative size of the body [m], about the
    same point as in `obstacle_shifts_m`.

    Without it, a larger body would be released compressed to its old size, and swing.
    """
    experiment = iterate.transcription.experiment
    turn, shift = (values[0] for values in experiment.rigid_motion(experiment.t_s[0]))
    pivot_m = turn @ iterate.transcription.nuisance.grasp_pivot_m + shift
    x_m = iterate.x[0].reshape(-1, 3)
    _, _, support = _first_contacts(iterate)
    middle_m = x_m.mean(axis=0) if support is None else support.start_place_m
    pivot_m = np.where(_free_axes(experiment), middle_m, pivot_m)
    arms_m = x_m - pivot_m
    for obstacle in experiment.obstacles:
        arms_m[obstacle.nodes] = 0.0
    return arms_m.ravel()


def _free_axes(experiment: Experiment) -> NDArray[np.bool_]:
    prescribed = set("".join(grasp.axes for grasp in experiment.body_grasps))
    return np.array([axis not in prescribed for axis in "xyz"])


def _first_contacts(
    iterate: ExperimentIterate,
) -> tuple[list[Contact], list[FirstContact], FirstContact | None]:
    """Return the contacts, the first contact of each, and the one that supports the body: of those
    that touch first, that of the obstacle that moves least; None without obstacles.
    """
    forces = iterate.equations.dynamics.forces
    contacts = [term for term in forces.external_terms if isinstance(term, Contact)]
    firsts = [FirstContact.from_motion(contact, iterate.x) for contact in contacts]
    travels_m = [
        np.ptp(iterate.x[:, c.law_of_contact.obstacle.prescribed_dofs], axis=0).max()
        for c in contacts
    ]
    order = sorted(range(len(contacts)), key=lambda k: (firsts[k].row, travels_m[k]))
    return contacts, firsts, firsts[order[0]] if order else None
