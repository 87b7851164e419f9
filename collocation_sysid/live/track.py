"""A pass with what later passes and the prior need of it, block by block.

The window holds blocks of rows. Each begins with a state, and what its rows say is one triangle at
the pass's p. When the window is full the oldest block leaves: its triangle joins the prior as it
is, and the next block's state becomes where later passes begin. That state is a function of p
alone, for the motion has no noise of its own: so nothing of it is estimated, its slopes are what
was found when it was passed, and later passes move it along these (first estimates, as filters
keep them, so that no direction seems better known for having been linearised twice).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ..arrays import Array
from ..program.least_squares import LeastSquares
from .model import TOGETHER, Model, Poses
from .sweep import Kept, LiveSweep, LoggedRow, Said, State
from .trust import Scatter

# Readings that a pass may lack for its others to count; all are joined anew with each frame.
LATE = 20


@dataclass(eq=False)
class Block:
    """Some rows in turn.

    Attributes
    ----------
    start : State or None, where the recording begins
    at : (P,) p of that state
    kept : list of Kept, one a row
    said : list of Said, one a reading
    """

    start: State | None
    at: Array
    kept: list[Kept] = field(default_factory=list)
    said: list[Said] = field(default_factory=list)


class Track:
    """A pass at p over the window.

    Parameters
    ----------
    model : Model
    p : (P,)
    prior : LeastSquares
        Of what was read before the window.
    block_rows : int
    base : Track, optional
        The one that is done again; it guesses the rows' positions.
    """

    def __init__(
        self,
        model: Model,
        p: Array,
        prior: LeastSquares,
        block_rows: int,
        base: Track | None = None,
    ) -> None:
        first = base.blocks[0] if base is not None and base.blocks else None
        self.prior, self.base, self.block_rows = prior, base, block_rows
        self.start = (None, p) if first is None else (first.start, first.at)
        self.model = model
        self.sweep = LiveSweep(model, p, prior.joined(model.stated(p)), *self.start)
        self.blocks: list[Block] = []
        self._turns = [(0, self.sweep.flat)]
        self.failed = False
        self.rows = 0
        self._off: list[Array] = []

    @property
    def p(self) -> Array:
        """Where it is linearised."""
        return self.sweep.p

    @property
    def information(self) -> LeastSquares:
        """All that is known at it of what is flat, see `Model.flat`, the prior included."""
        return self.sweep.information

    @property
    def loss(self) -> float:
        """Of what was measured and of the prior, at its own p."""
        return self.information.loss(self.sweep.flat)

    def advance(self, poses: Sequence[Poses], guesses: Sequence[Array] = ()) -> int:
        """Go on by rows of one block; how many it did. Their readings are taken by `read`.

        Raises
        ------
        SimulationError
            Where a row cannot be solved.
        """
        if self.rows % self.block_rows == 0:
            new = self.start if not self.blocks else (self.sweep.state, self.p)
            self.blocks.append(Block(*new))
        known = self._known(len(poses))
        found = self.sweep.advance(poses, guesses or self._guesses(known))
        pairs = list(zip(found, known, strict=False))[-2:]
        off = [kept.x - self._expected(base) for kept, base in pairs]
        self._off = [*self._off, *off][-2:]
        self.blocks[-1].kept += found
        self.rows += len(found)
        return len(found)

    def turn(self, p: Array) -> None:
        """Go on from here at another p; what is done stays linearised where it was."""
        self.sweep = LiveSweep(self.model, p, self.information, self.sweep.state, self.p)
        self._turns.append((self.rows, self.sweep.flat))

    @property
    def turned(self) -> int:
        """The row of the window from which on it has not turned."""
        return self._turns[-1][0]

    @property
    def points(self) -> list[Array]:
        """What was flat where the window's rows are linearised."""
        return self.points_from(0)

    def points_from(self, row: int) -> list[Array]:
        """The same of the rows from one on."""
        before = [flat for first, flat in self._turns if first <= row]
        return [*before[-1:], *[flat for first, flat in self._turns if first > row]]

    def read(self, said: Sequence[Said]) -> None:
        """Take what was read after the last rows."""
        self.blocks[-1].said += said
        self.sweep.take(said)

    @property
    def said(self) -> list[Said]:
        """What was read within the window."""
        return [said for block in self.blocks for said in block.said]

    def again(self, rows: Sequence[LoggedRow]) -> None:
        """Go on by rows and all that was read after them, as far as is possible at once."""
        done = self.advance([row.poses for row in rows[: self.left]])
        pairs = [(each, done - k) for k, row in enumerate(rows[:done], 1) for each in row.readings]
        self.read(self.sweep.linearised(pairs))

    @property
    def together(self) -> int:
        """Rows that can be done at once: those left of a block."""
        return min(TOGETHER, self.block_rows - self.rows % self.block_rows)

    @property
    def left(self) -> int:
        """The same of rows that are done again: one without a guess."""
        ahead = 0 if self.base is None else self.base.rows - self.rows
        return max(1, min(ahead, self.together))

    def _known(self, count: int) -> list[Kept]:
        if self.base is None or self.rows + count > self.base.rows:
            return []
        places = (divmod(self.rows + k, self.block_rows) for k in range(count))
        return [self.base.blocks[block].kept[place] for block, place in places]

    def _guesses(self, known: Sequence[Kept]) -> list[Array]:
        """Rows of the base, moved along their columns, and by what that missed before."""
        if not known:
            return []
        # Straight on from the last two, where there are two.
        first, off = ([np.zeros_like(known[0].x)] * 2 + self._off[:1] + self._off)[-2:]
        moved = map(self._expected, known)
        return [x + off + k * (off - first) for k, x in enumerate(moved, 1)]

    def _expected(self, base: Kept) -> Array:
        step = (self.sweep.flat - base.flat)[self.sweep.moving]
        return base.x + base.columns @ step.astype(np.float32)

    def drop_oldest(self) -> int:
        """Let the oldest block leave as prior; how many rows it had."""
        block = self.blocks.pop(0)
        self.rows -= len(block.kept)
        turns = [(max(0, row - len(block.kept)), flat) for row, flat in self._turns]
        self._turns = [*[turn for turn in turns if not turn[0]][-1:], *[t for t in turns if t[0]]]
        self.prior = self.sweep.added(self.prior, block.said)
        self.start = (self.blocks[0].start, self.blocks[0].at)
        return len(block.kept)

    @property
    def measured(self) -> LeastSquares:
        """All that was read, within the window and before it."""
        known = self.prior
        for block in self.blocks:
            known = self.sweep.added(known, block.said)
        return known


class JoinedPasses(NamedTuple):
    """What two passes over the same frames know together.

    With each reading as it was linearised last, and where that was.
    """

    information: LeastSquares
    said: list[Said]
    points: list[Array]

    @classmethod
    def of(cls, track: Track, again: Track | None) -> JoinedPasses:
        """Of a pass, and of another that has nearly caught up with it."""
        said = track.said
        done = again.said if again is not None and again.base is not None else []
        rest = said[len(done) :]
        if again is None or again.failed or not done or len(rest) > min(LATE, len(done)):
            return cls(track.information, said, track.points)
        points = [*again.points, *track.points_from(again.rows)]
        return cls(track.sweep.added(again.information, rest), [*done, *rest], points)

    def scatter(self, flat: Array) -> Scatter:
        """Of the markers' residuals, to first order."""
        return Scatter.of([said.at(flat) for said in self.said if not said.of])
