"""Slender bodies against closed forms and an independent discrete elastic rod."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from kit.checks import observed_order
from kit.forces import forces_alone
from kit.rods import (
    CABLE,
    DENSITY_KG_M3,
    UNDAMPED,
    DiscreteRod,
    cable,
    centres,
    clamped,
    directors,
    ends,
    free_dofs,
    modes,
    placed,
    plane_rod,
    relaxed,
    rest_shape_under,
    small_displacement,
    straight,
    wrench_on_section,
)
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.laws.constants import NATURAL_ENDS, NATURAL_STRAINS
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.fem.pattern import dofs_of
from collocation_sysid.kinds.rod.element import CrossSection, rod_mesh
from collocation_sysid.model.dynamics import Dynamics
from collocation_sysid.model.forces import Forces
from collocation_sysid.program.forward.scheme_simulation import simulate_scheme
from collocation_sysid.program.modes.natural import natural_modes

G_M_S2 = 9.81
DOWN = (0.0, 0.0, -G_M_S2)
LENGTH_M = 1.0
THIN = CrossSection.round(0.004)
EI, GJ, EA = CABLE.values()
WEIGHT_N_M = DENSITY_KG_M3 * THIN.area_m2 * G_M_S2


@cache
def thin(sections: int = 31, **options) -> Body:
    """A straight cable along x."""
    return cable(straight(LENGTH_M, THIN, sections), **options)


def tip(x: np.ndarray) -> np.ndarray:
    return centres(x)[-1]


# Small displacements ---------------------------------------------------------------------------


@pytest.mark.parametrize("section", [CrossSection.round(0.02), CrossSection.rectangle(0.03, 0.02)])
def test_a_short_beam_bends_shears_stretches_and_twists(section):
    """With shear the end moves by P L³/(3 EI) + P L/(GA), with one second-order term of sections."""
    length_m, young, poisson, count = 0.2, 3e6, 0.3, 21
    mesh = rod_mesh([[0, 0, 0], [0, 0, length_m]], section, count, first_director=[1, 0, 0])
    beam = Body(mesh, density_kg_m3=DENSITY_KG_M3)
    about_1, about_2 = section.moments_m4
    shear = young / (2 + 2 * poisson)
    end = mesh.points_m[-3:]
    # One point in the middle of an element: L³/3 becomes L³/3 − L h²/12.
    bends = length_m**3 / 3 - length_m * (length_m / (count - 1)) ** 2 / 12
    expected = [
        bends / (young * about_2) + length_m / (shear * section.area_m2),
        bends / (young * about_1) + length_m / (shear * section.area_m2),
        length_m / (young * section.area_m2),
        length_m / (young * about_1),
        length_m / (young * about_2),
        length_m / (shear * section.torsion_m4),
    ]
    for wrench, compliance in zip(np.eye(6), expected, strict=True):
        loads = np.zeros_like(mesh.points_m)
        loads[-3:] = wrench_on_section(end, wrench[:3], wrench[3:])
        moved = small_displacement(beam, loads, young_pa=young, poisson=poisson)
        assert np.sum(loads * moved) == pytest.approx(compliance, rel=5e-4)


def arc(radius_m: float, angle_rad: float, count: int, section: CrossSection = THIN):
    angle = np.linspace(0, angle_rad, 41)
    centreline_m = radius_m * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return rod_mesh(centreline_m, section, count)


def test_a_quarter_circle_bends_and_twists_under_a_load_across():
    """Castigliano: P R³ (π/(4 EI) + (3π/4 − 2)/GJ) + P R π/(2 GA)."""
    radius_m, errors, counts = 0.3, [], np.array([11, 21, 41])
    bends = radius_m**3 * (np.pi / (4 * EI) + (0.75 * np.pi - 2) / GJ)
    expected = bends + radius_m * np.pi / 2 / (EA / 2.6)
    for count in counts:
        quarter = cable(arc(radius_m, np.pi / 2, count))
        loads = np.zeros_like(quarter.nodes_m)
        loads[-3:, 2] = 1 / 3
        moved = small_displacement(quarter, loads, **CABLE)
        errors.append(abs(np.sum(loads * moved) / expected - 1))
    assert errors[-1] < 1e-3
    assert observed_order(1 / (counts - 1), errors) == pytest.approx(2, abs=0.2)


def castigliano_m(
    places_m: np.ndarray, tangents: np.ndarray, ds_m: float, end_m: np.ndarray, stiffness: dict
) -> np.ndarray:
    """Displacement (3,) of the end of a curved rod clamped at its beginning, under its weight.

    The principle of virtual forces with a unit force at the end: ∫ (M·M̄ over EI, T T̄/GJ, N N̄/EA,
    Q·Q̄/GA) ds, in the middles of equal parts.
    """
    beyond = np.arange(len(places_m))[::-1] + 0.5
    part_n = stiffness["weight_n_m"] * ds_m
    force = np.outer(part_n * beyond, [0.0, 0.0, -1.0])
    sums_m = np.cumsum(places_m[::-1], axis=0)[::-1] - 0.5 * places_m
    moment = np.cross(sums_m - beyond[:, None] * places_m, [0.0, 0.0, -part_n])
    moved = []
    for unit in np.eye(3):
        pairs = (
            (moment, np.cross(end_m - places_m, unit), stiffness["GJ"], stiffness["EI"]),
            (force, np.tile(unit, (len(places_m), 1)), stiffness["EA"], stiffness["GA"]),
        )
        work = 0.0
        for own, virtual, along, across in pairs:
            first, second = ((each * tangents).sum(axis=1) for each in (own, virtual))
            both = (own * virtual).sum(axis=1)
            work += ds_m * np.sum(first * second / along + (both - first * second) / across)
        moved.append(work)
    return np.array(moved)


def test_a_helical_spring_is_stretched_by_its_weight():
    """Three coils; the closed form of close coils is W/2 · 2π R³ n/GJ (Wahl 1963)."""
    radius_m, pitch_m, coils, section = 0.03, 0.01, 3, CrossSection.round(0.003)
    young, poisson = 2e6, 0.3
    shear = young / (2 + 2 * poisson)
    stiffness = {
        "EI": young * section.moments_m4[0],
        "GJ": shear * section.torsion_m4,
        "EA": young * section.area_m2,
        "GA": shear * section.area_m2,
        "weight_n_m": DENSITY_KG_M3 * section.area_m2 * G_M_S2,
    }

    def helix(angle):
        angle = np.asarray(angle)
        fall = -pitch_m * angle / (2 * np.pi)
        return np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), fall], axis=-1)

    whole = 2 * np.pi * coils
    angle = (np.arange(4000) + 0.5) * whole / 4000
    slopes = np.stack(
        [-radius_m * np.sin(angle), radius_m * np.cos(angle), 0 * angle - pitch_m / (2 * np.pi)],
        axis=1,
    )
    rate_m = np.linalg.norm(slopes[0])
    expected = castigliano_m(
        helix(angle), slopes / rate_m, rate_m * whole / 4000, helix(whole), stiffness
    )
    close = stiffness["weight_n_m"] * rate_m * whole * np.pi * radius_m**3 * coils
    assert -expected[2] == pytest.approx(close / stiffness["GJ"], rel=5e-3)
    errors, counts = [], np.array([37, 73, 145])
    for count in counts:
        mesh = rod_mesh(helix(np.linspace(0, whole, 181)), section, int(count))
        spring = Body(mesh, density_kg_m3=DENSITY_KG_M3)
        weight_n = np.outer(spring.node_mass, DOWN)
        moved = small_displacement(spring, weight_n, young_pa=young, poisson=poisson)
        errors.append(np.linalg.norm(tip(moved) - expected) / np.linalg.norm(expected))
    assert errors[-1] < 5e-3
    assert observed_order(1 / (counts - 1), errors) == pytest.approx(2, abs=0.1)


# Large displacements ---------------------------------------------------------------------------


@pytest.mark.parametrize("load", [1.0, 5.0, 10.0])
def test_an_elastica_bends_as_its_equation_says(load):
    """P L²/EI = 1, 5 and 10 (Mattiasson 1981), from the straight rod without load steps."""
    force_n = load * EI / LENGTH_M**2
    expected = plane_rod(LENGTH_M, EI, tip_force_n=(0.0, -force_n))[-1]
    published = {1.0: (0.30172, 0.05643), 5.0: (0.71379, 0.38763), 10.0: (0.81061, 0.55500)}[load]
    np.testing.assert_allclose([-expected[1], 1 - expected[0]], published, atol=1e-5)
    errors, counts = [], np.array([11, 21, 41])
    for count in counts:
        x = rest_shape_under(clamped(thin(int(count)), 0.0, 0.0, -force_n), **CABLE)
        errors.append(np.linalg.norm(tip(x)[[0, 2]] - expected))
    assert errors[-1] < 5e-4
    assert observed_order(1 / (counts - 1), errors) == pytest.approx(2, abs=0.2)


def test_natural_curvature_alone_makes_a_circle():
    curved = cable(straight(LENGTH_M, THIN, 31), natural_curvature=True)
    frame = directors(curved.mesh, curved.nodes_m)[0]
    constants = CABLE | {
        "curvature_1_1_m": 2 * np.pi * 0.6,
        "curvature_2_1_m": 2 * np.pi * 0.8,
        "twist_1_m": 0.0,
    }
    x = rest_shape_under(clamped(curved), **constants)
    # Bent about the axis 0.6 d₁ + 0.8 d₂, towards which the tangent e_x turns.
    axis = frame.T @ [0.6, 0.8]
    middle = np.cross(axis, [1.0, 0.0, 0.0]) / (2 * np.pi)
    np.testing.assert_allclose(
        np.linalg.norm(centres(x) - middle, axis=1), 1 / (2 * np.pi), rtol=0.01
    )
    np.testing.assert_allclose(tip(x), 0.0, atol=0.005)
    assert curved.energy(x, **constants) < 1e-9


def test_natural_curvature_that_is_affine_makes_a_spiral():
    """An arc of Euler's spiral, whose tangent has turned by κ₀ s + (κ₁ − κ₀) s²/2L at s."""
    begin, end, length_m = 2.0, 9.0, 0.6
    zero = {"curvature_2_1_m": 0.0, "twist_1_m": 0.0}
    zero |= {"curvature_2_end_1_m": 0.0, "twist_end_1_m": 0.0}
    s_m = np.linspace(0, length_m, 2001)
    angle = begin * s_m + (end - begin) * s_m**2 / (2 * length_m)
    along, across = np.trapezoid([np.cos(angle), np.sin(angle)], s_m)
    counts, errors = np.array([11, 21, 41]), []
    for count in counts:
        curved = cable(straight(length_m, THIN, count), natural_curvature="affine")
        ends = {"curvature_1_1_m": begin, "curvature_1_end_1_m": end}
        x = rest_shape_under(clamped(curved), **CABLE, **ends, **zero)
        side = np.cross(directors(curved.mesh, curved.nodes_m)[0, 0], [1.0, 0.0, 0.0])
        errors.append(np.linalg.norm(tip(x) - along * np.array([1.0, 0.0, 0.0]) - across * side))
    assert errors[-1] < 5e-4
    assert observed_order(1 / (counts - 1), errors) == pytest.approx(2, abs=0.2)


