"""Forces, stiffness and derivatives of bodies, and the validation of their input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from kit.checks import directional_derivative, relative_error
from kit.materials import COMPILED, elastic, theta_for
from scipy.spatial.transform import Rotation

from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.elements import ELEMENTS
from collocation_sysid.fem.meshes.mesh import TetMesh

ROTATION_INVARIANT = [name for name in COMPILED if name != "linear"]
EVALUATORS = ["simd", "casadi"]
LENGTH_M = 0.03  # a large change of a position


@pytest.fixture(params=COMPILED)
def body(request, make_body) -> Body:
    """One body of each material."""
    return make_body(request.param)


def deformed(body: Body, rng: np.random.Generator, states: int = 2) -> np.ndarray:
    """Node positions some way from rest, (T, n, 3)."""
    shape = (states, *body.nodes_m.shape)
    return body.nodes_m + rng.uniform(-0.004, 0.004, shape)


def velocities(body: Body, rng: np.random.Generator, states: int = 2) -> np.ndarray:
    return rng.standard_normal((states, 3 * len(body.nodes_m)))


# Energy, force, stiffness ---------------------------------------------------------------------


def test_stiffness_is_symmetric_on_the_mesh_graph_and_resists_every_strain_at_rest(body):
    K = body.stiffness(body.nodes_m, **elastic(body))
    assert sp.issparse(K)
    assert abs(K - K.T).max() == 0.0
    assert K.nnz == 9 * (len(body.nodes_m) + 2 * len(body.mesh.edges))
    spectrum = np.linalg.eigvalsh(K.toarray())
    assert abs(spectrum[:6]).max() < 1e-12 * spectrum[-1]  # three translations, three rotations
    assert spectrum[6] > 1e-4 * spectrum[-1]


def test_translation_changes_nothing(body, rng):
    x = deformed(body, rng)[0]
    moved = x + np.array([3.0, -2.0, 1.0])
    constants = elastic(body)
    energy, found = (body.energy(moved, **constants), body.elastic_force(moved, **constants))
    assert energy == pytest.approx(body.energy(x, **constants), rel=1e-12)
    assert relative_error(found, body.elastic_force(x, **constants)) < 1e-11


@pytest.mark.parametrize("material", ROTATION_INVARIANT)
def test_rigid_motion_causes_no_force(make_body, material, rng):
    body = make_body(material)
    turn = Rotation.from_rotvec([0.5, -2.0, 1.0]).as_matrix()
    moved = body.nodes_m @ turn.T + [0.3, 0.2, -0.1]
    scale = abs(body.elastic_force(deformed(body, rng)[0], **elastic(body))).max()
    assert abs(body.elastic_force(moved, **elastic(body))).max() < 1e-12 * scale


def test_elastic_forces_balance(body, rng):
    force = body.elastic_force(deformed(body, rng)[0], **elastic(body))
    assert abs(force.sum(axis=0)).max() < 1e-13 * abs(force).sum()


@pytest.mark.parametrize("material", ROTATION_INVARIANT)
def test_elastic_forces_exert_no_torque(make_body, material, rng):
    body = make_body(material)
    x = deformed(body, rng)[0]
    torques = np.cross(x, body.elastic_force(x, **elastic(body)))
    assert abs(torques.sum(axis=0)).max() < 1e-13 * abs(torques).sum()


# Damping --------------------------------------------------------------------------------------


@pytest.mark.parametrize("amplitude_m", [0.0, 0.002])
def test_damping_takes_energy_out_near_rest(body, amplitude_m, rng):
    theta = theta_for(body)
    x = np.repeat(body.nodes_m[None], 20, axis=0)
    x = x + rng.uniform(-amplitude_m, amplitude_m, x.shape)
    v = velocities(body, rng, len(x))
    damping = body.force(x, v, theta) - body.force(x, np.zeros_like(v), theta)
    assert (np.einsum("ti,ti->t", damping, v) < 0).all()


def test_rigid_rotation_is_not_slowed_by_stiffness_damping(body, rng):
    spin = np.cross([1.0, 2.0, 3.0], body.nodes_m)
    theta = theta_for(body, 0.1, 0.0)
    force = body.force(body.nodes_m, spin, theta)
    scale = abs(body.force(body.nodes_m, velocities(body, rng, 1), theta)).max()
    assert abs(force).max() < 1e-12 * scale


def test_translation_is_slowed_by_mass_damping_alone(body):
    v = np.tile([1.0, 2.0, 3.0], len(body.nodes_m))
    force = body.force(body.nodes_m, v, theta_for(body, 0.1, 2.0))[0]
    np.testing.assert_allclose(force, -2.0 * np.repeat(body.node_mass, 3) * v, atol=1e-14)


# Derivatives; `check_material` and `check_damping` compare them with the plain formula --------


def test_linearise_returns_the_force(body, rng):
    theta = theta_for(body)
    x, v = deformed(body, rng), velocities(body, rng)
    force = body.linearise(x, v, theta).force
    assert relative_error(force, body.force(x, v, theta)) < 1e-13


@pytest.mark.parametrize("material", ROTATION_INVARIANT)
def test_slopes_of_the_damping_force_by_position_are_symmetric(make_body, material, rng):
    """D_vK is a third derivative of the energy; only its lower triangle is ever computed."""
    body = make_body(material)
    x, v = deformed(body, rng, 1).reshape(1, -1), velocities(body, rng, 1)
    size = x.size

    def damping(x: np.ndarray) -> np.ndarray:
        without, with_damping = (
            body.force(x, np.broadcast_to(v, x.shape), theta_for(body, gamma_r, 0.0))
            for gamma_r in (0.0, 1.0)
        )
        return with_damping - without

    step_in_each_coordinate = LENGTH_M * np.eye(size)
    D = directional_derivative(damping, np.repeat(x, size, axis=0), step_in_each_coordinate)
    assert relative_error(D.T, D) < 1e-8


def test_linearise_writes_into_the_given_rows(make_body, rng):
    body = make_body()
    theta = theta_for(body)
    x, v = deformed(body, rng), velocities(body, rng)
    rows = np.full((len(x), body.linearisation_width), np.nan)
    at = body.linearise(x, v, theta, out=rows)
    for name, expected in vars(body.linearise(x, v, theta)).items():
        assert np.shares_memory(getattr(at, name), rows) or not expected.size
        np.testing.assert_array_equal(getattr(at, name), expected)
    with pytest.raises(InputError, match="expected contiguous float64"):
        body.linearise(x, v, theta, out=rows[:, 1:])


def test_force_is_linear_in_the_velocity(body, rng):
    """So that ∂²φ/∂v² is zero and not among the outputs."""
    theta = theta_for(body)
    x, v = deformed(body, rng), velocities(body, rng)
    slopes = (body.linearise(x, scale * v, theta).by_velocity for scale in (1.0, 5.0))
    np.testing.assert_array_equal(*slopes)


# Mass, volume, pattern ------------------------------------------------------------------------


def test_mass_is_density_times_volume_shared_among_the_nodes(small_mesh):
    body = Body(small_mesh, density_kg_m3=30.0)
    assert body.mass_kg == pytest.approx(30.0 * small_mesh.volume_m3, rel=1e-14)
    around = [small_mesh.volumes_m3[(body.cells == i).any(axis=1)].sum() for i in range(27)]
    np.testing.assert_allclose(body.node_mass, 30.0 * np.array(around) / 4, rtol=1e-13)
    assert (body.node_mass > 0).all()
    np.testing.assert_array_equal(body.dof_mass.reshape(-1, 3).T, [body.node_mass] * 3)


def test_weighed_mass_is_kept(small_mesh):
    assert Body(small_mesh, mass_kg=0.024).mass_kg == pytest.approx(0.024, rel=1e-14)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "of density_kg_m3 and mass_kg; expected exactly one"),
        (
            {"density_kg_m3": 30.0, "mass_kg": 0.02},
            "of density_kg_m3 and mass_kg; expected exactly one",
        ),
        ({"density_kg_m3": -30.0}, "density_kg_m3 is -30; expected a number above 0"),
        ({"mass_kg": 0.0}, "mass_kg is 0; expected a number above 0"),
        ({"mass_kg": np.nan}, "mass_kg is nan; expected a finite number"),
        ({"mass_kg": 1.0, "material": "rubber"}, "no material 'rubber'; available: "),
        ({"mass_kg": 1.0, "element": "hex8"}, "no element 'hex8'; available: tet4"),
        ({"mass_kg": 1.0, "evaluator": "gpu"}, "is 'gpu'; expected one of auto, simd, casadi"),
    ],
)
def test_unusable_arguments_are_refused(small_mesh, given, message):
    with pytest.raises(InputError, match=message):
        Body(small_mesh, **given)


def test_fields_of_the_wrong_shape_are_refused(make_body):
    body = make_body()
    theta = theta_for(body)
    x = body.nodes_m
    with pytest.raises(InputError, match=r"shapes \(26, 3\); expected \(27, 3\) or \(T, 27, 3\)"):
        body.energy(x[:-1], **elastic(body))
    with pytest.raises(InputError, match="positions at 2 times; expected those at one time"):
        body.elastic_force(np.stack([x, x]), **elastic(body))
    with pytest.raises(InputError, match="with the same number T of times"):
        body.force(np.stack([x, x]), np.zeros_like(x), theta)


def test_volume_ratio_is_one_at_rest_and_the_cube_of_a_stretch(make_body):
    body = make_body()
    ratios = body.volume_ratios(np.stack([body.nodes_m, 1.1 * body.nodes_m]))
    assert ratios.shape == (2, len(body.cells), 1)
    np.testing.assert_allclose(ratios[0], 1.0, rtol=1e-12)
    np.testing.assert_allclose(ratios[1], 1.1**3, rtol=1e-12)


def test_volume_ratio_of_a_mirrored_body_is_negative(make_body):
    body = make_body()
    np.testing.assert_allclose(body.volume_ratios(-body.nodes_m), -1.0, rtol=1e-12)


def test_pattern_finds_entries_of_either_triangle_and_nothing_outside(make_body):
    pattern = make_body().pattern
    found = pattern.positions_of(pattern.rows, pattern.columns)
    np.testing.assert_array_equal(found, np.arange(pattern.entry_count))
    np.testing.assert_array_equal(pattern.positions_of(pattern.columns, pattern.rows), found)
    full = pattern.matrix(np.ones(pattern.entry_count)).toarray()
    absent = np.argwhere(full == 0)
    for row, column in (absent[0], absent[-1]):
        with pytest.raises(IndexError, match="outside the mesh graph"):
            pattern.positions_of(np.array([row]), np.array([column]))


# Evaluators, threads, padding -----------------------------------------------------------------


def assert_same(a: Body, b: Body, rng: np.random.Generator, tolerance: float = 1e-12) -> None:
    x, v, w = deformed(a, rng, 3), velocities(a, rng, 3), velocities(a, rng, 3)
    theta, constants = theta_for(a), elastic(a)
    energy = b.energy(x[0], **constants)
    assert a.energy(x[0], **constants) == pytest.approx(energy, rel=tolerance)
    assert relative_error(a.force(x, v, theta), b.force(x, v, theta)) <= tolerance
    first, second = (
        [
            *vars(body.linearise(x, v, theta)).items(),
            *vars(body.second_derivatives(x, v, w, theta)).items(),
        ]
        for body in (a, b)
    )
    for (name, found), (_, expected) in zip(first, second, strict=True):
        assert found.shape == expected.shape, name
        error, size = (abs(each).max(initial=0) for each in (found - expected, expected))
        assert error <= tolerance * size, name


@pytest.mark.long
@pytest.mark.parametrize("material", COMPILED)
def test_evaluators_agree(make_body, material, rng):
    assert_same(make_body(material, "simd"), make_body(material, "casadi"), rng)


@pytest.mark.parametrize("evaluator", EVALUATORS)
def test_number_of_threads_does_not_change_a_bit(small_mesh, evaluator, rng):
    one, two = (
        Body(small_mesh, density_kg_m3=30.0, evaluator=evaluator, threads=threads)
        for threads in (1, 2)
    )
    assert_same(one, two, rng, tolerance=0.0)


@pytest.mark.parametrize("elements", [1, 3, 8, 9])
def test_any_number_of_elements_fills_the_vectors(small_mesh, elements, rng):
    mesh = TetMesh(small_mesh.points_m, small_mesh.tetrahedra[:elements])
    simd, reference = (Body(mesh, density_kg_m3=30.0, evaluator=name) for name in EVALUATORS)
    assert_same(simd, reference, rng)


@pytest.mark.parametrize("evaluator", EVALUATORS)
def test_more_quadrature_points_sum_to_the_same(small_mesh, evaluator, monkeypatch, rng):
    """A linear element's integrand is constant, however many points sample it."""
    a, b = 0.5854101966249685, 0.1381966011250105
    four = replace(ELEMENTS["tet4"], points=b + (a - b) * np.eye(4), weights=np.full(4, 0.25))
    monkeypatch.setitem(ELEMENTS, "tet4-four-points", four)
    one, many = (
        Body(small_mesh, density_kg_m3=30.0, element=element, evaluator=evaluator)
        for element in ("tet4", "tet4-four-points")
    )
    assert many.volume_ratios(small_mesh.points_m).shape == (1, len(many.cells), 4)
    assert_same(many, one, rng)
