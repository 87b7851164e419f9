"""Twins without errors: two small bodies, moved at random, with noisy marker tracks."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.model.parameters import Unknown
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Grasp, Markers, PoseSequence, Wrench

# Standard deviation of each marker coordinate [m], typical of cameras in a room.
NOISE_M = 5e-4
# Number of samples, and the time between them [s].
SAMPLES = 60
STEP_S = 0.01
# Edges [m] and numbers of elements along x, y and z; the nodes of the upper face are grasped.
BODIES = {"block": ((0.06, 0.06, 0.09), (2, 2, 3)), "bar": ((0.03, 0.03, 0.12), (1, 1, 4))}
# True constants of the soft and of the stiff body, and initial guesses with bounds.
SOFT = {"lambda_pa": 800.0, "mu_pa": 600.0, "gamma_r_s": 0.006, "gamma_m_1_s": 1.5}
GUESS = {
    "lambda_pa": Unknown(400.0, 10.0, 1e5),
    "mu_pa": Unknown(150.0, 10.0, 1e5),
    "gamma_r_s": Unknown(0.02, 1e-5, 1.0),
    "gamma_m_1_s": Unknown(0.5, 1e-3, 100.0),
}
STIFF = SOFT | {"lambda_pa": 16e3, "mu_pa": 12e3, "gamma_r_s": 0.002}


@cache
def block(size_m: tuple[float, ...], divisions: tuple[int, ...]) -> Body:
    """Return a block of foam with edges `size_m` [m].

    The cached body is shared by all twins, so that its kernels compile once.
    """
    return Body(box_mesh(size_m, divisions), density_kg_m3=30.0, damping="rayleigh")


def random_poses(t_s: np.ndarray, rng: np.random.Generator) -> PoseSequence:
    """Return poses at `t_s` [s] of a motion from rest, from a random pose, in all six degrees of
    freedom.
    """
    start = Rotation.from_quat(rng.normal(size=4))
    place_m = rng.uniform(-0.5, 0.5, 3)
    rise = (t_s - t_s[0]) ** 2 / ((t_s - t_s[0]) ** 2 + 0.1**2)

    def swing(size: float) -> np.ndarray:
        frequency = rng.uniform(1.0, 3.0, 3)
        phase = rng.uniform(0, 2 * np.pi, 3)
        wave = np.sin(2 * np.pi * np.outer(t_s, frequency) + phase)
        return size * rise[:, None] * rng.uniform(0.5, 1.0, 3) * wave

    rotations = Rotation.from_rotvec(swing(0.5)) * start
    return PoseSequence(t_s, place_m + swing(0.05), rotations.as_quat())


def twin(
    name: str,
    truth: dict[str, float],
    seed: int,
    samples: int = SAMPLES,
    integrator: str = "newmark",
    substeps: int | Literal["auto"] = "auto",
) -> Problem:
    """Return the correct problem of a simulated recording with noise."""
    rng = np.random.default_rng(seed)
    size_m, divisions = BODIES[name]
    body = block(size_m, divisions)
    t_s = STEP_S * np.arange(samples)
    grasped_nodes = np.flatnonzero(body.nodes_m[:, 2] > size_m[2] - 1e-6)
    free_nodes = np.setdiff1d(np.arange(len(body.nodes_m)), grasped_nodes)
    places_m = body.nodes_m[rng.choice(free_nodes, 6, replace=False)]
    markers = Markers(t_s, np.zeros((samples, 6, 3)), NOISE_M, places_m=places_m)
    experiment = Experiment(
        body, t_s, [Grasp(grasped_nodes, random_poses(t_s, rng))], markers, name="swing"
    )
    tracks_m = simulate(experiment, truth, integrator, substeps=substeps).markers_m
    noise = rng.normal(scale=NOISE_M, size=tracks_m.shape)
    return Problem([with_markers(experiment, tracks_m + noise)], GUESS)


# Standard deviations of the noise of the force [N] and torque [N m] sensor.
WRENCH_N = 5e-4
WRENCH_NM = 5e-5


def sensing_twin(name: str, truth: dict[str, float], seed: int, samples: int = SAMPLES) -> Problem:
    """Return a `twin` with a force–torque sensor at the grasp.

    The wrench is expressed in the frame of the grasp, about a point above the body.
    """
    unsensed = twin(name, truth, seed, samples)
    (experiment,) = unsensed.experiments
    (grasp,) = experiment.grasps
    point_m = (0.01, 0.02, BODIES[name][0][2] + 0.03)
    zero = np.zeros((samples, 6))
    sensor = Wrench(experiment.t_s, zero, WRENCH_N, WRENCH_NM, frame="grasp", point_m=point_m)
    sensed = replace(experiment, grasps=[replace(grasp, wrench=sensor)])
    (values,) = simulate(sensed, truth, "newmark").wrenches
    noise = np.random.default_rng(seed).normal(
        scale=np.repeat([WRENCH_N, WRENCH_NM], 3), size=values.shape
    )
    noisy_sensor = replace(sensor, values=values + noise)
    return replace(
        unsensed, experiments=[replace(experiment, grasps=[replace(grasp, wrench=noisy_sensor)])]
    )
