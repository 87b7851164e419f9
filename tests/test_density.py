"""Densities as parameters: derivatives, both methods, simulations, and what fixes their scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from checks import assert_derivative
from problems_small import (
    bar_in_two_hands,
    bar_let_go,
    cube_with_nuisance,
    hung_cube,
    measured_with,
    nodes_where,
    quadratic_bar,
)

from collocation_sysid.experiment import Experiment, PointMass
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.regions import Region
from collocation_sysid.methods import METHODS
from collocation_sysid.nlp.collocation import Collocation
from collocation_sysid.nlp.parameters import Parameters, Unknown

DENSITY_KG_M3 = {"density_kg_m3": 30.0, "core.density_kg_m3": 55.0}
TRUTH = {
    "lambda_pa": 200.0,
    "mu_pa": 300.0,
    "gamma_r_s": 0.009,
    "gamma_m_1_s": 1.0,
    "core.gamma_m_1_s": 3.0,
    **DENSITY_KG_M3,
}
GUESS = {
    "mu_pa": 400.0,
    "gamma_m_1_s": 0.5,
    "density_kg_m3": 45.0,
    "core.density_kg_m3": 35.0,
}


def with_core(experiment: Experiment, **changes) -> Experiment:
    """The experiment with a body of two parts, whose densities are free."""
    old = experiment.body
    core = Region("core", old.mesh.volumes_m3.argsort()[::2][:6], density_kg_m3=50.0)
    body = Body(
        old.mesh, density_kg_m3=30.0, element=old.element.name, regions=[core], **changes
    ).with_free_densities(["", "core"])
    return replace(experiment, body=body)


def weighted(experiment: Experiment) -> Experiment:
    """The experiment with a known mass on two of its nodes."""
    here = experiment.free_nodes[-2:]
    return replace(experiment, masses=(*experiment.masses, PointMass(here, 0.01)))


def parameters(truth=TRUTH, guess=GUESS) -> Parameters:
    return Parameters.of({n: Unknown(guess[n]) if n in guess else v for n, v in truth.items()})


MADE = {
    "hung cube": lambda: with_core(weighted(hung_cube())),
    "rayleigh": lambda: with_core(weighted(hung_cube()), damping="rayleigh"),
    "quadratic": lambda: with_core(weighted(quadratic_bar(6))),
    "let go": lambda: with_core(bar_let_go()),
    "nuisance": lambda: with_core(weighted(cube_with_nuisance(6))),
}


def test_derivatives_of_the_forces_of_a_body_by_its_densities(rng):
    body = with_core(hung_cube()).body
    theta = body.theta(TRUTH)
    x = body.nodes_m.ravel() + 1e-3 * rng.standard_normal(body.pattern.size)
    v, w = 0.1 * rng.standard_normal((2, body.pattern.size))
    tied = np.abs(rng.standard_normal(body.pattern.size)) * 1e-3
    at = body.linearise(x, v, theta, tied_kg=tied)

    def force(values):
        return body.force(x, v, values, tied)[0]

    assert_derivative(force, lambda d: at.by_theta[0] @ d, theta, rng, scale=0.1 * theta)
    found = body.curvature(x, v, w, theta, tied_kg=tied)

    def slope(values):
        return body.linearise(x, v, values, tied_kg=tied).by_theta[0].T @ w

    assert_derivative(slope, lambda d: found.theta_theta[0] @ d, theta, rng, scale=0.1 * theta)

    def by_velocity(values):
        matrix = body.linearise(x, v, values, tied_kg=tied).by_velocity[0]
        return body.pattern.matrix(matrix) @ w

    along = found.velocity_theta[0]
    assert_derivative(by_velocity, lambda d: along @ d, theta, rng, scale=0.1 * theta)


@pytest.mark.parametrize("name", MADE)
@pytest.mark.parametrize("scheme", ["midpoint", "bdf2"])
def test_derivatives_of_the_program_by_densities(name, scheme, rng):
    experiment = measured_with(MADE[name](), TRUTH)
    collocation = Collocation([experiment], parameters(), scheme=scheme)
    z = METHODS["reduced-space"](max_iterations=2)(collocation).z
    scale = np.concatenate([np.full(collocation.nq, 0.1), np.full(len(z) - collocation.nq, 0.01)])
    jacobian = collocation.jacobian(z)
    assert_derivative(
        collocation.constraint_values, lambda d: jacobian @ d, z, rng, tolerance=1e-7, scale=scale
    )
    weights = rng.standard_normal(collocation.constraints)
    hessian = collocation.hessian(z, 1.0, weights)

    def slope(at: np.ndarray) -> np.ndarray:
        return collocation.gradient(at) + collocation.jacobian(at).T @ weights

    assert_derivative(slope, lambda d: hessian @ d, z, rng, tolerance=1e-7, scale=scale)
