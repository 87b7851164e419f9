"""Closed surfaces: reading, refusals and tetrahedral meshes."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError

import meshio
import numpy as np
import pytest

from collocation_sysid.errors import InputError
from collocation_sysid.fem.meshes import surface
from collocation_sysid.fem.meshes.files import read_triangles
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.structured import box_mesh, cylinder_mesh
from collocation_sysid.fem.meshes.surface import merge_coincident, tetrahedralize_surface


def cube_surface(size_m=(0.1, 0.04, 0.04)) -> tuple[np.ndarray, np.ndarray]:
    mesh = box_mesh(size_m, (1, 1, 1))
    return mesh.points_m, mesh.surface


def test_an_open_surface_is_refused_with_its_open_edges():
    points, triangles = cube_surface()
    with pytest.raises(InputError, match="not closed: 3 open edges"):
        tetrahedralize_surface(points, triangles[:-1], 0.02)


def test_a_doubled_triangle_is_not_closed_either():
    points, triangles = cube_surface()
    with pytest.raises(InputError, match=r"0 open edges .* and 3 to more than two"):
        tetrahedralize_surface(points, np.vstack([triangles, triangles[:1]]), 0.02)


@pytest.mark.parametrize(
    ("edge_length_m", "message"),
    [
        (0.5, "more than half the diagonal of the surface"),
        (1e-4, "expected at most 2e"),
        (-1, "positive number"),
    ],
)
def test_an_edge_length_that_does_not_suit_the_surface_is_refused(edge_length_m, message):
    with pytest.raises(InputError, match=message):
        tetrahedralize_surface(*cube_surface(), edge_length_m)


def test_a_missing_mesher_is_named_with_the_remedy(monkeypatch):
    def absent(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(surface, "version", absent)
    with pytest.raises(InputError, match=r"pip install 'collocation-sysid\[surface\]'"):
        tetrahedralize_surface(*cube_surface(), 0.02)


@pytest.mark.parametrize("ending", ["stl", "obj", "ply"])
def test_surface_files_are_read_with_their_vertices_merged(tmp_path, ending):
    points, triangles = cube_surface()
    # Every triangle with vertices of its own, as an STL file stores them.
    soup = meshio.Mesh(
        points[triangles].reshape(-1, 3), [("triangle", np.arange(36).reshape(12, 3))]
    )
    path = tmp_path / f"cube.{ending}"
    meshio.write(path, soup)
    merged, faces = merge_coincident(*read_triangles(path))
    assert merged.shape == (8, 3)
    assert faces.shape == (12, 3)
    assert abs(np.linalg.det(merged[faces]).sum() / 6) == pytest.approx(1.6e-4, rel=1e-5)


def test_quadrilaterals_are_split(tmp_path):
    (tmp_path / "square.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    _, triangles = read_triangles(tmp_path / "square.obj")
    np.testing.assert_array_equal(triangles, [[0, 1, 2], [0, 2, 3]])


def test_an_open_surface_file_is_named(tmp_path):
    (tmp_path / "square.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    with pytest.raises(InputError, match=r"square\.obj: the surface is not closed: 4 open edges"):
        TetMesh.from_surface(tmp_path / "square.obj", 0.1)


def test_pytetwild_fills_a_surface_and_the_cache_repeats_the_mesh(tmp_path, monkeypatch):
    pytest.importorskip("pytetwild")
    monkeypatch.chdir(tmp_path)
    points, triangles = cube_surface((100.0, 40.0, 40.0))
    meshio.write("cube.stl", meshio.Mesh(points, [("triangle", triangles)]))
    mesh = TetMesh.from_surface("cube.stl", 0.02, length_unit="mm", cache="cache")
    assert mesh.volume_m3 == pytest.approx(1.6e-4, rel=0.02)
    assert (mesh.volumes_m3 > 0).all()
    assert 0.01 < mesh.quality().edge_mean_m < 0.04

    again = TetMesh.from_surface("cube.stl", 0.02, length_unit="mm", cache="cache")
    assert again.sha256 == mesh.sha256
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["cache", "cube.stl"]
    assert len(list((tmp_path / "cache").iterdir())) == 1


def test_the_mesher_respects_the_edge_length_of_a_round_body():
    pytest.importorskip("pytetwild")
    scan = cylinder_mesh(0.01, 0.1, 5, 40)
    edges_m = []
    for edge_length_m in (0.012, 0.006):
        mesh = TetMesh.from_surface((scan.points_m, scan.surface), edge_length_m)
        edges_m.append(mesh.quality().edge_mean_m / edge_length_m)
        assert mesh.volume_m3 == pytest.approx(scan.volume_m3, rel=0.005)
    assert all(0.65 < each < 1.5 for each in edges_m)


def test_a_coarse_mesh_has_the_volume_of_a_round_surface():
    scan = cylinder_mesh(0.01, 0.1, 5, 40)
    coarse = cylinder_mesh(0.01, 0.1, 1, 8)
    points, tetrahedra = coarse.points_m.copy(), coarse.tetrahedra
    radius_m = np.hypot(points[:, 0], points[:, 1])
    points[radius_m > 0.001, :2] *= (0.01 / radius_m[radius_m > 0.001])[:, None]
    assert TetMesh(points, tetrahedra).volume_m3 < 0.85 * scan.volume_m3
    moved = surface.with_volume_of(scan.points_m, scan.surface, points, tetrahedra)
    assert TetMesh(moved, tetrahedra).volume_m3 == pytest.approx(scan.volume_m3, rel=0.004)
    np.testing.assert_allclose(np.ptp(moved[:, 2]), 0.1, rtol=1e-9)


def test_a_mesh_of_plane_faces_is_kept():
    box = box_mesh((0.1, 0.04, 0.04), (5, 2, 2))
    moved = surface.with_volume_of(*cube_surface(), box.points_m, box.tetrahedra)
    np.testing.assert_allclose(moved, box.points_m, atol=1e-12)


def test_a_cache_folder_that_cannot_be_made_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(surface, "version", lambda name: "0")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written: Not a directory"):
        tetrahedralize_surface(*cube_surface(), 0.02, cache_dir=tmp_path / "file" / "cache")


def test_a_mesh_that_is_refused_is_not_kept(tmp_path, monkeypatch):
    flat = (np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]), np.array([[0, 1, 2, 3]]))
    monkeypatch.setattr(surface, "run_ftetwild", lambda *_, **__: flat)
    monkeypatch.setattr(surface, "version", lambda name: "0")
    with pytest.raises(InputError, match="degenerate"):
        TetMesh.from_surface(cube_surface(), 0.02, cache=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_surface_of_arrays_is_scaled_by_its_unit():
    points, triangles = cube_surface((100.0, 40.0, 40.0))
    with pytest.raises(InputError, match=r"measures 0\.1 × 0\.04 × 0\.04 m: check"):
        TetMesh.from_surface((points, triangles), 20.0, length_unit="mm")


def test_a_mesher_that_fails_is_reported_with_its_last_words(monkeypatch):
    monkeypatch.setattr(surface, "WORKER", "raise RuntimeError('no inside')")
    monkeypatch.setattr(surface, "version", lambda name: "0")
    with pytest.raises(InputError, match=r"could not fill the surface .*no inside"):
        tetrahedralize_surface(*cube_surface(), 0.02)
