"""Recursions h_k = R(h_{k−1}, s_k, s_{k−1}; c) along the time grid, with derivatives.

Use this module for a small state h that follows a signal s, such as the low-pass filter of a force
sensor. R is an expression of one instance, for example of one component of a sensor; the constants
c are shared by all instances. At the start (k = 0) h_{k−1} and s_{k−1} are unknown; the data mark
the start, and there R must depend on s_k and c alone.

Times and instances are the last axes of all arrays: states are (n, N, I), signals (i, N, I) and
data (d, N, I) for N times and I instances.

The low-pass of a sensor and the branches of a viscoelastic material relax exponentially; both take
the coefficients of a time step from `relaxation_coefficients`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from ..common.array_types import Array
from .generated_functions import GeneratedFunction

Expression = Callable[[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX], ca.SX]


@dataclass(frozen=True, eq=False)
class Recursion:
    """Recursion function R of one instance, with generated derivatives."""

    # ``expression(before, now, last, constants, data) -> state`` in CasADi operations on column
    # vectors: h_{k−1}, s_k, s_{k−1}, c and the data at k; returns h_k.
    expression: Expression
    state_size: int  # length n of the state h
    signal_size: int  # length i of the signal s
    constant_count: int  # length C of the constants c
    data_size: int  # length d of the data at each time

    @property
    def input_offsets(self) -> list[int]:
        """End indices of h_{k−1}, s_k, s_{k−1} and c in the input vector of
        `step_function`.
        """
        sizes = [self.state_size, self.signal_size, self.signal_size, self.constant_count]
        return np.cumsum(sizes).tolist()

    @cached_property
    def step_function(self) -> GeneratedFunction:
        """Expression R of the stacked inputs u = (h_{k−1}, s_k, s_{k−1}, c), with derivatives."""

        def expression(u: ca.SX, data: ca.SX) -> ca.SX:
            before, now, last, constants = ca.vertsplit(u, [0, *self.input_offsets])
            return self.expression(before, now, last, constants, data)

        return GeneratedFunction(expression, self.input_offsets[-1], data_size=self.data_size)

    def linear_coefficients(self, constants: ca.SX, data: ca.SX) -> ca.SX:
        """Return ∂R/∂(h_{k−1}, s_k, s_{k−1}) of a recursion that is linear in these, column by
        column.

        Parameters
        ----------
        constants : (C,) SX
        data : (d,) SX

        Returns
        -------
        (n (n + 2 i),) SX
            The Jacobian (n, n + 2 i), stacked column by column.
        """
        u = ca.SX.sym("u", self.input_offsets[2])
        before, now, last = ca.vertsplit(u, [0, *self.input_offsets[:3]])
        return ca.vec(ca.jacobian(self.expression(before, now, last, constants, data), u))


@dataclass(frozen=True, eq=False)
class RecursionTrajectory:
    """States of a recursion along a given signal, with derivatives forward and backward in time."""

    recursion: Recursion
    constants: Array  # (C,): constants c
    data: Array  # (d, N, I): data at each time and instance
    signal: Array  # (i, N, I): signal s
    states: Array  # (n, N, I): states h

    @classmethod
    def from_signal(
        cls, recursion: Recursion, constants: Array, data: Array, signal: Array
    ) -> RecursionTrajectory:
        """Run the recursion from the start along a signal.

        At the start h_{k−1} is zero and s_{k−1} is s_0.

        Parameters
        ----------
        constants : (C,)
        data : (d, N, I) or broadcastable to it
            Data that are equal for all instances may have the shape (d, N, 1).
        signal : (i, N, I)
            Signal s.
        """
        data = np.broadcast_to(data, (recursion.data_size, *signal.shape[1:]))
        states = np.zeros((recursion.state_size, *signal.shape[1:]))
        trajectory = cls(recursion, constants, data=data, signal=signal, states=states)
        for k in range(signal.shape[1]):
            now = slice(k, k + 1)
            states[:, now] = recursion.step_function.evaluate(
                trajectory._stacked_inputs(now), data[:, now]
            )
        return trajectory

    def _stacked_inputs(self, times: slice) -> Array:
        """(h_{k−1}, s_k, s_{k−1}, c) (size, T, I); at the start h = 0, s_{k−1} = s_0."""
        before = np.arange(times.start, times.stop) - 1
        states = np.where((before < 0)[:, None], 0.0, self.states[:, before])
        last = self.signal[:, np.maximum(before, 0)]
        c = np.broadcast_to(self.constants[:, None, None], (len(self.constants), *last.shape[1:]))
        return np.concatenate([states, self.signal[:, times], last, c])

    @cached_property
    def _jacobians(self) -> list[Array]:
        """Derivatives of R by h_{k−1}, s_k, s_{k−1} and c, a list of arrays (n, …, N, I)."""
        step = self.recursion.step_function
        all_times = slice(0, self.signal.shape[1])
        by_u = step.evaluate_with_jacobian(self._stacked_inputs(all_times), self.data)[1]
        return np.split(by_u, self.recursion.input_offsets[:-1], axis=1)

    def jacobian_vector_product(self, signal_changes: Array, constant_changes: Array) -> Array:
        """Return the changes of the states (n, N, I, c) for c directions at once, including those
        through earlier states.

        Parameters
        ----------
        signal_changes : (i, N, I, c)
            Changes of the signal s.
        constant_changes : (C, c)
            Changes of the constants.
        """
        by_state, by_now, by_last, by_constants = self._jacobians
        changes = np.einsum("abkp,bkpc->akpc", by_now, signal_changes)
        changes += np.einsum("abkp,bc->akpc", by_constants, constant_changes)
        changes[:, 1:] += np.einsum("abkp,bkpc->akpc", by_last[:, :, 1:], signal_changes[:, :-1])
        for k in range(1, changes.shape[1]):
            changes[:, k] += np.einsum("abp,bpc->apc", by_state[:, :, k], changes[:, k - 1])
        return changes

    def vector_jacobian_product(self, weights: Array) -> tuple[Array, Array]:
        """Return the gradient of Σ weights · h, over all times and instances, by the signal (i, N,
        I) and by the constants (C,).

        Parameters
        ----------
        weights : (n, N, I)
            Weights of the states; not modified.
        """
        by_state, by_now, by_last, by_constants = self._jacobians
        total = weights.copy()
        for k in range(total.shape[1] - 1, 0, -1):
            total[:, k - 1] += np.einsum("abp,ap->bp", by_state[:, :, k], total[:, k])
        by_signal = np.einsum("abkp,akp->bkp", by_now, total)
        by_signal[:, :-1] += np.einsum("abkp,akp->bkp", by_last[:, :, 1:], total[:, 1:])
        return by_signal, np.einsum("abkp,akp->b", by_constants, total)


def relaxation_coefficients(tau: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return the coefficients e and c of Q_k = e Q_{k−1} + c (s_k − s_{k−1}), the exact solution of
    dQ/dt + Q/τ = ds/dt over an interval h in which the signal s changes linearly.

    The coefficients are e = exp(−h/τ) and c = (τ/h) (1 − e).

    Parameters
    ----------
    tau : SX
        Time constant in units of the interval, τ/h; for 0 both coefficients are zero.
    """
    # exp(−1e6) is 0 in doubles.
    ratio = 1 / ca.fmax(tau, 1e-6)
    return ca.exp(-ratio), -tau * ca.expm1(-ratio)
