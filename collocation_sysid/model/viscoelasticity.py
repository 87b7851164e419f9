"""Memory of a viscoelastic body along a motion, with derivatives forward and backward in time.

Use this module for the Prony branches of a material (see `fem.laws.memory`). The internal variables
that evaluation k passes to the next one are, for each branch,

    m_k = d_k m_{k−1} + a_k S_k,   d_k = e_{k+1},   a_k = e_{k+1} c_k − b_{k+1},

with the stress S of the long-term energy, and the overstress at evaluation k is H_k + s_k S_k with
H_k = Σ m_{k−1} and s_k = Σ c_k. If S changes linearly in time, b = c. The start shape has S_0 and
Q_0 = c_0 S_0, where c_0 = g exp(−t/τ) if a load was applied suddenly a time t ago; c_0 = 0 if the
body has relaxed. Columns of derivatives follow by the chain rule,

    dF_k ∋ ∂f_H/∂H Σ dm_{k−1},   dm_k = d_k dm_{k−1} + a_k dS_k + dd_k m_{k−1} + da_k S_k,

and backward in time, with weights λ_k of the forces and μ_k of m_k,

    μ_{k−1} = d_k μ_k + (∂f_H/∂H)ᵀ λ_k,   ξ_k gets (∂S_k/∂ξ_k)ᵀ Σ a_k μ_k.

`MemoryHistory` holds all evaluations; `MemoryForwardColumns` propagates columns forward,
`MemoryAdjoint` propagates weights backward; `MemoryState` is the state at one time, for time
marching. The recursion is one of `recursion`; since it is linear in m and S, all points of a branch
share its coefficients. The memory is not a force with internal variables at the quadrature points
(`force_internal_variables`), because a sweep would take 1.9 to 3 times as long, see "Memory in
reduced space" in `docs/theory.md`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from ..common.array_types import Array, Index
from ..fem.body import Body, SecondDerivatives
from ..fem.laws.memory import MemoryInput
from .forces import Forces
from .generated_functions import GeneratedFunction
from .recursion import Recursion, relaxation_coefficients

# Number of evaluations whose stress derivatives are kept at a time; limits memory.
EVALUATIONS_PER_CHUNK = 16


def _interval_coefficients(u: ca.SX, data: ca.SX) -> ca.SX:
    """Return e, c and b (3,) of an interval, Q_k = e Q_{k−1} + c S_k − b S_{k−1}, with u = (g, τ).

    Data are the length of the interval, and 1 in a steady oscillation, else 0. S changes linearly, or
    the interval is a quarter of the period of the oscillation: with ωτ = w the complex modulus of a
    branch is g iw/(1 + iw), and the part of S that is a quarter period late is −S_{k−1}.
    """
    spacing_s, steady = data[0], data[1]
    e, c = relaxation_coefficients(u[1] / spacing_s)
    w = np.pi / 2 * u[1] / spacing_s
    in_phase = w**2 / (1 + w**2)
    return ca.vertcat(
        (1 - steady) * e,
        u[0] * ((1 - steady) * c + steady * in_phase),
        u[0] * ((1 - steady) * c + steady * w / (1 + w**2)),
    )


def _stiffening(u: ca.SX, data: ca.SX) -> ca.SX:
    """Return the coefficient c of an evaluation, with u = (g, τ); at the start the share g e^(−t/τ)
    of a load that was applied a time t before. See `_overstress` for the data.
    """
    since_s = data[0]
    began = data[1]
    at_once = u[0] * ca.exp(-since_s / u[1])
    over_interval = _interval_coefficients(u, ca.vertcat(since_s + began, data[3]))[1]
    return began * at_once + (1 - began) * over_interval


def _overstress(before: ca.SX, now: ca.SX, _: ca.SX, u: ca.SX, data: ca.SX) -> ca.SX:
    """Return m_k from m_{k−1} (`before`) and S_k (`now`), with u = (g, τ).

    Data are the time since the previous evaluation, or at the start since the load was applied; 1
    at the start, else 0; the time to the next evaluation; and 1 in a steady oscillation, else 0.
    """
    e, _, b = ca.vertsplit(_interval_coefficients(u, data[2:]))
    return e * before + (e * _stiffening(u, data) - b) * now


OVERSTRESS = Recursion(_overstress, 1, signal_size=1, constant_count=2, data_size=4)


def _coefficients(u: ca.SX, data: ca.SX) -> ca.SX:
    """Return c, and d, a of the recursion m_k = d m_{k−1} + a S_k: Q_k = m_{k−1} + c S_k."""
    return ca.vertcat(_stiffening(u, data), OVERSTRESS.linear_coefficients(u, data)[:2])


COEFFICIENTS = GeneratedFunction(_coefficients, 2, data_size=4)
STIFFENING = GeneratedFunction(_stiffening, 2, data_size=4)
INTERVAL = GeneratedFunction(_interval_coefficients, 2, data_size=2)


@dataclass(frozen=True, eq=False)
class FadingCoefficients:
    """Coefficients c, d and a of B branches at N evaluations, with derivatives by g and τ."""

    places: Index  # (2, B): indices of g and τ in θ
    u: Array  # (2, B, N): values of g and τ
    data: Array  # (4, B, N): times, see `_overstress`
    # (B, N): .
    c: Array
    d: Array
    a: Array
    by: Array  # (3, 2, B, N): derivatives of c, d and a by g and τ

    @classmethod
    def from_body(
        cls, body: Body, theta: Array, until_next_s: Array, loaded_s: float
    ) -> FadingCoefficients:
        """Return the coefficients of all branches of a body.

        Parameters
        ----------
        body : Body
            Body with memory (IndexError otherwise).
        theta : (k,)
            Constants of the body.
        until_next_s : (N,)
            Time from each evaluation to the next.
        loaded_s : float
            Time for which the body has been in its start shape; infinite if its memory has relaxed.
        """
        places = np.array([(each.share, each.tau) for each in body.memory.branches]).T
        branches = len(body.memory.branches)
        shape = (branches, len(until_next_s))
        since_s = np.empty(shape)
        # exp(−1000) is 0 in doubles.
        since_s[:, 0] = np.minimum(loaded_s, 1e3 * theta[places[1]])
        since_s[:, 1:] = until_next_s[:-1]
        began = np.broadcast_to(np.arange(shape[1]) == 0, shape)
        steady = np.full(shape, float(body.memory.oscillates))
        data = np.stack([since_s, began, np.broadcast_to(until_next_s, shape), steady])
        u = np.broadcast_to(theta[places][..., None], (2, branches, len(until_next_s)))
        (c, d, a), by = COEFFICIENTS.evaluate_with_jacobian(u, data)
        return cls(places, u, data=data, c=c, d=d, a=a, by=by)

    def jacobian_vector_product(self, theta_q: Array) -> tuple[Array, Array]:
        """Return the derivatives (q, B, N) of the coefficients d and a along the q directions
        `theta_q` (k, q) of θ.
        """
        d_q, a_q = np.einsum("cjbn,jbq->cqbn", self.by[1:], theta_q[self.places])
        return d_q, a_q


@dataclass(frozen=True, eq=False)
class MemoryHistory:
    """Memory of the material at the evaluations of a motion."""

    body: Body
    theta: Array  # (k,): constants of the body
    xi: Array  # (N, 3n): positions at the evaluations [m]
    stress: Array  # (N, width): long-term stress S at all points
    fading: FadingCoefficients  # coefficients of the recursion
    previous_variables: Array  # (N, all branches): internal variables m_{k−1} at each evaluation

    @classmethod
    def from_states(
        cls,
        body: Body,
        xi: Array,
        theta: Array,
        until_next_s: Array,
        loaded_s: float,
        previous_variables: Array | None = None,
    ) -> MemoryHistory:
        """Return the memory along given states.

        Parameters
        ----------
        body : Body
            Body with memory (IndexError otherwise).
        xi : (N, 3n)
            Positions at the evaluations, the first of which is the start [m].
        theta : (k,)
            Constants of the body.
        until_next_s : (N,)
            Time from each evaluation to the next.
        loaded_s : float
            Time for which the body has been in its start shape; infinite if its memory has relaxed.
        previous_variables : (N, all branches), optional
            Given internal variables m_{k−1} [Pa], which are kept, not copied; computed from the
            states by default.
        """
        stress = body.stresses.stress(xi, theta)
        fades = FadingCoefficients.from_body(
            body, theta, until_next_s=until_next_s, loaded_s=loaded_s
        )
        if previous_variables is None:
            borne = body.memory.to_branches(stress)
            d, a = map(body.memory.repeat_over_points, (fades.d, fades.a))
            previous_variables = np.zeros(borne.shape)
            for k in range(len(previous_variables) - 1):
                previous_variables[k + 1] = d[k] * previous_variables[k] + a[k] * borne[k]
        return cls(
            body, theta, xi=xi, stress=stress, fading=fades, previous_variables=previous_variables
        )

    def past_at(self, rows: slice) -> MemoryInput:
        """Return the memory's contribution to the forces at the evaluations `rows`, in new arrays.

        The overstress is H = Σ m_{k−1}, the stiffening of each part Σ c_k of its branches, with
        first and second derivatives by θ.
        """
        past = self.body.memory.relaxed(len(self.xi[rows]))
        fades = self.fading
        past.overstress[:] = self.body.memory.sum_over_branches(self.previous_variables[rows])
        for branch, c in zip(self.body.memory.branches, fades.c, strict=True):
            past.stiffening[:, branch.part] += c[rows]
        second = STIFFENING.weighted_hessian(fades.u, fades.data)
        past.stiffening_derivatives[:, fades.places] = np.moveaxis(fades.by[0, ..., rows], 2, 0)
        past.stiffening_second_derivatives[:, fades.places[:, None], fades.places] = np.moveaxis(
            second[..., rows], 3, 0
        )
        return past

    def insert_into(self, forces: Forces, rows: slice) -> Forces:
        """Return `forces`, given at the evaluations `rows` alone, with the memory at these
        evaluations, which replaces their `memory_state`; the argument is unchanged.
        """
        return replace(forces, memory_state=self.past_at(rows))

    def with_variable_weights(self, forces: Forces, mu: Array) -> Forces:
        """Return forces with the memory and with weights μ of a_k S_k in second derivatives.

        Parameters
        ----------
        forces : Forces
            Forces at all N evaluations; not modified.
        mu : (N, all branches)
        """
        past = replace(self.past_at(slice(None)), stress_weights=self.stress_weights(mu))
        return replace(forces, memory_state=past)

    def forward_columns(
        self, by_p: Callable[[int], Array], done: int = 0, known: Array | None = None
    ) -> MemoryForwardColumns:
        """Return an iterator of the columns dm forward in time, see `MemoryForwardColumns`.

        Parameters
        ----------
        by_p : callable
            Derivatives (U, columns) of the inputs at the evaluation with a given index.
        done : int
            Number of evaluations that have been passed already.
        known : (columns, all branches), optional
            Columns after those evaluations; 0 by default.
        """
        return MemoryForwardColumns(self, by_p(0)[: len(self.theta)], done=done, known=known)

    def adjoint(self) -> MemoryAdjoint:
        """Return an iterator of the weights μ backward in time, see `MemoryAdjoint`."""
        return MemoryAdjoint(self)

    def extract_final_state(self) -> MemoryState:
        """Return the state of the memory after the last evaluation."""
        c = self.body.memory.repeat_over_points(self.fading.c)[-1]
        overstress = self.previous_variables[-1] + c * self.body.memory.to_branches(self.stress[-1])
        return MemoryState(self.body, self.theta, stress=self.stress[-1], overstress=overstress)

    def compute_recursion_residuals(self) -> Array:
        """Return the residuals m_k − d_k m_{k−1} − a_k S_k for k = 0 … N − 2 (N − 1, all branches)
        [Pa]; zero if `previous_variables` satisfy the recursion, as those do that are computed from
        the states.
        """
        d, a = (
            self.body.memory.repeat_over_points(each[:, :-1])
            for each in (self.fading.d, self.fading.a)
        )
        m = self.previous_variables
        borne = self.body.memory.to_branches(self.stress[:-1])
        return m[1:] - d * m[:-1] - a * borne

    # Derivatives of Σ μ_k (d_k m_{k−1} + a_k S_k), μ (N, all branches) --------------------------

    def stress_weights(self, mu: Array) -> Array:
        """Return σ_k (N, width) such that Σ μ_k a_k S_k = Σ σ_k S_k, for weights μ (N, all
        branches).
        """
        return self.body.memory.sum_over_branches(
            self.body.memory.repeat_over_points(self.fading.a) * mu
        )

    def _overstress_inputs(self, mu: Array) -> Array:
        """Inputs (5, B, N) whose value is Σ μ_k m_k: the recursion is linear in m and S."""
        borne = self.body.memory.to_branches(self.stress)
        before, now = (
            self.body.memory.sum_over_points(mu * each) for each in (self.previous_variables, borne)
        )
        return np.stack([before, now, 0 * now, *self.fading.u])

    def stress_derivatives(self, theta_q: Array) -> Iterator[tuple[slice, Array]]:
        """Yield consecutive slices of at most `EVALUATIONS_PER_CHUNK` evaluations, each with the
        derivatives ∂S/∂θ θ_q (T, q, width) there, for q directions θ_q (k, q) in θ.
        """
        for start in range(0, len(self.xi), EVALUATIONS_PER_CHUNK):
            rows = slice(start, start + EVALUATIONS_PER_CHUNK)
            yield (
                rows,
                self.body.stresses.stress_theta_derivatives(
                    self.xi[rows], self.theta, theta_q=theta_q
                ),
            )

    def vector_jacobian_product(
        self, force_weights: Array, by_p: Array
    ) -> tuple[Array, Array, Array]:
        """Return the derivatives of Σ λ_k · f_H(H_k) through H, by ξ and ν (N, 3n) and by the
        parameters p (m,); those by ν are zero.

        Parameters
        ----------
        force_weights : (N, 3n)
            Weights λ of the forces.
        by_p : (N, U, m)
            Derivatives of the inputs by the parameters.
        """
        theta_p = by_p[0, : len(self.theta)]
        used = np.flatnonzero(theta_p.any(axis=0))
        theta_q = theta_p[:, used]
        by_parameters = np.zeros(theta_p.shape[1])
        stresses = self.body.stresses
        d = self.body.memory.repeat_over_points(self.fading.d)
        pushes = self.body.memory.to_branches(
            stresses.memory_force_vjp(self.xi, force_weights, theta=self.theta)
        )
        mu = np.zeros_like(pushes)
        for k in range(len(mu) - 1, 0, -1):
            mu[k - 1] = d[k] * mu[k] + pushes[k]
        _, by = OVERSTRESS.step_function.evaluate_with_jacobian(
            self._overstress_inputs(mu), self.fading.data
        )
        by_fading = by[0, OVERSTRESS.input_offsets[2] :]
        by_q = np.einsum("jbn,jbq->q", by_fading, theta_q[self.fading.places])
        sigma = self.stress_weights(mu)
        for rows, slopes in self.stress_derivatives(theta_q):
            by_q += np.einsum("tqp,tp->q", slopes, sigma[rows])
        by_parameters[used] = by_q
        by_xi = stresses.stress_vjp(self.xi, sigma, theta=self.theta)
        return by_xi, np.zeros_like(self.xi), by_parameters

    def add_curvature(self, curvature: SecondDerivatives, mu: Array) -> None:
        """Add the second derivatives of Σ μ_k (d_k m_{k−1} + a_k S_k) that involve (g, τ).

        The derivatives are added in place to the N states of a `SecondDerivatives` that already has
        those of Σ σ_k S_k, see `with_variable_weights`. Mixed derivatives are those with ξ and with
        elastic constants, through S.

        Parameters
        ----------
        curvature : SecondDerivatives
            Second derivatives of the forces; modified.
        mu : (N, all branches)
            Weights μ.
        """
        memory = self.body.memory
        places = self.fading.places
        inputs = self._overstress_inputs(mu)
        data = self.fading.data
        elastic = self.body.elastic_indices
        fading_inputs = slice(OVERSTRESS.input_offsets[2], None)
        slopes = OVERSTRESS.step_function.evaluate_with_jacobian(inputs, data)[1]
        second = OVERSTRESS.step_function.weighted_hessian(inputs, data)
        curvature.theta[:, places] += np.moveaxis(slopes[0, fading_inputs], 2, 0)
        curvature.theta_theta[:, places[:, None], places] += np.moveaxis(
            second[fading_inputs, fading_inputs], 3, 0
        )
        mixed = second[fading_inputs, 1]
        for number, branch_mask in enumerate(
            memory.repeat_over_points(np.eye(len(memory.branches)))
        ):
            weights = memory.sum_over_branches(branch_mask * mu)
            by_xi = self.body.stresses.stress_vjp(self.xi, weights, theta=self.theta)
            for place, factor in zip(places[:, number], mixed[:, number], strict=True):
                curvature.position_theta[:, :, place] += factor[:, None] * by_xi
        for rows, by in self.stress_derivatives(np.eye(len(self.theta))[:, elastic]):
            by_moduli = memory.sum_over_points(memory.to_branches(by) * mu[rows, None])
            both = np.einsum("jbt,bte->tjbe", mixed[..., rows], by_moduli)
            curvature.theta_theta[rows, places[..., None], elastic] += both
            curvature.theta_theta[rows, elastic, places[..., None]] += both


@dataclass(frozen=True, eq=False)
class MemoryState:
    """State of the material's memory at one time, for time marching."""

    body: Body
    theta: Array  # (k,): constants of the body
    stress: Array  # (width,): long-term stress S
    overstress: Array  # (all branches,): overstress Q of each branch

    @classmethod
    def at_start(cls, body: Body, x: Array, theta: Array, loaded_s: float) -> MemoryState:
        """Return the memory in the start shape x (3n,) [m] of a body with constants θ (k,), which
        has been loaded for a time `loaded_s` [s]; infinite if the memory has relaxed.

        The body must have memory (IndexError otherwise).
        """
        return MemoryHistory.from_states(
            body, x[None], theta=theta, until_next_s=np.ones(1), loaded_s=loaded_s
        ).extract_final_state()

    def insert_at_same_time(self, forces: Forces) -> Forces:
        """Return `forces`, given at one time, in the state of this memory: with its overstress Q,
        which replaces their `memory_state`. The argument and self are unchanged.
        """
        past = self.body.memory.relaxed(1)
        past.overstress[0] = self.body.memory.sum_over_branches(self.overstress)
        return replace(forces, memory_state=past)

    def insert_after_interval(self, forces: Forces, interval_s: float) -> Forces:
        """Return `forces`, given at one time, an interval [s] later than this state: their
        `memory_state` is replaced by the overstress that remains and the stiffening by the memory.
        The argument and self are unchanged.
        """
        past = self.body.memory.relaxed(1)
        previous, c = self._after_interval(interval_s)
        past.overstress[0] = self.body.memory.sum_over_branches(previous)
        for branch, own in zip(self.body.memory.branches, c, strict=True):
            past.stiffening[0, branch.part] += own
        return replace(forces, memory_state=past)

    def advance(self, forces: Forces, x: Array, v: Array, interval_s: float) -> MemoryState:
        """Return the memory in the state x (3n,) [m] that follows after an interval [s]; `self` is
        unchanged.

        Forces and velocity are not used.
        """
        memory = self.body.memory
        previous, c = self._after_interval(interval_s)
        stress = self.body.stresses.stress(x[None], self.theta)[0]
        overstress = previous + memory.repeat_over_points(c) * memory.to_branches(stress)
        return MemoryState(self.body, self.theta, stress=stress, overstress=overstress)

    def _after_interval(self, interval_s: float) -> tuple[Array, Array]:
        """Return e Q − b S (all branches,) [Pa] and the coefficients c (B,)."""
        memory = self.body.memory
        u = self.theta[[(b.share, b.tau) for b in memory.branches]].T
        data = np.tile([[interval_s], [float(memory.oscillates)]], u.shape[1])
        e, c, b = INTERVAL.evaluate(u, data)
        borne = memory.to_branches(self.stress)
        return memory.repeat_over_points(e) * self.overstress - memory.repeat_over_points(
            b
        ) * borne, c


