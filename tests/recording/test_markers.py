"""Markers: positions, missing samples, noise and validation."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, permutations
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from collocation_sysid.errors import InputError
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.program.observables import interpolation_matrix
from collocation_sysid.recording import Markers, Placement, place_markers


def box_body(divisions=(2, 2, 3), edge_m=0.1) -> Any:
    """A box of cubes of six tetrahedra each, with linear elements."""
    counts = np.array(divisions) + 1
    nodes = edge_m * np.argwhere(np.ones(counts)).astype(float)
    cubes = np.argwhere(np.ones(divisions))
    cells = []
    for axes in permutations(range(3)):
        corners = [cubes]
        for axis in axes:
            corners.append(corners[-1] + np.eye(3, dtype=int)[axis])
        cells.append(np.stack([np.ravel_multi_index(c.T, counts) for c in corners], axis=1))
    element = SimpleNamespace(shape_functions=lambda barycentric: barycentric)
    tetrahedra = np.concatenate(cells)
    mesh = TetMesh(nodes, tetrahedra)
    return SimpleNamespace(
        nodes_m=nodes, place_cells=tetrahedra, place_element=element, is_solid=True, mesh=mesh
    )


def quadratic(body) -> Any:
    """The same body with a node on each edge."""
    pairs = list(combinations(range(4), 2))
    edges = np.sort(body.place_cells[:, pairs], axis=2)
    unique, number = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
    cells = np.hstack([body.place_cells, len(body.nodes_m) + number.reshape(-1, 6)])
    nodes = np.vstack([body.nodes_m, body.nodes_m[unique].mean(axis=1)])

    def shape_functions(local):
        mid = [4 * local[:, i] * local[:, j] for i, j in pairs]
        return np.column_stack([local * (2 * local - 1), *mid])

    element = SimpleNamespace(shape_functions=shape_functions)
    return SimpleNamespace(
        nodes_m=nodes, place_cells=cells, place_element=element, is_solid=True, mesh=body.mesh
    )


def bend(nodes_m):
    """A smooth deformation that curves straight edges."""
    x, y, z = nodes_m.T
    return np.column_stack([x + 1.5 * z**2, y * (1 + 0.5 * z), z - x * z])


def located(placement, nodes_m):
    return np.einsum("mk,mkd->md", placement.weights, nodes_m[placement.nodes])


def track(placement, samples=4, **changes):
    m = len(placement.nodes)
    fields: dict[str, Any] = {
        "names": tuple(f"m{k}" for k in range(m)),
        "t_s": 0.01 * np.arange(samples),
        "positions_m": np.zeros((samples, m, 3)),
        "sigma_m": np.full(m, 1e-3),
        "placement": placement,
    }
    return Markers(**{**fields, **changes})


@pytest.fixture(params=["tet4", "tet10"])
def body(request):
    return box_body() if request.param == "tet4" else quadratic(box_body())


@pytest.mark.parametrize("deform", [np.asarray, bend])
def test_inside_points_are_embedded_at_their_place(body, deform):
    nodes = deform(body.nodes_m)
    points = deform(np.random.default_rng(2).uniform([0.02] * 3, [0.18, 0.18, 0.28], (20, 3)))
    placement = place_markers(points, nodes, body, attach="embedded")
    np.testing.assert_allclose(located(placement, nodes), points, atol=1e-12)
    np.testing.assert_allclose(placement.weights.sum(axis=1), 1.0)
    np.testing.assert_array_equal(placement.distance_m, 0.0)


def test_an_embedded_point_lies_within_its_tetrahedron():
    body = box_body()
    points = np.random.default_rng(3).uniform([0, 0, 0], [0.2, 0.2, 0.3], (50, 3))
    placement = place_markers(points, body.nodes_m, body, attach="embedded")
    assert placement.weights.min() > -1e-9
    cells = {tuple(cell) for cell in body.place_cells}
    assert all(tuple(nodes) in cells for nodes in placement.nodes)


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ([0.07, 0.11, 0.32], 0.02),  # above a face
        ([0.23, 0.24, 0.13], 0.05),  # beside an edge
        ([-0.01, -0.02, -0.02], 0.03),  # off a corner
    ],
)
def test_outside_points_are_extrapolated_and_the_distance_reported(body, point, distance):
    placement = place_markers([point], body.nodes_m, body, attach="embedded")
    np.testing.assert_allclose(located(placement, body.nodes_m), [point], atol=1e-12)
    assert placement.distance_m[0] == pytest.approx(distance)


def test_extrapolation_uses_the_element_that_must_stretch_least():
    body = box_body()
    placement = place_markers([[0.2, 0.2, 0.33]], body.nodes_m, body, attach="embedded")
    assert placement.weights.min() >= -0.3 - 1e-9
    assert placement.weights.max() <= 1.3 + 1e-9


def test_a_point_beyond_the_limit_is_refused_by_name():
    body = box_body()
    with pytest.raises(InputError, match=r"marker 'tip' .*0\.05 m away.*0\.02 m allowed"):
        place_markers(
            [[0.1, 0.1, 0.1], [0.1, 0.07, 0.35]],
            body.nodes_m,
            body,
            max_distance_m=0.02,
            names=["base", "tip"],
        )


def test_by_default_a_marker_may_be_an_edge_length_away():
    body = box_body()
    place_markers([[0.1, 0.07, 0.39]], body.nodes_m, body)
    with pytest.raises(InputError, match="marker '0'"):
        place_markers([[0.1, 0.07, 0.45]], body.nodes_m, body)


def test_vertex_takes_the_nearest_node(body):
    node = 17
    point = body.nodes_m[node] + [0.01, -0.02, 0.005]
    placement = place_markers([point], body.nodes_m, body, attach="vertex")
    np.testing.assert_allclose(located(placement, body.nodes_m)[0], body.nodes_m[node])
    assert np.count_nonzero(placement.weights) == 1
    assert placement.distance_m[0] == pytest.approx(np.linalg.norm([0.01, 0.02, 0.005]))


def test_auto_snaps_to_near_nodes_only():
    body = box_body()
    near = body.nodes_m[17] + [0.004, 0.0, 0.0]
    far = body.nodes_m[17] + [0.02, -0.01, 0.0]
    placement = place_markers([near, far], body.nodes_m, body)
    np.testing.assert_allclose(located(placement, body.nodes_m), [body.nodes_m[17], far])


def test_placing_follows_the_configuration_given():
    body = box_body()
    shift = np.array([1.0, 2.0, 3.0])
    points = np.array([[0.05, 0.13, 0.21]])
    here = place_markers(points, body.nodes_m, body)
    there = place_markers(points + shift, body.nodes_m + shift, body)
    np.testing.assert_array_equal(here.nodes, there.nodes)
    np.testing.assert_allclose(here.weights, there.weights, atol=1e-12)


def test_a_marker_without_position_is_refused_by_name():
    body = box_body()
    with pytest.raises(InputError, match=r"marker '1' has no sample .*reference_m"):
        place_markers([[0.1, 0.1, 0.1], [np.nan, 0.1, 0.1]], body.nodes_m, body)


def test_an_unknown_attachment_is_refused():
    body = box_body()
    attach: Any = "nearest"
    with pytest.raises(InputError, match="'auto', 'vertex' or 'embedded'"):
        place_markers([[0.1, 0.1, 0.1]], body.nodes_m, body, attach=attach)


def as_matrix(markers):
    placement = markers.placement
    return interpolation_matrix(placement.nodes, placement.weights, placement.node_count)


def test_observe_and_operator_agree(body):
    rng = np.random.default_rng(4)
    points = rng.uniform([0, 0, 0], [0.2, 0.2, 0.3], (6, 3))
    points[2] = body.nodes_m[5]
    markers = track(place_markers(points, body.nodes_m, body))
    x = body.nodes_m + 0.01 * rng.normal(size=(4, *body.nodes_m.shape))
    seen = markers.predict_positions(x)
    assert seen.shape == (4, 6, 3)
    operator = as_matrix(markers)
    assert operator.shape == (18, x[0].size)
    for t in range(4):
        np.testing.assert_allclose(operator @ x[t].ravel(), seen[t].ravel())


def test_operator_has_one_entry_per_coordinate_of_a_vertex_marker():
    body = box_body()
    markers = track(place_markers(body.nodes_m[[7]], body.nodes_m, body))
    operator = as_matrix(markers).tocoo()
    np.testing.assert_array_equal(operator.col, [21, 22, 23])
    np.testing.assert_array_equal(operator.row, [0, 1, 2])
    np.testing.assert_allclose(operator.data, 1.0)


def vertex_placement(m=2):
    return Placement(
        np.arange(4 * m).reshape(m, 4), np.tile([1.0, 0, 0, 0], (m, 1)), np.zeros(m), 4 * m
    )


def test_single_coordinates_of_a_sample_are_kept():
    positions = np.zeros((4, 2, 3))
    positions[1, 0, 2] = np.nan
    positions[2:, 1] = np.nan
    markers = track(vertex_placement(), positions_m=positions)
    np.testing.assert_array_equal(
        markers.is_present, [[True, True], [True, True], [True, False], [True, False]]
    )
    assert not markers.is_complete[1, 0]
    np.testing.assert_array_equal(markers.missing_count, [0, 2])
    assert markers.sample_count == 6
    np.testing.assert_array_equal(np.isnan(markers.positions_m[1, 0]), [False, False, True])
    # Descriptions of the motion use complete samples only.
    assert np.isnan(markers.positions_at_samples_m[1, 0]).all()
    away = markers.squared_distances_m2(positions + np.array([0.3, 0.0, 0.4]))
    np.testing.assert_allclose(away[:2], [[0.25, 0.25], [0.09, 0.25]])


def test_one_sigma_serves_all_markers():
    np.testing.assert_array_equal(track(vertex_placement(), sigma_m=0.002).sigma_m, [0.002] * 2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"names": ("a", "a")}, "'a' is given more than once"),
        ({"sigma_m": np.array([1e-3, 0.0])}, "sigma_m of marker 'm1' is 0"),
        ({"positions_m": np.zeros((3, 2, 3))}, r"marker positions has the shape \(3, 2, 3\)"),
        ({"placement": vertex_placement(3)}, "3 positions on the body for 2 markers"),
        ({"places_sigma_m": np.ones(3)}, r"places_sigma_m has the shape \(3,\)"),
    ],
)
def test_inconsistent_markers_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        replace(track(vertex_placement()), **changes)


def test_a_placement_beyond_the_last_node_is_refused():
    with pytest.raises(InputError, match="node 7; expected node indices from 0 to 4"):
        replace(vertex_placement(), node_count=5)