def test_a_straight_part_and_a_region_whose_curvature_grows():
    """The angle at the tip is the mean natural curvature of the region times its length."""
    region = cs.Region("drum", cs.Along(0.2, 0.6))
    mesh = rod_mesh([[0, 0, 0], [0.6, 0, 0]], THIN, 31, stations_m=[0.2])
    curved = cable(mesh, natural_curvature="affine", regions=[region])
    names = [constant.name for constant in NATURAL_STRAINS + NATURAL_ENDS]
    drum = {"drum.curvature_1_1_m": 1.0, "drum.curvature_1_end_1_m": 4.0}
    x = rest_shape_under(clamped(curved), **CABLE, **dict.fromkeys(names, 0.0), **drum)
    d1, d2 = directors(mesh, x)[-1]
    turned = np.arccos(np.cross(d1, d2)[0])
    assert turned == pytest.approx(2.5 * 0.4, rel=1e-3)
    straight_m = centres(x)[mesh.s_m < 0.2 + 1e-9]
    np.testing.assert_allclose(straight_m[:, 1:], 0.0, atol=1e-9)


def test_natural_curvature_and_twist_make_a_helix():
    """κ and τ uniform in the material frame: radius κ/(κ² + τ²), pitch 2π τ/(κ² + τ²)."""
    curvature, twist, length_m = 6.0, 4.0, 0.6
    curved = cable(straight(length_m, THIN, 81), natural_curvature=True)
    constants = CABLE | {"curvature_1_1_m": curvature, "curvature_2_1_m": 0.0, "twist_1_m": twist}
    x = rest_shape_under(clamped(curved), **constants)
    rate = np.hypot(curvature, twist)
    frame = directors(curved.mesh, curved.nodes_m)[0]
    screw = (curvature * frame[0] + twist * np.array([1.0, 0.0, 0.0])) / rate
    along = centres(x) @ screw
    assert along[-1] == pytest.approx(twist / rate * length_m, rel=2e-3)
    across = centres(x) - np.outer(along, screw)
    middle = np.cross(screw, [1.0, 0.0, 0.0]) / rate
    np.testing.assert_allclose(
        np.linalg.norm(across - middle, axis=1), curvature / rate**2, rtol=0.01
    )


