"""Synthetic data sets: simulate a problem's experiments and write what a laboratory would."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from .errors import InputError
from .experiment import Experiment, write_markers_csv, write_poses_csv, write_wrench_csv
from .files import whole_file
from .nlp.schemes import SCHEMES
from .nlp.simulation import Trajectory, simulate
from .output.writers import FRAMES_FILE, require_replaceable, run_folder, write_frames
from .problem import Problem


def write_data(
    problem: Problem,
    folder: str | Path,
    integrator: str = "newmark",
    timestep_s: float | None = None,
    noise_m: float = 0.0,
    seed: int = 0,
    frames: bool = False,
    progress: Callable[[float], None] | None = None,
    noise_n: float = 0.0,
    noise_nm: float = 0.0,
) -> list[Path]:
    """Simulate every experiment at the parameters' guesses and write poses, markers and wrenches.

    Parameters
    ----------
    problem : Problem
    folder : str or Path
        Made where it is missing; gets ``<experiment>_markers.csv``, ``<experiment>_poses.csv``
        (``_poses_2`` … for further grasps), ``<experiment>_wrench.csv`` (``_wrench_2`` …) of
        grasps whose wrench is measured, and ``<experiment>/`` with frames when asked for.
    integrator, timestep_s
        See `simulate`.
    noise_m : float
        Standard deviation of the normal noise on every coordinate.
    seed : int
    noise_n, noise_nm : float
        The same of every component of the wrenches.

    Returns
    -------
    list of Path
        The files written.

    Raises
    ------
    InputError
        For a parameter without a guess, an unknown integrator, a timestep, noise or seed that
        cannot be, and before a file that the problem reads is overwritten.
    SimulationError
        Before anything is written.
    """
    place = Path(folder)
    _refuse_unguessed(problem)
    noises = {"--noise-m": noise_m, "--noise-n": noise_n, "--noise-nm": noise_nm}
    _refuse_options(integrator, timestep_s, noises, seed)
    _refuse_inputs(problem, place)
    for experiment in problem.experiments if frames else ():
        require_replaceable(place / experiment.name, mark=FRAMES_FILE, what="simulation")
    rng = np.random.default_rng(seed)
    given, substeps = problem.parameters, problem.first_substeps
    simulated = [
        simulate(experiment, given, integrator, timestep_s, substeps, None, progress)
        for experiment in problem.experiments
    ]
    written = []
    with ExitStack() as whole:  # all files appear at its end, or none
        for experiment, trajectory in zip(problem.experiments, simulated, strict=True):
            files = _tables(experiment, place)
            drafts = [whole.enter_context(whole_file(file)) for file in files]
            _write_tables(experiment, trajectory, drafts, rng, (noise_m, noise_n, noise_nm))
            written += files
            if frames:
                folder = place / experiment.name
                there = run_folder(folder, mark=FRAMES_FILE, what="simulation")
                _write_frames(experiment, trajectory, whole.enter_context(there))
                written.append(folder / FRAMES_FILE)
    return written


def _write_tables(
    experiment: Experiment,
    trajectory: Trajectory,
    files: Sequence[Path],
    rng: np.random.Generator,
    noises: tuple[float, float, float],
) -> None:
    """Write markers, poses and wrenches into the files of `_tables`."""
    noise_m, *of_wrench = noises
    noise = noise_m * rng.normal(size=trajectory.markers_m.shape)
    names, tracks = experiment.markers.names, trajectory.markers_m + noise
    write_markers_csv(files[0], experiment.t_s, names, tracks)
    count = len(experiment.grasps)
    for file, grasp in zip(files[1 : 1 + count], experiment.grasps, strict=True):
        write_poses_csv(file, grasp.poses)
    sensors = [grasp.wrench for grasp in experiment.grasps if grasp.wrench is not None]
    sensed = zip(files[1 + count :], sensors, trajectory.wrenches, strict=True)
    for file, sensor, wrench in sensed:
        measured = np.where(sensor.measured, wrench, np.nan)
        noise = np.repeat(of_wrench, 3) * rng.normal(size=wrench.shape)
        write_wrench_csv(file, sensor.t_s, measured + noise)


def _refuse_options(
    integrator: str, timestep_s: float | None, noises: Mapping[str, float], seed: int
) -> None:
    known = ("newmark", *SCHEMES)
    if integrator not in known:
        raise InputError(
            f"found {integrator!r}; expected one of {', '.join(known)}", None, "--integrator"
        )
    if timestep_s is not None and not 0 < timestep_s < np.inf:
        raise InputError(
            f"found {timestep_s:g}; expected a number of seconds above 0", None, "--timestep-s"
        )
    for (option, size), unit in zip(noises.items(), ("metres", "newtons", "N m"), strict=True):
        if not 0 <= size < np.inf:
            raise InputError(f"found {size:g}; expected {unit}, 0 or more", None, option)
    if seed < 0:
        raise InputError(f"found {seed}; expected a whole number, 0 or more", None, "--seed")


def _refuse_unguessed(problem: Problem) -> None:
    if names := problem.parameters.unguessed:
        key = f"parameters.{names[0]}"
        raise InputError(
            f"has no guess, and a simulation needs a value; expected --set {key}.guess=VALUE",
            problem.path,
            key,
        )


def _refuse_inputs(problem: Problem, place: Path) -> None:
    """Refuse to overwrite a file that the problem reads: it may be a recording."""
    read = {file.resolve() for file in problem.origin.files} if problem.origin else set()
    for experiment in problem.experiments:
        for file in _tables(experiment, place):
            if file.exists() and file.resolve() in read:
                raise InputError(
                    f"{problem.path} reads this file, so it is not overwritten; choose another "
                    "folder, or move it away",
                    file,
                )


def _tables(experiment: Experiment, place: Path) -> list[Path]:
    """The marker file, one of poses for each grasp, and one for each sensor."""
    sensors = sum(grasp.wrench is not None for grasp in experiment.grasps)
    kinds = [("poses", k) for k in range(len(experiment.grasps))]
    kinds += [("wrench", k) for k in range(sensors)]
    names = [f"{kind}_{k + 1}" if k else kind for kind, k in kinds]
    return [place / f"{experiment.name}_{name}.csv" for name in ("markers", *names)]


def _write_frames(experiment: Experiment, trajectory: Trajectory, folder: Path) -> None:
    body = experiment.body
    write_frames(
        folder, trajectory.t_s, trajectory.positions_m, body.cells, body.element, body.nodes_m
    )