def with_start_memory(forces: Forces, loaded_s: float) -> Forces:
    """Return forces on the start shape, with the additional stiffness of a load that was applied a
    time `loaded_s` [s] ago: Q = g e^(−t/τ) S.

    If `loaded_s` is infinite, the argument itself is returned. Otherwise it is unchanged; it must be
    given at one time, and its `memory_state` is replaced in the result.
    """
    body = forces.body
    if np.isinf(loaded_s):
        return forces
    past = body.memory.relaxed(1)
    c = FadingCoefficients.from_body(
        body, forces.theta, until_next_s=np.ones(1), loaded_s=loaded_s
    ).c
    for branch, own in zip(body.memory.branches, c, strict=True):
        past.stiffening[:, branch.part] += own
    return replace(forces, memory_state=past)


class MemoryForwardColumns:
    """Columns dm of the internal variables, propagated forward in time.

    Parameters
    ----------
    theta_q : (k, columns)
        Derivatives of θ.
    done : int
        Number of evaluations that have been passed already.
    known : (columns, all branches), optional
        Columns after those evaluations, which are copied; 0 by default.

    Attributes
    ----------
    columns : (columns, all branches)
        Derivatives dm_{k−1} at the next evaluation k.
    next : int
        Index of the next evaluation.
    """

    def __init__(
        self, history: MemoryHistory, theta_q: Array, done: int = 0, known: Array | None = None
    ) -> None:
        self.history = history
        self.next = done
        self.memory = history.body.memory
        self.stresses = history.body.stresses
        self.theta = history.theta
        shape = theta_q.shape[1], history.previous_variables.shape[1]
        self.columns = np.zeros(shape) if known is None else known.copy()
        # Work space, kept: fresh pages would cost as much as the numbers in them.
        self._stress = np.zeros((len(self.columns), self.stresses.width))
        self._state = np.zeros((len(self.columns), history.xi.shape[1]))
        self._direction = np.zeros_like(self._state)
        self._moduli = np.flatnonzero(theta_q[history.body.elastic_indices].any(axis=0))
        self._theta_q = theta_q[:, self._moduli]
        self._by_moduli = np.zeros((0, 0, 0))
        fades = history.fading
        self._own = np.flatnonzero(theta_q[fades.places].any(axis=(0, 1)))
        self._d, self._a = map(self.memory.repeat_over_points, (fades.d, fades.a))
        self._d_own, self._a_own = fades.jacobian_vector_product(theta_q[:, self._own])

    def force_columns(self) -> Array:
        """Return the contribution of the memory to dF at the next evaluation, (3n, columns); the
        iterator does not advance.
        """
        self._state[:] = self.history.xi[self.next]
        return self.stresses.memory_force(
            self._state, self.memory.sum_over_branches(self.columns), theta=self.theta
        ).T

    def advance(self, of_state: Callable[[], Array], _: Callable[[], Array]) -> None:
        """Pass the next evaluation: overwrite `columns` with the columns after it, and increase
        `next` by one.

        Parameters
        ----------
        of_state : callable
            Function without arguments that returns the change (3n, columns) of ξ there; the second
            argument, that of ν, is not used.
        """
        k = self.next
        history = self.history
        stress = self._stress
        spread = self.memory.repeat_over_points
        self._state[:] = history.xi[k]
        self._direction[:] = of_state().T
        # Of a single branch the stress itself is not needed.
        alone = len(self.memory.branches) == 1
        a = self._a[k]
        self.columns *= self._d[k]
        if alone:
            stress = self.columns
            self._direction *= a
        else:
            stress.fill(0.0)
        self.stresses.stress_jvp(self._state, self._direction, theta=self.theta, out=stress)
        for column, slope in zip(self._moduli, self._elastic_stress_derivatives(k), strict=True):
            stress[column] += a * slope if alone else slope
        if not alone:
            self.columns += a * self.memory.to_branches(stress)
        m = history.previous_variables[k]
        borne = self.memory.to_branches(history.stress[k])
        for j, column in enumerate(self._own):
            self.columns[column] += spread(self._d_own[j, :, k]) * m
            self.columns[column] += spread(self._a_own[j, :, k]) * borne
        self.next += 1

    def _elastic_stress_derivatives(self, k: int) -> Array:
        """∂S (c, width) at evaluation k, which must not decrease."""
        if not len(self._moduli):
            return self._by_moduli
        if k % EVALUATIONS_PER_CHUNK == 0 or not len(self._by_moduli):
            first = k - k % EVALUATIONS_PER_CHUNK
            xi = self.history.xi[first : first + EVALUATIONS_PER_CHUNK]
            self._by_moduli = self.stresses.stress_theta_derivatives(
                xi, self.theta, theta_q=self._theta_q
            )
        return self._by_moduli[k % EVALUATIONS_PER_CHUNK]


