"""Change of the stiffness over time: the internal forces times a small share, as a force term.

Elastic forces and those of the damping law change by the same share; drag γ_m and masses stay. The
share s(t) is the only input.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from ..common.array_types import Array
from ..common.time_dependence import over_time
from ..fem.body import Body, Linearisation, SecondDerivatives
from ..fem.pattern import SymmetricPattern
from .force_term import AssemblyIndices, ForceTerm, States


@dataclass(frozen=True, eq=False)
class StiffnessChange(ForceTerm):
    """Internal forces of a body without memory, and without γ_m, times a share."""

    body: Body
    # (T, 1): relative change of the stiffness; the only input.
    share: Array = field(metadata=over_time())
    is_static: bool  # whether the experiment is static, so that nothing depends on velocities

    size = 1

    @property
    def couplings(self) -> SymmetricPattern:  # type: ignore[override]
        """Mesh graph of the body."""
        return self.body.pattern

    def with_inputs(self, u: Array) -> Self:
        return replace(self, share=u)

    def _undamped(self, theta: Array) -> Array:
        """Return a copy of constants θ (k,) with γ_m = 0."""
        undamped = np.array(theta, dtype=float)
        undamped[[*self.body.tied_shares]] = 0.0
        return undamped

    def _linearise(self, states: States) -> Linearisation:
        """Return the internal forces without γ_m, on which they do not depend."""
        at = self.body.linearise(states.xi, states.nu, theta=self._undamped(states.theta))
        at.by_theta[..., [*self.body.tied_shares]] = 0.0
        if self.is_static:
            at.by_velocity[:] = 0.0
        return at

    def force(self, states: States) -> Array:
        return self.share * self.body.force(
            states.xi, states.nu, theta=self._undamped(states.theta)
        )

    def add_derivatives(
        self, linearisation: Linearisation, places: AssemblyIndices, states: States
    ) -> None:
        at = self._linearise(states)
        constants = at.by_theta.shape[2]
        np.add(linearisation.force, self.share * at.force, out=linearisation.force)
        linearisation.by_position[:, places.entries] += self.share * at.by_position
        linearisation.by_velocity[:, places.entries] += self.share * at.by_velocity
        if at.by_position_skew.size:
            linearisation.by_position_skew[:, places.entries] += self.share * at.by_position_skew
        linearisation.by_theta[..., :constants] += self.share[:, :, None] * at.by_theta
        linearisation.by_theta[..., places.inputs.start] += at.force

    def add_second_derivatives(
        self, curvature: SecondDerivatives, places: AssemblyIndices, states: States, weights: Array
    ) -> None:
        column = places.inputs.start
        entries = places.entries
        own = self.body.second_derivatives(
            states.xi, states.nu, weights, theta=self._undamped(states.theta)
        )
        damping = [*self.body.tied_shares]
        for values in (own.position_theta, own.velocity_theta, own.theta_theta, own.theta):
            values[..., damping] = 0.0
        own.theta_theta[:, damping] = 0.0
        constants = own.theta.shape[1]
        share = self.share
        curvature.position_position[:, entries] += share * own.position_position
        curvature.position_theta[..., :constants] += share[:, :, None] * own.position_theta
        curvature.theta_theta[:, :constants, :constants] += share[:, :, None] * own.theta_theta
        curvature.theta[:, :constants] += share * own.theta
        at = self._linearise(states)
        pattern = self.body.pattern
        parts = zip(at.by_position, at.by_position_skew, weights, strict=True)
        curvature.position_theta[:, :, column] += [
            pattern.matrix(values, skew).T @ w for values, skew, w in parts
        ]
        mixed = np.einsum("ti,tik->tk", weights, at.by_theta)
        curvature.theta_theta[:, :constants, column] += mixed
        curvature.theta_theta[:, column, :constants] += mixed
        curvature.theta[:, column] += np.einsum("ti,ti->t", weights, at.force)
        if self.is_static:
            return
        curvature.position_velocity[:, entries] += share * own.position_velocity
        curvature.velocity_theta[..., :constants] += share[:, :, None] * own.velocity_theta
        curvature.velocity_theta[:, :, column] += pattern.products(at.by_velocity, weights)
        if own.position_velocity_skew.size:
            skew = share * own.position_velocity_skew
            curvature.position_velocity_skew[:, entries] += skew
