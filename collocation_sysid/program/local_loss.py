"""Second derivatives of the loss by positions and φ, of what follows from few positions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..arrays import Array, Index
from .channel import Entries, Points
from .reading import Reading


@dataclass(frozen=True, eq=False)
class LocalLoss:
    """That of some readings of one experiment.

    Attributes
    ----------
    readings : those whose channel is local, with that
    variables : int
        Number of x, all of which stand before φ.
    size : int
        Number of φ.
    dofs : int
        Of the body.
    """

    readings: tuple[tuple[Reading, Points], ...]
    variables: int
    size: int
    dofs: int

    @cached_property
    def structure(self) -> tuple[Index, Index]:
        """Rows and columns of the entries, upper triangle, sorted by column."""
        none, codes = np.zeros(self.size), [np.zeros(0, dtype=np.int64)]
        for reading, points in self.readings:
            slopes = points.slopes(None, none, self.variables)
            codes.append(self._codes(*reading.hessian_structure(slopes)))
        found = np.unique(np.concatenate(codes))
        return found % self._height, found // self._height

    @property
    def _height(self) -> int:
        return self.variables + self.size

    def _codes(self, rows: Index, columns: Index) -> Index:
        """Numbers of entries that ascend as they are sorted."""
        return columns * self._height + rows

    def hessian(self, x: Array, phi: Array, bent: bool = True) -> Array:
        """Values of the entries; of readings that are bent, or linear."""
        return self._constant if self._is_quadratic else self._at(x, phi, bent)

    @property
    def _is_quadratic(self) -> bool:
        """Whether they are always the same."""
        return all(reading.is_quadratic and points.is_linear for reading, points in self.readings)

    @cached_property
    def _constant(self) -> Array:
        rows = max((points.rows[-1] + 1 for _, points in self.readings), default=1)
        return self._at(np.zeros((rows, self.dofs)), np.zeros(self.size), True)

    def _at(self, x: Array, phi: Array, bent: bool) -> Array:
        codes = self._codes(*self.structure)
        values = np.zeros(len(codes))
        for entries in self._entries(x, phi, bent):
            np.add.at(values, np.searchsorted(codes, self._codes(*entries[:2])), entries.values)
        return values

    def _entries(self, x: Array, phi: Array, bent: bool) -> Iterator[Entries]:
        for reading, points in self.readings:
            values = points.of(x, phi)
            yield reading.hessian(values, phi, points.slopes(x, phi, self.variables), bent)
            if bent and not points.is_linear:
                by_values, _ = reading.loss_slopes(values, phi)
                yield points.curvature(x, phi, by_values, self.variables)
