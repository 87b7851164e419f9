"""Recording that `benchmark_peers` identifies: a soft cylinder that hangs from a hand and is swung.

The cylinder has the energy of St. Venant and Kirchhoff and the damping stress
S_v = γ_r (λ tr(Ė) I + 2 μ Ė); all free nodes have the same mass. It hangs in equilibrium when the
recording begins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import collocation_sysid as cs

Array = NDArray[np.float64]

# True values: Young's modulus [Pa], Poisson's ratio [1], damping time γ_r [s].
TRUTH = {"young_pa": 20e3, "poisson": 0.3, "gamma_r_s": 4e-3}
# Initial guess of every candidate.
GUESS = {"young_pa": 30e3, "poisson": 0.2, "gamma_r_s": 2e-3}
# Bounds of the search of every candidate.
BOUNDS = {"young_pa": (2e3, 2e5), "poisson": (0.05, 0.45), "gamma_r_s": (2e-4, 5e-2)}
GRAVITY_M_S2 = np.array([0.0, 0.0, -9.81])
RADIUS_M = 0.02
HEIGHT_M = 0.12
# Rings and layers of the mesh: 95 nodes, 288 tetrahedra.
RINGS = 2
LAYERS = 4
# Mass of every node: 60 g of foam on 95 nodes.
NODE_MASS_KG = 0.06 / 95
SAMPLE_S = 0.01
SAMPLE_COUNT = 51
# Nodes with markers, on the surface: three at the free end and three at mid-height.
MARKED_NODES = (7, 11, 15, 45, 49, 53)
# Standard deviation of a marker coordinate, of a good motion-capture system.
NOISE_M = 1e-4
SEED = 0
# The hand swings along x and about y; both begin smoothly within RAMP_S.
SWING_M = 0.03
SWING_RAD = 0.25
SWING_RATES_RAD_S = (16.0, 11.0)
RAMP_S = 0.2
# Time steps per sample of implicit rules; the motion is then within 0.02 mm
# (root mean square) of that of MuJoCo's explicit steps of 0.01 ms.
STEPS_PER_SAMPLE = 4


@dataclass(frozen=True)
class HandMotion:
    """Displacement of the hand along x [m], its angle about y [rad] and their rates, (2,) each."""

    coordinates: Array
    rates: Array


def cylinder() -> cs.TetMesh:
    """Return the mesh of the cylinder, whose top is grasped."""
    return cs.cylinder_mesh(radius_m=RADIUS_M, height_m=HEIGHT_M, rings=RINGS, layers=LAYERS)


def grasped_nodes(mesh: cs.TetMesh) -> NDArray[np.intp]:
    """Return the nodes at the top, which the hand grasps."""
    return np.flatnonzero(mesh.points_m[:, 2] > HEIGHT_M - 1e-6)


def hand_motion(time_s: float) -> HandMotion:
    """Return the prescribed motion of the hand at a time [s]."""
    share = min(1.0, time_s / RAMP_S)
    ramp = share**2 * (3 - 2 * share)
    ramp_rate = 6 * share * (1 - share) / RAMP_S
    amplitudes = np.array([SWING_M, SWING_RAD])
    rates = np.array(SWING_RATES_RAD_S)
    swing = amplitudes * np.sin(rates * time_s)
    swing_rate = amplitudes * rates * np.cos(rates * time_s)
    return HandMotion(ramp * swing, ramp_rate * swing + ramp * swing_rate)


def hand_pose(time_s: float) -> Array:
    """Return the pose (4, 4) of the hand, which turns about the centre of the cylinder's top."""
    shift_m, angle = hand_motion(time_s).coordinates
    pose = np.eye(4)
    cosine = np.cos(angle)
    sine = np.sin(angle)
    pose[:3, :3] = [[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]
    centre_m = np.array([0.0, 0.0, HEIGHT_M])
    pose[:3, 3] = centre_m - pose[:3, :3] @ centre_m
    pose[0, 3] += shift_m
    return pose


def hand_poses(times_s: NDArray[np.floating]) -> Array:
    """Return the poses (k, 4, 4) of the hand at times (k,) [s]."""
    return np.array([hand_pose(time_s) for time_s in times_s.tolist()])


def grasped_positions(mesh: cs.TetMesh, times_s: NDArray[np.floating]) -> Array:
    """Return the positions (k, g, 3) [m] of the grasped nodes at times (k,) [s]."""
    poses = hand_poses(times_s)
    places_m = mesh.points_m[grasped_nodes(mesh)]
    rotated_m = np.einsum("tij,kj->tki", poses[:, :3, :3], places_m)
    return rotated_m + poses[:, None, :3, 3]


def recording(mesh: cs.TetMesh, positions_m: Array) -> cs.Experiment:
    """Return the experiment of noisy markers on node positions (T, n, 3) [m].

    All free nodes have the same mass: the body has the largest density at which no node is heavier
    than NODE_MASS_KG, and point masses add what is missing.
    """
    t_s = SAMPLE_S * np.arange(SAMPLE_COUNT)
    grasped = grasped_nodes(mesh)
    free_nodes = np.setdiff1d(np.arange(len(mesh.points_m)), grasped)
    volumes_m3 = cs.Body(mesh, density_kg_m3=1.0).node_mass
    density = 0.999 * (NODE_MASS_KG / volumes_m3[free_nodes]).min()
    body = cs.Body(mesh, "st-venant-kirchhoff", density_kg_m3=density, damping="material")
    point_masses = [cs.PointMass([n], float(NODE_MASS_KG - body.node_mass[n])) for n in free_nodes]
    marked = list(MARKED_NODES)
    tracks_m = positions_m[:, marked]
    noise = np.random.default_rng(SEED).normal(size=tracks_m.shape)
    markers = cs.Markers(
        t_s, tracks_m + NOISE_M * noise, sigma_m=NOISE_M, places_m=mesh.points_m[marked]
    )
    return cs.Experiment(
        body,
        t_s,
        [cs.Grasp(grasped, hand_poses(t_s))],
        markers,
        name="swung-cylinder",
        masses=point_masses,
        nuisance=cs.Nuisance.none(),
        air_density_kg_m3="none",
    )
