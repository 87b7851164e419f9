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
    readings : those whose channel is local
    variables : int
        Number of x, all of which stand before φ.
    size : int
        Number of φ.
    """

    readings: tuple[tuple[Reading, Points], ...]
    variables: int
    size: int

    @cached_property
    def structure(self) -> tuple[Index, Index]:
        """Rows and columns of the entries, upper triangle, sorted by column."""
        none, codes = np.zeros(self.size), [np.zeros(0, dtype=np.int64)]
        for reading, points in self.readings:
            if points.each:
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
        return all(r.is_quadratic and not len(p.chart.estimated) for r, p in self.readings)

    @cached_property
    def _constant(self) -> Array:
        shape = max((p.rows[-1] + 1 for _, p in self.readings), default=0), self._dofs
        return self._at(np.zeros(shape), np.zeros(self.size), True)

    @property
    def _dofs(self) -> int:
        return 3 * self.readings[0][1].node_count

    def _at(self, x: Array, phi: Array, bent: bool) -> Array:
        codes = self._codes(*self.structure)
        values = np.zeros(len(codes))
        for entries in self._entries(x, phi, bent):
            np.add.at(values, np.searchsorted(codes, self._codes(*entries[:2])), entries.values)
        return values

    def _entries(self, x: Array, phi: Array, bent: bool) -> Iterator[Entries]:
        for reading, points in self.readings:
            if points.each:
                values = points.of(x, phi)
                slopes = points.slopes(x, phi, self.variables)
                yield reading.hessian(values, phi, slopes, bent)
                if bent and len(points.chart.estimated):
                    by_values, _ = reading.loss_slopes(values, phi)
                    yield points.curvature(x, phi, by_values, self.variables)
