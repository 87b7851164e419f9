"""The mesh: how it is made, read, cleaned, refused, measured and selected from."""

from __future__ import annotations

import pickle
import subprocess
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

from collocation_sysid.errors import InputError
from collocation_sysid.fem import meshing
from collocation_sysid.fem.mesh import TetMesh
from collocation_sysid.fem.meshing import box_mesh, cylinder_mesh, tetrahedralize_surface
from collocation_sysid.fem.selection import Ball, Box, Indices, Named

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
TWO_POINTS = np.vstack([CORNERS, [[1, 1, 1]]])
TWO_TETS = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])


@pytest.fixture
def box() -> TetMesh:
    return box_mesh((0.1, 0.04, 0.03), (5, 2, 2))


def face_areas(mesh: TetMesh) -> np.ndarray:
    a, b, c = mesh.points_m[mesh.surface].transpose(1, 0, 2)
    return np.cross(b - a, c - a) / 2


def cube_surface(size_m=(0.1, 0.04, 0.04)) -> tuple[np.ndarray, np.ndarray]:
    mesh = box_mesh(size_m, (1, 1, 1))
    return mesh.points_m, mesh.surface


def write_file(path: Path, points: np.ndarray, cells: Any) -> None:
    meshio.write(path, meshio.Mesh(points, cells))


def is_conforming(mesh: TetMesh) -> bool:
    """Every edge of the boundary is shared by exactly two of its triangles."""
    edges = np.sort(mesh.surface[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] == 2).all())


# --- structured meshes and what a mesh measures


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
    with pytest.raises(InputError, match="needs"):
        make()


def test_edges_are_unique_and_sorted():
    edges = TetMesh(TWO_POINTS, TWO_TETS).edges
    np.testing.assert_array_equal(
        edges, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [1, 4], [2, 3], [2, 4], [3, 4]]
    )


def test_quality_is_one_for_the_regular_tetrahedron():
    regular = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    quality = TetMesh(regular, [[0, 1, 2, 3]]).quality()
    assert quality.quality_min == pytest.approx(1.0)
    assert quality.edge_min_m == pytest.approx(np.sqrt(8))
    assert quality.edge_max_m == pytest.approx(np.sqrt(8))


def test_quality_names_the_worst_element_in_a_sentence():
    points = np.vstack([CORNERS, [[0.4, 0.4, 0.4]]])
    quality = TetMesh(points, [[0, 1, 2, 3], [1, 2, 3, 4]]).quality()
    assert quality.worst_element == 1
    assert quality.quality_min < quality.quality_median < 1
    assert "5 nodes, 2 tetrahedra" in quality.describe()
    assert "element 1" in quality.describe()


def test_arrays_are_read_only(box):
    for array in (box.points_m, box.tetrahedra, box.file_index, box.volumes_m3, box.surface):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_the_callers_arrays_stay_their_own():
    points = CORNERS.copy()
    mesh = TetMesh(points, [[0, 1, 2, 3]])
    points[0] = 9.0
    np.testing.assert_array_equal(mesh.points_m, CORNERS)


def test_hash_tells_meshes_apart(box):
    same = TetMesh(box.points_m, box.tetrahedra)
    moved = TetMesh(np.nextafter(box.points_m, 1.0), box.tetrahedra)
    assert box.sha256 == same.sha256
    assert box.sha256 != moved.sha256
    assert len(box.sha256) == 64


def test_meshio_is_imported_only_to_read_and_write():
    code = "import sys, collocation_sysid.fem.meshing; sys.exit('meshio' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_a_mesh_survives_pickling(box):
    assert pickle.loads(pickle.dumps(box)).sha256 == box.sha256


# --- cleaning


def test_negative_elements_are_reoriented_and_noted(box):
    tetrahedra = box.tetrahedra.copy()
    tetrahedra[[3, 70]] = tetrahedra[[3, 70]][:, [0, 2, 1, 3]]
    mesh = TetMesh(box.points_m, tetrahedra)
    assert (mesh.volumes_m3 > 0).all()
    np.testing.assert_array_equal(np.sort(mesh.tetrahedra), np.sort(box.tetrahedra))
    assert mesh.notes == ("2 of 120 elements had a negative volume and were re-oriented.",)


