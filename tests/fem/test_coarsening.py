"""Coarser meshes and bodies: geometry, node sets, regions, fields and interpolation."""

from __future__ import annotations

import numpy as np
import pytest

from collocation_sysid import Body, Field, Region, cylinder_mesh
from collocation_sysid.fem.coarse_body import coarsen_body
from collocation_sysid.fem.meshes.coarsening import coarsen_mesh
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.selection import Box
from collocation_sysid.fem.meshes.structured import box_mesh

SIZE_M = (0.1, 0.03, 0.03)
BOX = box_mesh(SIZE_M, (16, 5, 5))


def coarsened(mesh: TetMesh, count: int, labels=None):
    if labels is None:
        labels = np.zeros(len(mesh.points_m), dtype=np.int64)
    groups = np.zeros(len(mesh.tetrahedra), dtype=np.int64)
    return coarsen_mesh(mesh, count, node_labels=labels, cell_groups=groups)


def test_a_coarse_box_is_the_same_box_with_fewer_nodes():
    coarse = coarsened(BOX, len(BOX.points_m) // 6)
    assert len(coarse.mesh.points_m) <= len(BOX.points_m) // 5
    assert coarse.mesh.volume_m3 == pytest.approx(BOX.volume_m3, rel=1e-9)
    assert coarse.mesh.bounds_m == pytest.approx(BOX.bounds_m)
    assert coarse.mesh.quality().quality_min >= 0.1
    assert not coarse.mesh.notes  # no element is inverted, all are connected


def test_a_coarse_cylinder_encloses_nearly_the_same_volume():
    mesh = cylinder_mesh(0.04, 0.16, 3, 12)
    coarse = coarsened(mesh, len(mesh.points_m) // 4)
    assert len(coarse.mesh.points_m) < len(mesh.points_m) / 3
    assert coarse.mesh.volume_m3 == pytest.approx(mesh.volume_m3, rel=0.12)


def test_every_node_is_kept_or_moved_onto_one_with_its_label():
    labels = (BOX.points_m[:, 0] < 0.02).astype(np.int64)
    coarse = coarsened(BOX, len(BOX.points_m) // 6, labels)
    of_coarse = labels[coarse.kept_nodes]
    assert (of_coarse[coarse.coarse_nodes] == labels).all()
    assert (coarse.coarse_nodes[coarse.kept_nodes] == np.arange(len(coarse.kept_nodes))).all()
    kept_m = BOX.points_m[coarse.kept_nodes]
    assert (kept_m == coarse.mesh.points_m).all()
    held_m = coarse.mesh.points_m[of_coarse == 1]
    assert np.ptp(held_m[:, 0]) == pytest.approx(np.ptp(BOX.points_m[labels == 1, 0]))


def test_a_mesh_that_cannot_be_coarser_is_unchanged():
    small = box_mesh((0.1, 0.1, 0.1), (1, 1, 1))
    coarse = coarsened(small, 1)
    assert len(coarse.mesh.points_m) == len(small.points_m)


@pytest.mark.parametrize("element", ["tet4", "tet10"])
def test_a_linear_motion_is_interpolated_exactly(element: str):
    body = Body(BOX, density_kg_m3=1000.0, element=element)
    held = np.flatnonzero(body.nodes_m[:, 0] < 1e-9)
    relation = coarsen_body(body, len(body.nodes_m) // 6, [held])
    gradient = np.array([[1.2, 0.1, 0.0], [0.0, 0.9, 0.3], [-0.1, 0.0, 1.1]])
    coarse_m = relation.coarse.nodes_m
    moved_m = relation.interpolation @ (coarse_m @ gradient.T + 0.5)
    assert moved_m == pytest.approx(body.nodes_m @ gradient.T + 0.5, abs=1e-12)
    assert relation.coarse_values(body.nodes_m) == pytest.approx(coarse_m)
    coarse_held = relation.coarse_nodes(held)
    assert (coarse_m[coarse_held, 0] == 0).all()
    assert len(coarse_held) == (coarse_m[:, 0] == 0).sum()


def test_regions_keep_their_interface_densities_and_constants():
    tip = Region("tip", Box((0.05, -1, -1), (1, 1, 1)), density_kg_m3=500.0)
    body = Body(BOX, density_kg_m3=1000.0, regions=[tip], prony=["prony_1"])
    relation = coarsen_body(body, len(BOX.points_m) // 6, [])
    coarse = relation.coarse
    assert list(coarse.constants) == list(body.constants)
    assert [p.density_kg_m3 for p in coarse.parts] == [1000.0, 500.0]
    for mine, its in zip(coarse.parts, body.parts, strict=True):
        assert coarse.mesh.volumes_m3[mine.cells].sum() == pytest.approx(
            body.mesh.volumes_m3[its.cells].sum()
        )
    shared = np.intersect1d(*(coarse.mesh.tetrahedra[part.cells] for part in coarse.parts))
    edge_m = body.mesh.points_m[
        np.intersect1d(*(body.mesh.tetrahedra[p.cells] for p in body.parts)), 0
    ]
    assert coarse.mesh.points_m[shared, 0] == pytest.approx(edge_m[0])
    assert coarse.mass_kg == pytest.approx(body.mass_kg)


def test_a_field_has_the_values_of_the_same_places():
    body = Body(BOX, density_kg_m3=1000.0, field=Field(0.05, modes=3))
    relation = coarsen_body(body, len(BOX.points_m) // 6, [])
    own = body.parts[0].field
    its = relation.coarse.parts[0].field
    assert own is not None
    assert its is not None
    assert its.length_m == own.length_m
    assert its.volumes_m3.sum() == pytest.approx(own.volumes_m3.sum())
    x_m = relation.coarse.mesh.centres_m[:, 0]
    along = np.interp(
        x_m,
        np.sort(body.mesh.centres_m[:, 0]),
        own.shapes[np.argsort(body.mesh.centres_m[:, 0]), 0],
    )
    assert np.corrcoef(its.shapes[:, 0], along)[0, 1] > 0.98
