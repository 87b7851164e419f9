"""Densities as parameters: derivatives, methods, simulation and identifiability of the scale."""

from __future__ import annotations

from dataclasses import replace
from itertools import cycle

import numpy as np
import pytest
from kit.checks import assert_derivative
from kit.densities import (
    DENSITY_KG_M3,
    GUESS,
    MADE,
    REMEMBERED,
    TRUTH,
    parameters,
    remembering_core,
    with_core,
)
from kit.problems import hung_cube, measured_with

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.laws.constants import is_density
from collocation_sysid.fem.regions import Region
from collocation_sysid.methods import METHODS
from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.simulation import simulate


def test_derivatives_of_the_forces_of_a_body_by_its_densities(rng):
    body = with_core(hung_cube()).body
    theta = body.theta_from_values(TRUTH)
    x = body.nodes_m.ravel() + 1e-3 * rng.standard_normal(body.pattern.size)
    v, w = 0.1 * rng.standard_normal((2, body.pattern.size))
    tied = np.abs(rng.standard_normal(body.pattern.size)) * 1e-3
    at = body.linearise(x, v, theta, tied_kg=tied)

    def force(values):
        return body.force(x, v, values, tied)[0]

    assert_derivative(force, lambda d: at.by_theta[0] @ d, theta, rng, scale=0.1 * theta)
    found = body.second_derivatives(x, v, w, theta, tied_kg=tied)

    def slope(values):
        return body.linearise(x, v, values, tied_kg=tied).by_theta[0].T @ w

    assert_derivative(slope, lambda d: found.theta_theta[0] @ d, theta, rng, scale=0.1 * theta)

    def by_velocity(values):
        matrix = body.linearise(x, v, values, tied_kg=tied).by_velocity[0]
        return body.pattern.matrix(matrix) @ w

    along = found.velocity_theta[0]
    assert_derivative(by_velocity, lambda d: along @ d, theta, rng, scale=0.1 * theta)


# The same optimum ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["hung cube", "let go"])
def test_methods_find_densities_where_a_known_mass_sets_the_scale(name):
    experiment = measured_with(MADE[name](), TRUTH)
    collocation = Collocation([experiment], parameters())
    reduced, interior, shot = (
        METHODS[m]()(collocation) for m in ("reduced-space", "interior-point", "shooting")
    )
    for solution in (reduced, interior, shot):
        assert solution.status.converged, solution.message
        for each in GUESS:
            assert solution.parameters[each] == pytest.approx(TRUTH[each], rel=1e-3)
    values = [[*solution.parameters.values()] for solution in (reduced, interior)]
    np.testing.assert_allclose(*values, rtol=1e-5)
    assert reduced.kkt_residual < 1e-8


# Along the equations of motion --------------------------------------------------------------


TOLD = {name: (MADE[name], TRUTH) for name in ("rayleigh", "quadratic", "loaded")}
TOLD["memory"] = remembering_core, REMEMBERED


@pytest.mark.parametrize(("name", "integrator"), [*zip(TOLD, cycle(["newmark", "midpoint"]))])
def test_a_density_in_theta_is_one_that_is_stated(name, integrator):
    make, truth = TOLD[name]
    free = make()
    stated = {n: v for n, v in truth.items() if not is_density(n)}
    rest, core = free.body.parts
    body = Body(
        free.body.mesh,
        density_kg_m3=DENSITY_KG_M3["density_kg_m3"],
        element=free.body.element.name,
        damping=rest.damping,
        prony=rest.prony,
        regions=[Region("core", core.cells, density_kg_m3=DENSITY_KG_M3["core.density_kg_m3"])],
    )
    found = simulate(free, truth, integrator).markers_m
    expected = simulate(replace(free, body=body), stated, integrator).markers_m
    np.testing.assert_allclose(found, expected, atol=1e-10)
