"""Bodies of several regions with their own materials, damping and densities."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache

import numpy as np
import pytest
from kit.checks import assert_derivative, directional_derivative, relative_error
from kit.internal_force_check import full_matrix
from kit.materials import CONSTANTS, theta_for

from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body, Linearisation
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.selection import Ball, Box, Indices, Named
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.fem.regions import Region

EVALUATORS = ["simd", "casadi"]
LENGTH_M = 0.03  # a large change of a position
DENSITY_KG_M3 = 30.0
BELOW = Box([-1, -1, -1], [1, 1, 0.045])  # about half of the small mesh
SOFT = {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 0.009, "gamma_m_1_s": 1.0}
HARD = {"lambda_pa": 900.0, "mu_pa": 700.0, "gamma_r_s": 0.002, "gamma_m_1_s": 3.0}


def of_region(name: str, values: Mapping[str, float]) -> dict[str, float]:
    return {f"{name}.{own}": value for own, value in values.items()}


@pytest.fixture(scope="session")
def make_two(small_mesh: TetMesh) -> Callable[..., Body]:
    """``make_two(material of the core, evaluator)``, the rest being neo-Hookean.

    Only the core's damping has slopes with a skew part.
    """

    @cache
    def make(material: str | None = None, evaluator: str = "auto") -> Body:
        core = Region("core", BELOW, material, density_kg_m3=80.0, damping="kelvin-voigt")
        return Body(
            small_mesh,
            density_kg_m3=DENSITY_KG_M3,
            damping="rayleigh",
            regions=[core],
            evaluator=evaluator,
        )

    return make


def theta_of_two(body: Body) -> np.ndarray:
    """Constants that differ from region to region."""
    core = CONSTANTS.get(body.parts[1].material.name)
    own = HARD if core is None else {**core, "gamma_r_s": 0.002, "gamma_m_1_s": 3.0}
    return body.theta_from_values({**SOFT, **of_region("core", own)})


def states(body: Body, rng: np.random.Generator, count: int = 2) -> tuple[np.ndarray, ...]:
    """Positions some way from rest, velocities and weights."""
    shape = (count, *body.nodes_m.shape)
    x = body.nodes_m + rng.uniform(-0.004, 0.004, shape)
    v, w = rng.standard_normal((2, count, 3 * len(body.nodes_m)))
    return x, v, w


def times(
    body: Body, triangles: np.ndarray, field: np.ndarray, skew: np.ndarray | None = None
) -> np.ndarray:
    """Product of each state's matrix, given by lower triangles of its parts, with its vector."""
    vectors = field.reshape(len(triangles), -1)
    skews = np.zeros((len(triangles), 0)) if skew is None else skew
    parts = zip(triangles, skews, vectors, strict=True)
    return np.stack([full_matrix(body.pattern, lower, other) @ d for lower, other, d in parts])


def transposed_times(body: Body, at: Linearisation, field: np.ndarray) -> np.ndarray:
    """Product with the transpose of ∂f/∂x."""
    return times(body, at.by_position, field, -at.by_position_skew)


# Parts and constants --------------------------------------------------------------------------


def test_constants_are_those_of_the_parts_one_after_another(make_two):
    body = make_two("gent")
    assert [part.name for part in body.parts] == ["", "core"]
    assert [part.material.name for part in body.parts] == ["neo-hookean", "gent"]
    assert [*body.constants] == [
        *("lambda_pa", "mu_pa", "gamma_r_s", "gamma_m_1_s"),
        *("core.mu_pa", "core.gent_limit", "core.kappa_pa", "core.gamma_r_s", "core.gamma_m_1_s"),
    ]
    assert "body: neo-hookean, core: gent" in repr(body)


def test_elements_of_no_region_are_the_first_part_which_may_be_empty(small_mesh):
    cells = np.arange(len(small_mesh.tetrahedra))
    regions = [Region("a", cells < 10), Region("b", cells >= 10)]
    whole = Body(small_mesh, density_kg_m3=DENSITY_KG_M3, regions=regions)
    assert [part.name for part in whole.parts] == ["a", "b"]
    some = Body(small_mesh, density_kg_m3=DENSITY_KG_M3, regions=regions[:1])
    assert [part.name for part in some.parts] == ["", "a"]
    np.testing.assert_array_equal(some.parts[0].cells, cells[10:])


