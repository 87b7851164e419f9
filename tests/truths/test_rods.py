"""Slender bodies against closed forms and an independent discrete elastic rod."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from kit.checks import observed_order
from kit.rods import (
    CABLE,
    DENSITY_KG_M3,
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
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.rods import CrossSection, rod_mesh
from collocation_sysid.model.forces import Forces
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
