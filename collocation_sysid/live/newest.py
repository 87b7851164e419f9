"""What two passes over the same frames know together."""

from __future__ import annotations

from typing import NamedTuple

from ..arrays import Array
from .information import Information
from .statistics import Scatter
from .sweep import Said
from .track import Track

# Readings that a pass may lack for its others to count; all are joined anew with each frame.
LATE = 20


class Newest(NamedTuple):
    """What is known, with each reading as it was linearised last, and where that was."""

    information: Information
    said: list[Said]
    points: list[Array]

    @classmethod
    def of(cls, track: Track, again: Track | None) -> Newest:
        """Of a pass, and of another that has nearly caught up with it."""
        said = track.said
        done = again.said if again is not None and again.base is not None else []
        rest = said[len(done) :]
        if again is None or again.failed or not done or len(rest) > min(LATE, len(done)):
            return cls(track.information, said, track.points)
        points = [*again.points, *track.points_from(again.rows)]
        return cls(track.sweep.added(again.information, rest), [*done, *rest], points)

    def scatter(self, flat: Array) -> Scatter:
        """Of the residuals, to first order."""
        return Scatter.of([said.at(flat) for said in self.said])
