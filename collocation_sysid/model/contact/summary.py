"""Summary of the contact of a body with its obstacles in a motion: gaps, pressures and friction."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ...common.array_types import Array
from ...recording.experiment import Experiment
from ..dynamics import Dynamics
from ..force_term import States
from .force import Contact, contact_terms

# Number of samples whose gaps are evaluated together, to limit memory.
AT_ONCE = 64


@dataclass(frozen=True)
class ContactSummary:
    """Contact of a body with one obstacle in a motion."""

    # Names.
    experiment: str
    obstacle: str
    # Smallest gap [m]; contact exists where it is less than the width of the contact law.
    gap_m: float
    # Largest number of faces in contact at a time, from their quadrature points; 0 if there never
    # was contact.
    face_count: float
    face_mm: float  # mean edge length of the faces in contact [mm]
    is_initially_in_contact: bool  # whether a moving obstacle was in contact at the first time
    # Time of the first loss of contact [s]; None if contact was never lost.
    separation_s: float | None


def smallest_gaps(contact: Contact, x: Array) -> Array:
    """Return the smallest gap [m] of each contact point (i,) in a motion x (T, 3n) [m], T ≥ 1;
    negative inside the obstacle.
    """
    chunks = (x[first : first + AT_ONCE] for first in range(0, len(x), AT_ONCE))
    gaps = (
        contact.law_of_contact.gaps(contact.points.vectors(chunk)).min(axis=0) for chunk in chunks
    )
    return np.min([*gaps], axis=0)


def surface_gaps_and_pressures(
    experiment: Experiment, theta: Array, x: Array
) -> tuple[Array, Array]:
    """Return gaps [m] and pressures [Pa], each (T, F), of all surface faces in a motion.

    The gap of a face is the smallest of its points to any obstacle, NaN where no obstacle may touch
    it; the pressure is the mean over its points, summed over obstacles.

    Parameters
    ----------
    theta : (k,) array
        Constants of the body.
    x : (T, 3n) array
        Positions [m].
    """
    shape = len(x), len(experiment.body.mesh.surface)
    gaps_m = np.full(shape, np.nan)
    pressures_pa = np.zeros(shape)
    for contact in contact_terms(experiment):
        law = contact.law_of_contact
        for first in range(0, len(x), AT_ONCE):
            rows = slice(first, first + AT_ONCE)
            by_face = (-1, len(law.surface.faces), law.surface.points_per_face)
            here = rows, law.surface.faces
            gaps = law.gaps(contact.points.vectors(x[rows])).reshape(by_face)
            gaps_m[here] = np.fmin(gaps_m[here], gaps.min(axis=2))
            pressures = law.stiffness_at(theta) * contact.scaled_pressures(x[rows])[0]
            pressures_pa[here] += pressures.reshape(by_face).mean(axis=2)
    return gaps_m, pressures_pa


@dataclass(frozen=True)
class FrictionSummary:
    """Friction with an obstacle in a motion."""

    # Largest ratio of the total friction force to its limit, over the times whose limit is above
    # 1 % of the largest; 0 without contact.
    used: float
    slipping: float  # share of slipping points, weighted by their friction limits, over the motion
    dissipated_j: float  # dissipated energy [J]


def friction_summaries(
    experiment: Experiment, dynamics: Dynamics, x: Array
) -> dict[str, FrictionSummary]:
    """Return the friction with each obstacle that has friction, by the name of the obstacle; empty
    without friction.

    Parameters
    ----------
    dynamics : Dynamics
        Equations of motion at the parameters, whose time step must be that of x.
    x : (N, 3n) array
        Positions at all grid times [m].
    """
    xi, nu = dynamics.evaluation_states(x)
    summaries = {}
    for contact in contact_terms(experiment):
        if not contact.is_nonlinear_in_velocity:
            continue
        rows = (States(a[None], v[None], theta=dynamics.theta) for a, v in zip(xi, nu, strict=True))
        sums = np.concatenate([contact.friction_sums(row) for row in rows], axis=1)
        limit_n, slipping_n, *rub_n, power_w = sums
        # At times of little contact the ratio of both forces is meaningless.
        is_firm = limit_n > 0.01 * limit_n.max(initial=0.0)
        used = np.linalg.norm(rub_n, axis=0)[is_firm] / limit_n[is_firm]
        summaries[contact.law_of_contact.obstacle.name] = FrictionSummary(
            used=float(used.max(initial=0.0)),
            slipping=float(slipping_n.sum() / max(limit_n.sum(), np.finfo(float).tiny)),
            dissipated_j=float(power_w.sum() * dynamics.step_s),
        )
    return summaries


def contact_summaries(experiment: Experiment, x: Array, t_s: Array) -> Iterator[ContactSummary]:
    """Yield the contact summary of each obstacle for positions x (T, 3n) [m] at times `t_s` (T,)
    [s].
    """
    for contact, obstacle in zip(contact_terms(experiment), experiment.obstacles, strict=True):
        law = contact.law_of_contact
        smallest_gap_m = np.inf
        points = []
        has_been_in_contact = np.zeros(contact.points.count, dtype=bool)
        for first in range(0, len(x), AT_ONCE):
            gap = law.gaps(contact.points.vectors(x[first : first + AT_ONCE]))
            smallest_gap_m = min(smallest_gap_m, float(gap.min()))
            is_touching = gap < law.widths_m
            points.append(is_touching.sum(axis=1))
            has_been_in_contact |= is_touching.any(axis=0)
        count = np.concatenate(points)
        ends = np.flatnonzero((count[:-1] > 0) & (count[1:] == 0)) + 1
        face_m2 = (
            law.surface.area_m2[has_been_in_contact].sum()
            * law.surface.points_per_face
            / max(1, has_been_in_contact.sum())
        )
        yield ContactSummary(
            experiment.name,
            obstacle.name,
            gap_m=smallest_gap_m,
            face_count=int(count.max()) / law.surface.points_per_face,
            # Edge of an equilateral triangle with this area.
            face_mm=1e3 * float(np.sqrt(4 / np.sqrt(3) * face_m2)),
            is_initially_in_contact=bool(count[0]) and len(obstacle.poses.t_s) > 1,
            separation_s=float(t_s[ends[0]]) if len(ends) else None,
        )
