"""The check of an answer: every experiment simulated forward with it, and compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .arrays import Array, root_mean
from .errors import SimulationError
from .experiment import Experiment
from .fem.batched import side_by_side
from .methods.reduced_space import ReducedSpace
from .methods.solution import Solution, wrench_rms
from .nlp.segment import Segment
from .nlp.simulation import Trajectory, simulate
from .problem import Problem
from .statistics.linearised import Derived, LinearisedFit
from .statistics.numerical import changes_towards


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
    """

    rms_m: float
    max_m: float
    trajectory: Trajectory
    nuisance: Mapping[str, float]
    places_m: Mapping[str, list[float]]
    wrenches: Sequence[Array] = ()
    wrench_rms: tuple[float | None, float | None] = (None, None)


def roll_outs(problem: Problem, solution: Solution) -> dict[str, Rollout | str]:
    """Those of all experiments by their names, see `roll_out`."""
    threads = solution.collocation.threads
    try:
        found = side_by_side(lambda e: roll_out(problem, e, solution), problem.experiments, threads)
    except KeyboardInterrupt:  # the answer itself is there, and worth writing
        found = ["interrupted"] * len(problem.experiments)
    return {e.name: each for e, each in zip(problem.experiments, found, strict=True)}


def roll_out(problem: Problem, experiment: Experiment, solution: Solution) -> Rollout | str:
    """Simulate an experiment with a solution's parameters; or say why that fails."""
    options = problem.rollout
    integrator = problem.scheme if options.integrator == "scheme" else "newmark"
    try:
        segment, phi = _seen(experiment, solution)
        trajectory = simulate(
            segment.corrected(phi),
            experiment.body.theta(solution.parameters),
            integrator,
            timestep_s=options.timestep_s,
            substeps=problem.substeps,
        )
    except SimulationError as error:
        return str(error)
    readings = segment.observation.of_samples(trajectory.positions_m, phi)
    distances = np.linalg.norm(readings - experiment.markers.positions_m, axis=2)
    present = distances[experiment.markers.present]
    nuisance, wrenches = segment.nuisance, _read(segment, phi, trajectory)
    return Rollout(
        root_mean(present**2),
        float(present.max(initial=0.0)),
        replace(trajectory, markers_m=readings),
        dict(zip(nuisance.names, (phi * nuisance.scales).tolist(), strict=True))
        if experiment.validation
        else {},
        dict(zip(experiment.markers.names, segment.places_m(phi).tolist(), strict=True))
        if experiment.validation
        else {},
        wrenches,
        wrench_rms(experiment, wrenches),
    )


def _read(segment: Segment, phi: Array, trajectory: Trajectory) -> list[Array]:
    """What the experiment's sensors read, with its φ, of what was simulated."""
    grid, forced = trajectory.reactions
    return [replace(sensor, on=grid).readings(forced, phi) for sensor in segment.sensors]


def _seen(experiment: Experiment, solution: Solution) -> tuple[Segment, Array]:
    """The experiment with its φ: those of the fit, or fitted with θ as found."""
    collocation = solution.collocation
    for part in collocation.parts(solution.z):
        if part.segment.experiment is experiment:
            return part.segment, part.phi
    found, body = solution.parameters, experiment.body
    alone = replace(
        collocation,
        experiments=[replace(experiment, validation=False)],
        parameters=collocation.parameters.fixed_at(
            {name: found[name] for name in body.used_names(list(found))}
        ),
    )
    (segment,) = alone.segments
    # All that is left to estimate is φ.
    return segment, alone.parameters_of(ReducedSpace()(alone).z) if alone.nphi else np.zeros(0)


def step_changes(
    problem: Problem,
    solution: Solution,
    fit: LinearisedFit,
    rollouts: Mapping[str, Rollout | str],
) -> dict[str, float] | None:
    """Change of every parameter and modulus that a finer step would bring, to first order.

    A Gauss–Newton step towards the roll-outs; None where these are missing or no finer, and where
    all is static.
    """
    apart: list[Array] = []
    if all(segment.experiment.static for segment in solution.collocation.segments):
        return None
    parts = zip(solution.collocation.segments, solution.readings_m, strict=True)
    for segment, readings in parts:
        experiment, rollout = segment.experiment, rollouts.get(segment.experiment.name)
        if not isinstance(rollout, Rollout) or not _finer(problem, experiment):
            return None
        way = rollout.trajectory.markers_m - readings
        apart.append(np.nan_to_num(way / experiment.markers.sigma_m[:, None]))
        fitted = solution.wrenches.get(experiment.name, [])
        for sensor, read, rolled in zip(segment.sensors, fitted, rollout.wrenches, strict=True):
            way = np.nan_to_num((rolled - read) / sensor.wrench.sigmas)
            apart.append(way.reshape(-1, 2, 3))
    collocation = solution.collocation
    q, change = solution.q, changes_towards(fit, apart)[: collocation.nq]
    parameters = collocation.parameters
    after, before = (parameters.values(q + way) for way in (change, 0 * change))
    moduli = Derived.of((s.constants for s in collocation.segments), q).by_q
    return {
        **{name: after[name] - value for name, value in before.items() if after[name] != value},
        **{name: float(slopes @ change) for name, slopes in moduli.items() if slopes.any()},
    }


def _finer(problem: Problem, experiment: Experiment) -> bool:
    """Whether roll-outs have at most half the step of the fit, or there is none."""
    options, interval_s = problem.rollout, experiment.timestep_s
    if experiment.static:
        return True
    step_s = options.timestep_s or interval_s / 4
    return options.integrator == "newmark" and step_s <= 0.501 * interval_s / problem.substeps