@pytest.mark.parametrize("angle_rad", [0.0, 1.2, -1.4])
def test_a_rod_with_natural_curvature_hangs_as_its_equation_says(angle_rad):
    """In the plane x, z; EI = 0.02 N m² and 0.15 N/m are a sag of about half the length."""
    along = [np.cos(angle_rad), 0.0, np.sin(angle_rad)]
    mesh = rod_mesh(np.outer([0.0, LENGTH_M], along), THIN, 41, first_director=[0, 1, 0])
    hanging = cable(mesh, natural_curvature=True)
    curvature = 1.5
    # About d₁ = e_y by the right-hand rule the tangent turns from x to −z.
    constants = CABLE | {"curvature_1_1_m": -curvature, "curvature_2_1_m": 0.0, "twist_1_m": 0.0}
    x = rest_shape_under(clamped(hanging, gravity_m_s2=DOWN), **constants)
    expected = plane_rod(LENGTH_M, EI, angle_rad, WEIGHT_N_M, curvature_1_m=curvature)
    assert np.abs(x[:, 1]).max() < 1.01 * THIN.node_radii_m[0]
    np.testing.assert_allclose(tip(x)[[0, 2]], expected[-1], atol=1e-3)


def test_the_centreline_between_sections_is_a_smooth_curve():
    """On a circle, whose sections are nearer to each other in its first part."""
    angle = np.linspace(0.0, 2.0, 101)
    circle_m = 0.1 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    errors = []
    for count in (8, 16, 32):
        mesh = rod_mesh(
            circle_m, THIN, count + 1, stations_m=(np.arange(count // 4) * 0.24 / count).tolist()
        )
        s_m = np.linspace(0.0, mesh.s_m[-1], 201)
        sections, weights, *_ = mesh.smooth_interpolation(s_m, mesh.elements_at(s_m))
        points = np.einsum("ma,mai->mi", weights, mesh.centres_of_sections_m[sections])
        exact = 0.1 * np.stack([np.cos(s_m / 0.1), np.sin(s_m / 0.1), 0 * s_m], axis=1)
        errors.append(np.linalg.norm(points - exact, axis=1).max())
    assert errors[-1] < 1e-5
    assert -np.diff(np.log2(errors)).max() > 2.5


# Stability -------------------------------------------------------------------------------------


def ring_eigenvalues(count: int, twist_rad: float, ratio: float) -> np.ndarray:
    """Lowest eigenvalues over EI/L³ of the stiffness of a straight rod bent to a ring, both ends of
    which are clamped in one place.

    The clamp holds no more than the position of the ring as a whole.
    """
    rod = cable(straight(LENGTH_M, CrossSection.round(0.01), count))
    angle = 2 * np.pi * rod.mesh.s_m / LENGTH_M
    radius_m = LENGTH_M / (2 * np.pi)
    middle = radius_m * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], axis=1)
    bend = Rotation.from_rotvec(np.outer(angle, [0, 0, 1]))
    tangents = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    turn = Rotation.from_rotvec(twist_rad * (angle / (2 * np.pi))[:, None] * tangents)
    frames = directors(rod.mesh, rod.nodes_m)
    turned = np.stack([(turn * bend).apply(frames[:, k]) for k in range(2)], axis=1)
    constants = {"bending_n_m2": EI, "torsion_n_m2": ratio * EI, "axial_n": 4 * EI / 0.005**2}
    start = placed(rod.mesh, middle, turned)
    _, values = relaxed(rod, start, free_dofs(rod, *ends(rod)), 0.01 * EI, **constants)
    return values[:3] / (EI / LENGTH_M**3)


