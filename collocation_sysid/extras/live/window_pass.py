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

from ...common.array_types import Array
from ...program.streaming import (
    LinearisedResidual,
    LoggedRow,
    SquareRootInformation,
    StoredRow,
    StreamingModel,
    StreamingSweep,
    SweepState,
)
from ...recording.poses import Poses
from .trust import ResidualScatter

# Largest number of samples that a second pass may lag behind for its residuals to be used.
LARGEST_LAG = 20


@dataclass(eq=False)
class WindowBlock:
    """Some consecutive rows of a window."""

    start: SweepState | None  # state before the first row; None at the start of the recording
    linearisation_point: Array  # (P,): linearisation point of that state
    stored_rows: list[StoredRow] = field(default_factory=list)  # rows for later passes
    # Linearised residuals of the samples.
    residuals: list[LinearisedResidual] = field(default_factory=list)


class WindowPass:
    """Forward pass at parameters p over the window.

    Parameters
    ----------
    model : StreamingModel
        Model of the recording.
    p : (P,)
        Linearisation point, parameters that are not transformed.
    prior : SquareRootInformation
        Information of the samples before the window.
    block_rows : int
        Number of rows of a block.
    base : WindowPass, optional
        Pass that is repeated; it provides initial guesses of the positions.

    Attributes
    ----------
    rows : int
        Number of rows in the window so far.
    has_failed : bool
        Whether a row could not be solved; set by the user of the class.
    start : (SweepState or None, (P,) array)
        State before the window, None at the start of the recording, and the parameters at which it
        is linearised; by default those of the first block of `base`.
    sweep : StreamingSweep
        Time marching with sensitivities; replaced by `relinearise_at`.
    blocks : list of WindowBlock
        Blocks of the window, the oldest first.
    """

    def __init__(
        self,
        model: StreamingModel,
        p: Array,
        prior: SquareRootInformation,
        block_rows: int,
        base: WindowPass | None = None,
    ) -> None:
        first_block = base.blocks[0] if base is not None and base.blocks else None
        self.prior = prior
        self.base = base
        self.block_rows = block_rows
        self.start = (
            (None, p)
            if first_block is None
            else (first_block.start, first_block.linearisation_point)
        )
        self.model = model
        self.sweep = StreamingSweep(
            model, p, prior.with_problem(model.prior_information(p)), *self.start
        )
        self.blocks: list[WindowBlock] = []
        self._base_changes = [(0, self.sweep.transformed)]
        self.has_failed = False
        self.rows = 0
        self._off: list[Array] = []

    def compute_loss(self) -> float:
        """Return the loss of measurements and priors, a sum of squared residuals, at the current
        linearisation point.
        """
        return self.sweep.information.loss(self.sweep.transformed)

    def add_rows(self, poses: Sequence[Poses], guesses: Sequence[Array] = ()) -> int:
        """Compute further rows of one block and return how many, at least one; `add_residuals` adds
        their samples.

        Fewer rows than given are computed if an initial guess turns out to be far off; the caller
        passes the remaining poses again. A new block begins if the last one is full. Without
        guesses, neither given nor from `base`, they are extrapolated.

        Parameters
        ----------
        poses : sequence of Poses
            Poses of the moving grasps at the rows, at least one, at most `remaining_row_count`.
        guesses : sequence of (3n,), optional
            Initial guesses of the positions [m]; by default from the rows of `base`, if it has
            them.

        Raises
        ------
        SimulationError
            If a row cannot be solved.
        """
        if self.rows % self.block_rows == 0:
            new = self.start if not self.blocks else (self.sweep.copy_state(), self.sweep.p)
            self.blocks.append(WindowBlock(*new))
        rows_of_base = self._rows_of_base(len(poses))
        computed = self.sweep.advance(poses, guesses or self._initial_guesses(rows_of_base))
        last_rows = list(zip(computed, rows_of_base, strict=False))[-2:]
        errors = [stored.x - self._predicted_positions(base) for stored, base in last_rows]
        self._off = [*self._off, *errors][-2:]
        self.blocks[-1].stored_rows += computed
        self.rows += len(computed)
        return len(computed)

    def relinearise_at(self, p: Array) -> None:
        """Continue at another linearisation point p (P,), in the solver's coordinates, not
        transformed; the pass is changed, but previous rows keep their point.

        The information so far is kept, and the state after the last row is moved to p along its
        derivatives. Rows from here on are linearised at p.
        """
        self.sweep = StreamingSweep(
            self.model,
            p,
            prior_information=self.sweep.information,
            start=self.sweep.copy_state(),
            at=self.sweep.p,
        )
        self._base_changes.append((self.rows, self.sweep.transformed))

    @property
    def last_relinearised_row(self) -> int:
        """Index of the row of the window at which the linearisation point was changed last.

        0 if never.
        """
        return self._base_changes[-1][0]

    def linearisation_points_from(self, row: int) -> list[Array]:
        """Return the transformed parameters (P,) at which the rows from the index `row` of the
        window on are linearised, in order of the rows; one for each change.
        """
        before = [transformed for first, transformed in self._base_changes if first <= row]
        return [
            *before[-1:],
            *[transformed for first, transformed in self._base_changes if first > row],
        ]

    def add_residuals(self, residuals: Sequence[LinearisedResidual]) -> None:
        """Add the linearised residuals of samples to the last block and to the information, in
        place; at least one row must have been computed.
        """
        self.blocks[-1].residuals += residuals
        self.sweep.add_residuals(residuals)

    def list_residuals(self) -> list[LinearisedResidual]:
        """Return the linearised residuals of all samples in the window."""
        return [residual for block in self.blocks for residual in block.residuals]

    def repeat_rows(self, rows: Sequence[LoggedRow]) -> None:
        """Compute the first of the logged rows, at most `repeatable_row_count`, and add their
        samples to the pass.

        Fewer rows, but at least one, are computed if an initial guess turns out to be far off. The
        rows after them are ignored; the attribute `rows` increases by the number of rows that were
        computed.

        Parameters
        ----------
        rows : sequence of LoggedRow
            Rows that follow those of the pass, with the samples to evaluate after each; at least
            one; not modified.

        Raises
        ------
        SimulationError
            If a row cannot be solved; no samples are added then.
        """
        done = self.add_rows([row.poses for row in rows[: self.repeatable_row_count]])
        pairs = [(each, done - k) for k, row in enumerate(rows[:done], 1) for each in row.samples]
        self.add_residuals(self.sweep.linearise_samples(pairs))

    @property
    def remaining_row_count(self) -> int:
        """Largest number of rows that can be computed at once: those left in the block,
        or in a new one if it is full, at most `StreamingModel.rows_per_chunk`.
        """
        return min(self.model.rows_per_chunk, self.block_rows - self.rows % self.block_rows)

    @property
    def repeatable_row_count(self) -> int:
        """Largest number of rows that can be computed at once with initial guesses from
        `base`; 1 if there are none.
        """
        rows_of_base = 0 if self.base is None else self.base.rows - self.rows
        return max(1, min(rows_of_base, self.remaining_row_count))

    def _rows_of_base(self, count: int) -> list[StoredRow]:
        """Return the next `count` rows of the pass `base` that is repeated, those after the rows of
        this one; an empty list without `base`, or if it has fewer.
        """
        if self.base is None or self.rows + count > self.base.rows:
            return []
        places = (divmod(self.rows + k, self.block_rows) for k in range(count))
        return [self.base.blocks[block].stored_rows[place] for block, place in places]

    def _initial_guesses(self, known: Sequence[StoredRow]) -> list[Array]:
        """Return an initial guess of the positions, (3n,) [m], for each of the rows `known` of the
        pass that is repeated.

        Each is extrapolated to p with the sensitivities of its row; the error of this prediction at
        the last two rows is extrapolated linearly and added. If the error is known at one row only,
        it is taken as constant, and as zero if at none. Empty if `known` is empty.
        """
        if not known:
            return []
        if self._off:
            last_error = self._off[-1]
            previous_error = self._off[-2] if len(self._off) > 1 else last_error
        else:
            last_error = np.zeros_like(known[0].x)
            previous_error = last_error
        predicted = map(self._predicted_positions, known)
        return [
            x + last_error + k * (last_error - previous_error) for k, x in enumerate(predicted, 1)
        ]

    def latest_positions_at(self, transformed: Array) -> Array | None:
        """Return the node positions (3n,) [m] of the latest row at transformed parameters (P,), see
        `StreamingModel.transformed`, to first order; None if there is no row in the window.
        """
        if not self.blocks or not self.blocks[-1].stored_rows:
            return None
        return self._positions_at(self.blocks[-1].stored_rows[-1], transformed)

    def _predicted_positions(self, base: StoredRow) -> Array:
        """Return the node positions (3n,) [m] of the stored row `base`, such as one of another
        pass, at the linearisation point of this pass, to first order with the derivatives of the
        row.
        """
        return self._positions_at(base, self.sweep.transformed)

    def _positions_at(self, base: StoredRow, transformed: Array) -> Array:
        """Return the node positions (3n,) [m] of the stored row `base` at transformed parameters
        (P,), see `StreamingModel.transformed`, to first order with the derivatives of the row.
        """
        step = (transformed - base.transformed)[self.sweep.moving]
        return base.x + base.columns @ step.astype(np.float32)

    def drop_oldest_block(self) -> int:
        """Add the samples of the oldest block to the prior, remove the block from the window, and
        return its number of rows.

        `start` becomes the state before the next block, and `rows` decreases; there must be at
        least two blocks. The information does not change.
        """
        block = self.blocks.pop(0)
        self.rows -= len(block.stored_rows)
        changes = [
            (max(0, row - len(block.stored_rows)), transformed)
            for row, transformed in self._base_changes
        ]
        self._base_changes = [
            *[turn for turn in changes if not turn[0]][-1:],
            *[t for t in changes if t[0]],
        ]
        self.prior = self.sweep.with_residuals(self.prior, block.residuals)
        self.start = (self.blocks[0].start, self.blocks[0].linearisation_point)
        return len(block.stored_rows)

    def condense_measurements(self) -> SquareRootInformation:
        """Return the information of all samples within the window and before it, without stated
        priors.
        """
        information = self.prior
        for block in self.blocks:
            information = self.sweep.with_residuals(information, block.residuals)
        return information


