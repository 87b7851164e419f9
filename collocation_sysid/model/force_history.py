"""What instances of a force carry along a motion, with derivatives forward and backward in time.

See `point_forces`: at evaluation k, with b = h_{k−1} what it brings, columns follow by the chain
rule,

    dF_k ∋ ∂F/∂b db,   dh_k = ∂h/∂b db + ∂h/∂y dy_k + ∂h/∂ẏ dẏ_k + ∂h/∂c dc_k,

and backward, with weights λ_k of the forces and μ_k of h_k,

    μ_{k−1} = (∂h/∂b)ᵀ μ_k + (∂F/∂b)ᵀ λ_k,   y_k gets (∂h/∂y)ᵀ μ_k, and ẏ_k likewise.
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

# Slopes of so many evaluations are kept at a time.
CHUNK = 16


@dataclass(frozen=True, eq=False)
class ForceHistory:
    """What one force's instances have been through at N evaluations.

    Attributes
    ----------
    forces : Forces
        At all of them.
    number : int
        Of the force among the further ones.
    xi, nu : (N, 3n)
    brought : Brought
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
        """Of states (N, 3n), the first of which is the start; `before` follows, if not given."""
        term = forces.pointwise(number)[0]
        shape = term.carries, len(xi), term.points.count
        brought = Brought(np.zeros(shape) if before is None else before, since_s)
        made = cls(forces, number, xi, nu, brought)
        if before is None:
            for k in range(len(xi) - 1):
                brought.before[:, k + 1] = made.left(slice(k, k + 1))[:, 0]
        return made

    def left(self, rows: slice) -> Array:
        """(n, T, I) h of some evaluations."""
        return self.at(rows).left(self._states(rows))

    def at(self, rows: slice, weighed: Array | None = None) -> Pointwise:
        """The force at some evaluations, and what they bring."""
        before, since_s = self.brought
        term = self.forces.pointwise(self.number)[0].rows(rows)
        return term.bringing(Brought(before[:, rows], since_s[rows]), weighed)

    def _states(self, rows: slice) -> States:
        term = self.forces.pointwise(self.number)[0]
        return self.forces.states(self.xi[rows], self.nu[rows])(term)

    def onto(self, forces: Forces, rows: slice) -> Forces:
        """Forces of some evaluations with what these bring."""
        return forces.with_further(self.number, self.at(rows))

    @property
    def last(self) -> Left:
        """After the last evaluation."""
        last = slice(len(self.xi) - 1, None)
        return Left(self.number, self.at(last), self.left(last))

    def parts(self, rows: slice) -> Parts:
        """Slopes of F and h at some evaluations, (d + n, …, T, I)."""
        return self._moved(self.at(rows).parts(self._states(rows)))

    def _moved(self, parts: Parts) -> Parts:
        """Without what stands by velocities, where these are none to it."""
        term = self.forces.pointwise(self.number)[0]
        rests = self.forces.still and not term.slides
        return parts._replace(v=np.zeros_like(parts.v)) if rests else parts

    @property
    def columns(self) -> Index:
        """(c,) where in the inputs those are that it takes."""
        return self.forces.pointwise(self.number)[1]

    # Second derivatives of weights · F + μ · h ----------------------------------------------------

    def weighed(self, forces: Forces, mu: Array) -> Forces:
        """The forces of all evaluations, where h counts μ (n, N, I) besides."""
        return forces.with_further(self.number, self.at(slice(None), mu))

    def add_curvature(self, curvature: Curvature, mu: Array) -> None:
        """All by states and inputs are those of `weighed`."""

    def bent(self, mu: Array, weights: Array) -> Parts:
        """By u and b (…, n, N, I), of weights (N, 3n)."""
        every = slice(None)
        return self._moved(self.at(every, mu).bent(self._states(every), weights))

    # Along a motion -------------------------------------------------------------------------------

    def forward(
        self, by_p: Callable[[int], Array], done: int = 0, known: Array | None = None
    ) -> Carrying:
        """Columns of what is carried, see `Carrying`."""
        return Carrying(self, by_p, done, known)

    def backward(self) -> Pulling:
        """Its weights, see `Pulling`."""
        return Pulling(self)

    def pulled(self, force_weights: Array, by_p: Array) -> tuple[Array, Array, Array]:
        """Slopes of Σ λ_k F_k(h_{k−1}) through h, by ξ and ν (N, 3n) and by p.

        Parameters
        ----------
        force_weights : (N, 3n) λ
        by_p : (N, U, m) derivatives of the inputs
        """
        pulling = self.backward()
        by_xi, by_nu = np.zeros_like(self.xi), np.zeros_like(self.xi)
        found = np.zeros(by_p.shape[2])
        for k in reversed(range(len(self.xi))):
            by_xi[k], by_nu[k] = pulling.pulled()
            found += pulling.by_inputs() @ by_p[k][self.columns]
            pulling.retreat(force_weights[k])
        return by_xi, by_nu, found


