"""Forward simulation of an experiment: Newmark, or any collocation scheme."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Array
from ..errors import InputError
from ..experiment.experiment import Experiment
from .dynamics import Dynamics
from .marching import Progress, march
from .newmark import newmark
from .newton import NewtonOptions
from .parameters import Parameters, theta_of
from .schemes import Scheme


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Node positions over time, and the markers they carry.

    Attributes
    ----------
    t_s : (T,)
    positions_m : (T, n, 3)
    velocities_m_s : (T, n, 3)
    markers_m : (T, M, 3)
    """

    t_s: Array
    positions_m: Array
    velocities_m_s: Array
    markers_m: Array


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
        For a step or substeps that are not positive, or an unknown scheme.
    SimulationError
        When a step fails even after halvings; names time and element.
    """
    theta = theta_of(experiment.body, parameters)
    if timestep_s is not None and not timestep_s > 0:
        raise InputError(f"timestep_s = {timestep_s:g}, expected a positive time")
    if substeps < 1:
        raise InputError(f"substeps = {substeps}, expected at least 1")
    if experiment.static:
        x = march(experiment, Dynamics.of(experiment, integrator), theta, options, progress)
        v = np.zeros_like(x)
    elif integrator == "newmark":
        step = timestep_s or experiment.timestep_s / 4
        count = max(1, round(experiment.timestep_s / step))
        x, v = newmark(experiment, theta, count, options, progress)
    else:
        dynamics = Dynamics.of(experiment, integrator, substeps)
        grid = march(experiment, dynamics, theta, options, progress)
        x = grid[::substeps]
        v = np.gradient(grid, dynamics.step_s, axis=0)[::substeps]
    shape = (len(x), -1, 3)
    positions = x.reshape(shape)
    markers = experiment.markers.observe(positions)
    return Trajectory(experiment.t_s, positions, v.reshape(shape), markers)


def with_markers(experiment: Experiment, positions_m: ArrayLike) -> Experiment:
    """The same experiment with other marker tracks (T, M, 3)."""
    tracks = np.asarray(positions_m, dtype=float)
    if tracks.shape != experiment.markers.positions_m.shape:
        raise InputError(
            f"marker tracks have shape {tracks.shape}, "
            f"expected {experiment.markers.positions_m.shape}"
        )
    return replace(experiment, markers=replace(experiment.markers, positions_m=tracks))
