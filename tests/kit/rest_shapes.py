"""A soft bar whose mesh was made while it hung under its own weight, and recordings of it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.selection import Indices
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.fem.rest_shape import UnderGravity
from collocation_sysid.problem.problem import Problem
from collocation_sysid.program.forward.initial_equilibrium import equilibrium
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Grasp, Markers, Nuisance, PoseSequence

SIZE_M = (0.12, 0.03, 0.03)
TRUTH = {"young_pa": 3e5, "poisson": 0.3, "gamma_r_s": 0.01, "gamma_m_1_s": 0.5}
DENSITY_KG_M3 = 1000.0
# The bar was clamped at x = 0 and horizontal when it was scanned.
SCAN_GRAVITY_M_S2 = (0.0, 0.0, -9.81)
NOISE_M = 1e-4
RestShape = UnderGravity | Literal["stress_free"] | None


def clamped_nodes(mesh: TetMesh) -> np.ndarray:
    """Nodes at the clamped end, which is at x = 0 in the scan too."""
    return np.flatnonzero(mesh.points_m[:, 0] < mesh.points_m[:, 0].min() + 1e-3)


def as_scanned(mesh: TetMesh) -> UnderGravity:
    """How the bar was held during the scan."""
    return UnderGravity(Indices(clamped_nodes(mesh).tolist()), SCAN_GRAVITY_M_S2)


def straight_bar(element: str = "tet4", divisions: tuple[int, int, int] = (6, 2, 2)) -> Body:
    """The bar free of stress."""
    return Body(box_mesh(SIZE_M, divisions), density_kg_m3=DENSITY_KG_M3, element=element)


def recorded(
    body: Body,
    turn_rad: float = 0.0,
    static: bool = False,
    steps: int = 25,
    gravity_m_s2: tuple[float, float, float] = SCAN_GRAVITY_M_S2,
) -> Experiment:
    """The bar clamped at x = 0, turned about y by an angle and swayed, seen by nine markers."""
    t_s = 0.02 * np.arange(steps + 1)
    share = 1 - np.cos(8.0 * t_s)
    angle = turn_rad + 0.3 * share
    turns = np.zeros((len(t_s), 4))
    turns[:, 1], turns[:, 3] = np.sin(angle / 2), np.cos(angle / 2)
    poses = PoseSequence(t_s, np.outer(share, (0.02, 0.01, -0.015)), turns)
    mesh = body.mesh
    # The same nodes whatever the shape of the mesh.
    seen = np.arange(len(mesh.points_m))[-9:]
    nowhere = np.zeros((len(t_s), len(seen), 3))
    names = [f"m{k}" for k in range(len(seen))]
    markers = Markers(t_s, nowhere, NOISE_M, names, mesh.points_m[seen]).on_body(body)
    grasp = Grasp(Indices(clamped_nodes(mesh).tolist()), poses)
    return Experiment(
        body,
        t_s,
        [grasp],
        name="bar",
        markers=markers,
        gravity_m_s2=gravity_m_s2,
        nuisance=Nuisance.none(),
        kind="static" if static else "dynamic",
    )


@cache
def hung_mesh(young_pa: float = TRUTH["young_pa"], element: str = "tet4") -> TetMesh:
    """The mesh that a scan of the hanging bar gives: the deformed one."""
    body = straight_bar(element)
    theta = body.theta_from_values(TRUTH | {"young_pa": young_pa})
    shape = equilibrium(recorded(body), theta).reshape(-1, 3)
    return TetMesh(shape[: len(body.mesh.points_m)], body.mesh.tetrahedra)


def measured(
    rest_shape: RestShape,
    turn_rad: float = np.pi / 2,
    static: bool = False,
    seed: int | None = 0,
    steps: int = 25,
    mesh_from: str | None = None,
) -> Experiment:
    """A recording of the bar, straight when free of stress, described by the mesh of the scan."""
    truth = recorded(straight_bar(), turn_rad, static, steps)
    tracks = simulate(truth, TRUTH, "midpoint").markers_m
    if seed is not None:
        tracks = tracks + NOISE_M * np.random.default_rng(seed).normal(size=tracks.shape)
    mesh = hung_mesh()
    # Mass is that of the bar, whatever the volume of the mesh.
    mass_kg = straight_bar().mass_kg
    body = Body(mesh, mass_kg=mass_kg, rest_shape=rest_shape, mesh_from=mesh_from)
    return with_markers(recorded(body, turn_rad, static, steps), tracks)


def problem_of(experiment: Experiment, **changes) -> Problem:
    """Identify E, and of a motion γ_r."""
    from collocation_sysid.model.parameters import Unknown

    static = experiment.is_static
    parameters = {
        "young_pa": Unknown(4e5),
        "poisson": TRUTH["poisson"],
        "gamma_r_s": TRUTH["gamma_r_s"] if static else Unknown(0.02),
        "gamma_m_1_s": TRUTH["gamma_m_1_s"],
    }
    return Problem([replace(experiment)], parameters, **changes)
