"""Internal variables of one force along a motion, with derivatives forward and backward in time.

See `point_forces` for the law of a force with internal variables h. At evaluation k, with the
previous variables b = h_{k−1}, columns of derivatives follow by the chain rule,

    dF_k ∋ ∂F/∂b db,   dh_k = ∂h/∂b db + ∂h/∂y dy_k + ∂h/∂ẏ dẏ_k + ∂h/∂c dc_k,

and backward in time, with weights λ_k of the forces and μ_k of h_k,

    μ_{k−1} = (∂h/∂b)ᵀ μ_k + (∂F/∂b)ᵀ λ_k,   y_k gets (∂h/∂y)ᵀ μ_k, and ẏ_k likewise.

`ForceHistory` holds all evaluations; `Carrying` propagates columns forward, `Pulling` propagates
weights backward. `Left` is the state at one time, for time-marching methods.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..arrays import Array, Index
from ..fem.body import Curvature
from .force_term import States
from .forces import Forces
from .point_forces import Brought, Parts, Pointwise

# Number of evaluations whose derivatives are kept at a time; limits memory.
CHUNK = 16


@dataclass(frozen=True, eq=False)
class ForceHistory:
    """Internal variables of all instances of one force at N evaluations.

    Attributes
    ----------
    forces : Forces
        Forces at all evaluations.
    number : int
        Index of the force in `Forces.further`.
    xi, nu : (N, 3n)
        Positions [m] and velocities [m/s] at the evaluations.
    brought : Brought
        Internal variables of the previous evaluation, at each evaluation.
    """

    forces: Forces
    number: int
    xi: Array
    nu: Array
    brought: Brought

    @classmethod
    def of(
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
            Index of the force in `Forces.further`.
        xi, nu : (N, 3n)
            Positions [m] and velocities [m/s], the first of which are those of the start.
        since_s : (N,)
            Time since the previous evaluation; 0 at the start.
        before : (n, N, I), optional
            Given variables h_{k−1} at each evaluation; computed from the states by default.
        """
        term = forces.pointwise(number)[0]
        shape = term.carries, len(xi), term.points.count
        brought = Brought(np.zeros(shape) if before is None else before, since_s)
        history = cls(forces, number, xi, nu, brought)
        if before is None:
            for k in range(len(xi) - 1):
                brought.before[:, k + 1] = history.left(slice(k, k + 1))[:, 0]
        return history

    def left(self, rows: slice) -> Array:
        """Return the internal variables h (n, T, I) after some evaluations."""
        return self.at(rows).left(self._states(rows))

    def at(self, rows: slice, weighed: Array | None = None) -> Pointwise:
        """Return the force term at some evaluations, with its previous internal variables.

        Parameters
        ----------
        rows : slice
            Indices of the evaluations.
        weighed : (n, T, I), optional
            Weights of h in second derivatives; 0 by default.
        """
        before, since_s = self.brought
        term = self.forces.pointwise(self.number)[0].rows(rows)
        return term.bringing(Brought(before[:, rows], since_s[rows]), weighed)

    def _states(self, rows: slice) -> States:
        """Return the states of some evaluations, as the force uses them."""
        term = self.forces.pointwise(self.number)[0]
        return self.forces.states(self.xi[rows], self.nu[rows])(term)

    def onto(self, forces: Forces, rows: slice) -> Forces:
        """Return the forces of the evaluations `rows` with the previous internal variables of this
        force.
        """
        return forces.with_further(self.number, self.at(rows))

    @property
    def last(self) -> Left:
        """State after the last evaluation."""
        last = slice(len(self.xi) - 1, None)
        return Left(self.number, self.at(last), self.left(last))

    def parts(self, rows: slice) -> Parts:
        """Return the derivatives of F and h at some evaluations, each (d + n, …, T, I)."""
        return self._moved(self.at(rows).parts(self._states(rows)))

    def _moved(self, parts: Parts) -> Parts:
        """Return the derivatives, with those by ẏ zero if the force gets no velocities
        (statics).
        """
        term = self.forces.pointwise(self.number)[0]
        rests = self.forces.still and not term.slides
        return parts._replace(v=np.zeros_like(parts.v)) if rests else parts

    @property
    def columns(self) -> Index:
        """Columns (c,) of the force's constants among all inputs."""
        return self.forces.pointwise(self.number)[1]

    # Second derivatives of weights · F + μ · h ----------------------------------------------------

    def weighed(self, forces: Forces, mu: Array) -> Forces:
        """Return the forces of all evaluations, with weights μ (n, N, I) of h in second
        derivatives.
        """
        return forces.with_further(self.number, self.at(slice(None), mu))

    def add_curvature(self, curvature: Curvature, mu: Array) -> None:
        """Do nothing: `weighed` already includes all second derivatives by states and inputs."""

    def bent(self, mu: Array, weights: Array) -> Parts:
        """Return the second derivatives of weights · F + μ · h by (u, b), each (…, n, N, I).

        Parameters
        ----------
        mu : (n, N, I)
            Weights of h.
        weights : (N, 3n)
            Weights of the forces.
        """
        all_rows = slice(None)
        return self._moved(self.at(all_rows, mu).bent(self._states(all_rows), weights))

    # Along a motion -------------------------------------------------------------------------------

    def forward(
        self, by_p: Callable[[int], Array], done: int = 0, known: Array | None = None
    ) -> Carrying:
        """Return an iterator of the columns db forward in time, see `Carrying`."""
        return Carrying(self, by_p, done, known)

    def backward(self) -> Pulling:
        """Return an iterator of the weights μ backward in time, see `Pulling`."""
        return Pulling(self)

    def pulled(self, force_weights: Array, by_p: Array) -> tuple[Array, Array, Array]:
        """Return the derivatives of Σ λ_k F_k(h_{k−1}) through h by ξ and ν, (N, 3n) each, and by p
        (m,).

        Parameters
        ----------
        force_weights : (N, 3n)
            Weights λ of the forces.
        by_p : (N, U, m)
            Derivatives of the inputs by the parameters.
        """
        pulling = self.backward()
        by_xi = np.zeros_like(self.xi)
        by_nu = np.zeros_like(self.xi)
        by_parameters = np.zeros(by_p.shape[2])
        for k in reversed(range(len(self.xi))):
            by_xi[k], by_nu[k] = pulling.pulled()
            by_parameters += pulling.by_inputs() @ by_p[k][self.columns]
            pulling.retreat(force_weights[k])
        return by_xi, by_nu, by_parameters


