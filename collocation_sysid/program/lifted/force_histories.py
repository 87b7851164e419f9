"""History variables b of one force as variables of the program, with their recursion as equations.

For evaluations k = 1 … N − 1, in mean edge lengths ℓ as positions are,

    (b_k − h(ξ_{k−1}, ν_{k−1}, c_{k−1}, b_{k−1})) / ℓ = 0,   variables b_k / ℓ,

see `model.point_forces`; b_0 is zero. Of the Lagrangian's second derivatives, those by
positions and parameters alone are computed together with the other forces (with other weights);
those with b are computed here.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ...common.array_types import Array, Index
from ...fem.force_points import ForcePoints
from ...model.force_internal_variables import ForceHistory
from ...model.point_forces import LawDerivatives
from ..experiment_iterate import ExperimentIterate
from ..linear_algebra.sparse_assembly import EntryBlock
from ..motion_transcription import RowWeights, WeightedHistory
from .reactions import LiftedReactions, motion_equations
from .variables import LiftedVariables


@dataclass(frozen=True, eq=False)
class LiftedForceHistory(LiftedVariables):
    """Lifted history variables b of one force of one experiment.

    Arrays end with the axes of evaluations and instances, (…, T, I).
    """

    motion_history: int  # index of the history in `ExperimentIterate.histories`
    force_index: int  # index of the force, see `ForceHistory`
    # Lifted reaction forces, whose equations also contain the force; None if the program has none.
    reactions: LiftedReactions | None = None
    kind = "force"
    # Index of the evaluation that the first variables belong to.
    first_evaluation = 1
    # Whether force and equations are linear in the variables, and neither has parameters.
    is_bilinear = False

    @property
    def unit_m(self) -> float:
        """Unit of the variables and of the equations [m]: the mean edge length ℓ."""
        return self.transcription.length_m

    @property
    def history_index(self) -> int:
        return self.motion_history

    @property
    def _points(self) -> ForcePoints:
        """Points of the body at which the force acts, in all I instances."""
        return self.transcription.dynamics.forces.pointwise_term(self.force_index)[0].points

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (n, N − 1, I): n numbers at N − 1 evaluations and I instances."""
        term = self.transcription.dynamics.forces.pointwise_term(self.force_index)[0]
        return (term.internal_variable_count, self.transcription.grid_times - 1, self._points.count)

    def consistent_values(self, iterate: ExperimentIterate) -> Array:
        return (
            self._history_of(iterate).previous_state.before[:, 1:].ravel()
            / self.transcription.length_m
        )

    def with_lifted(self, iterate: ExperimentIterate, z: Array) -> ExperimentIterate:
        """Return a copy of the iterate with the history variables b (n, N, I) [m] of this force
        taken from z; b is zero at evaluation 0.
        """
        later = z[self.columns].reshape(self.shape) * self.transcription.length_m
        before = np.concatenate([np.zeros_like(later[:, :1]), later], axis=1)
        return replace(
            iterate, lifted_histories={**iterate.lifted_histories, self.history_index: before}
        )

    def residuals(self, iterate: ExperimentIterate, z: Array) -> Array:
        """Return the scaled equations (count,): the variables in z minus their values by the
        recursion from those that the iterate contains.
        """
        predicted = self._history_of(iterate).internal_variables(slice(self.shape[1])).ravel()
        return z[self.columns] - predicted / self.transcription.length_m

    def weighted_history(self, iterate: ExperimentIterate, multipliers: Array) -> WeightedHistory:
        """Return the history and μ (n, N, I): multipliers · equations contains Σ μ_k h_k."""
        mu = -multipliers[self.rows].reshape(self.shape) / self.transcription.length_m
        return self._history_of(iterate), np.concatenate([mu, np.zeros_like(mu[:, :1])], axis=1)

    def _history_of(self, iterate: ExperimentIterate) -> ForceHistory:
        history = iterate.histories[self.history_index]
        assert isinstance(history, ForceHistory)
        return history

    # Entries ------------------------------------------------------------------------------------

    @cached_property
    def _indices(self) -> Index:
        """Indices (n, N − 1, I) of the variables b_1, b_2, … within this block."""
        return np.arange(self.count).reshape(self.shape)

    @cached_property
    def _dynamic_columns(self) -> Index:
        """Columns (m,) in z of the parameters that change the motion."""
        return self.transcription.dynamic_columns(self.first_phi)

    def _position_lags(self, first: int) -> Iterator[tuple[slice, Index, Array, Array]]:
        """Iterate over the lags of the stencil, for N − 1 evaluations from `first` on."""
        dynamics = self.transcription.dynamics
        times = np.arange(first, first + self.shape[1])
        q = dynamics.tables.q / dynamics.step_s
        for lag, (of_p, of_q) in enumerate(zip(dynamics.state_weights.T, q.T, strict=True)):
            used = (times >= lag) & ((of_p[times] != 0) | (of_q[times] != 0))
            if used.any():
                here = slice(int(used.argmax()), len(used))
                k = times[here, None]
                x = (
                    self.transcription.offsets.variable
                    + (k - lag) * self.transcription.dof_count
                    + self._points.nonzero_weights[2]
                )
                yield here, x, of_p[k], of_q[k]

    def _position_derivatives(self, first: int, derivatives: LawDerivatives) -> Iterator[Array]:
        """Yield derivatives (a, T, P) by positions at each lag, from evaluations on `first`."""
        instance, local, _, weight = self._points.nonzero_weights
        by_y = derivatives.y[:, local, :, instance].transpose(1, 2, 0) * weight
        by_v = (
            derivatives.v[:, local, :, instance].transpose(1, 2, 0) * weight
            if derivatives.v.size
            else 0.0
        )
        for here, _, p, q in self._position_lags(first):
            yield by_y[:, here] * p + (by_v[:, here] * q if isinstance(by_v, np.ndarray) else 0.0)

    def _motion_entries(self) -> Iterator[tuple[Index, Index, Index, Array]]:
        """Yield point pairs (K,), evaluations (T,), rows (T, K) in g and weights (T, K) of b."""
        dynamics = self.transcription.dynamics
        first_row = self.transcription.dynamics.first_row
        _, _, of_pairs, shares = self._points.nonzero_weights
        for rows in motion_equations(self.transcription, self.reactions):
            pairs = np.flatnonzero(rows.row_of_dof[of_pairs] >= 0)
            dofs = of_pairs[pairs]
            for lag, weights in enumerate(dynamics.tables.w.T):
                k = np.arange(max(self.first_evaluation, first_row), dynamics.row_count - lag)[
                    :, None
                ]
                if not len(k) or not weights[lag:].any():
                    continue
                row = (
                    rows.first_row
                    + (k + lag - first_row) * rows.rows_per_time
                    + rows.row_of_dof[dofs]
                )
                weight = weights[k + lag] * shares[pairs]
                if rows.omits_prescribed:
                    weight[
                        dynamics.is_temporarily_prescribed[k, dofs]
                        | dynamics.is_temporarily_prescribed[k + lag, dofs]
                    ] = 0.0
                yield pairs, k[:, 0], row, weight / self.transcription.force_n

    def _jacobian_blocks(self) -> Iterator[EntryBlock]:
        """Yield the entries of the equations by b, x and parameters, then of the motion by b."""
        rows = self.offsets.row + self._indices
        columns = self.offsets.variable + self._indices
        instance = self._points.nonzero_weights[0]
        yield EntryBlock([rows], [columns])
        yield EntryBlock([rows[:, None, 1:]], [columns[:, :-1]])
        for here, x, *_ in self._position_lags(0):
            yield EntryBlock([rows[:, here][..., instance]], [x])
        yield EntryBlock([rows[:, None]], [self._dynamic_columns[:, None, None]])
        for pairs, k, row, _ in self._motion_entries():
            yield EntryBlock(
                [row], [columns[:, k[:, None] - self.first_evaluation, instance[pairs]]]
            )

    def _hessian_blocks(self) -> Iterator[EntryBlock]:
        """Yield the Hessian's entries in the columns of b: by x, by b and by parameters."""
        columns = self.offsets.variable + self._indices
        for here, x, *_ in self._position_lags(self.first_evaluation):
            yield EntryBlock([x], [columns[:, here][..., self._points.nonzero_weights[0]]])
        if not self.is_bilinear:
            i, j = np.triu_indices(self.shape[0])
            yield EntryBlock([columns[i]], [columns[j]])
            yield EntryBlock([self._dynamic_columns[:, None, None, None]], [columns])

    def jacobian_values(self, iterate: ExperimentIterate, z: Array) -> tuple[Array, Array]:
        history = self._history_of(iterate)
        length_m = self.transcription.length_m
        d = self._points.dofs
        slopes = history.derivatives(slice(None))
        places = history.input_columns
        by = LawDerivatives(*(-each[d:, :, :-1] / length_m for each in slopes))
        blocks = [np.ones(self.count), length_m * by.b[:, :, 1:]]
        blocks += [length_m * each for each in self._position_derivatives(0, by)]
        of_inputs = iterate.equations.input_derivatives[:-1][:, places]
        blocks.append(np.einsum("acti,tcm->amti", by.c, of_inputs))
        blocks += self._motion_derivatives(slopes)
        return self.residuals(iterate, z), np.concatenate([each.ravel() for each in blocks])

    def _motion_derivatives(self, slopes: LawDerivatives) -> Iterator[Array]:
        """Yield derivatives of the scaled motion by scaled b, in the order of `_motion_entries`."""
        instance, local, *_ = self._points.nonzero_weights
        for pairs, k, _, weight in self._motion_entries():
            by_b = slopes.b[local[pairs], :, :, instance[pairs]][:, :, k]
            yield self.unit_m * by_b.transpose(1, 2, 0) * weight

    def hessian_values(
        self,
        iterate: ExperimentIterate,
        z: Array,
        loss_weight: float,
        multipliers: Array,
        weights: RowWeights,
    ) -> Array:
        """Return the values of `hessian_entries`: second derivatives with b of multipliers · g,
        including the forces in the equations of motion; arguments as in
        `LiftedVariables.hessian_values`.
        """
        history, mu = self.weighted_history(iterate, multipliers)
        assert isinstance(history, ForceHistory)
        length_m = self.transcription.length_m
        places = history.input_columns
        second_derivatives = history.mixed_second_derivatives(mu, weights.forces)
        first = self.first_evaluation
        by = LawDerivatives(*(self.unit_m * each[:, :, first:] for each in second_derivatives))
        by_state = LawDerivatives(*(each.swapaxes(0, 1) for each in by))
        blocks = [length_m * each for each in self._position_derivatives(first, by_state)]
        if self.is_bilinear:
            return np.concatenate([each.ravel() for each in blocks])
        blocks.append(self.unit_m * by.b[np.triu_indices(self.shape[0])])
        of_inputs = iterate.equations.input_derivatives[first:][:, places]
        blocks.append(np.einsum("cati,tcm->mati", by.c, of_inputs))
        return np.concatenate([each.ravel() for each in blocks])
