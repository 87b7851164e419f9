"""User-defined forces on nodes, in every method and in a problem file."""

from __future__ import annotations

import json
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from kit.forces import forces_alone
from kit.problem_files import AT_TRUTH, both, replace_text, run_command, settings, write
from kit.problems import GUESS, TRUTH, hung_cube

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.fem.meshes.refinement import refine_body
from collocation_sysid.methods import METHODS
from collocation_sysid.program.simulation import simulate, with_markers
from collocation_sysid.recording import Experiment, Nuisance

DRAG = 40.0


def drag(x, v, at, drag_coefficient):
    """Of a thick fluid, so that it is felt: half its density, the share of the surface, speed."""
    return -5.0 * drag_coefficient * at.area_m2 * ca.sqrt(ca.sumsqr(v) + 1e-8) * v


def in_fluid(steps: int = 10, law=drag, **changes) -> Experiment:
    """A hung cube in a fluid, without what is unknown by default."""
    old = hung_cube(steps, nuisance=Nuisance.none())
    forces = [cs.NodeForce.from_law(law, cs.Constant("drag_coefficient", "c", usual=1.0))]
    body = cs.Body(old.body.mesh, density_kg_m3=30.0, forces=forces, **changes)
    return replace(old, body=body)


def parameters(guess: float) -> cs.Parameters:
    own = cs.Parameters.from_mapping({"drag_coefficient": cs.Unknown(guess)})
    return cs.Parameters((*GUESS.items, *own.items))


def seen(experiment: Experiment, integrator: str = "midpoint", sigma: float = 0.0) -> Experiment:
    values = {**TRUTH, "drag_coefficient": DRAG}
    tracks = simulate(experiment, values, integrator, substeps=1).markers_m
    noise = sigma * np.random.default_rng(4).normal(size=tracks.shape)
    return with_markers(experiment, tracks + noise)


@pytest.mark.long
@pytest.mark.parametrize("method", [m for m in METHODS if not m.startswith("casadi:")])
def test_every_method_finds_the_constant_of_a_users_force(method):
    problem = cs.Problem([seen(in_fluid())], parameters=parameters(25.0), method=METHODS[method]())
    found = cs.solve(problem)
    assert found.parameters["drag_coefficient"] == pytest.approx(DRAG, rel=5e-3)


def squeezed(x, v, at, squeeze_pa):
    """A pressure that comes and goes, along the normal of the face as it is."""
    return -squeeze_pa * ca.sin(40.0 * at.t_s) ** 2 * at.area_m2 * at.normal


@pytest.mark.parametrize("method", ["reduced-space", "interior-point"])
@pytest.mark.parametrize("element", ["tet4", "tet10"])
def test_a_users_pressure_on_faces_is_found(element, method):
    low = cs.Box((-1, -1, -1), (1, 1, 0.051))
    force = cs.NodeForce.from_law(squeezed, nodes=low, on="faces")
    mesh = hung_cube(2, (1, 1, 2)).body.mesh
    body = cs.Body(mesh, density_kg_m3=30.0, element=element, forces=[force])
    old = hung_cube(12)
    markers = cs.Markers(old.t_s, np.zeros((13, 2, 3)), 1e-4, places_m=[[0, 0, 0], [0.1, 0.1, 0]])
    top = cs.Box((-1, -1, 0.099), (1, 1, 1))
    made = cs.Experiment(
        body, old.t_s, [cs.Grasp(top, old.grasps[0].poses)], markers, nuisance=Nuisance.none()
    )
    truth = {**TRUTH, "squeeze_pa": 8.0}
    made = with_markers(made, simulate(made, truth, "midpoint", substeps=1).markers_m)
    unknown = {"mu_pa": cs.Unknown(200.0), "squeeze_pa": cs.Unknown(5.0)}
    problem = cs.Problem(
        [made], cs.Parameters.from_mapping({**truth, **unknown}), method=METHODS[method]()
    )
    found = cs.solve(problem).parameters
    assert found["squeeze_pa"] == pytest.approx(8.0, rel=1e-3)
    assert found["mu_pa"] == pytest.approx(TRUTH["mu_pa"], rel=1e-3)


