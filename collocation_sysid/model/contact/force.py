"""Contact force of an obstacle as a term of the equations of motion.

Use `contact_terms` to get the contact terms of an experiment; the law of the force is
`law.ContactLaw`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np

from ...common.array_types import Array, Index
from ...common.time_dependence import LOAD
from ...fem.force_points import ForcePoints
from ...fem.pattern import SymmetricPattern
from ...recording.experiment import Experiment
from ..force_term import AssemblyIndices, States
from ..generated_functions import GeneratedFunction
from ..local_force import LocalForce
from ..point_forces import ComplementarityForce, PreviousState
from .law import DATA_COUNT, POINT_BATCH, ContactLaw, contact_law
from .time_step import StepContact


@dataclass(frozen=True, eq=False)
class Contact(ComplementarityForce):
    """Contact forces between one obstacle and a body, at any times.

    Attributes
    ----------
    law_of_contact : ContactLaw
    previous_state : PreviousState, optional
        Given b of a program that has b as variables; b follows from the gap by default.
    variable_weights : (1, T, points), optional
        Weights of the complementarity residuals in second derivatives.
    step_s : float
        Length of the time steps over which an averaged pressure is a mean; 0 if it is not averaged.
    """

    law_of_contact: ContactLaw
    factor: float = field(default=1.0, metadata=LOAD)
    previous_state: PreviousState | None = None
    variable_weights: Array | None = None
    step_s: float = 0.0
    size = 0
    uses_increments = True

    @property
    def points(self) -> ForcePoints:  # type: ignore[override]
        """Points of the surface, with the obstacle's frame."""
        return self.law_of_contact.surface.points

    @property
    def law(self) -> GeneratedFunction:
        """Force law: of the gap, or of given b with the complementarity residual."""
        return (
            self.law_of_contact.force_function
            if self.previous_state is None
            else self.law_of_contact.complementarity_function
        )

    @property
    def is_complementarity(self) -> bool:  # type: ignore[override]
        """Whether the contact is relaxed complementarity."""
        return self.law_of_contact.obstacle.relaxed is not None

    @property
    def internal_variable_count(self) -> int:  # type: ignore[override]
        """Number of values that are given at each point: 1 where b is given, else 0.

        With a given b, what `internal_variables` and derivatives of h contain are the residuals of
        complementarity.
        """
        return int(self.previous_state is not None)

    @property
    def is_local(self) -> bool:  # type: ignore[override]
        """Whether few points have a pressure: all have one if the contact is complementarity."""
        return not self.is_complementarity

    def local_force(self, theta: Array, pattern: SymmetricPattern) -> LocalForce:
        return StepContact(self.law_of_contact, theta, pattern=pattern, step_s=self.step_s)

    @property
    def pressure_unit_m(self) -> float:  # type: ignore[override]
        """Unit of b as a variable [m]: the largest width δ of the contact law."""
        return self.law_of_contact.largest_width_m

    def scaled_pressures(self, xi: Array, nu: Array | None = None) -> Array:
        """Return the pressures divided by κ, b (1, T, i) [m], at positions ξ (T, 3n) [m], from the
        gaps there: without an average over the step, and without a given b.
        """
        gaps = self.law_of_contact.gaps(self.points.vectors(xi))
        data = np.broadcast_to(self.law_of_contact.data[:, None], (DATA_COUNT, *gaps.shape))
        return self.law_of_contact.scaled_pressure_function.evaluate(gaps[None], data)

    def rigid_limit_n(self, states: States) -> Array:
        """Return the change (T, 3n) [N] of the forces if contact were rigid, to first order.

        With κ/ε and ε δ in place of κ and δ, the pressure depends on g/ε alone. For ε → 0 it is
        therefore the present pressure at a gap larger by g, at all points with a pressure: they
        move to the surface of the obstacle, from inside it or in front of it. The pressure must not
        be averaged over a step. This is not checked; the result would be wrong.
        """
        evaluated = self._inputs_at(states)
        y = evaluated.u[evaluated.y]
        gap, normal = self.law_of_contact.gaps_with_slopes(y)
        _, slopes = self.law.evaluate_with_jacobian(evaluated.u, evaluated.data)
        change = np.einsum("vkti,kti->vti", slopes[evaluated.y, :3], normal[:3] * gap)
        return self.factor * self.points.assemble(change, evaluated.chosen)

    def friction_sums(self, states: States) -> Array:
        """Return the sums over the points (6, T) of `ContactLaw.friction_function`: five forces
        [N], then the power [W]; in a static experiment the work of the displacements [J].

        The obstacle must have friction, and b must not be given (`previous_state`): the inputs
        would have another length.
        """
        evaluated = self._inputs_at(states)
        return self.law_of_contact.friction_function.evaluate(evaluated.u, evaluated.data).sum(
            axis=2
        )

    @property
    def is_nonlinear_in_velocity(self) -> bool:
        """Whether the force depends on velocities: with friction, or if averaged over a step."""
        return self.law_of_contact.depends_on_velocity

    @property
    def has_skew_stiffness(self) -> bool:
        """Whether derivatives by positions have a skew part: only if the force depends on
        velocities.
        """
        return self.law_of_contact.depends_on_velocity

    @property
    def has_skew_damping(self) -> bool:  # type: ignore[override]
        """Whether derivatives by velocities are non-symmetric: only if averaged over a step."""
        return self.law_of_contact.is_averaged

    def with_inputs(self, u: Array) -> Self:
        return self

    def active_points(self, states: States) -> tuple[Index | None, Array]:
        """Return the indices of the points that may have a pressure, and y (12, T, i) of these
        points.

        These are the points within δ at any of the times, and some more to fill a multiple of
        `POINT_BATCH`. With relaxed contact all points act, and the indices are None.
        """
        y = self.points.vectors(states.xi)
        if self.is_complementarity:
            return None, y
        is_active = np.any(self._least_gaps(states, y) < self.law_of_contact.widths_m, axis=0)
        is_active[np.flatnonzero(~is_active)[: -is_active.sum() % POINT_BATCH]] = True
        chosen = np.flatnonzero(is_active)
        return chosen, y[..., chosen]

    def _least_gaps(self, states: States, y: Array) -> Array:
        """Return the gaps (T, i) [m] of y (12, T, i); the smaller one if averaged over a step."""
        half_s = self.step_s / 2
        if not half_s:
            return self.law_of_contact.gaps(y)
        half_step = half_s * self.points.vectors(states.nu)
        return np.minimum(
            self.law_of_contact.gaps(y - half_step), self.law_of_contact.gaps(y + half_step)
        )

    def separate_bodies(self, places: Array, shape: Array) -> Array:
        frame = self.law_of_contact.obstacle.nodes
        penetration_m, normal = self.deepest_point(shape.ravel())
        moved = places.copy()
        moved[frame] -= max(penetration_m, 0.0) * normal
        return moved

    def deepest_point(self, x: Array) -> tuple[float, Array]:
        """Return the penetration δ − g [m] of the point with the smallest gap at positions x (3n,)
        [m], and the gradient of its gap (3,) in the axes of the world, the obstacle's outward
        normal.

        The penetration is negative if no point has a pressure.
        """
        y = self.points.vectors(x[None])
        gap, slopes = self.law_of_contact.gaps_with_slopes(y)
        deepest = int(gap[0].argmin())
        return self.law_of_contact.widths_m[deepest] - float(gap[0, deepest]), slopes[
            :3, 0, deepest
        ]

    def constants(self, states: States) -> Array:
        """Return the constants (c, 1) on which stiffness and friction depend."""
        return states.theta[self.law_of_contact.constant_columns][:, None]

    def constant_columns(self, places: AssemblyIndices) -> Index:
        return self.law_of_contact.constant_columns

    def data(self, chosen: Index | None) -> Array:
        """Return the data (5, 1, i) of the chosen points; of all points for None."""
        points = slice(None) if chosen is None else chosen
        return self.law_of_contact.data_of(points, self.step_s)[:, None]


def contact_terms(experiment: Experiment, step_s: float = 0.0) -> tuple[Contact, ...]:
    """Return the contact terms of an experiment's obstacles.

    Parameters
    ----------
    step_s : float
        Length of the time steps over which pressures are averaged; 0 for the pressure at each
        state. Relaxed contact is not averaged.
    """
    terms = []
    for obstacle in experiment.obstacles:
        averaged = step_s > 0 and obstacle.relaxed is None
        law = contact_law(experiment.body, obstacle, static=experiment.is_static, averaged=averaged)
        terms.append(Contact(law, step_s=step_s if averaged else 0.0))
    return tuple(terms)
