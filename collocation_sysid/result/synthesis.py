"""Synthetic data sets: simulate a problem's experiments and write what a laboratory would."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..checked import Count, NotNegative, Options, Positive
from ..errors import InputError, require_among
from ..files import whole_file
from ..model.schemes import SCHEMES
from ..problem import Problem
from ..program.simulation import NEWMARK, Trajectory, simulate
from ..recording import (
    Experiment,
    write_gauge_csv,
    write_markers_csv,
    write_poses_csv,
    write_wrench_csv,
)
from ..written_files import LIST_FILE, hashes_of, is_written_here, list_as_text, listed_hashes
from .writers import (
    FRAMES_FILE,
    require_no_link,
    require_only_written,
    require_replaceable,
    run_folder,
    write_frames,
)


@dataclass(frozen=True)
class Recipe(Options):
    """How data are made.

    Attributes
    ----------
    integrator : str
        newmark, or a scheme: midpoint, backward-euler, bdf2.
    timestep_s : float
        The step of newmark; chosen so that the motion does not depend on it by default.
    noise_m : float
        Standard deviation of the markers' noise.
    noise_n : float
        That of measured forces.
    noise_nm : float
        That of measured torques.
    noise_own : float
        That of custom readings, in their sigmas.
    seed : int
        Seed of the noise.
    frames : --frames/--no-frames
        Also write frames for ParaView.

    Raises
    ------
    InputError
        For an unknown integrator, and a timestep, noise or seed that cannot be.
    """

    integrator: str = NEWMARK
    timestep_s: Positive | None = None
    noise_m: NotNegative = 0.0
    noise_n: NotNegative = 0.0
    noise_nm: NotNegative = 0.0
    noise_own: NotNegative = 0.0
    seed: Count = 0
    frames: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        require_among(self.integrator, (NEWMARK, *SCHEMES), None, "integrator")


def write_data(
    problem: Problem,
    folder: str | Path,
    recipe: Recipe | None = None,
    progress: Callable[[float], None] | None = None,
) -> list[Path]:
    """Simulate every experiment at the parameters' guesses and write poses, markers and wrenches.

    Parameters
    ----------
    problem : Problem
    folder : str or Path
        Made where it is missing; gets ``<experiment>_markers.csv``, ``<experiment>_poses.csv``
        (``_poses_2`` … for further grasps), ``<experiment>_wrench.csv`` (``_wrench_2`` …) of
        grasps whose wrench is measured, ``<experiment>_reading_<name>.csv`` of readings of one's
        own, and ``<experiment>/`` with frames when asked for.
    recipe : Recipe, optional
        Without noise by default.
    progress : callable, optional
        Called with the share of a simulation that is done.

    Returns
    -------
    list of Path
        The files written.

    Raises
    ------
    InputError
        For a parameter without a guess, and before anything is written into a folder that has
        files of others, or a file is overwritten that the problem reads or that this program did
        not write. The problem's own folder may have other files.
    SimulationError
        Before anything is written.
    """
    place, recipe = Path(folder), recipe or Recipe()
    _refuse_unguessed(problem)
    _refuse_foreign(problem, place)
    for experiment in problem.experiments if recipe.frames else ():
        require_replaceable(place / experiment.name, mark=FRAMES_FILE, what="simulation")
    rng = np.random.default_rng(recipe.seed)
    simulated = [
        simulate(
            experiment,
            problem.parameters,
            recipe.integrator,
            timestep_s=recipe.timestep_s,
            # The grid of the problem is that of schemes; Newmark's step is stated in the recipe.
            substeps="auto" if recipe.integrator == NEWMARK else problem.substeps,
            progress=progress,
        )
        for experiment in problem.experiments
    ]
    written = []
    drafts_of: dict[Path, Path] = {}
    with ExitStack() as whole:  # all files appear at its end, or none
        for experiment, trajectory in zip(problem.experiments, simulated, strict=True):
            files = _tables(experiment, place)
            drafts = [whole.enter_context(whole_file(file)) for file in files]
            drafts_of |= dict(zip(files, drafts, strict=True))
            _write_tables(experiment, trajectory, drafts, rng, recipe)
            written += files
            if recipe.frames:
                folder, body = place / experiment.name, experiment.body
                there = run_folder(folder, mark=FRAMES_FILE, what="simulation")
                at = whole.enter_context(there), trajectory.t_s, trajectory.positions_m
                write_frames(*at, body.cells, body.element, body.nodes_m)
                written.append(folder / FRAMES_FILE)
        by_name = {file.name: draft for file, draft in drafts_of.items()}
        listing = whole.enter_context(whole_file(place / LIST_FILE))
        hashes = listed_hashes(place) | hashes_of(by_name)
        listing.write_text(list_as_text(hashes), encoding="utf-8")
    return written


def _write_tables(
    experiment: Experiment,
    trajectory: Trajectory,
    files: Sequence[Path],
    rng: np.random.Generator,
    recipe: Recipe,
) -> None:
    """Write markers, poses and wrenches into the files of `_tables`."""
    noise = recipe.noise_m * rng.normal(size=trajectory.markers_m.shape)
    names, tracks = experiment.markers.names, trajectory.markers_m + noise
    left = iter(files)
    write_markers_csv(next(left), experiment.t_s, names, tracks)
    for grasp in experiment.grasps:
        write_poses_csv(next(left), grasp.poses)
    for sensor, wrench in zip(experiment.wrenches, trajectory.wrenches, strict=True):
        measured = np.where(sensor.measured, wrench, np.nan)
        noise = np.repeat([recipe.noise_n, recipe.noise_nm], 3) * rng.normal(size=wrench.shape)
        write_wrench_csv(next(left), sensor.t_s, measured + noise)
    for gauge, read in zip(experiment.readings, trajectory.readings, strict=True):
        noise = recipe.noise_own * gauge.sigma * rng.normal(size=read.shape)
        write_gauge_csv(next(left), gauge.times, gauge.columns, read + noise)


def _refuse_unguessed(problem: Problem) -> None:
    if names := problem.parameters.unguessed:
        key = f"parameters.{names[0]}"
        raise InputError(
            f"has no guess, and a simulation needs a value; expected --set {key}.guess=VALUE",
            problem.path,
            key,
        )


def _refuse_foreign(problem: Problem, place: Path) -> None:
    """Refuse a folder with files of others, and to overwrite one that the problem reads.

    What the problem reads may be a recording. Its own folder may have other files.
    """
    require_no_link(place)
    read = {file.resolve() for file in problem.origin.files} if problem.origin else set()
    for experiment in problem.experiments:
        for file in _tables(experiment, place):
            if file.exists() and file.resolve() in read:
                raise InputError(
                    f"{problem.path} reads this file, so it is not overwritten; choose another "
                    "folder, or move it away",
                    file,
                )
            if (file.exists() or file.is_symlink()) and not is_written_here(file):
                raise InputError(
                    "is there and was not written by this program, or was changed since, so it is "
                    "not overwritten; choose another folder, or move it away",
                    file,
                )
    at_home = problem.path is not None and problem.path.resolve().parent == place.resolve()
    if place.is_dir() and not at_home:
        require_only_written(place)


def _tables(experiment: Experiment, place: Path) -> list[Path]:
    """The marker file, one of poses for each grasp, and one for each sensor and own reading."""
    kinds = [("poses", k) for k in range(len(experiment.grasps))]
    kinds += [("wrench", k) for k in range(len(experiment.wrenches))]
    names = [f"{kind}_{k + 1}" if k else kind for kind, k in kinds]
    names += [f"reading_{gauge.name}" for gauge in experiment.readings]
    return [place / f"{experiment.name}_{name}.csv" for name in ("markers", *names)]
