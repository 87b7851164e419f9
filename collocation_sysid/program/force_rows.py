"""What one force's instances carry as variables of a program, and its recursion as equations.

Of evaluations k = 1 … N − 1, in edge lengths ℓ as positions are,

    (b_k − h(ξ_{k−1}, ν_{k−1}, c_{k−1}, b_{k−1})) / ℓ = 0,   variables b_k / ℓ,

see `model.point_forces`; b_0 is zero. Of second derivatives, those by x and by parameters are with
the other forces', at other weights; those with b are here.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..arrays import Array, Index
from ..fem.force_points import ForcePoints
from ..model.force_history import ForceHistory
from ..model.point_forces import Parts
from .carried import Carried, together
from .entries import Outer
from .part import Part
from .reaction_rows import Reactions, rows_of_motion
from .segment import RowWeights, Weighed


@dataclass(frozen=True, eq=False)
class ForceRows(Carried):
    """B of one force of one experiment; arrays end with evaluations and instances, (…, T, I).

    Attributes
    ----------
    along : int
        Which of the histories of the motion it is.
    force_number : int
        Of the force, see `ForceHistory`.
    reactions : Reactions, optional
        Further rows of motion, where the program has them.
    """

    along: int
    force_number: int
    reactions: Reactions | None = None
    called = "force"

    @property
    def first(self) -> int:
        """The evaluation that the first b is of."""
        return 1

    @property
    def unit_m(self) -> float:
        """Of b and of the equations."""
        return self.segment.length_m

    @property
    def history(self) -> int:
        """Which of the histories of the motion it is."""
        return self.along

    @property
    def _points(self) -> ForcePoints:
        return self.segment.dynamics.forces.pointwise(self.force_number)[0].points

    @property
    def shape(self) -> tuple[int, int, int]:
        """(n, N − 1, I)."""
        term = self.segment.dynamics.forces.pointwise(self.force_number)[0]
        return term.carries, self.segment.grid_rows - 1, self._points.count

    def following(self, part: Part) -> Array:
        """The variables as they follow from positions and parameters."""
        return self._of(part).brought.before[:, 1:].ravel() / self.segment.length_m

    def given(self, part: Part, z: Array) -> Part:
        """The experiment with b at z."""
        later = z[self.variables].reshape(self.shape) * self.segment.length_m
        before = np.concatenate([np.zeros_like(later[:, :1]), later], axis=1)
        return replace(part, brought={**part.brought, self.history: before})

    def values(self, part: Part, z: Array) -> Array:
        """The equations."""
        left = self._of(part).left(slice(self.shape[1])).ravel()
        return z[self.variables] - left / self.segment.length_m

    def weighed(self, part: Part, multipliers: Array) -> Weighed:
        """And μ (n, N, I) such that multipliers · r has Σ μ_k h_k."""
        mu = -multipliers[self.rows].reshape(self.shape) / self.segment.length_m
        return self._of(part), np.concatenate([mu, np.zeros_like(mu[:, :1])], axis=1)

    def _of(self, part: Part) -> ForceHistory:
        history = part.along[self.history]
        assert isinstance(history, ForceHistory)
        return history

    # Entries ------------------------------------------------------------------------------------

    @cached_property
    def _own(self) -> Index:
        """(n, N − 1, I) b_1, b_2, … by their numbers."""
        return np.arange(self.count).reshape(self.shape)

    @cached_property
    def _moving(self) -> Index:
        """(m,) what moves the body, in z."""
        return self.segment.moving_in(self.first_phi)

    def _lags(self, first: int) -> Iterator[tuple[slice, Index, Array, Array]]:
        """Of N − 1 evaluations from `first` on those with a lag, and their x in z (T, P).

        P are the `pairs` of the points; the coefficients p and q are (T, 1).
        """
        dynamics, times = self.segment.dynamics, np.arange(first, first + self.shape[1])
        q = dynamics.tables.q / dynamics.step_s
        for lag, (of_p, of_q) in enumerate(zip(dynamics.state_weights.T, q.T, strict=True)):
            used = (times >= lag) & ((of_p[times] != 0) | (of_q[times] != 0))
            if used.any():
                here = slice(int(used.argmax()), len(used))
                k = times[here, None]
                x = self.segment.first.x + (k - lag) * self.segment.dofs + self._points.pairs[2]
                yield here, x, of_p[k], of_q[k]

    def _by_x(self, first: int, parts: Parts) -> Iterator[Array]:
        """Slopes (a, T, P) by x at each lag, from those of N − 1 evaluations."""
        instance, local, _, weight = self._points.pairs
        by_y = parts.y[:, local, :, instance].transpose(1, 2, 0) * weight
        by_v = parts.v[:, local, :, instance].transpose(1, 2, 0) * weight if parts.v.size else 0.0
        for here, _, p, q in self._lags(first):
            yield by_y[:, here] * p + (by_v[:, here] * q if isinstance(by_v, np.ndarray) else 0.0)

    def _motion(self) -> Iterator[tuple[Index, Index, Index, Array]]:
        """Rows of motion with b: which K pairs of the points they are of, and evaluations (T,).

        And the rows (T, K), and what the force counts in them.
        """
        dynamics, first_row = self.segment.dynamics, self.segment.dynamics.first_row
        _, _, of_pairs, shares = self._points.pairs
        for rows in rows_of_motion(self.segment, self.reactions):
            pairs = np.flatnonzero(rows.number[of_pairs] >= 0)
            dofs = of_pairs[pairs]
            for lag, weights in enumerate(dynamics.tables.w.T):
                k = np.arange(max(self.first, first_row), dynamics.rows - lag)[:, None]
                if not len(k) or not weights[lag:].any():
                    continue
                row = rows.first + (k + lag - first_row) * rows.per_time + rows.number[dofs]
                weight = weights[k + lag] * shares[pairs]
                if rows.taken:
                    weight[dynamics.taken[k, dofs] | dynamics.taken[k + lag, dofs]] = 0.0
                yield pairs, k[:, 0], row, weight / self.segment.force_n

    def _jacobian(self) -> Iterator[Outer]:
        """Of r by b, by x, and by what moves the body; of the motion by b."""
        rows, columns = self.places.row + self._own, self.places.variable + self._own
        instance = self._points.pairs[0]
        yield Outer([rows], [columns])
        yield Outer([rows[:, None, 1:]], [columns[:, :-1]])
        for here, x, *_ in self._lags(0):
            yield Outer([rows[:, here][..., instance]], [x])
        yield Outer([rows[:, None]], [self._moving[:, None, None]])
        for pairs, k, row, _ in self._motion():
            yield Outer([row], [columns[:, k[:, None] - self.first, instance[pairs]]])

    def _hessian(self) -> Iterator[Outer]:
        """In the columns of b: by b, by x, and by what moves the body."""
        columns, (i, j) = self.places.variable + self._own, np.triu_indices(self.shape[0])
        yield Outer([columns[i]], [columns[j]])
        for here, x, *_ in self._lags(self.first):
            yield Outer([x], [columns[:, here][..., self._points.pairs[0]]])
        yield Outer([self._moving[:, None, None, None]], [columns])

    def jacobian_entries(self) -> tuple[Index, Index]:
        """Rows and columns of the further entries of ∂g/∂z, in the order of their values."""
        return together(each.laid_out() for each in self._jacobian())

    def hessian_entries(self) -> tuple[Index, Index]:
        """The same of the upper triangle of the Lagrangian's Hessian."""
        return together(each.laid_out() for each in self._hessian())

    def jacobian_values(self, part: Part, z: Array) -> tuple[Array, Array]:
        """The equations, and the values of these entries."""
        history, length_m, d = self._of(part), self.segment.length_m, self._points.dofs
        slopes, places = history.parts(slice(None)), history.columns
        by = Parts(*(-each[d:, :, :-1] / length_m for each in slopes))
        found = [np.ones(self.count), length_m * by.b[:, :, 1:]]
        found += [length_m * each for each in self._by_x(0, by)]
        of_inputs = part.setting.by_p[:-1][:, places]
        found.append(np.einsum("acti,tcm->amti", by.c, of_inputs))
        found += self._motion_by_b(slopes)
        return self.values(part, z), np.concatenate([each.ravel() for each in found])

    def _motion_by_b(self, slopes: Parts) -> Iterator[Array]:
        """Slopes of the rows of motion, from those at all evaluations."""
        instance, local, *_ = self._points.pairs
        for pairs, k, _, weight in self._motion():
            by_b = slopes.b[local[pairs], :, :, instance[pairs]][:, :, k]
            yield self.unit_m * by_b.transpose(1, 2, 0) * weight

    def hessian_values(
        self, part: Part, z: Array, loss_weight: float, multipliers: Array, weights: RowWeights
    ) -> Array:
        """The values of these entries; multipliers are those of all of g."""
        history, mu = self.weighed(part, multipliers)
        assert isinstance(history, ForceHistory)
        length_m, places = self.segment.length_m, history.columns
        bent, first = history.bent(mu, weights.forces), self.first
        by = Parts(*(self.unit_m * each[:, :, first:] for each in bent))
        found = [self.unit_m * by.b[np.triu_indices(self.shape[0])]]
        across = Parts(*(each.swapaxes(0, 1) for each in by))
        found += [length_m * each for each in self._by_x(first, across)]
        of_inputs = part.setting.by_p[first:][:, places]
        found.append(np.einsum("cati,tcm->mati", by.c, of_inputs))
        return np.concatenate([each.ravel() for each in found])
