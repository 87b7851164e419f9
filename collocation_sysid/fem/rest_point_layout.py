"""Data of the stress-free shape at a quadrature point, see `rest_shape`."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca


@dataclass(frozen=True)
class RestPointLayout:
    """Layout of the data of the stress-free shape at a quadrature point.

    A point has D values: the 9 entries of G = ∂X/∂Y, column after column, and, for elements that
    average the dilatation, ρ = ln(det G / mean of det G over the element). They are followed by
    their D k derivatives by the k inputs, and by the second derivatives by pairs (i, j), i ≤ j.
    """

    input_count: int  # number k of entries of θ on which X depends
    averages_dilatation: bool  # whether the element averages the dilatation

    @property
    def input_pairs(self) -> list[tuple[int, int]]:
        """Pairs of inputs (i, j), i ≤ j, in the order of the second derivatives."""
        return [(i, j) for j in range(self.input_count) for i in range(j + 1)]

    @property
    def value_count(self) -> int:
        """Number D (1 + k + k (k + 1)/2) of data of a point: values, first and second
        derivatives.
        """
        return (10 if self.averages_dilatation else 9) * (
            1 + self.input_count + len(self.input_pairs)
        )

    def expand(self, data: ca.SX, changes: ca.SX) -> ca.SX:
        """Return the D values of the stress-free shape after changes (k,) of the inputs, to second
        order.

        `data` contains column after column the D values, their k first derivatives, and their
        second derivatives in the order of `input_pairs`.
        """
        columns = ca.reshape(
            data,
            10 if self.averages_dilatation else 9,
            1 + self.input_count + len(self.input_pairs),
        )
        values = columns[:, 0]
        for i in range(self.input_count):
            values += columns[:, 1 + i] * changes[i]
        for number, (i, j) in enumerate(self.input_pairs):
            factor = 0.5 if i == j else 1.0
            values += factor * changes[i] * changes[j] * columns[:, 1 + self.input_count + number]
        return values
