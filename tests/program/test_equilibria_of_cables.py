"""Equilibria of cables: in any order, and of what hardly bends or stretches."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import collocation_sysid as cs

CLAMP_M = 0.05
KNOWN = {"torsion_n_m2": 0.1, "axial_n": 1e3, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
# To one side and to the other: at the end, the clamp turns by 240° between two equilibria.
ANGLES_DEG = np.array([0, 30, -30, 60, -60, 90, -90, 120, -120])


def clamped_cable(angles_deg: np.ndarray) -> cs.Experiment:
    mesh = cs.rod_mesh([[0, 0, 0], [1, 0, 0]], cs.CrossSection.round(0.01), 21, [CLAMP_M])
    body = cs.Body(mesh, "cable", mass_kg=0.1)
    t_s = np.arange(len(angles_deg), dtype=float)
    turns = Rotation.from_rotvec(np.radians(angles_deg)[:, None] * [0, 1, 0])
    clamp = cs.Grasp(
        np.flatnonzero(mesh.arc_lengths_m < CLAMP_M * 1.01),
        cs.PoseSequence(t_s, np.zeros((len(t_s), 3)), turns.as_quat()),
    )
    markers = cs.Markers(t_s, np.zeros((len(t_s), 2, 3)), 1e-3, places_m=[[0.5, 0, 0], [1.0, 0, 0]])
    return cs.Experiment(
        body,
        t_s,
        [clamp],
        markers,
        kind="static",
        nuisance=cs.Nuisance.none(),
        air_density_kg_m3="none",
    )


def test_equilibria_are_the_same_in_another_order():
    order = np.argsort(ANGLES_DEG)
    mixed, ordered = (
        cs.simulate(clamped_cable(angles), {**KNOWN, "bending_n_m2": 0.2}).markers_m
        for angles in (ANGLES_DEG, ANGLES_DEG[order])
    )
    assert np.allclose(mixed[order], ordered, atol=1e-8)


def test_a_stiffness_is_found_from_a_soft_guess_in_any_order():
    truth = {**KNOWN, "bending_n_m2": 0.12}
    experiment = clamped_cable(ANGLES_DEG)
    seen = cs.with_markers(experiment, cs.simulate(experiment, truth).markers_m)
    found = cs.solve(cs.Problem([seen], {**KNOWN, "bending_n_m2": cs.Unknown(0.03)}))
    assert abs(found.parameters["bending_n_m2"] / 0.12 - 1) < 1e-6


@pytest.mark.parametrize(
    "softness",
    [{"bending_n_m2": 1e-4, "torsion_n_m2": 1e-4}, {"bending_n_m2": 1e-3, "axial_n": 1e6}],
)
def test_a_cable_hangs_from_a_level_clamp_however_soft_or_inextensible_it_is(softness):
    experiment = clamped_cable(np.zeros(1))
    tip_m = cs.simulate(experiment, KNOWN | softness).markers_m[0, -1]
    assert abs(tip_m[2] + 1 - CLAMP_M) < 0.05
    assert abs(tip_m[0] - CLAMP_M) < 0.05