def test_newmarks_rule_moves_it_alike():
    at = {**TRUTH, "drag_coefficient": DRAG}
    experiment = in_fluid()
    fine = simulate(experiment, at, "newmark", timestep_s=1e-3).markers_m
    ours = simulate(experiment, at, "midpoint", substeps=10).markers_m
    without = simulate(experiment, {**at, "drag_coefficient": 1e-6}, "midpoint", substeps=10)
    moved = np.abs(ours - without.markers_m).max()
    assert np.abs(ours - fine).max() < 2e-4 * moved
    assert moved > 2e-4


@pytest.mark.long
def test_its_interval_holds_the_truth_and_the_report_names_it():
    problem = cs.Problem([seen(in_fluid(20), sigma=1e-4)], parameters=parameters(25.0))
    run = cs.run(problem, seek_causes=False)
    low, high = run.interval("drag_coefficient")
    assert low < DRAG < high
    assert "drag_coefficient" in str(run)


def test_left_out_the_verdict_doubts_the_answer():
    experiment = seen(in_fluid(20), sigma=1e-5)
    still = replace(experiment, body=hung_cube().body)
    run = cs.run(cs.Problem([still], parameters=GUESS), seek_causes=False)
    assert run.trust.verdict != "good"


@pytest.mark.parametrize("element", ["tet4", "tet10"])
def test_on_a_finer_mesh_it_is_the_same_force(element):
    mesh = hung_cube().body.mesh
    body = cs.Body(mesh, density_kg_m3=30.0, element=element, forces=[cs.NodeForce.from_law(drag)])
    wind = np.array([0.3, -0.2, 0.5])
    theta = np.array([1e-9, 1e-9, 0.0, 0.0, DRAG])
    of_both = []
    for each in (body, refine_body(body)):
        moving = np.tile(wind, len(each.nodes_m))[None]
        total = forces_alone(each, theta).total(each.nodes_m.reshape(1, -1), moving.reshape(1, -1))
        of_both.append(total.reshape(-1, 3).sum(axis=0))
    expected = -5.0 * DRAG * 6 * 0.1**2 * np.linalg.norm(wind) * wind
    np.testing.assert_allclose(of_both, [expected, expected], rtol=1e-6)


# In a file ---------------------------------------------------------------------------------------

MINE = """
import casadi as ca

def drag(x, v, at, drag_coefficient):
    return -5.0 * drag_coefficient * at.area_m2 * ca.sqrt(ca.sumsqr(v) + 1e-8) * v

def lift(x, v, at, drag_coefficient):
    return drag_coefficient * ca.vertcat(v[1], -v[0], 0)

def wild(x, v, at, drag_coefficient):
    return -drag_coefficient * ca.sqrt(ca.sumsqr(v)) * v[:2]
"""
FORCE = """density_kg_m3 = 30.0
[[object.force]]
file = "mine.py"
function = "{}"
"""
FACES = """on = "faces"
nodes = { box_m = [[-1, -1, -1], [1, 1, 0.001]] }
"""
PARAMETER = "gamma_m_1_s = {"


def with_force(function: str = "drag"):
    return both(
        replace_text("density_kg_m3 = 30.0\n", FORCE.format(function)),
        replace_text(PARAMETER, f"drag_coefficient = {{ guess = 25.0 }}\n{PARAMETER}"),
    )


@pytest.mark.long
def test_a_force_in_a_file_is_simulated_and_identified(tiny):
    with_force()(tiny)
    write("mine.py", MINE)(tiny)
    truth = settings(*AT_TRUTH, "parameters.drag_coefficient.guess=40")
    code = ("problem.toml", "--allow-code", "--quiet")
    done = run_command("simulate", *code, *truth, "--integrator", "midpoint", "--out", "data")
    assert done.code == 0, done.err
    recorded = settings("experiment.0.markers.file=data/swing_markers.csv")
    assert run_command("solve", *code, *recorded, "--out", "found").code == 0
    result = json.loads((tiny / "found" / "result.json").read_text())
    found = result["parameters"]["drag_coefficient"]["optimum"]
    assert found == pytest.approx(40.0, rel=0.02)