def test_a_name_without_a_region_is_for_all_regions_that_have_none_of_their_own(make_two):
    body = make_two()
    shared = body.theta_from_values(SOFT)
    np.testing.assert_array_equal(shared, [*SOFT.values()] * 2)
    own = body.theta_from_values({**SOFT, "core.gamma_m_1_s": 7.0})
    np.testing.assert_array_equal(own, [*SOFT.values(), *[*SOFT.values()][:3], 7.0])


def test_small_strain_moduli_are_reported_for_each_part(make_two):
    body = make_two("gent")
    found = body.lame(theta_of_two(body))
    assert found[""] == pytest.approx((200.0, 300.0))
    assert found["core"] == pytest.approx((200.0, 300.0))
    stiffer = make_two()
    assert stiffer.lame(theta_of_two(stiffer))["core"] == pytest.approx((900.0, 700.0))


# Equal to one region --------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("element", ["tet4", "tet10"])
@pytest.mark.parametrize("evaluator", EVALUATORS)
def test_regions_with_the_same_constants_are_one_body(evaluator, element, rng):
    mesh = box_mesh((0.10, 0.12, 0.09), (2, 1, 1))
    one, two = (
        Body(mesh, "stable-neo-hookean", 30.0, element, regions=regions, evaluator=evaluator)
        for regions in ((), [Region("core", Box([-1, -1, -1], [0.05, 1, 1]))])
    )
    assert len(two.parts) == 2
    x, v, w = states(one, rng)
    theta, both = theta_for(one), np.tile(theta_for(one), 2)
    constants = {"lambda_pa": 200.0, "mu_pa": 300.0}
    assert two.energy(x[0], **constants) == pytest.approx(one.energy(x[0], **constants), rel=1e-13)
    np.testing.assert_allclose(two.node_mass, one.node_mass, rtol=1e-13)
    assert relative_error(two.force(x, v, both), one.force(x, v, theta)) < 1e-12
    found, expected = two.linearise(x, v, both), one.linearise(x, v, theta)
    for name in ("force", "by_position", "by_velocity", "by_position_skew"):
        assert relative_error(getattr(found, name), getattr(expected, name)) < 1e-12
    summed = found.by_theta[..., :4] + found.by_theta[..., 4:]
    assert relative_error(summed, expected.by_theta) < 1e-12
    found, expected = (
        two.second_derivatives(x, v, w, both),
        one.second_derivatives(x, v, w, theta),
    )
    for name in ("position_position", "position_velocity", "position_velocity_skew"):
        assert relative_error(getattr(found, name), getattr(expected, name)) < 1e-12
    for name in ("position_theta", "velocity_theta", "theta"):
        summed = getattr(found, name)[..., :4] + getattr(found, name)[..., 4:]
        assert relative_error(summed, getattr(expected, name)) < 1e-12
    blocks = found.theta_theta.reshape(-1, 2, 4, 2, 4)
    assert relative_error(blocks.sum(axis=(1, 3)), expected.theta_theta) < 1e-12


@pytest.mark.long
@pytest.mark.parametrize("material", ["mooney-rivlin", None])
def test_evaluators_agree(make_two, material, rng):
    simd, casadi = (make_two(material, evaluator) for evaluator in EVALUATORS)
    x, v, w = states(simd, rng)
    theta = theta_of_two(simd)
    for method, fields in (("linearise", (x, v)), ("second_derivatives", (x, v, w))):
        found, expected = (getattr(body, method)(*fields, theta) for body in (simd, casadi))
        for name, values in vars(expected).items():
            assert relative_error(getattr(found, name), values) < 1e-12, name


# Derivatives ----------------------------------------------------------------------------------


