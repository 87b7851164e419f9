"""Point masses, forces, and grasps that hold for a part of the recording."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from kit.problems import (
    EDGE_M,
    GRAVITY_M_S2,
    TRUTH,
    as_theta,
    bar_in_two_hands,
    bar_let_go,
    box,
    hung_cube,
    nodes_where,
    times,
    vertex_markers,
)

from collocation_sysid.errors import InputError
from collocation_sysid.fem.schemes import SCHEMES
from collocation_sysid.program.forward.initial_equilibrium import equilibrium
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import Experiment, Force, Grasp, PointMass, PoseSequence
from collocation_sysid.recording.time_tables import read_forces

INTEGRATORS = ["newmark", *SCHEMES]
UNDAMPED = {**TRUTH, "gamma_r_s": 0.0, "gamma_m_1_s": 0.0}
TIP = nodes_where(box(), 2, 0.0)


def flying(**changes) -> Experiment:
    """A cube that nobody holds, without gravity, at rest."""
    cube = hung_cube(**{"steps": 8, "start": "undeformed", "gravity_m_s2": np.zeros(3)})
    return replace(cube, grasps=(), **changes)


# Masses and forces


def test_a_point_mass_pulls_like_its_weight():
    heavy = hung_cube(masses=(PointMass(TIP, 0.004),))
    pulled = hung_cube(forces=(Force(TIP, 0.004 * np.array(GRAVITY_M_S2)),))
    theta = as_theta(TRUTH)
    np.testing.assert_allclose(equilibrium(heavy, theta), equilibrium(pulled, theta), atol=1e-12)
    assert np.abs(equilibrium(heavy, theta) - equilibrium(hung_cube(), theta)).max() > 5e-4


@pytest.mark.parametrize("integrator", ["newmark", "midpoint"])
def test_a_heavy_mass_swings_as_on_a_spring(integrator: str):
    body, t_s = box(), times(110, 0.0004)
    mass, stiff = 0.2, {**UNDAMPED, "lambda_pa": 0.0, "mu_pa": 3e4}
    spring = Experiment(
        body,
        t_s,
        [Grasp(nodes_where(body, 2, EDGE_M), PoseSequence.fixed())],
        vertex_markers(body, TIP, t_s),
        start="undeformed",
        masses=(PointMass(TIP, mass),),
    )
    sag = (body.nodes_m - equilibrium(spring, as_theta(stiff)).reshape(-1, 3))[TIP, 2].mean()
    period = 2 * np.pi * np.sqrt(sag / 9.81)  # m g = k sag
    motion = simulate(spring, stiff, integrator)
    drop = body.nodes_m[TIP, 2].mean() - motion.markers_m[:, :, 2].mean(axis=1)
    lowest = t_s[np.argmax(drop)]
    back = t_s[np.argmax(drop) + np.argmin(drop[np.argmax(drop) :])]
    assert 2 * lowest == pytest.approx(period, rel=0.03)
    assert back == pytest.approx(period, rel=0.03)
    assert drop.max() == pytest.approx(2 * sag, rel=0.03)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_mass_that_joins_moves_along(integrator: str):
    speed = np.array([0.3, -0.2, 0.1])
    thrown = flying(masses=(PointMass(TIP, 0.01, from_s=0.03),))
    velocities = np.broadcast_to(speed, thrown.body.nodes_m.shape)
    thrown = replace(
        thrown,
        start="given",
        start_positions_m=thrown.body.nodes_m,
        start_velocities_m_s=velocities,
    )
    motion = simulate(thrown, UNDAMPED, integrator)
    expected = thrown.body.nodes_m + thrown.t_s[:, None, None] * speed
    np.testing.assert_allclose(motion.positions_m, expected, atol=1e-10)


@pytest.mark.parametrize("integrator", ["newmark", "midpoint"])
def test_a_force_gives_its_impulse(integrator: str):
    table = np.array([[0.0, 0.0, 0.0], [0.03, -0.02, 0.04], [0.0, 0.0, 0.0]])
    pushed = flying(forces=(Force(TIP, table, [0.0, 0.025, 0.05]),))
    motion = simulate(pushed, UNDAMPED, integrator, timestep_s=0.0025, substeps=4)
    impulse = 0.025 * (table[:-1] + table[1:]).sum(axis=0) / 2
    mass = pushed.body.node_mass
    momentum = mass @ (motion.positions_m[-1] - motion.positions_m[-2]) / pushed.timestep_s
    np.testing.assert_allclose(momentum, impulse, rtol=0.02, atol=1e-6)


def test_a_force_is_linear_between_its_rows_and_nothing_outside():
    force = Force([2, 5], [[0, 0, 0], [0, 0, 4.0]], [1.0, 2.0])
    at = force.node_forces_n([0.5, 1.25, 2.0, 2.1], 6)
    np.testing.assert_allclose(at[:, 5, 2], [0, 0.5, 2.0, 0])
    np.testing.assert_array_equal(at[:, 5], at[:, 2])
    assert not at[:, [0, 1, 3, 4]].any()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PointMass([0], 0.0), "expected a number above 0"),
        (lambda: PointMass([], 1.0), "empty list of nodes"),
        (lambda: Force([0], [[0, 0, 0], [0, 0, 1]]), "expected t_s"),
        (lambda: Force([0], [[0, 0, 0], [0, 0, 1]], [1.0, 1.0]), "row 2: .*time must increase"),
        (lambda: Grasp([0], PoseSequence.fixed(), 2.0, 1.0), "expected from_s <= until_s"),
    ],
)
def test_loads_that_mean_nothing_are_refused(make, message: str):
    with pytest.raises(InputError, match=message):
        make()


def test_force_files_are_read_by_column_name(tmp_path):
    file = tmp_path / "force.csv"
    file.write_text("fx_n,t_s,fz_n,fy_n\n1,0,3,2\n4,0.5,6,5\n")
    t_s, force_n = read_forces(file)
    np.testing.assert_array_equal(t_s, [0, 0.5])
    np.testing.assert_array_equal(force_n, [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t_s,fx_n,fy_n\n0,1,2\n", "line 1: the columns are t_s, fx_n, fy_n; expected"),
        ("t_s,fx_n,fy_n,fz_n\n0,1,2,x\n", "line 2: column fz_n holds 'x'"),
        ("t_s,fx_n,fy_n,fz_n\n0,1,2,3\n0,1,2,3\n", "line 3: .*time must increase"),
    ],
)
def test_force_files_that_are_wrong_name_the_line(tmp_path, text: str, message: str):
    file = tmp_path / "force.csv"
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        read_forces(file)


# Grasps for a while


def test_two_grasps_may_hold_a_node_one_after_the_other():
    bar = bar_in_two_hands()
    still, moving = bar.grasps
    first = replace(moving, until_s=0.03)
    again = replace(moving, from_s=0.06)
    passed = replace(bar, grasps=(still, first, again))
    held, positions = passed.prescribed_displacements(passed.t_s)
    expected = (passed.t_s < 0.035) | (passed.t_s > 0.055)
    np.testing.assert_array_equal(held[:, moving.nodes[0]].all(axis=1), expected)
    assert np.isnan(positions[~expected][:, moving.nodes]).all()
    np.testing.assert_array_equal(passed.prescribed_dofs, still.prescribed_dofs)
    with pytest.raises(InputError, match="held by the grasps 2 and 3 at the same time"):
        replace(bar, grasps=(still, first, replace(moving, from_s=0.02)))


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_body_let_go_by_everyone_falls_freely(integrator: str):
    cube = hung_cube(16)
    (grasp,) = cube.grasps
    dropped = replace(cube, grasps=(replace(grasp, until_s=0.04),))
    motion = simulate(dropped, {**TRUTH, "gamma_m_1_s": 0.0}, integrator, timestep_s=0.01)
    centre = dropped.body.node_mass @ motion.positions_m / dropped.body.mass_kg
    acceleration = np.diff(centre, 2, axis=0) / dropped.timestep_s**2
    remembers = 0.01 if integrator == "bdf2" else 1e-6  # the last steps in hand fade slowly there
    np.testing.assert_allclose(acceleration[-2:], [GRAVITY_M_S2] * 2, atol=remembers)
    np.testing.assert_allclose(
        motion.positions_m[:5, grasp.nodes],
        grasp.positions_at(cube.body.nodes_m, dropped.t_s[:5]),
        atol=1e-15,
    )


@cache
def let_go_by_newmark_m() -> np.ndarray:
    """Markers of the bar that one hand lets go of, in very small steps."""
    bar = bar_let_go()
    return simulate(bar, TRUTH, timestep_s=bar.timestep_s / 64).markers_m


@pytest.mark.parametrize("scheme", SCHEMES)
def test_schemes_agree_with_newmark_where_hands_let_go_and_masses_join(scheme: str):
    bar, reference = bar_let_go(), let_go_by_newmark_m()
    moved = np.abs(reference - reference[0]).max()
    errors = [
        np.abs(simulate(bar, TRUTH, scheme, substeps=m).markers_m - reference).max()
        for m in (4, 16)
    ]
    assert errors[1] < 0.4 * errors[0]
    assert errors[1] < 0.02 * moved


def test_a_release_starts_from_the_equilibrium_in_all_grasps():
    bar = bar_in_two_hands()
    still, moving = bar.grasps
    let_go = replace(bar, grasps=(still, replace(moving, until_s=0.0)))
    both_hold, one_holds = (
        equilibrium(e, as_theta(TRUTH)) for e in (let_go, replace(bar, grasps=(still,)))
    )
    motion = simulate(let_go, TRUTH, "midpoint", substeps=1)
    np.testing.assert_allclose(motion.positions_m[0].ravel(), both_hold, atol=1e-12)
    assert np.abs(both_hold - one_holds).max() > 1e-3
    tip = moving.nodes[0]
    drop = motion.positions_m[:3, tip, 2]
    assert drop[0] == pytest.approx(bar.body.nodes_m[tip, 2])
    assert drop[2] < drop[1] < drop[0]
