"""The quadratic tetrahedron: exactness and convergence."""

from __future__ import annotations

import json
from functools import cache

import meshio
import numpy as np
import pytest
import scipy.sparse as sp
from kit.checks import assert_derivative, observed_order
from kit.materials import COMPILED, LAME, elastic, theta_for
from kit.problem_files import AT_TRUTH, TRUTH, run_command, settings
from kit.problems import uneven_box
from scipy.sparse.linalg import eigsh, spsolve
from scipy.spatial.transform import Rotation

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.elements import element_named
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.problem import Problem
from collocation_sysid.recording import place_markers
from collocation_sysid.result.run_writers import write_frames
from collocation_sysid.result.synthesis import Recipe, write_data

TET10 = element_named("tet10")


@cache
def small_body(
    material: str = "neo-hookean", evaluator: str = "auto", element: str = "tet10"
) -> Body:
    """Six elements, no two alike."""
    return Body(uneven_box(1), material, 30.0, element, damping="rayleigh", evaluator=evaluator)


@pytest.fixture
def patch(small_mesh) -> Body:
    """A distorted mesh with a node, and many edges, inside."""
    return Body(small_mesh, "linear", density_kg_m3=30.0, element="tet10")


def deformed(body: Body, rng: np.random.Generator, states: int = 2) -> np.ndarray:
    return body.nodes_m + rng.uniform(-0.003, 0.003, (states, *body.nodes_m.shape))


