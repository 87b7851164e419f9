"""Warnings of grasps whose nodes end before the box that selects them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problems import times, vertex_markers

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.selection import Box
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.model.parameters import Unknown
from collocation_sysid.problem import Problem, UncertaintyOptions
from collocation_sysid.recording import Experiment, Grasp, PoseSequence
from collocation_sysid.runs.check import check_problem
from collocation_sysid.runs.facts import facts, grasp_gaps
from collocation_sysid.statistics.budget.systematic_effects import Assumptions

# A cube of 100 mm with layers of nodes every 20 mm along z.
CUBE = Body(box_mesh((0.1, 0.1, 0.1), (1, 1, 5)), density_kg_m3=30.0)


def held_above(height_m: float, axes: str = "xyz", support: str = "", body: Body = CUBE) -> Problem:
    """A problem with a cube whose nodes above a height are held along `axes`, and those of the
    lowest layer along the axes of `support`.
    """
    t_s = times(3)
    box = Box((-1, -1, height_m), (1, 1, 1))
    grasps = [Grasp(box, PoseSequence.fixed(), axes=axes)]
    if support:
        lowest = Box((-1, -1, -1), (1, 1, 0.001))
        grasps.append(Grasp(lowest, PoseSequence.fixed(), axes=support))
    experiment = Experiment(body, t_s, grasps, vertex_markers(body, [0], t_s), name="cube")
    unknown = Unknown(1000.0, 10.0, 1e5)
    return Problem(
        [experiment],
        {"lambda_pa": unknown, "mu_pa": unknown, "gamma_r_s": 0.01, "gamma_m_1_s": 1.0},
    )


@pytest.mark.parametrize(
    ("height_m", "gap_mm"),
    [
        (0.075, 5.0),
        (0.0791, 0.9),
        # 0.3 mm are less than 0.5 % of the free 80 mm.
        (0.0797, None),
        (0.08, None),
        # A box around the highest layer alone, with a margin.
        (0.09, None),
        # Everything is held along z.
        (-1.0, None),
    ],
)
def test_a_box_that_ends_beyond_its_nodes_is_reported(height_m, gap_mm):
    concerns = facts(held_above(height_m))
    assert [each.code for each in concerns] == (["description/grasp-extent"] if gap_mm else [])
    for concern in concerns:
        assert concern.grade == "check"
        assert f"ends {gap_mm:.3g} mm beyond" in concern.message
        assert "of the free length of 80 mm" in concern.message


@pytest.mark.parametrize("element", ["tet4", "tet10"])
def test_a_held_part_that_ends_raggedly_is_as_short_as_its_volume(rng, element):
    """Single nodes are close to the face of the box, but elements end up to an edge before it."""
    mesh = box_mesh((0.1, 0.1, 0.1), (6, 6, 6))
    inside = (mesh.points_m[:, 2] > 0.01) & (mesh.points_m[:, 2] < 0.09)
    points_m = mesh.points_m.copy()
    points_m[inside, 2] += rng.uniform(-0.006, 0.006, inside.sum())
    body = Body(TetMesh(points_m, mesh.tetrahedra), element=element, density_kg_m3=30.0)
    height_m = 0.0635
    corners_m = points_m[mesh.tetrahedra]
    held = corners_m[(corners_m[:, :, 2] > height_m).all(axis=1)]
    volume_m3 = np.abs(np.linalg.det(held[:, 1:] - held[:, :1])).sum() / 6
    assert points_m[points_m[:, 2] > height_m, 2].min() < height_m + 0.001
    problem = held_above(height_m, body=body)
    ((_, gap_m, _),) = grasp_gaps(problem.experiments[0], problem.experiments[0].body_grasps[0])
    assert gap_m == pytest.approx(0.1 - height_m - volume_m3 / 0.01, rel=0.1)


def test_planes_of_symmetry_and_platens_are_no_grippers():
    free_along_y = held_above(0.075, axes="xz", support="y")
    assert facts(free_along_y) == []


def test_the_extent_of_a_simulated_grasp_is_a_note():
    problem = held_above(0.075)
    simulated = replace(
        problem, uncertainty=UncertaintyOptions(assumptions=Assumptions(damping_law="none"))
    )
    (note,) = facts(simulated)
    assert isinstance(note, str)
    assert "ends 5 mm beyond" in note


def test_check_warns_before_a_solve():
    messages = [each.message for each in check_problem(held_above(0.075)).concerns]
    assert any("ends 5 mm beyond the elements" in m for m in messages)