class MemoryAdjoint:
    """Weights μ of the internal variables, propagated backward in time.

    Attributes
    ----------
    columns : (all branches,)
        Weights μ_k of the internal variables after the next evaluation k; zero at first.
    next : int
        Index of the next evaluation: at first that of the last one, −1 after all.
    """

    def __init__(self, history: MemoryHistory) -> None:
        self.history = history
        self.next = len(history.xi) - 1
        self.columns = np.zeros(history.previous_variables.shape[1])

    def state_gradient(self) -> tuple[Array, Array]:
        """Return the derivatives of μ · m by ξ and ν of the evaluation, (3n,) each; by ν zero."""
        history = self.history
        k = self.next
        weights = history.body.memory.sum_over_branches(
            history.body.memory.repeat_over_points(history.fading.a[:, k]) * self.columns
        )
        state = history.xi[k]
        by_x = history.body.stresses.stress_vjp(state[None], weights[None], theta=history.theta)[0]
        return by_x, np.zeros_like(by_x)

    def step_back(self, force_weight: Array) -> None:
        """Pass the evaluation backward: replace `columns` by a new array with the weights μ before
        it, and decrease `next` by one.

        Parameters
        ----------
        force_weight : (3n,)
            Weights λ of its forces.
        """
        history = self.history
        k = self.next
        state = history.xi[k][None]
        weight = force_weight[None]
        push = history.body.stresses.memory_force_vjp(state, weight, theta=history.theta)[0]
        d = history.body.memory.repeat_over_points(history.fading.d[:, k])
        self.columns = d * self.columns + history.body.memory.to_branches(push)
        self.next -= 1
