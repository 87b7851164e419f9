"""Correct problems of small blocks that touch one obstacle, of which only the force is measured.

`poked_twin` is a quarter of a gel block that a ball indents, of which the load along z is known,
`sheared_twin` a block that a gripper presses on a plate and then drags along it. Nothing but the
noise differs between seeds.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from make_poked_block import quarter

from collocation_sysid.common.array_types import Array
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.selection import Box
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.model.parameters import Parameters, Unknown
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import (
    Experiment,
    Grasp,
    Nuisance,
    Obstacle,
    Plane,
    PoseSequence,
    Sphere,
    Wrench,
)

TRUTH = {"young_pa": 2e4, "poisson": 0.4, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
UNKNOWN = {**TRUTH, "young_pa": Unknown(1e4)}
DENSITY_KG_M3 = 1000.0
# Distance of selected nodes from a plane [m].
ROUND_OFF_M = 1e-6
# The ball, its depths and the noise of its force on the quarter.
BALL_RADIUS_M = 0.0032
POKED_DEPTHS_M = 4e-4 * np.arange(6)
POKED_NOISE_N = 2.5e-4
# Standard deviation of the prior of the position of the surface [m].
ONSET_M = 1e-4
# The dragged block, its gap above the plate, and the shifts (T, 3) of the gripper: down, then along
# x.
BLOCK_M = (0.04, 0.04, 0.02)
BLOCK_DIVISIONS = (2, 2, 1)
GAP_M = 5e-4
GRIPPER_SHIFTS_M = np.array(
    [[0.0, 0.0, -4e-4 * k] for k in range(6)] + [[5e-4 * k, 0.0, -2e-3] for k in range(1, 6)]
)
# Friction coefficient of the plate.
FRICTION = 0.5
# Slip from sample to sample below which friction is smooth [m].
SLIP_M = 1e-4
DRAGGED_NOISE_N = 5e-3


def translation(shifts_m: Array) -> PoseSequence:
    """Return poses without rotation at one sample each second, from shifts (T, 3) [m]."""
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(shifts_m), 1))
    times_s = np.arange(len(shifts_m), dtype=float)
    return PoseSequence(times_s, shifts_m, upright, "linear")


def poked_twin(seed: int) -> Problem:
    """Return the problem of a ball that indents a block, of which a quarter is modelled."""
    return _with_noise(_poked(), POKED_NOISE_N, seed=seed)


def sheared_twin(seed: int) -> Problem:
    """Return the problem of a block that is pressed on a plate and dragged along it."""
    return _with_noise(_sheared(), DRAGGED_NOISE_N, seed=seed)


def _with_noise(experiment: Experiment, sigma_n: float, seed: int) -> Problem:
    """Return the problem of a simulated experiment with noise on the force of its obstacle."""
    (obstacle,) = experiment.obstacles
    assert obstacle.wrench is not None
    noise = sigma_n * np.random.default_rng(seed).normal(size=obstacle.wrench.values.shape)
    measured = _with_force(obstacle, obstacle.wrench.values + noise, sigma_n=sigma_n)
    return Problem([experiment.with_obstacles([measured])], Parameters.from_mapping(UNKNOWN))


def _with_force(obstacle: Obstacle, values: Array, sigma_n: float) -> Obstacle:
    """Return the obstacle with measured forces (T, 3), or wrenches (T, 6) [N, N m]."""
    times_s = np.arange(len(values), dtype=float)
    return Obstacle(
        poses=obstacle.poses,
        shape=obstacle.shape,
        name=obstacle.name,
        friction=obstacle.friction,
        faces=obstacle.faces,
        slip=obstacle.slip,
        wrench=Wrench(times_s, values[:, :3], sigma_n),
        zero=obstacle.zero,
    )


@cache
def _poked() -> Experiment:
    """Return the indentation with its exact forces; cached."""
    body = Body(quarter(), density_kg_m3=DENSITY_KG_M3, element="tet10")
    x, y, z = body.nodes_m.T
    glued_nodes = np.flatnonzero(z < z.min() + ROUND_OFF_M)
    side_nodes = np.flatnonzero((x < ROUND_OFF_M) & (z > z.min() + ROUND_OFF_M))
    front_nodes = np.flatnonzero((y < ROUND_OFF_M) & (z > z.min() + ROUND_OFF_M))
    fixed = PoseSequence.fixed()
    contact_edge_m = 0.0035
    tip = Obstacle(
        poses=translation(np.outer(POKED_DEPTHS_M, [0.0, 0.0, -1.0])),
        shape=Sphere(BALL_RADIUS_M, (0.0, 0.0, BALL_RADIUS_M)),
        name="tip",
        faces=Box((-1.0, -1.0, -1e-4), (contact_edge_m, contact_edge_m, 1e-4)),
    )
    grasps = [
        Grasp(glued_nodes, fixed),
        Grasp(side_nodes, fixed, axes="x"),
        Grasp(front_nodes, fixed, axes="y"),
    ]
    experiment = _simulated(body, grasps, tip, sigma_n=POKED_NOISE_N)
    (tip,) = experiment.obstacles
    assert tip.wrench is not None
    axial_forces_n = np.where(np.arange(3) == 2, tip.wrench.values[:, :3], np.nan)
    return experiment.with_obstacles([_with_force(tip, axial_forces_n, sigma_n=POKED_NOISE_N)])


@cache
def _sheared() -> Experiment:
    """Return the dragged block with its exact forces; cached."""
    body = Body(box_mesh(BLOCK_M, BLOCK_DIVISIONS), density_kg_m3=DENSITY_KG_M3, element="tet10")
    top = np.flatnonzero(body.nodes_m[:, 2] > BLOCK_M[2] - ROUND_OFF_M)
    plate = Obstacle(
        shape=Plane(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -GAP_M])),
        name="plate",
        friction=FRICTION,
        slip=SLIP_M,
    )
    gripper = Grasp(top, translation(GRIPPER_SHIFTS_M))
    return _simulated(body, [gripper], plate, sigma_n=DRAGGED_NOISE_N)


def _simulated(body: Body, grasps: list[Grasp], obstacle: Obstacle, sigma_n: float) -> Experiment:
    """Return a static experiment with the exact force of its obstacle."""
    count = max(len(each.poses.t_s) for each in [*grasps, obstacle])
    blank = _with_force(obstacle, np.zeros((count, 3)), sigma_n=sigma_n)
    experiment = Experiment(
        body,
        np.arange(count, dtype=float),
        [*grasps, blank],
        name="contact",
        kind="static",
        gravity_m_s2=(0.0, 0.0, 0.0),
        air_density_kg_m3=0.0,
        nuisance=Nuisance.none(obstacle_offset_m=ONSET_M),
    )
    (forces,) = simulate(experiment, TRUTH).wrenches
    return experiment.with_obstacles([_with_force(obstacle, forces, sigma_n=sigma_n)])
