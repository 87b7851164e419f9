"""A new problem: a commented file, and a recording simulated for it, so that it runs as it is."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from ..arrays import Array
from ..errors import InputError
from ..fem.body import Body
from ..fem.selection import Box
from ..fem.structured import cylinder_of_edge
from ..files import write_whole
from ..folders import require_possible
from ..program.simulation import simulate
from ..recording import Grasp, Markers, PoseSequence, write_markers_csv, write_poses_csv
from ..recording.experiment import Experiment
from . import Problem

YOUNG_PA = 8e4
SWUNG = {"young_pa": 8000.0, "poisson": 0.3, "gamma_r_s": 0.005, "gamma_m_1_s": 1.0}
SEED = 1
TEMPLATES = Path(__file__).parent / "templates"


def write_template(folder: Path, kind: str = "swing") -> Path:
    """Write problem.toml of a kind into a folder, which is made; its name is the title.

    Raises
    ------
    InputError
        Where there is one already, or the folder cannot be made.
    """
    file = folder / "problem.toml"
    require_possible(folder)
    if file.exists():
        raise InputError("it is there already; choose another name", file)
    title = json.dumps(folder.resolve().name, ensure_ascii=False)  # quoted as TOML quotes
    text = (TEMPLATES / f"{kind}.toml").read_text(encoding="utf-8")
    write_whole(file, text.replace('title = ""', f"title = {title}", 1))
    return file


def begin(folder: Path, kind: str) -> list[Path]:
    """Write the problem of a kind, and a recording simulated at `YOUNG_PA` or `SWUNG`.

    Returns
    -------
    list of Path
        The problem file, then its data.

    Raises
    ------
    InputError
        Where there is a problem already, or the folder cannot be made.
    """
    file = write_template(folder, kind)
    return [file, *RECORDINGS[kind](folder)]


def _swing(folder: Path) -> list[Path]:
    """A foam cylinder that hangs from a gripper, which moves it to and fro."""
    mesh = cylinder_of_edge(0.05, 0.15, 0.025)
    body = Body(mesh, mass_kg=0.1)
    t_s = np.arange(81) * np.float64(0.01)
    hanging = Rotation.from_euler("x", 180, degrees=True).as_quat()
    shift_m = 0.03 * np.outer(1 - np.cos(7 * t_s), [1, 0, 0]) + 0.02 * np.outer(
        np.sin(11 * t_s) ** 2, [0, 1, 0]
    )
    poses = PoseSequence(t_s, shift_m, np.tile(hanging, (len(t_s), 1)))
    places_m = np.array([[25, 0, 60], [0, 25, 105], [25, 0, 150], [-25, 0, 150]]) / 1000
    markers = Markers(t_s, np.zeros((len(t_s), 4, 3)), 1e-3, places_m=places_m)
    grasp = Grasp(Box((-1, -1, -1e-3), (1, 1, 1e-3)), poses)
    tracks_m = simulate(Experiment(body, t_s, [grasp], markers), SWUNG).markers_m
    tracks_m = tracks_m + np.random.default_rng(SEED).normal(scale=1e-3, size=tracks_m.shape)
    files = [folder / name for name in ("body.vtu", "poses.csv", "markers.csv")]
    mesh.write(files[0])
    write_poses_csv(files[1], poses)
    write_markers_csv(files[2], t_s, ["low", "middle", "end_1", "end_2"], tracks_m)
    return files


def _pressed(folder: Path) -> list[Path]:
    """A cylinder pressed by a fifth, as a machine writes it: compression is positive."""
    t_s = np.arange(0.0, 60.5, 0.5)
    names = "Time (s),Displacement (mm),Force (N)"
    return _benched(folder, names, t_s, 0.1 * t_s, noise=0.1, scale=-4.0)


def _pulled(folder: Path) -> list[Path]:
    """A bar pulled by a third, in strain and stress."""
    t_s = np.arange(0.0, 60.5, 0.5)
    names = "Time (s),Strain (%),Stress (kPa)"
    area_m2 = 2.56e-4
    return _benched(folder, names, t_s, 0.5 * t_s, noise=0.02e-3 / area_m2, scale=4e-3 / area_m2)


def _benched(
    folder: Path, names: str, t_s: Array, moved: Array, noise: float, scale: float
) -> list[Path]:
    """The table of a test bench: what the crosshead does, and what the model answers to it.

    The reaction of the part that is modelled is multiplied by `scale`.
    """
    file = folder / "run_1.csv"

    def write(measured: Array) -> None:
        rows = [f"{t:.1f},{m:.4f},{f:.4f}" for t, m, f in zip(t_s, moved, measured, strict=True)]
        write_whole(file, "\n".join([names, *rows, ""]))

    write(np.zeros(len(t_s)))
    at_truth = [f"parameters.young_pa.guess={YOUNG_PA}"]
    problem = Problem.read(folder / "problem.toml", at_truth, simulation=True)
    (experiment,) = problem.experiments
    (reaction,) = simulate(experiment, problem.parameters).wrenches
    (sensor,) = (grasp.wrench for grasp in experiment.grasps if grasp.wrench is not None)
    measured = scale * CubicSpline(sensor.t_s, reaction[:, 2])(t_s)  # between equilibria smooth
    write(measured + np.random.default_rng(SEED).normal(scale=noise, size=len(t_s)))
    return [file]


RECORDINGS: dict[str, Callable[[Path], list[Path]]] = {
    "swing": _swing,
    "compression": _pressed,
    "tension": _pulled,
}
