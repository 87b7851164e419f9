"""The check of an answer: every experiment simulated forward with it, and compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..arrays import Array, root_mean
from ..errors import InputError, SimulationError
from ..fem.kernels import side_by_side
from ..methods.complementarity import with_energy
from ..methods.reduced_space import ReducedSpace
from ..methods.solution import Solution, reading_rms, wrench_rms
from ..model.schemes import MOST_STEPS, as_scheme
from ..problem import Problem
from ..program.channel import Forced, Motion
from ..program.collocation import Part
from ..program.gauge import gauge_readings
from ..program.segment import Segment
from ..program.simulation import Trajectory, simulate
from ..program.wrench_channel import Grid
from ..recording import Experiment
from ..statistics.estimates import Estimate
from ..statistics.linearised import LinearisedFit, values_of
from ..statistics.numerical import Refinement, changes_towards, numerical_errors

# Grid steps over those of a forward simulation that tells the step's error, with room for rounding.
LEAST_FINER = 1.99


@dataclass(frozen=True, eq=False)
class Rollout:
    """A forward simulation with the answer's parameters, against the measurements.

    Attributes
    ----------
    rms_m, max_m : distance of the markers from the measurements; the tip error is in `max_m`
    trajectory : Trajectory
        Its markers are read with the experiment's nuisance parameters.
    nuisance : mapping of name to value
        Nuisance parameters of an experiment for validation, fitted with the material as found.
        Of places they are the way from where these were started.
    places_m : mapping of marker to place [x, y, z], for validation likewise
    wrenches : tuple of (S, 6)
        What the sensors of its grasps should read, NaN where that is not known.
    wrench_rms : RMS of force [N] and torque [N m], None where there is none
    readings : mapping of name to (S, m)
        What readings of one's own should say.
    reading_rms : RMS of each of them, by name
    """

    rms_m: float
    max_m: float
    trajectory: Trajectory
    nuisance: Mapping[str, float]
    places_m: Mapping[str, list[float]]
    wrenches: Sequence[Array] = ()
    wrench_rms: tuple[float | None, float | None] = (None, None)
    readings: Mapping[str, Array] = field(default_factory=dict)
    reading_rms: Mapping[str, float] = field(default_factory=dict)


def roll_outs(problem: Problem, solution: Solution) -> dict[str, Rollout | str]:
    """Those of all experiments by their names, see `roll_out`."""
    threads = solution.collocation.threads
    rollouts = side_by_side(lambda e: roll_out(problem, e, solution), problem.experiments, threads)
    return {e.name: each for e, each in zip(problem.experiments, rollouts, strict=True)}


def roll_out(problem: Problem, experiment: Experiment, solution: Solution) -> Rollout | str:
    """Simulate an experiment with a solution's parameters; or say why that fails."""
    options = problem.rollout
    integrator = problem.scheme if options.integrator == "scheme" else "newmark"
    try:
        segment, phi = _seen(experiment, solution)
        trajectory = simulate(
            with_energy(segment.corrected(phi)),
            experiment.body.theta(solution.parameters),
            integrator,
            timestep_s=_step_s(problem, segment),
            substeps=segment.substeps,
        )
    except (InputError, SimulationError) as error:
        # A density that leaves a node without mass is input of who simulates, but found here.
        return str(error)
    readings = segment.markers.of_samples(trajectory.positions_m, phi)
    distances = np.linalg.norm(readings - experiment.markers.positions_m, axis=2)
    present = distances[experiment.markers.present]
    grid, forced = trajectory.reactions
    wrenches = [sensor.on(grid).of_forced(forced, phi) for sensor in segment.sensors]
    nuisance, validation = segment.nuisance, experiment.validation
    own = zip(nuisance.names, (phi * nuisance.scales).tolist(), strict=True)
    places = zip(experiment.markers.names, segment.places_m(phi).tolist(), strict=True)
    x = trajectory.positions_m.reshape(len(trajectory.positions_m), -1)
    read = zip(segment.gauges, _gauged(segment, x, trajectory.reactions, phi), strict=True)
    gauged = {gauge.gauge.name: gauge.said(each) for gauge, each in read}
    return Rollout(
        root_mean(present**2),
        float(present.max(initial=0.0)),
        replace(trajectory, markers_m=readings),
        dict(own if validation else ()),
        dict(places if validation else ()),
        wrenches,
        wrench_rms(experiment, wrenches),
        gauged,
        reading_rms(experiment, gauged),
    )


def _seen(experiment: Experiment, solution: Solution) -> tuple[Segment, Array]:
    """The experiment with its φ: those of the fit, or fitted with θ as found."""
    if (part := solution.part_of(experiment.name)) is not None:
        return part.segment, part.phi
    values, body = solution.parameters, experiment.body
    alone = replace(
        solution.collocation,
        experiments=[replace(experiment, validation=False)],
        parameters=solution.collocation.parameters.fixed_at(
            {name: values[name] for name in body.used_names(list(values))}
        ),
    )
    (segment,) = alone.segments
    # All that is left to estimate is φ.
    if not alone.nphi:
        return segment, np.zeros(0)
    return segment, alone.parameters_of(ReducedSpace()(alone).unless_interrupted().z)


