"""A user-defined force with an internal variable."""

from __future__ import annotations

import inspect
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from kit.problem_files import replace_text, run_command, write
from kit.problems import TRUTH, hung_cube
from scipy.integrate import solve_ivp

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.methods import METHODS
from collocation_sysid.program.forward.initial_equilibrium import equilibrium
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Nuisance

SPRING_N_M, CREEP_S = 3.0, 0.03
STATED = {**TRUTH, "spring_n_m": SPRING_N_M, "creep_s": CREEP_S}


def maxwell(x, v, before, at, spring_n_m, creep_s):
    """A spring and a dashpot in series, to the ground: the joint between goes after the node.

    ds/dt = (x − s) / τ by the trapezoidal rule; what is carried is where s and x were.
    """
    joint, last = before[:3], before[3:]
    half = at.interval_s / (2 * creep_s)
    moved = ((1 - half) * joint + half * (last + x)) / (1 + half)
    joint = at.is_start * x + (1 - at.is_start) * moved
    return -spring_n_m * (x - joint), ca.vertcat(joint, x)


def tied(steps: int = 12, **changes) -> Experiment:
    """A hung cube, one corner of which such an element holds."""
    old = hung_cube(steps, (1, 1, 1), nuisance=Nuisance.none(), **changes)
    corner = np.flatnonzero(np.abs(old.body.nodes_m).sum(axis=1) < 1e-9)
    force = cs.NodeForce.from_law(maxwell, nodes=corner, carries=6)
    return replace(old, body=cs.Body(old.body.mesh, density_kg_m3=30.0, forces=[force]))


def integrated(experiment: Experiment) -> np.ndarray:
    """Positions (T, 3n) by another hand: one ODE of positions, velocities and the joint."""
    body, grasp, t_s = experiment.body, experiment.grasps[0], experiment.t_s
    theta, mass = body.theta_from_values(STATED), np.repeat(body.node_mass, 3)
    held = np.isin(np.repeat(np.arange(len(body.nodes_m)), 3), grasp.nodes)
    free, count = ~held, int((~held).sum())
    corner = 3 * int(np.abs(body.nodes_m).sum(axis=1).argmin()) + np.arange(3)
    weight = (body.node_mass[:, None] * experiment.gravity_m_s2).ravel()

    def whole(t: float, of_free: np.ndarray) -> np.ndarray:
        x = np.empty(len(held))
        x[held], x[free] = (grasp.positions_at(body.nodes_m, [t]).ravel(), of_free)
        return x

    def rates(t: float, y: np.ndarray) -> np.ndarray:
        x, joint, v = whole(t, y[:count]), y[2 * count :], np.zeros(len(held))
        v[held] = ((whole(t + 1e-6, y[:count]) - whole(t - 1e-6, y[:count])) / 2e-6)[held]
        v[free] = y[count : 2 * count]
        force = body.force(x, v, theta)[0] + weight
        force[corner] -= SPRING_N_M * (x[corner] - joint)
        return np.concatenate([v[free], (force / mass)[free], (x[corner] - joint) / CREEP_S])

    x = equilibrium(experiment, theta)
    start = np.concatenate([x[free], np.zeros(count), x[corner]])
    found = solve_ivp(rates, t_s[[0, -1]], start, "DOP853", t_s, rtol=1e-9, atol=1e-11)
    return np.array([whole(t, y) for t, y in zip(t_s, found.y[:count].T, strict=True)])


@pytest.mark.long
def test_motions_are_those_of_the_same_equations_solved_by_another_hand():
    experiment = tied()
    expected, off = integrated(experiment), []
    for integrator, steps in (("midpoint", (4, 8)), ("bdf2", (8, 16)), ("newmark", (4, 8))):
        for count in steps:
            step = experiment.timestep_s / count
            own: dict[str, Any] = (
                {"timestep_s": step} if integrator == "newmark" else {"substeps": count}
            )
            found = simulate(experiment, STATED, integrator, **own)
            off.append(np.abs(found.positions_m.reshape(expected.shape) - expected).max())
    without = simulate(experiment, {**STATED, "spring_n_m": 1e-9}, "midpoint", substeps=4)
    felt = np.abs(without.positions_m.reshape(expected.shape) - expected).max()
    for coarse, fine in zip(off[::2], off[1::2], strict=True):
        assert fine < 0.27 * coarse, "not of second order"
        assert fine < 0.002 * felt


