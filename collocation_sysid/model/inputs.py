"""What parameters do to the equations of motion: inputs u(p; t), derivatives generated.

Of every evaluation u has, in this order, the constants θ of the body; gravity (3), where a φ turns
it; the share of each load whose time is estimated; the amplitude of each tendon and pressure. p are
the parameters that move the body: q, then the φ of `NuisanceMap.moving`. Forces know how they
depend on u, see `forces`; ∂u/∂p and Σ w ∂²u/∂p² are generated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from ..arrays import Array
from ..recording.actuator import Actuator
from ..recording.experiment import Experiment
from ..recording.loads import ramp
from ..recording.nuisance import JOINING
from .dynamics import Dynamics
from .generated import Generated
from .nuisance import NuisanceMap, Timed
from .parameters import Parameters, ThetaMap

Expression = Callable[[ca.SX, ca.SX], ca.SX]


@dataclass(frozen=True, eq=False)
class Input:
    """Entries of u.

    Attributes
    ----------
    size : int
    expression : callable
        ``expression(p, data) -> (size,)`` in CasADi operations.
    data : (d, N) at the evaluations, or (d, 1) where the entries are constant
    by_state : bool
        Whether forces change with it and the state together.
    """

    size: int
    expression: Expression
    data: Array
    by_state: bool = True


@dataclass(frozen=True, eq=False)
class Inputs:
    """u of one experiment.

    Attributes
    ----------
    inputs : sequence of Input
    parameters : int
        Length m of p.
    times : int
        Number N of evaluations.
    """

    inputs: Sequence[Input]
    parameters: int
    times: int

    def at(self, p: Array) -> tuple[Array, Array]:
        """U (N, U) and ∂u/∂p (N, U, m); in the memory of one time where nothing changes."""
        values, slopes = [], []
        rows = max((e.data.shape[1] for e in self.inputs), default=1)
        for each, generated in zip(self.inputs, self._generated, strict=True):
            value, slope = generated.slopes(p, each.data)
            values.append(np.broadcast_to(value.T, (rows, each.size)))
            shape = (rows, each.size, self.parameters)
            slopes.append(np.broadcast_to(np.moveaxis(slope, 2, 0), shape))
        u, by_p = np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)
        if rows == self.times:
            return u, by_p
        # In the memory of one time.
        whole = self.times, *by_p.shape[1:]
        return np.broadcast_to(u, whole[:2]), np.broadcast_to(by_p, whole)

    def curvature(self, p: Array, weights: Array) -> Array:
        """Σ weights[t] · ∂²u_t/∂p² (m, m), for weights (N, U)."""
        found, first = np.zeros((self.parameters,) * 2), 0
        for each, generated in zip(self.inputs, self._generated, strict=True):
            own = weights[:, first : first + each.size].T
            if each.data.shape[1] == 1:
                own = own.sum(axis=1, keepdims=True)
            found += generated.curvature(p, each.data, own).sum(axis=2)
            first += each.size
        return found

    @cached_property
    def _generated(self) -> list[Generated]:
        return [Generated(e.expression, self.parameters, len(e.data)) for e in self.inputs]

    @cached_property
    def by_state(self) -> Array:
        """(m,) which parameters change forces together with the state."""
        found = np.zeros(self.parameters, dtype=bool)
        for each, generated in zip(self.inputs, self._generated, strict=True):
            if each.by_state:
                found |= generated.depends
        return found


def with_inputs(dynamics: Dynamics, nuisance: NuisanceMap) -> Dynamics:
    """The equations of motion with room for the inputs that φ change."""
    forces, loads = dynamics.forces, [timed.load for timed in nuisance.timed]
    turns = len(nuisance.of_gravity) > 0
    weight = forces.weight.with_inputs(turns, loads, dynamics.evaluated_s)
    return replace(dynamics, forces=replace(forces, weight=weight))


def inputs_of(
    experiment: Experiment, parameters: Parameters, nuisance: NuisanceMap, evaluated_s: Array
) -> Inputs:
    """U of an experiment, at the times of the evaluations (N,)."""
    constants, still = ThetaMap(parameters, experiment.body), np.zeros((0, 1))
    nq = len(parameters.free)
    place = {phi: nq + k for k, phi in enumerate(nuisance.moving.tolist())}

    def theta(p: ca.SX, _: ca.SX) -> ca.SX:
        return constants.expression(p[:nq])

    def value(p: ca.SX, phi: int) -> ca.SX:
        """Of a φ, with its unit; zero of none."""
        return ca.SX(0) if phi < 0 else float(nuisance.scales[phi]) * p[place[phi]]

    def gravity(p: ca.SX, _: ca.SX) -> ca.SX:
        return nuisance.gravity_expression(p[[place[k] for k in nuisance.of_gravity.tolist()]])

    def share(phi: int, timed: Timed) -> Input:
        sign, interval_s = 1.0 if timed.change == "from_s" else -1.0, experiment.timestep_s

        def change(p: ca.SX, since_s: ca.SX) -> ca.SX:
            late_s = value(p, phi)
            return sign * (ramp((since_s - late_s) / interval_s) - ramp(since_s / interval_s))

        return Input(1, change, evaluated_s[None] - timed.stated_s)

    def amplitude(number: int, actuator: Actuator) -> Input:
        stated, places = nuisance.stated_off[number].tolist(), nuisance.drive_places(number)

        def driven(p: ca.SX, course: ca.SX) -> ca.SX:
            off = (at + value(p, phi) for at, phi in zip(stated, places, strict=True))
            return actuator.driven(course, *off)

        return Input(1, driven, actuator.course.at(evaluated_s)[None])

    found = [Input(len(experiment.body.constants), theta, still)]
    if len(nuisance.of_gravity):
        found.append(Input(3, gravity, still, by_state=False))
    joining = zip(nuisance.places(JOINING).tolist(), nuisance.timed, strict=True)
    found += [share(phi, timed) for phi, timed in joining]
    found += [amplitude(k, actuator) for k, actuator in enumerate(experiment.actuators)]
    return Inputs(found, nq + len(nuisance.moving), len(evaluated_s))