def step_error(
    problem: Problem,
    solution: Solution,
    fit: LinearisedFit,
    rollouts: Mapping[str, Rollout | str],
    estimates: Mapping[str, Estimate],
) -> Refinement | None:
    """What the step does to every parameter and modulus, to first order.

    From a Gauss–Newton step towards the forward simulations; None where these are missing or no
    finer, where all is static, and where something is touched in motion: an impact within a step
    moves forces by far more than first order tells, and rings in the forward simulation.
    """
    apart: list[Array] = []
    collocation = solution.collocation
    moving = [s.experiment for s in collocation.segments if not s.experiment.static]
    if not moving or any(experiment.obstacles for experiment in moving):
        return None
    for part, readings in zip(solution.parts, solution.readings_m, strict=True):
        segment, experiment = part.segment, part.segment.experiment
        rollout = rollouts.get(experiment.name)
        share = _share(problem, segment)
        if not isinstance(rollout, Rollout) or share is None:
            return None
        way = share * (rollout.trajectory.markers_m - readings)
        apart.append(np.nan_to_num(way / experiment.markers.sigma_m[:, None]))
        fitted = solution.wrenches.get(experiment.name, [])
        for sensor, read, rolled in zip(segment.sensors, fitted, rollout.wrenches, strict=True):
            way = share * np.nan_to_num((rolled - read) / sensor.wrench.sigmas)
            apart.append(way.reshape(-1, 2, 3))
        apart += _of_gauges(part, rollout.trajectory, share)
        apart += _of_depths(part, rollout.trajectory, share)
    change = changes_towards(fit, apart)[: collocation.nq]
    q = np.clip(solution.q + change, *collocation.parameters.bounds_q)
    linear, order = problem.parameters.linear, as_scheme(problem.scheme).order
    return Refinement(numerical_errors(estimates, [values_of(collocation, q)], [], order, linear))


def _of_gauges(part: Part, trajectory: Trajectory, share: float) -> list[Array]:
    """A share of the way of one's own readings to a forward simulation, of each (S, G, 3)."""
    if not (segment := part.segment).gauges:
        return []
    fitted = part.x[segment.markers.grid_rows], (Grid.of(segment.dynamics), part.motion.forced)
    rolled = trajectory.positions_m.reshape(len(fitted[0]), -1), trajectory.reactions
    here, there = (_gauged(segment, *each, part.phi) for each in (fitted, rolled))
    return [
        share * np.nan_to_num(far - near) / gauge.sigmas[:, None]
        for gauge, near, far in zip(segment.gauges, here, there, strict=True)
    ]


def _of_depths(part: Part, trajectory: Trajectory, share: float) -> list[Array]:
    """The same of depth cameras, of each (S, M, 3), at the points that they see as fitted."""
    if not (sights := part.surface_sights):
        return []
    known_s, rows_s = part.segment.experiment.t_s, part.segment.dynamics.t_s
    fitted = part.x[part.segment.markers.grid_rows]
    way_m = share * (trajectory.positions_m.reshape(len(fitted), -1) - fitted)
    along_m = np.array([np.interp(rows_s, known_s, each) for each in way_m.T])
    by = along_m.T.reshape(len(rows_s), -1, 3, 1)
    return [
        reading.changes(looked, by[:, reading.sighting.skin.nodes], part.phi)[..., 0]
        for reading, looked in sights
    ]


def _gauged(segment: Segment, x: Array, reactions: tuple[Grid, Forced], phi: Array) -> list[Array]:
    """What readings of one's own say (S, G, 3) of positions x (T, 3n) at the samples."""
    grid, motion = reactions[0], Motion(x, lambda: reactions[1])
    gauges = gauge_readings(segment.experiment, segment.experiment.t_s, grid, segment.nuisance)
    return [gauge.of_motion(motion, phi) for gauge in gauges]


def _share(problem: Problem, segment: Segment) -> float | None:
    """Of the way to a forward simulation, what half the step would go; None if it is no finer."""
    experiment, options = segment.experiment, problem.rollout
    if experiment.static:
        return 1.0
    steps = experiment.timestep_s / _step_s(problem, segment) / segment.substeps
    if options.integrator != "newmark" or steps < LEAST_FINER:
        return None
    order = as_scheme(problem.scheme).order
    # Newmark's own error is of second order: beside one of the first it is none.
    left = steps**-order if order > 1 else 0.0
    return (1 - 0.5**order) / (1 - left)


def _step_s(problem: Problem, segment: Segment) -> float:
    """Of forward simulations: a quarter of the samples' distance at most, and half the grid's."""
    count = min(max(4, 2 * segment.substeps), MOST_STEPS - 1)
    return problem.rollout.timestep_s or segment.experiment.timestep_s / count
