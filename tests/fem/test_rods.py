"""Elements of slender bodies: strains, forces, derivatives, masses and sections."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from kit.checks import relative_error
from kit.internal_force_check import check_forces_of_body
from kit.rods import CABLE, DENSITY_KG_M3, bent, cable, centres, directors, placed, straight
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.laws.constants import NaturalCurvature
from collocation_sysid.kinds.rod.element import CrossSection, RodMesh, rod_mesh
from collocation_sysid.testing.property_check import PropertyCheck

ROUND = CrossSection.round(0.01)
HOSE = CrossSection.round(0.012, 0.008)
STRIP = CrossSection.rectangle(0.012, 0.007)
SECTIONS = {"round": ROUND, "hose": HOSE, "rectangle": STRIP}
HOMOGENEOUS = {"young_pa": 3e6, "poisson": 0.35}
NATURAL = {"curvature_1_1_m": 1.0, "curvature_2_1_m": -2.0, "twist_1_m": 0.5}
ENDS = {"curvature_1_end_1_m": -0.5, "curvature_2_end_1_m": 0.7, "twist_end_1_m": 1.5}
CURVATURES = {False: {}, True: NATURAL, "affine": NATURAL | ENDS}
LAWS = {"rod": HOMOGENEOUS, "cable": CABLE}
DAMPED = {"gamma_r_s": 0.02, "gamma_m_1_s": 0.3}


@cache
def body(
    law: str = "rod",
    damping: str = "kelvin-voigt",
    evaluator: str = "auto",
    natural_curvature: NaturalCurvature = False,
) -> Body:
    return Body(
        bent(),
        law,
        density_kg_m3=DENSITY_KG_M3,
        damping=damping,
        evaluator=evaluator,
        natural_curvature=natural_curvature,
    )


def constants_of(law: str, natural_curvature: NaturalCurvature = False) -> dict[str, float]:
    return LAWS[law] | CURVATURES[natural_curvature]


def deformed(rod: Body, rng: np.random.Generator) -> np.ndarray:
    return rod.nodes_m + rng.uniform(-3e-4, 3e-4, rod.nodes_m.shape)


# Strains and forces ----------------------------------------------------------------------------


@pytest.mark.parametrize("section", SECTIONS)
@pytest.mark.parametrize("law", LAWS)
def test_a_rod_at_rest_has_no_force_and_resists_every_strain(section, law):
    for mesh in (straight(0.3, SECTIONS[section], 6, (0.6, 0.0, -0.8)), bent()):
        rod = Body(mesh, law, density_kg_m3=DENSITY_KG_M3)
        K = rod.stiffness(rod.nodes_m, **LAWS[law])
        assert abs(K - K.T).max() == 0.0
        force = rod.elastic_force(rod.nodes_m, **LAWS[law])
        assert np.abs(force).max() < 1e-13 * abs(K).max() * 0.3
        spectrum = np.linalg.eigvalsh(K.toarray())
        assert np.abs(spectrum[:6]).max() < 1e-11 * spectrum[-1]
        assert spectrum[6] > 1e3 * np.abs(spectrum[:6]).max()


@pytest.mark.parametrize("natural_curvature", CURVATURES)
@pytest.mark.parametrize("law", LAWS)
def test_a_rigid_motion_rotates_the_force_and_keeps_the_energy(law, natural_curvature, rng):
    rod, constants = (
        body(law, natural_curvature=natural_curvature),
        constants_of(law, natural_curvature),
    )
    x = deformed(rod, rng)
    turn = Rotation.from_rotvec([0.5, -2.0, 1.0]).as_matrix()
    moved = x @ turn.T + [0.3, 0.2, -0.1]
    expected = rod.elastic_force(x, **constants) @ turn.T
    assert relative_error(rod.elastic_force(moved, **constants), expected) < 1e-12
    assert rod.energy(moved, **constants) == pytest.approx(rod.energy(x, **constants), rel=1e-12)


@pytest.mark.parametrize("natural_curvature", CURVATURES)
@pytest.mark.parametrize("law", LAWS)
def test_elastic_forces_of_a_rod_balance(law, natural_curvature, rng):
    rod = body(law, natural_curvature=natural_curvature)
    x = deformed(rod, rng)
    force = rod.elastic_force(x, **constants_of(law, natural_curvature))
    assert np.abs(force.sum(axis=0)).max() < 1e-13 * np.abs(force).sum()
    assert np.abs(np.cross(x, force).sum(axis=0)).max() < 1e-13 * np.abs(force).sum()


@pytest.mark.parametrize("damping", ["kelvin-voigt", "rayleigh"])
@pytest.mark.parametrize("natural_curvature", CURVATURES)
@pytest.mark.parametrize("law", LAWS)
def test_derivatives_of_rods(law, natural_curvature, damping):
    """First and second derivatives by positions, velocities and constants, and the energy."""
    check_forces_of_body(
        PropertyCheck(f"rod {law!r} with damping {damping!r}"),
        body(law, damping, natural_curvature=natural_curvature),
        constants_of(law, natural_curvature) | DAMPED,
        displacement_m=3e-4,
        is_objective=damping == "kelvin-voigt",
        is_dissipative=damping == "kelvin-voigt",
    )


@pytest.mark.parametrize("damping", ["kelvin-voigt", "rayleigh"])
@pytest.mark.parametrize("law", LAWS)
def test_both_evaluators_of_rods_agree(law, damping, rng):
    found = []
    constants = constants_of(law, True) | DAMPED
    states = None
    for evaluator in ("casadi", "simd"):
        rod = body(law, damping, evaluator, natural_curvature=True)
        states = states or (
            deformed(rod, rng),
            rng.standard_normal(rod.nodes_m.shape),
            rng.standard_normal(rod.nodes_m.shape),
        )
        x, v, w = states
        theta = rod.theta_from_values(constants)
        first = vars(rod.linearise(x, v, theta))
        found.append(first | vars(rod.second_derivatives(x, v, w, theta)))
    for name, expected in found[0].items():
        if expected.size and np.abs(expected).max() > 0:
            assert relative_error(found[1][name], expected) < 1e-11, name


@pytest.mark.parametrize("natural_curvature", CURVATURES)
@pytest.mark.parametrize("evaluator", ["casadi", "simd"])
@pytest.mark.parametrize("law", LAWS)
def test_resultants_turn_with_a_rod(law, evaluator, natural_curvature, rng):
    """Strains do not change with a rotation W, so that Σ s ∂²ε/∂x² W x = W Σ s ∂ε/∂x, which are the
    forces if s are the resultants.
    """
    rod = body(law, evaluator=evaluator, natural_curvature=natural_curvature)
    theta = rod.theta_from_values(
        constants_of(law, natural_curvature) | {"gamma_r_s": 0.02, "gamma_m_1_s": 0.0}
    )
    x, v = deformed(rod, rng), rng.standard_normal(rod.nodes_m.shape)
    axis = rng.standard_normal(3)
    states = x.reshape(1, -1), v.reshape(1, -1)
    lower = rod.resultant_stiffness(states[0], rod.resultants(*states, theta), theta)[0]
    turned = rod.pattern.matrix(lower) @ np.cross(axis, x).ravel()
    expected = np.cross(axis, -rod.force(x, v, theta)[0].reshape(-1, 3)).ravel()
    assert relative_error(turned, expected) < 1e-11


def test_kelvin_voigt_damping_does_not_slow_a_rigid_rotation(rng):
    rod = body()
    theta = rod.theta_from_values(HOMOGENEOUS | {"gamma_r_s": 0.1, "gamma_m_1_s": 0.0})
    turn = Rotation.from_rotvec([0.5, -2.0, 1.0]).as_matrix()
    x = rod.nodes_m @ turn.T
    scale = np.abs(rod.force(x, rng.standard_normal(x.shape), theta)).max()
    assert np.abs(rod.force(x, np.cross([1.0, 2.0, 3.0], x), theta)).max() < 1e-12 * scale


def test_mass_proportional_damping_of_a_rod_acts_on_each_node(rng):
    rod = body()
    theta = rod.theta_from_values(HOMOGENEOUS | {"gamma_r_s": 0.0, "gamma_m_1_s": 2.0})
    v = rng.standard_normal(rod.nodes_m.shape)
    expected = -2.0 * rod.node_mass[:, None] * v
    force = rod.force(rod.nodes_m, v, theta)[0].reshape(-1, 3)
    np.testing.assert_allclose(force, expected, atol=1e-9)


# Energies of known strains ---------------------------------------------------------------------

LENGTH_M, COUNT = 0.4, 81
ALONG = np.linspace(0, LENGTH_M, COUNT)


def strained(kind: str, amount: float) -> tuple[np.ndarray, np.ndarray]:
    """Centres and directors d₁ and d₂ of a rod along z, with uniform strain."""
    nothing = 0 * ALONG
    middle = np.stack([nothing, nothing, ALONG], axis=1)
    turns = np.zeros((COUNT, 3))
    if kind == "axial":
        middle *= 1 + amount
    elif kind in ("shear 1", "shear 2"):
        middle[:, int(kind[-1]) - 1] = amount * ALONG
    elif kind == "twist":
        turns[:, 2] = amount * ALONG
    else:
        # The frame turns about d₁ or d₂ by the right-hand rule.
        about = int(kind[-1]) - 1
        turns[:, about] = amount * ALONG
        across = (1 - np.cos(amount * ALONG)) / amount
        middle[:, 2] = np.sin(amount * ALONG) / amount
        middle[:, 1 - about] = -across if about == 0 else across
    frames = Rotation.from_rotvec(turns).as_matrix()[:, :, :2].swapaxes(1, 2)
    return middle, frames


# Energy per length over half the squared strain, by section and constants.
STIFFNESS = {
    "axial": lambda s, E, G: E * s.area_m2,
    "shear 1": lambda s, E, G: G * s.area_m2,
    "shear 2": lambda s, E, G: G * s.area_m2,
    "bending 1": lambda s, E, G: E * s.moments_m4[0],
    "bending 2": lambda s, E, G: E * s.moments_m4[1],
    "twist": lambda s, E, G: G * s.torsion_m4,
}
NATURAL_OF = {"bending 1": "curvature_1_1_m", "bending 2": "curvature_2_1_m", "twist": "twist_1_m"}


@cache
def along_z() -> Body:
    mesh = rod_mesh([[0, 0, 0], [0, 0, LENGTH_M]], STRIP, COUNT, first_director=[1, 0, 0])
    return Body(mesh, "rod", density_kg_m3=DENSITY_KG_M3, natural_curvature=True)


@pytest.mark.parametrize("kind", STIFFNESS)
def test_the_energy_of_a_uniform_strain_is_that_of_its_stiffness(kind):
    rod, amount = along_z(), 0.5 if kind in NATURAL_OF else 1e-3
    mesh = rod.mesh
    x = placed(mesh, *strained(kind, amount))
    young, poisson = HOMOGENEOUS.values()
    stiffness = STIFFNESS[kind](STRIP, young, young / (2 + 2 * poisson))
    none = dict.fromkeys(NATURAL_OF.values(), 0.0)
    expected = stiffness * amount**2 / 2 * LENGTH_M
    assert rod.energy(x, **HOMOGENEOUS, **none) == pytest.approx(expected, rel=1e-4)
    if kind in NATURAL_OF:
        # Natural curvature and twist are those about the directors, by the right-hand rule.
        natural = none | {NATURAL_OF[kind]: amount}
        assert rod.energy(x, **HOMOGENEOUS, **natural) < 1e-6 * expected


def test_a_cable_has_its_constants_about_both_axes():
    mesh = rod_mesh([[0, 0, 0], [0, 0, LENGTH_M]], STRIP, COUNT, first_director=[1, 0, 0])
    rod = cable(mesh)
    for kind, name in (
        ("axial", "axial_n"),
        ("bending 1", "bending_n_m2"),
        ("bending 2", "bending_n_m2"),
        ("twist", "torsion_n_m2"),
    ):
        amount = 1e-3 if kind == "axial" else 0.5
        x = placed(mesh, *strained(kind, amount))
        expected = CABLE[name] * amount**2 / 2 * LENGTH_M
        assert rod.energy(x, **CABLE) == pytest.approx(expected, rel=1e-4)


# Masses and sections ---------------------------------------------------------------------------


@pytest.mark.parametrize("section", SECTIONS)
def test_masses_have_the_inertia_of_each_section(section):
    mesh = rod_mesh([[0, 0, 0], [0, 0, 0.3]], SECTIONS[section], 7, first_director=[1, 0, 0])
    rod, area = Body(mesh, density_kg_m3=DENSITY_KG_M3), SECTIONS[section].area_m2
    about_1, about_2 = SECTIONS[section].moments_m4
    parts = np.full(7, 0.05)
    parts[[0, -1]] /= 2
    np.testing.assert_allclose(
        rod.node_mass.reshape(-1, 3), np.outer(DENSITY_KG_M3 * area * parts, np.full(3, 1 / 3))
    )
    x, y = (rod.nodes_m[:, :2] - np.repeat(centres(rod.nodes_m), 3, axis=0)[:, :2]).T
    mass = rod.node_mass
    for k, moments in enumerate((mass * y * y, mass * x * x, mass * x * y)):
        of_sections = moments.reshape(-1, 3).sum(axis=1)
        expected = DENSITY_KG_M3 * parts * (about_1, about_2, 0.0)[k]
        np.testing.assert_allclose(
            of_sections, expected, rtol=1e-12, atol=1e-15 * mass.sum() * area
        )


def test_a_weighed_rod_has_its_mass():
    rod = Body(bent(), mass_kg=0.2)
    assert rod.node_mass.sum() == pytest.approx(0.2, rel=1e-12)


def test_moments_of_sections():
    """By the areas of a fine grid."""
    side = (np.arange(2000) + 0.5) / 1000 - 1
    X, Y = np.meshgrid(side, side)
    cell_m2 = (0.006 / 1000) ** 2
    inside = {
        "round": (X**2 + Y**2 < (5 / 6) ** 2),
        "hose": (X**2 + Y**2 < 1) & (X**2 + Y**2 > (4 / 6) ** 2),
        "rectangle": np.abs(Y) < 3.5 / 6,
    }
    for name, section in SECTIONS.items():
        x, y = 0.006 * X[inside[name]], 0.006 * Y[inside[name]]
        found = cell_m2 * np.array([len(x), (y * y).sum(), (x * x).sum()])
        expected = [section.area_m2, *section.moments_m4]
        np.testing.assert_allclose(found, expected, rtol=3e-3)
        if name != "rectangle":
            assert section.torsion_m4 == pytest.approx(sum(section.moments_m4), rel=1e-14)


@pytest.mark.parametrize("ratio", [1.0, 1.2, 1.5, 2.0, 3.0, 5.0, 10.0, 100.0])
def test_torsion_constant_of_a_rectangle(ratio):
    """Against the series of Saint-Venant (Timoshenko & Goodier, sec. 109)."""
    b, a = 0.004, 0.004 * ratio
    odd = np.arange(1, 200, 2)
    series = (np.tanh(odd * np.pi * a / (2 * b)) / odd**5).sum()
    expected = a * b**3 / 3 * (1 - 192 * b / (np.pi**5 * a) * series)
    for section in (CrossSection.rectangle(a, b), CrossSection.rectangle(b, a)):
        assert section.torsion_m4 == pytest.approx(expected, rel=0.04)


# Meshes ----------------------------------------------------------------------------------------


def test_sections_are_along_the_centreline_and_orthonormal():
    mesh = bent(30)
    frames = directors(mesh, mesh.points_m)
    np.testing.assert_allclose(
        frames @ frames.swapaxes(1, 2), np.broadcast_to(np.eye(2), (len(frames), 2, 2)), atol=1e-12
    )
    middle = mesh.centres_of_sections_m
    tangents = np.gradient(middle, mesh.s_m, axis=0, edge_order=2)
    normals = np.cross(frames[:, 0], frames[:, 1])
    np.testing.assert_allclose(normals, tangents, atol=0.01)
    assert np.abs(mesh.s_m - 0.0333).min() < 1e-12


def test_many_stated_arc_lengths_do_not_reduce_the_number_of_sections():
    stated_m = np.linspace(0.011, 0.95, 49)
    mesh = rod_mesh([[0, 0, 0], [1, 0, 0]], CrossSection.round(0.002), 61, list(stated_m))
    assert len(mesh.s_m) >= 61
    assert np.abs(mesh.s_m[:, None] - stated_m).min(axis=0).max() < 1e-12


def test_arc_length_of_a_circle():
    angle = np.linspace(0, 1.5 * np.pi, 25)
    circle = 0.2 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    mesh = rod_mesh(circle, ROUND, 40)
    assert mesh.s_m[-1] == pytest.approx(0.3 * np.pi, rel=1e-4)
    np.testing.assert_allclose(np.linalg.norm(mesh.centres_of_sections_m, axis=1), 0.2, rtol=2e-4)
    np.testing.assert_allclose(np.diff(mesh.s_m), mesh.s_m[-1] / 39, rtol=1e-12)


def test_sections_of_a_curve_in_space_are_not_twisted():
    """The directors of a Bishop frame do not turn about the tangent: d₂·d₁′ = 0."""
    mesh = bent(20)
    frames = directors(mesh, mesh.points_m)
    steps = np.diff(frames, axis=0) / np.diff(mesh.s_m)[:, None, None]
    middle = (frames[1:] + frames[:-1]) / 2
    twists = np.einsum("nc,nc->n", middle[:, 1], steps[:, 0])
    assert np.abs(twists).max() < 1e-9 * np.abs(steps).max()


@pytest.mark.parametrize(
    ("arguments", "where"),
    [
        ({"centreline_m": [[0, 0, 0]]}, "centreline_m"),
        ({"centreline_m": [[0, 0, 0], [0, 0, 0], [1, 0, 0]]}, "centreline_m"),
        ({"centreline_m": [[0, 0], [1, 0]]}, "centreline_m"),
        ({"sections": 2}, "sections"),
        ({"stations_m": [1.2]}, "s_m"),
        ({"first_director": [1, 0, 0]}, "first_director"),
    ],
)
def test_what_is_no_rod_is_refused(arguments, where):
    settings = {"centreline_m": [[0, 0, 0], [1, 0, 0]], "section": ROUND} | arguments
    with pytest.raises(InputError) as refused:
        rod_mesh(**settings)
    assert where in (refused.value.where, str(refused.value).split()[0])


@pytest.mark.parametrize(
    ("options", "where"),
    [
        ({"material": "yeoh"}, "material"),
        ({"prony": ["fast"]}, "prony"),
        ({"rest_shape": cs.UnderGravity([0, 1, 2])}, "rest_shape"),
    ],
)
def test_what_a_rod_does_not_have_is_refused(options, where):
    with pytest.raises(InputError) as refused:
        Body(bent(), density_kg_m3=1000.0, **options)
    assert where in (refused.value.where, str(refused.value).split()[0])


def test_a_rod_mesh_states_its_volume():
    mesh = bent()
    assert isinstance(mesh, RodMesh)
    assert mesh.volumes_m3.sum() == pytest.approx(STRIP.area_m2 * mesh.lengths_m.sum(), rel=1e-12)


def test_regions_side_by_side_along_a_rod_have_each_element_once():
    """Also where no section is at their common end: the element belongs to that of its middle."""
    regions = [cs.Region("a", cs.Along(0, 0.407)), cs.Region("b", cs.Along(0.407, 1))]
    parts = cable(straight(1.0, ROUND, 11), regions=regions).parts
    assert [part.name for part in parts] == ["a", "b"]
    assert np.array_equal(parts[0].cells, range(4))
    assert np.array_equal(parts[1].cells, range(4, 10))