def test_unreferenced_nodes_are_dropped_with_their_values_and_noted():
    points = np.insert(CORNERS, 2, [[7.0, 7, np.nan]], axis=0)
    mesh = TetMesh(points, [[0, 1, 3, 4]], {"id": np.arange(5)})
    np.testing.assert_array_equal(mesh.points_m, CORNERS)
    np.testing.assert_array_equal(mesh.tetrahedra, [[0, 1, 2, 3]])
    np.testing.assert_array_equal(mesh.file_index, [0, 1, 3, 4])
    np.testing.assert_array_equal(mesh.point_arrays["id"], [0, 1, 3, 4])
    assert mesh.file_node_count == 5
    assert "1 of 5 nodes were dropped (node 2 is the first)" in mesh.notes[0]


def test_unconnected_parts_are_noted_with_coincident_nodes():
    far = TetMesh(np.vstack([CORNERS, CORNERS + 5]), [[0, 1, 2, 3], [4, 5, 6, 7]])
    assert "2 unconnected parts" in far.notes[0]
    assert "merge" not in far.notes[0]
    torn = TetMesh(np.vstack([CORNERS, -CORNERS]), [[0, 1, 2, 3], [4, 6, 5, 7]])
    assert "1 of 8 nodes lie exactly on others" in torn.notes[0]


# --- refusals


@pytest.mark.parametrize(
    ("points", "tets", "message"),
    [
        (CORNERS[:, :2], [[0, 1, 2, 3]], r"shape \(n, 3\), not \(4, 2\)"),
        (CORNERS, [[0, 1, 2]], r"shape \(E, 4\) with E > 0, not \(1, 3\)"),
        (CORNERS, np.empty((0, 4), int), r"E > 0"),
        (CORNERS, [[0.0, 1.0, 2.0, 3.0]], "integer node numbers, not float64"),
        (CORNERS, [[0, 1, 2, 9]], r"element 0 has nodes \[0, 1, 2, 9\], but there are 4 nodes"),
        (CORNERS, [[0, 1, 2, -1]], "element 0 has nodes"),
        (CORNERS, [[1, 2, 3, 4]], "they seem to count from 1"),
        (CORNERS * [1, 1, np.nan], [[0, 1, 2, 3]], "node 0 lies at .*nan"),
        (TWO_POINTS, [[0, 1, 2, 3], [3, 1, 0, 2]], "element 1 has the same nodes .* as element 0"),
        (CORNERS * [1, 1, 1e-9], [[0, 1, 2, 3]], "element 0 .* is degenerate: its volume is 1.67e"),
        (CORNERS, [[0, 1, 2, 2]], "degenerate: its volume is 0 m³"),
    ],
)
def test_bad_arrays_are_refused_with_the_reason(points, tets, message):
    with pytest.raises(InputError, match=message):
        TetMesh(points, tets)


def test_degeneracy_is_relative_to_the_elements_size():
    assert TetMesh(CORNERS * 1e-6, [[0, 1, 2, 3]]).volume_m3 == pytest.approx(1e-18 / 6)


def test_point_arrays_must_have_a_value_per_node():
    with pytest.raises(InputError, match='point array "grip" has shape'):
        TetMesh(CORNERS, [[0, 1, 2, 3]], {"grip": [1, 0]})


# --- files


@pytest.mark.parametrize("ending", ["vtu", "vtk", "msh", "mesh", "inp"])
def test_a_written_mesh_reads_back(tmp_path, ending, box):
    box.write(tmp_path / f"box.{ending}")
    again = TetMesh.read(tmp_path / f"box.{ending}")
    np.testing.assert_array_equal(again.tetrahedra, box.tetrahedra)
    np.testing.assert_allclose(again.points_m, box.points_m, atol=1e-12)


def test_vtu_keeps_every_bit_and_the_point_arrays(tmp_path, box):
    grip = box.points_m[:, 0] == 0
    TetMesh(box.points_m, box.tetrahedra, {"grip": grip}).write(tmp_path / "box.vtu")
    again = TetMesh.read(tmp_path / "box.vtu")
    assert again.sha256 == box.sha256
    np.testing.assert_array_equal(again.point_arrays["grip"], grip)