@pytest.mark.parametrize("ratio", [0.65, 2.0])
def test_a_twisted_ring_buckles_at_the_twist_of_michell(ratio):
    """2π √3 EI/GJ; at any twist the ring can roll about its own centreline."""
    critical = 2 * np.pi * np.sqrt(3) / ratio
    below, above = (ring_eigenvalues(31, share * critical, ratio) for share in (0.97, 1.03))
    assert np.abs(below[0]) < 1e-4
    assert below[1] > 1e-2
    assert above[0] < -1e-2


def twisted_eigenvalue(count: int, moment: float, ratio: float) -> float:
    """Lowest eigenvalue over EI/L³ of the stiffness of a straight rod that is clamped at both ends
    and twisted, by a moment in units of EI/L.
    """
    rod = cable(straight(LENGTH_M, CrossSection.round(0.01), count))
    turn = Rotation.from_rotvec(np.outer(moment / ratio * rod.mesh.s_m / LENGTH_M, [1, 0, 0]))
    frames = directors(rod.mesh, rod.nodes_m)
    turned = np.stack([turn.apply(frames[:, k]) for k in range(2)], axis=1)
    constants = {"bending_n_m2": EI, "torsion_n_m2": ratio * EI, "axial_n": 4 * EI / 0.005**2}
    start = placed(rod.mesh, centres(rod.nodes_m), turned)
    _, values = relaxed(rod, start, free_dofs(rod, *ends(rod)), 0.01 * EI, **constants)
    return values[0] / (EI / LENGTH_M**3)


