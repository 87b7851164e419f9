"""Internal variables of one force along a motion, with derivatives forward and backward in time.

See `point_forces` for the law of a force with internal variables h. At evaluation k, with the
previous variables b = h_{k−1}, columns of derivatives follow by the chain rule,

    dF_k ∋ ∂F/∂b db,   dh_k = ∂h/∂b db + ∂h/∂y dy_k + ∂h/∂ẏ dẏ_k + ∂h/∂c dc_k,

and backward in time, with weights λ_k of the forces and μ_k of h_k,

    μ_{k−1} = (∂h/∂b)ᵀ μ_k + (∂F/∂b)ᵀ λ_k,   y_k gets (∂h/∂y)ᵀ μ_k, and ẏ_k likewise.

`ForceHistory` holds all evaluations; `ForceForwardColumns` propagates columns forward,
`ForceAdjoint` propagates weights backward. `ForcePreviousState` is the state at one time, for
time-marching methods.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..common.array_types import Array, Index
from ..common.time_dependence import at_times
from ..fem.body import SecondDerivatives
from .force_term import States
from .forces import Forces
from .point_forces import LawDerivatives, Pointwise, PreviousState

# Number of evaluations whose derivatives are kept at a time; limits memory.
CHUNK = 16


@dataclass(frozen=True, eq=False)
class ForceHistory:
    """Internal variables of all instances of one force at N evaluations."""

    forces: Forces  # forces at all evaluations
    number: int  # index of the force in `Forces.external_terms`
    # (N, 3n): positions [m] and velocities [m/s] at the evaluations.
    xi: Array
    nu: Array
    # Internal variables of the previous evaluation, at each evaluation.
    previous_state: PreviousState

    @classmethod
    def from_states(
        cls,
        forces: Forces,
        number: int,
        xi: Array,
        nu: Array,
        since_s: Array,
        before: Array | None = None,
    ) -> ForceHistory:
        """Return the history along given states.

        Parameters
        ----------
        forces : Forces
            Forces at the N evaluations.
        number : int
            Index of the force in `Forces.external_terms`.
        xi, nu : (N, 3n)
            Positions [m] and velocities [m/s], the first of which are those of the start.
        since_s : (N,)
            Time since the previous evaluation; 0 at the start.
        before : (n, N, I), optional
            Given variables h_{k−1} at each evaluation, which are kept, not copied; computed from
            the states by default.
        """
        term = forces.pointwise_term(number)[0]
        shape = term.internal_variable_count, len(xi), term.points.count
        previous = PreviousState(np.zeros(shape) if before is None else before, since_s)
        history = cls(forces, number, xi=xi, nu=nu, previous_state=previous)
        if before is None:
            for k in range(len(xi) - 1):
                previous.before[:, k + 1] = history.internal_variables(slice(k, k + 1))[:, 0]
        return history

    def internal_variables(self, rows: slice) -> Array:
        """Return the internal variables h (n, T, I) after some evaluations."""
        return self.term_at(rows).internal_variables(self._states(rows))

    def term_at(self, rows: slice, variable_weights: Array | None = None) -> Pointwise:
        """Return the force term at some evaluations, with its previous internal variables.

        Parameters
        ----------
        rows : slice
            Indices of the evaluations.
        variable_weights : (n, T, I), optional
            Weights of h in second derivatives; 0 by default.
        """
        before, since_s = self.previous_state
        term = at_times(self.forces.pointwise_term(self.number)[0], rows)
        return term.with_previous_state(
            PreviousState(before[:, rows], since_s[rows]), variable_weights
        )

    def _states(self, rows: slice) -> States:
        """Return the states of the evaluations `rows`, with the velocities that the force uses."""
        term = self.forces.pointwise_term(self.number)[0]
        return self.forces.states_of_terms(self.xi[rows], self.nu[rows])(term)

    def insert_into(self, forces: Forces, rows: slice) -> Forces:
        """Return `forces`, given at the evaluations `rows` alone, with the previous internal
        variables of this force; the argument is unchanged.
        """
        return forces.with_term(self.number, self.term_at(rows))

    def extract_final_state(self) -> ForcePreviousState:
        """Return the state after the last evaluation."""
        last = slice(len(self.xi) - 1, None)
        return ForcePreviousState(
            self.number, self.term_at(last), after=self.internal_variables(last)
        )

    def derivatives(self, rows: slice) -> LawDerivatives:
        """Return the derivatives of F and h at the evaluations `rows`, each (d + n, …, T, I): first
        those of the d forces, then of the n internal variables.
        """
        return self._without_static_velocity(self.term_at(rows).derivatives(self._states(rows)))

    def _without_static_velocity(self, parts: LawDerivatives) -> LawDerivatives:
        """Derivatives; those by ẏ are zero in a static experiment without friction."""
        term = self.forces.pointwise_term(self.number)[0]
        rests = self.forces.is_static and not term.uses_increments
        return parts._replace(v=np.zeros_like(parts.v)) if rests else parts

    @property
    def input_columns(self) -> Index:
        """Columns (c,) of the force's constants among all inputs."""
        return self.forces.pointwise_term(self.number)[1]

    # Second derivatives of weights · F + μ · h ----------------------------------------------------

    def with_variable_weights(self, forces: Forces, mu: Array) -> Forces:
        """Return `forces`, given at all N evaluations, with the previous internal variables of this
        force and with weights μ (n, N, I) of h in second derivatives; the argument is unchanged.
        """
        return forces.with_term(self.number, self.term_at(slice(None), mu))

    def add_curvature(self, curvature: SecondDerivatives, mu: Array) -> None:
        """Do nothing: `with_variable_weights` already includes all second derivatives by states and
        inputs.
        """

    def mixed_second_derivatives(self, mu: Array, weights: Array) -> LawDerivatives:
        """Return the second derivatives of weights · F + μ · h by (u, b), each (…, n, N, I).

        Parameters
        ----------
        mu : (n, N, I)
            Weights of h.
        weights : (N, 3n)
            Weights of the forces.
        """
        all_rows = slice(None)
        return self._without_static_velocity(
            self.term_at(all_rows, mu).mixed_second_derivatives(self._states(all_rows), weights)
        )

    # Along a motion -------------------------------------------------------------------------------

    def forward_columns(
        self, by_p: Callable[[int], Array], done: int = 0, known: Array | None = None
    ) -> ForceForwardColumns:
        """Return an iterator of the columns db forward in time, see `ForceForwardColumns`.

        Parameters
        ----------
        by_p : callable
            Derivatives (U, columns) of the inputs at the evaluation with a given index.
        done : int
            Number of evaluations that have been passed already.
        known : array, optional
            Columns after those evaluations; 0 by default.
        """
        return ForceForwardColumns(self, by_p, done=done, known=known)

    def adjoint(self) -> ForceAdjoint:
        """Return an iterator of the weights μ backward in time, see `ForceAdjoint`."""
        return ForceAdjoint(self)

    def vector_jacobian_product(
        self, force_weights: Array, by_p: Array
    ) -> tuple[Array, Array, Array]:
        """Return the derivatives of Σ λ_k · F_k(h_{k−1}) through h, by ξ and ν (N, 3n) and by the
        parameters p (m,).

        Parameters
        ----------
        force_weights : (N, 3n)
            Weights λ of the forces.
        by_p : (N, U, m)
            Derivatives of the inputs by the parameters.
        """
        pulling = self.adjoint()
        by_xi = np.zeros_like(self.xi)
        by_nu = np.zeros_like(self.xi)
        by_parameters = np.zeros(by_p.shape[2])
        for k in reversed(range(len(self.xi))):
            by_xi[k], by_nu[k] = pulling.state_gradient()
            by_parameters += pulling.input_gradient() @ by_p[k][self.input_columns]
            pulling.step_back(force_weights[k])
        return by_xi, by_nu, by_parameters


