"""One experiment at given variables of the nonlinear program: its parameters, motion and
observables.

Methods and statistics use an `ExperimentIterate` to evaluate the loss, its gradient and the forces
at one iterate; derived quantities are computed once and cached. Derivatives of its observables
along the equations of motion are in `observable_response`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from ..common.array_types import Array
from ..fem.body import Linearisation
from ..model.equations_at_parameters import EquationsAtParameters
from ..model.internal_variables import AnyHistory
from .measurement_residual import MeasurementResidual, Observable
from .observables import ObservedMotion, ReactionForces
from .reactions.forces import reaction_vjp, reactions_at
from .transcription import Transcription

R = TypeVar("R", bound=MeasurementResidual)


@dataclass(frozen=True, eq=False)
class ExperimentIterate:
    """One experiment at given variables of the nonlinear program.

    Attributes
    ----------
    q : (nq,) array
        Shared parameters.
    phi : (k,) array
        Nuisance parameters of the experiment in units of their priors.
    x : (N, 3n) array
        Positions [m], or their first rows.
    lifted_histories : mapping of int to array
        History variables by the index of the history, where they are variables of the program;
        others follow from x.
    lifted_pressures : mapping of int to array
        Pressure variables b (1, N, i) of obstacles by the index of the force, where pressure and
        gap are complementary; others follow from x.
    lifted_observables : mapping of int to array
        Observables by the index of the measurement, where they are variables of the program; others
        follow from x.
    has_observation_curvature : bool
        If false, neglect the curvature of the observations (Gauss–Newton).
    """

    transcription: Transcription
    q: Array
    phi: Array
    x: Array
    lifted_histories: Mapping[int, Array] = field(default_factory=dict)
    lifted_pressures: Mapping[int, Array] = field(default_factory=dict)
    lifted_observables: Mapping[int, Array] = field(default_factory=dict)
    has_observation_curvature: bool = True

    @cached_property
    def equations(self) -> EquationsAtParameters:
        """Equations of motion at q and φ, see `Transcription.equations_at`."""
        return self.transcription.equations_at(self.q, self.phi)

    @cached_property
    def histories(self) -> tuple[AnyHistory, ...]:
        """History variables of the body and of forces at all evaluations, then forces of
        obstacles with given pressures: lifted ones where they are variables, otherwise
        computed from the positions.
        """
        dynamics = self.equations.dynamics
        pressed = dynamics.forces_with_pressures(self.x, self.lifted_pressures)
        return (*dynamics.histories(self.x, self.lifted_histories), *pressed)

    @cached_property
    def reactions(self) -> ReactionForces:
        """Reaction forces on the sensed dofs, without changes."""
        return reactions_at(
            self.equations.dynamics,
            self.x,
            dofs=self.transcription.sensed_dofs,
            histories=self.histories,
        )

    def motion_for(self, observable: Observable) -> ObservedMotion:
        """Return the motion without changes; with reaction forces if the observable measures
        them.
        """
        return ObservedMotion(self.x, self.reactions if observable.measures_reactions else None)

    @cached_property
    def observables(self) -> list[Array]:
        """Values (n, e, 3) of the observable of each measurement, in the order of
        `transcription.residuals`; lifted ones are the values of the variables.
        """
        return [
            self.lifted_observables[k]
            if k in self.lifted_observables
            else residual.observable.evaluate(self.motion_for(residual.observable), self.phi)
            for k, residual in enumerate(self.transcription.residuals)
        ]

    def residuals_of(self, kind: type[R]) -> list[tuple[R, Array]]:
        """Return the measurement residuals of one class, each with the values (n, e, 3) of its
        observable.
        """
        pairs = zip(self.transcription.residuals, self.observables, strict=True)
        return [(each, values) for each, values in pairs if isinstance(each, kind)]

    @property
    def loss(self) -> float:
        """Loss Σ ρ of all measurements of this experiment, without priors."""
        pairs = zip(self.transcription.residuals, self.observables, strict=True)
        return sum(residual.loss(observation, self.phi) for residual, observation in pairs)

    @cached_property
    def loss_gradients(self) -> list[tuple[Array, Array]]:
        """Gradient of the loss of each measurement by the values of its observable (n, e, 3) and,
        at constant values, by φ (k,).
        """
        pairs = zip(self.transcription.residuals, self.observables, strict=True)
        return [residual.loss_gradient(observation, self.phi) for residual, observation in pairs]

    def gradient(self) -> tuple[Array, Array]:
        """Return the gradient of the loss by x (N, 3n) [1/m] and by (q, φ) (nq + k,), including the
        dependence through reaction forces.

        Observables that are variables of the program (`lifted_observables`) are treated as
        constant; priors are not included.
        """
        nq = self.transcription.nq
        phi = self.phi
        by_x = np.zeros_like(self.x)
        by_p = np.zeros(nq + len(phi))
        by_reaction = None
        pairs = zip(self.transcription.residuals, self.loss_gradients, strict=True)
        for k, (residual, (by_observables, by_phi)) in enumerate(pairs):
            by_p[nq:] += by_phi
            if k not in self.lifted_observables:
                own_x, own_reaction, own_phi = residual.observable.vjp(
                    self.motion_for(residual.observable), phi, by_values=by_observables
                )
                by_x = by_x + own_x
                by_p[nq:] = by_p[nq:] + own_phi
                if own_reaction is not None:
                    by_reaction = own_reaction + (0.0 if by_reaction is None else by_reaction)
        if by_reaction is not None:
            through_x, through_p = self._reaction_vjp(by_reaction)
            by_x += through_x
            by_p[self.transcription.dynamic_parameters] += through_p
        return by_x, by_p

    def _reaction_vjp(self, weights: Array) -> tuple[Array, Array]:
        """VJP of R with histories; overwrites `linearisation_buffer`."""
        by_x, by_p, force_weights = reaction_vjp(
            self.equations,
            self.x,
            weights=weights,
            dofs=self.transcription.sensed_dofs,
            buffer=self.transcription.linearisation_buffer,
        )
        through_x, through_p = self.transcription.history_vjp(
            self.x, self.equations, weights=force_weights
        )
        return by_x + through_x, by_p + through_p

    def linearise_fixed_motion(self) -> list[tuple[Array, Array]]:
        """Linearise the residuals of all measurements by φ, at a motion that does not change.

        Returns
        -------
        list of (array, array)
            For each measurement, residuals (s, G, 3) and derivatives (s, G, 3, k), also
            for sensors of reactions, with the reaction forces of the motion.
        """
        none = np.zeros(0, dtype=np.int64)
        count = len(self.phi)
        reactions = None
        if any(r.observable.measures_reactions for r in self.transcription.residuals):
            nothing = np.zeros((*self.reactions.reaction.shape, 0))
            reactions = replace(self.reactions, reaction_by=nothing, position_by=nothing)
        motion = ObservedMotion(self.x, reactions)
        linearised = []
        for residual in self.transcription.residuals:
            values_and_slopes = residual.observable.linearise(motion, self.phi, none, count)
            linearised.append(residual.linearise(*values_and_slopes, self.phi, count))
        return linearised

    @cached_property
    def forces(self) -> Linearisation:
        """Forces at the evaluations with their derivatives; stored in the transcription's
        `linearisation_buffer`, hence valid until the transcription linearises again.
        """
        rows = self.transcription.linearisation_buffer
        return self.equations.dynamics.linearise(self.x, rows, histories=self.histories)

    def compute_residual_n(self) -> Array:
        """Return the residuals of the equations of motion (N, free dofs) [N], see
        `Transcription.residual_n`.
        """
        return self.transcription.residual_n(self.x, self.equations, histories=self.histories)