@dataclass(frozen=True, eq=False)
class Left:
    """What instances have and leave at one time.

    Attributes
    ----------
    number : int
    term : Pointwise
        At that time, and what that brings.
    after : (n, 1, I) h
    """

    number: int
    term: Pointwise
    after: Array

    @classmethod
    def of(cls, forces: Forces, number: int, x: Array, v: Array) -> Left:
        """Of forces at one state, each (3n,)."""
        term = forces.pointwise(number)[0]
        return cls(number, term, term.left(forces.states(x, v)(term)))

    def now(self, forces: Forces) -> Forces:
        """Forces in this very state."""
        brought = self.term.brought
        if brought is None:
            return forces
        return forces.with_further(self.number, forces.pointwise(self.number)[0].bringing(brought))

    def ahead(self, forces: Forces, interval_s: float) -> Forces:
        """Forces in a state an interval later."""
        brought = Brought(self.after, np.array([interval_s]))
        return forces.with_further(self.number, forces.pointwise(self.number)[0].bringing(brought))

    def following(self, forces: Forces, x: Array, v: Array, interval_s: float) -> Left:
        """In a state an interval later, in which these are the forces."""
        return Left.of(self.ahead(forces, interval_s), self.number, x, v)


class _Along:
    """The slopes of a history, evaluation by evaluation."""

    def __init__(self, history: ForceHistory, at: int) -> None:
        self.history, self.next = history, at
        self.points = history.forces.pointwise(history.number)[0].points
        self.shape = history.brought.before[:, 0].shape
        self._chunk, self._parts = -1, Parts(*np.zeros((4, 0)))

    def slopes(self) -> tuple[Parts, Parts]:
        """∂F (d, …, I) and ∂h (n, …, I) at the next evaluation."""
        (chunk, k), d = divmod(self.next, CHUNK), self.points.dofs
        if chunk != self._chunk:
            self._chunk = chunk
            self._parts = self.history.parts(slice(chunk * CHUNK, (chunk + 1) * CHUNK))
        here = [part[:, :, k] for part in self._parts]
        return Parts(*(part[:d] for part in here)), Parts(*(part[d:] for part in here))


class Carrying(_Along):
    """Columns db of a history, evaluation after evaluation.

    Parameters
    ----------
    history : ForceHistory
    by_p : of an evaluation, by its number, the derivatives (U, columns) of the inputs
    done : int
        Evaluations that are known.
    known : (n, I, columns), optional
        `columns` after the last of them.
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
        """What they add to dF at the next evaluation, (3n, columns)."""
        found = np.einsum("abi,bic->aci", self.slopes()[0].b, self.columns)
        return self.points.summed(found).T

    def advance(self, of_state: Callable[[], Array], of_rate: Callable[[], Array]) -> None:
        """Go past the next evaluation, whose ξ and ν change by (3n, columns)."""
        (_, by), of_inputs = self.slopes(), self.by_p(self.next)[self.history.columns]
        columns = np.einsum("abi,bic->aic", by.b, self.columns)
        columns += np.einsum("abi,bc->aic", by.c, of_inputs)
        for part, moved in ((by.y, of_state), (by.v, of_rate)):
            if part.any():
                columns += np.einsum("abi,bci->aic", part, self.points.vectors(moved().T))
        self.columns, self.next = columns, self.next + 1


class Pulling(_Along):
    """μ of a history, evaluation before evaluation."""

    def __init__(self, history: ForceHistory) -> None:
        super().__init__(history, len(history.xi) - 1)
        self.columns = np.zeros(self.shape)

    def pulled(self) -> tuple[Array, Array]:
        """What position and velocity of the evaluation get through h, (3n,) each."""
        by = self.slopes()[1]
        by_x, by_v = (self.points.summed(self._of(each)[:, None])[0] for each in (by.y, by.v))
        return by_x, by_v

    def by_inputs(self) -> Array:
        """(c,) what its inputs get."""
        return self._of(self.slopes()[1].c).sum(axis=1)

    def _of(self, by: Array) -> Array:
        return np.einsum("abi,ai->bi", by, self.columns)

    def retreat(self, force_weight: Array) -> None:
        """Go before the evaluation, whose force has weights (3n,)."""
        of_force, by = self.slopes()
        weights = self.points.vectors(force_weight[None])[:, 0]
        pushes = np.einsum("abi,ai->bi", of_force.b, weights)
        self.columns, self.next = self._of(by.b) + pushes, self.next - 1
