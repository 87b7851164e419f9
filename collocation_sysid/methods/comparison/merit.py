"""The merit function of the penalty and augmented-Lagrangian methods.

    m(z) = L(z) + yᵀ g(z) + ρ/2 ‖g(z)‖²,   ∇m = ∇L + Jᵀ (y + ρ g),

with loss and rows in the scaling of the NLP and y = 0 for a penalty. Grasped nodes are variables
too, tied by rows of their own; variables whose bounds are equal, such as a given start, are not.
So is what bodies with memory carry, and wrenches, see `explicit`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from ...arrays import Array, Index
from ...program.collocation import Collocation, carried_over
from ...program.stopwatch import Stopwatch


class Unconstrained:
    """A collocation NLP whose grasps are rows, not bounds, and how it answers for the given one.

    Parameters
    ----------
    collocation : Collocation
        As given, with either kind of grasps.
    stopwatch : Stopwatch, optional

    Attributes
    ----------
    nlp : Collocation
        With explicit grasps, memory and wrenches.
    lower, upper : (variables,) bounds
    free : (variables,) bool, what is not given
    bounded : (k,) positions of the free variables p that may have bounds: q and φ
    """

    def __init__(self, collocation: Collocation, stopwatch: Stopwatch | None = None) -> None:
        self.given = collocation
        self.stopwatch = stopwatch or Stopwatch()
        with self.stopwatch.building():
            explicit = collocation.explicit_grasps
            grasped = collocation if explicit else replace(collocation, explicit_grasps=True)
            self.nlp = grasped.made_explicit()
            indptr, indices = self.nlp.jacobian_structure
            shape = (self.nlp.constraints, self.nlp.variables)
            self._entries = np.zeros(len(indices))
            self._jacobian = sp.csc_array((self._entries, indices, indptr), shape=shape)
        self.evaluations = 0
        self.lower, self.upper = self.nlp.bounds()
        self.free = self.lower != self.upper
        of_p = np.zeros(self.nlp.variables, dtype=bool)
        of_p[: self.nlp.nq] = True
        of_p[self.nlp.of_phi] = True
        self.bounded: Index = np.flatnonzero(of_p & self.free)

    def constraints_and_jacobian(self, z: Array) -> tuple[Array, sp.csc_array]:
        """Constraints g and ∂g/∂z; the matrix is overwritten by the next call."""
        self.evaluations += 1
        with self.stopwatch.evaluating():
            rows, _ = self.nlp.constraints_and_jacobian(z, self._entries)
        return rows, self._jacobian

    def constraint_values(self, z: Array) -> Array:
        """Constraints g, scaled."""
        self.evaluations += 1
        with self.stopwatch.evaluating():
            return self.nlp.constraint_values(z)

    def is_upright(self, z: Array) -> bool:
        """Whether no element is inverted where the equations of motion are evaluated."""
        if not np.isfinite(z).all():
            return False
        with self.stopwatch.evaluating():
            for part in self.nlp.parts(z):
                states, _ = part.segment.dynamics.evaluation_states(part.x)
                if not part.segment.body.volume_ratios(states).min() > 0:
                    return False
        return True

    def projected(self, z: Array, slope: Array) -> Array:
        """A gradient without what is given, or pushes against a bound."""
        slope = np.where(self.free, slope, 0.0)
        slope[(z <= self.lower) & (slope > 0)] = 0
        slope[(z >= self.upper) & (slope < 0)] = 0
        return slope

    # Answering for the collocation given ------------------------------------------------------

    def began(self, z: Array) -> Array:
        """Variables from those of the given collocation."""
        return carried_over(z, self.given, self.nlp)

    def answer(self, z: Array) -> Array:
        """Variables of the given collocation, all held nodes exactly where their grasps are."""
        moved = [part.segment.grasped(part.x, part.phi) for part in self.nlp.parts(z)]
        there = self.nlp.pack(self.nlp.parameters_of(z), moved)
        there[~self.free] = z[~self.free]
        return carried_over(there if self.is_upright(there) else z, self.nlp, self.given)

    def multipliers(self, explicit: Array) -> Array:
        """Multipliers of the given collocation's rows from those of all rows."""
        pairs = zip(self.given.segments, self.nlp.segments, strict=True)
        rows = ((given, s, explicit[s.rows]) for given, s in pairs)
        return np.concatenate(
            [
                each
                if given.rows_per_time == s.rows_per_time
                else each.reshape(-1, s.dofs)[:, given.row_dofs].ravel()
                for given, s, each in rows
            ]
        )


@dataclass(frozen=True, eq=False)
class Merit:
    """m for one ρ and y.

    Attributes
    ----------
    problem : Unconstrained
    rho : float
    multipliers : (constraints,) y
    """

    problem: Unconstrained
    rho: float
    multipliers: Array

    def value(self, z: Array) -> float:
        """m(z); infinite where an element is inverted."""
        if not self.problem.is_upright(z):
            return np.inf
        return self.value_of(z, self.problem.constraint_values(z))

    def value_and_gradient(self, z: Array) -> tuple[float, Array]:
        """m(z) and ∇m (variables,), which is zero for what is given."""
        if not self.problem.is_upright(z):
            return np.inf, np.full(len(z), np.nan)
        rows, jacobian = self.problem.constraints_and_jacobian(z)
        return self.value_of(z, rows), self.gradient(z, rows, jacobian)

    def gradient(self, z: Array, rows: Array, jacobian: sp.csc_array) -> Array:
        """∇m from g and J at z."""
        slope = self.problem.nlp.gradient(z) + jacobian.T @ self.estimate(rows)
        return np.where(self.problem.free, slope, 0.0)

    def estimate(self, rows: Array) -> Array:
        """Multipliers y + ρ g that make the Lagrangian stationary where m is."""
        return self.multipliers + self.rho * rows

    def value_of(self, z: Array, rows: Array) -> float:
        """The value m from g at z."""
        pull = float(self.multipliers @ rows + self.rho / 2 * (rows @ rows))
        value = self.problem.nlp.objective(z) + pull
        return value if np.isfinite(value) else np.inf
