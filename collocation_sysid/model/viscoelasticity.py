"""The memory of a body along a trajectory, with derivatives forward and backward in time.

Of each branch (see `fem.memory`) what is carried from evaluation k to the next is

    m_k = d_k m_{k−1} + a_k S_k,   d_k = e_{k+1},   a_k = e_{k+1} c_k − c_{k+1},

and evaluation k has H_k = Σ m_{k−1} and s_k = Σ c_k. It begins with S_0 and Q_0 = c_0 S_0 in the
start shape, c_0 = g exp(−t/τ) of a load that came at once and has been there for a time t: none
where the body has relaxed. Columns of derivatives follow by the chain rule,

    dF_k ∋ ∂f_H/∂H Σ dm_{k−1},   dm_k = d_k dm_{k−1} + a_k dS_k + dd_k m_{k−1} + da_k S_k,

and backward, with weights λ_k of the forces and μ_k of m_k,

    μ_{k−1} = d_k μ_k + (∂f_H/∂H)ᵀ λ_k,   ξ_k gets (∂S_k/∂ξ_k)ᵀ Σ a_k μ_k.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from ..arrays import Array
from ..fem.body import Body, Curvature
from ..fem.memory import Branch, Past, fading
from .generated import Generated

# Stress slopes of so many evaluations are kept at a time.
CHUNK = 16


def _coefficients(u: ca.SX, data: ca.SX) -> ca.SX:
    """c, d and a of an evaluation, of (g, τ).

    Data are the time from the one before, or since the load of the start came, and whether it is
    the start, and the time to the next.
    """
    share, tau_s = u[0], u[1]
    since_s, began, on_s = data[0], data[1], data[2]

    def even(spacing_s: ca.SX) -> ca.SX:
        return -share * ca.expm1(-spacing_s / tau_s) * tau_s / spacing_s

    c = began * share * ca.exp(-since_s / tau_s) + (1 - began) * even(since_s + began)
    e = ca.exp(-on_s / tau_s)
    return ca.vertcat(c, e, e * c - even(on_s))


COEFFICIENTS = Generated(_coefficients, 2, 3)
# Of what was held for so many relaxation times nothing is left.
LONG = 1e3


@dataclass(frozen=True, eq=False)
class Recursion:
    """c, d and a of one branch at every evaluation, with their derivatives by g and τ.

    Attributes
    ----------
    branch : Branch
    u, data : (2,) and (3, N) of `COEFFICIENTS`
    c, d, a : (N,)
    by : (3, 2, N) their slopes
    """

    branch: Branch
    u: Array
    data: Array
    c: Array
    d: Array
    a: Array
    by: Array

    @classmethod
    def of(cls, branch: Branch, theta: Array, until_next_s: Array, loaded_s: float) -> Recursion:
        """Of a branch, from the times (N,) from each evaluation to the next."""
        count = len(until_next_s)
        u = theta[[branch.share, branch.tau]]
        since_s = np.append(min(loaded_s, LONG * theta[branch.tau]), until_next_s[:-1])
        data = np.stack([since_s, np.arange(count) == 0, until_next_s])
        (c, d, a), by = COEFFICIENTS.slopes(u, data)
        return cls(branch, u, data, c, d, a, by)

    def bent(self, weights: Array) -> Array:
        """Second derivatives (2, 2, N) of the sum of c, d and a with weights (3, N)."""
        return COEFFICIENTS.curvature(self.u, self.data, weights)


def recursions_of(
    body: Body, theta: Array, until_next_s: Array, loaded_s: float
) -> list[Recursion]:
    """Those of all branches of a body."""
    return [Recursion.of(b, theta, until_next_s, loaded_s) for b in body.memory.branches]


@dataclass(frozen=True, eq=False)
class History:
    """What the evaluations of a trajectory have been through.

    Attributes
    ----------
    body : Body
    theta : (k,)
    xi : (N, 3n) evaluation states
    stress : (N, width) S
    recursions : tuple of Recursion
    brought : tuple of (N, …), m_{k−1} of each branch
    """

    body: Body
    theta: Array
    xi: Array
    stress: Array
    recursions: tuple[Recursion, ...]
    brought: tuple[Array, ...]

    @classmethod
    def of(
        cls,
        body: Body,
        xi: Array,
        theta: Array,
        until_next_s: Array,
        loaded_s: float,
        given: Array | None = None,
    ) -> History:
        """Of the states xi (N, 3n), the first of which is the start.

        What they bring follows from that, or is `given`, (N, …) of all branches.
        """
        stress = body.stresses.stress(xi, theta)
        recursions = recursions_of(body, theta, until_next_s, loaded_s)
        if given is not None:
            brought = [given[:, r.branch.own] for r in recursions]
            return cls(body, theta, xi, stress, tuple(recursions), tuple(brought))
        brought = []
        for r in recursions:
            own = stress[:, r.branch.points]
            m = np.zeros_like(own)
            for k in range(len(m) - 1):
                m[k + 1] = r.d[k] * m[k] + r.a[k] * own[k]
            brought.append(m)
        return cls(body, theta, xi, stress, tuple(recursions), tuple(brought))

    def carried(self, rows: slice) -> Past:
        """What some of the evaluations bring from the past."""
        found = self.body.memory.nothing(len(self.xi[rows]))
        for r, m in zip(self.recursions, self.brought, strict=True):
            only_c = np.outer([1.0, 0.0, 0.0], np.ones_like(r.c))
            bent = r.bent(only_c)
            found.overstress[:, r.branch.points] += m[rows]
            found.stiffening[:, r.branch.part] += r.c[rows]
            own = slice(r.branch.share, r.branch.tau + 1)
            found.slopes[:, own] = r.by[0, :, rows].T
            found.bends[:, own, own] = np.moveaxis(bent[..., rows], 2, 0)
        return found

    @property
    def last(self) -> Remembered:
        """After the last evaluation."""
        overstress = [
            m[-1] + r.c[-1] * self.stress[-1, r.branch.points]
            for r, m in zip(self.recursions, self.brought, strict=True)
        ]
        branches = [r.branch for r in self.recursions]
        return Remembered(self.body, self.theta, branches, self.stress[-1], overstress)

    def weights(self, pushes: Array) -> list[Array]:
        """μ_k (N, …) of each branch from (∂f_H/∂H)ᵀ λ_k (N, width)."""
        found = []
        for r in self.recursions:
            own = pushes[:, r.branch.points]
            mu = np.zeros_like(own)
            for k in range(len(mu) - 1, 0, -1):
                mu[k - 1] = r.d[k] * mu[k] + own[k]
            found.append(mu)
        return found

    def pulled(self, force_weights: Array, theta_q: Array) -> tuple[Array, Array]:
        """Derivatives of Σ λ_k f_H(H_k) through H, by ξ (N, 3n) and by q.

        Parameters
        ----------
        force_weights : (N, 3n) λ
        theta_q : (k, q) derivatives of θ
        """
        stresses, by_q = self.body.stresses, np.zeros(theta_q.shape[1])
        mus = self.weights(stresses.against(self.xi, force_weights, self.theta))
        of_stress = self.stress_weights(mus)
        for r, m, mu in zip(self.recursions, self.brought, mus, strict=True):
            own = self.stress[:, r.branch.points]
            along = r.by[1] @ np.sum(mu * m, axis=1) + r.by[2] @ np.sum(mu * own, axis=1)
            by_q += along @ theta_q[[r.branch.share, r.branch.tau]]
        for start in range(0, len(self.xi), CHUNK):
            rows = slice(start, start + CHUNK)
            slopes = stresses.stress_by(self.xi[rows], self.theta, theta_q)
            by_q += np.einsum("tqp,tp->q", slopes, of_stress[rows])
        return stresses.pulled(self.xi, of_stress, self.theta), by_q

    # Where what they bring is given -------------------------------------------------------------

    @property
    def gaps(self) -> Array:
        """(N − 1, …) of all branches, m_k − d_k m_{k−1} − a_k S_k: zero where m follows."""
        found = [
            m[1:] - r.d[:-1, None] * m[:-1] - r.a[:-1, None] * self.stress[:-1, r.branch.points]
            for r, m in zip(self.recursions, self.brought, strict=True)
        ]
        return np.hstack(found)

    def stress_weights(self, mus: Sequence[Array]) -> Array:
        """σ_k (N, width) such that Σ μ_k a_k S_k = Σ σ_k S_k."""
        found = np.zeros_like(self.stress)
        for r, mu in zip(self.recursions, mus, strict=True):
            found[:, r.branch.points] += r.a[:, None] * mu
        return found

    def add_curvature(self, curvature: Curvature, mus: Sequence[Array]) -> None:
        """Add the derivatives of Σ μ_k (d_k m_{k−1} + a_k S_k) by g and τ, and those by another.

        In place, to the N states of a `Curvature` that has those of Σ σ_k S_k.
        """
        stresses, elastic = self.body.stresses, self.body.elastic_places
        units = np.eye(len(self.theta))[:, elastic]
        for r, m, mu in zip(self.recursions, self.brought, mus, strict=True):
            own, points = slice(r.branch.share, r.branch.tau + 1), r.branch.points
            of_m = np.sum(mu * m, axis=1)
            of_stress = np.sum(mu * self.stress[:, points], axis=1)
            weights = np.stack([0 * of_m, of_m, of_stress])
            curvature.theta[:, own] += np.einsum("ct,cjt->tj", weights, r.by)
            curvature.theta_theta[:, own, own] += np.moveaxis(r.bent(weights), 2, 0)
            for place, a_by in zip((r.branch.share, r.branch.tau), r.by[2], strict=True):
                weights = np.zeros_like(self.stress)
                weights[:, points] = a_by[:, None] * mu
                pulled = stresses.pulled(self.xi, weights, self.theta)
                curvature.position_theta[:, :, place] += pulled
            for start in range(0, len(self.xi), CHUNK):
                rows = slice(start, start + CHUNK)
                slopes = stresses.stress_by(self.xi[rows], self.theta, units)[:, :, points]
                by = np.einsum("tqp,tp,bt->tbq", slopes, mu[rows], r.by[2][:, rows])
                curvature.theta_theta[rows, own, elastic] += by
                curvature.theta_theta[rows, elastic, own] += by.swapaxes(1, 2)


@dataclass(frozen=True, eq=False)
class Remembered:
    """The state of the memory at one time.

    Attributes
    ----------
    body, theta
    branches : sequence of Branch
    stress : (width,) S
    overstress : sequence of (…,) Q of each branch
    """

    body: Body
    theta: Array
    branches: Sequence[Branch]
    stress: Array
    overstress: Sequence[Array]

    @classmethod
    def at_start(cls, body: Body, x: Array, theta: Array, loaded_s: float) -> Remembered:
        """In the start shape x (3n,)."""
        return History.of(body, x[None], theta, np.ones(1), loaded_s).last

    @property
    def now(self) -> Past:
        """What this very state bears beside S."""
        found = self.body.memory.nothing(1)
        for branch, overstress in zip(self.branches, self.overstress, strict=True):
            found.overstress[0, branch.points] += overstress
        return found

    def ahead(self, interval_s: float) -> Past:
        """What a state after an interval brings from this one."""
        found = self.body.memory.nothing(1)
        for branch, overstress in zip(self.branches, self.overstress, strict=True):
            e, c = self._fading(branch, interval_s)
            brought = e * overstress - c * self.stress[branch.points]
            found.overstress[0, branch.points] += brought
            found.stiffening[0, branch.part] += c
        return found

    def after(self, x: Array, interval_s: float) -> Remembered:
        """At the state x (3n,) an interval later."""
        stress, overstress = self.body.stresses.stress(x[None], self.theta)[0], []
        for branch, before in zip(self.branches, self.overstress, strict=True):
            e, c = self._fading(branch, interval_s)
            change = stress[branch.points] - self.stress[branch.points]
            overstress.append(e * before + c * change)
        return Remembered(self.body, self.theta, self.branches, stress, overstress)

    def _fading(self, branch: Branch, interval_s: float) -> tuple[float, float]:
        return fading(self.theta[branch.share], self.theta[branch.tau], interval_s)


def start_carried(body: Body, theta: Array, loaded_s: float) -> Past | None:
    """What the start shape bears beside S, where a load has not been there for long."""
    if not body.remembers or np.isinf(loaded_s):
        return None
    found = body.memory.nothing(1)
    for branch in body.memory.branches:
        found.stiffening[:, branch.part] += theta[branch.share] * np.exp(
            -loaded_s / theta[branch.tau]
        )
    return found


class Slopes:
    """Columns dm of a history, evaluation after evaluation.

    Parameters
    ----------
    history : History
    theta_q : (k, columns) derivatives of θ
    done : int
        Evaluations that are known.
    known : sequence of arrays, optional
        `columns` after the last of them.
    """

    def __init__(
        self, history: History, theta_q: Array, done: int = 0, known: Sequence[Array] = ()
    ) -> None:
        self.history, self.theta_q, self.next = history, theta_q, done
        self.stresses, self.theta = history.body.stresses, history.theta
        count = theta_q.shape[1]
        # (columns, …) of each branch
        self.columns = [each.copy() for each in known] or [
            np.zeros((count, m.shape[1])) for m in history.brought
        ]
        # Work space, kept: fresh pages would cost as much as the numbers in them.
        self._stress = np.zeros((count, self.stresses.width))
        self._total, self._scratch = np.zeros_like(self._stress), np.zeros_like(self._stress)
        self._state = np.zeros((count, history.xi.shape[1]))
        self._direction = np.zeros_like(self._state)
        self._moduli = np.flatnonzero(theta_q[history.body.elastic_places].any(axis=0))
        self._slopes, self._first = np.zeros((0, 0, 0)), 0
        # (columns, N) derivatives of d and a of each branch, and where they are not zero.
        self._own = []
        for r in history.recursions:
            own = theta_q[[r.branch.share, r.branch.tau]].T
            self._own.append((np.flatnonzero(own.any(axis=1)), own @ r.by[1], own @ r.by[2]))

    def force(self) -> Array:
        """What they add to dF at the next evaluation, (3n, columns)."""
        total = self.columns[0]
        if len(self.columns) > 1:
            total = self._total
            total.fill(0.0)
            for r, columns in zip(self.history.recursions, self.columns, strict=True):
                total[:, r.branch.points] += columns
        self._state[:] = self.history.xi[self.next]
        return self.stresses.force(self._state, total, self.theta).T

    def advance(self, of_state: Array) -> None:
        """Go past the next evaluation, whose state changes by (3n, columns)."""
        k, history, stress = self.next, self.history, self._stress
        self._state[:], self._direction[:] = history.xi[k], of_state.T
        # Of a single branch the stress itself is not needed.
        alone = history.recursions[0] if len(history.recursions) == 1 else None
        if alone is not None:
            stress = self.columns[0]
            stress *= alone.d[k]
            self._direction *= alone.a[k]
        else:
            stress.fill(0.0)
        self.stresses.along(self._state, self._direction, self.theta, stress)
        if len(self._moduli):
            for column, slope in zip(self._moduli, self._by_moduli(k), strict=True):
                stress[column] += slope if alone is None else alone.a[k] * slope
        for r, m, columns, (moved, d_own, a_own) in zip(
            history.recursions, history.brought, self.columns, self._own, strict=True
        ):
            points = r.branch.points
            if alone is None:
                columns *= r.d[k]
                columns += np.multiply(stress[:, points], r.a[k], out=self._scratch[:, points])
            for j in moved:
                columns[j] += d_own[j, k] * m[k]
                columns[j] += a_own[j, k] * history.stress[k, points]
        self.next += 1

    def _by_moduli(self, k: int) -> Array:
        if not self._first <= k < self._first + len(self._slopes):
            xi, theta_q = self.history.xi[k : k + CHUNK], self.theta_q[:, self._moduli]
            self._slopes, self._first = self.stresses.stress_by(xi, self.theta, theta_q), k
        return self._slopes[k - self._first]


class Weights:
    """μ of a history, evaluation before evaluation."""

    def __init__(self, history: History) -> None:
        self.history, self.next = history, len(history.xi) - 1
        self.columns = [np.zeros(m.shape[1]) for m in history.brought]

    def pulled(self) -> Array:
        """What the state of the evaluation gets through S, (3n,)."""
        history, k = self.history, self.next
        weights = np.zeros((1, history.stress.shape[1]))
        for r, mu in zip(history.recursions, self.columns, strict=True):
            weights[0, r.branch.points] += r.a[k] * mu
        return history.body.stresses.pulled(history.xi[k][None], weights, history.theta)[0]

    def retreat(self, force_weight: Array) -> None:
        """Go before the evaluation, whose force has weights (3n,)."""
        history, k = self.history, self.next
        state, weight = history.xi[k][None], force_weight[None]
        push = history.body.stresses.against(state, weight, history.theta)[0]
        for b, r in enumerate(history.recursions):
            self.columns[b] = r.d[k] * self.columns[b] + push[r.branch.points]
        self.next -= 1
