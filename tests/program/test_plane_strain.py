"""A block between rigid walls: the stiffness of plane strain, E / (1 − ν²)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

import collocation_sysid as cs

LOADS = np.arange(4.0)
SIDE_M, YOUNG_PA, POISSON = 0.02, 1e5, 0.3
SIGMA_N = 0.01
EVERYWHERE = cs.Box((-1, -1, -1), (1, 1, 1))
WALL_BELOW = cs.Box((-1, -1, -1), (1, 1, 1e-6))
WALL_ABOVE = cs.Box((-1, -1, SIDE_M - 1e-6), (1, 1, 1))


@pytest.mark.parametrize("is_plane", [True, False])
def test_walls_along_one_axis_make_plane_strain(is_plane):
    body = cs.Body(
        cs.box_mesh((SIDE_M,) * 3, (2, 2, 2)), "linear", density_kg_m3=1000.0, element="tet10"
    )
    strain = -1e-3 * LOADS
    shift_m = np.outer(strain * SIDE_M, [0, 0, 1.0])
    bench = cs.PoseSequence(LOADS, shift_m, np.tile([0, 0, 0, 1.0], (4, 1)))
    load = cs.Wrench(LOADS, np.zeros((4, 3)), sigma_n=1e-4)
    grasps = [
        cs.Grasp(WALL_ABOVE, bench, axes="z", wrench=load),
        cs.Grasp(WALL_BELOW, cs.PoseSequence.fixed(), axes="z"),
        cs.Grasp(cs.Box((-1, -1, -1), (1e-6, 1, 1)), cs.PoseSequence.fixed(), axes="x"),
        cs.Grasp(
            EVERYWHERE if is_plane else cs.Box((-1, -1, -1), (1, 1e-6, 1)),
            cs.PoseSequence.fixed(),
            axes="y",
        ),
    ]
    test = cs.Experiment(
        body, LOADS, grasps, kind="static", gravity_m_s2=(0, 0, 0), air_density_kg_m3="none"
    )
    (wrench,) = cs.simulate(
        test, {"young_pa": YOUNG_PA, "poisson": POISSON, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    ).wrenches
    modulus_pa = YOUNG_PA / (1 - POISSON**2) if is_plane else YOUNG_PA
    expected_n = modulus_pa * strain * SIDE_M**2
    np.testing.assert_allclose(wrench[:, 2], expected_n, atol=2e-3 * np.abs(expected_n).max())


def test_the_modulus_follows_from_a_large_compression_between_walls():
    """The closed form: λ₂ = 1, and λ₃ such that the neo-Hookean stress across is zero."""
    lame_pa = YOUNG_PA * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    mu_pa = YOUNG_PA / (2 * (1 + POISSON))
    stretch = np.linspace(1.0, 0.7, 7)
    across = [
        brentq(lambda w, s=s: lame_pa * np.log(s * w) + mu_pa * (w**2 - 1), 0.5, 3.0)
        for s in stretch
    ]
    stress_pa = (lame_pa * np.log(stretch * across) + mu_pa * (stretch**2 - 1)) / stretch
    force_n = np.zeros((7, 3))
    force_n[:, 2] = stress_pa * SIDE_M**2
    force_n[:, 2] += np.random.default_rng(0).normal(scale=SIGMA_N, size=7)
    loads = np.arange(7.0)
    poses = cs.PoseSequence(
        loads, np.outer((stretch - 1) * SIDE_M, [0, 0, 1.0]), np.tile([0, 0, 0, 1.0], (7, 1))
    )
    fixed = cs.PoseSequence.fixed()
    body = cs.Body(cs.box_mesh((SIDE_M,) * 3, (1, 1, 1)), density_kg_m3=1e3, element="tet10")
    test = cs.Experiment(
        body,
        loads,
        [
            cs.Grasp(WALL_ABOVE, poses, axes="z", wrench=cs.Wrench(loads, force_n, SIGMA_N)),
            cs.Grasp(WALL_BELOW, fixed, axes="z"),
            cs.Grasp(cs.Box((-1, -1, -1), (1e-6, 1, 1)), fixed, axes="x"),
            cs.Grasp(EVERYWHERE, fixed, axes="y"),
        ],
        kind="static",
        gravity_m_s2=(0, 0, 0),
        air_density_kg_m3="none",
        nuisance=cs.Nuisance.none(),
    )
    constants = {"poisson": POISSON, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    answer = cs.solve(cs.Problem([test], constants | {"young_pa": cs.Unknown(3e4)}))
    assert answer.parameters["young_pa"] == pytest.approx(YOUNG_PA, rel=5e-3)


@pytest.mark.parametrize(("young_pa", "poisson"), [(4e5, 0.3), (9e5, 0.4)])
def test_a_wide_strip_hangs_by_the_stiffness_of_a_plate(young_pa, poisson):
    """A cantilever whose width does not change sags by ρ g L⁴ 12 (1 − ν²) / (8 E h²)."""
    length_m, high_m, density = 0.1, 0.01, 1000.0
    strip = cs.box_mesh((length_m, 0.01, high_m), (20, 1, 3))
    body = cs.Body(strip, "linear", density_kg_m3=density, element="tet10")
    tip_m = [[length_m, 0.005, high_m / 2]]
    deflection_m = -density * 9.81 * length_m**4 * 12 * (1 - poisson**2)
    deflection_m /= 8 * young_pa * high_m**2
    seen_m = np.tile(np.add(tip_m, [0, 0, deflection_m]), (3, 1, 1))
    loads = np.arange(3.0)
    markers = cs.Markers(loads, seen_m, 2e-5, places_m=tip_m)
    fixed = cs.PoseSequence.fixed()
    test = cs.Experiment(
        body,
        loads,
        [
            cs.Grasp(cs.Box((-1, -1, -1), (1e-6, 1, 1)), fixed, axes="xz"),
            cs.Grasp(EVERYWHERE, fixed, axes="y"),
        ],
        markers,
        kind="static",
        gravity_m_s2=(0, 0, -9.81),
        air_density_kg_m3="none",
        nuisance=cs.Nuisance.none(),
    )
    constants = {"poisson": poisson, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
    answer = cs.solve(cs.Problem([test], constants | {"young_pa": cs.Unknown(1e5)}))
    # The formula neglects shear and the clamp, which are of the order of (h / L)².
    assert answer.parameters["young_pa"] == pytest.approx(young_pa, rel=0.02)
