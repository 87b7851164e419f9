"""Static equilibrium of slender, nearly incompressible bodies with large rotations."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from collocation_sysid import (
    Body,
    Experiment,
    Grasp,
    Markers,
    PoseSequence,
    SimulationError,
    TetMesh,
    box_mesh,
)
from collocation_sysid.program.forward.initial_equilibrium import equilibrium
from collocation_sysid.program.forward.newton_solver import NewtonOptions, NewtonSolver
from collocation_sysid.program.forward.retraction import Retraction

SIZE_M = (0.18, 0.02, 0.02)
CELLS = (18, 1, 3)
MU_PA = 30.7e3


def notched_bar(element: str) -> Experiment:
    """A bar with deep notches, clamped horizontally at one end, that sags by most of its length."""
    mesh = box_mesh(SIZE_M, CELLS)
    centres = mesh.points_m[mesh.tetrahedra].mean(axis=1) - mesh.points_m.min(axis=0)
    column = (centres[:, 0] * CELLS[0] / SIZE_M[0]).astype(int)
    notched = (column % 2 == 1) & (centres[:, 2] > SIZE_M[2] / 3)
    body = Body(
        TetMesh(mesh.points_m, mesh.tetrahedra[~notched]), density_kg_m3=1080.0, element=element
    )
    clamped = np.flatnonzero(body.nodes_m[:, 0] < body.nodes_m[:, 0].min() + 1e-9)
    t_s = np.array([0.0, 0.1, 0.2])
    tip = Markers(t_s, np.zeros((3, 1, 3)), sigma_m=1e-3, places_m=[body.nodes_m[-1]])
    return Experiment(body, t_s, [Grasp(clamped, PoseSequence.fixed())], tip)


def theta_of(body: Body, poisson: float) -> NDArray[np.float64]:
    lame = 2 * MU_PA * poisson / (1 - 2 * poisson)
    values = {"mu_pa": MU_PA, "lambda_pa": lame, "gamma_r_s": 1e-3, "gamma_m_1_s": 0.1}
    return body.theta_from_values(values)


@pytest.mark.parametrize(
    ("element", "poisson", "most"),
    [("tet4", 0.45, 12), ("tet4", 0.49, 12), ("tet10-p0", 0.49, 13), ("tet10-p0", 0.4999, 13)],
)
def test_a_notched_bar_finds_its_equilibrium_in_few_factorisations(
    element, poisson, most, monkeypatch
):
    bar = notched_bar(element)
    factorised = []
    factorise = NewtonSolver.factorise

    def counting(self, *matrix, **options):
        factorised.append(self)
        return factorise(self, *matrix, **options)

    monkeypatch.setattr(NewtonSolver, "factorise", counting)
    x = equilibrium(bar, theta_of(bar.body, poisson)).reshape(-1, 3)
    sag_m = -(x - bar.body.nodes_m)[:, 2].min()
    assert sag_m > 0.5 * SIZE_M[0]
    assert len(factorised) <= most


def test_a_limit_on_the_iterations_ends_the_search_with_an_explanation():
    bar = notched_bar("tet4")
    solver = NewtonSolver(bar, NewtonOptions(max_iterations=2, max_halvings=1))
    with pytest.raises(
        SimulationError,
        match="the search for the initial equilibrium failed: Newton's method took more",
    ):
        equilibrium(bar, theta_of(bar.body, 0.45), solver=solver)


@pytest.mark.parametrize("element", ["tet4", "tet10-p0"])
def test_a_rotation_of_the_whole_body_is_applied_without_strain(element):
    body = notched_bar(element).body
    x = body.nodes_m
    spin = np.array([[0.0, 0.0, 0.8], [0.0, 0.0, 0.0], [-0.8, 0.0, 0.0]])
    free = np.zeros(x.shape, dtype=bool)
    free[0] = True  # one node stays where the increment has it
    turned = Retraction(body, free)(x.ravel(), ((x - x[0]) @ spin.T).ravel()).reshape(-1, 3)
    lengths = np.linalg.norm(turned - turned[0], axis=1)
    np.testing.assert_allclose(lengths, np.linalg.norm(x - x[0], axis=1), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(body.volume_ratios(turned.ravel()), 1.0, rtol=1e-6)


def test_a_strain_without_trace_keeps_the_volume():
    body = notched_bar("tet10-p0").body
    x = body.nodes_m
    free = np.zeros(x.shape, dtype=bool)
    stretched = Retraction(body, free)(x.ravel(), (x * [0.3, -0.2, -0.1]).ravel())
    np.testing.assert_allclose(body.volume_ratios(stretched), 1.0, rtol=1e-6)


@pytest.mark.parametrize("size", [0.05, 0.5, 3.0])
def test_a_homogeneous_strain_is_applied_as_its_exponential(size):
    body = notched_bar("tet4").body
    x = body.nodes_m - body.nodes_m[0]
    strain = size * np.array([[0.6, 0.2, -0.3], [0.2, -0.5, 0.1], [-0.3, 0.1, 0.4]])
    prescribed = np.zeros(x.shape, dtype=bool)
    prescribed[0] = True
    increment = (x @ strain).ravel()
    moved = Retraction(body, prescribed)(body.nodes_m.ravel(), increment).reshape(-1, 3)
    np.testing.assert_allclose(moved - moved[0], x @ expm(strain), rtol=1e-6, atol=1e-9)


def test_small_increments_are_added():
    body = notched_bar("tet4").body
    rng = np.random.default_rng(0)
    prescribed = np.zeros(body.nodes_m.shape, dtype=bool)
    prescribed[:4] = True
    direction = rng.standard_normal(body.nodes_m.size)
    retraction = Retraction(body, prescribed)
    errors_m = []
    for size_m in (1e-5, 1e-6):
        increment = size_m * direction
        moved = retraction(body.nodes_m.ravel(), increment)
        errors_m.append(np.abs(moved - body.nodes_m.ravel() - increment).max())
    assert errors_m[1] < 0.02 * errors_m[0]  # of second order
    np.testing.assert_array_equal(
        moved.reshape(-1, 3)[:4], (body.nodes_m.ravel() + increment).reshape(-1, 3)[:4]
    )
