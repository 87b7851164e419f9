"""Block that falls on a plane, whose surface is measured with a noise of 1 mm."""

from __future__ import annotations

from itertools import product

import numpy as np

import collocation_sysid as cs

SIDE_M, DROP_M, DURATION_S, SIGMA_M = 0.1, 0.15, 0.4, 1e-3
TRUTH = {"young_pa": 2e5, "poisson": 0.3, "gamma_r_s": 0.004, "gamma_m_1_s": 0.1}
FREE = ("young_pa", "poisson", "gamma_r_s")
# Steps per second of the simulated twins.
TWIN_HZ = 3840
# Corners, middles of edges and of faces, in half edges.
PLACES = np.array([place for place in product(range(3), repeat=3) if place != (1, 1, 1)])


def falling_block(
    cells: int,
    t_s: np.ndarray,
    element: str = "tet10",
    side_m: float = SIDE_M,
    drop_m: float = DROP_M,
) -> cs.Experiment:
    """Return the experiment with empty tracks, with so many cells along an edge."""
    mesh = cs.box_mesh((side_m,) * 3, (cells,) * 3)
    body = cs.Body(mesh, density_kg_m3=1000.0, element=element, made="cast", mesh_from="cad")
    floor = cs.Obstacle(shape=cs.Plane((0, 0, 1), (0, 0, -drop_m)), friction=0.3, name="floor")
    unseen_m = np.zeros((len(t_s), len(PLACES), 3))
    return cs.Experiment(
        body,
        t_s,
        [floor],
        cs.Markers(t_s, unseen_m, SIGMA_M, places_m=side_m / 2 * PLACES),
        start="undeformed",
        air_density_kg_m3="none",
        nuisance=cs.Nuisance.none(),
    )


def noise_of(seed: int, shape: tuple[int, ...]) -> np.ndarray:
    return SIGMA_M * np.random.default_rng(seed).normal(size=shape)
