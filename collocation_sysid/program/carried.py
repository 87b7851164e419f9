"""What a program has as variables, with an equation each, that follows from its other variables.

The equations come after all rows of the program given, the variables after all of its variables.
Most are patterns, see `pattern_rows`: to be carried is to declare them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from ..arrays import Array, Index
from .part import Part
from .pattern_rows import Pattern
from .segment import RowWeights, Segment, Weighed


@dataclass(frozen=True)
class Places:
    """Where in z and g the variables and the equations of what is carried begin."""

    variable: int
    row: int


@dataclass(frozen=True, eq=False)
class Carried(ABC):
    """Variables of one experiment and as many equations.

    Attributes
    ----------
    segment : Segment
    number : int
        Of the segment.
    first_phi : int
        Where in z the φ of all experiments begin.
    places : Places
    called : what it belongs to: "memory", "force" or "wrench"
    """

    segment: Segment
    number: int
    first_phi: int
    places: Places
    called: ClassVar[str]

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Of the variables, and of the equations."""

    @property
    def count(self) -> int:
        """Number of variables, and of equations."""
        return int(np.prod(self.shape))

    @property
    def variables(self) -> slice:
        """They in z."""
        return slice(self.places.variable, self.places.variable + self.count)

    @property
    def rows(self) -> slice:
        """Their equations in g."""
        return slice(self.places.row, self.places.row + self.count)

    @property
    def after(self) -> Places:
        """Where the next begins."""
        return Places(self.variables.stop, self.rows.stop)

    @property
    def phi_columns(self) -> Index:
        """(k,) where in z the experiment's φ are."""
        return self.first_phi + self.segment.local.places - self.segment.nq

    @property
    def least(self) -> float:
        """Lower bound of the variables."""
        return -np.inf

    def given(self, part: Part, z: Array) -> Part:
        """The experiment with what it takes of these variables."""
        return part

    @abstractmethod
    def following(self, part: Part) -> Array:
        """(count,) the variables as they follow from what the program given has."""

    @cached_property
    def patterns(self) -> tuple[Pattern, ...]:
        """What adds up to the equations; rows count from the first of these."""
        return ()

    def values(self, part: Part, z: Array) -> Array:
        """(count,) the equations."""
        return np.sum([pattern.values(z, self.count) for pattern in self.patterns], axis=0)

    def jacobian_entries(self) -> tuple[Index, Index]:
        """Rows and columns of the further entries of ∂g/∂z, in the order of their values."""
        rows, columns = together(pattern.jacobian_entries() for pattern in self.patterns)
        return self.places.row + rows, columns

    def jacobian_values(self, part: Part, z: Array) -> tuple[Array, Array]:
        """The equations, and the values of these entries."""
        found = [pattern.jacobian_values(z, self.count) for pattern in self.patterns]
        values, slopes = zip(*found, strict=True)
        return np.sum(values, axis=0), np.concatenate(slopes)

    def hessian_entries(self) -> tuple[Index, Index]:
        """The same of the upper triangle of the Lagrangian's Hessian."""
        return together(pattern.hessian_entries() for pattern in self.patterns)

    def hessian_values(
        self, part: Part, z: Array, loss_weight: float, multipliers: Array, weights: RowWeights
    ) -> Array:
        """The values of these entries; multipliers are those of all of g."""
        own = multipliers[self.rows]
        found = [pattern.hessian_values(z, own) for pattern in self.patterns]
        return np.concatenate([np.zeros(0), *found])

    # What the loss has of the variables ---------------------------------------------------------

    def gradient(self, part: Part) -> Array:
        """∂loss by them (count,)."""
        return np.zeros(self.count)

    # What multipliers weigh ---------------------------------------------------------------------

    def row_weights(self, multipliers: Array) -> Array | float:
        """(N, 3n) derivative of multipliers · its equations by what c has in newtons."""
        return 0.0

    @property
    def history(self) -> int | None:
        """Which of the histories of the motion it is, if any."""
        return None

    def weighed(self, part: Part, multipliers: Array) -> Weighed:
        """That history, and what each h_k counts in multipliers · its equations."""
        raise NotImplementedError

    @property
    def nonzeros(self) -> tuple[int, int]:
        """How many further entries Jacobian and Hessian have."""
        return len(self.jacobian_entries()[0]), len(self.hessian_entries()[0])


def together(parts: Iterable[tuple[Index, Index]]) -> tuple[Index, Index]:
    """Rows and columns of all."""
    none = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    rows, columns = zip(none, *parts, strict=True)
    return np.concatenate(rows), np.concatenate(columns)
