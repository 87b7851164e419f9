"""Memory of a viscoelastic body as variables of the program, with its recursion as equations.

For evaluations k = 1 … N − 1 and all branches, in scaled quantities,

    r_k = (m_{k−1} − d_{k−1} m_{k−2} − a_{k−1} S_{k−1}) / S̄,   variables m_{k−1} / S̄,

with the history variables m and the second Piola–Kirchhoff stress S of the long-term energy, see
`model.viscoelasticity`; m_{−1} is zero, and S̄ is the branch's long-term stress at a strain of one.
The derivatives of r_k have the entries ∂S/∂x of one evaluation, and the equations of motion those
∂f_H/∂H of another, f_H being the force of the overstress H. Of the second derivatives only those by
x and m are additional entries: 18 numbers per point and node.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ...common.array_types import Array, Index
from ...model.viscoelasticity import EVALUATIONS_PER_CHUNK, MemoryHistory
from ..experiment_iterate import ExperimentIterate
from ..linear_algebra.sparse_assembly import EntryBlock
from ..motion_transcription import RowWeights, WeightedHistory
from .reactions import LiftedReactions, MotionEquations, motion_equations
from .variables import LiftedVariables


@dataclass(frozen=True, eq=False)
class _Lag:
    """Entries of evaluations `start` … `stop` − 1 at one lag of a stencil."""

    lag: int  # number of grid times before the evaluation
    # Range of the evaluations.
    start: int
    stop: int
    factors: Array  # (N,): coefficients of the stencil, by evaluation

    def select_evaluations(self) -> Index:
        """Return the indices (T, 1) of the evaluations."""
        return np.arange(self.start, self.stop)[:, None]


@dataclass(frozen=True, eq=False)
class _MotionEntries:
    """Entries of one set of equations of motion that contain the memory."""

    derivative_indices: Index  # (K,): indices of the derivatives
    row_indices: Index  # (K,): index of the row of each within its grid time
    rows: MotionEquations


class _StressEntries(NamedTuple):
    """Derivatives of the stresses of all branches by positions, K in total."""

    positions: Index  # (K,): column of each in `stress_jacobian`
    # (K,): history variable to which the stress belongs, among the width of all branches.
    variables: Index
    dofs: Index  # (K,): dof by which it is differentiated
    branches: Index  # (K,): index of the branch


@dataclass(frozen=True, eq=False)
class LiftedMemory(LiftedVariables):
    """Lifted history variables m of a viscoelastic body."""

    # Lifted reaction forces, whose equations also contain the memory; None if the program has none.
    reactions: LiftedReactions | None = None
    kind = "memory"
    # The history of the body is the first in `ExperimentIterate.histories`.
    history_index = 0  # type: ignore[override]

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (N − 1, width): evaluations with a past, and history variables of all branches."""
        return self.transcription.grid_times - 1, self.transcription.body.memory.branches[
            -1
        ].columns.stop

    @cached_property
    def unit_pa(self) -> Array:
        """Unit (width,) of the history variables [Pa]: normal entries of dS/dε of a uniform stretch
        at the guess, averaged over the branch.
        """
        transcription = self.transcription
        body = self.transcription.body
        theta = transcription.constants.theta(transcription.parameters.guess_q)
        rest = body.nodes_m.reshape(1, -1)
        memory = body.memory
        change = np.abs(body.stresses.stress_jvp(rest, rest, theta=theta)[0])
        normal = [
            change[b.points][: (b.points.stop - b.points.start) // 2] for b in memory.branches
        ]
        means = np.array([each.mean() for each in normal])
        return np.broadcast_to(memory.repeat_over_points(means), self.shape[1:])

    # Values -------------------------------------------------------------------------------------

    def consistent_values(self, iterate: ExperimentIterate) -> Array:
        return (_body_history(iterate).previous_variables[1:] / self.unit_pa).ravel()

    def with_lifted(self, iterate: ExperimentIterate, z: Array) -> ExperimentIterate:
        """Return a copy of the iterate with the history variables (N, width) [Pa] of the body taken
        from z; those of the first evaluation are zero.
        """
        later = z[self.columns].reshape(self.shape) * self.unit_pa
        memory = np.concatenate([np.zeros((1, self.shape[1])), later])
        return replace(
            iterate, lifted_histories={**iterate.lifted_histories, self.history_index: memory}
        )

    def residuals(self, iterate: ExperimentIterate, z: Array) -> Array:
        """Return the scaled equations r (count,) at the history variables that the iterate
        contains; z is not used.
        """
        return (_body_history(iterate).compute_recursion_residuals() / self.unit_pa).ravel()

    def weighted_history(self, iterate: ExperimentIterate, multipliers: Array) -> WeightedHistory:
        """Return the history and μ: multipliers · r = −Σ μ_k (m_k − d_k m_{k−1} − a_k S_k)."""
        return _body_history(iterate), self._history_weights(multipliers)

    def _history_weights(self, multipliers: Array) -> Array:
        """Return μ (N, width), see `weighted_history`; zero at the last evaluation."""
        mu = -multipliers[self.rows].reshape(self.shape) / self.unit_pa
        return np.concatenate([mu, np.zeros((1, self.shape[1]))])

    # Entries ------------------------------------------------------------------------------------

    @cached_property
    def _stress_entries(self) -> _StressEntries:
        entries = self.transcription.body.stresses.jacobian_entries
        index_arrays = []
        for number, branch in enumerate(self.transcription.body.memory.branches):
            points = branch.points
            in_branch = (entries.points >= points.start) & (entries.points < points.stop)
            places = np.flatnonzero(in_branch)
            own = entries.points[places] - points.start + branch.columns.start
            index_arrays.append((places, own, entries.dofs[places], np.full(len(places), number)))
        return _StressEntries(*(np.concatenate(each) for each in zip(*index_arrays, strict=True)))

    @cached_property
    def _motion_entries(self) -> list[_MotionEntries]:
        """Equations of motion, and of lifted reactions, that contain the memory, with entries."""
        entries = []
        dofs = self._stress_entries.dofs
        for rows in motion_equations(self.transcription, self.reactions):
            slopes = np.flatnonzero(rows.row_of_dof[dofs] >= 0)
            entries.append(_MotionEntries(slopes, rows.row_of_dof[dofs[slopes]], rows=rows))
        return entries

    @cached_property
    def _stress_lags(self) -> list[_Lag]:
        """Lags of S_k by x_{k−lag}; the last evaluation has no equation."""
        return self._nonzero_lags(self.transcription.dynamics.state_weights, 0, stop=self.shape[0])

    @cached_property
    def _state_lags(self) -> list[_Lag]:
        """Lags of forces at evaluation k with a past by x_{k−lag}."""
        return self._nonzero_lags(
            self.transcription.dynamics.tables.p,
            max(1, self.transcription.dynamics.first_row),
            stop=self.transcription.grid_times,
        )

    @staticmethod
    def _nonzero_lags(table: Array, first: int, stop: int) -> list[_Lag]:
        """Return the lags with a non-zero coefficient, for evaluations with a position there."""
        columns = enumerate(table.T)
        return [
            _Lag(lag, max(lag, first), stop=stop, factors=column)
            for lag, column in columns
            if column.any()
        ]

    @cached_property
    def _force_lags(self) -> list[_Lag]:
        """Lags j of c_{k+j} by the forces at evaluations k with a past whose row k + j exists."""
        table = self.transcription.dynamics.tables.w
        count = self.transcription.grid_times
        lags = [
            _Lag(
                j,
                max(1, self.transcription.dynamics.first_row),
                stop=count - j,
                factors=table[j:, j],
            )
            for j in range(table.shape[1])
        ]
        return [each for each in lags if each.factors.any()]

    def _memory_columns(self, lag: _Lag, variables: Index) -> list[Index | int]:
        """Return arrays whose sum are the columns (T, K) in z of m_{k−1} at a lag."""
        return [self.offsets.variable, (lag.select_evaluations() - 1) * self.shape[1], variables]

    def _position_columns(self, lag: _Lag, dofs: Index) -> list[Index | int]:
        """Return arrays whose sum are the columns (T, K) in z of positions at the times k − lag."""
        return [
            self.transcription.offsets.variable,
            (lag.select_evaluations() - lag.lag) * self.transcription.dof_count,
            dofs,
        ]

    def _jacobian_blocks(self) -> list[EntryBlock]:
        """Return the entries of r by q, m_{k−1}, m_{k−2} and x, then of the motion by m."""
        own = self._stress_entries.variables
        dofs = self._stress_entries.dofs
        equations, variables = (np.arange(s.start, s.stop) for s in (self.rows, self.columns))
        blocks = [
            EntryBlock([equations], [np.arange(self.transcription.nq)[:, None]]),
            EntryBlock([equations], [variables]),
            EntryBlock([equations[self.shape[1] :]], [variables[: -self.shape[1]]]),
        ]
        for each in self._stress_lags:
            rows = [self.offsets.row, each.select_evaluations() * self.shape[1], own]
            blocks.append(EntryBlock(rows, self._position_columns(each, dofs)))
        for moved in self._motion_entries:
            for each in self._force_lags:
                row_times = (
                    each.select_evaluations() + each.lag - self.transcription.dynamics.first_row
                )
                rows = [
                    moved.rows.first_row,
                    row_times * moved.rows.rows_per_time,
                    moved.row_indices,
                ]
                blocks.append(
                    EntryBlock(rows, self._memory_columns(each, own[moved.derivative_indices]))
                )
        return blocks

    def _hessian_blocks(self) -> list[EntryBlock]:
        """Return the Hessian's entries in the columns of m: by q, then by x."""
        variables = np.arange(self.columns.start, self.columns.stop)
        blocks = [EntryBlock([np.arange(self.transcription.nq)[:, None]], [variables])]
        own = self._stress_entries.variables
        dofs = self._stress_entries.dofs
        for each in self._state_lags:
            blocks.append(
                EntryBlock(self._position_columns(each, dofs), self._memory_columns(each, own))
            )
        return blocks

    @property
    def entry_counts(self) -> tuple[int, int]:
        groups = self._jacobian_blocks(), self._hessian_blocks()
        return sum(each.entry_count for each in groups[0]), sum(
            each.entry_count for each in groups[1]
        )

    def jacobian_values(self, iterate: ExperimentIterate, z: Array) -> tuple[Array, Array]:
        history = _body_history(iterate)
        memory = iterate.transcription.body.memory
        after = self.shape[0] - 1, self.shape[1]
        fading = np.broadcast_to(memory.repeat_over_points(-history.fading.d[:, 1:-1]), after)
        values = [
            self._parameter_derivatives(
                history, iterate.equations.theta_p[:, : iterate.equations.nq]
            ),
            np.ones(self.count),
            fading,
        ]
        values += self._stress_derivatives(history)
        for moved in self._motion_entries:
            values += self._force_derivatives(history, moved)
        rows = (history.compute_recursion_residuals() / self.unit_pa).ravel()
        return rows, np.concatenate([each.ravel() for each in values])

    def _parameter_derivatives(self, history: MemoryHistory, theta_q: Array) -> Array:
        """Return derivatives (nq, N − 1, width) of the scaled r by q, from `theta_q` (k, nq)."""
        memory = history.body.memory
        derivatives = np.empty((theta_q.shape[1], *self.shape))
        d_q, a_q = (
            memory.repeat_over_points(np.moveaxis(e, 1, 0))
            for e in history.fading.jacobian_vector_product(theta_q)
        )
        a = memory.repeat_over_points(history.fading.a)
        for rows, slopes in history.stress_derivatives(theta_q):
            rows = slice(rows.start, min(rows.stop, self.shape[0]))
            change = d_q[:, rows] * history.previous_variables[rows]
            change += a_q[:, rows] * memory.to_branches(history.stress[rows])
            by_modulus = np.moveaxis(memory.to_branches(slopes[: rows.stop - rows.start]), 1, 0)
            derivatives[:, rows] = -(change + a[rows] * by_modulus)
        return derivatives / self.unit_pa

    def _stress_derivatives(self, history: MemoryHistory) -> list[Array]:
        """Return derivatives of the scaled r by scaled positions, (T, K) for each stress lag."""
        entries = self._stress_entries
        scale = -self.transcription.length_m / self.unit_pa[entries.variables]
        a = history.fading.a.T

        def slopes(times: slice) -> Array:
            derivatives = history.body.stresses.stress_jacobian(history.xi[times], history.theta)
            selected = derivatives[:, entries.positions]
            return selected * a[times, entries.branches] * scale

        return self._scaled_by_lag(self._stress_lags, slopes)

    def _force_derivatives(self, history: MemoryHistory, changes: _MotionEntries) -> list[Array]:
        """Return derivatives of the scaled motion by m, (T, K) for each lag; 0 if prescribed."""
        positions, own, dofs, _ = (
            each[changes.derivative_indices] for each in self._stress_entries
        )
        scale = self.unit_pa[own] / self.transcription.force_n
        is_prescribed = self.transcription.dynamics.is_temporarily_prescribed

        def slopes(times: slice) -> Array:
            scaled = history.body.stresses.memory_force_jacobian(history.xi[times], history.theta)
            return np.where(
                changes.rows.omits_prescribed & is_prescribed[times, dofs],
                0.0,
                scaled[:, positions] * scale,
            )

        scaled = self._scaled_by_lag(self._force_lags, slopes)
        for each, values in zip(self._force_lags, scaled, strict=True):
            is_prescribed_later = is_prescribed[each.start + each.lag : each.stop + each.lag, dofs]
            values[changes.rows.omits_prescribed & is_prescribed_later] = 0.0
        return scaled

    def hessian_values(
        self,
        iterate: ExperimentIterate,
        z: Array,
        loss_weight: float,
        multipliers: Array,
        weights: RowWeights,
    ) -> Array:
        transcription = self.transcription
        history = _body_history(iterate)
        theta_q = iterate.equations.theta_p[:, : iterate.equations.nq]
        d_q = history.body.memory.repeat_over_points(
            np.moveaxis(history.fading.jacobian_vector_product(theta_q)[0], 1, 0)
        )
        by_q = d_q[:, 1:] * self._history_weights(multipliers)[1:] * self.unit_pa
        entries = self._stress_entries
        scale = transcription.length_m * self.unit_pa[entries.variables]

        # f_H is linear in x and in H, so that its derivative by both is that by H at the weights.
        def slopes(times: slice) -> Array:
            derivatives = transcription.body.stresses.memory_force_jacobian(
                weights.forces[times], history.theta
            )
            return derivatives[:, entries.positions] * scale

        values = [by_q, *self._scaled_by_lag(self._state_lags, slopes)]
        return np.concatenate([each.ravel() for each in values])

    @staticmethod
    def _scaled_by_lag(lags: list[_Lag], derivatives: Callable[[slice], Array]) -> list[Array]:
        """Return derivatives of evaluations times the stencil's factors, (T, K) for each lag."""
        scaled: list[Array] = []
        first = min(each.start for each in lags)
        last = max(each.stop for each in lags)
        for start in range(first, last, EVALUATIONS_PER_CHUNK):
            stop = min(start + EVALUATIONS_PER_CHUNK, last)
            own = derivatives(slice(start, stop))
            scaled = scaled or [np.empty((e.stop - e.start, own.shape[1])) for e in lags]
            for each, values in zip(lags, scaled, strict=True):
                low = max(start, each.start)
                high = min(stop, each.stop)
                if high > low:
                    here = slice(low - each.start, high - each.start)
                    factors = each.factors[low:high, None]
                    np.multiply(own[low - start : high - start], factors, out=values[here])
        return scaled


def _body_history(iterate: ExperimentIterate) -> MemoryHistory:
    history = iterate.histories[0]
    assert isinstance(history, MemoryHistory)
    return history
