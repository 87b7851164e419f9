"""What the points of one body carry as variables, and its recursion as equations.

Of evaluations k = 1 … N − 1 and all branches, in scaled quantities,

    r_k = (m_{k−1} − d_{k−1} m_{k−2} − a_{k−1} S_{k−1}) / S̄,   variables m_{k−1} / S̄,

see `memory`; m_{−1} is zero, and S̄ the branch's S, long-term, of a strain of one. r_k has the
entries ∂S/∂x of one evaluation, the motion those ∂f_H/∂H of another, and of second derivatives only
those by x and m are further entries: 18 numbers of a point and node each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Index
from ..fem.memory import Branch
from ..model.setting import Setting
from ..model.viscoelasticity import CHUNK, History
from .carried import Carried
from .part import Part
from .reaction_rows import Reactions
from .segment import RowWeights


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
    """Rows of motion: of which slopes (K,), what number each has at its time, and where all begin.

    `taken` (N, 3n) says of which dofs no force counts.
    """

    slopes: Index
    number: Index
    first: int
    per_time: int
    taken: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Overstress(Carried):
    """The m of one experiment, of a body with memory.

    Attributes
    ----------
    reactions : Reactions, optional
        Further rows of motion, where the program has them.
    """

    reactions: Reactions | None = None

    @cached_property
    def branches(self) -> list[Branch]:
        """Those of the body."""
        return self.segment.body.memory.branches

    @property
    def width(self) -> int:
        """How many numbers all branches carry."""
        return self.branches[-1].own.stop

    @property
    def shape(self) -> tuple[int, int]:
        """Evaluations that bring something, and what."""
        return self.segment.grid_rows - 1, self.width

    @property
    def count(self) -> int:
        """Number of variables, and of equations."""
        return self.shape[0] * self.shape[1]

    @cached_property
    def unit_pa(self) -> Array:
        """(width,) S̄: the normal entries of dS/dε of an even stretch, on average over the part."""
        segment, body = self.segment, self.segment.body
        theta = segment.constants.theta(segment.parameters.guess_q)
        rest = body.nodes_m.reshape(1, -1)
        change = np.abs(body.stresses.along(rest, rest, theta)[0])
        units = np.empty(self.width)
        for branch in self.branches:
            of_points = change[branch.points]
            units[branch.own] = of_points[: len(of_points) // 2].mean()
        return units

    # Values -------------------------------------------------------------------------------------

    def following(self, part: Part) -> Array:
        """(count,) the variables as they follow from positions and parameters."""
        return (np.hstack(self._history(part).brought)[1:] / self.unit_pa).ravel()

    def given(self, part: Part, z: Array) -> Part:
        """The experiment with m_{k−1} (N, width) at z, as `Dynamics` takes it."""
        later = z[self.variables].reshape(self.shape) * self.unit_pa
        return replace(part, brought=np.concatenate([np.zeros((1, self.width)), later]))

    def values(self, part: Part, z: Array) -> Array:
        """(count,) r at the m of the setting."""
        return (self._history(part).gaps / self.unit_pa).ravel()

    def memory_weights(self, multipliers: Array) -> list[Array]:
        """μ (N, …) of each branch such that multipliers · r has −Σ μ_k (m_k − d_k m_{k−1} − …)."""
        mu = np.zeros((self.segment.grid_rows, self.width))
        mu[:-1] = -multipliers[self.rows].reshape(self.shape) / self.unit_pa
        return [mu[:, branch.own] for branch in self.branches]

    def _history(self, part: Part) -> History:
        history = part.setting.dynamics.history(part.x)
        assert history is not None
        return history

    # Entries ------------------------------------------------------------------------------------

    @cached_property
    def _slopes(self) -> tuple[Index, Index, Index, Index]:
        """Of the entries of slopes, branch after branch: place, variable, dof and branch."""
        entries = self.segment.body.stresses.slope_entries
        found = []
        for number, branch in enumerate(self.branches):
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
        segment, dofs = self.segment, self._slopes[2]
        free = np.flatnonzero(np.isin(dofs, segment.free_dofs))
        number = np.searchsorted(segment.row_dofs, dofs[free])
        taken = segment.dynamics.taken
        found = [_Moved(free, number, segment.first.row, segment.rows_per_time, taken)]
        if self.reactions is not None:
            sensed = np.flatnonzero(np.isin(dofs, self.reactions.dofs))
            number = np.searchsorted(self.reactions.dofs, dofs[sensed])
            first, count = self.reactions.places.row, self.reactions.shape[1]
            found.append(_Moved(sensed, number, first, count, np.zeros_like(taken)))
        return found

    @cached_property
    def _stress_lags(self) -> list[_Lag]:
        """Of S_k by x_{k−lag}; the last is of no equation."""
        table = self.segment.dynamics.state_weights
        lags = [_Lag(i, i, self.shape[0], table[:, i]) for i in range(table.shape[1])]
        return [each for each in lags if each.factors.any()]

    @cached_property
    def _state_lags(self) -> list[_Lag]:
        """Of forces at k, where there is something brought, by x_{k−lag}."""
        table, count = self.segment.dynamics.tables.p, self.segment.grid_rows
        lags = [_Lag(i, max(i, self._first), count, table[:, i]) for i in range(table.shape[1])]
        return [each for each in lags if each.factors.any()]

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

    def _brought(self, each: _Lag, own: Index) -> Index:
        """Places in z of what the evaluations bring, (T · K,)."""
        return (self.places.variable + (each.times - 1) * self.width + own).ravel()

    def _states(self, each: _Lag, dofs: Index) -> Index:
        """Places in z of the positions at their lag, (T · K,)."""
        first = self.segment.first.x
        return (first + (each.times - each.lag) * self.segment.dofs + dofs).ravel()

    @property
    def nonzeros(self) -> tuple[int, int]:
        """How many further entries Jacobian and Hessian have, without laying them out."""
        per_time, (rows, width) = len(self._slopes[0]), self.shape
        by_x, by_m, mixed = (
            sum(each.stop - each.start for each in lags)
            for lags in (self._stress_lags, self._force_lags, self._state_lags)
        )
        by_q = self.segment.nq * self.count
        recursion = (2 * rows - 1) * width
        jacobian = (
            by_q
            + recursion
            + by_x * per_time
            + by_m * sum(len(each.slopes) for each in self._moved)
        )
        return jacobian, by_q + mixed * per_time

    def jacobian_entries(self) -> tuple[Index, Index]:
        """Rows and columns of the further entries of ∂g/∂z, in the order of their values."""
        segment, nq = self.segment, self.segment.nq
        _, own, dofs, _ = self._slopes
        equations = np.arange(self.rows.start, self.rows.stop)
        variables = np.arange(self.variables.start, self.variables.stop)
        # r by q, by m_{k−1} and by m_{k−2}
        rows = [np.tile(equations, nq), equations, equations[self.width :]]
        columns = [np.repeat(np.arange(nq), self.count), variables, variables[: -self.width]]
        for each in self._stress_lags:
            rows.append((self.places.row + each.times * self.width + own).ravel())
            columns.append(self._states(each, dofs))
        for moved in self._moved:
            for each in self._force_lags:
                of_time = each.times + each.lag - segment.dynamics.first_row
                rows.append((moved.first + of_time * moved.per_time + moved.number).ravel())
                columns.append(self._brought(each, own[moved.slopes]))
        return np.concatenate(rows), np.concatenate(columns)

    def jacobian_values(self, part: Part, z: Array) -> tuple[Array, Array]:
        """r, and the values of these entries."""
        history, setting = self._history(part), part.setting
        sizes = [branch.own.stop - branch.own.start for branch in self.branches]
        fading = -np.repeat([r.d[1:-1] for r in history.recursions], sizes, axis=0).T
        values = [self._by_q(history, setting).ravel(), np.ones(self.count), fading.ravel()]
        values += self._stress_values(history)
        for moved in self._moved:
            values += self._force_values(history, moved)
        return (history.gaps / self.unit_pa).ravel(), np.concatenate(values)

    def _by_q(self, history: History, setting: Setting) -> Array:
        """Of r by q, (nq, N − 1, width)."""
        found = np.empty((self.segment.nq, *self.shape))
        theta_q, stresses = setting.theta_q, history.body.stresses
        for start in range(0, self.shape[0], CHUNK):
            rows = slice(start, min(start + CHUNK, self.shape[0]))
            slopes = stresses.stress_by(history.xi[rows], history.theta, theta_q)
            for r, m in zip(history.recursions, history.brought, strict=True):
                points, own = r.branch.points, theta_q[[r.branch.share, r.branch.tau]].T
                change = np.einsum("qt,tp->qtp", own @ r.by[1][:, rows], m[rows])
                stress = history.stress[rows, points]
                change += np.einsum("qt,tp->qtp", own @ r.by[2][:, rows], stress)
                change += np.einsum("t,tqp->qtp", r.a[rows], slopes[:, :, points])
                found[:, rows, r.branch.own] = -change
        return found / self.unit_pa

    def _stress_values(self, history: History) -> list[Array]:
        """Of r by x."""
        place, own, _, number = self._slopes
        scale = -self.segment.length_m / self.unit_pa[own]
        a = np.stack([r.a for r in history.recursions], axis=1)

        def slopes(times: slice) -> Array:
            found = history.body.stresses.stress_slopes(history.xi[times], history.theta)
            return found[:, place] * a[times, number] * scale

        return [values.ravel() for values in self._spread(self._stress_lags, slopes)]

    def _force_values(self, history: History, moved: _Moved) -> list[Array]:
        """Of the motion by m."""
        place, own, dofs, _ = (each[moved.slopes] for each in self._slopes)
        scale, taken = self.unit_pa[own] / self.segment.force_n, moved.taken

        def slopes(times: slice) -> Array:
            found = history.body.stresses.force_slopes(history.xi[times], history.theta)
            return np.where(taken[times, dofs], 0.0, found[:, place] * scale)

        found = self._spread(self._force_lags, slopes)
        for each, values in zip(self._force_lags, found, strict=True):
            values[taken[each.start + each.lag : each.stop + each.lag, dofs]] = 0.0
        return [values.ravel() for values in found]

    def hessian_entries(self) -> tuple[Index, Index]:
        """The same of the upper triangle of the Lagrangian's Hessian, in the columns of m."""
        nq, (_, own, dofs, _) = self.segment.nq, self._slopes
        variables = np.arange(self.variables.start, self.variables.stop)
        rows, columns = [np.repeat(np.arange(nq), self.count)], [np.tile(variables, nq)]
        for each in self._state_lags:
            rows.append(self._states(each, dofs))
            columns.append(self._brought(each, own))
        return np.concatenate(rows), np.concatenate(columns)

    def hessian_values(
        self, part: Part, z: Array, loss_weight: float, multipliers: Array, weights: RowWeights
    ) -> Array:
        """The values of these entries; multipliers are those of all of g."""
        segment, setting = self.segment, part.setting
        theta_q = setting.theta_q
        by_q = np.zeros((segment.nq, *self.shape))
        recursions = setting.dynamics.recursions
        for r, mu in zip(recursions, self.memory_weights(multipliers), strict=True):
            fading = theta_q[[r.branch.share, r.branch.tau]].T @ r.by[1][:, 1:]
            by_q[:, :, r.branch.own] = np.einsum("qt,tp->qtp", fading, mu[1:])
        place, own, _, _ = self._slopes
        scale = segment.length_m * self.unit_pa[own]
        # f_H is linear in x and in H, so that its slope by both is that by H at the weights.

        def slopes(times: slice) -> Array:
            found = segment.body.stresses.force_slopes(weights.forces[times], setting.theta)
            return found[:, place] * scale

        found = [by_q * self.unit_pa, *self._spread(self._state_lags, slopes)]
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
