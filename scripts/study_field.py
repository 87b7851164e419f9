"""What of a stiffness that differs from place to place is found: twins whose stiffness is known.

A block hangs from a swung hand; markers are glued to its surface. Its stiff half, or a stiff ball
inside, is in no description: one field of Young's modulus over the whole body is estimated, and
counted is in how many elements the 95 % interval holds the truth: of all, and of those that the
data tell, where the interval is less than half as wide as the prior's. The tracks are made with the
scheme that fits them, each with noise of its own, on a mesh whose elements meet where the materials
do.

    nice -n 15 python scripts/study_field.py --twins 10
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from synthetic import swing

import collocation_sysid as cs
from collocation_sysid.fem.body import Body

SIZE_M, EDGE_M, STEP_S, SIGMA_M = (0.04, 0.04, 0.12), 0.0133, 1 / 60, 1e-4
YOUNG_PA = 3e4
BESIDE = {"poisson": 0.45, "gamma_r_s": 5e-3, "gamma_m_1_s": 0.1}
BALL_M, RADIUS_M = np.array([0.026, 0.02, 0.06]), 0.015


@dataclass(frozen=True)
class Twin:
    """What is hidden, and how it is sought."""

    name: str
    kind: str
    ratio: float
    length_m: float | tuple[float, ...] = 0.04
    modes: int = 40
    amplitude: float = 0.5
    markers: int = 48
    steps: int = 40


def stiff_cells(kind: str, mesh: cs.TetMesh) -> NDArray[np.bool_]:
    """Which cells are stiffer."""
    centres = mesh.points_m[mesh.tetrahedra].mean(axis=1)
    if kind == "half":
        return centres[:, 2] < SIZE_M[2] / 2
    if kind == "ball":
        return np.linalg.norm(centres - BALL_M, axis=1) < RADIUS_M
    return np.zeros(len(centres), dtype=bool)


def hung(body: Body, count: int, steps: int) -> cs.Experiment:
    """The block in the hand, with markers on its surface that nobody has seen yet."""
    t_s = STEP_S * np.arange(steps)
    poses = swing(
        t_s, (0.02, 0.02, 0.01), (0.3, 0.3, 0.5), (1.7, 2.3, 1.3), 0.2, Rotation.identity()
    )
    x, high = body.nodes_m, np.array(SIZE_M)
    surface = np.flatnonzero(
        ((x < 1e-9) | (x > high - 1e-9)).any(axis=1) & (x[:, 2] < high[2] - 0.01)
    )
    chosen = np.random.default_rng(0).permutation(surface)[:count]
    names = [f"m{k}" for k in range(len(chosen))]
    nowhere = np.zeros((steps, len(chosen), 3))
    markers = cs.Markers(t_s, nowhere, SIGMA_M, names, x[chosen]).on(body)
    grasp = cs.Grasp(np.flatnonzero(x[:, 2] > high[2] - 1e-9), poses)
    return cs.Experiment(body, t_s, [grasp], markers, nuisance=cs.Nuisance.none())


def problem_of(twin: Twin, seed: int) -> tuple[cs.Problem, NDArray[np.float64]]:
    """Its problem, and the truth: the logarithm of E in every cell."""
    mesh = cs.box_mesh(SIZE_M, tuple(round(size / EDGE_M) for size in SIZE_M))
    stiff = stiff_cells(twin.kind, mesh)
    regions = [cs.Region("stiff", stiff)] if stiff.any() else []
    true = Body(mesh, density_kg_m3=1000.0, regions=regions)
    values = {"young_pa": YOUNG_PA, "stiff.young_pa": twin.ratio * YOUNG_PA, **BESIDE}
    known = {n: v for n, v in values.items() if regions or not n.startswith("stiff")}
    made = cs.simulate(hung(true, twin.markers, twin.steps), known, "midpoint")
    field = cs.Field(twin.length_m, modes=twin.modes, amplitude=twin.amplitude)
    sought = hung(Body(mesh, density_kg_m3=1000.0, field=field), twin.markers, twin.steps)
    noise = np.random.default_rng(seed).normal(size=made.markers_m.shape)
    experiment = cs.with_markers(sought, made.markers_m + SIGMA_M * noise)
    guesses = {n: cs.Unknown(0.7 * values[n]) for n in ("young_pa", "gamma_r_s")}
    problem = cs.Problem([experiment], {**BESIDE, **guesses}, substeps=1)
    return problem, np.log(YOUNG_PA * np.where(stiff, twin.ratio, 1.0))
