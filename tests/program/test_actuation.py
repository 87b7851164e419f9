"""Bodies under tendons and pressures, compared with closed-form and reference solutions."""

from __future__ import annotations

import numpy as np
import pytest
from kit.actuation import hollow_octant
from scipy.integrate import solve_bvp, solve_ivp
from scipy.optimize import brentq

from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.selection import Box, Named
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.model.force_term import States
from collocation_sysid.model.forces import Forces
from collocation_sysid.program.forward.initial_equilibrium import equilibrium
from collocation_sysid.program.forward.newton_solver import NewtonSolver
from collocation_sysid.recording import (
    Experiment,
    Grasp,
    Markers,
    Nuisance,
    PoseSequence,
    Pressure,
    Tendon,
)

STILL = PoseSequence.fixed()


def driven(body: Body, grasps: list[Grasp], **drives) -> Experiment:
    """One equilibrium without gravity, seen at a node."""
    seen = Markers([0.0], np.zeros((1, 1, 3)), 1e-3, ["m"], body.nodes_m[-1:])
    return Experiment(
        body,
        [0.0],
        grasps,
        seen,
        (0.0, 0.0, 0.0),
        kind="static",
        nuisance=Nuisance.none(),
        **drives,
    )


def plane(body: Body, axis: int, value_m: float = 0.0) -> np.ndarray:
    """Nodes on a plane across an axis."""
    return np.flatnonzero(np.abs(body.nodes_m[:, axis] - value_m) < 1e-9)


YOUNG_PA, LENGTH_M, THICK_M = 1e5, 0.2, 0.01


def tip_of_the_elastica(tension_n: float, arm_m: float) -> np.ndarray:
    """Middle of the end of a thin beam under a tendon at a distance from its axis, clamped at 0.

    The tendon keeps its distance, so that it pulls with T and bends with T a: θ' = M / EI and
    stretch 1 − T / EA all along, a circle that scipy integrates.
    """
    area, second = THICK_M**2, THICK_M**4 / 12
    bend, stretch = (tension_n * arm_m / (YOUNG_PA * second), 1 - tension_n / (YOUNG_PA * area))
    s = np.linspace(0, LENGTH_M, 20)
    found = solve_bvp(
        lambda s, y: [stretch * np.cos(y[2]), stretch * np.sin(y[2]), np.full_like(s, bend)],
        lambda at_clamp, at_tip: at_clamp,
        s,
        np.zeros((3, len(s))),
        tol=1e-8,
    )
    assert found.success
    return found.sol(LENGTH_M)[:2]


@pytest.mark.parametrize("tension_n", [0.02, 0.08])
def test_a_tendon_bends_a_thin_beam_as_the_elastica(tension_n):
    mesh = box_mesh((LENGTH_M, THICK_M, THICK_M), (20, 1, 1))
    body, arm = Body(mesh, density_kg_m3=1e3, element="tet10"), 0.003
    points = [(x, THICK_M / 2 + arm, THICK_M / 2) for x in np.linspace(0, LENGTH_M, 41)]
    grasps = [Grasp(plane(body, 0), STILL)]
    experiment = driven(body, grasps, tendons=[Tendon(points, tension_n)])
    x = equilibrium(
        experiment, body.theta_from_values({"young_pa": YOUNG_PA, "poisson": 0.0} | REST)
    )
    middle = plane(body, 0, LENGTH_M)
    tip = x.reshape(-1, 3)[middle].mean(axis=0)
    expected = tip_of_the_elastica(tension_n, arm) + np.array([0.0, THICK_M / 2])
    assert expected[1] > 0.018
    np.testing.assert_allclose(tip[:2], expected, atol=0.02 * (expected[1] - THICK_M / 2))


REST = {"gamma_r_s": 0.0, "gamma_m_1_s": 0.0}


