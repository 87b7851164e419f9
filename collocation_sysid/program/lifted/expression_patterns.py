"""Constraints that repeat one small expression at many instances, with generated derivatives.

The values y(u, data) of all instances are added to constraints; index arrays state which variables
are the inputs u and which constraints the values belong to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...common.array_types import Array, Index
from ...model.generated_functions import GeneratedFunction
from ...model.recursion import Recursion

T = TypeVar("T", bound=np.generic)
# Unit of variables that are not scaled.
ONE = np.ones(1)


class PatternIndices(NamedTuple):
    """Variables or constraints of instances."""

    indices: Index  # (k, …): their indices in z or g
    # Physical value of one unit of each; of the same shape as `indices` or one that broadcasts to
    # it.
    unit: Array = ONE


@dataclass(frozen=True, eq=False)
class ExpressionPattern:
    """An expression at I instances."""

    expression: GeneratedFunction  # function y(u, data) with derivatives
    data: Array  # (d, I): data of the instances
    # PatternIndices, (k, I): variables that are the inputs u; the expression gets their physical
    # values.
    inputs: PatternIndices
    # PatternIndices, (m, I): constraints that the values y, divided by their units, are added to.
    rows: PatternIndices

    @classmethod
    def from_arrays(
        cls,
        expression: GeneratedFunction,
        data: Array,
        inputs: Sequence[PatternIndices],
        rows: PatternIndices,
    ) -> ExpressionPattern:
        """Build a pattern of instances of any shape.

        Parameters
        ----------
        expression : GeneratedFunction
            Function y(u, data).
        data : (d, …) array
            Data; broadcast to the shape of the instances.
        inputs : sequence of PatternIndices, each (k, …)
            Inputs, concatenated along the first axis after broadcasting.
        rows : PatternIndices, (m, …)
            Constraints.
        """
        shapes = (data.shape, rows.indices.shape, *(each.indices.shape for each in inputs))
        shape = np.broadcast_shapes(*(shape[1:] for shape in shapes))

        def one_dimensional(values: NDArray[T], length: int) -> NDArray[T]:
            broadcast = np.broadcast_to(values, (length, *shape))
            return broadcast.reshape(length, int(np.prod(shape)))

        def concatenated(parts: Sequence[PatternIndices]) -> PatternIndices:
            places = [one_dimensional(part.indices, len(part.indices)) for part in parts]
            units = [one_dimensional(np.asarray(part.unit), len(part.indices)) for part in parts]
            return PatternIndices(np.concatenate(places), np.concatenate(units))

        return cls(
            expression,
            one_dimensional(data, len(data)),
            inputs=concatenated(inputs),
            rows=concatenated([rows]),
        )

    @classmethod
    def from_recursion(
        cls,
        recursion: Recursion,
        data: Array,
        states: PatternIndices,
        input_indices: PatternIndices,
        constants: PatternIndices,
        rows: PatternIndices,
    ) -> ExpressionPattern:
        """Build the pattern h_k − R(h_{k−1}, s_k, s_{k−1}; c) of a recursion R.

        At the first evaluation, the first states and inputs stand for those before; the recursion
        must ignore them.

        Parameters
        ----------
        data : (d, …) array
            Data of the recursion; broadcast to the shape of the instances.
        states : PatternIndices, (n, N, I)
            States h at N evaluations.
        input_indices : PatternIndices, (i, N, I)
            Inputs s.
        constants : PatternIndices
            Constants c, of a shape that broadcasts.
        rows : PatternIndices, (n, N, I)
            Constraints.
        """

        def gap(u: ca.SX, data: ca.SX) -> ca.SX:
            own, inputs = ca.vertsplit(u, [0, recursion.state_size, u.numel()])
            return own - recursion.step_function.expression(inputs, data)

        before = np.maximum(np.arange(states.indices.shape[1]) - 1, 0)
        parts = [
            states,
            _at_evaluations(states, before),
            input_indices,
            _at_evaluations(input_indices, before),
            constants,
        ]
        size = recursion.state_size + recursion.input_offsets[-1]
        return cls.from_arrays(
            GeneratedFunction(gap, size, data_size=recursion.data_size),
            data,
            inputs=parts,
            rows=rows,
        )

    def _input_values(self, z: Array) -> Array:
        """Return the inputs (k, I) in physical units from the variables z."""
        return self.inputs.unit * z[self.inputs.indices]

    def residuals(self, z: Array, count: int) -> Array:
        """Return the contributions to the scaled constraints (count,) at z; those without values y
        are zero.
        """
        return self._assemble(self.expression.evaluate(self._input_values(z), self.data), count)

    def _assemble(self, y: Array, count: int) -> Array:
        """Return sums (count,) of values (m, I) over their constraints, in units of the rows."""
        assembled = np.zeros(count)
        np.add.at(assembled, self.rows.indices, y / self.rows.unit)
        return assembled

    def jacobian_entries(self) -> tuple[Index, Index]:
        """Return constraint, and index in z, of each derivative that may be non-zero, for all
        instances; an entry may be repeated.
        """
        y, u = np.nonzero(self.expression.jacobian_pattern)
        return self.rows.indices[y].ravel(), self.inputs.indices[u].ravel()

    def jacobian_values(self, z: Array, count: int) -> tuple[Array, Array]:
        """Return the contributions to the scaled constraints (count,) at z, and the values of
        `jacobian_entries`, derivatives by scaled variables.
        """
        value, slopes = self.expression.evaluate_with_jacobian(self._input_values(z), self.data)
        y, u = np.nonzero(self.expression.jacobian_pattern)
        slopes = slopes[y, u] * self.inputs.unit[u] / self.rows.unit[y]
        return self._assemble(value, count), slopes.ravel()

    @cached_property
    def _hessian_pairs(self) -> tuple[Index, Index, NDArray[np.bool_]]:
        """Pairs (h,) of inputs in both orders, and instances (h, I) in the upper triangle."""
        i, j = np.nonzero(self.expression.hessian_pattern)
        indices = self.inputs.indices
        return i, j, indices[i] <= indices[j]

    def hessian_entries(self) -> tuple[Index, Index]:
        """Return rows and columns in z of the second derivatives, upper triangle; an entry may be
        repeated.
        """
        i, j, is_upper = self._hessian_pairs
        indices = self.inputs.indices
        return indices[i][is_upper], indices[j][is_upper]

    def hessian_values(self, z: Array, multipliers: Array) -> Array:
        """Return the second derivatives of multipliers (count,) · constraints by the scaled
        variables, in the order of `hessian_entries`.
        """
        i, j, is_upper = self._hessian_pairs
        unit = self.inputs.unit
        weights = multipliers[self.rows.indices] / self.rows.unit
        curvature = self.expression.weighted_hessian(
            self._input_values(z), self.data, weights=weights
        )
        return (curvature[i, j] * unit[i] * unit[j])[is_upper]


def _at_evaluations(indices: PatternIndices, evaluations: Index) -> PatternIndices:
    """Return indices (k, E, …) at other evaluations; units are the same at all of them."""
    return PatternIndices(indices.indices[:, evaluations], indices.unit)