@dataclass(frozen=True, eq=False)
class ForcePreviousState:
    """Internal variables of one force at one time, for time marching."""

    number: int  # index of the force in `Forces.external_terms`
    term: Pointwise  # force at that time, with the internal variables before it
    after: Array  # (n, 1, I): internal variables h after that time

    @classmethod
    def from_state(cls, forces: Forces, number: int, x: Array, v: Array) -> ForcePreviousState:
        """Return the internal variables h after an evaluation at (x, v), (3n,) each.

        Parameters
        ----------
        forces : Forces
            Forces at the time, with the internal variables before it.
        number : int
            Index of the force in `external_terms`.
        x, v : (3n,)
            Position [m] and velocity [m/s].
        """
        term = forces.pointwise_term(number)[0]
        return cls(number, term, after=term.internal_variables(forces.states_of_terms(x, v)(term)))

    def insert_at_same_time(self, forces: Forces) -> Forces:
        """Return `forces`, given at one time, in the same state, with the internal variables before
        it; the argument itself if there are none. It is unchanged.
        """
        previous = self.term.previous_state
        if previous is None:
            return forces
        return forces.with_term(
            self.number, forces.pointwise_term(self.number)[0].with_previous_state(previous)
        )

    def insert_after_interval(self, forces: Forces, interval_s: float) -> Forces:
        """Return `forces`, given at one time, an interval [s] later than this state, with the
        internal variables after this evaluation as the previous ones. The argument and self are
        unchanged.
        """
        previous = PreviousState(self.after, np.array([interval_s]))
        return forces.with_term(
            self.number, forces.pointwise_term(self.number)[0].with_previous_state(previous)
        )

    def advance(self, forces: Forces, x: Array, v: Array, interval_s: float) -> ForcePreviousState:
        """Return the internal variables in the state (x, v) one interval later; self is unchanged.

        Parameters
        ----------
        forces : Forces
            Forces at the later time.
        x, v : (3n,)
            Position [m] and velocity [m/s] at the later time; in a static experiment the
            displacement since the previous sample [m].
        interval_s : float
            Interval [s], positive: 0 would mean a start.
        """
        return ForcePreviousState.from_state(
            self.insert_after_interval(forces, interval_s), self.number, x=x, v=v
        )


