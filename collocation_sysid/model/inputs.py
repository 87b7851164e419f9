"""What parameters do to the equations of motion: inputs u(p; t), derivatives generated.

Of every evaluation u has, in this order, the constants θ of the body; gravity (3), where a φ turns
it; the share of each load whose time is estimated; the amplitude of each tendon and pressure. p are
the parameters that move the body: q, then the φ of `NuisanceMap.moving`. Forces know how they
depend on u, see `forces`; ∂u/∂p and Σ w ∂²u/∂p² are generated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from ..arrays import Array
from .generated import Generated

Expression = Callable[[ca.SX, ca.SX], ca.SX]


@dataclass(frozen=True, eq=False)
class Input:
    """Entries of u.

    Attributes
    ----------
    size : int
    expression : callable
        ``expression(p, data) -> (size,)`` in CasADi operations.
    data : (d, N) at the evaluations, or (d, 1) where the entries are constant
    by_state : bool
        Whether forces change with it and the state together.
    """

    size: int
    expression: Expression
    data: Array
    by_state: bool = True


@dataclass(frozen=True, eq=False)
class Inputs:
    """u of one experiment.

    Attributes
    ----------
    inputs : sequence of Input
    parameters : int
        Length m of p.
    times : int
        Number N of evaluations.
    """

    inputs: Sequence[Input]
    parameters: int
    times: int

    def at(self, p: Array) -> tuple[Array, Array]:
        """U (N, U) and ∂u/∂p (N, U, m); in the memory of one time where nothing changes."""
        values, slopes = [], []
        rows = max((e.data.shape[1] for e in self.inputs), default=1)
        for each, generated in zip(self.inputs, self._generated, strict=True):
            value, slope = generated.slopes(p, each.data)
            values.append(np.broadcast_to(value.T, (rows, each.size)))
            shape = (rows, each.size, self.parameters)
            slopes.append(np.broadcast_to(np.moveaxis(slope, 2, 0), shape))
        u, by_p = np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)
        if rows == self.times:
            return u, by_p
        # In the memory of one time.
        whole = self.times, *by_p.shape[1:]
        return np.broadcast_to(u, whole[:2]), np.broadcast_to(by_p, whole)

    def curvature(self, p: Array, weights: Array) -> Array:
        """Σ weights[t] · ∂²u_t/∂p² (m, m), for weights (N, U)."""
        found, first = np.zeros((self.parameters,) * 2), 0
        for each, generated in zip(self.inputs, self._generated, strict=True):
            own = weights[:, first : first + each.size].T
            if each.data.shape[1] == 1:
                own = own.sum(axis=1, keepdims=True)
            found += generated.curvature(p, each.data, own).sum(axis=2)
            first += each.size
        return found

    @cached_property
    def _generated(self) -> list[Generated]:
        return [Generated(e.expression, self.parameters, len(e.data)) for e in self.inputs]

    @cached_property
    def by_state(self) -> Array:
        """(m,) which parameters change forces together with the state."""
        found = np.zeros(self.parameters, dtype=bool)
        for each, generated in zip(self.inputs, self._generated, strict=True):
            if each.by_state:
                found |= generated.depends
        return found
