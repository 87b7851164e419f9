"""Merit function of the penalty and augmented-Lagrangian methods.

    m(z) = L(z) + yᵀ g(z) + ρ/2 ‖g(z)‖²,   ∇m = ∇L + Jᵀ (y + ρ g),

with loss and constraints in the scaling of the NLP and y = 0 for a penalty. History variables of
materials with memory and lifted measurements are variables with constraints of their own (see
`program.lifted`). Variables with equal bounds, such as a given start, are constant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from ...common.array_types import Array, Index
from ...program.collocation import Collocation
from ...program.lifted.collocation import with_lifted_variables
from ...program.stopwatch import Stopwatch


class PenaltyProblem:
    """Collocation with lifted variables, and counted evaluations of its constraints.

    Attributes
    ----------
    nlp : Collocation
        Problem with lifted variables.
    lower, upper : (variables,) array
        Bounds.
    is_free : (variables,) array of bool
        Variables that are not constant.
    parameter_indices : (k,) array of int
        Indices of the free parameters q and φ, which may have bounds.
    reach_p : (k,) array
        Size of a large change of each of them.
    evaluations : int
        Number of evaluations of the constraints so far.
    """

    def __init__(self, collocation: Collocation, stopwatch: Stopwatch | None = None) -> None:
        self.stopwatch = stopwatch or Stopwatch()
        with self.stopwatch.building():
            self.nlp = with_lifted_variables(collocation)
        self.evaluations = 0
        self.lower, self.upper = self.nlp.bounds()
        self.is_free = self.lower != self.upper
        of_p = np.zeros(self.nlp.variable_count, dtype=bool)
        of_p[: self.nlp.nq] = True
        of_p[self.nlp.phi_columns] = True
        self.parameter_indices: Index = np.flatnonzero(of_p & self.is_free)
        self.reach_p = self.nlp.reach_p[np.flatnonzero(self.nlp.parameters_from(self.is_free))]

    def constraints_and_jacobian(self, z: Array) -> tuple[Array, sp.csc_array]:
        """Return the scaled constraints g (constraints,) and ∂g/∂z at z (variables,); the call
        counts in `evaluations`.
        """
        self.evaluations += 1
        with self.stopwatch.evaluating():
            rows, values = self.nlp.constraints_and_jacobian(z)
        indptr, indices = self.nlp.jacobian_structure
        return rows, sp.csc_array((values, indices, indptr), shape=(len(rows), len(z)))

    def constraint_values(self, z: Array) -> Array:
        """Return the scaled constraints g (constraints,) at z (variables,); the call counts in
        `evaluations`.
        """
        self.evaluations += 1
        with self.stopwatch.evaluating():
            return self.nlp.constraint_values(z)

    def has_valid_elements(self, z: Array) -> bool:
        """Return whether z is finite and no element is inverted at the states at which the
        equations of motion are evaluated.
        """
        if not np.isfinite(z).all():
            return False
        with self.stopwatch.evaluating():
            for part in self.nlp.iterates(z):
                states, _ = part.transcription.dynamics.evaluation_states(part.x)
                if not part.transcription.body.volume_ratios(states).min() > 0:
                    return False
        return True


@dataclass(frozen=True, eq=False)
class MeritFunction:
    """Merit function m for one ρ and y."""

    problem: PenaltyProblem
    rho: float  # penalty parameter ρ
    multipliers: Array  # (constraints,): multipliers y

    def value(self, z: Array) -> float:
        """Return m(z); infinite if an element is inverted, or if m is not finite.

        Raises
        ------
        SimulationError
            If the body has no stress-free shape at these parameters.
        """
        if not self.problem.has_valid_elements(z):
            return np.inf
        return self.value_from_constraints(z, self.problem.constraint_values(z))

    def multiplier_estimate(self, rows: Array) -> Array:
        """Return the multipliers y + ρ g (constraints,), with which the Lagrangian is stationary
        where m is, from the constraints g (`rows`).
        """
        return self.multipliers + self.rho * rows

    def value_from_constraints(self, z: Array, rows: Array) -> float:
        """Return m at z from the constraints g there (`rows`); infinite if m is not finite."""
        penalty = float(self.multipliers @ rows + self.rho / 2 * (rows @ rows))
        value = self.problem.nlp.objective(z) + penalty
        return value if np.isfinite(value) else np.inf


@dataclass(frozen=True, eq=False)
class MeritPoint:
    """Merit function with its derivatives at z."""

    z: Array  # (variables,): variables
    value: float  # merit m
    rows: Array  # (constraints,): constraints g
    jacobian: sp.csc_array  # sparse (constraints, variables): ∂g/∂z
    gradient: Array  # (variables,): ∂m/∂z, zero for constant variables
    # (variables,): the same with zeros at bounds across which m would decrease.
    projected: Array

    @classmethod
    def evaluate(cls, merit: MeritFunction, z: Array) -> MeritPoint:
        """Return the merit function, the constraints and their Jacobian, and ∂m/∂z at z
        (variables,).

        Elements are not checked: if one is inverted, the value may be infinite and derivatives NaN.

        Raises
        ------
        SimulationError
            If the body has no stress-free shape at these parameters.
        """
        problem = merit.problem
        rows, jacobian = problem.constraints_and_jacobian(z)
        slope = problem.nlp.gradient(z) + jacobian.T @ merit.multiplier_estimate(rows)
        gradient = np.where(problem.is_free, slope, 0.0)
        is_held = (z <= problem.lower) & (gradient > 0) | (z >= problem.upper) & (gradient < 0)
        return cls(
            z,
            merit.value_from_constraints(z, rows),
            rows=rows,
            jacobian=jacobian,
            gradient=gradient,
            projected=np.where(is_held, 0.0, gradient),
        )

    @property
    def gradient_norm(self) -> float:
        """Largest entry of the projected gradient."""
        return float(np.abs(self.projected).max(initial=0.0))
