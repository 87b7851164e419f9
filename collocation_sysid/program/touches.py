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


def touches(experiment: Experiment, x: Array) -> Iterator[Touch]:
    """How the positions x (T, 3n) touch each obstacle."""
    for contact, obstacle in zip(contacts(experiment, 1), experiment.obstacles, strict=True):
        law, least, most = contact.contact, np.inf, 0
        for first in range(0, len(x), AT_ONCE):
            gap = law.gaps(contact.points.vectors(x[first : first + AT_ONCE]))
            least = min(least, float(gap.min()))
            most = max(most, int((gap < law.width_m).sum(axis=1).max()))
        yield Touch(experiment.name, obstacle.name, least, most / law.surface.a_face)
