"""Obstacles in problem files: accepted tables, messages and defaults."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from kit.problem_files import run_command
from kit.problems import TRUTH, as_theta, pressed_cube

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.model.contact.force import contact_terms
from collocation_sysid.model.contact.summary import surface_gaps_and_pressures
from collocation_sysid.model.force_term import States
from collocation_sysid.recording import write_markers_csv, write_poses_csv, write_wrench_csv
from collocation_sysid.result.pictures.shapes import obstacle_pictures
from collocation_sysid.result.replay import MotionRecord

PROBLEM = """
[object]
mesh = "cube.vtu"
density_kg_m3 = 30.0

[parameters]
lambda_pa = 400.0
mu_pa = 150.0
gamma_r_s = 0.02
gamma_m_1_s = 0.5
{parameter}

[[experiment]]
name = "pressed"

[experiment.nuisance]
obstacle = {{ prior_m = 0.0002, prior_rad = 0.01 }}
marker_offsets = "none"

[experiment.grasp]
nodes = {{ box_m = [[-1, -1, -1], [1, 1, 0.001]] }}

[[experiment.obstacle]]
name = "ball"
shape = {{ {ball} }}
poses = "ball.csv"
friction = {friction}
force = {{ file = "force.csv", sigma_n = 0.3 }}

[[experiment.obstacle]]
shape = {{ plane = {{ normal = [1, 0, 0], point_m = [-0.002, 0, 0] }} }}
stiffness_pa_m = 4e4

