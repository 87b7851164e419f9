"""Errors of lengths that the data determine better than the budget: those of a body that falls."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import collocation_sysid as cs

SIDE_M, DROP_M, SIGMA_M = 0.1, 0.1, 1e-4
T_S = np.arange(24) / 60
CORNERS_M = cs.box_mesh((SIDE_M,) * 3, (1,) * 3).points_m
TRUTH = {"young_pa": 5e4, "poisson": 0.3, "gamma_r_s": 0.01, "gamma_m_1_s": 0.1}
pytestmark = pytest.mark.long


def fall(*obstacles: cs.Obstacle) -> cs.Experiment:
    mesh = cs.box_mesh((SIDE_M,) * 3, (1,) * 3)
    body = cs.Body(mesh, density_kg_m3=1000.0, made="cast", mesh_from="cad")
    unseen = cs.Markers(T_S, np.zeros((len(T_S), 8, 3)), SIGMA_M, places_m=CORNERS_M)
    return cs.Experiment(
        body,
        T_S,
        obstacles,
        unseen,
        start="undeformed",
        air_density_kg_m3="none",
        nuisance=cs.Nuisance.none(),
    )


@cache
def solved(scale: float) -> cs.Run:
    """A fall on a plane, seen by cameras whose lengths are too long by `scale`."""
    floor = cs.Obstacle(shape=cs.Plane((0, 0, 1), (0, 0, -DROP_M)), friction=0.3, name="floor")
    exact_m = cs.simulate(fall(floor), TRUTH, "bdf2", substeps=4).markers_m
    noise_m = SIGMA_M * np.random.default_rng(0).normal(size=exact_m.shape)
    seen_m = exact_m + scale * (exact_m - SIDE_M / 2) + noise_m
    problem = cs.Problem(
        [cs.with_markers(fall(floor), seen_m)],
        TRUTH | {"young_pa": cs.Unknown(TRUTH["young_pa"])},
        scheme="bdf2",
        substeps=4,
    )
    return cs.run(problem, seek_causes=False)


def test_gravity_determines_the_scale_of_the_cameras_and_the_markers_that_of_the_body():
    right, wrong = solved(0.0), solved(3e-3)
    assert right.systematic_effects is not None
    assert wrong.systematic_effects is not None
    for rulers, scale in (
        (right.systematic_effects.rulers, 0.0),
        (wrong.systematic_effects.rulers, 3e-3 / 2e-3),
    ):
        assert {*rulers} == {"body_scale", "calibration_scale"}
        for name, expected in (("body_scale", 0.0), ("calibration_scale", scale)):
            value, error = rulers[name]
            assert 0 < error < 0.05
            assert value == pytest.approx(expected, abs=3 * error)


def test_estimates_are_corrected_for_what_the_data_determine():
    wrong = solved(3e-3)
    estimate = wrong.estimates["young_pa"]
    truth = TRUTH["young_pa"]
    assert abs(estimate.value - truth) < 0.4 * abs(estimate.optimum - truth)
    shares = wrong.budget["young_pa"].shares
    assert shares["calibration_scale"] + shares["body_scale"] < 0.01
    (note,) = [each for each in wrong.notes if "scale of the cameras" in each]
    assert "+0.3" in note