@pytest.mark.parametrize("evaluator", EVALUATORS)
@pytest.mark.parametrize("material", ["mooney-rivlin", "gent", None])
def test_linearise_gives_the_slopes_of_the_force(make_two, material, evaluator, rng):
    body = make_two(material, evaluator)
    x, v, _ = states(body, rng)
    theta = theta_of_two(body)
    at = body.linearise(x, v, theta)
    assert relative_error(at.force, body.force(x, v, theta)) < 1e-13
    assert_derivative(
        lambda x: body.force(x, v, theta),
        lambda dx: times(body, at.by_position, dx, at.by_position_skew),
        x,
        rng,
        scale=LENGTH_M,
    )
    assert_derivative(
        lambda v: body.force(x, v, theta), lambda dv: times(body, at.by_velocity, dv), v, rng
    )
    for k, direction in enumerate(np.diag(theta)):
        expected = directional_derivative(lambda c: body.force(x, v, c), theta, direction)
        assert relative_error(theta[k] * at.by_theta[:, :, k], expected) < 1e-9, k


@pytest.mark.parametrize("evaluator", EVALUATORS)
@pytest.mark.parametrize(
    "material", ["mooney-rivlin", pytest.param("gent", marks=pytest.mark.long)]
)
def test_curvature_gives_the_slopes_of_the_weighted_slopes(make_two, material, evaluator, rng):
    body = make_two(material, evaluator)
    x, v, w = states(body, rng)
    theta = theta_of_two(body)
    at = body.second_derivatives(x, v, w, theta)

    def by_theta(x, v, theta):
        return np.einsum("tik,ti->tk", body.linearise(x, v, theta).by_theta, w)

    np.testing.assert_allclose(at.theta, by_theta(x, v, theta), rtol=1e-9)
    assert_derivative(
        lambda x: transposed_times(body, body.linearise(x, v, theta), w),
        lambda dx: times(body, at.position_position, dx),
        x,
        rng,
        tolerance=1e-7,
        scale=LENGTH_M,
    )
    assert_derivative(
        lambda v: transposed_times(body, body.linearise(x, v, theta), w),
        lambda dv: times(body, at.position_velocity, dv, at.position_velocity_skew),
        v,
        rng,
        tolerance=1e-7,
    )
    for k, direction in enumerate(np.diag(theta)):
        for name, slope in (
            ("position_theta", lambda c: transposed_times(body, body.linearise(x, v, c), w)),
            ("velocity_theta", lambda c: times(body, body.linearise(x, v, c).by_velocity, w)),
            ("theta_theta", lambda c: by_theta(x, v, c)),
        ):
            expected = directional_derivative(slope, theta, direction)
            found = theta[k] * getattr(at, name)[..., k]
            size = np.abs(getattr(at, name) * theta).max()
            assert np.abs(found - expected).max() <= 1e-8 * size, (name, k)


def test_constants_of_one_region_move_no_node_inside_another(make_two, rng):
    body = make_two()
    x, v, _ = states(body, rng)
    by_theta = body.linearise(x, v, theta_of_two(body)).by_theta
    inside = [
        np.setdiff1d(np.arange(len(body.nodes_m)), body.cells[part.cells]) for part in body.parts
    ]
    for elsewhere, columns in zip(inside, (slice(0, 4), slice(4, 8)), strict=True):
        assert len(elsewhere)
        at_nodes = by_theta.reshape(len(x), -1, 3, 8)[:, elsewhere]
        assert not at_nodes[..., columns].any()


# Mass and its damping -------------------------------------------------------------------------


def test_each_region_has_its_density(small_mesh, make_two):
    body = make_two()
    rest_m3, core_m3 = (small_mesh.volumes_m3[part.cells].sum() for part in body.parts)
    assert body.mass_kg == pytest.approx(30.0 * rest_m3 + 80.0 * core_m3, rel=1e-13)
    expected = np.zeros(len(body.nodes_m))
    for part, density in zip(body.parts, (30.0, 80.0), strict=True):
        for cell in part.cells:
            expected[body.cells[cell]] += density * small_mesh.volumes_m3[cell] / 4
    np.testing.assert_allclose(body.node_mass, expected, rtol=1e-13)


