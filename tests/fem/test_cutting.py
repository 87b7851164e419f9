"""Nodes of a mesh in the planes where grasps end."""

from __future__ import annotations

import meshio
import numpy as np
import pytest
from kit.problem_files import replace_text, write_problem
from kit.problems import times, vertex_markers

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes import surface
from collocation_sysid.fem.meshes.checks import boundary_of, mean_ratios
from collocation_sysid.fem.meshes.cutting import with_nodes_in_planes
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.selection import Box
from collocation_sysid.fem.meshes.structured import box_mesh, cylinder_mesh
from collocation_sysid.model.forces import Forces
from collocation_sysid.problem import Problem
from collocation_sysid.program.modes.natural import natural_modes
from collocation_sysid.recording import Experiment, Grasp, PoseSequence
from collocation_sysid.runs.facts import facts

LENGTH_M = 0.1
END_M = 0.075  # of the gripper, which holds the part above


def irregular_rod(rings: int = 2) -> TetMesh:
    """A round rod whose nodes are at random heights, except at its ends."""
    mesh = cylinder_mesh(0.01, LENGTH_M, rings, 8)
    points = mesh.points_m.copy()
    inner = (points[:, 2] > 1e-6) & (points[:, 2] < LENGTH_M - 1e-6)
    points[inner, 2] += np.random.default_rng(0).uniform(-0.004, 0.004, inner.sum())
    return TetMesh(points, mesh.tetrahedra)


def first_frequency_hz(mesh: TetMesh) -> float:
    body = Body(mesh, density_kg_m3=1000.0, element="tet10")
    t_s = times(3)
    held = Grasp(Box((-1, -1, END_M), (1, 1, 1)), PoseSequence.fixed())
    experiment = Experiment(body, t_s, [held], vertex_markers(body, [0], t_s))
    forces = Forces.from_experiment(experiment, t_s[:1], [1e5, 5e4, 0.0, 0.0])
    modes = natural_modes(forces, body.nodes_m, free_dofs=experiment.free_dofs, count=1)
    return float(modes.frequencies_hz[0])


def test_no_element_crosses_a_plane_and_the_body_keeps_its_shape():
    mesh = irregular_rod()
    planes_m = {"x": [0.002], "z": [0.03, 0.034, END_M]}
    points, tetrahedra = with_nodes_in_planes(mesh.points_m, mesh.tetrahedra, planes_m)
    for axis, coordinates_m in planes_m.items():
        along_m = points[tetrahedra, "xyz".index(axis)]
        for plane_m in coordinates_m:
            beside = (along_m.min(axis=1) < plane_m - 1e-9) & (along_m.max(axis=1) > plane_m + 1e-9)
            assert not beside.any()
    cut = TetMesh(points, tetrahedra)
    assert cut.notes == ()  # no element is degenerate or reversed
    assert cut.volume_m3 == pytest.approx(mesh.volume_m3, rel=1e-3)
    # Two halves of an element that had other neighbours than each other would show as new surface.
    areas = [
        np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
        for a, b, c in (
            m.points_m[boundary_of(m.tetrahedra)[0]].swapaxes(0, 1) for m in (mesh, cut)
        )
    ]
    assert areas[1] == pytest.approx(areas[0], rel=1e-3)


def test_a_plane_through_nodes_or_beside_the_end_of_the_body_changes_nothing():
    mesh = box_mesh((0.1, 0.04, 0.04), (5, 2, 2))
    planes_m = {"x": [-1.0, 0.04, 0.098], "y": [0.02, 0.001], "z": [0.04, 1.0]}
    points, tetrahedra = with_nodes_in_planes(mesh.points_m, mesh.tetrahedra, planes_m)
    np.testing.assert_allclose(points, mesh.points_m, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(tetrahedra, mesh.tetrahedra)


def test_moved_nodes_make_better_elements_than_cuts_alone(monkeypatch):
    mesh = irregular_rod()
    qualities = []
    for near in (0.35, 0.0):
        monkeypatch.setattr("collocation_sysid.fem.meshes.cutting.NEAR", near)
        made = with_nodes_in_planes(mesh.points_m, mesh.tetrahedra, {"z": [END_M]})
        qualities.append(mean_ratios(*made).min())
    assert qualities[0] > 1.5 * qualities[1]


def test_the_free_length_is_that_of_the_gripper_and_not_of_the_mesh():
    right_hz = first_frequency_hz(cylinder_mesh(0.01, LENGTH_M, 1, 8))  # a layer of it ends there
    mesh = irregular_rod(rings=1)
    made = with_nodes_in_planes(mesh.points_m, mesh.tetrahedra, {"z": [END_M]})
    assert first_frequency_hz(TetMesh(*made)) == pytest.approx(right_hz, rel=0.005)
    assert first_frequency_hz(mesh) < 0.95 * right_hz


def test_the_body_of_a_scan_is_held_up_to_the_box_of_its_grasp(tmp_path, monkeypatch):
    file = write_problem(tmp_path, {"swing": 4})
    mesh = TetMesh.read(tmp_path / "body.vtu")
    meshio.write(tmp_path / "body.stl", meshio.Mesh(mesh.points_m, [("triangle", mesh.surface)]))
    monkeypatch.setattr(surface, "run_ftetwild", lambda *_, **__: (mesh.points_m, mesh.tetrahedra))
    monkeypatch.setattr(surface, "version", lambda name: "0")
    replace_text('mesh = "body.vtu"', 'surface = "body.stl"\nedge_length_m = 0.03')(tmp_path)
    replace_text("0.089", "0.047")(tmp_path)  # the layers of nodes are 30 mm apart
    (experiment,) = Problem.read(file).experiments
    (held,) = experiment.grasps
    free_m = np.delete(experiment.body.nodes.points_m, held.nodes, axis=0)
    assert experiment.body.nodes.points_m[held.nodes, 2].min() == 0.047
    assert free_m[:, 2].max() < 0.047
    assert not facts(Problem.read(file))
