"""Structured meshes: exact sizes and conforming elements."""

from __future__ import annotations

import numpy as np
import pytest

from collocation_sysid.errors import InputError
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import (
    box_mesh,
    box_of_edge,
    count_box_elements,
    count_cylinder_elements,
    cylinder_mesh,
    cylinder_of_edge,
)


@pytest.fixture
def box() -> TetMesh:
    return box_mesh((0.1, 0.04, 0.03), (5, 2, 2))


def face_areas(mesh: TetMesh) -> np.ndarray:
    a, b, c = mesh.points_m[mesh.surface].transpose(1, 0, 2)
    return np.cross(b - a, c - a) / 2


def is_conforming(mesh: TetMesh) -> bool:
    """Every edge of the boundary is shared by exactly two of its triangles."""
    edges = np.sort(mesh.surface[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] == 2).all())


def test_box_has_exact_volume_bounds_and_node_count(box):
    assert len(box.points_m) == 6 * 3 * 3
    assert len(box.tetrahedra) == 6 * 5 * 2 * 2
    assert box.volume_m3 == pytest.approx(0.1 * 0.04 * 0.03, rel=1e-12)
    np.testing.assert_allclose(box.bounds_m, [[0, 0, 0], [0.1, 0.04, 0.03]])
    assert (box.volumes_m3 > 0).all()
    assert box.notes == ()


def test_box_surface_is_closed_outward_and_has_the_exact_area(box):
    normals = face_areas(box)
    area = 2 * (0.1 * 0.04 + 0.1 * 0.03 + 0.04 * 0.03)
    assert np.linalg.norm(normals, axis=1).sum() == pytest.approx(area, rel=1e-12)
    # The divergence theorem gives the volume only if every triangle faces outward.
    centers = box.points_m[box.surface].mean(axis=1)
    assert (centers * normals).sum() / 3 == pytest.approx(box.volume_m3, rel=1e-12)
    outward = centers - box.bounds_m.mean(axis=0)
    assert ((outward * normals).sum(axis=1) > 0).all()
    assert is_conforming(box)


def test_box_can_be_placed_elsewhere():
    mesh = box_mesh((1, 2, 3), (1, 1, 1), origin_m=(-1, 5, 0))
    np.testing.assert_allclose(mesh.bounds_m, [[-1, 5, 0], [0, 7, 3]])


@pytest.mark.parametrize(("rings", "layers"), [(1, 1), (1, 11), (2, 8), (3, 4)])
def test_cylinder_is_a_conforming_prism_of_good_elements(rings, layers):
    height = 0.04 / rings * layers  # as tall as wide elements
    mesh = cylinder_mesh(0.04, height, rings, layers)
    assert len(mesh.points_m) == (1 + 3 * rings * (rings + 1)) * (layers + 1)
    assert len(mesh.tetrahedra) == 18 * rings**2 * layers
    sides = 6 * rings
    polygon = sides / 2 * 0.04**2 * np.sin(2 * np.pi / sides)
    assert mesh.volume_m3 == pytest.approx(polygon * height, rel=1e-12)
    caps = 2 * 6 * rings**2
    assert len(mesh.surface) == caps + 2 * sides * layers
    assert is_conforming(mesh)
    assert mesh.quality().quality_min > 0.6


@pytest.mark.parametrize(
    "make",
    [
        lambda: box_mesh((1, 0, 1), (1, 1, 1)),
        lambda: box_mesh((1, 1, 1), (1, 1.5, 1)),
        lambda: cylinder_mesh(0.1, 1.0, 0, 3),
        lambda: cylinder_mesh(-0.1, 1.0, 2, 3),
    ],
)
def test_structured_meshes_refuse_impossible_sizes(make):
    with pytest.raises(InputError, match=r"needs|expected"):
        make()


@pytest.mark.parametrize("edge_length_m", [0.0, -0.01, float("nan")])
@pytest.mark.parametrize(
    "make",
    [
        lambda edge_m: box_of_edge((0.1, 0.1, 0.1), edge_m),
        lambda edge_m: count_box_elements((0.1, 0.1, 0.1), edge_m),
        lambda edge_m: cylinder_of_edge(0.1, 0.1, edge_m),
        lambda edge_m: count_cylinder_elements(0.1, 0.1, edge_m),
    ],
)
def test_an_edge_length_that_is_not_positive_is_refused(make, edge_length_m):
    """A negative one would give a single cell along each axis."""
    with pytest.raises(InputError, match=r"edge_length_m.*positive length"):
        make(edge_length_m)
