"""The memory of a body along a trajectory, with derivatives forward and backward in time.

Of each branch (see `fem.memory`) what is carried from evaluation k to the next is

    m_k = d_k m_{k−1} + a_k S_k,   d_k = e_{k+1},   a_k = e_{k+1} c_k − c_{k+1},

and evaluation k has H_k = Σ m_{k−1} and s_k = Σ c_k. It begins with S_0 and Q_0 = c_0 S_0 in the
start shape, c_0 = g exp(−t/τ) of a load that came at once and has been there for a time t: none
where the body has relaxed. Columns of derivatives follow by the chain rule,

    dF_k ∋ ∂f_H/∂H Σ dm_{k−1},   dm_k = d_k dm_{k−1} + a_k dS_k + dd_k m_{k−1} + da_k S_k,

and backward, with weights λ_k of the forces and μ_k of m_k,

    μ_{k−1} = d_k μ_k + (∂f_H/∂H)ᵀ λ_k,   ξ_k gets (∂S_k/∂ξ_k)ᵀ Σ a_k μ_k.

The recursion is one of `recursion`; as it is linear in m and S, all points of a branch share its
coefficients, which spares most of what generated rows of each point would cost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from ..arrays import Array, Index
from ..fem.body import Body, Curvature
from ..fem.memory import Past, PointLayout, fading
from .forces import Forces
from .generated import Generated
from .recursion import Recursion

# Stress slopes of so many evaluations are kept at a time.
CHUNK = 16
# Of what was held for so many relaxation times nothing is left.
LONG = 1e3


def _even(u: ca.SX, spacing_s: ca.SX) -> ca.SX:
    """C of an interval in which S changes evenly."""
    share, tau_s = u[0], u[1]
    return -share * ca.expm1(-spacing_s / tau_s) * tau_s / spacing_s


def _stiffening(u: ca.SX, data: ca.SX) -> ca.SX:
    """C of an evaluation."""
    since_s, began = data[0], data[1]
    at_once = u[0] * ca.exp(-since_s / u[1])
    return began * at_once + (1 - began) * _even(u, since_s + began)


def _overstress(before: ca.SX, now: ca.SX, _: ca.SX, u: ca.SX, data: ca.SX) -> ca.SX:
    """M from the one before and from S, of u = (g, τ).

    Data are the time from the evaluation before, or since the load of the start came, and whether
    it is the start, and the time to the next.
    """
    e = ca.exp(-data[2] / u[1])
    return e * before + (e * _stiffening(u, data) - _even(u, data[2])) * now


OVERSTRESS = Recursion(_overstress, 1, 1, 2, 3)


def _coefficients(u: ca.SX, data: ca.SX) -> ca.SX:
    """c, d and a."""
    return ca.vertcat(_stiffening(u, data), OVERSTRESS.coefficients(u, data)[:2])


COEFFICIENTS, STIFFENING = Generated(_coefficients, 2, 3), Generated(_stiffening, 2, 3)


@dataclass(frozen=True, eq=False)
class Fading:
    """c, d and a of B branches at N evaluations, with their derivatives by g and τ.

    Attributes
    ----------
    places : (2, B) of g and τ in θ
    u, data : (2, B, N) and (3, B, N) of `COEFFICIENTS`
    c, d, a : (B, N)
    by : (3, 2, B, N) their slopes
    """

    places: Index
    u: Array
    data: Array
    c: Array
    d: Array
    a: Array
    by: Array

    @classmethod
    def of(cls, body: Body, theta: Array, until_next_s: Array, loaded_s: float) -> Fading:
        """Of all branches, from the times (N,) from each evaluation to the next."""
        places = np.array([(each.share, each.tau) for each in body.memory.branches]).T
        shape = len(body.memory.branches), len(until_next_s)
        since_s = np.empty(shape)
        since_s[:, 0] = np.minimum(loaded_s, LONG * theta[places[1]])
        since_s[:, 1:] = until_next_s[:-1]
        began = np.broadcast_to(np.arange(shape[1]) == 0, shape)
        data = np.stack([since_s, began, np.broadcast_to(until_next_s, shape)])
        u = np.broadcast_to(theta[places][..., None], (2, *shape))
        (c, d, a), by = COEFFICIENTS.slopes(u, data)
        return cls(places, u, data, c, d, a, by)

    def along(self, theta_q: Array) -> tuple[Array, Array]:
        """Derivatives (q, B, N) of d and a by what θ changes with by theta_q (k, q)."""
        d_q, a_q = np.einsum("cjbn,jbq->cqbn", self.by[1:], theta_q[self.places])
        return d_q, a_q


@dataclass(frozen=True, eq=False)
class History:
    """What the evaluations of a trajectory have been through.

    Attributes
    ----------
    body : Body
    theta : (k,)
    xi : (N, 3n) evaluation states
    stress : (N, width) S
    fading : Fading
    brought : (N, all branches) m_{k−1}
    """

    body: Body
    theta: Array
    xi: Array
    stress: Array
    fading: Fading
    brought: Array

    @classmethod
    def of(
        cls,
        body: Body,
        xi: Array,
        theta: Array,
        until_next_s: Array,
        loaded_s: float,
        brought: Array | None = None,
    ) -> History:
        """Of the states xi (N, 3n), the first of which is the start.

        What they bring follows from that, where it is not given.
        """
        stress = body.stresses.stress(xi, theta)
        fades = Fading.of(body, theta, until_next_s, loaded_s)
        if brought is None:
            borne, (d, a) = body.memory.borne(stress), map(body.memory.spread, (fades.d, fades.a))
            brought = np.zeros(borne.shape)
            for k in range(len(brought) - 1):
                brought[k + 1] = d[k] * brought[k] + a[k] * borne[k]
        return cls(body, theta, xi, stress, fades, brought)

    @property
    def memory(self) -> PointLayout:
        """What is where."""
        return self.body.memory

    def carried(self, rows: slice) -> Past:
        """What some of the evaluations bring from the past."""
        found, fades = self.memory.nothing(len(self.xi[rows])), self.fading
        found.overstress[:] = self.memory.summed(self.brought[rows])
        for branch, c in zip(self.memory.branches, fades.c, strict=True):
            found.stiffening[:, branch.part] += c[rows]
        bent = STIFFENING.curvature(fades.u, fades.data)
        found.slopes[:, fades.places] = np.moveaxis(fades.by[0, ..., rows], 2, 0)
        found.bends[:, fades.places[:, None], fades.places] = np.moveaxis(bent[..., rows], 3, 0)
        return found

    def onto(self, forces: Forces, rows: slice) -> Forces:
        """Forces of some evaluations with what these bring."""
        return replace(forces, past=self.carried(rows))

    def weighed(self, forces: Forces, mu: Array) -> Forces:
        """The forces of all evaluations, where a_k S_k counts μ (N, all branches) besides."""
        borne = replace(self.carried(slice(None)), stress_weights=self.stress_weights(mu))
        return replace(forces, past=borne)

    def forward(
        self, by_p: Callable[[int], Array], done: int = 0, known: Array | None = None
    ) -> Slopes:
        """Columns of what is carried, see `Slopes`; of an evaluation, those (U, c) of inputs."""
        return Slopes(self, by_p(0)[: len(self.theta)], done, known)

    def backward(self) -> Weights:
        """Its weights, see `Weights`."""
        return Weights(self)

    @property
    def last(self) -> Remembered:
        """After the last evaluation."""
        c = self.memory.spread(self.fading.c)[-1]
        overstress = self.brought[-1] + c * self.memory.borne(self.stress[-1])
        return Remembered(self.body, self.theta, self.stress[-1], overstress)

    @property
    def gaps(self) -> Array:
        """(N − 1, …) m_k − d_k m_{k−1} − a_k S_k: zero where m follows."""
        d, a = (self.memory.spread(each[:, :-1]) for each in (self.fading.d, self.fading.a))
        m, borne = self.brought, self.memory.borne(self.stress[:-1])
        return m[1:] - d * m[:-1] - a * borne

    # Derivatives of Σ μ_k (d_k m_{k−1} + a_k S_k), μ (N, all branches) --------------------------

    def stress_weights(self, mu: Array) -> Array:
        """σ_k (N, width) such that Σ μ_k a_k S_k = Σ σ_k S_k."""
        return self.memory.summed(self.memory.spread(self.fading.a) * mu)

    def _summed(self, mu: Array) -> Array:
        """U (5, B, N) of `OVERSTRESS` whose value is Σ μ_k m_k of each branch.

        As that is linear in m and S, it goes on from Σ μ_k m_{k−1}, at Σ μ_k S_k.
        """
        borne = self.memory.borne(self.stress)
        before, now = (self.memory.totals(mu * each) for each in (self.brought, borne))
        return np.stack([before, now, 0 * now, *self.fading.u])

    def stress_by(self, theta_q: Array) -> Iterator[tuple[slice, Array]]:
        """∂S/∂θ θ_q (T, q, width), a few evaluations at a time."""
        for start in range(0, len(self.xi), CHUNK):
            rows = slice(start, start + CHUNK)
            yield rows, self.body.stresses.stress_by(self.xi[rows], self.theta, theta_q)

    def pulled(self, force_weights: Array, by_p: Array) -> tuple[Array, Array, Array]:
        """Derivatives of Σ λ_k f_H(H_k) through H, by ξ and ν (N, 3n) and by p.

        Parameters
        ----------
        force_weights : (N, 3n) λ
        by_p : (N, U, m) derivatives of the inputs
        """
        theta_p = by_p[0, : len(self.theta)]
        used = np.flatnonzero(theta_p.any(axis=0))
        theta_q, found = theta_p[:, used], np.zeros(theta_p.shape[1])
        stresses, d = self.body.stresses, self.memory.spread(self.fading.d)
        pushes = self.memory.borne(stresses.against(self.xi, force_weights, self.theta))
        mu = np.zeros_like(pushes)
        for k in range(len(mu) - 1, 0, -1):
            mu[k - 1] = d[k] * mu[k] + pushes[k]
        _, by = OVERSTRESS.step.slopes(self._summed(mu), self.fading.data)
        by_own = by[0, OVERSTRESS.ends[2] :]
        by_q = np.einsum("jbn,jbq->q", by_own, theta_q[self.fading.places])
        sigma = self.stress_weights(mu)
        for rows, slopes in self.stress_by(theta_q):
            by_q += np.einsum("tqp,tp->q", slopes, sigma[rows])
        found[used] = by_q
        return stresses.pulled(self.xi, sigma, self.theta), np.zeros_like(self.xi), found

    def add_curvature(self, curvature: Curvature, mu: Array) -> None:
        """Add those by g and τ, and those by another.

        In place, to the N states of a `Curvature` that has those of Σ σ_k S_k. A branch's Σ μ_k m_k
        bends by (g, τ), and by these with Σ μ_k S_k, which moves with ξ and with moduli.
        """
        memory, places, at = self.memory, self.fading.places, (self._summed(mu), self.fading.data)
        elastic, own = self.body.elastic_places, slice(OVERSTRESS.ends[2], None)
        slopes, bent = OVERSTRESS.step.slopes(*at)[1], OVERSTRESS.step.curvature(*at)
        curvature.theta[:, places] += np.moveaxis(slopes[0, own], 2, 0)
        curvature.theta_theta[:, places[:, None], places] += np.moveaxis(bent[own, own], 3, 0)
        across = bent[own, 1]
        for number, of_branch in enumerate(memory.spread(np.eye(len(memory.branches)))):
            weights = memory.summed(of_branch * mu)
            by_xi = self.body.stresses.pulled(self.xi, weights, self.theta)
            for place, factor in zip(places[:, number], across[:, number], strict=True):
                curvature.position_theta[:, :, place] += factor[:, None] * by_xi
        for rows, by in self.stress_by(np.eye(len(self.theta))[:, elastic]):
            by_moduli = memory.totals(memory.borne(by) * mu[rows, None])
            both = np.einsum("jbt,bte->tjbe", across[..., rows], by_moduli)
            curvature.theta_theta[rows, places[..., None], elastic] += both
            curvature.theta_theta[rows, elastic, places[..., None]] += both


@dataclass(frozen=True, eq=False)
class Remembered:
    """The state of the memory at one time.

    Attributes
    ----------
    body, theta
    stress : (width,) S
    overstress : (all branches,) Q
    """

    body: Body
    theta: Array
    stress: Array
    overstress: Array

    @classmethod
    def at_start(cls, body: Body, x: Array, theta: Array, loaded_s: float) -> Remembered:
        """In the start shape x (3n,)."""
        return History.of(body, x[None], theta, np.ones(1), loaded_s).last

    def now(self, forces: Forces) -> Forces:
        """Forces in this very state, which bears this beside S."""
        found = self.body.memory.nothing(1)
        found.overstress[0] = self.body.memory.summed(self.overstress)
        return replace(forces, past=found)

    def ahead(self, forces: Forces, interval_s: float) -> Forces:
        """Forces in a state an interval later."""
        found, (brought, c) = self.body.memory.nothing(1), self._brought(interval_s)
        found.overstress[0] = self.body.memory.summed(brought)
        for branch, own in zip(self.body.memory.branches, c, strict=True):
            found.stiffening[0, branch.part] += own
        return replace(forces, past=found)

    def following(self, forces: Forces, x: Array, v: Array, interval_s: float) -> Remembered:
        """In the state x (3n,) an interval later."""
        memory, (brought, c) = self.body.memory, self._brought(interval_s)
        stress = self.body.stresses.stress(x[None], self.theta)[0]
        overstress = brought + memory.spread(c) * memory.borne(stress)
        return Remembered(self.body, self.theta, stress, overstress)

    def _brought(self, interval_s: float) -> tuple[Array, Array]:
        """E Q − c S of all branches, and c (B,)."""
        memory = self.body.memory
        share, tau_s = self.theta[[(b.share, b.tau) for b in memory.branches]].T
        e, c = fading(share, tau_s, interval_s)
        borne = memory.borne(self.stress)
        return memory.spread(e) * self.overstress - memory.spread(c) * borne, c


def at_start(forces: Forces, loaded_s: float) -> Forces:
    """Forces on a start shape that bears more than S, where a load has not been there for long."""
    body = forces.body
    if not body.remembers or np.isinf(loaded_s):
        return forces
    found = body.memory.nothing(1)
    c = Fading.of(body, forces.theta, np.ones(1), loaded_s).c
    for branch, own in zip(body.memory.branches, c, strict=True):
        found.stiffening[:, branch.part] += own
    return replace(forces, past=found)


class Slopes:
    """Columns dm of a history, evaluation after evaluation.

    Parameters
    ----------
    history : History
    theta_q : (k, columns) derivatives of θ
    done : int
        Evaluations that are known.
    known : (columns, all branches), optional
        `columns` after the last of them.
    """

    def __init__(
        self, history: History, theta_q: Array, done: int = 0, known: Array | None = None
    ) -> None:
        self.history, self.next, self.memory = history, done, history.memory
        self.stresses, self.theta = history.body.stresses, history.theta
        shape = theta_q.shape[1], history.brought.shape[1]
        self.columns = np.zeros(shape) if known is None else known.copy()
        # Work space, kept: fresh pages would cost as much as the numbers in them.
        self._stress = np.zeros((len(self.columns), self.stresses.width))
        self._state = np.zeros((len(self.columns), history.xi.shape[1]))
        self._direction = np.zeros_like(self._state)
        self._moduli = np.flatnonzero(theta_q[history.body.elastic_places].any(axis=0))
        self._theta_q, self._by_moduli = theta_q[:, self._moduli], np.zeros((0, 0, 0))
        fades = history.fading
        self._own = np.flatnonzero(theta_q[fades.places].any(axis=(0, 1)))
        self._d, self._a = map(self.memory.spread, (fades.d, fades.a))
        self._d_own, self._a_own = fades.along(theta_q[:, self._own])

    def force(self) -> Array:
        """What they add to dF at the next evaluation, (3n, columns)."""
        self._state[:] = self.history.xi[self.next]
        return self.stresses.force(self._state, self.memory.summed(self.columns), self.theta).T

    def advance(self, of_state: Callable[[], Array], _: Callable[[], Array]) -> None:
        """Go past the next evaluation, whose ξ changes by (3n, columns)."""
        k, history, stress, spread = self.next, self.history, self._stress, self.memory.spread
        self._state[:], self._direction[:] = history.xi[k], of_state().T
        # Of a single branch the stress itself is not needed.
        alone, a = len(self.memory.branches) == 1, self._a[k]
        self.columns *= self._d[k]
        if alone:
            stress = self.columns
            self._direction *= a
        else:
            stress.fill(0.0)
        self.stresses.along(self._state, self._direction, self.theta, stress)
        for column, slope in zip(self._moduli, self._slopes(k), strict=True):
            stress[column] += a * slope if alone else slope
        if not alone:
            self.columns += a * self.memory.borne(stress)
        m, borne = history.brought[k], self.memory.borne(history.stress[k])
        for j, column in enumerate(self._own):
            self.columns[column] += spread(self._d_own[j, :, k]) * m
            self.columns[column] += spread(self._a_own[j, :, k]) * borne
        self.next += 1

    def _slopes(self, k: int) -> Array:
        """(moduli, width) of S by what changes moduli."""
        if not len(self._moduli):
            return self._by_moduli
        if k % CHUNK == 0 or not len(self._by_moduli):
            first = k - k % CHUNK
            xi = self.history.xi[first : first + CHUNK]
            self._by_moduli = self.stresses.stress_by(xi, self.theta, self._theta_q)
        return self._by_moduli[k % CHUNK]


class Weights:
    """μ of a history, evaluation before evaluation."""

    def __init__(self, history: History) -> None:
        self.history, self.next = history, len(history.xi) - 1
        self.columns = np.zeros(history.brought.shape[1])

    def pulled(self) -> tuple[Array, Array]:
        """What position and velocity of the evaluation get through S, (3n,) each."""
        history, k = self.history, self.next
        weights = history.memory.summed(
            history.memory.spread(history.fading.a[:, k]) * self.columns
        )
        state = history.xi[k]
        by_x = history.body.stresses.pulled(state[None], weights[None], history.theta)[0]
        return by_x, np.zeros_like(by_x)

    def retreat(self, force_weight: Array) -> None:
        """Go before the evaluation, whose force has weights (3n,)."""
        history, k = self.history, self.next
        state, weight = history.xi[k][None], force_weight[None]
        push = history.body.stresses.against(state, weight, history.theta)[0]
        d = history.memory.spread(history.fading.d[:, k])
        self.columns = d * self.columns + history.memory.borne(push)
        self.next -= 1
