"""Forward simulation of an experiment: Newmark, or any collocation scheme."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array
from ..errors import InputError, SimulationError
from ..model.dynamics import Dynamics
from ..model.nuisance import NuisanceMap
from ..model.parameters import Parameters, theta_of
from ..model.schemes import MOST_STEPS, Scheme
from ..recording.experiment import Experiment
from ..recording.nuisance import Nuisance
from .channel import Forced, Motion
from .gauge import gauge_readings
from .lost_stability import explained
from .marching import Progress, march
from .newmark import newmark
from .newton import NewtonOptions
from .reaction import forces_on, reactions
from .wrench import wrench_readings
from .wrench_channel import Grid, sensed_dofs


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Node positions over time, and the markers they carry.

    Attributes
    ----------
    t_s : (T,)
    positions_m : (T, n, 3)
    velocities_m_s : (T, n, 3)
    markers_m : (T, M, 3)
    reactions : (Grid, Forced)
        Those on the dofs of grasps with a sensor.
    wrenches : tuple of (S, 6)
        What the sensors of the grasps read at their times, [N] and [N m], NaN where that is not
        known.
    readings : tuple of (S, m)
        What the experiment's readings of one's own read, of the positions at its samples.
    """

    t_s: Array
    positions_m: Array
    velocities_m_s: Array
    markers_m: Array
    reactions: tuple[Grid, Forced]
    wrenches: tuple[Array, ...]
    readings: tuple[Array, ...] = ()


def require_steps(experiment: Experiment, step_s: float) -> None:
    """Refuse a step that is far too short for an experiment's samples.

    Raises
    ------
    InputError
    """
    if not experiment.static and experiment.timestep_s > MOST_STEPS * step_s:
        raise InputError(
            f"found steps of {step_s:g} s; expected at most {MOST_STEPS} from sample to sample"
        )


def simulate(
    experiment: Experiment,
    parameters: Parameters | Mapping[str, float] | Sequence[float] | Array,
    integrator: str | Scheme = "newmark",
    timestep_s: float | None = None,
    substeps: int = 1,
    options: NewtonOptions | None = None,
    progress: Progress | None = None,
) -> Trajectory:
    """Simulate an experiment forward from its start; a static one from equilibrium to equilibrium.

    Parameters
    ----------
    experiment : Experiment
    parameters : Parameters (their guesses), values by name, or θ in the order of the body
    integrator : str or Scheme
        "newmark", or a scheme, by its name in `schemes.SCHEMES`, on the collocation grid.
    timestep_s : float, optional
        Newmark's step, rounded to divide the sample interval; a quarter of it by default.
    substeps : int
        Grid steps between samples for a scheme.
    options : NewtonOptions, optional
    progress : callable, optional
        Called with the share done, between 0 and 1.

    Returns
    -------
    Trajectory at the experiment's samples

    Raises
    ------
    InputError
        For a step or substeps that are not positive, too many steps, an unknown scheme, or a
        density that leaves a node without mass.
    SimulationError
        When a step fails even after halvings; names time and element, and where an equilibrium
        ceased to be stable the mode, see `program.lost_stability`.
    """
    theta = theta_of(experiment.body, parameters)
    try:
        return _simulate(experiment, theta, integrator, timestep_s, substeps, options, progress)
    except SimulationError as error:
        if (reason := explained(experiment, theta, error)) is error:
            raise
        raise reason from error


def _simulate(
    experiment: Experiment,
    theta: Array,
    integrator: str | Scheme,
    timestep_s: float | None,
    substeps: int,
    options: NewtonOptions | None,
    progress: Progress | None,
) -> Trajectory:
    """Return what `simulate` does, without the reasons of its errors."""
    sensed = sensed_dofs(experiment)
    if timestep_s is not None and not timestep_s > 0:
        raise InputError(f"timestep_s = {timestep_s:g}, expected a positive time")
    if substeps < 1:
        raise InputError(f"substeps = {substeps}, expected at least 1")
    if (massless := experiment.body.massless(theta)) is not None:
        raise InputError(massless)
    if integrator == "newmark" and not experiment.static:
        step = timestep_s or experiment.timestep_s / 4
        require_steps(experiment, step)
        count = max(1, round(experiment.timestep_s / step))
        x, v, forced = newmark(experiment, theta, count, options, progress, sensed)
        rows = (len(x) - 1) * count + 1
        at = Grid.at(np.linspace(experiment.t_s[0], experiment.t_s[-1], rows))
    else:
        taken = 1 if experiment.static else substeps
        dynamics = Dynamics.of(experiment, integrator, taken).with_theta(theta)
        grid = march(experiment, dynamics, options, progress)
        x = grid[::taken]
        still = np.zeros_like(grid)
        v = still if experiment.static else np.gradient(grid, dynamics.step_s, axis=0)[::taken]
        at, force = Grid.of(dynamics), forces_on(dynamics, grid, sensed)
        mass_kg, acceleration = dynamics.mass.kg[:, sensed], dynamics.acceleration(grid)
        reaction = reactions(dynamics, mass_kg, force, acceleration[:, sensed])
        forced = Forced(reaction, grid[:, sensed])
    shape = (len(x), -1, 3)
    positions = x.reshape(shape)
    markers = experiment.markers.observe(positions)
    ideal = NuisanceMap.of(replace(experiment, nuisance=Nuisance.none()))
    wrenches = tuple(
        sensor.of_forced(forced, np.zeros(ideal.size))
        for sensor in wrench_readings(experiment, at, ideal)
    )
    return Trajectory(
        experiment.t_s,
        positions,
        v.reshape(shape),
        markers,
        (at, forced),
        wrenches,
        _gauged(experiment, positions, (at, forced), ideal),
    )


def _gauged(
    experiment: Experiment, positions_m: Array, reactions: tuple[Grid, Forced], ideal: NuisanceMap
) -> tuple[Array, ...]:
    """What its gauges read of the body's motion, nothing of them unknown."""
    readings = gauge_readings(experiment, experiment.t_s, reactions[0], ideal)
    motion = Motion(positions_m.reshape(len(positions_m), -1), lambda: reactions[1])
    return tuple(
        reading.said(reading.of_motion(motion, np.zeros(ideal.size))) for reading in readings
    )


def with_wrenches(experiment: Experiment, wrenches: Sequence[Array]) -> Experiment:
    """The same experiment with other values (S, 6) at the grasps that have a sensor."""
    found, grasps = iter(wrenches), []
    for grasp in experiment.grasps:
        sensor = grasp.wrench and replace(grasp.wrench, values=next(found))
        grasps.append(replace(grasp, wrench=sensor))
    return replace(experiment, grasps=grasps)


def with_readings(experiment: Experiment, readings: Sequence[ArrayLike]) -> Experiment:
    """The same experiment with other values (S, m) of its readings of one's own."""
    pairs = zip(experiment.readings, readings, strict=True)
    return replace(experiment, readings=[replace(g, values=v) for g, v in pairs])


def with_markers(experiment: Experiment, positions_m: ArrayLike) -> Experiment:
    """The same experiment with other marker tracks (T, M, 3)."""
    tracks = np.asarray(positions_m, dtype=float)
    if tracks.shape != experiment.markers.positions_m.shape:
        raise InputError(
            f"marker tracks have shape {tracks.shape}, "
            f"expected {experiment.markers.positions_m.shape}"
        )
    return replace(experiment, markers=replace(experiment.markers, positions_m=tracks))
