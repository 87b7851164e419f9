"""Merit function of the penalty and augmented-Lagrangian methods.

    m(z) = L(z) + yᵀ g(z) + ρ/2 ‖g(z)‖²,   ∇m = ∇L + Jᵀ (y + ρ g),

with loss and constraints in the scaling of the NLP and y = 0 for a penalty. Positions of grasped
nodes, history variables of materials with memory and lifted measurements are variables with
constraints of their own (see `program.lifted`). Variables with equal bounds, such as a
given start, are constant.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from ...common.array_types import Array, Index
from ...program.collocation import Collocation, convert_variables
from ...program.lifted.collocation import with_lifted_variables
from ...program.stopwatch import Stopwatch


class PenaltyProblem:
    """Collocation in which prescribed displacements are constraints, and its relation to the given
    one.

    Attributes
    ----------
    original : Collocation
        Given problem.
    nlp : Collocation
        Problem with constraints for prescribed displacements, and with lifted variables.
    lower, upper : (variables,) array
        Bounds.
    is_free : (variables,) array of bool
        Variables that are not constant.
    parameter_indices : (k,) array of int
        Indices of the free parameters q and φ, which may have bounds.
    evaluations : int
        Number of evaluations of the constraints so far.

    Parameters
    ----------
    collocation : Collocation
        Given problem, with prescribed displacements as bounds or constraints.
    stopwatch : Stopwatch, optional
        Stopwatch that measures evaluations.
    """

    def __init__(self, collocation: Collocation, stopwatch: Stopwatch | None = None) -> None:
        self.original = collocation
        self.stopwatch = stopwatch or Stopwatch()
        with self.stopwatch.building():
            has_grasp_constraints = collocation.has_grasp_constraints
            grasped = (
                collocation
                if has_grasp_constraints
                else replace(collocation, has_grasp_constraints=True)
            )
            self.nlp = with_lifted_variables(grasped)
            indptr, indices = self.nlp.jacobian_structure
            shape = (self.nlp.constraint_count, self.nlp.variable_count)
            self._entries = np.zeros(len(indices))
            self._jacobian = sp.csc_array((self._entries, indices, indptr), shape=shape)
        self.evaluations = 0
        self.lower, self.upper = self.nlp.bounds()
        self.is_free = self.lower != self.upper
        of_p = np.zeros(self.nlp.variable_count, dtype=bool)
        of_p[: self.nlp.nq] = True
        of_p[self.nlp.phi_columns] = True
        self.parameter_indices: Index = np.flatnonzero(of_p & self.is_free)

    def constraints_and_jacobian(self, z: Array) -> tuple[Array, sp.csc_array]:
        """Return the scaled constraints g (constraints,) and ∂g/∂z at z (variables,). The next call
        overwrites the matrix, and each call counts in `evaluations`.
        """
        self.evaluations += 1
        with self.stopwatch.evaluating():
            rows, _ = self.nlp.constraints_and_jacobian(z, self._entries)
        return rows, self._jacobian

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

    def project_gradient(self, z: Array, slope: Array) -> Array:
        """Return a gradient with zeros for constant variables, and at bounds across which the
        objective would decrease.

        Parameters
        ----------
        z : (variables,) array
            Variables.
        slope : (variables,) array
            Gradient of the objective at z; not modified.
        """
        slope = np.where(self.is_free, slope, 0.0)
        slope[(z <= self.lower) & (slope > 0)] = 0
        slope[(z >= self.upper) & (slope < 0)] = 0
        return slope

    # Conversion to and from the given problem -------------------------------------------------

    def from_original(self, z: Array) -> Array:
        """Return the variables of `nlp` (variables,) from variables z of the given problem."""
        return convert_variables(z, self.original, target=self.nlp)

    def to_original(self, z: Array) -> Array:
        """Return variables of the given problem from the variables z (variables,) of `nlp`, with
        grasped nodes at their prescribed positions.

        Grasped nodes stay where they are if that would invert elements.
        """
        positions = [
            part.transcription.with_prescribed_positions(part.x, part.phi)
            for part in self.nlp.iterates(z)
        ]
        prescribed = self.nlp.pack(self.nlp.parameters_from(z), positions)
        prescribed[~self.is_free] = z[~self.is_free]
        return convert_variables(
            prescribed if self.has_valid_elements(prescribed) else z, self.nlp, target=self.original
        )

    def to_original_multipliers(self, multipliers: Array) -> Array:
        """Return the multipliers of the given problem from those of all constraints of `nlp`
        (constraints,); those of prescribed displacements are left out if the given problem has no
        such constraints.
        """
        pairs = zip(self.original.transcriptions, self.nlp.transcriptions, strict=True)
        rows = ((block, s, multipliers[s.rows]) for block, s in pairs)
        return np.concatenate(
            [
                each
                if values.constraints_per_time == s.constraints_per_time
                else each.reshape(-1, s.dof_count)[:, values.constrained_dofs].ravel()
                for values, s, each in rows
            ]
        )


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

    def value_and_gradient(self, z: Array) -> tuple[float, Array]:
        """Return m(z) and ∇m (variables,), which is zero for constant variables.

        If an element is inverted, m is infinite and ∇m NaN.

        Raises
        ------
        SimulationError
            If the body has no stress-free shape at these parameters.
        """
        if not self.problem.has_valid_elements(z):
            return np.inf, np.full(len(z), np.nan)
        rows, jacobian = self.problem.constraints_and_jacobian(z)
        return self.value_from_constraints(z, rows), self.gradient(z, rows, jacobian=jacobian)

    def gradient(self, z: Array, rows: Array, jacobian: sp.csc_array) -> Array:
        """Return ∇m (variables,) at z from the constraints g (`rows`) and `jacobian`, ∂g/∂z, there;
        zero for constant variables.
        """
        slope = self.problem.nlp.gradient(z) + jacobian.T @ self.multiplier_estimate(rows)
        return np.where(self.problem.is_free, slope, 0.0)

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