def inner_nodes(body: Body) -> np.ndarray:
    """Corners off the surface, and mid nodes of edges that are no side of a surface triangle."""
    mesh = body.mesh
    pairs = np.sort(mesh.surface[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    sides = {tuple(pair) for pair in pairs.tolist()}
    corners = np.setdiff1d(np.arange(len(mesh.points_m)), mesh.surface)
    mids = [k for k, edge in enumerate(mesh.edges.tolist()) if tuple(edge) not in sides]
    return np.concatenate([corners, len(mesh.points_m) + np.array(mids)])


# The element ----------------------------------------------------------------------------------


def over_the_volume(function) -> np.ndarray:
    """Mean of a function of barycentric points, by Gauss's rule on a collapsed cube."""
    x, weight = np.polynomial.legendre.leggauss(6)
    r, s, t = (axis.ravel() for axis in np.meshgrid(*[(x + 1) / 2] * 3, indexing="ij"))
    w = 6 / 8 * np.einsum("i,j,k->ijk", weight, weight, weight).ravel() * (1 - r) ** 2 * (1 - s)
    points = np.column_stack([r, (1 - r) * s, (1 - r) * (1 - s) * t])
    barycentric = np.column_stack([1 - points.sum(axis=1), points])
    return np.tensordot(w, function(barycentric), axes=1)


def test_each_shape_function_is_one_at_its_own_node_alone():
    corners = np.eye(4)
    middles = [(corners[a] + corners[b]) / 2 for a, b in TET10.edges]
    values = TET10.shape_functions(np.vstack([corners, *middles]))
    np.testing.assert_allclose(values, np.eye(10), atol=1e-15)


def test_shape_gradients_are_the_slopes(rng):
    points = rng.dirichlet(np.ones(4), 5)
    assert_derivative(
        TET10.shape_functions,
        lambda d: np.einsum("kal,kl->ka", TET10.shape_gradients(points), d),
        points,
        rng,
    )


def test_quadrature_is_exact_for_every_quadratic():
    def products(L):
        return np.einsum("ki,kj->kij", L, L)

    found = np.tensordot(TET10.weights, products(TET10.points), axes=1)
    np.testing.assert_allclose(found, over_the_volume(products), atol=1e-15)
    np.testing.assert_allclose(found, (1 + np.eye(4)) / 20, atol=1e-15)


def test_mass_shares_are_the_scaled_diagonal_of_the_consistent_mass():
    diagonal = over_the_volume(lambda L: TET10.shape_functions(L) ** 2)
    np.testing.assert_allclose(diagonal, np.repeat([1 / 70, 8 / 105], [4, 6]), rtol=1e-12)
    np.testing.assert_allclose(TET10.mass_shares, diagonal / diagonal.sum(), rtol=1e-12)


# The body -------------------------------------------------------------------------------------


def test_corners_keep_their_numbers_and_each_edge_has_a_node_halfway():
    body = small_body()
    mesh, n = body.mesh, len(body.mesh.points_m)
    np.testing.assert_array_equal(body.nodes_m[:n], mesh.points_m)
    np.testing.assert_array_equal(body.nodes_m[n:], mesh.points_m[mesh.edges].mean(axis=1))
    np.testing.assert_array_equal(body.cells[:, :4], mesh.tetrahedra)
    middles = body.nodes_m[body.cells[:, TET10.edges]].mean(axis=2)
    np.testing.assert_allclose(body.nodes_m[body.cells[:, 4:]], middles, atol=1e-16)


def test_mass_is_kept_and_positive_everywhere(patch):
    assert patch.mass_kg == pytest.approx(30.0 * patch.mesh.volume_m3, rel=1e-13)
    assert patch.node_mass.min() > 0
    n = len(patch.mesh.points_m)
    assert patch.node_mass[:n].sum() == pytest.approx(patch.mass_kg / 9, rel=1e-13)
    center = patch.node_mass @ patch.nodes_m / patch.mass_kg
    middles = patch.mesh.points_m[patch.mesh.tetrahedra].mean(axis=1)
    np.testing.assert_allclose(center, patch.mesh.volumes_m3 @ middles / patch.mesh.volume_m3)


@pytest.mark.parametrize("material", ["neo-hookean", "linear"])
def test_evaluators_agree(material, rng):
    simd, casadi = (small_body(material, name) for name in ("simd", "casadi"))
    x, (v, w) = (deformed(simd, rng), rng.standard_normal((2, 2, 3 * len(simd.nodes_m))))
    theta, constants = theta_for(simd), elastic(simd)
    energy = casadi.energy(x[0], **constants)
    assert simd.energy(x[0], **constants) == pytest.approx(energy, rel=1e-12)
    for method, fields in (("linearise", (x, v)), ("second_derivatives", (x, v, w))):
        found, expected = (getattr(body, method)(*fields, theta) for body in (simd, casadi))
        for name, values in vars(expected).items():
            difference = abs(getattr(found, name) - values).max(initial=0)
            assert difference <= 1e-12 * abs(values).max(initial=0), name


@pytest.mark.parametrize("element", ["tet10", "tet10-p0"])
@pytest.mark.parametrize("material", [name for name in COMPILED if name != "linear"])
def test_rigid_motion_causes_no_force(material, element, rng):
    body = small_body(material, element=element)
    turn = Rotation.from_rotvec([0.5, -2.0, 1.0]).as_matrix()
    moved = body.nodes_m @ turn.T + [0.3, 0.2, -0.1]
    constants = elastic(body)
    scale = abs(body.elastic_force(deformed(body, rng)[0], **constants)).max()
    assert abs(body.elastic_force(moved, **constants)).max() < 1e-12 * scale


def test_only_rigid_motion_is_without_energy_even_for_a_single_element():
    one = TetMesh([[0, 0, 0], [0.1, 0, 0], [0.02, 0.1, 0], [0.01, 0.03, 0.1]], [[0, 1, 2, 3]])
    body = Body(one, density_kg_m3=30.0, element="tet10")
    spectrum = np.linalg.eigvalsh(body.stiffness(body.nodes_m, **elastic(body)).toarray())
    assert abs(spectrum[:6]).max() < 1e-13 * spectrum[-1]
    assert spectrum[6] > 1e-3 * spectrum[-1]


# What it reproduces ---------------------------------------------------------------------------


@pytest.mark.parametrize("material", COMPILED)
def test_a_uniform_strain_leaves_inner_nodes_in_equilibrium(small_mesh, material, rng):
    body = Body(small_mesh, material, density_kg_m3=30.0, element="tet10")
    F = np.eye(3) + rng.uniform(-0.15, 0.15, (3, 3))
    x = body.nodes_m @ F.T
    force = body.elastic_force(x, **elastic(body))
    assert len(inner_nodes(body)) > 20
    assert abs(force[inner_nodes(body)]).max() < 1e-13 * abs(force).max()
    np.testing.assert_allclose(body.volume_ratios(x), np.linalg.det(F), rtol=1e-12)
    # The energy is that of the same strain in linear elements, whatever their number of nodes.
    linear = Body(small_mesh, material, density_kg_m3=30.0)
    expected = linear.energy(x[: len(small_mesh.points_m)], **elastic(linear))
    assert body.energy(x, **elastic(body)) == pytest.approx(expected, rel=1e-12)


def test_a_quadratic_displacement_is_reproduced(patch, rng):
    """u_i = ½ Q_ijk X_j X_k needs the body force −div σ = −(λ + μ) Q_jji − μ Q_ijj."""
    lambda_pa, mu_pa = LAME
    Q = rng.standard_normal((3, 3, 3))
    Q = Q + np.swapaxes(Q, 1, 2)
    X = patch.nodes_m
    force = patch.elastic_force(X + np.einsum("ijk,nj,nk->ni", Q, X, X) / 2, **elastic(patch))
    divergence = (lambda_pa + mu_pa) * np.einsum("jji->i", Q) + mu_pa * np.einsum("ijj->i", Q)
    mean_shape = over_the_volume(TET10.shape_functions)  # −1/20 at corners, 1/5 at mid nodes
    shares = np.zeros(len(X))
    np.add.at(shares, patch.cells, np.outer(patch.mesh.volumes_m3, mean_shape))
    inner = inner_nodes(patch)
    expected = shares[inner, None] * divergence
    assert abs(force[inner] - expected).max() < 1e-12 * abs(force).max()


def test_markers_inside_follow_a_quadratic_motion(rng):
    body = small_body()
    points = rng.dirichlet(np.ones(4), 8)
    corners = body.mesh.points_m[body.mesh.tetrahedra[rng.integers(len(body.cells), size=8)]]
    points_m = np.einsum("ma,mai->mi", points, corners)
    placement = place_markers(points_m, body.nodes_m, body, attach="embedded")

    def moved(x: np.ndarray) -> np.ndarray:
        return x + 0.3 * x[:, [1, 2, 0]] + 2.0 * x[:, [1, 1, 0]] * x[:, [2, 0, 0]]

    found = np.einsum("ma,mai->mi", placement.weights, moved(body.nodes_m)[placement.nodes])
    np.testing.assert_allclose(found, moved(points_m), atol=1e-13)


# What it is better at -------------------------------------------------------------------------

YOUNG_PA, DENSITY_KG_M3, THICKNESS_M, GRAVITY_M_S2 = 1e5, 1000.0, 0.02, 9.81


def clamped_beam(element: str, divisions, length_m: float, poisson: float = 0.3):
    """Body, stiffness and masses of the free degrees of freedom of a beam clamped at x = 0."""
    mesh = box_mesh((length_m, THICKNESS_M, THICKNESS_M), divisions)
    body = Body(mesh, "linear", density_kg_m3=DENSITY_KG_M3, element=element)
    K = body.stiffness(body.nodes_m, young_pa=YOUNG_PA, poisson=poisson)
    free = np.flatnonzero(np.repeat(body.nodes_m[:, 0] > 1e-9, 3))
    return body, K[free][:, free].tocsc(), free


def sag_m(element: str, divisions, length_m: float, poisson: float) -> float:
    """How far the tip sinks under gravity."""
    body, K, free = clamped_beam(element, divisions, length_m, poisson)
    load, u = np.zeros((2, 3 * len(body.nodes_m)))
    load[2::3] = -GRAVITY_M_S2 * body.node_mass
    u[free] = np.asarray(spsolve(K, load[free]))
    return -u[2::3][body.nodes_m[:, 0] > length_m - 1e-9].mean()


@pytest.mark.parametrize(
    ("poisson", "divisions", "tolerance"), [(0.3, (10, 1, 1), 0.04), (0.49, (20, 2, 2), 0.07)]
)
def test_a_slender_beam_sags_as_beam_theory_predicts(poisson, divisions, tolerance):
    length = 0.2
    weight_n_m = DENSITY_KG_M3 * GRAVITY_M_S2 * THICKNESS_M**2
    bending = weight_n_m * length**4 / (8 * YOUNG_PA * THICKNESS_M**4 / 12)
    shear_modulus = YOUNG_PA / (2 * (1 + poisson))
    timoshenko = bending + weight_n_m * length**2 / (2 * 5 / 6 * shear_modulus * THICKNESS_M**2)
    assert sag_m("tet10", divisions, length, poisson) == pytest.approx(timoshenko, rel=tolerance)
    assert sag_m("tet4", divisions, length, poisson) < 0.3 * timoshenko
    assert sag_m("tet4", np.multiply(divisions, 2), length, poisson) < 0.6 * timoshenko


def first_frequency_hz(element: str, divisions) -> float:
    body, K, free = clamped_beam(element, divisions, 0.1)
    masses = sp.diags_array(body.dof_mass[free]).tocsc()
    (square,), _ = eigsh(K, k=1, M=masses, sigma=0.0)
    return np.sqrt(square) / (2 * np.pi)


# Tet10 with (10 m, 2 m, 2 m) divisions, m = 1 to 2, extrapolated from there.
EXACT_HZ = 3.1626


def test_the_first_natural_frequency_converges_from_above_and_fast():
    coarse, middle = (first_frequency_hz("tet10", (5 * m, m, m)) for m in (1, 2))
    linear = np.array([first_frequency_hz("tet4", (5 * m, m, m)) for m in (1, 2, 4)])
    errors = np.array([coarse, middle]) - EXACT_HZ
    assert errors[0] > errors[1] > 0
    assert (
        observed_order([1.0, 0.5], errors) > 2.0 > observed_order([1, 0.5, 0.25], linear - EXACT_HZ)
    )
    assert errors[0] < 0.25 * (linear[-1] - EXACT_HZ)  # of 99 nodes against 525


# Files ----------------------------------------------------------------------------------------


def test_frames_are_quadratic_and_read_back(tmp_path, rng):
    body = small_body()
    positions = deformed(body, rng, 3)
    write_frames(tmp_path, [0.0, 0.1, 0.2], positions, body.cells, body.element, body.nodes_m)
    frame = tmp_path / "frames" / "frame_0002.vtu"
    read = meshio.read(frame)
    np.testing.assert_array_equal(read.cells_dict["tetra10"], body.cells)
    np.testing.assert_array_equal(read.points, positions[2])
    undeformed = read.points - read.point_data["displacement_m"]
    np.testing.assert_allclose(undeformed, body.nodes_m, atol=1e-15)


def test_a_problem_with_quadratic_elements_is_fitted(tiny):
    elements = ["object.element=tet10"]
    problem = Problem.read(
        tiny / "problem.toml", [*AT_TRUTH, *elements, "transcription.substeps=1"], simulation=True
    )
    held = problem.experiments[0].grasps[0].nodes
    np.testing.assert_array_equal(held, np.flatnonzero(problem.bodies[0].nodes_m[:, 2] > 0.0899))
    assert len(held) == 25
    (tiny / "swing_markers.csv").unlink()  # of linear elements
    write_data(problem, tiny, Recipe("midpoint"))
    outcome = run_command(
        "solve", "problem.toml", "--out", "run", *settings(*elements), "--method", "reduced-space"
    )
    assert outcome.code == 0, outcome.err
    result = json.loads((tiny / "run" / "result.json").read_text())
    for name, value in TRUTH.items():
        assert result["parameters"][name]["optimum"] == pytest.approx(value, rel=1e-5)
    assert result["problem"]["nodes"] == len(problem.bodies[0].nodes_m)
    frame = meshio.read(next((tiny / "run").rglob("frame_0000.vtu")))
    np.testing.assert_array_equal(frame.cells_dict["tetra10"], problem.bodies[0].cells)


def test_a_written_body_is_the_same_body_when_read(tmp_path):
    body = small_body()
    meshio.write(tmp_path / "a.vtu", meshio.Mesh(body.nodes_m, [("tetra10", body.cells)]))
    mesh = TetMesh.read(tmp_path / "a.vtu")
    assert mesh.sha256 == body.mesh.sha256
    again = Body(mesh, density_kg_m3=30.0, element="tet10")
    np.testing.assert_array_equal(again.nodes_m, body.nodes_m)
    np.testing.assert_array_equal(again.cells, body.cells)
