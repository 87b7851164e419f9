"""A block between rigid walls: the stiffness of plane strain, E / (1 − ν²)."""

from __future__ import annotations

import numpy as np
import pytest

import collocation_sysid as cs

LOADS = np.arange(4.0)
SIDE_M, YOUNG_PA, POISSON = 0.02, 1e5, 0.3
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
