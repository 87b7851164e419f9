"""Second derivatives of the loss by positions and nuisance parameters, for local observables.

An observable is local if it depends on few positions at each time, such as the place of a marker.
Wrenches are not; programs that need their second derivatives lift them, see `wrench_rows`.
"""

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
    """Hessian of the loss of the local measurements of one experiment.

    Attributes
    ----------
    readings : tuple of (Reading, Points)
        Measurements with their local observables.
    variables : int
        Number of position variables, all of which precede φ.
    size : int
        Number of nuisance parameters φ.
    dofs : int
        Number of dofs of the body.
    """

    readings: tuple[tuple[Reading, Points], ...]
    variables: int
    size: int
    dofs: int

    @cached_property
    def structure(self) -> tuple[Index, Index]:
        """Rows and columns among (x, φ) of the entries, upper triangle, sorted by column."""
        none = np.zeros(self.size)
        codes = [np.zeros(0, dtype=np.int64)]
        for reading, points in self.readings:
            slopes = points.slopes(None, none, self.variables)
            codes.append(self._codes(*reading.hessian_structure(slopes)))
        unique_codes = np.unique(np.concatenate(codes))
        return unique_codes % self._height, unique_codes // self._height

    @property
    def _height(self) -> int:
        """Number of rows and columns."""
        return self.variables + self.size

    def _codes(self, rows: Index, columns: Index) -> Index:
        """Return one number for each entry, ascending in the order of `structure`."""
        return columns * self._height + rows

    def hessian(self, x: Array, phi: Array, bent: bool = True) -> Array:
        """Return the values of the entries.

        Parameters
        ----------
        x : (N, 3n) array
            Positions [m].
        phi : (k,) array
            Nuisance parameters.
        bent : bool
            If false, neglect the curvature of the observations (Gauss–Newton).
        """
        return self._constant if self._is_quadratic else self._at(x, phi, bent)

    @property
    def _is_quadratic(self) -> bool:
        """Whether the values do not depend on x and φ."""
        return all(reading.is_quadratic and points.is_linear for reading, points in self.readings)

    @cached_property
    def _constant(self) -> Array:
        """Values of the entries at zero positions."""
        rows = max((points.rows[-1] + 1 for _, points in self.readings), default=1)
        return self._at(np.zeros((rows, self.dofs)), np.zeros(self.size), True)

    def _at(self, x: Array, phi: Array, bent: bool) -> Array:
        """Return the values of the entries at x and φ."""
        codes = self._codes(*self.structure)
        values = np.zeros(len(codes))
        for entries in self._entries(x, phi, bent):
            np.add.at(values, np.searchsorted(codes, self._codes(*entries[:2])), entries.values)
        return values

    def _entries(self, x: Array, phi: Array, bent: bool) -> Iterator[Entries]:
        """Iterate over the contributions of the measurements, and of the curvature of
        observables.
        """
        for reading, points in self.readings:
            values = points.of(x, phi)
            yield reading.hessian(values, phi, points.slopes(x, phi, self.variables), bent)
            if bent and not points.is_linear:
                by_values, _ = reading.loss_slopes(values, phi)
                yield points.curvature(x, phi, by_values, self.variables)
