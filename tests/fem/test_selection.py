"""Node selections: results and refusals."""

from __future__ import annotations

import numpy as np
import pytest

from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.selection import Ball, Box, Indices, Named
from collocation_sysid.fem.meshes.structured import box_mesh

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


@pytest.fixture
def box() -> TetMesh:
    return box_mesh((0.1, 0.04, 0.03), (5, 2, 2))


def test_a_box_selects_its_nodes_and_those_on_its_faces(box):
    chosen = box.select(Box([-1, -1, -1], [0.02, 1, 1]))
    np.testing.assert_array_equal(chosen, np.flatnonzero(box.points_m[:, 0] < 0.021))
    assert chosen.dtype == np.int64
    everything = box.select(Box([-np.inf] * 3, [np.inf] * 3))
    assert len(everything) == len(box.points_m)


def test_a_box_forgives_round_off(box):
    assert len(box.select(Box([0.1 + 1e-13, -1, -1], [1, 1, 1]))) == 9


def test_a_ball_selects_by_distance(box):
    np.testing.assert_array_equal(box.select(Ball([0, 0, 0], 0.016)), [0, 1])


def test_indices_are_those_of_the_file():
    mesh = TetMesh(np.insert(CORNERS, 0, 9.0, axis=0), [[1, 2, 3, 4]])
    np.testing.assert_array_equal(mesh.select(Indices([4, 1, 4])), [0, 3])
    with pytest.raises(InputError, match="node 0 was dropped"):
        mesh.select(Indices([0, 1]))
    with pytest.raises(InputError, match="node 5 does not exist; the mesh has 5 nodes"):
        mesh.select(Indices([5]))
    with pytest.raises(InputError, match="node -1 does not exist"):
        mesh.select(Indices([-1]))


@pytest.mark.parametrize(
    "values", [[True, False, False, True], [1, 0, 0, 1], [[1.0], [0], [0], [1]]]
)
def test_a_named_array_selects_where_it_is_true(values):
    mesh = TetMesh(CORNERS, [[0, 1, 2, 3]], {"grip": values})
    np.testing.assert_array_equal(mesh.select(Named("grip")), [0, 3])


def test_an_unknown_name_lists_the_names_there_are(box):
    mesh = TetMesh(CORNERS, [[0, 1, 2, 3]], {"grip": [1, 0, 0, 0], "tip": [0, 0, 0, 1]})
    with pytest.raises(InputError, match='no point array or group "grp"; it has "grip", "tip"'):
        mesh.select(Named("grp"))
    with pytest.raises(InputError, match="it has none"):
        box.select(Named("grip"))


def test_a_named_array_must_be_a_mask():
    arrays = {"heat": [0.0, 1, 2, 3], "velocity": np.zeros((4, 3))}
    mesh = TetMesh(CORNERS, [[0, 1, 2, 3]], arrays)
    with pytest.raises(InputError, match=r'"heat" contains the value 2\.0'):
        mesh.select(Named("heat"))
    with pytest.raises(InputError, match='"velocity" has 3 values per node'):
        mesh.select(Named("velocity"))


@pytest.mark.parametrize("selection", [Box([5, 5, 5], [6, 6, 6]), Ball([5, 5, 5], 1), Indices([])])
def test_an_empty_selection_is_refused_with_the_extent_of_the_body(box, selection):
    with pytest.raises(InputError, match=r"selects none of the 54 nodes.*x from 0 to 0\.1 m"):
        box.select(selection)


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        (Box, ([1, 0, 0], [0, 1, 1]), "low corner has x = 1 m, above 0 m"),
        (Box, ([0, 0], [1, 1, 1]), "low_m must be three numbers"),
        (Box, ([0, 0, "a"], [1, 1, 1]), "low_m must be three numbers"),
        (Ball, ([0, 0, 0], 0), "Ball: radius_m is 0; expected a number above 0"),
        (Ball, ([0, 0, np.nan], 1), r"center_m\[2\] is nan; expected a number"),
        (Indices, ([1.5],), "whole numbers from 0"),
        (Indices, ([True],), "whole numbers from 0"),
    ],
)
def test_ill_formed_selections_are_refused(kind, values, message):
    with pytest.raises(InputError, match=message):
        kind(*values)


# --- nodes on edges


def quadratic(mesh: TetMesh) -> Body:
    return Body(mesh, density_kg_m3=30.0, element="tet10")


@pytest.mark.parametrize(
    "selection",
    [Box([-1, -1, -1], [0.011, 1, 1]), Ball([0, 0, 0], 0.012), Ball([0.01, 0, 0], 1e-6)],
)
def test_boxes_and_balls_act_on_nodes_on_edges_too(box, selection):
    body = quadratic(box)
    if isinstance(selection, Box):
        expected = body.nodes_m[:, 0] < 0.0111
    else:
        distance = np.linalg.norm(body.nodes_m - selection.center_m, axis=1)
        expected = distance < selection.radius_m + 1e-9
    chosen = body.select(selection)
    np.testing.assert_array_equal(chosen, np.flatnonzero(expected))
    assert chosen.max() >= len(box.points_m)


@pytest.mark.parametrize("selection", [Indices([1, 3, 4]), Named("grip")])
def test_a_node_on_an_edge_is_selected_with_both_ends_of_the_edge(selection):
    points = np.insert(CORNERS, 0, 9.0, axis=0)
    mesh = TetMesh(points, [[1, 2, 3, 4]], {"grip": [0, 1, 0, 1, 1]})
    body = quadratic(mesh)
    np.testing.assert_array_equal(mesh.select(selection), [0, 2, 3])
    chosen = body.select(selection)
    np.testing.assert_array_equal(chosen[:3], [0, 2, 3])
    np.testing.assert_allclose(
        sorted(body.nodes_m[chosen[3:]].tolist()), [[0, 0, 0.5], [0, 0.5, 0], [0, 0.5, 0.5]]
    )


def test_linear_bodies_select_like_their_mesh(box):
    body = Body(box, density_kg_m3=30.0)
    selection = Box([-1, -1, -1], [0.02, 1, 1])
    np.testing.assert_array_equal(body.select(selection), box.select(selection))


def test_a_mid_node_of_the_file_cannot_be_given():
    points = np.vstack([CORNERS, [[0.5, 0, 0]]])
    body = quadratic(TetMesh(points, [[0, 1, 2, 3]]))
    with pytest.raises(
        InputError, match=r"node 4 was dropped.*not the corner of an element; leave it out"
    ):
        body.select(Indices([0, 1, 4]))


def test_selections_with_the_same_values_are_equal():
    assert Box([0, 0, 0], [1, 1, 1]) == Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    assert hash(Indices([1, 2])) == hash(Indices((1, 2)))
