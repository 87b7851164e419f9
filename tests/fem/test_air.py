"""Air around a body: buoyancy, added mass, drag, their budget and the keys that describe them."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from kit.problem_files import AT_TRUTH, run_command, settings
from kit.problems import (
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
from collocation_sysid.errors import InputError
from collocation_sysid.fem.node_force import AIR_KG_M3, SMOOTH_BELOW_M_S
from collocation_sysid.judge.posterior import BudgetLine, Effects, Posterior
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.model.force_term import States
from collocation_sysid.model.forces import Forces
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment
from collocation_sysid.statistics.budget.consider_analysis import changed_residuals
from collocation_sysid.statistics.budget.systematic_effects import ASSUMPTIONS
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.uncertainty import AUTO, uncertainty_from_fit

VOLUME_M3, DENSITY_KG_M3 = EDGE_M**3, 30.0
STIFF = {"lambda_pa": 1e5, "mu_pa": 1e5, "gamma_r_s": 1e-3, "gamma_m_1_s": 0.0}
GAMMA_M = "gamma_m_1_s"
OF_AIR = ("buoyancy", "added_mass", "air_drag")


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


@pytest.mark.long
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
    mass = Forces.from_experiment(
        replace(cube, masses=[tip], air_density_kg_m3=AIR_KG_M3), [0.0]
    ).mass
    air_kg = AIR_KG_M3 * VOLUME_M3
    assert mass.displaced_kg.sum() == pytest.approx(3 * air_kg)
    body_kg = 3 * (DENSITY_KG_M3 * VOLUME_M3 + 0.01)
    assert mass.damped_kg.sum() == pytest.approx(body_kg)
    assert mass.weight_kg.sum() == pytest.approx(body_kg - 3 * air_kg)
    assert mass.inertia_kg.sum() == pytest.approx(body_kg + 1.5 * air_kg)


def test_drag_is_the_gradient_of_its_dissipation_and_acts_at_the_surface_alone(rng):
    forces = Forces.from_experiment(
        hung_cube(3, (3, 3, 3), air_density_kg_m3=AIR_KG_M3), [0.0, 0.1]
    )
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
    assert Forces.from_experiment(static, [0.0]).air_drag is None
    vacuum = hung_cube(3, air_density_kg_m3="none")
    assert vacuum.air_density_kg_m3 == 0.0
    assert Forces.from_experiment(vacuum, [0.0]).air_drag is None


# What the air does to an estimate -----------------------------------------------------------------


NOISE_M = 2e-4


def recorded(drag: float, stated: float | str) -> Problem:
    """A cube in air with this multiple of the model's drag, described as in air of some density."""
    hung = hung_cube(40, air_density_kg_m3=AIR_KG_M3)

    def more_drag(x, v, at):
        speed = ca.sqrt(ca.sumsqr(v) + 1e-8)
        return -(drag - 1) * 0.125 * AIR_KG_M3 * at.area_m2 * speed * v

    force = cs.NodeForce.from_law(more_drag)
    body = cs.Body(hung.body.mesh, density_kg_m3=DENSITY_KG_M3, forces=[force])
    tracks = simulate(replace(hung, body=body), TRUTH, "midpoint", substeps=1).markers_m
    noise = NOISE_M * np.random.default_rng(0).standard_normal(tracks.shape)
    seen = with_markers(replace(hung, air_density_kg_m3=stated), tracks + noise)
    markers = replace(seen.markers, sigma_m=np.full(tracks.shape[1], NOISE_M))
    return Problem([replace(seen, markers=markers)], GUESS, substeps=1)


@dataclass(frozen=True)
class Estimated:
    """Statistical interval of γ_m without effects, and its budget of the rows of the air alone."""

    statistical95: tuple[float, float]
    line: BudgetLine


def estimated(described: Problem, deviations: Mapping[str, float] | None = None) -> Estimated:
    """Fit γ_m; deviations of the rows of the air are those of the table unless they are given."""
    solution = ReducedSpace(tolerance=1e-6)(described.collocation())
    collocation, z = solution.collocation, solution.z
    rows = [row for row in ASSUMPTIONS if row.name in OF_AIR]
    sizes = {row.name: (deviations or {}).get(row.name, row.considered) for row in rows}
    changes = changed_residuals(collocation, z, [(row, sizes[row.name]) for row in rows])
    fit, parameters = linearise_fit(collocation, z), collocation.parameters
    effects = Effects.from_changes(changes, sizes, {}, {})
    posterior = Posterior.from_fit(fit, effects, parameters, solution.q, AUTO)
    without = uncertainty_from_fit(fit, parameters, solution.q)
    interval = without.estimates[GAMMA_M].statistical95
    assert interval is not None
    return Estimated(interval, posterior.budget[GAMMA_M])


