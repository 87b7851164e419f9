"""Motions of a damped body compared with those of scikit-fem and of MuJoCo."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco")

from kit.swung_cylinders import (
    STEPS_PER_SAMPLE,
    TRUTH,
    ScikitFemCylinder,
    cylinder,
    recording,
    simulate_flex,
)

import collocation_sysid as cs


@pytest.mark.long
def test_scikit_fem_and_mujoco_move_a_swung_cylinder_as_this_package_does():
    """Scikit-fem has the same scheme and steps, MuJoCo its own explicit one."""
    mesh = cylinder(rings=1, layers=3)
    flex = simulate_flex(mesh, TRUTH)
    experiment = recording(mesh, flex, seed=0)
    ours_m = cs.simulate(
        experiment, {**TRUTH, "gamma_m_1_s": 0.0}, "midpoint", substeps=STEPS_PER_SAMPLE
    ).positions_m
    theirs_m = ScikitFemCylinder(experiment).simulate(TRUTH)
    np.testing.assert_allclose(theirs_m, ours_m, atol=1e-8)
    way_m = np.linalg.norm(np.ptp(flex.positions_m, axis=0), axis=1).max()
    assert np.abs(flex.positions_m - ours_m).max() < 0.01 * way_m
