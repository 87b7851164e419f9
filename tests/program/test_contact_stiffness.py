"""The effect of contact stiffness on forces, and its budget entry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.contact import moved, quarter, sensor
from kit.pokes import TRUTH as POKED
from kit.pokes import poked
from kit.problems import EDGE_M, box

import collocation_sysid as cs
from collocation_sysid.model.contact.force import contact_terms
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.recording import Experiment, Obstacle, Plane
from collocation_sysid.statistics.budget.consider_analysis import changed_residuals
from collocation_sysid.statistics.budget.systematic_effects import ASSUMPTIONS

YOUNG_PA = 1e4
LAW = {"young_pa": YOUNG_PA, "poisson": 0.3, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
UP = np.array([0.0, 0.0, 1.0])
(SOFTNESS,) = (row for row in ASSUMPTIONS if row.name == "contact_stiffness")
# Nearly rigid: a thousand times the default.
RIGID = 1e3


def between_platens(stretch: float, factor: float = 1.0) -> Experiment:
    """Return a block that smooth platens press in small steps, with a stiffer contact."""
    ways_m = EDGE_M * (1 - np.linspace(1, stretch, 15)) / 2
    t_s = np.arange(float(len(ways_m)))
    body = box()
    edge_m = EDGE_M / 2 * (2 + np.sqrt(2)) / 3
    law = {"stiffness_pa_m": factor * 100 * YOUNG_PA / edge_m, "width_m": 2e-4 * edge_m / factor}
    platens = [
        Obstacle(
            shape=Plane(way * UP, (0.0, 0.0, height_m)),
            poses=moved(t_s, np.outer(ways_m, way * UP)),
            wrench=sensor(t_s),
            name=name,
            **(law if factor > 1 else {}),
        )
        for name, way, height_m in (("bottom", 1, 0.0), ("top", -1, EDGE_M))
    ]
    return Experiment(
        body,
        t_s,
        [*quarter(body), *platens],
        kind="static",
        gravity_m_s2=np.zeros(3),
        nuisance=cs.Nuisance.none(),
    )


def first_order_n(experiment: Experiment, values: dict[str, float]) -> np.ndarray:
    """Return the change (T,) of the last sensor's force along z if contact were rigid [N]."""
    known = Parameters.from_mapping({**values, "young_pa": cs.Unknown(values["young_pa"])})
    collocation = cs.Collocation([experiment], known, "midpoint")
    positions = cs.simulate(experiment, values).positions_m
    z = collocation.pack(collocation.guess_p, [positions.reshape(len(positions), -1)])
    _, blocks = changed_residuals(collocation, z, [(SOFTNESS, 1.0)])
    sensor_sigma = experiment.wrenches[-1].value_sigmas.reshape(2, 3)[0, 2]
    return blocks[-1][:, 0, 2, 0] * sensor_sigma


def test_the_force_between_platens_is_within_the_allowance_for_softness():
    soft = between_platens(0.3)
    force_n, rigid_n = (
        cs.simulate(each, LAW).wrenches[-1][:, 2] for each in (soft, between_platens(0.3, RIGID))
    )
    assert force_n[-1] / rigid_n[-1] < 0.97
    allowance_n = first_order_n(soft, LAW)
    np.testing.assert_allclose(
        allowance_n[1:6], (rigid_n - force_n)[1:6], atol=0.03 * np.abs(rigid_n - force_n)[5]
    )
    assert (np.abs(rigid_n - force_n)[1:] < 1.96 * np.abs(allowance_n)[1:]).all()


def test_the_effect_on_an_indentation_is_that_of_a_contact_with_twice_the_stiffness():
    experiment = poked(place_sigma_m=None, depths_m=np.linspace(0.001, 0.004, 4))
    (ball,) = experiment.obstacles
    (term,) = contact_terms(experiment)
    edge_m = float(term.law_of_contact.edges_m[0])
    assert np.ptp(term.law_of_contact.edges_m) < 1e-12
    law = {"stiffness_pa_m": 100 * POKED["young_pa"] / edge_m, "width_m": 2e-4 * edge_m}
    soft, stiffer = (
        experiment.with_obstacles(
            [replace(ball, **{k: v * s for (k, v), s in zip(law.items(), w, strict=True)})]
        )
        for w in ((1, 1), (1.02, 1 / 1.02))
    )
    force_n, stiffer_n = (cs.simulate(each, POKED).wrenches[-1][:, 2] for each in (soft, stiffer))
    # κ/ε and ε δ at ε = 1/1.02 is a fiftieth of the way to ε = 0.
    expected_n = (stiffer_n - force_n) / (1 - 1 / 1.02)
    np.testing.assert_allclose(
        first_order_n(experiment, POKED), expected_n, atol=0.03 * np.abs(expected_n).max()
    )


def test_stiffness_and_width_follow_the_faces_at_each_point():
    body = cs.Body(cs.box_mesh((0.1, 0.1, 0.1), (2, 2, 2)), density_kg_m3=50.0)
    fine = np.array([0.0, 0.01, 0.1])
    points = body.mesh.points_m.copy()
    points[:, 0] = np.interp(points[:, 0], [0, 0.05, 0.1], fine)
    points[:, 1] = np.interp(points[:, 1], [0, 0.05, 0.1], fine)
    graded = cs.Body(cs.TetMesh(points, np.array(body.mesh.tetrahedra)), density_kg_m3=50.0)
    t_s = np.zeros(1)
    ball = Obstacle(shape=cs.Sphere(0.02, (0.0, 0.0, 0.12)), wrench=sensor(t_s))
    experiment = Experiment(graded, t_s, [ball], kind="static", nuisance=cs.Nuisance.none())
    law = contact_terms(experiment)[0].law_of_contact
    corners = graded.mesh.points_m[graded.mesh.surface]
    top = np.flatnonzero(
        (corners[..., 2] > 0.0999).all(axis=1) & (corners[..., :2] < 0.011).all((1, 2))
    )
    edges_m = law.edges_m.reshape(len(corners), -1)[top]
    assert edges_m == pytest.approx(0.01 * (2 + np.sqrt(2)) / 3)
    theta = graded.theta_from_values(LAW)
    kappa = law.stiffness_at(theta).reshape(len(corners), -1)[top]
    assert kappa == pytest.approx(100 * YOUNG_PA / edges_m)
    assert law.widths_m.max() > 3 * law.widths_m.reshape(len(corners), -1)[top].max()