@pytest.mark.parametrize(
    ("unit", "metres"), [("m", 1), ("cm", 0.01), ("mm", 1e-3), ("um", 1e-6), ("in", 0.0254)]
)
def test_length_units_scale_to_metres(tmp_path, unit, metres):
    write_file(tmp_path / "tet.vtu", CORNERS, [("tetra", [[0, 1, 2, 3]])])
    mesh = TetMesh.read(tmp_path / "tet.vtu", length_unit=unit)
    assert mesh.volume_m3 == pytest.approx(metres**3 / 6)


def test_an_unknown_length_unit_lists_the_known_ones(tmp_path):
    with pytest.raises(InputError, match='\'ft\' is unknown; use one of "m", "cm", "mm"'):
        TetMesh.read(tmp_path / "tet.vtu", length_unit="ft")


def test_mixed_cells_keep_the_tetrahedra_and_say_so(tmp_path):
    cells = [("triangle", np.array([[0, 1, 2]])), ("tetra", TWO_TETS[:1]), ("tetra", TWO_TETS[1:])]
    write_file(tmp_path / "mixed.vtu", TWO_POINTS, cells)
    mesh = TetMesh.read(tmp_path / "mixed.vtu")
    assert len(mesh.tetrahedra) == 2
    assert mesh.notes[0] == "Cells other than tetrahedra were left out (1 triangle)."


def test_left_out_solid_cells_are_called_missing(tmp_path):
    cells = [("tetra", [[0, 1, 2, 3]]), ("pyramid", [[0, 1, 2, 3, 4]])]
    write_file(tmp_path / "mixed.vtu", TWO_POINTS, cells)
    assert "that part of the body is missing" in TetMesh.read(tmp_path / "mixed.vtu").notes[0]


def test_point_sets_of_the_file_can_be_selected(tmp_path):
    mesh = meshio.Mesh(CORNERS, [("tetra", [[0, 1, 2, 3]])], point_sets={"grip": [1, 3]})
    meshio.write(tmp_path / "tet.inp", mesh)
    read = TetMesh.read(tmp_path / "tet.inp")
    np.testing.assert_array_equal(read.select(Named("grip")), [1, 3])


def test_a_file_without_tetrahedra_tells_what_it_holds(tmp_path):
    write_file(tmp_path / "shell.vtu", CORNERS, [("triangle", [[0, 1, 2]])])
    with pytest.raises(InputError, match="no tetrahedra in this file, found 1 triangle; a closed"):
        TetMesh.read(tmp_path / "shell.vtu")


def test_quadratic_tetrahedra_are_not_supported_yet(tmp_path):
    cells = [("tetra10", [list(range(10))])]
    write_file(tmp_path / "curved.vtu", np.eye(10, 3), cells)
    with pytest.raises(InputError, match=r"1 tetra10.*quadratic element and not supported yet"):
        TetMesh.read(tmp_path / "curved.vtu")


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("absent.vtu", None, "there is no such file"),
        ("notes.docx", b"hello", "Could not deduce file format"),
        ("broken.vtu", b"<VTKFile", "cannot be read as a mesh"),
        ("broken.msh", b"\x00\x01\x02", "cannot be read as a mesh"),
        ("broken.vtk", b"# vtk DataFile Version 3.0\nx\nASCII\nnonsense", "cannot be read"),
        ("empty.inp", b"", "no cells at all|cannot be read|shape"),
    ],
)
def test_unreadable_files_give_one_error_and_print_nothing(tmp_path, capfd, name, content, reason):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=reason) as caught:
        TetMesh.read(path)
    assert caught.value.source == path
    assert capfd.readouterr() == ("", "")


def test_refusals_of_a_files_mesh_name_the_file(tmp_path):
    write_file(tmp_path / "flat.vtu", CORNERS, [("tetra", [[0, 1, 2, 2]])])
    with pytest.raises(InputError, match=r"flat\.vtu: element 0 .*degenerate"):
        TetMesh.read(tmp_path / "flat.vtu")


def test_writing_to_an_unknown_format_is_refused(tmp_path, box):
    with pytest.raises(InputError, match="cannot be written"):
        box.write(tmp_path / "mesh.docx")


# --- selections


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
    with pytest.raises(InputError, match='no point array "grp"; it has "grip", "tip"'):
        mesh.select(Named("grp"))
    with pytest.raises(InputError, match="it has none"):
        box.select(Named("grip"))


