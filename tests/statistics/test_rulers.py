"""A body that falls: errors of lengths that the data determine better than the budget, and the error
of the mesh in contact, which nothing determines.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import collocation_sysid as cs

SIDE_M, DROP_M = 0.1, 0.1
T_S = np.arange(24) / 60
CORNERS_M = cs.box_mesh((SIDE_M,) * 3, (1,) * 3).points_m
TRUTH = {"young_pa": 5e4, "poisson": 0.3, "gamma_r_s": 0.01, "gamma_m_1_s": 0.1}
pytestmark = pytest.mark.long


def fall(cells: int, sigma_m: float, tilt_deg: float = 0.0) -> cs.Experiment:
    """A block with empty tracks that falls on a plane."""
    mesh = cs.box_mesh((SIDE_M,) * 3, (cells,) * 3)
    normal = (np.sin(np.radians(tilt_deg)), 0.0, np.cos(np.radians(tilt_deg)))
    floor = cs.Obstacle(shape=cs.Plane(normal, (0, 0, -DROP_M)), friction=0.3, name="floor")
    body = cs.Body(mesh, density_kg_m3=1000.0, made="cast", mesh_from="cad")
    unseen = cs.Markers(T_S, np.zeros((len(T_S), 8, 3)), sigma_m, places_m=CORNERS_M)
    return cs.Experiment(
        body,
        T_S,
        [floor],
        unseen,
        start="undeformed",
        air_density_kg_m3="none",
        nuisance=cs.Nuisance.none(),
    )


@cache
def solved(scale: float, cells: int = 1, sigma_m: float = 1e-4, tilt_deg: float = 0.0) -> cs.Run:
    """The fall of a body with more cells along an edge than the fit has, on a plane that is tilted,
    seen by cameras whose lengths are too long by `scale`.
    """
    exact_m = cs.simulate(fall(cells, sigma_m, tilt_deg), TRUTH, "bdf2", substeps=4).markers_m
    noise_m = sigma_m * np.random.default_rng(0).normal(size=exact_m.shape)
    seen_m = exact_m + scale * (exact_m - SIDE_M / 2) + noise_m
    problem = cs.Problem(
        [cs.with_markers(fall(1, sigma_m), seen_m)],
        TRUTH | {"young_pa": cs.Unknown(TRUTH["young_pa"])},
        scheme="bdf2",
        substeps=4,
    )
    return cs.run(problem, seek_causes=False)


def test_gravity_determines_the_scale_of_the_cameras_and_the_markers_that_of_the_body():
    for scale in (0.0, 3e-3):
        effects = {each.name: each for each in solved(scale).effects}
        for name, expected in (("body_scale", 0.0), ("calibration_scale", scale)):
            own = effects[name]
            assert 0 < own.std_error < 0.1 * own.deviation
            assert own.value == pytest.approx(expected, abs=3 * own.std_error)


def test_estimates_are_corrected_for_what_the_data_determine():
    wrong = solved(3e-3)
    estimate = wrong.estimates["young_pa"]
    truth = TRUTH["young_pa"]
    assert abs(estimate.value - truth) < 0.4 * abs(estimate.optimum - truth)
    shares = wrong.budget["young_pa"].shares
    assert shares.get("calibration_scale", 0.0) + shares.get("body_scale", 0.0) < 0.01


@pytest.mark.parametrize("tilt_deg", [0.0, 0.1])
def test_the_data_determine_the_tilt_and_the_interval_holds(tilt_deg):
    run = solved(0.0, tilt_deg=tilt_deg)
    low, high = run.interval("young_pa")
    assert low <= TRUTH["young_pa"] <= high
    effects = [each for each in run.effects if each.name.startswith("obstacle_tilt_rad")]
    assert min(each.std_error / each.deviation for each in effects) < 0.1 + tilt_deg / 0.2
