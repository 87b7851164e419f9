"""The choice of grasped nodes, and its sensitivity to small displacements of the grasp."""

from __future__ import annotations

import pytest
from kit.problems import times, vertex_markers

from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.selection import Box
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.recording import Experiment, Grasp, PoseSequence
from collocation_sysid.runs.check.body import (
    GraspCheck,
    check_grasps,
    grasp_concerns,
    grasp_sentence,
)

# Layers of nodes are so far apart, so a tenth of an edge is 2 mm.
EDGE_M = 0.02
TOP = Box((-1, -1, 0.079), (1, 1, 1))
BOTTOM = Box((-1, -1, -1), (1, 1, 0.021))
CORNER = Box((-1, -1, 0.079), (0.021, 0.021, 1))

Point = tuple[float, float, float]


def held(region: Box, *moves: tuple[Point, Point], axes: str = "xyz") -> GraspCheck:
    """A cube of 100 mm held by a region, after some of its nodes were moved."""
    mesh = box_mesh((0.1, 0.1, 0.1), (5, 5, 5))
    points_m = mesh.points_m.copy()
    for at, to in moves:
        (node,) = abs(points_m - at).max(axis=1).argsort()[:1]
        points_m[node] = to
    body, t_s = (Body(TetMesh(points_m, mesh.tetrahedra), density_kg_m3=30.0), times(3))
    grasps = [Grasp(region, PoseSequence.fixed(), axes=axes)]
    if axes != "xyz":
        grasps.append(Grasp(BOTTOM, PoseSequence.fixed()))
    seen = vertex_markers(body, [100], t_s)
    return check_grasps(Experiment(body, t_s, grasps, seen, name="cube"), EDGE_M)[0]


@pytest.mark.parametrize(
    ("region", "moves", "nearly_held", "nearly_free"),
    [
        (TOP, [], 0, 0),
        (BOTTOM, [], 0, 0),
        (CORNER, [], 0, 0),
        # 1.5 mm beyond the face that the body goes on beyond, on either side of it.
        (TOP, [((0.04, 0.04, 0.06), (0.04, 0.04, 0.0785))], 1, 0),
        (TOP, [((0.04, 0.04, 0.08), (0.04, 0.04, 0.0815))], 0, 1),
        (BOTTOM, [((0.04, 0.04, 0.04), (0.04, 0.04, 0.0215))], 1, 0),
        (BOTTOM, [((0.04, 0.04, 0.02), (0.04, 0.04, 0.0185))], 0, 1),
        # More than a tenth of an edge, or on the face but for rounding.
        (TOP, [((0.04, 0.04, 0.06), (0.04, 0.04, 0.0775))], 0, 0),
        (TOP, [((0.04, 0.04, 0.08), (0.04, 0.04, 0.0825))], 0, 0),
        (TOP, [((0.04, 0.04, 0.08), (0.04, 0.04, 0.08 + 1e-9))], 0, 0),
        (TOP, [((0.04, 0.04, 0.08), (0.04, 0.04, 0.08 + 1e-5))], 0, 1),
        # Two nodes, and one at two faces, which counts once.
        (TOP, [((x, 0.04, 0.06), (x, 0.04, 0.0785)) for x in (0.04, 0.06)], 2, 0),
        (CORNER, [((0.02, 0.02, 0.08), (0.0185, 0.0185, 0.0815))], 0, 1),
        (CORNER, [((0.04, 0.0, 0.1), (0.0215, 0.0, 0.1))], 1, 0),
        # Behind faces at which the body ends nothing is cut.
        (TOP, [((0.04, 0.04, 0.1), (0.04, 0.04, 0.0985))], 0, 0),
        (TOP, [((0.0, 0.04, 0.08), (0.0015, 0.04, 0.08))], 0, 0),
        # Below the box, but beside it by more than 1.5 edges.
        (CORNER, [((0.04, 0.04, 0.06), (0.045, 0.04, 0.0785))], 1, 0),
        (CORNER, [((0.06, 0.04, 0.06), (0.06, 0.04, 0.0785))], 0, 0),
    ],
)
def test_nodes_beside_a_face_that_cuts_elements_are_counted(
    region, moves, nearly_held, nearly_free
):
    found = held(region, *moves)
    assert (found.nearly_grasped, found.nearly_free) == (nearly_held, nearly_free)
    (said, *more) = [each.message for each in grasp_concerns(found)] or [""]
    assert not more
    assert ("enlarged by a tenth of an element's edge" in said) == bool(nearly_held + nearly_free)
    if said:
        assert f"selects {found.nodes} nodes, but {nearly_held} more if" in said
        assert f"or {nearly_free} fewer if it is reduced by as much" in said


def test_a_grasp_is_reported_with_nodes_size_and_place():
    found = held(CORNER)
    assert (found.nodes, found.share) == (8, 8 / 216)
    assert grasp_sentence(found) == (
        "8 nodes, 4% of all, in a box of 20 × 20 × 20 mm at (0, 0, 80) mm"
    )
    assert grasp_sentence(held(TOP, axes="xz")) == (
        "72 nodes, 33% of all, in a box of 100 × 100 × 20 mm at (0, 0, 80) mm, "
        "held along x and z only"
    )