@pytest.mark.long
@pytest.mark.parametrize("method", [m for m in METHODS if not m.startswith("casadi:")])
def test_every_method_finds_its_constants(method: str):
    made = tied(20)
    made = with_markers(made, simulate(made, STATED, "midpoint", substeps=1).markers_m)
    own = {"spring_n_m": cs.Unknown(2.0), "creep_s": cs.Unknown(0.04)}
    problem = cs.Problem([made], cs.Parameters.from_mapping(STATED | own), method=METHODS[method]())
    found = cs.solve(problem).parameters
    assert found["spring_n_m"] == pytest.approx(SPRING_N_M, rel=5e-3)
    assert found["creep_s"] == pytest.approx(CREEP_S, rel=5e-3)


def test_a_law_that_leaves_something_else_is_refused_in_words():
    def pull(x, v, before, at, pull_n):
        return -pull_n * x, before[:2]

    with pytest.raises(InputError, match="'pull' returns 2 internal variables; expected 3"):
        cs.NodeForce.from_law(pull, carries=3)
    with pytest.raises(
        InputError, match="returns the three components of a force, and of the new internal"
    ):
        cs.NodeForce.from_law(lambda x, v, before, at, pull_n: -pull_n * x, carries=2, name="pull")


# In a file ----------------------------------------------------------------------------------------

FORCE = """density_kg_m3 = 30.0
[[object.force]]
file = "mine.py"
function = "maxwell"
nodes = { box_m = [[-1, -1, -1], [0.001, 0.001, 0.001]] }
carries = 6
"""
MADE = """
from collocation_sysid import NodeForce

made = NodeForce.from_law(lambda x, v, b, at, pull_n: (-pull_n * x, b), carries=3)
"""
CONSTANTS = "spring_n_m = { guess = 2.0 }\ncreep_s = { guess = 0.04 }\ngamma_m_1_s = {"


@pytest.fixture
def strutted(tiny: Path) -> Path:
    """A problem whose force stands in a file."""
    replace_text("density_kg_m3 = 30.0\n", FORCE)(tiny)
    replace_text("gamma_m_1_s = {", CONSTANTS)(tiny)
    write("mine.py", f"import casadi as ca\n\n\n{inspect.getsource(maxwell)}")(tiny)
    return tiny


def test_a_strut_from_a_file_is_the_one_from_python(strutted):
    read = cs.Problem.read(strutted / "problem.toml", allow_code=True)
    (experiment,) = read.experiments
    force = cs.NodeForce.from_law(maxwell, nodes=[0], carries=6)
    body = cs.Body(experiment.body.mesh, density_kg_m3=30.0, forces=[force])
    made = replace(experiment, body=body)
    found, same = (
        simulate(each, STATED, "midpoint", substeps=1).markers_m for each in (experiment, made)
    )
    np.testing.assert_array_equal(found, same)
    assert np.abs(found - experiment.markers.positions_m).max() > 1e-3, "it does nothing"
    recorded = replace(read, experiments=[with_markers(experiment, found)])
    answer = cs.solve(replace(recorded, method=METHODS["reduced-space"]())).parameters
    assert answer["creep_s"] == pytest.approx(CREEP_S, rel=5e-3)


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (
            ("carries = 6", "carries = 2.5"),
            "object.force.0.carries: found 2.5; expected a whole number",
        ),
        (
            ("carries = 6", "carries = -1"),
            "object.force.0.carries: found -1; expected a number of at least 0",
        ),
        (
            ("carries = 6", "carries = 4"),
            "force 'maxwell' returns 6 internal variables; expected 4",
        ),
        (("carries = 6\n", ""), "force 'maxwell': the function has an argument between v and `at`"),
        (('"maxwell"', '"made"'), "object.force.0.carries: found 6, but the force 'made' has "),
    ],
)
def test_invalid_internal_variables_of_a_force_are_one_message(strutted, edit, said):
    replace_text(*edit)(strutted)
    write("mine.py", (strutted / "mine.py").read_text() + MADE)(strutted)
    done = run_command("check", "problem.toml", "--allow-code")
    assert done.code == 2
    assert said in " ".join(done.err.split())


def test_an_obstacle_that_is_not_touched_does_not_change_the_reference_motion():
    """Its force precedes the user's among the terms, and is apart while a step is solved."""
    experiment = tied()
    far = cs.Obstacle(shape=cs.Plane((0.0, 0.0, 1.0), (0.0, 0.0, -9.0)))
    beside = replace(experiment, grasps=[*experiment.grasps, far])
    alone, both = (simulate(each, STATED, "newmark").positions_m for each in (experiment, beside))
    np.testing.assert_allclose(both[:, : alone.shape[1]], alone, rtol=0, atol=1e-12)
