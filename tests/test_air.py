"""Air around a body: what it lifts, what of it moves along, how it drags, and what is said of it."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from problem_files import both, expect_message, replace_text
from problems_small import (
    EDGE_M,
    GRAVITY_M_S2,
    GUESS,
    IDEAL,
    TRUTH,
    box,
    hung_cube,
    times,
    vertex_markers,
)
from scipy.integrate import solve_ivp

import collocation_sysid as cs
from collocation_sysid.fem.air import AIR_KG_M3, SMOOTH_BELOW_M_S
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.force_term import States
from collocation_sysid.model.forces import Forces
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment
from collocation_sysid.statistics.assumptions import ASSUMPTIONS
from collocation_sysid.statistics.budget import Sources, budget
from collocation_sysid.statistics.considered import changed_residuals
from collocation_sysid.statistics.linearised import linearised_fit
from collocation_sysid.statistics.uncertainty import covariance

VOLUME_M3, DENSITY_KG_M3 = EDGE_M**3, 30.0
STIFF = {"lambda_pa": 1e5, "mu_pa": 1e5, "gamma_r_s": 1e-3, "gamma_m_1_s": 0.0}
GAMMA_M = "gamma_m_1_s"


def falling(air_density_kg_m3: float | str) -> Experiment:
    """A stiff cube of foam that falls freely for a second."""
    body, t_s = box(), times(50, 0.02)
    return Experiment(
        body,
        t_s,
        [],
        vertex_markers(body, [0], t_s),
        start="undeformed",
        nuisance=IDEAL,
        air_density_kg_m3=air_density_kg_m3,
    )


def fallen_m(experiment: Experiment, integrator: str) -> np.ndarray:
    """(T,) height of the centre of mass over that at the start."""
    positions_m = simulate(experiment, STIFF, integrator).positions_m
    height_m = np.average(positions_m[..., 2], axis=1, weights=experiment.body.node_mass)
    return height_m - height_m[0]


@pytest.mark.parametrize("integrator", ["midpoint", "newmark"])
def test_a_falling_cube_follows_the_equation_of_a_falling_point(integrator):
    dragged = 0.5 * AIR_KG_M3 * 0.25 * 6 * EDGE_M**2
    inertia_kg = (DENSITY_KG_M3 + 0.5 * AIR_KG_M3) * VOLUME_M3
    weight_n = (DENSITY_KG_M3 - AIR_KG_M3) * VOLUME_M3 * GRAVITY_M_S2[2]

    def rate(_, state):
        velocity = state[1]
        return [velocity, (weight_n - dragged * abs(velocity) * velocity) / inertia_kg]

    experiment = falling(AIR_KG_M3)
    t_s = experiment.t_s
    exact = solve_ivp(rate, (0.0, t_s[-1]), [0.0, 0.0], t_eval=t_s, rtol=1e-10, atol=1e-12).y[0]
    fallen = fallen_m(experiment, integrator)
    np.testing.assert_allclose(fallen, exact, atol=1e-3 * abs(exact[-1]))
    in_vacuum = fallen_m(falling("none"), integrator)
    assert in_vacuum[-1] == pytest.approx(0.5 * GRAVITY_M_S2[2] * t_s[-1] ** 2, rel=1e-6)
    assert exact[-1] > 0.8 * in_vacuum[-1]


def test_in_equilibrium_a_body_in_air_is_as_one_that_is_lighter_by_the_air():
    hanging = hung_cube(3, air_density_kg_m3=AIR_KG_M3, kind="static")
    lighter = cs.Body(hanging.body.mesh, density_kg_m3=DENSITY_KG_M3 - AIR_KG_M3)
    in_vacuum = replace(hanging, body=lighter, air_density_kg_m3="none")
    ours, theirs = (simulate(each, TRUTH).positions_m for each in (hanging, in_vacuum))
    np.testing.assert_allclose(ours, theirs, atol=1e-9)
    assert np.abs(ours - simulate(replace(hanging, air_density_kg_m3="none"), TRUTH).positions_m
                  ).max() > 1e-5  # fmt: skip


def test_point_masses_displace_no_air_and_no_air_is_damped_as_the_body_is():
    cube = hung_cube(3)
    tip = cs.PointMass([0], 0.01)
    mass = Forces.of(replace(cube, masses=[tip], air_density_kg_m3=AIR_KG_M3), [0.0]).mass
    air_kg = AIR_KG_M3 * VOLUME_M3
    assert mass.displaced_kg.sum() == pytest.approx(3 * air_kg)
    body_kg = 3 * (DENSITY_KG_M3 * VOLUME_M3 + 0.01)
    assert mass.damped_kg.sum() == pytest.approx(body_kg)
    assert mass.weighed_kg.sum() == pytest.approx(body_kg - 3 * air_kg)
    assert mass.kg.sum() == pytest.approx(body_kg + 1.5 * air_kg)


def test_drag_is_the_slope_of_what_it_dissipates_and_acts_at_the_surface_alone(rng):
    forces = Forces.of(hung_cube(3, (3, 3, 3), air_density_kg_m3=AIR_KG_M3), [0.0, 0.1])
    drag = forces.air_drag
    assert drag is not None
    size = forces.body.pattern.size
    x, v = rng.normal(size=(2, 2, size))
    area_m2 = drag.placed.data[3]

    def potential(v: np.ndarray) -> float:
        speed = np.linalg.norm(v.reshape(2, -1, 3)[:, drag.points.nodes[:, 0]], axis=2)
        cubed = (speed**2 + SMOOTH_BELOW_M_S**2) ** 1.5
        return float((0.125 * AIR_KG_M3 * area_m2 * cubed).sum()) / 3

    force, way = drag.force(States(x, v, np.zeros(0))), rng.normal(size=v.shape)
    slope = (potential(v + 1e-5 * way) - potential(v - 1e-5 * way)) / 2e-5
    assert -(force * way).sum() == pytest.approx(slope, rel=1e-7)
    assert (np.einsum("ti,ti->t", force, v) < 0).all()
    nodes_m = forces.body.nodes_m
    inside = (np.abs(nodes_m - EDGE_M / 2) < 0.4 * EDGE_M).all(axis=1)
    assert inside.sum() == 8
    assert not force.reshape(2, -1, 3)[:, inside].any()
    assert area_m2.sum() == pytest.approx(6 * EDGE_M**2)


def test_nothing_drags_in_equilibrium_and_in_a_vacuum():
    static = hung_cube(3, air_density_kg_m3=AIR_KG_M3, kind="static")
    assert Forces.of(static, [0.0]).air_drag is None
    vacuum = hung_cube(3, air_density_kg_m3="none")
    assert vacuum.air_density_kg_m3 == 0.0
    assert Forces.of(vacuum, [0.0]).air_drag is None


# What the air does to an estimate -----------------------------------------------------------------


SHAKEN = {"lambda_pa": 200.0, "mu_pa": 300.0, "gamma_r_s": 0.009, GAMMA_M: 1.0}


def recorded(drag: float, stated: float | str) -> Experiment:
    """A cube in air with so much of the model's drag, seen with noise, described by a density."""
    hung = hung_cube(40, air_density_kg_m3=AIR_KG_M3)

    def more_drag(x, v, at):
        speed = cs.sqrt(v) if False else (v[0] ** 2 + v[1] ** 2 + v[2] ** 2 + 1e-8) ** 0.5
        return -(drag - 1) * 0.125 * AIR_KG_M3 * at.area_m2 * speed * v

    body = cs.Body(
        hung.body.mesh, density_kg_m3=DENSITY_KG_M3, forces=[cs.NodeForce.of(more_drag)]
    )
    tracks = simulate(replace(hung, body=body), SHAKEN, "midpoint").markers_m
    noise = 3e-4 * np.random.default_rng(0).standard_normal(tracks.shape)
    seen = with_markers(replace(hung, air_density_kg_m3=stated), tracks + noise)
    return replace(seen, markers=replace(seen.markers, sigma_m=np.full(9, 3e-4)))