@pytest.mark.long
def test_a_thick_sphere_that_keeps_its_volume_inflates_as_rivlin_predicts():
    """p / μ = [−2/λ − 1/(2λ⁴)] between the stretches outside and inside, upside down."""
    inner, outer, mu = 0.01, 0.02, 3e4

    def pressure(a: float) -> float:
        b = (1 + (a**3 - 1) * inner**3 / outer**3) ** (1 / 3)
        inside, outside = (-2 / t - 1 / (2 * t**4) for t in (a, b))
        return float(mu * (inside - outside))

    stretch = float(brentq(lambda a: pressure(a) - 0.4 * mu, 1.0, 1.5))
    errors = []
    for divisions in (2, 3):
        mesh = hollow_octant(inner, outer, divisions, divisions)
        body = Body(mesh, density_kg_m3=1e3, element="tet10-p0")
        grasps = [Grasp(plane(body, k), STILL, axes="xyz"[k]) for k in range(3)]
        wall = Pressure(Named("wall"), 0.4 * mu)
        experiment = driven(body, grasps, pressures=[wall])
        theta = body.theta_from_values({"mu_pa": mu, "poisson": 0.4999} | REST)
        x = equilibrium(experiment, theta).reshape(-1, 3)
        radii = np.linalg.norm(x[np.flatnonzero(mesh.point_arrays["wall"])], axis=1)
        errors.append(radii.mean() - stretch * inner)
    assert np.log(errors[0] / errors[1]) / np.log(1.5) > 1.4
    assert abs(errors[1]) < 0.15 * (stretch - 1) * inner


def test_a_pressed_patch_with_a_held_rim_has_the_force_of_the_pressure():
    body = Body(box_mesh((0.03, 0.03, 0.01), (3, 3, 1)), density_kg_m3=1e3)
    inside = (np.abs(body.nodes_m[:, :2] - 0.015) < 0.006).all(axis=1)
    held = np.flatnonzero(~inside | (body.nodes_m[:, 2] < 1e-9))
    top = Pressure(Box((-1, -1, 0.0099), (1, 1, 1)), 100.0)
    experiment = driven(body, [Grasp(held, STILL)], pressures=[top])
    here = States(body.nodes_m.reshape(1, -1), np.zeros((1, 0)), np.zeros(0))
    (pressure,) = Forces.from_experiment(experiment, [0.0]).external_terms
    force = -pressure.force(here)
    up = force.reshape(-1, 3)[inside & (body.nodes_m[:, 2] > 0.009)]
    np.testing.assert_allclose(up[:, :2], 0, atol=1e-15)
    np.testing.assert_allclose(up[:, 2], 100.0 * 1e-4, rtol=1e-12)
    with pytest.raises(InputError, match="the faces are not closed"):
        driven(body, [Grasp(plane(body, 2), STILL)], pressures=[top])


def test_tensions_are_applied_in_parts_where_newton_fails_at_once():
    mesh = box_mesh((0.1, 0.01, 0.01), (8, 1, 1))
    body = Body(mesh, density_kg_m3=1e3, element="tet10")
    points = [(x, 0.008, 0.005) for x in np.linspace(0, 0.1, 17)]
    experiment = driven(body, [Grasp(plane(body, 0), STILL)], tendons=[Tendon(points, 0.6)])
    theta = body.theta_from_values({"young_pa": YOUNG_PA, "poisson": 0.3} | REST)
    x = equilibrium(experiment, theta)
    forces = Forces.from_experiment(experiment, [0.0], theta).total(x[None], np.zeros((1, x.size)))
    assert np.abs(forces[0, NewtonSolver(experiment).free]).max() < 1e-8
    assert np.linalg.norm(x.reshape(-1, 3)[-1] - body.nodes_m[-1]) > 0.05


def lagging_pressure(lag_s: float) -> Pressure:
    """A pressure that rises from 5 to 20 Pa, rests, and falls."""
    return Pressure(
        Named("cavity"), [5.0, 5.0, 20.0, 20.0, 12.0], [0, 0.1, 0.11, 0.3, 0.5], lag_s=lag_s
    )


def test_a_lagging_pressure_solves_its_differential_equation():
    """Integrated by scipy, piece by piece between the corners of the stated pressure."""
    pressure = lagging_pressure(0.04)
    t_s = np.linspace(0, 0.5, 51)
    found = solve_ivp(
        lambda t, p: (np.interp(t, pressure.t_s, pressure.pressure_pa) - p) / 0.04,
        (0.0, 0.5),
        [5.0],
        t_eval=t_s,
        max_step=1e-3,
        rtol=1e-10,
        atol=1e-10,
    )
    np.testing.assert_allclose(-pressure.energy_amplitude_at(t_s), found.y[0], rtol=1e-5)


def test_a_vanishing_lag_leaves_the_stated_pressure():
    t_s = np.linspace(0, 0.5, 51)
    np.testing.assert_allclose(
        lagging_pressure(1e-7).energy_amplitude_at(t_s),
        lagging_pressure(0.0).energy_amplitude_at(t_s),
        rtol=1e-3,
    )


def test_a_constant_pressure_with_a_lag_is_refused():
    with pytest.raises(InputError, match=r"lag_s of 0\.1 s; expected a table"):
        Pressure(Named("cavity"), 5.0, lag_s=0.1)
