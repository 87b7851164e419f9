"""What the points of one body carry as variables, and its recursion as equations.

Of evaluations k = 1 … N − 1 and all branches, in scaled quantities,

    r_k = (m_{k−1} − d_{k−1} m_{k−2} − a_{k−1} S_{k−1}) / S̄,   variables m_{k−1} / S̄,

see `model.viscoelasticity`; m_{−1} is zero, and S̄ the branch's S, long-term, of a strain of one.
r_k has the entries ∂S/∂x of one evaluation, the motion those ∂f_H/∂H of another, and of second
derivatives only those by x and m are further entries: 18 numbers of a point and node each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..arrays import Array, Index
from ..model.viscoelasticity import CHUNK, History
from .carried import Carried, together
from .entries import Outer
from .part import Part
from .reaction_rows import Reactions, RowsOfMotion, rows_of_motion
from .segment import RowWeights, Weighed


@dataclass(frozen=True, eq=False)
class _Lag:
    """Entries of evaluations `start` … `stop` − 1 at one lag of a stencil.

    `factors` (N,) are its coefficients, by evaluation.
    """

    lag: int
    start: int
    stop: int
    factors: Array

    @property
    def times(self) -> Index:
        """(T, 1) the evaluations."""
        return np.arange(self.start, self.stop)[:, None]


@dataclass(frozen=True, eq=False)
class _Moved:
    """Rows of motion: of which slopes (K,), and what number each has at its time."""

    slopes: Index
    number: Index
    rows: RowsOfMotion


@dataclass(frozen=True, eq=False)
class Overstress(Carried):
    """The m of one experiment, of a body with memory.

    Attributes
    ----------
    reactions : Reactions, optional
        Further rows of motion, where the program has them.
    """

    reactions: Reactions | None = None
    called = "memory"

    @property
    def shape(self) -> tuple[int, int]:
        """Evaluations that bring something, and how many numbers all branches carry."""
        return self.segment.grid_rows - 1, self.segment.body.memory.branches[-1].own.stop

    @cached_property
    def unit_pa(self) -> Array:
        """(width,) S̄: the normal entries of dS/dε of an even stretch, on average over the part."""
        segment, body = self.segment, self.segment.body
        theta = segment.constants.theta(segment.parameters.guess_q)
        rest, memory = body.nodes_m.reshape(1, -1), body.memory
        change = np.abs(body.stresses.along(rest, rest, theta)[0])
        normal = [
            change[b.points][: (b.points.stop - b.points.start) // 2] for b in memory.branches
        ]
        means = np.array([each.mean() for each in normal])
        return np.broadcast_to(memory.spread(means), self.shape[1:])

    # Values -------------------------------------------------------------------------------------

    def following(self, part: Part) -> Array:
        """(count,) the variables as they follow from positions and parameters."""
        return (_history(part).brought[1:] / self.unit_pa).ravel()

    def given(self, part: Part, z: Array) -> Part:
        """The experiment with m_{k−1} (N, width) at z."""
        later = z[self.variables].reshape(self.shape) * self.unit_pa
        brought = np.concatenate([np.zeros((1, self.shape[1])), later])
        return replace(part, brought={**part.brought, self.history: brought})

    def values(self, part: Part, z: Array) -> Array:
        """(count,) r at the m of the experiment."""
        return (_history(part).gaps / self.unit_pa).ravel()

    @property
    def history(self) -> int:
        """That of the body comes first."""
        return 0

    def weighed(self, part: Part, multipliers: Array) -> Weighed:
        """And μ (N, …) such that multipliers · r has −Σ μ_k (m_k − d_k m_{k−1} − …)."""
        return _history(part), self._mu(multipliers)

    def _mu(self, multipliers: Array) -> Array:
        mu = -multipliers[self.rows].reshape(self.shape) / self.unit_pa
        return np.concatenate([mu, np.zeros((1, self.shape[1]))])

    # Entries ------------------------------------------------------------------------------------

    @cached_property
    def _slopes(self) -> tuple[Index, Index, Index, Index]:
        """Of the entries of slopes, branch after branch: place, variable, dof and branch."""
        entries, found = self.segment.body.stresses.slope_entries, []
        for number, branch in enumerate(self.segment.body.memory.branches):
            points = branch.points
            here = (entries.points >= points.start) & (entries.points < points.stop)
            places = np.flatnonzero(here)
            own = entries.points[places] - points.start + branch.own.start
            found.append((places, own, entries.dofs[places], np.full(len(places), number)))
        place, own, dof, number = (np.concatenate(each) for each in zip(*found, strict=True))
        return place, own, dof, number

    @cached_property
    def _moved(self) -> list[_Moved]:
        """Rows of motion that m is in, and by which slopes."""
        found, dofs = [], self._slopes[2]
        for rows in rows_of_motion(self.segment, self.reactions):
            slopes = np.flatnonzero(rows.number[dofs] >= 0)
            found.append(_Moved(slopes, rows.number[dofs[slopes]], rows))
        return found

    @cached_property
    def _stress_lags(self) -> list[_Lag]:
        """Of S_k by x_{k−lag}; the last is of no equation."""
        return self._lags(self.segment.dynamics.state_weights, 0, self.shape[0])

    @cached_property
    def _state_lags(self) -> list[_Lag]:
        """Of forces at k, where there is something brought, by x_{k−lag}."""
        return self._lags(self.segment.dynamics.tables.p, self._first, self.segment.grid_rows)

    @staticmethod
    def _lags(table: Array, first: int, stop: int) -> list[_Lag]:
        columns = enumerate(table.T)
        return [_Lag(lag, max(lag, first), stop, column) for lag, column in columns if column.any()]

    @cached_property
    def _force_lags(self) -> list[_Lag]:
        """Of c_{k+lag} by those forces."""
        table, count = self.segment.dynamics.tables.w, self.segment.grid_rows
        lags = [_Lag(j, self._first, count - j, table[j:, j]) for j in range(table.shape[1])]
        return [each for each in lags if each.factors.any()]

    @property
    def _first(self) -> int:
        """The first evaluation of a force to which something is brought."""
        return max(1, self.segment.dynamics.first_row)

    def _brought(self, each: _Lag, own: Index) -> list[Index | int]:
        """Places in z of what the evaluations bring, (T, K)."""
        return [self.places.variable, (each.times - 1) * self.shape[1], own]

    def _states(self, each: _Lag, dofs: Index) -> list[Index | int]:
        """Places in z of the positions at their lag, (T, K)."""
        return [self.segment.first.x, (each.times - each.lag) * self.segment.dofs, dofs]

    def _jacobian(self) -> list[Outer]:
        """Of r by q, by m_{k−1}, by m_{k−2} and by x, and of the motion by m."""
        _, own, dofs, _ = self._slopes
        equations, variables = (np.arange(s.start, s.stop) for s in (self.rows, self.variables))
        found = [
            Outer([equations], [np.arange(self.segment.nq)[:, None]]),
            Outer([equations], [variables]),
            Outer([equations[self.shape[1] :]], [variables[: -self.shape[1]]]),
        ]
        for each in self._stress_lags:
            rows = [self.places.row, each.times * self.shape[1], own]
            found.append(Outer(rows, self._states(each, dofs)))
        for moved in self._moved:
            for each in self._force_lags:
                late = each.times + each.lag - self.segment.dynamics.first_row
                rows = [moved.rows.first, late * moved.rows.per_time, moved.number]
                found.append(Outer(rows, self._brought(each, own[moved.slopes])))
        return found

    def _hessian(self) -> list[Outer]:
        """In the columns of m: by q, and by x."""
        variables = np.arange(self.variables.start, self.variables.stop)
        found = [Outer([np.arange(self.segment.nq)[:, None]], [variables])]
        _, own, dofs, _ = self._slopes
        for each in self._state_lags:
            found.append(Outer(self._states(each, dofs), self._brought(each, own)))
        return found

    def jacobian_entries(self) -> tuple[Index, Index]:
        """Rows and columns of the further entries of ∂g/∂z, in the order of their values."""
        return together(each.laid_out() for each in self._jacobian())

    def hessian_entries(self) -> tuple[Index, Index]:
        """The same of the upper triangle of the Lagrangian's Hessian."""
        return together(each.laid_out() for each in self._hessian())

    @property
    def nonzeros(self) -> tuple[int, int]:
        """How many these are, without laying them out."""
        groups = self._jacobian(), self._hessian()
        return sum(each.count for each in groups[0]), sum(each.count for each in groups[1])

    def jacobian_values(self, part: Part, z: Array) -> tuple[Array, Array]:
        """r, and the values of these entries."""
        history, memory = _history(part), part.segment.body.memory
        after = self.shape[0] - 1, self.shape[1]
        fading = np.broadcast_to(memory.spread(-history.fading.d[:, 1:-1]), after)
        values = [self._by_q(history, part.setting.theta_q), np.ones(self.count), fading]
        values += self._stress_values(history)
        for moved in self._moved:
            values += self._force_values(history, moved)
        rows = (history.gaps / self.unit_pa).ravel()
        return rows, np.concatenate([each.ravel() for each in values])

    def _by_q(self, history: History, theta_q: Array) -> Array:
        """Of r by q, (nq, N − 1, width)."""
        memory, found = history.memory, np.empty((theta_q.shape[1], *self.shape))
        d_q, a_q = (memory.spread(np.moveaxis(e, 1, 0)) for e in history.fading.along(theta_q))
        a = memory.spread(history.fading.a)
        for rows, slopes in history.stress_by(theta_q):
            rows = slice(rows.start, min(rows.stop, self.shape[0]))
            change = d_q[:, rows] * history.brought[rows]
            change += a_q[:, rows] * memory.borne(history.stress[rows])
            by_modulus = np.moveaxis(memory.borne(slopes[: rows.stop - rows.start]), 1, 0)
            found[:, rows] = -(change + a[rows] * by_modulus)
        return found / self.unit_pa

    def _stress_values(self, history: History) -> list[Array]:
        """Of r by x."""
        place, own, _, number = self._slopes
        scale, a = -self.segment.length_m / self.unit_pa[own], history.fading.a.T

        def slopes(times: slice) -> Array:
            found = history.body.stresses.stress_slopes(history.xi[times], history.theta)
            return found[:, place] * a[times, number] * scale

        return self._spread(self._stress_lags, slopes)

    def _force_values(self, history: History, moved: _Moved) -> list[Array]:
        """Of the motion by m."""
        place, own, dofs, _ = (each[moved.slopes] for each in self._slopes)
        scale, taken = self.unit_pa[own] / self.segment.force_n, self.segment.dynamics.taken

        def slopes(times: slice) -> Array:
            found = history.body.stresses.force_slopes(history.xi[times], history.theta)
            return np.where(moved.rows.taken & taken[times, dofs], 0.0, found[:, place] * scale)

        found = self._spread(self._force_lags, slopes)
        for each, values in zip(self._force_lags, found, strict=True):
            late = taken[each.start + each.lag : each.stop + each.lag, dofs]
            values[moved.rows.taken & late] = 0.0
        return found

    def hessian_values(
        self, part: Part, z: Array, loss_weight: float, multipliers: Array, weights: RowWeights
    ) -> Array:
        """The values of these entries; multipliers are those of all of g."""
        segment, history, theta_q = self.segment, _history(part), part.setting.theta_q
        d_q = history.memory.spread(np.moveaxis(history.fading.along(theta_q)[0], 1, 0))
        by_q = d_q[:, 1:] * self._mu(multipliers)[1:] * self.unit_pa
        place, own, _, _ = self._slopes
        scale = segment.length_m * self.unit_pa[own]
        # f_H is linear in x and in H, so that its slope by both is that by H at the weights.

        def slopes(times: slice) -> Array:
            found = segment.body.stresses.force_slopes(weights.forces[times], history.theta)
            return found[:, place] * scale

        found = [by_q, *self._spread(self._state_lags, slopes)]
        return np.concatenate([each.ravel() for each in found])

    @staticmethod
    def _spread(lags: list[_Lag], slopes: Callable[[slice], Array]) -> list[Array]:
        """Slopes of evaluations times the factors, (T, K) of each lag; a few at a time."""
        found: list[Array] = []
        first, last = min(each.start for each in lags), max(each.stop for each in lags)
        for start in range(first, last, CHUNK):
            stop = min(start + CHUNK, last)
            own = slopes(slice(start, stop))
            found = found or [np.empty((e.stop - e.start, own.shape[1])) for e in lags]
            for each, values in zip(lags, found, strict=True):
                low, high = max(start, each.start), min(stop, each.stop)
                if high > low:
                    here = slice(low - each.start, high - each.start)
                    factors = each.factors[low:high, None]
                    np.multiply(own[low - start : high - start], factors, out=values[here])
        return found


def _history(part: Part) -> History:
    history = part.along[0]
    assert isinstance(history, History)
    return history