class CombinedPasses(NamedTuple):
    """Joint information of two passes over the same frames.

    Each sample counts as linearised last.
    """

    # Information in transformed parameters, including the priors.
    information: SquareRootInformation
    residuals: list[LinearisedResidual]  # linearised residuals of all samples
    points: list[Array]  # list of (P,): transformed parameters at which they are linearised

    @classmethod
    def from_passes(cls, first_pass: WindowPass, second_pass: WindowPass | None) -> CombinedPasses:
        """Return the joint information of a first pass and of a second one that repeats it and has
        nearly caught up: the samples that both have count from the second, the rest from the first.

        If the second is None, has failed, has no base (a trial of other initial values), or lags
        behind by more than `LARGEST_LAG` samples or than its own samples, the information is that
        of the first alone.

        Parameters
        ----------
        first_pass : WindowPass
            Pass with all rows of the window; not changed.
        second_pass : WindowPass or None
            Repetition of its first rows; not changed.
        """
        residuals = first_pass.list_residuals()
        repeated = (
            second_pass.list_residuals()
            if second_pass is not None and second_pass.base is not None
            else []
        )
        remaining = residuals[len(repeated) :]
        if (
            second_pass is None
            or second_pass.has_failed
            or not repeated
            or len(remaining) > min(LARGEST_LAG, len(repeated))
        ):
            return cls(
                first_pass.sweep.information,
                residuals,
                points=first_pass.linearisation_points_from(0),
            )
        points = [
            *second_pass.linearisation_points_from(0),
            *first_pass.linearisation_points_from(second_pass.rows),
        ]
        return cls(
            first_pass.sweep.with_residuals(second_pass.sweep.information, remaining),
            [*repeated, *remaining],
            points=points,
        )

    def scatter(self, transformed: Array, instruments: Sequence[int]) -> ResidualScatter:
        """Return RMS and autocorrelation of the residuals of some instruments, the largest of each,
        at transformed parameters (P,), to first order.
        """
        scatters = [
            ResidualScatter.from_residuals(
                [
                    residual.evaluate_at(transformed)
                    for residual in self.residuals
                    if residual.instrument == instrument
                ]
            )
            for instrument in instruments
        ]
        return ResidualScatter(
            max(each.rms for each in scatters), max(each.lag1 for each in scatters)
        )
