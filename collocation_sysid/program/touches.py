"""What of a body touched its obstacles in a motion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ..arrays import Array
from ..model.contact import contacts
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
    points : int
        Most quadrature points of the surface that touched at a time; none where it never did.
    a_face : int
        Those of one face.
    """

    experiment: str
    obstacle: str
    gap_m: float
    points: int
    a_face: int

    @property
    def faces(self) -> float:
        """Most faces that touched at a time."""
        return self.points / self.a_face


def touches(experiment: Experiment, x: Array) -> Iterator[Touch]:
    """How the positions x (T, 3n) touch each obstacle."""
    for contact, obstacle in zip(contacts(experiment, 1), experiment.obstacles, strict=True):
        law, least, most = contact.contact, np.inf, 0
        for first in range(0, len(x), AT_ONCE):
            y = contact.points.vectors(x[first : first + AT_ONCE])
            gap = law.distance.value(y, np.zeros((0, *y.shape[1:])))[0]
            least = min(least, float(gap.min()))
            most = max(most, int((gap < law.width_m).sum(axis=1).max()))
        a_face = 3 if experiment.body.element.nodes == 4 else 6
        yield Touch(experiment.name, obstacle.name, least, most, a_face)
