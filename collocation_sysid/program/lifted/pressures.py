"""Pressures of a complementarity problem as variables of the program, with their equations.

For evaluations k with an equation of motion, in the unit δ of the pressures,

    (b_k + g(ξ_k) − √((b_k − g(ξ_k))² + 4 r δ²)) / δ = 0,   variables b_k / δ,

with the pressure variable b, the gap g and the relaxation r of a
`model.point_forces.ComplementarityForce`. The structure is that of a force history
(`force_histories`), but b belongs to the evaluation itself instead of the one before. Stresses
of a law with strains of its own have the same structure.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ...common.array_types import Array
from ...model.point_forces import ComplementarityForce
from ..experiment_iterate import ExperimentIterate
from ..linear_algebra.sparse_assembly import EntryBlock
from ..motion_transcription import RowWeights, WeightedHistory
from .force_histories import LiftedForceHistory


@dataclass(frozen=True, eq=False)
class LiftedPressure(LiftedForceHistory):
    """Lifted pressure variables b of one force of one experiment."""

    kind = "pressure"

    @property
    def width(self) -> int:
        """Number of variables of each point."""
        return 1

    @property
    def first_evaluation(self) -> int:  # type: ignore[override]
        """Index of the evaluation that the first variables belong to: the first with an equation of
        motion.
        """
        return self.transcription.dynamics.first_row

    @property
    def unit_m(self) -> float:
        """Unit δ of the variables and of the equations [m]."""
        return self._find_force().pressure_unit_m

    def _find_force(self) -> ComplementarityForce:
        term = self.transcription.dynamics.forces.external_terms[self.force_index]
        assert isinstance(term, ComplementarityForce)
        return term

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (width, evaluations, I): evaluations with an equation
        of motion, and I points.
        """
        return self.width, self.transcription.constraint_times, self._points.count

    def consistent_values(self, iterate: ExperimentIterate) -> Array:
        states = iterate.equations.dynamics.evaluation_states(iterate.x)
        return self._find_force().scaled_pressures(*states).ravel() / self.unit_m

    def with_lifted(self, iterate: ExperimentIterate, z: Array) -> ExperimentIterate:
        """Return a copy of the iterate with the scaled pressures b (width, N, I) [m] of this force
        taken from z; b is zero at a stated initial state.
        """
        b = np.zeros((self.width, self.transcription.grid_times, self._points.count))
        b[:, self.first_evaluation :] = self.unit_m * z[self.columns].reshape(self.shape)
        return replace(iterate, lifted_pressures={**iterate.lifted_pressures, self.force_index: b})

    def residuals(self, iterate: ExperimentIterate, z: Array) -> Array:
        """Return the scaled complementarity equations (count,) at an iterate; z is not used,
        because the iterate contains b.
        """
        return (
            self._history_of(iterate).internal_variables(slice(self.first_evaluation, None)).ravel()
            / self.unit_m
        )

    def weighted_history(self, iterate: ExperimentIterate, multipliers: Array) -> WeightedHistory:
        """Return the history and its weights μ (width, N, I) in the Lagrangian, such that multipliers ·
        equations = Σ μ_k h_k with the unscaled equations h_k of evaluation k; `multipliers` are
        those of all constraints g.
        """
        mu = np.zeros((self.width, self.transcription.grid_times, self._points.count))
        mu[:, self.first_evaluation :] = multipliers[self.rows].reshape(self.shape) / self.unit_m
        return self._history_of(iterate), mu

    def _jacobian_blocks(self) -> Iterator[EntryBlock]:
        """Yield the entries of the equations by b and by x, then those of the motion by b."""
        rows = self.offsets.row + self._indices
        columns = self.offsets.variable + self._indices
        instance = self._points.nonzero_weights[0]
        yield EntryBlock([rows], [columns])  # no equation has the variable of another
        for here, x, *_ in self._position_lags(self.first_evaluation):
            yield EntryBlock([rows[:, here][..., instance]], [x])
        for pairs, k, row, _ in self._motion_entries():
            yield EntryBlock(
                [row], [columns[:, k[:, None] - self.first_evaluation, instance[pairs]]]
            )

    def jacobian_values(self, iterate: ExperimentIterate, z: Array) -> tuple[Array, Array]:
        history = self._history_of(iterate)
        d = self._points.dofs
        slopes = history.derivatives(slice(None))
        by = type(slopes)(*(each[d:, :, self.first_evaluation :] / self.unit_m for each in slopes))
        blocks = [self.unit_m * np.einsum("aati->ati", by.b)]
        blocks += [
            self.transcription.length_m * each
            for each in self._position_derivatives(self.first_evaluation, by)
        ]
        blocks += self._motion_derivatives(slopes)
        return self.residuals(iterate, z), np.concatenate([each.ravel() for each in blocks])


class LiftedStress(LiftedPressure):
    """Lifted stresses of elements whose law has strains of its own, see `Kind.given_stresses`."""

    kind = "stress"
    is_bilinear = True

    @property
    def width(self) -> int:
        return self.transcription.body.element.stresses

    def _hessian_blocks(self) -> Iterator[EntryBlock]:
        """Yield also the diagonal, which is zero: methods may add to it."""
        yield from super()._hessian_blocks()
        columns = self.offsets.variable + self._indices
        yield EntryBlock([columns], [columns])

    def hessian_values(
        self,
        iterate: ExperimentIterate,
        z: Array,
        loss_weight: float,
        multipliers: Array,
        weights: RowWeights,
    ) -> Array:
        values = super().hessian_values(iterate, z, loss_weight, multipliers, weights)
        return np.concatenate([values, np.zeros(self.count)])