@dataclass(frozen=True, eq=False)
class Left:
    """Internal variables of one force at one time, for time marching.

    Attributes
    ----------
    number : int
        Index of the force in `Forces.further`.
    term : Pointwise
        Force at that time, with the internal variables before it.
    after : (n, 1, I)
        Internal variables h after that time.
    """

    number: int
    term: Pointwise
    after: Array

    @classmethod
    def of(cls, forces: Forces, number: int, x: Array, v: Array) -> Left:
        """Return the internal variables after the state (x, v), (3n,) each, with the forces
        there.
        """
        term = forces.pointwise(number)[0]
        return cls(number, term, term.left(forces.states(x, v)(term)))

    def now(self, forces: Forces) -> Forces:
        """Return forces in the same state, with the internal variables before it."""
        brought = self.term.brought
        if brought is None:
            return forces
        return forces.with_further(self.number, forces.pointwise(self.number)[0].bringing(brought))

    def ahead(self, forces: Forces, interval_s: float) -> Forces:
        """Return forces in a state one interval later, with the internal variables `after`
        inserted.
        """
        brought = Brought(self.after, np.array([interval_s]))
        return forces.with_further(self.number, forces.pointwise(self.number)[0].bringing(brought))

    def following(self, forces: Forces, x: Array, v: Array, interval_s: float) -> Left:
        """Return the internal variables in the state (x, v) one interval later.

        Parameters
        ----------
        forces : Forces
            Forces at the later time.
        x, v : (3n,)
            Position [m] and velocity [m/s] at the later time.
        interval_s : float
        """
        return Left.of(self.ahead(forces, interval_s), self.number, x, v)


