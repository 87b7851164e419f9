"""What is carried from one evaluation to the next, h_k = R(h_{k−1}, s_k, s_{k−1}; c).

R is one small expression of each instance, such as a channel of a sensor: s is what it looks at,
c are constants that all instances share. Its data say where the start is: there R must depend on
s_k and c alone. Instances and evaluations come last: states are (n, N, I), what is looked at
(i, N, I), data (d, N, I).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from ..arrays import Array
from .generated import Generated

Expression = Callable[[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX], ca.SX]


@dataclass(frozen=True, eq=False)
class Recursion:
    """R, with all its derivatives.

    Attributes
    ----------
    expression : callable
        ``expression(before, now, last, constants, data) -> state`` in CasADi operations, of
        columns: h_{k−1}, s_k, s_{k−1} and c.
    state, looked, constants, data : int
        Their lengths.
    """

    expression: Expression
    state: int
    looked: int
    constants: int
    data: int

    @property
    def ends(self) -> list[int]:
        """Where h_{k−1}, s_k, s_{k−1} and c end among the inputs of `step`."""
        sizes = [self.state, self.looked, self.looked, self.constants]
        return np.cumsum(sizes).tolist()

    @cached_property
    def step(self) -> Generated:
        """R of u = (h_{k−1}, s_k, s_{k−1}, c)."""

        def expression(u: ca.SX, data: ca.SX) -> ca.SX:
            before, now, last, constants = ca.vertsplit(u, [0, *self.ends])
            return self.expression(before, now, last, constants, data)

        return Generated(expression, self.ends[-1], self.data)

    def coefficients(self, constants: ca.SX, data: ca.SX) -> ca.SX:
        """∂R/∂(h_{k−1}, s_k, s_{k−1}) by columns, of a recursion that is linear in these."""
        u = ca.SX.sym("u", self.ends[2])
        before, now, last = ca.vertsplit(u, [0, *self.ends[:3]])
        return ca.vec(ca.jacobian(self.expression(before, now, last, constants, data), u))


@dataclass(frozen=True, eq=False)
class Evolution:
    """A recursion along what it looks at.

    Attributes
    ----------
    recursion : Recursion
    constants : (C,)
    data : (d, N, I)
    looked : (i, N, I) s
    states : (n, N, I) h
    """

    recursion: Recursion
    constants: Array
    data: Array
    looked: Array
    states: Array

    @classmethod
    def of(cls, recursion: Recursion, constants: Array, data: Array, looked: Array) -> Evolution:
        """From the start on; data need not be told for each instance."""
        data = np.broadcast_to(data, (recursion.data, *looked.shape[1:]))
        states = np.zeros((recursion.state, *looked.shape[1:]))
        found = cls(recursion, constants, data, looked, states)
        for k in range(looked.shape[1]):
            here = slice(k, k + 1)
            states[:, here] = recursion.step.value(found._u(here), data[:, here])
        return found

    def _u(self, here: slice) -> Array:
        """(k, …) inputs of some evaluations, one after the other."""
        before = np.arange(here.start, here.stop) - 1
        states = np.where((before < 0)[:, None], 0.0, self.states[:, before])
        last = self.looked[:, np.maximum(before, 0)]
        c = np.broadcast_to(self.constants[:, None, None], (len(self.constants), *last.shape[1:]))
        return np.concatenate([states, self.looked[:, here], last, c])

    @cached_property
    def _slopes(self) -> list[Array]:
        """∂R by h_{k−1}, s_k, s_{k−1} and c, (n, …, N, I) each."""
        step, every = self.recursion.step, slice(0, self.looked.shape[1])
        by_u = step.slopes(self._u(every), self.data)[1]
        return np.split(by_u, self.recursion.ends[:-1], axis=1)

    def forward(self, looked: Array, constants: Array) -> Array:
        """Changes (n, N, I, c) of the states, from those of s (i, N, I, c) and of c (C, c)."""
        by_state, by_now, by_last, by_constants = self._slopes
        found = np.einsum("abkp,bkpc->akpc", by_now, looked)
        found += np.einsum("abkp,bc->akpc", by_constants, constants)
        found[:, 1:] += np.einsum("abkp,bkpc->akpc", by_last[:, :, 1:], looked[:, :-1])
        for k in range(1, found.shape[1]):
            found[:, k] += np.einsum("abp,bpc->apc", by_state[:, :, k], found[:, k - 1])
        return found

    def backward(self, weights: Array) -> tuple[Array, Array]:
        """Slopes of Σ weights · h by s (i, N, I) and by c (C,), at weights (n, N, I)."""
        (by_state, by_now, by_last, by_constants), total = self._slopes, weights.copy()
        for k in range(total.shape[1] - 1, 0, -1):
            total[:, k - 1] += np.einsum("abp,ap->bp", by_state[:, :, k], total[:, k])
        by_looked = np.einsum("abkp,akp->bkp", by_now, total)
        by_looked[:, :-1] += np.einsum("abkp,akp->bkp", by_last[:, :, 1:], total[:, 1:])
        return by_looked, np.einsum("abkp,akp->b", by_constants, total)
