"""What of a body touched its obstacles in a motion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..model.contact import Contact, contacts
from ..recording.experiment import Experiment

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
    """

    experiment: str
    obstacle: str
    gap_m: float
    faces: float


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
    for contact in contacts(experiment, 1):
        law = contact.contact
        for first in range(0, len(x), AT_ONCE):
            rows, by_face = (
                slice(first, first + AT_ONCE),
                (-1, len(law.surface.faces), law.surface.a_face),
            )
            here = rows, law.surface.faces
            gaps = law.gaps(contact.points.vectors(x[rows])).reshape(by_face)
            gaps_m[here] = np.fmin(gaps_m[here], gaps.min(axis=2))
            pressing = contact.pressing(x[rows])[0].reshape(by_face).mean(axis=2)
            pressures_pa[here] += law.stiffness_at(theta) * pressing
    return gaps_m, pressures_pa


def touches(experiment: Experiment, x: Array) -> Iterator[Touch]:
    """How the positions x (T, 3n) touch each obstacle."""
    for contact, obstacle in zip(contacts(experiment, 1), experiment.obstacles, strict=True):
        law, least, most = contact.contact, np.inf, 0
        for first in range(0, len(x), AT_ONCE):
            gap = law.gaps(contact.points.vectors(x[first : first + AT_ONCE]))
            least = min(least, float(gap.min()))
            most = max(most, int((gap < law.width_m).sum(axis=1).max()))
        yield Touch(experiment.name, obstacle.name, least, most / law.surface.a_face)