def test_a_weighed_mass_is_that_of_all_regions(small_mesh):
    core = Region("core", BELOW, density_kg_m3=80.0)
    body = Body(small_mesh, mass_kg=0.1, regions=[core])
    assert body.mass_kg == pytest.approx(0.1, rel=1e-13)
    assert body.parts[1].density_kg_m3 == 80.0
    rest_m3, core_m3 = (small_mesh.volumes_m3[part.cells].sum() for part in body.parts)
    assert body.parts[0].density_kg_m3 == pytest.approx((0.1 - 80.0 * core_m3) / rest_m3)


def test_regions_without_a_density_share_the_remaining_mass(small_mesh):
    lower, upper = np.array_split(np.arange(len(small_mesh.tetrahedra)), 2)
    regions = [Region("a", lower, density_kg_m3=80.0), Region("b", upper)]
    body = Body(small_mesh, mass_kg=0.1, regions=regions)
    assert body.mass_kg == pytest.approx(0.1, rel=1e-13)


def test_regions_damp_their_own_mass(make_two):
    body = make_two()
    theta = body.theta_from_values({**SOFT, **of_region("core", HARD)})
    v = np.tile([1.0, 2.0, 3.0], len(body.nodes_m))
    force = body.force(body.nodes_m, v, theta)[0]
    shares = [np.zeros(len(body.nodes_m)) for _ in body.parts]
    for part, share in zip(body.parts, shares, strict=True):
        volumes = np.repeat(body.mesh.volumes_m3[part.cells, None], 4, axis=1)
        np.add.at(share, body.cells[part.cells], part.density_kg_m3 * volumes / 4)
    drag = SOFT["gamma_m_1_s"] * shares[0] + HARD["gamma_m_1_s"] * shares[1]
    np.testing.assert_allclose(force, -np.repeat(drag, 3) * v, atol=1e-13)


def test_mass_tied_to_a_node_is_damped_as_the_body_there(make_two):
    body = make_two()
    v = np.tile([1.0, 2.0, 3.0], len(body.nodes_m))
    theta = theta_of_two(body)
    alone = body.force(body.nodes_m, v, theta)
    heavier = body.force(body.nodes_m, v, theta, tied_kg=2 * body.dof_mass)
    np.testing.assert_allclose(heavier, 3 * alone, atol=1e-13)


# Which cells ----------------------------------------------------------------------------------


@pytest.fixture
def slab() -> TetMesh:
    """Two boxes side by side along x, the second told by a cell array."""
    mesh = box_mesh((0.2, 0.1, 0.1), (2, 1, 1))
    second = (mesh.centres_m[:, 0] > 0.1).astype(np.uint8)
    return TetMesh(mesh.points_m, mesh.tetrahedra, None, {"second": second, "tag": 1 + second})


SECOND = {
    "box": lambda second: Box([0.1, -1, -1], [1, 1, 1]),
    "ball": lambda second: Ball([0.2, 0.05, 0.05], 0.09),
    "indices": lambda second: Indices(np.flatnonzero(second)),
    "named": lambda second: Named("second"),
    "mask": lambda second: second,
    "numbers": lambda second: np.flatnonzero(second)[::-1],
}


@pytest.mark.parametrize("how", SECOND)
def test_cells_of_a_region_are_selected_in_several_ways(slab, how):
    second = slab.centres_m[:, 0] > 0.1
    body = Body(slab, density_kg_m3=1.0, regions=[Region("second", SECOND[how](second))])
    np.testing.assert_array_equal(body.parts[1].cells, np.flatnonzero(second))
    np.testing.assert_array_equal(body.parts[0].cells, np.flatnonzero(~second))


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        (Box([5, 5, 5], [6, 6, 6]), "selects none of the 12 cells"),
        (Ball([0, 0, 9], 0.1), "selects none of the 12 cells"),
        (Indices([3, 12]), "cell 12 does not exist; the mesh has 12 tetrahedra, numbered 0 to 11"),
        (Named("third"), 'no cell array or group "third"; it has "second", "tag"'),
        (Named("tag"), 'cell array "tag" contains the value 2; expected only 0 and 1'),
        (np.zeros(12, bool), "boolean array .12,. that is true somewhere"),
        (np.ones(7, bool), "expected indices of cells from 0, or a boolean array .12,."),
        ([0.5, 1.5], "expected indices of cells from 0, or a boolean array"),
        ([3, 12], "cell 12 does not exist; expected indices of the 12 cells"),
        ([-1, 3], "cell -1 does not exist"),
        ([], "expected indices of cells from 0, or a boolean array"),
    ],
)
def test_cells_that_are_not_there_are_refused_with_the_region(slab, cells, message):
    with pytest.raises(InputError, match=f"region 'core'.*{message}"):
        Body(slab, density_kg_m3=1.0, regions=[Region("core", cells)])