def test_a_named_array_must_be_a_mask():
    arrays = {"heat": [0.0, 1, 2, 3], "velocity": np.zeros((4, 3))}
    mesh = TetMesh(CORNERS, [[0, 1, 2, 3]], arrays)
    with pytest.raises(InputError, match=r'"heat" holds 2\.0'):
        mesh.select(Named("heat"))
    with pytest.raises(InputError, match='"velocity" has 3 values per node'):
        mesh.select(Named("velocity"))


@pytest.mark.parametrize("selection", [Box([5, 5, 5], [6, 6, 6]), Ball([5, 5, 5], 1), Indices([])])
def test_an_empty_selection_tells_where_the_body_is(box, selection):
    with pytest.raises(InputError, match=r"selects none of the 54 nodes.*x from 0 to 0\.1 m"):
        box.select(selection)


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        (Box, ([1, 0, 0], [0, 1, 1]), "low corner has x = 1 m, above 0 m"),
        (Box, ([0, 0], [1, 1, 1]), "low_m must be three numbers"),
        (Box, ([0, 0, "a"], [1, 1, 1]), "low_m must be three numbers"),
        (Ball, ([0, 0, 0], 0), "radius_m must be a positive number"),
        (Ball, ([0, 0, np.nan], 1), "center_m must be three numbers"),
        (Indices, ([1.5],), "whole node numbers"),
        (Indices, ([True],), "whole node numbers"),
    ],
)
def test_ill_formed_selections_are_refused(kind, values, message):
    with pytest.raises(InputError, match=message):
        kind(*values)


def test_selections_with_the_same_values_are_equal():
    assert Box([0, 0, 0], [1, 1, 1]) == Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    assert hash(Indices([1, 2])) == hash(Indices((1, 2)))


# --- surfaces


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
    [(0.5, "over half the surface's diagonal"), (1e-4, "more than 2e"), (-1, "positive number")],
)
def test_an_edge_length_that_does_not_suit_the_surface_is_refused(edge_length_m, message):
    with pytest.raises(InputError, match=message):
        tetrahedralize_surface(*cube_surface(), edge_length_m)


def test_a_missing_mesher_is_named_with_the_remedy(monkeypatch):
    def absent(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(meshing, "version", absent)
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
    merged, faces = meshing.merge_coincident(*meshing.read_surface(path))
    assert merged.shape == (8, 3)
    assert faces.shape == (12, 3)
    assert abs(np.linalg.det(merged[faces]).sum() / 6) == pytest.approx(1.6e-4, rel=1e-5)


def test_quadrilaterals_are_split(tmp_path):
    (tmp_path / "square.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    _, triangles = meshing.read_surface(tmp_path / "square.obj")
    np.testing.assert_array_equal(triangles, [[0, 1, 2], [0, 2, 3]])


def test_an_open_surface_file_is_named(tmp_path):
    (tmp_path / "square.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    with pytest.raises(InputError, match=r"square\.obj: the surface is not closed: 4 open edges"):
        TetMesh.from_surface(tmp_path / "square.obj", 0.1)


def test_pytetwild_fills_a_surface_and_the_cache_repeats_it(tmp_path, monkeypatch):
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


def test_a_cache_folder_that_cannot_be_made_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(meshing, "version", lambda name: "0")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="folder to keep meshes in cannot be made"):
        tetrahedralize_surface(*cube_surface(), 0.02, cache_dir=tmp_path / "file" / "cache")


def test_a_surface_of_arrays_is_scaled_by_its_unit():
    points, triangles = cube_surface((100.0, 40.0, 40.0))
    with pytest.raises(InputError, match=r"measures 0\.1 × 0\.04 × 0\.04 m: check"):
        TetMesh.from_surface((points, triangles), 20.0, length_unit="mm")


def test_a_mesher_that_fails_is_reported_with_its_last_words(monkeypatch):
    monkeypatch.setattr(meshing, "_WORKER", "raise RuntimeError('no inside')")
    monkeypatch.setattr(meshing, "version", lambda name: "0")
    with pytest.raises(InputError, match=r"could not fill the surface .*no inside"):
        tetrahedralize_surface(*cube_surface(), 0.02)
