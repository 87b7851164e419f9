"""Which inputs an experiment has, and how they follow from its parameters."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from ..arrays import Array
from ..recording.actuator import Actuator
from ..recording.experiment import Experiment
from ..recording.loads import ramp
from ..recording.nuisance import JOINING
from .dynamics import Dynamics
from .inputs import Input, Inputs
from .nuisance import NuisanceMap, Timed
from .parameters import Parameters, ThetaMap


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
