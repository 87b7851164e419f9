"""What is assumed changes the residuals as a simulation with another body says."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from problems_small import EDGE_M, hung_cube

from collocation_sysid import Body, Collocation, Experiment, Tied, Unknown, simulate
from collocation_sysid.model.parameters import Parameters
from collocation_sysid.statistics.assumptions import (
    AIR_KG_M3,
    ASSUMPTIONS,
    Fitted,
)
from collocation_sysid.statistics.considered import changed_residuals

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))

from assumed_twins import wrong

VALUES = {"young_pa": 8e3, "poisson": 0.3, "gamma_r_s": 6e-3, "gamma_m_1_s": 0.0}
BY_NAME = {row.name: row for row in ASSUMPTIONS}
# How far off what is assumed is, so that markers follow it linearly.
OFF = {
    "body_scale": 1e-3,
    "mass": 1e-3,
    "density_gradient x": 1e-3,
    "density_gradient z": 1e-3,
    "anisotropy x": 1e-3,
    "anisotropy z": 1e-3,
    "stiffness_drift": 1e-3,
    "time_scale": 1e-3,
    "poisson": 1e-3,
    "buoyancy": 0.3,
    "added_mass": 0.03,
}


def swung() -> Experiment:
    """A cube hung from its top face, swayed and turned from rest, and its markers as simulated."""
    experiment = hung_cube(24)
    body = Body(experiment.body.mesh, density_kg_m3=60.0)
    return wrong(replace(experiment, body=body), VALUES, {})


def parameters(**stated: float | Unknown | Tied) -> Parameters:
    return Parameters.of(VALUES | {"young_pa": Unknown(VALUES["young_pa"], 10.0, 1e6)} | stated)


def changed(experiment: Experiment, name: str) -> np.ndarray:
    """Markers (T, M, 3) where an assumption is off by one of its unit, to first order [m]."""
    row = name.partition(" ")[0]
    collocation = Collocation([experiment], parameters(), "midpoint")
    positions = simulate(experiment, VALUES, "midpoint").positions_m
    z = collocation.pack(collocation.guess_p, [positions.reshape(len(positions), -1)])
    names, found = changed_residuals(collocation, z, [(BY_NAME[row], 1.0)])
    return found[0][..., names.index(name)] * experiment.markers.sigma_m[:, None]


@pytest.mark.parametrize("name", OFF)
def test_markers_change_as_where_the_body_is_as_the_assumption_fears(name):
    experiment, off = swung(), OFF[name]
    tracks = [wrong(experiment, VALUES, {name: way}).markers.positions_m for way in (off, 0.0)]
    simulated = (tracks[0] - tracks[1]) / off
    largest = np.abs(simulated).max()
    assert largest > 0
    atol = (0.05 if name == "stiffness_drift" else 0.01) * largest
    np.testing.assert_allclose(changed(experiment, name), simulated, atol=atol)


def test_the_drag_of_air_is_that_of_a_quarter_of_the_surface():
    experiment = swung()
    collocation = Collocation([experiment], parameters(), "midpoint")
    x = experiment.body.nodes_m.ravel()
    z = collocation.pack(collocation.guess_p, [np.tile(x, (len(experiment.t_s), 1))])
    at = Fitted(collocation.parts(z)[0], collocation.parameters)
    vars(at)["states"] = (x[None], np.tile([0.0, 2.0, 0.0], len(x) // 3)[None])
    force = BY_NAME["air_drag"].effect(at, 0).force_n[0].reshape(-1, 3).sum(axis=0)
    np.testing.assert_allclose(force, [0, -0.5 * AIR_KG_M3 * 1.5 * EDGE_M**2 * 4.0, 0], atol=1e-9)


def test_a_ratio_tied_to_one_that_is_estimated_is_not_stated():
    estimated = parameters(**{"poisson": Unknown(0.3, 0.1, 0.49), "core.poisson": Tied("poisson")})
    experiment = swung()
    collocation = Collocation([experiment], parameters(), "midpoint")
    x = np.tile(experiment.body.nodes_m.ravel(), (len(experiment.t_s), 1))
    (part,) = collocation.parts(collocation.pack(collocation.guess_p, [x]))
    assert BY_NAME["poisson"].effect(Fitted(part, estimated), 0) is None
    assert BY_NAME["poisson"].effect(Fitted(part, parameters()), 0) is not None