[experiment.markers]
file = "markers.csv"
reference_m = {{ m1 = [0, 0, 0.1], m2 = [0.1, 0, 0.1] }}
"""
BALL = "sphere_m = { radius_m = 0.05, centre_m = [0.05, 0.05, 0.152] }"


def written(folder: Path, ball: str = BALL, friction: str = '"ball_friction"') -> Path:
    """The pressed cube as a problem file."""
    cube = pressed_cube(5)
    cube.body.mesh.write(folder / "cube.vtu")
    write_poses_csv(folder / "ball.csv", cube.obstacles[0].poses)
    resting = np.broadcast_to([[0.0, 0.0, 0.1], [0.1, 0.0, 0.1]], (6, 2, 3))
    write_markers_csv(folder / "markers.csv", cube.t_s, ["m1", "m2"], resting)
    write_wrench_csv(folder / "force.csv", cube.t_s, np.full((6, 3), 0.05))
    parameter = "ball_friction = { guess = 0.4 }" if "friction" in friction else ""
    content = PROBLEM.format(ball=ball, friction=friction, parameter=parameter)
    (folder / "problem.toml").write_text(content)
    return folder / "problem.toml"


def test_a_file_describes_obstacles(tmp_path: Path):
    problem = cs.Problem.read(written(tmp_path), simulation=True)
    (experiment,) = problem.experiments
    ball, wall = experiment.obstacles
    assert (ball.name, wall.name) == ("ball", "obstacle 2")
    assert isinstance(ball.shape, cs.Sphere)
    assert ball.shape.radius_m == 0.05
    np.testing.assert_allclose(wall.shape.offset_direction, [1, 0, 0])
    assert wall.stiffness_pa_m == 4e4
    assert ball.wrench is not None
    assert ball.wrench.sigma_n == 0.3
    friction = problem.parameters.items[-1]
    assert (friction.name, friction.lower, friction.upper) == ("ball_friction", 0.0, 2.0)
    (transcription,) = problem.collocation().transcriptions
    labels = [name.partition(": ")[2] for name in transcription.nuisance.names]
    assert [label for label in labels if "ball" in label or "obstacle" in label] == [
        "place of ball [m]",
        "place of obstacle 2 [m]",
        "tilt of obstacle 2, first [rad]",
        "tilt of obstacle 2, second [rad]",
    ]


@pytest.mark.parametrize(
    ("ball", "friction", "message"),
    [
        ("ball_m = [0, 0, 0, 1]", "0.3", "ball_m"),
        (f"{BALL}, plane = {{}}", "0.3", "found plane and sphere_m; expected exactly one of"),
        ("sphere_m = { radius_m = -0.05 }", "0.3", "radius_m"),
        ("capsule_m = { radius_m = 0.01, ends_m = [[0, 0, 0]] }", "0.3", "ends_m"),
        (BALL, "2.5", "friction of ball is 2.5; expected 0 to 2"),
        (BALL, '"mu_pa"', "expected a number, or the name of a parameter that ends with friction"),
        (BALL, '"table_friction"', "did you mean 'table_friction'"),
    ],
)
def test_invalid_obstacles_are_refused(tmp_path: Path, ball: str, friction: str, message: str):
    with pytest.raises(InputError, match=message):
        cs.Problem.read(written(tmp_path, ball, friction), simulation=True)


@pytest.mark.parametrize("command", ["check", "solve"])
def test_friction_is_refused_beside_complementarity_before_anything_is_done(
    tmp_path: Path, command: str
):
    keys = ("solver.method=interior-point", "solver.interior-point.contact=complementarity")
    arguments = [command, str(written(tmp_path)), *(w for k in keys for w in ("--set", k))]
    before = sorted(tmp_path.iterdir())
    outcome = run_command(*arguments)
    assert outcome.code == 2
    said = " ".join(outcome.err.split())
    assert "experiment 'pressed': ball has friction, which contact = \"complementarity\"" in said
    assert 'expected friction = 0, or contact = "energy"' in said
    assert sorted(tmp_path.iterdir()) == before


def test_two_obstacles_have_two_names():
    cube = pressed_cube(3)
    held, ball, plate = cube.grasps
    with pytest.raises(InputError, match="two obstacles are called 'ball'"):
        replace(cube, grasps=[held, ball, replace(plate, name="ball")])


def test_a_plane_whose_normal_points_away_from_the_body_is_refused():
    cube = pressed_cube(3)
    held, ball, plate = cube.grasps
    behind = replace(plate, shape=cs.Plane((-1, 0, 0), (0, 0, 0)))
    with pytest.raises(InputError, match="inside 'plate', by up to 100 mm; expected it outside"):
        replace(cube, grasps=[held, ball, behind])
    # Where it is before it acts does not matter, and need not be known.
    later = cs.PoseSequence(cube.t_s[1:], np.zeros((3, 3)), np.tile([0, 0, 0, 1.0], (3, 1)))
    replace(cube, grasps=[held, ball, replace(behind, poses=later, from_s=cube.t_s[1])])


def test_a_body_keeps_its_nodes_and_mass_and_its_obstacles_come_last():
    cube = pressed_cube(3)
    plain = replace(cube, grasps=cube.body_grasps)
    assert plain.body.frames.size == 0
    assert cube.body.mass_kg == plain.body.mass_kg
    nodes = len(plain.body.nodes_m)
    np.testing.assert_array_equal(cube.body.frames.ravel(), nodes + np.arange(8))
    shuffled = replace(cube, grasps=[cube.grasps[k] for k in (2, 0, 1)])
    assert [type(grasp).__name__ for grasp in shuffled.grasps] == ["Grasp", "Obstacle", "Obstacle"]
    assert replace(cube, name="again").body is cube.body


SOLIDS = {
    "plane": cs.Plane((0.0, 0.6, 0.8), (0.01, 0.02, 0.03)),
    "sphere": cs.Sphere(0.02, (0.01, 0.0, 0.05)),
    "cylinder": cs.Cylinder(0.01, [[0, 0, 0], [0.05, 0, 0.02]]),
    "capsule": cs.Capsule(0.01, [[0, 0, 0], [0.05, 0, 0.02]]),
    "cuboid": cs.Cuboid([[0, 0, 0], [0.05, 0.03, 0.02]]),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_an_outline_is_on_the_surface(name: str):
    solid, point = SOLIDS[name], ca.SX.sym("point", 3)
    gap = ca.Function("gap", [point], [solid.signed_distance(point)])
    points_m = np.concatenate(solid.outline_polylines(np.array([0.05, 0.05, 0.05]), 0.1))
    assert len(points_m) > 3
    assert max(abs(float(gap(each))) for each in points_m) < 1e-9


def test_pictures_keep_the_outlines_of_obstacles():
    cube = pressed_cube(4)
    seen = MotionRecord.from_experiment(cube)
    assert seen.obstacles_m is not None
    ball = cube.obstacles[0]
    circles = seen.obstacles_m[:, : 3 * 34]
    centres = ball.poses.at(cube.t_s)[1] + ball.shape.centre_m
    distance_m = np.linalg.norm(circles - centres[:, None], axis=2)
    np.testing.assert_allclose(distance_m[np.isfinite(distance_m)], ball.shape.radius_m)
    kept = MotionRecord.from_arrays(cube.name, seen.to_arrays())
    np.testing.assert_array_equal(kept.obstacles_m, seen.obstacles_m)
    assert MotionRecord.from_experiment(replace(cube, grasps=cube.body_grasps)).obstacles_m is None


def test_pictures_show_where_something_presses_and_how_far_the_rest_is(tmp_path: Path):
    both, theta = pressed_cube(4), as_theta(TRUTH)
    held, _, plate = both.grasps
    cube = replace(both, grasps=[held, plate])
    motion = cs.simulate(cube, TRUTH, "bdf2", substeps=1)
    x = motion.positions_m.reshape(len(motion.t_s), -1)
    touched = gaps_m, pressures_pa = surface_gaps_and_pressures(cube, theta, x)
    (term,) = contact_terms(cube)
    force = term.force(States(x, np.zeros_like(x), theta)).reshape(len(x), -1, 3)
    own, surface = cube.body.mesh.points_m, cube.body.mesh.surface
    areas_m2 = np.linalg.norm(
        np.cross(own[surface[:, 1]] - own[surface[:, 0]], own[surface[:, 2]] - own[surface[:, 0]]),
        axis=1,
    )
    given_n = np.linalg.norm(force[:, : len(own)].sum(axis=1), axis=1)
    assert given_n[-1] > 0
    np.testing.assert_allclose(pressures_pa @ areas_m2 / 2, given_n, rtol=1e-9)
    assert np.all(gaps_m[pressures_pa == 0] >= term.law_of_contact.largest_width_m)
    seen = MotionRecord.from_experiment(
        cube,
        (motion.positions_m, motion.markers_m),
        recorded=dict(zip(("gaps_m", "pressures_pa"), touched, strict=True)),
    )
    kept = MotionRecord.from_arrays(cube.name, seen.to_arrays())
    assert set(obstacle_pictures(kept)) == {"pressure", "gap"}
    assert obstacle_pictures(MotionRecord.from_experiment(cube)) == {}


def test_recordings_with_other_obstacles_are_of_one_body():
    cube = pressed_cube(4)
    fewer = replace(cube, grasps=cube.grasps[:2], name="fewer")
    both = [MotionRecord.from_experiment(each).to_arrays(f"{each.name}/") for each in (cube, fewer)]
    stored = both[0] | both[1]
    assert MotionRecord.from_arrays("fewer", stored).is_prescribed.shape[1] == len(
        cube.body.mesh.points_m
    )