class _DerivativeIterator:
    """Derivatives at one evaluation (`next`) after the other, in chunks; `columns` propagate."""

    def __init__(self, history: ForceHistory, at: int) -> None:
        self.history = history
        self.next = at
        self.points = history.forces.pointwise_term(history.number)[0].points
        self.shape = history.previous_state.before[:, 0].shape
        self._chunk = -1
        self._parts = LawDerivatives(*np.zeros((4, 0)))

    def derivatives(self) -> tuple[LawDerivatives, LawDerivatives]:
        """Return ∂F (d, …, I) and ∂h (n, …, I) at the next evaluation, without advancing."""
        chunk, k = divmod(self.next, CHUNK)
        d = self.points.dofs
        if chunk != self._chunk:
            self._chunk = chunk
            self._parts = self.history.derivatives(slice(chunk * CHUNK, (chunk + 1) * CHUNK))
        now = [part[:, :, k] for part in self._parts]
        return LawDerivatives(*(part[:d] for part in now)), LawDerivatives(
            *(part[d:] for part in now)
        )


class ForceForwardColumns(_DerivativeIterator):
    """Columns db of the internal variables, propagated forward in time.

    Parameters
    ----------
    by_p : callable
        Derivatives (U, columns) of the inputs at the evaluation with a given index.
    done : int
        Number of evaluations that have been passed already.
    known : (n, I, columns), optional
        Columns after those evaluations, which are copied; 0 by default.

    Attributes
    ----------
    columns : (n, I, columns)
        Derivatives of h_{k−1} at the next evaluation k.
    next : int
        Index of the next evaluation.
    """

    def __init__(
        self,
        history: ForceHistory,
        by_p: Callable[[int], Array],
        done: int = 0,
        known: Array | None = None,
    ) -> None:
        super().__init__(history, done)
        self.by_p = by_p
        shape = *self.shape, by_p(0).shape[1]
        self.columns = np.zeros(shape) if known is None else known.copy()

    def force_columns(self) -> Array:
        """Return the contribution of the internal variables to dF at the next evaluation, (3n,
        columns) [N]; the iterator does not advance.
        """
        contribution = np.einsum("abi,bic->aci", self.derivatives()[0].b, self.columns)
        return self.points.assemble(contribution).T

    def advance(self, of_state: Callable[[], Array], of_rate: Callable[[], Array]) -> None:
        """Pass the next evaluation: replace `columns` by a new array with the columns after it, and
        increase `next` by one.

        Parameters
        ----------
        of_state, of_rate : callable
            Functions without arguments that return the changes (3n, columns) of ξ and ν there;
            called only if the variables depend on them.
        """
        _, by = self.derivatives()
        of_inputs = self.by_p(self.next)[self.history.input_columns]
        columns = np.einsum("abi,bic->aic", by.b, self.columns)
        columns += np.einsum("abi,bc->aic", by.c, of_inputs)
        for part, state_change in ((by.y, of_state), (by.v, of_rate)):
            if part.any():
                columns += np.einsum("abi,bci->aic", part, self.points.vectors(state_change().T))
        self.columns = columns
        self.next = self.next + 1


class ForceAdjoint(_DerivativeIterator):
    """Weights μ of the internal variables, propagated backward in time.

    Attributes
    ----------
    columns : (n, I)
        Weights μ_k of the internal variables after the next evaluation k; zero at first.
    next : int
        Index of the next evaluation: at first that of the last one, −1 after all.
    """

    def __init__(self, history: ForceHistory) -> None:
        super().__init__(history, len(history.xi) - 1)
        self.columns = np.zeros(self.shape)

    def state_gradient(self) -> tuple[Array, Array]:
        """Return the derivatives of μ · h by ξ and ν of the next evaluation, (3n,) each; the
        iterator does not advance.
        """
        by = self.derivatives()[1]
        by_x, by_v = (
            self.points.assemble(self._weighted_by_mu(each)[:, None])[0] for each in (by.y, by.v)
        )
        return by_x, by_v

    def input_gradient(self) -> Array:
        """Return the derivatives (c,) of μ · h of the next evaluation by the constants of the
        force; the iterator does not advance.
        """
        return self._weighted_by_mu(self.derivatives()[1].c).sum(axis=1)

    def _weighted_by_mu(self, by: Array) -> Array:
        """Return the derivatives `by` (n, …, I) weighted by μ and summed over h."""
        return np.einsum("abi,ai->bi", by, self.columns)

    def step_back(self, force_weight: Array) -> None:
        """Pass the evaluation backward: replace `columns` by a new array with the weights μ before
        it, and decrease `next` by one.

        Parameters
        ----------
        force_weight : (3n,)
            Weights λ of its forces.
        """
        of_force, by = self.derivatives()
        weights = self.points.vectors(force_weight[None])[:, 0]
        pushes = np.einsum("abi,ai->bi", of_force.b, weights)
        self.columns = self._weighted_by_mu(by.b) + pushes
        self.next = self.next - 1
