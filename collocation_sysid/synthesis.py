"""Synthetic data sets: simulate a problem's experiments and write what a laboratory would."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from .errors import InputError
from .experiment import Experiment, write_markers_csv, write_poses_csv
from .nlp.schemes import SCHEMES
from .nlp.simulation import Trajectory, simulate
from .problem import Problem
from .results.writers import write_frames


def write_data(
    problem: Problem,
    folder: str | Path,
    integrator: str = "newmark",
    timestep_s: float | None = None,
    noise_m: float = 0.0,
    seed: int = 0,
    frames: bool = False,
    progress: Callable[[float], None] | None = None,
) -> list[Path]:
    """Simulate every experiment at the parameters' guesses and write poses and markers.

    Parameters
    ----------
    problem : Problem
    folder : str or Path
        Made where it is missing; gets ``<experiment>_markers.csv``, ``<experiment>_poses.csv``
        (``_poses_2`` … for further grasps), and ``<experiment>/`` with frames when asked for.
    integrator, timestep_s
        See `simulate`.
    noise_m : float
        Standard deviation of the normal noise on every coordinate.
    seed : int

    Returns
    -------
    list of Path
        The files written.

    Raises
    ------
    InputError
        For an unknown integrator, or a timestep or noise that is no length of time or noise.
    SimulationError
        Before anything is written.
    """
    known = ("newmark", *SCHEMES)
    if integrator not in known:
        raise InputError(
            f"found {integrator!r}; expected one of {', '.join(known)}", None, "--integrator"
        )
    if timestep_s is not None and not 0 < timestep_s < np.inf:
        raise InputError(
            f"found {timestep_s:g}; expected a number of seconds above 0", None, "--timestep-s"
        )
    if not 0 <= noise_m < np.inf:
        raise InputError(f"found {noise_m:g}; expected metres, 0 or more", None, "--noise-m")
    rng = np.random.default_rng(seed)
    substeps = problem.file.transcription.substeps
    simulated = [
        simulate(experiment, problem.parameters, integrator, timestep_s, substeps, None, progress)
        for experiment in problem.experiments
    ]
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    written = []
    for experiment, trajectory in zip(problem.experiments, simulated, strict=True):
        noise = noise_m * rng.normal(size=trajectory.markers_m.shape)
        written += _write_tables(experiment, trajectory.markers_m + noise, place)
        if frames:
            written.append(_write_frames(experiment, trajectory, place / experiment.name))
    return written


def _write_tables(experiment: Experiment, tracks_m: np.ndarray, place: Path) -> list[Path]:
    markers = place / f"{experiment.name}_markers.csv"
    write_markers_csv(markers, experiment.t_s, experiment.markers.names, tracks_m)
    written = [markers]
    for number, grasp in enumerate(experiment.grasps, start=1):
        suffix = "" if number == 1 else f"_{number}"
        file = place / f"{experiment.name}_poses{suffix}.csv"
        write_poses_csv(file, grasp.poses)
        written.append(file)
    return written


def _write_frames(experiment: Experiment, trajectory: Trajectory, folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    body = experiment.body
    return write_frames(
        folder, trajectory.t_s, trajectory.positions_m, body.cells, body.element, body.nodes_m
    )
