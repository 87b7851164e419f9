"""Forward pass over a window of recent rows, with the information that later passes and the prior
need.

The window consists of blocks of rows. Each block begins with a state, and its residuals are one
triangular factor at the linearisation point of the pass. When the window is full, the oldest block
leaves: its information becomes part of the prior, and later passes begin at the state of the next
block. That state is a function of p alone, since the motion has no noise. Therefore it is not
estimated; its derivatives are those of the pass that computed it, and later passes move it along
them (first-estimate Jacobians, as in filters, so that no direction gains information from being
linearised twice).
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

# Largest number of samples that a second pass may lag behind for its residuals to be used.
LATE = 20


@dataclass(eq=False)
class Block:
    """Some consecutive rows of a window.

    Attributes
    ----------
    start : State or None
        State before the first row; None at the start of the recording.
    at : (P,)
        Linearisation point of that state.
    kept : list of Kept
        Rows for later passes.
    said : list of Said
        Linearised residuals of the samples.
    """

    start: State | None
    at: Array
    kept: list[Kept] = field(default_factory=list)
    said: list[Said] = field(default_factory=list)


class Track:
    """Forward pass at parameters p over the window.

    Parameters
    ----------
    model : Model
    p : (P,)
        Linearisation point.
    prior : LeastSquares
        Information of the samples before the window.
    block_rows : int
        Number of rows of a block.
    base : Track, optional
        Pass that is repeated; it provides initial guesses of the positions.

    Attributes
    ----------
    rows : int
        Number of rows in the window so far.
    failed : bool
        Whether a row could not be solved.
    """

    def __init__(
        self,
        model: Model,
        p: Array,
        prior: LeastSquares,
        block_rows: int,
        base: Track | None = None,
    ) -> None:
        first_block = base.blocks[0] if base is not None and base.blocks else None
        self.prior = prior
        self.base = base
        self.block_rows = block_rows
        self.start = (None, p) if first_block is None else (first_block.start, first_block.at)
        self.model = model
        self.sweep = LiveSweep(model, p, prior.joined(model.stated(p)), *self.start)
        self.blocks: list[Block] = []
        self._turns = [(0, self.sweep.flat)]
        self.failed = False
        self.rows = 0
        self._off: list[Array] = []

    @property
    def p(self) -> Array:
        """Parameters of the current linearisation point (P,)."""
        return self.sweep.p

    @property
    def information(self) -> LeastSquares:
        """Information at p in the transformed parameters, including the prior."""
        return self.sweep.information

    @property
    def loss(self) -> float:
        """Loss of measurements and prior at p."""
        return self.information.loss(self.sweep.flat)

    def advance(self, poses: Sequence[Poses], guesses: Sequence[Array] = ()) -> int:
        """Compute further rows of one block and return how many; `read` adds their samples.

        Parameters
        ----------
        poses : sequence of Poses
        guesses : sequence of (3n,), optional
            Initial guesses of the positions; by default those of `base`, otherwise extrapolated.

        Raises
        ------
        SimulationError
            If a row cannot be solved.
        """
        if self.rows % self.block_rows == 0:
            new = self.start if not self.blocks else (self.sweep.state, self.p)
            self.blocks.append(Block(*new))
        rows_of_base = self._known(len(poses))
        computed = self.sweep.advance(poses, guesses or self._guesses(rows_of_base))
        last_rows = list(zip(computed, rows_of_base, strict=False))[-2:]
        errors = [kept.x - self._expected(base) for kept, base in last_rows]
        self._off = [*self._off, *errors][-2:]
        self.blocks[-1].kept += computed
        self.rows += len(computed)
        return len(computed)

    def turn(self, p: Array) -> None:
        """Continue with another linearisation point; previous rows keep theirs."""
        self.sweep = LiveSweep(self.model, p, self.information, self.sweep.state, self.p)
        self._turns.append((self.rows, self.sweep.flat))

    @property
    def turned(self) -> int:
        """Index of the row of the window at which the linearisation point was changed last.

        0 if never.
        """
        return self._turns[-1][0]

    @property
    def points(self) -> list[Array]:
        """Transformed parameters at which the rows of the window are linearised."""
        return self.points_from(0)

    def points_from(self, row: int) -> list[Array]:
        """Return the transformed parameters at which the rows from an index on are linearised."""
        before = [flat for first, flat in self._turns if first <= row]
        return [*before[-1:], *[flat for first, flat in self._turns if first > row]]

    def read(self, said: Sequence[Said]) -> None:
        """Add the linearised residuals of samples after the last rows."""
        self.blocks[-1].said += said
        self.sweep.take(said)

    @property
    def said(self) -> list[Said]:
        """Linearised residuals of all samples in the window."""
        return [said for block in self.blocks for said in block.said]

    def again(self, rows: Sequence[LoggedRow]) -> None:
        """Compute logged rows and add their samples, as many as possible at once."""
        done = self.advance([row.poses for row in rows[: self.left]])
        pairs = [(each, done - k) for k, row in enumerate(rows[:done], 1) for each in row.readings]
        self.read(self.sweep.linearised(pairs))

    @property
    def together(self) -> int:
        """Largest number of rows that can be computed at once: those left in the block."""
        return min(TOGETHER, self.block_rows - self.rows % self.block_rows)

    @property
    def left(self) -> int:
        """Largest number of rows that can be repeated at once; 1 without an initial guess."""
        ahead = 0 if self.base is None else self.base.rows - self.rows
        return max(1, min(ahead, self.together))

    def _known(self, count: int) -> list[Kept]:
        """Return the next rows of the repeated pass; an empty list if it has too few."""
        if self.base is None or self.rows + count > self.base.rows:
            return []
        places = (divmod(self.rows + k, self.block_rows) for k in range(count))
        return [self.base.blocks[block].kept[place] for block, place in places]

    def _guesses(self, known: Sequence[Kept]) -> list[Array]:
        """Return initial guesses from rows of the repeated pass.

        They are moved along the columns, and by the extrapolated error of this prediction at the
        last two rows.
        """
        if not known:
            return []
        # Straight on from the last two, where there are two.
        previous_error, last_error = ([np.zeros_like(known[0].x)] * 2 + self._off[:1] + self._off)[
            -2:
        ]
        predicted = map(self._expected, known)
        return [
            x + last_error + k * (last_error - previous_error) for k, x in enumerate(predicted, 1)
        ]

    def _expected(self, base: Kept) -> Array:
        """Return the positions of a stored row, moved to p along its columns."""
        step = (self.sweep.flat - base.flat)[self.sweep.moving]
        return base.x + base.columns @ step.astype(np.float32)

    def drop_oldest(self) -> int:
        """Add the oldest block to the prior and remove it from the window.

        Return its number of rows.
        """
        block = self.blocks.pop(0)
        self.rows -= len(block.kept)
        turns = [(max(0, row - len(block.kept)), flat) for row, flat in self._turns]
        self._turns = [*[turn for turn in turns if not turn[0]][-1:], *[t for t in turns if t[0]]]
        self.prior = self.sweep.added(self.prior, block.said)
        self.start = (self.blocks[0].start, self.blocks[0].at)
        return len(block.kept)

    @property
    def measured(self) -> LeastSquares:
        """Information of all samples within the window and before it, without stated priors."""
        information = self.prior
        for block in self.blocks:
            information = self.sweep.added(information, block.said)
        return information


class JoinedPasses(NamedTuple):
    """Joint information of two passes over the same frames.

    Each sample counts as linearised last.

    Attributes
    ----------
    information : LeastSquares
    said : list of Said
        Linearised residuals of all samples.
    points : list of (P,)
        Transformed parameters at which they are linearised.
    """

    information: LeastSquares
    said: list[Said]
    points: list[Array]

    @classmethod
    def of(cls, track: Track, again: Track | None) -> JoinedPasses:
        """Return the joint information of a pass and of a repetition that has nearly caught up with
        it.

        If the repetition is None, has failed or lags behind too far, that of the pass alone.
        """
        residuals = track.said
        repeated = again.said if again is not None and again.base is not None else []
        remaining = residuals[len(repeated) :]
        if (
            again is None
            or again.failed
            or not repeated
            or len(remaining) > min(LATE, len(repeated))
        ):
            return cls(track.information, residuals, track.points)
        points = [*again.points, *track.points_from(again.rows)]
        return cls(track.sweep.added(again.information, remaining), [*repeated, *remaining], points)

    def scatter(self, flat: Array) -> Scatter:
        """Return the scatter of the markers' residuals at transformed parameters, to first
        order.
        """
        return Scatter.of([said.at(flat) for said in self.said if not said.of])
