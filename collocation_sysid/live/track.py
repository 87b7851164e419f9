"""A pass with what later passes and the prior need of it, block by block.

The window holds blocks of rows. Each begins with a state, and what its rows say is one triangle at
the pass's p. When the window is full the oldest block leaves: its triangle joins the prior as it
is, and the next block's state becomes where later passes begin. That state is a function of p
alone, for the motion has no noise of its own: so nothing of it is estimated, its slopes are what
was found when it was passed, and later passes move it along these (first estimates, as filters
keep them, so that no direction seems better known for having been linearised twice).
"""

from __future__ import annotations

from dataclasses import dataclass, field

from ..arrays import Array
from .information import Information
from .model import Model, Poses
from .sweep import Kept, LoggedRow, State, Sweep


@dataclass(eq=False)
class Block:
    """Some rows in turn.

    Attributes
    ----------
    start : State or None, where the recording begins
    at : (P,) p of that state
    kept : list of Kept, one a row
    said : list of residual (M, 3), NaN where missing, and slopes (M, 3, P) of what was read
    """

    start: State | None
    at: Array
    kept: list[Kept] = field(default_factory=list)
    said: list[tuple[Array, Array]] = field(default_factory=list)


class Track:
    """A pass at p over the window.

    Parameters
    ----------
    model : Model
    p : (P,)
    prior : Information
        What was known before the window.
    block_rows : int
    base : Track, optional
        The one that is done again; it guesses the rows' positions.
    """

    def __init__(
        self, model: Model, p: Array, prior: Information, block_rows: int, base: Track | None = None
    ) -> None:
        first = base.blocks[0] if base is not None and base.blocks else None
        self.prior, self.base, self.block_rows = prior, base, block_rows
        self.start = (None, p) if first is None else (first.start, first.at)
        self.sweep = Sweep(model, p, prior, *self.start)
        self.blocks: list[Block] = []
        self.failed = False
        self.rows = 0
        self._off: list[Array] = []

    @property
    def p(self) -> Array:
        """Where it is linearised."""
        return self.sweep.p

    @property
    def information(self) -> Information:
        """All that is known at it, the prior included."""
        return self.sweep.information

    @property
    def loss(self) -> float:
        """Of what was measured and of the prior, at its own p."""
        return self.information.loss(self.p)

    def advance(self, poses: Poses, guess: Array | None = None) -> None:
        """Go on by a row; its readings are taken by `read`.

        Raises
        ------
        SimulationError
            Where the row cannot be solved.
        """
        if self.rows % self.block_rows == 0:
            new = self.start if not self.blocks else (self.sweep.state, self.p)
            self.blocks.append(Block(*new))
        kept = self.sweep.advance(poses, self._guess() if guess is None else guess)
        self._note(kept)
        self.blocks[-1].kept.append(kept)
        self.rows += 1

    def read(self, residual: Array, slope: Array) -> None:
        """Take what was read after the last row."""
        self.blocks[-1].said.append((residual, slope))
        self.sweep.take(residual, slope)

    def residuals(self, p: Array) -> list[Array]:
        """(M, 3) of what was read within the window, linearised to p, NaN where missing."""
        step = p - self.p
        return [residual + slope @ step for block in self.blocks for residual, slope in block.said]

    def again(self, row: LoggedRow) -> None:
        """Go on by a row and all that was read after it."""
        self.advance(row.poses)
        for reading in row.readings:
            self.read(*self.sweep.linearised(reading))

    def _known(self, row: int) -> Kept | None:
        if self.base is None or row >= self.base.rows:
            return None
        block, place = divmod(row, self.block_rows)
        return self.base.blocks[block].kept[place]

    def _guess(self) -> Array | None:
        """Row of the base, moved along its columns, and by what that missed before."""
        known = self._known(self.rows)
        if known is None:
            return None
        moved = known.x + known.columns @ self._step
        if len(self._off) == 2:
            return moved + 2 * self._off[1] - self._off[0]
        return moved + self._off[-1] if self._off else moved

    def _note(self, kept: Kept) -> None:
        known = self._known(self.rows)
        if known is not None:
            off = kept.x - known.x - known.columns @ self._step
            self._off = [*self._off[-1:], off]

    @property
    def _step(self) -> Array:
        assert self.base is not None
        return (self.p - self.base.p)[self.sweep.moving]

    def drop_oldest(self) -> int:
        """Let the oldest block leave as prior; how many rows it had."""
        block = self.blocks.pop(0)
        self.rows -= len(block.kept)
        for residual, slope in block.said:
            self.prior = self.prior.with_rows(*self.sweep.rows_of(residual, slope), self.p)
        self.start = (self.blocks[0].start, self.blocks[0].at)
        return len(block.kept)
