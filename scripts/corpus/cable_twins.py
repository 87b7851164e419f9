"""Twins of the example of a cable.

Each twin is simulated with twice as many sections as the example, and deviates from its description
by draws from the priors of the budget: mass (1 %), end of the clamp (0.5 mm), stiffness along the
cable (5 %), direction of gravity (1°), turn and shift in the grasp (0.5° and 1 mm), clocks of markers
and wrench (5 ms), scale of the cameras (0.2 %), tares (0.1 N and 0.01 N m), and noise.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.problem.new import TEMPLATES
from collocation_sysid.recording.writers import write_columns_csv, write_markers_csv

TRUTH = {"bending_n_m2": 1e-3, "gamma_r_s": 2e-3, "gamma_m_1_s": 0.3}
STATED = {"torsion_n_m2": 3e-4, "axial_n": 200.0}
MASS_PER_LENGTH_KG_M, CLAMP_M, SECTIONS = 0.034, 0.05, 81


Grip = tuple[Rotation, np.ndarray]


def write_twin(folder: Path, seed: int) -> tuple[cs.Experiment, Grip]:
    """Write the problem of the example with the data of a twin, and return the true cable with the
    stated poses, and its grip.
    """
    shutil.copytree(TEMPLATES / "cable", folder, dirs_exist_ok=True)
    rng = np.random.default_rng(seed)
    mass_kg_m = MASS_PER_LENGTH_KG_M * (1 + 0.01 * rng.normal())
    clamp_m = CLAMP_M + 5e-4 * rng.normal()
    down = Rotation.from_rotvec([*rng.normal(0, np.radians(1.0), 2), 0.0]).apply([0, 0, -9.81])
    changes = [
        f"object.sections={SECTIONS}",
        f"object.mass_per_length_kg_m={mass_kg_m!r}",
        f"experiment.0.grasp.nodes.s_m=[0.0,{clamp_m!r}]",
        f"experiment.0.gravity_m_s2={down.tolist()!r}",
    ]
    (stated,) = cs.Problem.read(folder / "problem.toml", changes, simulation=True).experiments
    grip = drawn_grip(rng)
    along = stated.body.nodes_m[stated.body.cells, 0].mean(axis=1)
    gradient = 0.05 * rng.normal() * (2 * along / along.max() - 1)
    body = stated.body.with_stiffness_factors(1 + gradient)
    true = replace(stated, body=body)
    motion = cs.simulate(gripped(true, true.grasps[0].poses, grip), TRUTH | STATED)
    t_s = stated.t_s

    def late(values: np.ndarray) -> np.ndarray:
        at_s = np.clip(t_s + 5e-3 * rng.normal(), t_s[0], t_s[-1])
        return CubicSpline(t_s, values)(at_s)

    tracks_m = late(motion.markers_m)
    middle_m = tracks_m.mean(axis=(0, 1))
    tracks_m = middle_m + (1 + 2e-3 * rng.normal()) * (tracks_m - middle_m)
    tracks_m += rng.normal(scale=5e-4, size=tracks_m.shape)
    write_markers_csv(folder / "markers.csv", t_s, ["middle", "tip"], tracks_m)
    units = np.repeat([1.0, 0.1], 3)
    wrench = late(motion.wrenches[0]) + units * (
        0.1 * rng.normal(size=6) + 0.01 * rng.normal(size=(len(t_s), 6))
    )
    names = ("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm")
    write_columns_csv(
        folder / "wrench.csv", {"t_s": t_s, **dict(zip(names, wrench.T, strict=True))}
    )
    return true, grip


def drawn_grip(rng: np.random.Generator) -> Grip:
    """Draw turn and shift of the cable in the gripper."""
    turn = Rotation.from_rotvec(rng.normal(0, np.radians(0.5), 3))
    pivot_m = np.array([CLAMP_M / 2, 0.0, 0.0])
    return turn, pivot_m + rng.normal(0, 1e-3, 3) - turn.apply(pivot_m)


def gripped(experiment: cs.Experiment, poses: cs.PoseSequence, grip: Grip) -> cs.Experiment:
    """Return the experiment with a gripper that moves along poses."""
    turn, shift_m = grip
    hand = Rotation.from_quat(poses.quaternions_xyzw)
    held = cs.PoseSequence(
        poses.t_s, poses.positions_m + hand.apply(shift_m), (hand * turn).as_quat()
    )
    (grasp,) = experiment.grasps
    return replace(experiment, grasps=(replace(grasp, poses=held),))
