"""A body that falls: errors of lengths that the data determine better than the budget, and the error
of the mesh in contact, which nothing determines.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid import pipeline
from collocation_sysid.statistics.budget.consider_analysis import changes_of_assumptions
from collocation_sysid.statistics.budget.variance_sources import VarianceSources
from collocation_sysid.statistics.probes.routine import is_alarming

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


def test_memory_is_not_named_where_the_mesh_in_contact_may_be_the_cause(monkeypatch):
    monkeypatch.setattr(pipeline, "is_significant_beside_budget", lambda *_: True)
    found = solved.__wrapped__(0.0, cells=2, sigma_m=6e-3)
    memory = [each for each in found.probes if each.name.startswith("memory")]
    assert max(each.chi_squared for each in memory) > 50
    assert found.budgeted is not None
    assert not any(map(is_alarming, found.probes))


@pytest.mark.parametrize("tilt_deg", [0.0, 0.1])
def test_the_budget_contains_the_tilt_that_the_data_leave(tilt_deg):
    run = solved(0.0, tilt_deg=tilt_deg)
    low, high = run.interval("young_pa")
    assert low <= TRUTH["young_pa"] <= high
    assert run.fit is not None
    assert run.uncertainty is not None
    collocation, z = run.solution.collocation, run.solution.z
    budget = run.problem.assumed_deviations
    changes = changes_of_assumptions(collocation, z, budget)
    unlimited, limited = (
        VarianceSources.from_fit(
            run.fit,
            changes,
            collocation.parameters,
            run.solution.q,
            run.uncertainty,
            deviations=budget,
            has_rulers=has_rulers,
        )
        for has_rulers in (False, True)
    )
    way = [k for k, name in enumerate(limited.names) if name == "obstacle_tilt_rad"]
    before, after = (np.linalg.norm(s.sensitivities[:, way]) for s in (unlimited, limited))
    assert after < (0.1 + tilt_deg / 0.2) * before
