"""Second derivatives of the loss by positions and nuisance parameters, for local observables.

An observable is local if it depends on few positions at each time, such as the place of a marker.
Resultants of reactions are not; programs that need their second derivatives lift them, see
`lifted.resultants`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..common.array_types import Array, Index
from ..common.unique_codes import unique_codes
from .measurement_residual import MeasurementResidual
from .observables import PointPositions, SparseEntries


@dataclass(frozen=True, eq=False)
class LocalLoss:
    """Hessian of the loss of the local measurements of one experiment."""

    # tuple of (MeasurementResidual, PointPositions): measurements with their local observables.
    residuals: tuple[tuple[MeasurementResidual, PointPositions], ...]
    position_count: int  # number of position variables, all of which precede φ
    nuisance_count: int  # number of nuisance parameters φ
    dof_count: int  # number of dofs of the body

    @cached_property
    def structure(self) -> tuple[Index, Index]:
        """Rows and columns among (x, φ) of the possible entries, upper triangle, sorted by column,
        each once.
        """
        none = np.zeros(self.nuisance_count)
        codes = []
        for residual, points in self.residuals:
            slopes = points.derivative_matrix(None, none, position_count=self.position_count)
            codes.append(self._codes(*residual.hessian_structure(slopes)))
        columns, rows = np.divmod(unique_codes(codes), self.position_count + self.nuisance_count)
        return rows, columns

    def _codes(self, rows: Index, columns: Index) -> Index:
        """Return one number for each entry, ascending in the order of `structure`."""
        return columns * (self.position_count + self.nuisance_count) + rows

    def hessian(self, x: Array, phi: Array, has_observation_curvature: bool = True) -> Array:
        """Return the values of the entries of `structure`, in SI units.

        A loss that is quadratic is evaluated once; its Hessian contains the observation curvature,
        which is zero.

        Parameters
        ----------
        x : (N, 3n) array
            Positions [m].
        phi : (k,) array
            Nuisance parameters.
        has_observation_curvature : bool
            If false, neglect the curvature of the observations (Gauss–Newton): the derivatives of
            the loss through second derivatives of the residuals.
        """
        return (
            self._constant
            if self._is_quadratic()
            else self._evaluate_at(x, phi, has_observation_curvature=has_observation_curvature)
        )

    def _is_quadratic(self) -> bool:
        """Return whether the values do not depend on x and φ."""
        return all(
            residual.is_quadratic and points.is_linear for residual, points in self.residuals
        )

    @cached_property
    def _constant(self) -> Array:
        """Values at zero positions and parameters; valid everywhere if `_is_quadratic`."""
        rows = max((points.rows[-1] + 1 for _, points in self.residuals), default=1)
        return self._evaluate_at(
            np.zeros((rows, self.dof_count)),
            np.zeros(self.nuisance_count),
            has_observation_curvature=True,
        )

    def _evaluate_at(self, x: Array, phi: Array, has_observation_curvature: bool) -> Array:
        """Return the values of the entries of `structure` at x (N, 3n) and φ (k,)."""
        codes = self._codes(*self.structure)
        values = np.zeros(len(codes))
        for entries in self._entries(x, phi, has_observation_curvature):
            np.add.at(values, np.searchsorted(codes, self._codes(*entries[:2])), entries.values)
        return values

    def _entries(
        self, x: Array, phi: Array, has_observation_curvature: bool
    ) -> Iterator[SparseEntries]:
        for residual, points in self.residuals:
            values = points.evaluate_positions(x, phi)
            yield residual.hessian(
                values,
                phi,
                derivatives=points.derivative_matrix(x, phi, position_count=self.position_count),
                has_observation_curvature=has_observation_curvature,
            )
            if has_observation_curvature and not points.is_linear:
                by_values, _ = residual.loss_gradient(values, phi)
                yield points.curvature(
                    x, phi, by_values=by_values, position_count=self.position_count
                )
