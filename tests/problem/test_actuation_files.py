"""Tendons and pressures in problem files: accepted tables, messages and output."""

from __future__ import annotations

import json
from pathlib import Path

import meshio
import numpy as np
import pytest
from kit.actuation import box_with_cavity
from kit.problem_files import TRUTH, pictures_drawn, run_command
from kit.problems import smooth_poses, times

from collocation_sysid.errors import InputError
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.shape import EnclosedVolume
from collocation_sysid.problem import Problem
from collocation_sysid.recording import write_poses_csv
from collocation_sysid.result.synthesis import Recipe, write_data

PROBLEM = """\
title = "A driven box"

[object]
mesh = "box.vtu"
density_kg_m3 = 30.0

[parameters]
lambda_pa   = 200.0
mu_pa       = { guess = 200.0, lower = 10.0, upper = 1e5 }
gamma_r_s   = 0.009
gamma_m_1_s = 1.0

[rollout]
integrator = "scheme"

[[experiment]]
name = "drive"
nuisance = { gravity = "none", time_shift = "none", marker_offsets = "none", hand_eye = "none", \
tension_factor = { prior = 0.1 }, pressure_lost = { prior_pa = 1.0 } }
grasp = { nodes = { box_m = [[-1, -1, 0.029], [1, 1, 1]] }, poses = "motion.csv" }

[experiment.markers]
file = "drive_markers.csv"
reference_m = { low = [0.0, 0.0, 0.0], mid = [0.03, 0.01, 0.01], side = [0.01, 0.0, 0.0] }

[[experiment.tendon]]
points_m = [[0.003, 0.004, 0.03], [0.003, 0.004, 0.015], [0.003, 0.004, 0.0]]
tension = "tension.csv"

[[experiment.pressure]]
name = "air"
faces = { name = "wall" }
pressure_pa = 10.0
"""
TENSION = "t_s,tension_n\n0,0.001\n0.05,0.004\n"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A problem with exact data."""
    folder = tmp_path_factory.mktemp("driven")
    box_with_cavity().write(folder / "box.vtu")
    write_poses_csv(folder / "motion.csv", smooth_poses(times(5)))
    (folder / "tension.csv").write_text(TENSION)
    file = folder / "problem.toml"
    file.write_text(PROBLEM)
    at_truth = [f"parameters.mu_pa.guess={TRUTH['mu_pa']}", "transcription.substeps=1"]
    write_data(Problem.read(file, at_truth, simulation=True), folder, Recipe("midpoint"))
    return folder


@pytest.fixture
def driven(made, tmp_path) -> Path:
    """A copy of it, to be spoilt."""
    for file in made.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path


@pytest.mark.long
def test_a_driven_box_is_read_solved_and_shown(driven):
    (experiment,) = Problem.read(driven / "problem.toml").experiments
    assert [actuator.name for actuator in experiment.actuators] == ["tendon_1", "air"]
    np.testing.assert_allclose(experiment.tendons[0].energy_amplitude_at([0.025]), 0.0025)
    # The tension acts 5 % more than its file states, and 0.5 Pa of the pressure are lost.
    (driven / "tension.csv").write_text("t_s,tension_n\n0,0.00095238\n0.05,0.0038095\n")
    text = PROBLEM.replace("pressure_pa = 10.0", "pressure_pa = 10.5")
    text = text.replace('_markers.csv"', '_markers.csv"\nsigma_m = 1e-6')
    (driven / "problem.toml").write_text(text)
    with pictures_drawn():
        done = run_command("solve", driven / "problem.toml", "--out", driven / "run", "--details")
    assert done.code == 0, done.err
    said = " ".join(done.out.split())
    assert "tendon_1, more than stated by" in said
    assert "(prior ±10 %)" in said
    assert "air, lost" in said
    result = json.loads((driven / "run" / "result.json").read_text())
    assert result["parameters"]["mu_pa"]["optimum"] == pytest.approx(TRUTH["mu_pa"], rel=1e-3)
    assert "tendon_1, more than stated [1]" in result["nuisance"]["drive"]
    assert list((driven / "run").glob("**/mesh.*"))
    shown = run_command("report", driven / "run", "--to", driven / "page.html")
    assert shown.code == 0, shown.err
    assert "tendon_1, more than stated" in (driven / "page.html").read_text()


def test_a_group_of_triangles_is_the_wall(driven):
    body = Problem.read(driven / "problem.toml").experiments[0].body
    volume = (
        body and Problem.read(driven / "problem.toml").experiments[0].pressures[0].require_measure()
    )
    assert isinstance(volume, EnclosedVolume)
    cells = [("tetra", body.mesh.tetrahedra), ("triangle", volume.faces)]
    on_wall = [np.zeros(len(body.cells), int), np.ones(12, int)]
    mesh = meshio.Mesh(body.mesh.points_m, cells, cell_data={"cavity": on_wall})
    mesh.write(driven / "grouped.vtu")
    read = TetMesh.read(driven / "grouped.vtu")
    assert read.face_sets["cavity"].shape == (12, 3)
    text = PROBLEM.replace("box.vtu", "grouped.vtu").replace('"wall"', '"cavity"')
    (driven / "problem.toml").write_text(text)
    again = Problem.read(driven / "problem.toml").experiments[0].pressures[0].require_measure()
    at = body.nodes_m.reshape(1, -1)
    assert again.evaluate(at)[0] == pytest.approx(volume.evaluate(at)[0], rel=1e-12)


TENDON = PROBLEM[PROBLEM.index("[[experiment.tendon]]") : PROBLEM.index("[[experiment.pressure]]")]
SLIPS = {
    "no column": (
        ("tension.csv", "t_s,tension\n0,1\n1,1\n"),
        "column tension names no unit; .*for example tension \\(N\\)",
    ),
    "other unit": (("tension.csv", "t_s,tension_kg\n0,1\n1,1\n"), "a unit of force, one of N, mN"),
    "pushes": (("tension.csv", "t_s,tension_n\n0,1\n1,-2\n"), "line 3.*a tendon only pulls"),
    "raw": (("tension.csv", "t_s,tension_n\n0,1\n1,9e7\n"), "too large for a soft body"),
    "back in time": (("tension.csv", "t_s,tension_n\n1,1\n0,1\n"), "line 3.*must increase"),
    "blank": (("tension.csv", "t_s,tension_n\n0,1\n1,\n"), "line 3.*holds ''"),
    "empty": (("tension.csv", ""), "is empty"),
    "other clock": (
        ("tension.csv", "t_s,tension_n\n100,1\n101,1\n"),
        "tendon_1 is given from 100 s to 101 s, but the recording lasts from 0 s to 0.05 s",
    ),
    "no file": ((TENDON, TENDON.replace("tension.csv", "t.csv")), "t.csv does not exist"),
    "both": (
        (TENDON, TENDON.replace('"tension.csv"', '"tension.csv"\ntension_n = 1.0')),
        "found tension_n and tension; expected exactly one",
    ),
    "neither": ((TENDON, TENDON.replace('tension = "tension.csv"', "")), "expected exactly one"),
    "one point": (("[0.003, 0.004, 0.015], [0.003, 0.004, 0.0]", ""), r"tendon\.0\.points_m"),
    "millimetres": (("[0.003, 0.004, 0.015]", "[3, 4, 15]"), "point 2 at .* m outside the body"),
    "name twice": (('name = "air"', 'name = "tendon_1"'), "two tendons or pressures are called"),
    "no wall": (('"wall" }', '"cavity" }'), 'no group of faces "cavity"; it has "wall"'),
    "whole surface": (
        ('{ name = "wall" }', "{ box_m = [[-1, -1, -1], [1, 1, 1]] }"),
        "the faces are the outer surface of the body",
    ),
    "open": (
        ('{ name = "wall" }', "{ box_m = [[-1, -1, -1], [1, 1, 0.001]] }"),
        "the faces are not closed, and 12 of the 12 edges of their rim move",
    ),
    "negative prior": (("prior_pa = 1.0", "prior_pa = -1.0"), "pressure_lost.prior_pa"),
}


@pytest.mark.parametrize("slip", SLIPS)
def test_a_slip_is_explained(driven, slip):
    (place, text), message = SLIPS[slip]
    file = driven / "problem.toml"
    if place.endswith(".csv"):
        (driven / place).write_text(text)
    else:
        assert place in PROBLEM
        file.write_text(PROBLEM.replace(place, text))
    with pytest.raises(InputError, match=message):
        Problem.read(file)
