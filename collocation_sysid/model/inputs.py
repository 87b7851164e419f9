"""Inputs u(p; t) by which parameters enter the equations of motion, with generated derivatives.

The entries of u at each evaluation are, in this order: the constants θ of the body; gravity (3), if
a nuisance parameter rotates it; the share of each load whose time is estimated; the factors of the
motion at the first time; the amplitude of each tendon and pressure; the relative change of the
stiffness, if a deviation changes it. The parameters p are those that affect the motion: the shared
coordinates q, then the nuisance parameters φ of `NuisanceMap.motion_indices`. Every force provides
its derivatives by u (see `forces`); this module generates ∂u/∂p and Σ w ∂²u/∂p².
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import casadi as ca
import numpy as np

from ..common.array_types import Array
from ..recording.actuator import Actuator
from ..recording.experiment import Experiment
from ..recording.loads import smooth_ramp
from ..recording.nuisance import JOINING
from ..recording.start_motion import start_forces_n
from .dynamics import Dynamics
from .generated_functions import GeneratedFunction
from .nuisance_map import NuisanceMap, TimedLoad
from .parameters import Parameters, ThetaMap

Expression = Callable[[ca.SX, ca.SX], ca.SX]


@dataclass(frozen=True, eq=False)
class Input:
    """Group of consecutive entries of u, with one expression."""

    size: int  # number of entries
    expression: Expression  # ``expression(p, data) -> (size,)`` in CasADi operations
    # (d, N) or (d, 1): data at the N evaluations; (d, 1) for entries that are constant in time.
    data: Array
    # Whether the mixed second derivative of the forces by these entries and the state is nonzero.
    is_coupled_to_state: bool = True


@dataclass(frozen=True, eq=False)
class Inputs:
    """Input vector u of one experiment as a function of its parameters p."""

    groups: Sequence[Input]  # groups of entries, in the order of u
    parameter_count: int  # length m of p
    time_count: int  # number N of evaluations

    def evaluate_at(self, p: Array) -> tuple[Array, Array]:
        """Return the inputs u (N, U) and their derivatives ∂u/∂p (N, U, m) at parameters p (m,).

        If all entries are constant in time and N > 1, both arrays are read-only views with stride 0
        along the time; otherwise they are new.

        Raises
        ------
        InputError
            If the parameters do not determine the constants of the body.
        """
        values = []
        slopes = []
        rows = max((e.data.shape[1] for e in self.groups), default=1)
        for each, generated in zip(self.groups, self._functions, strict=True):
            value, slope = generated.evaluate_with_jacobian(p, each.data)
            values.append(np.broadcast_to(value.T, (rows, each.size)))
            shape = (rows, each.size, self.parameter_count)
            slopes.append(np.broadcast_to(np.moveaxis(slope, 2, 0), shape))
        u = np.concatenate(values, axis=1)
        by_p = np.concatenate(slopes, axis=1)
        if rows == self.time_count:
            return u, by_p
        full_shape = self.time_count, *by_p.shape[1:]
        return np.broadcast_to(u, full_shape[:2]), np.broadcast_to(by_p, full_shape)

    def weighted_hessian(self, p: Array, weights: Array) -> Array:
        """Return Σ_t weights[t] · ∂²u_t/∂p² (m, m), summed over all evaluations and entries, at
        parameters p (m,), for weights (N, U).
        """
        hessian = np.zeros((self.parameter_count,) * 2)
        offset = 0
        for each, generated in zip(self.groups, self._functions, strict=True):
            group_weights = weights[:, offset : offset + each.size].T
            if each.data.shape[1] == 1:
                group_weights = group_weights.sum(axis=1, keepdims=True)
            hessian += generated.weighted_hessian(p, each.data, weights=group_weights).sum(axis=2)
            offset += each.size
        return hessian

    @cached_property
    def _functions(self) -> list[GeneratedFunction]:
        """Expressions of the groups with derivatives, in the order of `groups`."""
        return [
            GeneratedFunction(e.expression, self.parameter_count, data_size=len(e.data))
            for e in self.groups
        ]

    @cached_property
    def is_coupled_to_state(self) -> Array:
        """Mask (m,) of the parameters on which entries with `Input.is_coupled_to_state` depend."""
        mask = np.zeros(self.parameter_count, dtype=bool)
        for each, generated in zip(self.groups, self._functions, strict=True):
            if each.is_coupled_to_state:
                mask |= generated.dependent_inputs
        return mask


def with_inputs(experiment: Experiment, dynamics: Dynamics, nuisance: NuisanceMap) -> Dynamics:
    """Return equations of motion whose weight has the inputs that φ changes: gravity, if a
    parameter rotates it, the shares of loads with an estimated time, and the motion at the first
    time. The argument is not modified.

    Values are unchanged until `Dynamics.with_inputs` sets the inputs.
    """
    forces = dynamics.forces
    loads = [timed.load for timed in nuisance.timed_loads]
    has_gravity_input = len(nuisance.gravity_indices) > 0
    starting_n = np.zeros((0, len(dynamics.evaluated_s), forces.pattern.size))
    if numbers := [nuisance.number_of_start(phi) for phi in nuisance.start_indices.tolist()]:
        starting_n = start_forces_n(experiment, dynamics.evaluated_s)[numbers]
    weight = forces.weight.with_load_inputs(
        has_gravity_input, loads, t_s=dynamics.evaluated_s, starting_n=starting_n
    )
    return replace(dynamics, forces=replace(forces, weight=weight))


def inputs_from_experiment(
    experiment: Experiment, parameters: Parameters, nuisance: NuisanceMap, evaluated_s: Array
) -> Inputs:
    """Return the inputs of an experiment, in the order that the module states.

    If the parameters do not determine the constants of the body, evaluating the inputs is an
    `InputError`; see `Parameters.require_constants_of` to check this before.

    Parameters
    ----------
    parameters : Parameters
        Parameters of the problem; p begins with the free ones, by their coordinates q.
    nuisance : NuisanceMap
        Nuisance parameters of the experiment; p ends with those of `motion_indices`.
    evaluated_s : (N,)
        Times at which forces are evaluated [s].
    """
    constants = ThetaMap(parameters, experiment.body)
    no_data = np.zeros((0, 1))
    nq = len(parameters.free)
    place = {phi: nq + k for k, phi in enumerate(nuisance.motion_indices.tolist())}

    def theta(p: ca.SX, _: ca.SX) -> ca.SX:
        """Return the constants θ of the body, of q alone."""
        return constants.expression(p[:nq])

    def value(p: ca.SX, phi: int) -> ca.SX:
        """Return a nuisance parameter with its unit; zero for the index −1, which means none."""
        return ca.SX(0) if phi < 0 else float(nuisance.scales[phi]) * p[place[phi]]

    def gravity(p: ca.SX, _: ca.SX) -> ca.SX:
        return nuisance.gravity_expression(p[[place[k] for k in nuisance.gravity_indices.tolist()]])

    def share(phi: int, timed: TimedLoad) -> Input:
        """Return the input of the share of a load: the change from its share at the stated time."""
        sign = 1.0 if timed.change == "from_s" else -1.0
        interval_s = experiment.timestep_s

        def change(p: ca.SX, since_s: ca.SX) -> ca.SX:
            late_s = value(p, phi)
            return sign * (
                smooth_ramp((since_s - late_s) / interval_s) - smooth_ramp(since_s / interval_s)
            )

        return Input(1, change, data=evaluated_s[None] - timed.declared_s)

    def amplitude(number: int, actuator: Actuator) -> Input:
        declared_calibration = nuisance.declared_calibration[number].tolist()
        places = nuisance.actuator_calibration_indices(number)

        def driven(p: ca.SX, data: ca.SX) -> ca.SX:
            calibration = (
                nominal + value(p, phi)
                for nominal, phi in zip(declared_calibration, places, strict=True)
            )
            return actuator.calibrated_amplitude(data, *calibration)

        return Input(1, driven, data=actuator.input_data(evaluated_s))

    groups = [Input(len(experiment.body.constants), theta, data=no_data)]
    if len(nuisance.gravity_indices):
        groups.append(Input(3, gravity, data=no_data, is_coupled_to_state=False))
    joining = zip(nuisance.indices_of_rows(JOINING).tolist(), nuisance.timed_loads, strict=True)
    groups += [share(phi, timed) for phi, timed in joining]
    groups += [
        Input(1, lambda p, _, phi=phi: value(p, phi), data=no_data, is_coupled_to_state=False)
        for phi in nuisance.start_indices.tolist()
    ]
    groups += [amplitude(k, actuator) for k, actuator in enumerate(experiment.actuators)]
    if rows := experiment.stiffness_deviations:
        changing = nuisance.stiffness_indices.tolist()
        slopes = {row.name: row.stiffness(experiment, evaluated_s) for row in rows if row.stiffness}
        data = [slopes[nuisance.entries[phi].row.name] for phi in changing]

        def stiffness(p: ca.SX, data: ca.SX) -> ca.SX:
            """Return the relative change of the stiffness: the known one, and the estimated ones."""
            estimated = (value(p, phi) * data[k + 1] for k, phi in enumerate(changing))
            return data[0] + sum(estimated, ca.SX(0))

        known = experiment.known_stiffness_change(evaluated_s)
        groups.append(Input(1, stiffness, data=np.array([known, *data])))
    return Inputs(groups, nq + len(nuisance.motion_indices), time_count=len(evaluated_s))