@pytest.mark.parametrize("ratio", [0.65, 2.0])
def test_a_twisted_rod_between_clamps_buckles_at_the_moment_of_greenhill(ratio):
    """M L/EI = 2 u with tan u = u, u = 4.4934 (Timoshenko & Gere 1961, section 2.21)."""
    critical = 2 * 4.493409
    assert twisted_eigenvalue(31, 0.97 * critical, ratio) > 0.1
    assert twisted_eigenvalue(31, 1.03 * critical, ratio) < -0.1


# Motions ---------------------------------------------------------------------------------------


def frequencies(count: int) -> dict[str, float]:
    """Frequencies over those of closed forms: bending 1 to 3, torsion and stretch [1]."""
    section, length_m, young, poisson = CrossSection.round(0.01), 0.6, 5e6, 0.3
    rod = Body(straight(length_m, section, count), density_kg_m3=DENSITY_KG_M3)
    found = modes(rod, ends(rod)[0], count=18, young_pa=young, poisson=poisson)
    rotation = np.sqrt(section.moments_m4[0] / section.area_m2)
    along = np.sqrt(young / DENSITY_KG_M3)
    roots = np.array([1.875104069, 4.694091133, 7.854757438])
    closed = {
        f"bending {k + 1}": root**2 * rotation * along / length_m**2 / (2 * np.pi)
        for k, root in enumerate(roots)
    }
    closed["torsion"] = along / np.sqrt(2 + 2 * poisson) / (4 * length_m)
    closed["stretch"] = along / (4 * length_m)
    shapes = found.shapes.reshape(len(found.shapes), -1, 3, 3)
    moved = shapes.mean(axis=2)
    # Share of the motion of the nodes that is a displacement along the rod, or a rotation about it.
    total = (shapes**2).mean(axis=2).sum(axis=(1, 2))
    is_stretch = (moved[..., 0] ** 2).sum(axis=1) > 0.5 * total
    is_torsion = (moved**2).sum(axis=(1, 2)) < 0.1 * total
    hz = found.frequencies_hz
    bending = hz[~is_stretch & ~is_torsion]
    np.testing.assert_allclose(bending[0:6:2], bending[1:6:2], rtol=1e-4)
    values = [*bending[0:6:2], hz[is_torsion][0], hz[is_stretch][0]]
    return {name: value / closed[name] for name, value in zip(closed, values, strict=True)}


