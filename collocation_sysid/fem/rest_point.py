"""Numbers that the stress-free shape of a body gives each quadrature point, see `rest_shape`."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca


@dataclass(frozen=True)
class RestPoint:
    """Layout of what the stress-free shape gives each quadrature point.

    Per point there are D = 9 numbers of G, column after column, and for elements that average the
    dilatation ρ = ln(det G / mean of det G over the element); then the D k derivatives by the k
    inputs, and those of second order by pairs (i, j), i ≤ j.

    Attributes
    ----------
    inputs : int
        Number k of the entries of θ that X depends on.
    mean_dilatation : bool
    """

    inputs: int
    mean_dilatation: bool

    @property
    def values(self) -> int:
        """Number D."""
        return 10 if self.mean_dilatation else 9

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Pairs of inputs (i, j), i ≤ j."""
        return [(i, j) for j in range(self.inputs) for i in range(j + 1)]

    @property
    def count(self) -> int:
        """Numbers per point."""
        return self.values * (1 + self.inputs + len(self.pairs))

    def expand(self, data: ca.SX, changes: ca.SX) -> ca.SX:
        """Return the D values where the inputs change by `changes` (k,), to second order."""
        columns = ca.reshape(data, self.values, 1 + self.inputs + len(self.pairs))
        found = columns[:, 0]
        for i in range(self.inputs):
            found += columns[:, 1 + i] * changes[i]
        for number, (i, j) in enumerate(self.pairs):
            share = 0.5 if i == j else 1.0
            found += share * changes[i] * changes[j] * columns[:, 1 + self.inputs + number]
        return found
