"""Tendons and pressures among the forces: −Σ_a c_a(t) ∂S_a/∂x of energies c_a(t) S_a(x).

An amplitude c depends on what the tension or pressure may be off by, its factor and what is lost,
see `experiment.actuator`. In slopes by θ these follow the constants of the body, two for each.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array, Index
from ..experiment.actuator import Actuator
from ..experiment.experiment import Experiment
from ..fem.body import Body, Curvature, Linearisation
from ..fem.length import Length
from ..fem.pattern import Joined
from ..fem.volume import Volume


@dataclass(frozen=True, eq=False)
class Drives:
    """What tendons and pressures do to a body at T times.

    Attributes
    ----------
    actuators : (A,) Actuator, on the body
    t_s : (T,)
    joined : Joined
        The mesh graph, and the couplings of each.
    share : float
        Of all amplitudes.
    """

    actuators: tuple[Actuator, ...]
    t_s: Array
    joined: Joined
    share: float = 1.0

    @classmethod
    def of(cls, experiment: Experiment, t_s: ArrayLike) -> Drives:
        """Those of an experiment at the times `t_s` (T,)."""
        times = np.atleast_1d(np.asarray(t_s, dtype=np.float64))
        return cls(experiment.actuators, times, experiment.joined)

    @classmethod
    def none(cls, body: Body) -> Drives:
        """None, at one time."""
        return cls((), np.zeros(1), Joined.of((body.pattern,)))

    def rows(self, rows: slice) -> Drives:
        """The same at some of the times."""
        return replace(self, t_s=self.t_s[rows])

    def off_by(self, values: Array) -> Drives:
        """The same with factors and what is lost, (A, 2)."""
        pairs = zip(self.actuators, values, strict=True)
        return replace(self, actuators=tuple(a.off_by(*each) for a, each in pairs))

    def towards(self, other: Drives, share: float) -> Drives:
        """The same with a share of the way to what they are at other times."""
        return replace(self, t_s=self.t_s + share * (other.t_s - self.t_s))

    @cached_property
    def _amplitudes(self) -> Array:
        """(A, T) c."""
        return self.share * np.array([a.amplitude(self.t_s) for a in self.actuators])

    @cached_property
    def _slopes(self) -> Array:
        """(A, T, 2) of c by factor and what is lost."""
        return self.share * np.array([a.slopes(self.t_s) for a in self.actuators])

    def _each(self) -> Iterator[tuple[Length | Volume, Index, Array, Array]]:
        """S, where its couplings are, c (T, 1) and the slopes of c (T, 1, 2) of each."""
        places = self.joined.places[1:]
        for k, (actuator, place) in enumerate(zip(self.actuators, places, strict=True)):
            yield actuator.measure, place, self._amplitudes[k][:, None], self._slopes[k][:, None]

    def force(self, xi: Array) -> Array | float:
        """(T, 3n) [N] at positions (T, 3n)."""
        states = xi.reshape(len(self.t_s), -1)
        return sum((-c * s.gradient(states) for s, _, c, _ in self._each()), start=0.0)

    def added_to(self, at: Linearisation, xi: Array) -> Linearisation:
        """The forces and slopes of the body, with theirs, on the joined pattern."""
        if not self.actuators:
            return at
        states = xi.reshape(len(self.t_s), -1)
        by_position, by_theta = self.joined.spread(at.by_position), [at.by_theta]
        for scalar, place, c, slopes in self._each():
            gradient = scalar.gradient(states)
            np.subtract(at.force, c * gradient, out=at.force)
            by_position[:, place] -= c * scalar.hessian(states)
            by_theta.append(-gradient[..., None] * slopes)
        return replace(
            at,
            by_position=by_position,
            by_velocity=self.joined.spread(at.by_velocity),
            by_theta=np.concatenate(by_theta, axis=2),
            by_position_skew=self.joined.spread(at.by_position_skew),
        )

    def bent(self, at: Curvature, xi: Array, weights: Array) -> Curvature:
        """The second derivatives of weightsᵀ F of the body, with theirs."""
        if not self.actuators:
            return at
        states, w = xi.reshape(len(self.t_s), -1), weights.reshape(len(self.t_s), -1)
        twice, by_theta = self.joined.spread(at.position_position), [at.position_theta]
        for scalar, place, c, slopes in self._each():
            twice[:, place] -= c * scalar.hessian_along(states, w)
            turned = scalar.couplings.products(scalar.hessian(states), w)
            by_theta.append(-turned[..., None] * slopes)
        return replace(
            at,
            position_position=twice,
            position_velocity=self.joined.spread(at.position_velocity),
            position_theta=np.concatenate(by_theta, axis=2),
            position_velocity_skew=self.joined.spread(at.position_velocity_skew),
        )
