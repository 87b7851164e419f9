"""What of a body touched its obstacles in a motion."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..model.contact import Contact, contacts
from ..model.dynamics import Dynamics
from ..model.force_term import States
from ..recording.experiment import Experiment
from .part import Part

# Of the largest normal force.
GRAZE = 0.01
# Samples whose gaps are looked at together.
AT_ONCE = 64


@dataclass(frozen=True)
class Touch:
    """How a body touched one obstacle.

    Attributes
    ----------
    experiment, obstacle : str
    gap_m : float
        The smallest; it touches where that is less than the width of the pressure.
    faces : float
        Most faces that touched at a time, by their quadrature points; none where it never did.
    face_mm : float
        Edge of those, on the average.
    pressed : bool
        Whether an obstacle that moves touched at the first time.
    lost_s : float or None
        When it was first touched no more, where it had been.
    """

    experiment: str
    obstacle: str
    gap_m: float
    faces: float
    face_mm: float
    pressed: bool
    lost_s: float | None


def nearest(contact: Contact, x: Array) -> Array:
    """(i,) the smallest gap of each point in a motion x (T, 3n)."""
    chunks = (x[first : first + AT_ONCE] for first in range(0, len(x), AT_ONCE))
    gaps = (contact.contact.gaps(contact.points.vectors(chunk)).min(axis=0) for chunk in chunks)
    return np.min([*gaps], axis=0)


def on_surface(experiment: Experiment, theta: Array, x: Array) -> tuple[Array, Array]:
    """Gaps [m] and pressures [Pa], (T, F) of all faces, in a motion x (T, 3n) of a body at θ (k,).

    Of a face the smallest gap of its points to any obstacle, NaN where none may touch it, and the
    mean of their pressures.
    """
    shape = len(x), len(experiment.body.mesh.surface)
    gaps_m, pressures_pa = np.full(shape, np.nan), np.zeros(shape)
    for contact in contacts(experiment):
        law = contact.contact
        for first in range(0, len(x), AT_ONCE):
            rows, by_face = (
                slice(first, first + AT_ONCE),
                (-1, len(law.surface.faces), law.surface.a_face),
            )
            here = rows, law.surface.faces
            gaps = law.gaps(contact.points.vectors(x[rows])).reshape(by_face)
            gaps_m[here] = np.fmin(gaps_m[here], gaps.min(axis=2))
            pressures = law.stiffness_at(theta) * contact.pressing(x[rows])[0]
            pressures_pa[here] += pressures.reshape(by_face).mean(axis=2)
    return gaps_m, pressures_pa


@dataclass(frozen=True)
class Rubbing:
    """What friction with an obstacle did in a motion.

    Attributes
    ----------
    used : float
        Its largest force over what it may be, of all points together.
    slipping : float
        Share of the time that points slip, by what friction may be there.
    dissipated_j : float
    """

    used: float
    slipping: float
    dissipated_j: float


def rubbings(experiment: Experiment, dynamics: Dynamics, x: Array) -> dict[str, Rubbing]:
    """By its name what each obstacle with friction did along positions x (T, 3n)."""
    xi, nu = dynamics.evaluation_states(x)
    told = {}
    for contact in contacts(experiment):
        if not contact.by_velocity:
            continue
        rows = (States(a[None], v[None], dynamics.theta) for a, v in zip(xi, nu, strict=True))
        sums = np.concatenate([contact.rubbing(row) for row in rows], axis=1)
        limit_n, slipping_n, *rub_n, power_w = sums
        # Of a mere graze nothing is said.
        firm = limit_n > GRAZE * limit_n.max(initial=0.0)
        used = np.linalg.norm(rub_n, axis=0)[firm] / limit_n[firm]
        told[contact.contact.obstacle.name] = Rubbing(
            used=float(used.max(initial=0.0)),
            slipping=float(slipping_n.sum() / max(limit_n.sum(), np.finfo(float).tiny)),
            dissipated_j=float(power_w.sum() * dynamics.step_s),
        )
    return told


def touched(parts: Iterable[Part]) -> Iterator[Touch]:
    """The same of all experiments."""
    for part in parts:
        t_s = part.setting.dynamics.t_s[: len(part.x)]
        yield from touches(part.segment.experiment, part.x, t_s)


def touches(experiment: Experiment, x: Array, t_s: Array) -> Iterator[Touch]:
    """How the positions x (T, 3n) at times (T,) touch each obstacle."""
    for contact, obstacle in zip(contacts(experiment), experiment.obstacles, strict=True):
        law, least, points = contact.contact, np.inf, []
        ever = np.zeros(contact.points.count, dtype=bool)
        for first in range(0, len(x), AT_ONCE):
            gap = law.gaps(contact.points.vectors(x[first : first + AT_ONCE]))
            least, near = min(least, float(gap.min())), gap < law.widths_m
            points.append(near.sum(axis=1))
            ever |= near.any(axis=0)
        count = np.concatenate(points)
        ends = np.flatnonzero((count[:-1] > 0) & (count[1:] == 0)) + 1
        face_m2 = law.surface.area_m2[ever].sum() * law.surface.a_face / max(1, ever.sum())
        yield Touch(
            experiment.name,
            obstacle.name,
            gap_m=least,
            faces=int(count.max()) / law.surface.a_face,
            # Of a triangle with sides alike.
            face_mm=1e3 * float(np.sqrt(4 / np.sqrt(3) * face_m2)),
            pressed=bool(count[0]) and len(obstacle.poses.t_s) > 1,
            lost_s=float(t_s[ends[0]]) if len(ends) else None,
        )