def lift(x, v, at, spin_n_s_m4):
    """Across where the body goes, as on what spins."""
    return spin_n_s_m4 * at.volume_m3 * ca.cross(v, ca.vertcat(0.5, 1.0, -0.3))


@pytest.mark.parametrize("method", ["reduced-space", "interior-point"])
def test_a_force_across_the_velocity_is_found(method: str):
    old, truth = (hung_cube(12, nuisance=Nuisance.none()), {**TRUTH, "spin_n_s_m4": 400.0})
    body = cs.Body(old.body.mesh, density_kg_m3=30.0, forces=[cs.NodeForce.from_law(lift)])
    made = replace(old, body=body)
    seen = with_markers(made, simulate(made, truth, "midpoint", substeps=1).markers_m)
    unknown = {"spin_n_s_m4": cs.Unknown(150.0), "mu_pa": cs.Unknown(GUESS.items[0].guess)}
    problem = cs.Problem(
        [seen], cs.Parameters.from_mapping({**truth, **unknown}), method=METHODS[method]()
    )
    found = cs.solve(problem).parameters
    assert found["spin_n_s_m4"] == pytest.approx(400.0, rel=1e-3)
    fine = simulate(made, truth, "newmark", timestep_s=made.timestep_s / 8).markers_m
    coarse = simulate(made, truth, "midpoint", substeps=8).markers_m
    without = simulate(made, {**truth, "spin_n_s_m4": 0.0}, "midpoint", substeps=8).markers_m
    assert np.abs(fine - coarse).max() < 0.02 * np.abs(without - coarse).max()


@pytest.mark.parametrize(
    ("function", "said"),
    [
        ("wild", r"force 'wild' returns an expression of the shape \(2, 1\); expected \(3, 1\)"),
        ("gone", "there is no function 'gone'; expected one of drag, lift, wild"),
    ],
)
def test_an_invalid_force_term_is_one_message(tiny, function, said):
    with_force(function)(tiny)
    write("mine.py", MINE)(tiny)
    with pytest.raises(InputError, match=said):
        cs.Problem.read(tiny / "problem.toml", allow_code=True)


def test_a_force_on_faces_in_a_file_that_no_face_has_is_one_message(tiny):
    both(
        replace_text("density_kg_m3 = 30.0\n", FORCE.format("drag") + FACES),
        replace_text(PARAMETER, f"drag_coefficient = {{ guess = 25.0 }}\n{PARAMETER}"),
    )(tiny)
    write("mine.py", MINE)(tiny)
    assert run_command("check", "problem.toml", "--allow-code").code == 0
    replace_text("[-1, -1, -1]", "[0.05, 0.05, -1]")(tiny)
    done = run_command("check", "problem.toml", "--allow-code")
    assert done.code == 2
    assert "force 'drag' acts on faces of the surface, but no face has all" in " ".join(
        done.err.split()
    )


def test_a_force_is_not_run_unless_it_is_allowed(tiny):
    with_force()(tiny)
    write("mine.py", "raise SystemExit")(tiny)
    found = run_command("solve", "problem.toml")
    assert found.code == 2
    assert "object.force.0" in found.err
    assert "--allow-code" in found.err


def test_a_constant_that_the_body_has_is_refused():
    def mine(x, v, at, mu_pa):
        return -mu_pa * v

    with pytest.raises(
        InputError, match="'mu_pa', but another constant of the body has the same name"
    ):
        cs.Body(hung_cube().body.mesh, density_kg_m3=30.0, forces=[cs.NodeForce.from_law(mine)])


def test_a_law_that_is_not_finite_at_rest_is_refused():
    def mine(x, v, at, drag_coefficient):
        return -drag_coefficient * ca.sqrt(ca.sumsqr(v)) * v

    with pytest.raises(InputError, match="not finite for a node at rest"):
        cs.NodeForce.from_law(mine)