class _Along:
    """Derivatives of a history at one evaluation after the other, computed in chunks.

    Attributes
    ----------
    next : int
        Index of the evaluation that is next.
    columns : array
        What is propagated; defined by subclasses.
    """

    def __init__(self, history: ForceHistory, at: int) -> None:
        self.history = history
        self.next = at
        self.points = history.forces.pointwise(history.number)[0].points
        self.shape = history.brought.before[:, 0].shape
        self._chunk = -1
        self._parts = Parts(*np.zeros((4, 0)))

    def slopes(self) -> tuple[Parts, Parts]:
        """Return ∂F (d, …, I) and ∂h (n, …, I) at the next evaluation."""
        chunk, k = divmod(self.next, CHUNK)
        d = self.points.dofs
        if chunk != self._chunk:
            self._chunk = chunk
            self._parts = self.history.parts(slice(chunk * CHUNK, (chunk + 1) * CHUNK))
        now = [part[:, :, k] for part in self._parts]
        return Parts(*(part[:d] for part in now)), Parts(*(part[d:] for part in now))


class Carrying(_Along):
    """Columns db of the internal variables, propagated forward in time.

    Parameters
    ----------
    history : ForceHistory
    by_p : callable
        Derivatives (U, columns) of the inputs at the evaluation with a given index.
    done : int
        Number of evaluations that have been passed already.
    known : (n, I, columns), optional
        Columns after those evaluations; 0 by default.
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

    def force(self) -> Array:
        """Return the contribution of the internal variables to dF at the next evaluation, (3n,
        columns).
        """
        contribution = np.einsum("abi,bic->aci", self.slopes()[0].b, self.columns)
        return self.points.summed(contribution).T

    def advance(self, of_state: Callable[[], Array], of_rate: Callable[[], Array]) -> None:
        """Pass the next evaluation and update the columns, in place.

        Parameters
        ----------
        of_state, of_rate : callable
            Changes (3n, columns) of ξ and ν there; called only if the variables depend on them.
        """
        _, by = self.slopes()
        of_inputs = self.by_p(self.next)[self.history.columns]
        columns = np.einsum("abi,bic->aic", by.b, self.columns)
        columns += np.einsum("abi,bc->aic", by.c, of_inputs)
        for part, state_change in ((by.y, of_state), (by.v, of_rate)):
            if part.any():
                columns += np.einsum("abi,bci->aic", part, self.points.vectors(state_change().T))
        self.columns = columns
        self.next = self.next + 1


class Pulling(_Along):
    """Weights μ of the internal variables, propagated backward in time.

    Parameters
    ----------
    history : ForceHistory
    """

    def __init__(self, history: ForceHistory) -> None:
        super().__init__(history, len(history.xi) - 1)
        self.columns = np.zeros(self.shape)

    def pulled(self) -> tuple[Array, Array]:
        """Return the derivatives of μ · h by ξ and ν of the evaluation, (3n,) each."""
        by = self.slopes()[1]
        by_x, by_v = (self.points.summed(self._of(each)[:, None])[0] for each in (by.y, by.v))
        return by_x, by_v

    def by_inputs(self) -> Array:
        """Return the derivatives of μ · h by the constants (c,) of the force."""
        return self._of(self.slopes()[1].c).sum(axis=1)

    def _of(self, by: Array) -> Array:
        """Return the derivatives `by` (n, …, I) weighted by μ and summed over h."""
        return np.einsum("abi,ai->bi", by, self.columns)

    def retreat(self, force_weight: Array) -> None:
        """Pass the evaluation backward and update μ, in place.

        Parameters
        ----------
        force_weight : (3n,)
            Weights λ of its forces.
        """
        of_force, by = self.slopes()
        weights = self.points.vectors(force_weight[None])[:, 0]
        pushes = np.einsum("abi,ai->bi", of_force.b, weights)
        self.columns = self._of(by.b) + pushes
        self.next = self.next - 1