def test_frequencies_of_a_cantilever():
    counts = np.array([11, 21, 41])
    ratios = [frequencies(int(count)) for count in counts]
    for name, most in (
        ("bending 1", 1e-3),
        ("bending 2", 2e-3),
        ("bending 3", 7e-3),
        ("torsion", 1e-3),
        ("stretch", 1e-3),
    ):
        assert ratios[-1][name] == pytest.approx(1, abs=most), name
        first, second = np.diff([ratio[name] for ratio in ratios])
        assert np.log2(first / second) == pytest.approx(2, abs=0.3), name


def test_a_beam_on_pins_sags_and_swings_as_a_simply_supported_one():
    """The second and third node of a section are on a line along d₂: held, they are its pin. The
    other end rolls along the beam.
    """
    bending, length_m, section = CABLE["bending_n_m2"], 0.5, CrossSection.round(0.006)
    mass_kg_m = DENSITY_KG_M3 * section.area_m2
    expected_hz = np.pi / (2 * length_m**2) * np.sqrt(bending / mass_kg_m)
    expected_m = 5 * mass_kg_m * 9.81 * length_m**4 / (384 * bending)
    errors = []
    for count in (11, 21, 41):
        beam = cable(straight(length_m, section, count))
        n = len(beam.nodes_m)
        pins = dofs_of(np.array([1, 2, n - 2, n - 1]))
        free = np.append(np.setdiff1d(np.arange(3 * n), pins), [3 * n - 6, 3 * n - 3])
        forces = forces_alone(beam, beam.theta_from_values(CABLE | UNDAMPED))
        hz = natural_modes(forces, beam.nodes_m, np.sort(free), 1).frequencies_hz[0]
        weight_n = np.full((n, 3), [0.0, mass_kg_m * 9.81 * length_m / (count - 1) / 3, 0.0])
        weight_n[[0, 1, 2, n - 3, n - 2, n - 1]] /= 2
        stiffness = beam.stiffness(beam.nodes_m, **CABLE).toarray()[np.ix_(free, free)]
        moved_m = np.zeros(3 * n)
        moved_m[free] = np.linalg.solve(stiffness, weight_n.ravel()[free])
        sag_m = moved_m.reshape(-1, 3, 3).mean(axis=1)[count // 2, 1]
        errors.append([hz / expected_hz - 1, sag_m / expected_m - 1])
    assert np.abs(errors[-1]).max() < 1.5e-3
    np.testing.assert_allclose(np.array(errors[0])[1] / np.array(errors[1])[1], 4, rtol=0.1)


ROOTS = np.array([1.875104069, 4.694091133])


@pytest.mark.parametrize("damping", ["kelvin-voigt", "rayleigh"])
@pytest.mark.parametrize(("stiffness", "mass"), [(0.02, 0.0), (0.0, 0.03), (0.01, 0.02)])
def test_bending_vibrations_decay_as_damping_says(damping, stiffness, mass):
    """ζ = γ_r ω/2 + γ_m/(2 ω) of bending 1 and 2, after gravity begins to act across; stated are both
    terms of bending 1.
    """
    length_m, section = 0.5, THIN
    rod = cable(straight(length_m, section, 16), damping=damping)
    mass_kg_m = DENSITY_KG_M3 * section.area_m2
    slow, fast = ROOTS**2 * np.sqrt(EI / mass_kg_m) / length_m**2
    t_s = 2 * np.pi / slow * np.arange(601) / 200
    released = clamped(
        rod, t_s=t_s, start="undeformed", gravity_m_s2=(0.0, 0.0, -0.05), air_density_kg_m3="none"
    )
    constants = {"gamma_r_s": 2 * stiffness / slow, "gamma_m_1_s": 2 * mass * slow}
    values = {"bending_n_m2": EI, "torsion_n_m2": GJ, "axial_n": 500.0} | constants
    motion = cs.simulate(released, values, "midpoint", substeps=1)
    fall = centres(motion.positions_m)[:, -1, 2]
    fall = fall / np.abs(fall).max()

    def difference(values: np.ndarray) -> np.ndarray:
        predicted = np.full(len(t_s), values[0])
        for decay, omega, cosine, sine in values[1:].reshape(2, 4):
            phase = omega * t_s
            waves = cosine * np.cos(phase) + sine * np.sin(phase)
            predicted = predicted + np.exp(-decay * t_s) * waves
        return predicted - fall

    guess = [-0.5, 0.01 * slow, slow, 0.5, 0.0, 0.03 * fast, fast, 0.01, 0.0]
    scales = [1, slow, slow, 1, 1, fast, fast, 1, 1]
    fit = least_squares(difference, guess, x_scale=scales, xtol=1e-12, ftol=1e-12)
    assert np.abs(fit.fun).max() < 1e-3  # of the other modes
    for (decay, omega), usual, most in zip(
        fit.x[1:].reshape(2, 4)[:, :2], (slow, fast), (5e-3, 0.015), strict=True
    ):
        assert np.hypot(omega, decay) == pytest.approx(usual, rel=most)
        # The frequency has the error of 16 sections.
        expected = constants["gamma_r_s"] * omega**2 / 2 + constants["gamma_m_1_s"] / 2
        assert decay == pytest.approx(expected, rel=most)


def test_a_tumbling_rod_keeps_its_momenta_and_its_energy():
    """The midpoint rule keeps both momenta exactly, and the energy within bounds.

    A soft rod turns twice and exchanges a fifth of its energy with its bending.
    """
    rod = cable(straight(0.5, CrossSection.round(0.012), 11))
    from_middle = rod.nodes_m - rod.nodes_m.mean(axis=0)
    velocity = np.cross([3.0, 2.0, 8.0], from_middle)
    velocity[:, 2] += 1.5 * np.cos(4 * np.pi * from_middle[:, 0])
    velocity -= np.average(velocity, axis=0, weights=rod.node_mass)
    thrown = clamped(
        rod,
        t_s=8e-4 * np.arange(2001),
        grasps=[],
        start="given",
        start_positions_m=rod.nodes_m,
        start_velocities_m_s=velocity,
        air_density_kg_m3="none",
    )
    constants = {"bending_n_m2": 1e-3, "torsion_n_m2": 8e-4, "axial_n": 50.0}
    theta = rod.theta_from_values(constants | UNDAMPED)
    dynamics = Dynamics.from_experiment(thrown, "midpoint").with_theta(theta)
    x = simulate_scheme(thrown, dynamics)
    rates, middle = np.diff(x, axis=0) / dynamics.step_s, (x[1:] + x[:-1]) / 2
    momentum = rod.dof_mass * rates + rod.force(middle, rates, theta) * dynamics.step_s / 2
    kinetic = (momentum**2 / rod.dof_mass).sum(axis=1) / 2
    momentum = momentum.reshape(len(momentum), -1, 3)
    places = x[1:].reshape(momentum.shape)
    angular = np.cross(places, momentum).sum(axis=1)
    usual = np.linalg.norm(momentum[0], axis=1).sum()
    assert np.abs(momentum.sum(axis=1)).max() < 1e-10 * usual
    assert np.ptp(angular, axis=0).max() < 1e-10 * np.linalg.norm(angular[0])
    kinetic = kinetic[::10]
    energy = kinetic + np.array([rod.energy(each, **constants) for each in places[::10]])
    assert np.ptp(energy) < 2e-3 * energy[0]
    assert (kinetic / energy).min() < 0.85
    cords = centres(places)[:, -1] - centres(places)[:, 0]
    assert np.linalg.norm(cords, axis=1).min() < 0.45


# Other models ----------------------------------------------------------------------------------


@pytest.mark.parametrize("ratio", [0.4, 1.0])
def test_a_discrete_elastic_rod_takes_the_same_shape_in_space(ratio):
    """Naturally bent and twisted, under its weight and a force at its end; GJ/EI 0.4 and 1."""
    natural, force_n = (1.0, -1.5, 2.0), (0.0, 0.08, 0.0)
    rod = cable(straight(LENGTH_M, THIN, 31), natural_curvature=True)
    first, second = directors(rod.mesh, rod.nodes_m)[0]
    reference = DiscreteRod(
        LENGTH_M,
        20,
        EI,
        ratio * EI,
        WEIGHT_N_M,
        natural,
        np.stack([first, second, np.array([1.0, 0.0, 0.0])]),
        force_n,
    ).solve()
    names = ("curvature_1_1_m", "curvature_2_1_m", "twist_1_m")
    constants = CABLE | {"torsion_n_m2": ratio * EI} | dict(zip(names, natural, strict=True))
    hanging = clamped(rod, *force_n, gravity_m_s2=DOWN)
    x = centres(rest_shape_under(hanging, **constants))
    assert np.abs(reference[-1] - [1.0, 0.0, 0.0]).min() > 0.05
    np.testing.assert_allclose(x[-1], reference[-1], atol=3e-3)


@pytest.mark.parametrize(("poisson", "most"), [(0.0, 5e-3), (0.3, 0.012)])
def test_a_bar_of_tetrahedra_bends_and_swings_like_a_rod(poisson, most):
    """Ten times as long as wide, with two quadratic elements across, under its own weight; it sags
    by a fifth and by two thirds of its length.
    """
    length_m, width_m, young = 0.2, 0.02, 3e5
    shear = young / (2 + 2 * poisson)
    first_lame = 2 * shear * poisson / (1 - 2 * poisson)
    middle_m = width_m / 2
    mesh = rod_mesh(
        [[0, middle_m, middle_m], [length_m, middle_m, middle_m]],
        CrossSection.rectangle(width_m, width_m),
        41,
        first_director=[0, 1, 0],
    )
    solid = box_mesh((length_m, width_m, width_m), (20, 2, 2))
    bodies = [Body(mesh, density_kg_m3=1000.0), Body(solid, density_kg_m3=1000.0, element="tet10")]
    values = [{"young_pa": young, "poisson": poisson}, {"lambda_pa": first_lame, "mu_pa": shear}]
    sags, found = [], []
    for body, constants in zip(bodies, values, strict=True):
        held, end = (np.flatnonzero(np.abs(body.nodes_m[:, 0] - x) < 1e-9) for x in (0.0, length_m))
        for gravity_m_s2 in (2.0, G_M_S2):
            hung = clamped(
                body,
                grasps=[cs.Grasp(held, cs.PoseSequence.fixed())],
                gravity_m_s2=(0.0, 0.0, -gravity_m_s2),
                air_density_kg_m3="none",
            )
            moved = rest_shape_under(hung, **constants) - body.nodes_m
            sags.append(moved[end].mean(axis=0))
        hz = modes(body, held, count=8, **constants).frequencies_hz
        found.append(hz[[0, 1, 2, 3, 5, 6, 7]])  # bending 1 and 2, stretch, bending 3; not torsion
    rod, bar = np.array(sags).reshape(2, 2, 3)
    away = np.linalg.norm(bar - rod, axis=1) / np.linalg.norm(rod, axis=1)
    assert away.max() < most
    np.testing.assert_allclose(found[1], found[0], rtol=0.015)


@pytest.mark.parametrize("is_held", [True, False])
def test_soft_modes_of_a_thin_rod_are_no_rigid_motions(is_held):
    """The stiffness of the sections is 10¹³ times that of the first mode."""
    mesh = rod_mesh([[0, 0, 0], [1.0, 0, 0]], THIN, 41)
    body = cs.Body(mesh, "cable", density_kg_m3=1200.0)
    t_s = np.linspace(0.0, 1.0, 11)
    markers = cs.Markers(t_s, np.zeros((11, 1, 3)), 1e-3, places_m=[[1.0, 0, 0]])
    grasps = [cs.Grasp(np.arange(3), cs.PoseSequence.fixed())] if is_held else []
    experiment = cs.Experiment(
        body, t_s, grasps, markers, start="undeformed", air_density_kg_m3="none"
    )
    constants = {"bending_n_m2": 0.02, "torsion_n_m2": 0.015, "axial_n": 5e4}
    theta = body.theta_from_values(constants | {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0})
    forces = Forces.from_experiment(experiment, 0.0, theta=theta)
    free = np.arange(9 if is_held else 0, body.nodes_m.size)
    modes = natural_modes(forces, body.nodes_m, free_dofs=free, count=4)
    roots = np.repeat([1.8751, 4.6941] if is_held else [4.7300, 7.8532], 2)
    expected_hz = np.sqrt(0.02 / body.mass_kg) * roots**2 / (2 * np.pi)
    assert np.allclose(modes.frequencies_hz, expected_hz, rtol=0.003)
    assert modes.omitted_count == (0 if is_held else 6)
