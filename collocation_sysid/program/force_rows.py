"""History variables b of one force as variables of the program, with their recursion as equations.

For evaluations k = 1 … N − 1, in mean edge lengths ℓ as positions are,

    (b_k − h(ξ_{k−1}, ν_{k−1}, c_{k−1}, b_{k−1})) / ℓ = 0,   variables b_k / ℓ,

see `model.point_forces`; b_0 is zero. Of the Lagrangian's second derivatives, those by positions
and parameters alone are computed together with the other forces (with other weights); those with b
are computed here.
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
    """Lifted history variables b of one force of one experiment.

    Arrays end with the axes of evaluations and instances, (…, T, I).

    Attributes
    ----------
    along : int
        Index of the history among those of the motion, `Part.along`.
    force_number : int
        Index of the force, see `ForceHistory`.
    reactions : Reactions or None
        Lifted reaction forces, whose equations also contain the force; None if the program has
        none.
    """

    along: int
    force_number: int
    reactions: Reactions | None = None
    called = "force"

    @property
    def first(self) -> int:
        """Index of the evaluation that the first variables belong to."""
        return 1

    @property
    def unit_m(self) -> float:
        """Unit of the variables and of the equations [m]."""
        return self.segment.length_m

    @property
    def history(self) -> int:
        """Index of the history among those of the motion."""
        return self.along

    @property
    def _points(self) -> ForcePoints:
        """Points of the body at which the force acts."""
        return self.segment.dynamics.forces.pointwise(self.force_number)[0].points

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (n, N − 1, I): n numbers at N − 1 evaluations and I instances."""
        term = self.segment.dynamics.forces.pointwise(self.force_number)[0]
        return term.carries, self.segment.grid_rows - 1, self._points.count

    def following(self, part: Part) -> Array:
        """Return the scaled variables that satisfy the equations at the part's positions
        and parameters.
        """
        return self._of(part).brought.before[:, 1:].ravel() / self.segment.length_m

    def given(self, part: Part, z: Array) -> Part:
        """Return the part with b taken from z."""
        later = z[self.variables].reshape(self.shape) * self.segment.length_m
        before = np.concatenate([np.zeros_like(later[:, :1]), later], axis=1)
        return replace(part, brought={**part.brought, self.history: before})

    def values(self, part: Part, z: Array) -> Array:
        """Return the scaled equations (count,)."""
        predicted = self._of(part).left(slice(self.shape[1])).ravel()
        return z[self.variables] - predicted / self.segment.length_m

    def weighed(self, part: Part, multipliers: Array) -> Weighed:
        """Return the history and its weights in the Lagrangian.

        Returns
        -------
        (ForceHistory, (n, N, I) array)
            The history, and μ such that multipliers · equations contains Σ μ_k h_k.
        """
        mu = -multipliers[self.rows].reshape(self.shape) / self.segment.length_m
        return self._of(part), np.concatenate([mu, np.zeros_like(mu[:, :1])], axis=1)

    def _of(self, part: Part) -> ForceHistory:
        """Return the force history of a part."""
        history = part.along[self.history]
        assert isinstance(history, ForceHistory)
        return history

    # Entries ------------------------------------------------------------------------------------

    @cached_property
    def _own(self) -> Index:
        """Indices (n, N − 1, I) of the variables b_1, b_2, … within this block."""
        return np.arange(self.count).reshape(self.shape)

    @cached_property
    def _moving(self) -> Index:
        """Columns (m,) in z of the parameters that change the motion."""
        return self.segment.moving_in(self.first_phi)

    def _lags(self, first: int) -> Iterator[tuple[slice, Index, Array, Array]]:
        """Iterate over the lags of the stencil, for N − 1 evaluations from `first` on.

        Yields the slice of the evaluations with this lag, the columns (T, P) in z of their
        positions, P being the `pairs` of the points, and the coefficients p and q (T, 1).
        """
        dynamics = self.segment.dynamics
        times = np.arange(first, first + self.shape[1])
        q = dynamics.tables.q / dynamics.step_s
        for lag, (of_p, of_q) in enumerate(zip(dynamics.state_weights.T, q.T, strict=True)):
            used = (times >= lag) & ((of_p[times] != 0) | (of_q[times] != 0))
            if used.any():
                here = slice(int(used.argmax()), len(used))
                k = times[here, None]
                x = self.segment.first.x + (k - lag) * self.segment.dofs + self._points.pairs[2]
                yield here, x, of_p[k], of_q[k]

    def _by_x(self, first: int, parts: Parts) -> Iterator[Array]:
        """Yield derivatives (a, T, P) by x at each lag, from those of N − 1 evaluations by
        state and velocity.
        """
        instance, local, _, weight = self._points.pairs
        by_y = parts.y[:, local, :, instance].transpose(1, 2, 0) * weight
        by_v = parts.v[:, local, :, instance].transpose(1, 2, 0) * weight if parts.v.size else 0.0
        for here, _, p, q in self._lags(first):
            yield by_y[:, here] * p + (by_v[:, here] * q if isinstance(by_v, np.ndarray) else 0.0)

    def _motion(self) -> Iterator[tuple[Index, Index, Index, Array]]:
        """Iterate over the entries of equations of motion that contain b.

        Yields indices (K,) of the pairs of points, evaluations (T,), rows (T, K) in g, and the
        weights (T, K) of the force in them.
        """
        dynamics = self.segment.dynamics
        first_row = self.segment.dynamics.first_row
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
        """Yield the entries of the equations by b, by x and by the dynamic parameters, then
        those of the motion by b.
        """
        rows = self.places.row + self._own
        columns = self.places.variable + self._own
        instance = self._points.pairs[0]
        yield Outer([rows], [columns])
        yield Outer([rows[:, None, 1:]], [columns[:, :-1]])
        for here, x, *_ in self._lags(0):
            yield Outer([rows[:, here][..., instance]], [x])
        yield Outer([rows[:, None]], [self._moving[:, None, None]])
        for pairs, k, row, _ in self._motion():
            yield Outer([row], [columns[:, k[:, None] - self.first, instance[pairs]]])

    def _hessian(self) -> Iterator[Outer]:
        """Yield the Hessian's entries in the columns of b: by b, by x and by the dynamic
        parameters.
        """
        columns = self.places.variable + self._own
        i, j = np.triu_indices(self.shape[0])
        yield Outer([columns[i]], [columns[j]])
        for here, x, *_ in self._lags(self.first):
            yield Outer([x], [columns[:, here][..., self._points.pairs[0]]])
        yield Outer([self._moving[:, None, None, None]], [columns])

    def jacobian_entries(self) -> tuple[Index, Index]:
        """Return rows and columns of the additional entries of ∂g/∂z, in the order of their
        values.
        """
        return together(each.laid_out() for each in self._jacobian())

    def hessian_entries(self) -> tuple[Index, Index]:
        """Return rows and columns of the additional entries of the Hessian, upper triangle."""
        return together(each.laid_out() for each in self._hessian())

    def jacobian_values(self, part: Part, z: Array) -> tuple[Array, Array]:
        """Return the equations, and the values of `jacobian_entries`."""
        history = self._of(part)
        length_m = self.segment.length_m
        d = self._points.dofs
        slopes = history.parts(slice(None))
        places = history.columns
        by = Parts(*(-each[d:, :, :-1] / length_m for each in slopes))
        blocks = [np.ones(self.count), length_m * by.b[:, :, 1:]]
        blocks += [length_m * each for each in self._by_x(0, by)]
        of_inputs = part.setting.by_p[:-1][:, places]
        blocks.append(np.einsum("acti,tcm->amti", by.c, of_inputs))
        blocks += self._motion_by_b(slopes)
        return self.values(part, z), np.concatenate([each.ravel() for each in blocks])

    def _motion_by_b(self, slopes: Parts) -> Iterator[Array]:
        """Yield derivatives of the equations of motion by b, from the force's derivatives
        at all evaluations.
        """
        instance, local, *_ = self._points.pairs
        for pairs, k, _, weight in self._motion():
            by_b = slopes.b[local[pairs], :, :, instance[pairs]][:, :, k]
            yield self.unit_m * by_b.transpose(1, 2, 0) * weight

    def hessian_values(
        self, part: Part, z: Array, loss_weight: float, multipliers: Array, weights: RowWeights
    ) -> Array:
        """Return the values of `hessian_entries`; arguments as in `Carried.hessian_values`."""
        history, mu = self.weighed(part, multipliers)
        assert isinstance(history, ForceHistory)
        length_m = self.segment.length_m
        places = history.columns
        second_derivatives = history.bent(mu, weights.forces)
        first = self.first
        by = Parts(*(self.unit_m * each[:, :, first:] for each in second_derivatives))
        blocks = [self.unit_m * by.b[np.triu_indices(self.shape[0])]]
        by_state = Parts(*(each.swapaxes(0, 1) for each in by))
        blocks += [length_m * each for each in self._by_x(first, by_state)]
        of_inputs = part.setting.by_p[first:][:, places]
        blocks.append(np.einsum("cati,tcm->mati", by.c, of_inputs))
        return np.concatenate([each.ravel() for each in blocks])