def test_regions_that_overlap_are_refused_with_a_cell(slab):
    regions = [Region("core", [0, 1, 2]), Region("skin", [2, 3])]
    with pytest.raises(InputError, match="cell 2 is in the regions 'core' and 'skin'"):
        Body(slab, density_kg_m3=1.0, regions=regions)


def test_names_that_cannot_be_distinguished_are_refused(slab):
    with pytest.raises(InputError, match="two regions are named 'core'"):
        Body(slab, density_kg_m3=1.0, regions=[Region("core", [0]), Region("core", [1])])
    with pytest.raises(InputError, match="name is ''; expected a valid file name"):
        Region("", [0])
    for name in ("a.b", "a b"):
        with pytest.raises(InputError, match=r"the region's name is .*expected letters, digits"):
            Region(name, [0])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"mass_kg": 1e-3},
            r"mass_kg is 0\.001; expected more than 0\.1 kg, the mass of the regions",
        ),
        ({"density_kg_m3": 0.0}, "density_kg_m3 is 0; expected a number above 0"),
        ({}, "of density_kg_m3 and mass_kg; expected exactly one"),
    ],
)
def test_regions_that_leave_no_mass_are_refused(slab, given, message):
    core = Region("core", Named("second"), density_kg_m3=100.0)
    with pytest.raises(InputError, match=message):
        Body(slab, regions=[core], **given)


def test_a_mass_without_information_is_refused(slab):
    both = [Region(n, c, density_kg_m3=50.0) for n, c in (("a", range(6)), ("b", range(6, 12)))]
    with pytest.raises(InputError, match="every cell is in a region with a density of its own"):
        Body(slab, mass_kg=0.1, regions=both)


def test_a_regions_density_must_be_positive(slab):
    with pytest.raises(
        InputError, match=r"Region 'core': density_kg_m3 is -3; expected a number above 0"
    ):
        Body(slab, density_kg_m3=1.0, regions=[Region("core", [0], density_kg_m3=-3.0)])


def test_unknown_materials_and_dampings_of_a_region_are_refused(slab):
    with pytest.raises(InputError, match="no material 'rubber'"):
        Body(slab, density_kg_m3=1.0, regions=[Region("core", [0], "rubber")])
    with pytest.raises(InputError, match=r"no damping 'raleigh'.*did you mean 'rayleigh'"):
        Body(slab, density_kg_m3=1.0, regions=[Region("core", [0], damping="raleigh")])


@pytest.mark.parametrize("evaluator", EVALUATORS)
def test_a_stiffness_factor_of_an_element_is_that_of_its_moduli(
    evaluator: str, small_mesh: TetMesh, rng: np.random.Generator
):
    core = Region("core", BELOW, damping="kelvin-voigt")
    body = Body(
        small_mesh,
        density_kg_m3=DENSITY_KG_M3,
        damping="kelvin-voigt",
        regions=[core],
        evaluator=evaluator,
    )
    x, v, _ = states(body, rng)
    same = {**SOFT, "gamma_m_1_s": 0.0}
    stiffer = {name: 1.7 * value if name.endswith("_pa") else value for name, value in same.items()}
    in_core = np.zeros(len(body.cells), dtype=bool)
    in_core[body.parts[1].cells] = True
    scaled = body.with_stiffness_factors(np.where(in_core, 1.7, 1.0))
    theta, of_stiffer = (
        body.theta_from_values({**same, **of_region("core", own)}) for own in (same, stiffer)
    )
    expected = body.force(x, v, of_stiffer)
    np.testing.assert_allclose(
        scaled.force(x, v, theta), expected, atol=1e-12 * np.abs(expected).max()
    )
    np.testing.assert_array_equal(scaled.mass_of_dofs(theta), body.mass_of_dofs(theta))
