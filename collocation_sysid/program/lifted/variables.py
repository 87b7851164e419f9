"""Lifted variables: variables of the program that follow from the others, each with an equation.

By default they are eliminated; `collocation.LiftedCollocation` has them so that exact
matrices stay sparse. Their equations come after all other constraints, and the variables after all
other variables. Subclass `LiftedVariables` to lift another quantity; most subclasses only declare
`patterns` of small expressions, see `expression_patterns`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from ...common.array_types import Array, Index
from ..experiment_iterate import ExperimentIterate
from ..linear_algebra.sparse_assembly import EntryBlock
from ..motion_transcription import Offsets, RowWeights, WeightedHistory
from ..transcription import Transcription
from .expression_patterns import ExpressionPattern


@dataclass(frozen=True, eq=False)
class LiftedVariables(ABC):
    """A group of lifted variables of one experiment, and as many equations."""

    transcription: Transcription  # transcription of the experiment
    transcription_index: int  # index of the transcription
    first_phi: int  # index in z where the nuisance parameters of all experiments begin
    offsets: Offsets  # offsets of the variables and equations
    kind: ClassVar[str]  # kind of quantity

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Shape of the array of variables, and of that of the equations; the last index is the
        fastest in z and in g.
        """

    @property
    def count(self) -> int:
        """Number of variables, which is that of the equations: the product of `shape`."""
        return int(np.prod(self.shape))

    @property
    def columns(self) -> slice:
        """Slice of the variables in z."""
        return slice(self.offsets.variable, self.offsets.variable + self.count)

    @property
    def rows(self) -> slice:
        """Slice of the equations in g."""
        return slice(self.offsets.row, self.offsets.row + self.count)

    @property
    def next_offsets(self) -> Offsets:
        """Offsets of the group that follows."""
        return Offsets(self.columns.stop, self.rows.stop)

    @property
    def phi_columns(self) -> Index:
        """Indices (k,) in z of the experiment's nuisance parameters."""
        return self.first_phi + self.transcription.nuisance_indices.indices - self.transcription.nq

    def with_lifted(self, iterate: ExperimentIterate, z: Array) -> ExperimentIterate:
        """Return a copy of the iterate with those quantities replaced that these variables of z
        determine; here the iterate itself, for groups that determine none.
        """
        return iterate

    @abstractmethod
    def consistent_values(self, iterate: ExperimentIterate) -> Array:
        """Return the scaled variables (count,) that satisfy the equations at the iterate's
        positions and parameters.
        """

    @cached_property
    def patterns(self) -> tuple[ExpressionPattern, ...]:
        """Expressions whose sum is the equations, with indices of rows from the group's first
        equation on; empty for subclasses that override the methods below.
        """
        return ()

    def residuals(self, iterate: ExperimentIterate, z: Array) -> Array:
        """Return the scaled equations (count,) at the iterate and z,
        zero where they are satisfied.
        """
        return np.sum([pattern.residuals(z, self.count) for pattern in self.patterns], axis=0)

    def jacobian_entries(self) -> tuple[Index, Index]:
        """Return rows in g and columns in z of the additional entries of ∂g/∂z, in the order of
        their values; an entry may be repeated, and its values are summed.
        """
        of_patterns = (pattern.jacobian_entries() for pattern in self.patterns)
        of_blocks = (block.indices() for block in self._jacobian_blocks())
        return concatenated_entries(
            [*((self.offsets.row + rows, columns) for rows, columns in of_patterns), *of_blocks]
        )

    def jacobian_values(self, iterate: ExperimentIterate, z: Array) -> tuple[Array, Array]:
        """Return the scaled equations (count,) at the iterate and z, and the values of
        `jacobian_entries`: derivatives by scaled variables.
        """
        evaluated = [pattern.jacobian_values(z, self.count) for pattern in self.patterns]
        values, slopes = zip(*evaluated, strict=True)
        return np.sum(values, axis=0), np.concatenate(slopes)

    def hessian_entries(self) -> tuple[Index, Index]:
        """Return rows and columns in z of the additional entries of the Lagrangian's Hessian, upper
        triangle; an entry may be repeated, and its values are summed.
        """
        of_patterns = (pattern.hessian_entries() for pattern in self.patterns)
        of_blocks = (block.indices() for block in self._hessian_blocks())
        return concatenated_entries([*of_patterns, *of_blocks])

    def _jacobian_blocks(self) -> Iterable[EntryBlock]:
        """Return blocks of entries of ∂g/∂z besides those of `patterns`."""
        return ()

    def _hessian_blocks(self) -> Iterable[EntryBlock]:
        """Return blocks of entries of the Hessian besides those of `patterns`."""
        return ()

    def hessian_values(
        self,
        iterate: ExperimentIterate,
        z: Array,
        loss_weight: float,
        multipliers: Array,
        weights: RowWeights,
    ) -> Array:
        """Return the values of `hessian_entries`: second derivatives of loss_weight · loss +
        multipliers · g.

        Parameters
        ----------
        iterate : ExperimentIterate
            The experiment at z.
        z : array
            All variables of the program.
        loss_weight : float
            Factor of the loss; used by groups on which the loss depends.
        multipliers : array
            Multipliers of all constraints g.
        weights : RowWeights
            Weights of the experiment's constraints and forces.
        """
        own = multipliers[self.rows]
        blocks = [pattern.hessian_values(z, own) for pattern in self.patterns]
        return np.concatenate([np.zeros(0), *blocks])

    # What the loss has of the variables ---------------------------------------------------------

    def loss_gradient(self, iterate: ExperimentIterate) -> Array:
        """Return the gradient of the loss by these scaled variables (count,); here zero, for groups
        on which the loss does not depend.
        """
        return np.zeros(self.count)

    # What multipliers weigh ---------------------------------------------------------------------

    def residual_weights(self, multipliers: Array) -> Array | float:
        """Return the derivative (N, 3n) of multipliers · equations by the residual c in newtons
        [1/N]; 0 if the equations do not contain it.

        Parameters
        ----------
        multipliers : (constraints,) array
            Multipliers of all constraints g.
        """
        return 0.0

    @property
    def history_index(self) -> int | None:
        """Index of the history in `ExperimentIterate.histories`, or None if the group is no
        history.
        """
        return None

    def weighted_history(self, iterate: ExperimentIterate, multipliers: Array) -> WeightedHistory:
        """Return the history of the iterate, and the weights of each h_k in multipliers ·
        equations.

        Raises
        ------
        NotImplementedError
            If the group is no history (`history_index` is None).
        """
        raise NotImplementedError

    @property
    def entry_counts(self) -> tuple[int, int]:
        """Numbers of additional entries of the Jacobian, and of the
        upper triangle of the Hessian.
        """
        return len(self.jacobian_entries()[0]), len(self.hessian_entries()[0])


def concatenated_entries(groups: Iterable[tuple[Index, Index]]) -> tuple[Index, Index]:
    """Concatenate the rows, and the columns, of several groups of entries; without groups both are
    empty.
    """
    none = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    rows, columns = zip(none, *groups, strict=True)
    return np.concatenate(rows), np.concatenate(columns)
