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

    Attributes
    ----------
    lag : int
        Number of grid times before the evaluation.
    start, stop : int
        Range of the evaluations.
    factors : (N,) array
        Coefficients of the stencil, by evaluation.
    """

    lag: int
    start: int
    stop: int
    factors: Array

    @property
    def times(self) -> Index:
        """Indices (T, 1) of the evaluations."""
        return np.arange(self.start, self.stop)[:, None]


@dataclass(frozen=True, eq=False)
class _Moved:
    """Entries of one set of equations of motion that contain the memory.

    Attributes
    ----------
    slopes : (K,) array
        Indices of the derivatives.
    number : (K,) array
        Index of the row of each within its grid time.
    rows : RowsOfMotion
        The equations.
    """

    slopes: Index
    number: Index
    rows: RowsOfMotion


@dataclass(frozen=True, eq=False)
class Overstress(Carried):
    """Lifted history variables m of a viscoelastic body.

    Attributes
    ----------
    reactions : Reactions or None
        Lifted reaction forces, whose equations also contain the memory; None if the program has
        none.
    """

    reactions: Reactions | None = None
    called = "memory"

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (N − 1, width): evaluations with a past, and history variables of all branches."""
        return self.segment.grid_rows - 1, self.segment.body.memory.branches[-1].own.stop

    @cached_property
    def unit_pa(self) -> Array:
        """Unit (width,) of the history variables [Pa]: normal entries of dS/dε of a uniform
        stretch, averaged over the part.
        """
        segment = self.segment
        body = self.segment.body
        theta = segment.constants.theta(segment.parameters.guess_q)
        rest = body.nodes_m.reshape(1, -1)
        memory = body.memory
        change = np.abs(body.stresses.along(rest, rest, theta)[0])
        normal = [
            change[b.points][: (b.points.stop - b.points.start) // 2] for b in memory.branches
        ]
        means = np.array([each.mean() for each in normal])
        return np.broadcast_to(memory.spread(means), self.shape[1:])

    # Values -------------------------------------------------------------------------------------

    def following(self, part: Part) -> Array:
        """Return the scaled variables (count,) that satisfy the recursion at the part's
        positions and parameters.
        """
        return (_history(part).brought[1:] / self.unit_pa).ravel()

    def given(self, part: Part, z: Array) -> Part:
        """Return the part with the history variables (N, width) taken from z."""
        later = z[self.variables].reshape(self.shape) * self.unit_pa
        memory = np.concatenate([np.zeros((1, self.shape[1])), later])
        return replace(part, brought={**part.brought, self.history: memory})

    def values(self, part: Part, z: Array) -> Array:
        """Return the scaled equations r (count,) at the history variables of the part."""
        return (_history(part).gaps / self.unit_pa).ravel()

    @property
    def history(self) -> int:
        """Index of the history: that of the body is the first."""
        return 0

    def weighed(self, part: Part, multipliers: Array) -> Weighed:
        """Return the history and its weights in the Lagrangian.

        Returns
        -------
        (History, (N, width) array)
            The history, and μ such that multipliers · r = −Σ μ_k (m_k − d_k m_{k−1} − a_k S_k).
        """
        return _history(part), self._mu(multipliers)

    def _mu(self, multipliers: Array) -> Array:
        """Return μ (N, width), see `weighed`; zero at the last evaluation."""
        mu = -multipliers[self.rows].reshape(self.shape) / self.unit_pa
        return np.concatenate([mu, np.zeros((1, self.shape[1]))])

    # Entries ------------------------------------------------------------------------------------

    @cached_property
    def _slopes(self) -> tuple[Index, Index, Index, Index]:
        """Index arrays of the stress derivatives of all branches: entry, variable, dof and
        branch.
        """
        entries = self.segment.body.stresses.slope_entries
        index_arrays = []
        for number, branch in enumerate(self.segment.body.memory.branches):
            points = branch.points
            in_branch = (entries.points >= points.start) & (entries.points < points.stop)
            places = np.flatnonzero(in_branch)
            own = entries.points[places] - points.start + branch.own.start
            index_arrays.append((places, own, entries.dofs[places], np.full(len(places), number)))
        place, own, dof, number = (np.concatenate(each) for each in zip(*index_arrays, strict=True))
        return place, own, dof, number

    @cached_property
    def _moved(self) -> list[_Moved]:
        """Equations of motion that contain the memory."""
        entries = []
        dofs = self._slopes[2]
        for rows in rows_of_motion(self.segment, self.reactions):
            slopes = np.flatnonzero(rows.number[dofs] >= 0)
            entries.append(_Moved(slopes, rows.number[dofs[slopes]], rows))
        return entries

    @cached_property
    def _stress_lags(self) -> list[_Lag]:
        """Lags of S_k by x_{k−lag}; the last evaluation has no equation."""
        return self._lags(self.segment.dynamics.state_weights, 0, self.shape[0])

    @cached_property
    def _state_lags(self) -> list[_Lag]:
        """Lags of forces at evaluation k with a past by x_{k−lag}."""
        return self._lags(self.segment.dynamics.tables.p, self._first, self.segment.grid_rows)

    @staticmethod
    def _lags(table: Array, first: int, stop: int) -> list[_Lag]:
        """Return the lags of a stencil table (N, lags) with non-zero coefficients, for a
        range of evaluations.
        """
        columns = enumerate(table.T)
        return [_Lag(lag, max(lag, first), stop, column) for lag, column in columns if column.any()]

    @cached_property
    def _force_lags(self) -> list[_Lag]:
        """Lags of c_{k+lag} by the forces at evaluation k."""
        table = self.segment.dynamics.tables.w
        count = self.segment.grid_rows
        lags = [_Lag(j, self._first, count - j, table[j:, j]) for j in range(table.shape[1])]
        return [each for each in lags if each.factors.any()]

    @property
    def _first(self) -> int:
        """Index of the first evaluation whose force depends on history variables."""
        return max(1, self.segment.dynamics.first_row)

    def _brought(self, each: _Lag, own: Index) -> list[Index | int]:
        """Return summands of the columns (T, K) in z of history variables."""
        return [self.places.variable, (each.times - 1) * self.shape[1], own]

    def _states(self, each: _Lag, dofs: Index) -> list[Index | int]:
        """Return summands of the columns (T, K) in z of positions."""
        return [self.segment.first.x, (each.times - each.lag) * self.segment.dofs, dofs]

    def _jacobian(self) -> list[Outer]:
        """Return the entries of r by q, by m_{k−1}, by m_{k−2} and by x, then those of the
        motion by m.
        """
        _, own, dofs, _ = self._slopes
        equations, variables = (np.arange(s.start, s.stop) for s in (self.rows, self.variables))
        blocks = [
            Outer([equations], [np.arange(self.segment.nq)[:, None]]),
            Outer([equations], [variables]),
            Outer([equations[self.shape[1] :]], [variables[: -self.shape[1]]]),
        ]
        for each in self._stress_lags:
            rows = [self.places.row, each.times * self.shape[1], own]
            blocks.append(Outer(rows, self._states(each, dofs)))
        for moved in self._moved:
            for each in self._force_lags:
                row_times = each.times + each.lag - self.segment.dynamics.first_row
                rows = [moved.rows.first, row_times * moved.rows.per_time, moved.number]
                blocks.append(Outer(rows, self._brought(each, own[moved.slopes])))
        return blocks

    def _hessian(self) -> list[Outer]:
        """Return the Hessian's entries in the columns of m: by q, then by x."""
        variables = np.arange(self.variables.start, self.variables.stop)
        blocks = [Outer([np.arange(self.segment.nq)[:, None]], [variables])]
        _, own, dofs, _ = self._slopes
        for each in self._state_lags:
            blocks.append(Outer(self._states(each, dofs), self._brought(each, own)))
        return blocks

    def jacobian_entries(self) -> tuple[Index, Index]:
        """Return rows and columns of the additional entries of ∂g/∂z, in the order of their
        values.
        """
        return together(each.laid_out() for each in self._jacobian())

    def hessian_entries(self) -> tuple[Index, Index]:
        """Return rows and columns of the additional entries of the Lagrangian's Hessian,
        upper triangle.
        """
        return together(each.laid_out() for each in self._hessian())

    @property
    def nonzeros(self) -> tuple[int, int]:
        """Numbers of additional entries of Jacobian and Hessian, computed without index arrays."""
        groups = self._jacobian(), self._hessian()
        return sum(each.count for each in groups[0]), sum(each.count for each in groups[1])

    def jacobian_values(self, part: Part, z: Array) -> tuple[Array, Array]:
        """Return the equations r, and the values of `jacobian_entries`."""
        history = _history(part)
        memory = part.segment.body.memory
        after = self.shape[0] - 1, self.shape[1]
        fading = np.broadcast_to(memory.spread(-history.fading.d[:, 1:-1]), after)
        values = [self._by_q(history, part.setting.theta_q), np.ones(self.count), fading]
        values += self._stress_values(history)
        for moved in self._moved:
            values += self._force_values(history, moved)
        rows = (history.gaps / self.unit_pa).ravel()
        return rows, np.concatenate([each.ravel() for each in values])

    def _by_q(self, history: History, theta_q: Array) -> Array:
        """Return the derivatives of r by q, (nq, N − 1, width)."""
        memory = history.memory
        derivatives = np.empty((theta_q.shape[1], *self.shape))
        d_q, a_q = (memory.spread(np.moveaxis(e, 1, 0)) for e in history.fading.along(theta_q))
        a = memory.spread(history.fading.a)
        for rows, slopes in history.stress_by(theta_q):
            rows = slice(rows.start, min(rows.stop, self.shape[0]))
            change = d_q[:, rows] * history.brought[rows]
            change += a_q[:, rows] * memory.borne(history.stress[rows])
            by_modulus = np.moveaxis(memory.borne(slopes[: rows.stop - rows.start]), 1, 0)
            derivatives[:, rows] = -(change + a[rows] * by_modulus)
        return derivatives / self.unit_pa

    def _stress_values(self, history: History) -> list[Array]:
        """Return the derivatives of r by x, one array for each lag."""
        place, own, _, number = self._slopes
        scale = -self.segment.length_m / self.unit_pa[own]
        a = history.fading.a.T

        def slopes(times: slice) -> Array:
            derivatives = history.body.stresses.stress_slopes(history.xi[times], history.theta)
            return derivatives[:, place] * a[times, number] * scale

        return self._spread(self._stress_lags, slopes)

    def _force_values(self, history: History, moved: _Moved) -> list[Array]:
        """Return the derivatives of equations of motion by m, one array for each lag."""
        place, own, dofs, _ = (each[moved.slopes] for each in self._slopes)
        scale = self.unit_pa[own] / self.segment.force_n
        taken = self.segment.dynamics.taken

        def slopes(times: slice) -> Array:
            scaled = history.body.stresses.force_slopes(history.xi[times], history.theta)
            return np.where(moved.rows.taken & taken[times, dofs], 0.0, scaled[:, place] * scale)

        scaled = self._spread(self._force_lags, slopes)
        for each, values in zip(self._force_lags, scaled, strict=True):
            is_prescribed_later = taken[each.start + each.lag : each.stop + each.lag, dofs]
            values[moved.rows.taken & is_prescribed_later] = 0.0
        return scaled

    def hessian_values(
        self, part: Part, z: Array, loss_weight: float, multipliers: Array, weights: RowWeights
    ) -> Array:
        """Return the values of `hessian_entries`; arguments as in `Carried.hessian_values`."""
        segment = self.segment
        history = _history(part)
        theta_q = part.setting.theta_q
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
        """Return derivatives of evaluations times the stencil's factors, (T, K) for each lag.

        Parameters
        ----------
        lags : list of _Lag
            Lags.
        slopes : callable
            Returns derivatives (T, K) of a slice of evaluations; called for a few evaluations at a
            time to save memory.
        """
        scaled: list[Array] = []
        first = min(each.start for each in lags)
        last = max(each.stop for each in lags)
        for start in range(first, last, CHUNK):
            stop = min(start + CHUNK, last)
            own = slopes(slice(start, stop))
            scaled = scaled or [np.empty((e.stop - e.start, own.shape[1])) for e in lags]
            for each, values in zip(lags, scaled, strict=True):
                low = max(start, each.start)
                high = min(stop, each.stop)
                if high > low:
                    here = slice(low - each.start, high - each.start)
                    factors = each.factors[low:high, None]
                    np.multiply(own[low - start : high - start], factors, out=values[here])
        return scaled


def _history(part: Part) -> History:
    """Return the viscoelastic history of a part."""
    history = part.along[0]
    assert isinstance(history, History)
    return history