def width(interval: tuple[float, float]) -> float:
    return interval[1] - interval[0]


def holds(interval: tuple[float, float]) -> bool:
    return interval[0] <= TRUTH[GAMMA_M] <= interval[1]


def test_the_combined_interval_is_narrower_where_air_is_known():
    """The drag of the twin is 30 % above that of the model."""
    described = recorded(1.3, AIR_KG_M3)
    found = estimated(described)
    as_if_missing = estimated(described, dict.fromkeys(OF_AIR, 1.0))
    assert holds(found.line.combined95)
    assert width(found.line.combined95) < 0.7 * width(as_if_missing.line.combined95)
    assert next(iter(found.line.shares)) == "air_drag"


def test_omitted_air_makes_damping_too_large_and_the_budget_has_no_air():
    found = estimated(recorded(1.0, "none"))
    assert found.statistical95[0] > 1.05 * TRUTH[GAMMA_M]
    assert not set(OF_AIR) & set(found.line.shares)


@pytest.mark.long
def test_modelled_air_in_a_vacuum_makes_damping_too_small_within_the_budget():
    found = estimated(recorded(0.0, AIR_KG_M3))
    assert found.statistical95[1] < TRUTH[GAMMA_M]
    assert next(iter(found.line.shares)) == "air_drag"
    # All of the drag is 2.5 standard deviations of its coefficient.
    missing = estimated(recorded(0.0, AIR_KG_M3), {"air_drag": 1.0})
    assert holds(missing.line.combined95)


# What a user says and reads -----------------------------------------------------------------------


@pytest.mark.long
def test_air_is_part_of_the_model_unless_stated_otherwise():
    """In a process of its own: the tests of this one are in a vacuum by default."""
    script = (
        "import collocation_sysid as cs, numpy as np\n"
        "from collocation_sysid.problem.schema import EnvironmentSection\n"
        "from collocation_sysid.fem.meshes.structured import box_mesh\n"
        "body = cs.Body(box_mesh((.1,) * 3, (1,) * 3), density_kg_m3=30.0)\n"
        "grasp = cs.Grasp([0, 1, 2], cs.PoseSequence.fixed())\n"
        "seen = cs.Markers([0.0], [[[0.1, 0.1, 0.1]]], 1e-3, places_m=[[0.1, 0.1, 0.1]])\n"
        "hung = cs.Experiment(body, [0.0], [grasp], seen, kind='static')\n"
        "print(hung.air_density_kg_m3, EnvironmentSection().air_density_kg_m3)\n"
    )
    found = subprocess.run(
        [sys.executable, "-c", script], check=False, capture_output=True, text=True, timeout=120
    )
    assert found.returncode == 0, found.stderr
    assert found.stdout.split() == ["1.2", "1.2"]


def with_air(folder: Path, value: str) -> Path:
    """The problem of a folder with an environment; the path of its file."""
    file = folder / "problem.toml"
    environment = f"[environment]\nair_density_kg_m3 = {value}\n\n[solver]"
    file.write_text(file.read_text().replace("[solver]", environment))
    return file


@pytest.mark.parametrize(("value", "density"), [('"none"', 0.0), ("1.05", 1.05), ("0.0", 0.0)])
def test_a_problem_file_states_the_air_of_all_experiments(tiny, value, density):
    problem = Problem.read(with_air(tiny, value))
    assert [e.air_density_kg_m3 for e in problem.experiments] == [density]


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("-1.2", "environment.air_density_kg_m3: found -1.2; expected"),
        ('"no"', "environment.air_density_kg_m3: found 'no'; expected"),
        ("1000.0", "environment.air_density_kg_m3: the air has a density of 1000 kg/m³, and the "
                   "body of 30 kg/m³; expected air that is lighter"),
    ],
)  # fmt: skip
def test_air_that_cannot_be_is_refused(tiny, value, message):
    with_air(tiny, value)
    ended = run_command("check", "problem.toml")
    assert ended.code == 2
    assert message in " ".join(ended.err.split())


@pytest.mark.parametrize("value", [-1.0, np.nan, True, "vacuum"])
def test_air_that_cannot_be_is_refused_in_python(value):
    with pytest.raises(InputError, match=r"air_density_kg_m3 is .*; expected a density in kg/m³"):
        hung_cube(3, air_density_kg_m3=value)


def test_check_and_result_report_the_air_of_the_model(tiny):
    with_air(tiny, "1.1")
    assert "1.1 kg/m³ (buoyancy, added mass and drag)" in run_command("check", "problem.toml").out
    ended = run_command("solve", "problem.toml", "--json", *settings(*AT_TRUTH))
    assert ended.code == 0, ended.err
    (experiment,) = json.loads(ended.out)["fit"]["experiments"].values()
    assert experiment["air_density_kg_m3"] == 1.1
