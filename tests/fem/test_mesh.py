"""Meshes: measures, cleaning, refusals and files."""

from __future__ import annotations

import pickle
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.elements import EDGES
from collocation_sysid.fem.meshes import files as mesh_files
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.fem.meshes.selection import Named
from collocation_sysid.fem.meshes.structured import box_mesh

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
TWO_POINTS = np.vstack([CORNERS, [[1, 1, 1]]])
TWO_TETS = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])


@pytest.fixture
def box() -> TetMesh:
    return box_mesh((0.1, 0.04, 0.03), (5, 2, 2))


def write_file(path: Path, points: np.ndarray, cells: Any) -> None:
    meshio.write(path, meshio.Mesh(points, cells))


# --- what a mesh measures


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


def test_quality_of_a_flat_element_is_below_the_median():
    points = np.vstack([CORNERS, [[0.4, 0.4, 0.4]]])
    quality = TetMesh(points, [[0, 1, 2, 3], [1, 2, 3, 4]]).quality()
    assert quality.quality_min < quality.quality_median < 1


def test_arrays_are_read_only(box):
    for array in (box.points_m, box.tetrahedra, box.file_index, box.volumes_m3, box.surface):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_the_callers_arrays_stay_their_own():
    points = CORNERS.copy()
    mesh = TetMesh(points, [[0, 1, 2, 3]])
    points[0] = 9.0
    np.testing.assert_array_equal(mesh.points_m, CORNERS)


def test_hash_distinguishes_meshes(box):
    same = TetMesh(box.points_m, box.tetrahedra)
    moved = TetMesh(np.nextafter(box.points_m, 1.0), box.tetrahedra)
    assert box.sha256 == same.sha256
    assert box.sha256 != moved.sha256
    assert len(box.sha256) == 64


def test_meshio_is_imported_only_to_read_and_write():
    code = "import sys, collocation_sysid.fem.meshes.mesh; sys.exit('meshio' in sys.modules)"
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
    assert mesh.notes == (
        "2 of 120 elements had a negative volume and were re-oriented, which is harmless.",
    )


def test_unreferenced_nodes_are_dropped_with_their_values_and_noted():
    points = np.insert(CORNERS, 2, [[7.0, 7, np.nan]], axis=0)
    mesh = TetMesh(points, [[0, 1, 3, 4]], {"id": np.arange(5)})
    np.testing.assert_array_equal(mesh.points_m, CORNERS)
    np.testing.assert_array_equal(mesh.tetrahedra, [[0, 1, 2, 3]])
    np.testing.assert_array_equal(mesh.file_index, [0, 1, 3, 4])
    np.testing.assert_array_equal(mesh.point_arrays["id"], [0, 1, 3, 4])
    assert mesh.file_node_count == 5
    assert "1 of 5 nodes were dropped (the first is node 2)" in mesh.notes[0]


def test_unconnected_parts_are_noted_with_coincident_nodes():
    far = TetMesh(np.vstack([CORNERS, CORNERS + 5]), [[0, 1, 2, 3], [4, 5, 6, 7]])
    assert "2 unconnected parts" in far.notes[0]
    assert "merge" not in far.notes[0]
    torn = TetMesh(np.vstack([CORNERS, -CORNERS]), [[0, 1, 2, 3], [4, 6, 5, 7]])
    assert "1 of 8 nodes coincide with other nodes" in torn.notes[0]


# --- refusals


@pytest.mark.parametrize(
    ("points", "tets", "message"),
    [
        (CORNERS[:, :2], [[0, 1, 2, 3]], r"shape \(4, 2\); expected \(any, 3\)"),
        (CORNERS, [[0, 1, 2]], r"shape \(E, 4\) with E > 0, not \(1, 3\)"),
        (CORNERS, np.empty((0, 4), int), r"E > 0"),
        (CORNERS, [[0.0, 1.0, 2.0, 3.0]], "integer node indices from 0, not float64"),
        (
            CORNERS,
            [[0, 1, 2, 9]],
            r"element 0 has nodes \[0, 1, 2, 9\]; expected indices from 0 to 3",
        ),
        (CORNERS, [[0, 1, 2, -1]], "element 0 has nodes"),
        (CORNERS, [[1, 2, 3, 4]], "the indices seem to count from 1"),
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


def test_cell_arrays_must_have_a_value_per_element():
    with pytest.raises(InputError, match='cell array "core" has shape'):
        TetMesh(CORNERS, [[0, 1, 2, 3]], None, {"core": [1, 0]})


def test_cell_arrays_are_kept_and_read_only():
    mesh = TetMesh(TWO_POINTS, TWO_TETS, None, {"core": [True, False], "stress": [[1, 2], [3, 4]]})
    np.testing.assert_array_equal(mesh.cell_arrays["core"], [True, False])
    assert mesh.cell_arrays["stress"].shape == (2, 2)
    with pytest.raises(ValueError, match="read-only"):
        mesh.cell_arrays["core"][0] = False


def test_centres_are_the_means_of_the_corners(box):
    np.testing.assert_allclose(box.centres_m, box.points_m[box.tetrahedra].mean(axis=1))


# --- files


@pytest.mark.parametrize("ending", ["vtu", "vtk", "msh", "mesh", "inp", "xdmf"])
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


def test_mixed_cells_keep_the_tetrahedra_with_a_note(tmp_path):
    cells = [("triangle", np.array([[0, 1, 2]])), ("tetra", TWO_TETS[:1]), ("tetra", TWO_TETS[1:])]
    write_file(tmp_path / "mixed.vtu", TWO_POINTS, cells)
    mesh = TetMesh.read(tmp_path / "mixed.vtu")
    assert len(mesh.tetrahedra) == 2
    assert mesh.notes[0] == "Cells other than tetrahedra were left out (1 triangle)."


def test_left_out_solid_cells_are_called_missing(tmp_path):
    cells = [("tetra", [[0, 1, 2, 3]]), ("pyramid", [[0, 1, 2, 3, 4]])]
    write_file(tmp_path / "mixed.vtu", TWO_POINTS, cells)
    assert "this part of the body is missing" in TetMesh.read(tmp_path / "mixed.vtu").notes[0]


def test_point_sets_of_the_file_can_be_selected(tmp_path):
    mesh = meshio.Mesh(CORNERS, [("tetra", [[0, 1, 2, 3]])], point_sets={"grip": [1, 3]})
    meshio.write(tmp_path / "tet.inp", mesh)
    read = TetMesh.read(tmp_path / "tet.inp")
    np.testing.assert_array_equal(read.select(Named("grip")), [1, 3])


@pytest.mark.parametrize("ending", ["vtu", "vtk"])
def test_cell_arrays_are_written_and_read_back(tmp_path, ending):
    arrays = {"core": np.array([True, False]), "modulus": np.array([2.5, 7.0])}
    TetMesh(TWO_POINTS, TWO_TETS, None, arrays).write(tmp_path / f"two.{ending}")
    again = TetMesh.read(tmp_path / f"two.{ending}")
    np.testing.assert_array_equal(again.cell_arrays["core"], [1, 0])
    np.testing.assert_array_equal(again.cell_arrays["modulus"], [2.5, 7.0])
    np.testing.assert_array_equal(Named("core").resolve_cells(again), [0])


def test_cell_arrays_are_those_of_the_tetrahedra_in_a_mixed_file(tmp_path):
    cells = [("tetra", TWO_TETS[:1]), ("triangle", [[0, 1, 2]]), ("tetra", TWO_TETS[1:])]
    tags = {"tag": [np.array([5]), np.array([9]), np.array([7])]}
    meshio.write(tmp_path / "mixed.vtu", meshio.Mesh(TWO_POINTS, cells, cell_data=tags))
    np.testing.assert_array_equal(TetMesh.read(tmp_path / "mixed.vtu").cell_arrays["tag"], [5, 7])


def test_cell_sets_of_the_file_can_be_selected(tmp_path):
    mesh = meshio.Mesh(TWO_POINTS, [("tetra", TWO_TETS)], cell_sets={"core": [[1]]})
    meshio.write(tmp_path / "two.inp", mesh)
    read = TetMesh.read(tmp_path / "two.inp")
    np.testing.assert_array_equal(Named("core").resolve_cells(read), [1])


# Two tetrahedra in groups of their own; a face in a group with the tag of the first's.
MSH_FILES = {
    "2.2": """\
$MeshFormat
2.2 0 8
$EndMeshFormat
$PhysicalNames
3
2 1 "floor"
3 1 "core"
3 2 "skin"
$EndPhysicalNames
$Nodes
5
1 0 0 0
2 1 0 0
3 0 1 0
4 0 0 1
5 1 1 1
$EndNodes
$Elements
4
1 2 2 1 1 1 2 3
2 2 2 5 2 3 4 5
3 4 2 1 1 1 2 3 4
4 4 2 2 2 2 3 4 5
$EndElements
""",
    "4.1": """\
$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
3
2 1 "floor"
3 1 "core"
3 2 "skin"
$EndPhysicalNames
$Entities
0 0 2 2
1 0 0 0 1 1 0 1 1 0
2 0 0 0 1 1 1 1 5 0
1 0 0 0 1 1 1 1 1 1 1
2 0 0 0 1 1 1 1 2 1 2
$EndEntities
$Nodes
1 5 1 5
3 1 0 5
1
2
3
4
5
0 0 0
1 0 0
0 1 0
0 0 1
1 1 1
$EndNodes
$Elements
4 4 1 4
2 1 2 1
1 1 2 3
2 2 2 1
2 3 4 5
3 1 4 1
3 1 2 3 4
3 2 4 1
4 2 3 4 5
$EndElements
""",
}


@pytest.mark.parametrize("version", MSH_FILES)
def test_physical_groups_are_cells_and_nodes_by_name_and_dimension(tmp_path, version):
    (tmp_path / "two.msh").write_text(MSH_FILES[version])
    mesh = TetMesh.read(tmp_path / "two.msh")
    assert len(mesh.tetrahedra) == 2
    np.testing.assert_array_equal(Named("core").resolve_cells(mesh), [0])
    np.testing.assert_array_equal(Named("skin").resolve_cells(mesh), [1])
    np.testing.assert_array_equal(mesh.select(Named("core")), [0, 1, 2, 3])
    np.testing.assert_array_equal(mesh.select(Named("skin")), [1, 2, 3, 4])
    # A group of faces has nodes only, though its tag is the one of a group of cells.
    np.testing.assert_array_equal(mesh.select(Named("floor")), [0, 1, 2])
    with pytest.raises(InputError, match='no cell array or group "floor"; it has "core", "skin"'):
        Named("floor").resolve_cells(mesh)


def without_groups(version: str, dimension: int) -> str:
    """The file in which one entity, or one element, belongs to no physical group."""
    changes = {
        ("2.2", 2): ("2 2 2 5 2 3 4 5", "2 2 2 0 2 3 4 5"),
        ("2.2", 3): ("4 4 2 2 2 2 3 4 5", "4 4 2 0 2 2 3 4 5"),
        ("4.1", 2): ("2 0 0 0 1 1 1 1 5 0", "2 0 0 0 1 1 1 0 0"),
        ("4.1", 3): ("2 0 0 0 1 1 1 1 2 1 2", "2 0 0 0 1 1 1 0 1 2"),
    }
    old, new = changes[version, dimension]
    assert old in MSH_FILES[version]
    return MSH_FILES[version].replace(old, new)


@pytest.mark.parametrize("dimension", [2, 3])
def test_entities_without_a_group_are_read_in_one_version_and_named_in_the_other(
    tmp_path, dimension
):
    file = tmp_path / "two.msh"
    file.write_text(without_groups("2.2", dimension))
    assert len(TetMesh.read(file).tetrahedra) == 2
    file.write_text(without_groups("4.1", dimension))
    with pytest.raises(InputError, match=r"others to none; .*Mesh.SaveAll = 0.* = 2\.2") as caught:
        TetMesh.read(file)
    assert caught.value.source == file


@pytest.mark.parametrize("version", MSH_FILES)
def test_parametric_coordinates_of_nodes_are_named(tmp_path, version):
    content = {
        "2.2": MSH_FILES["2.2"].replace("Nodes\n", "ParametricNodes\n"),
        "4.1": MSH_FILES["4.1"].replace("3 1 0 5", "3 1 1 5"),
    }[version]
    assert content != MSH_FILES[version]
    (tmp_path / "two.msh").write_text(content)
    with pytest.raises(InputError, match=r"saved with Mesh\.SaveParametric = 0"):
        TetMesh.read(tmp_path / "two.msh")


@pytest.mark.parametrize("version", MSH_FILES)
def test_groups_without_a_name_are_called_by_their_tag(tmp_path, version):
    (tmp_path / "two.msh").write_text(MSH_FILES[version])
    mesh = TetMesh.read(tmp_path / "two.msh")
    np.testing.assert_array_equal(mesh.select(Named("physical_5")), [2, 3, 4])


def write_clamped(path: Path, file_format: str, names: dict[str, tuple[int, int]]) -> TetMesh:
    """A bar whose end face is in a group of triangles, with a node in front that no cell has."""
    bar = box_mesh((0.1, 0.04, 0.03), (3, 2, 2))
    at_end = np.isclose(bar.points_m[bar.surface][:, :, 0], 0.0).all(axis=1)
    cells = [bar.surface[at_end] + 1, bar.tetrahedra + 1]
    tags = [np.full(len(block), 7) for block in cells]
    entities = np.full((1 + len(bar.points_m), 2), (3, 1))
    entities[cells[0].ravel()] = 2, 1
    mesh = meshio.Mesh(
        np.insert(bar.points_m, 0, 9.0, axis=0),
        list(zip(("triangle", "tetra"), cells, strict=True)),
        point_data={"gmsh:dim_tags": entities},
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": [np.ones_like(t) for t in tags]},
        field_data={name: np.array(key) for name, key in names.items()},
    )
    meshio.write(path, mesh, file_format, binary=False)
    return bar


@pytest.mark.parametrize("file_format", ["gmsh22", "gmsh"])  # 2.2 and 4.1
def test_a_group_of_faces_can_be_clamped(tmp_path, file_format):
    file = tmp_path / "bar.msh"
    bar = write_clamped(file, file_format, {"clamp": (7, 2), "foam": (7, 3)})
    mesh = TetMesh.read(file)
    expected = np.flatnonzero(np.isclose(mesh.points_m[:, 0], 0.0))
    assert len(expected) == 9
    assert mesh.file_node_count == len(bar.points_m) + 1
    np.testing.assert_array_equal(mesh.select(Named("clamp")), expected)
    assert len(mesh.select(Named("foam"))) == len(bar.points_m)
    body = Body(mesh, density_kg_m3=30.0, element="tet10")
    at_end = np.flatnonzero(np.isclose(body.nodes_m[:, 0], 0.0))
    np.testing.assert_array_equal(body.select(Named("clamp")), at_end)
    message = 'no point array or group "clmp"; it has "clamp", "foam"; did you mean \'clamp\'?'
    with pytest.raises(InputError, match=re.escape(message)):
        mesh.select(Named("clmp"))


@pytest.mark.parametrize("file_format", ["gmsh22", "gmsh"])
def test_unnamed_groups_of_one_tag_and_two_dimensions_are_distinguished(tmp_path, file_format):
    write_clamped(tmp_path / "bar.msh", file_format, {})
    mesh = TetMesh.read(tmp_path / "bar.msh")
    assert len(mesh.select(Named("physical_7_surface"))) == 9
    assert len(mesh.select(Named("physical_7_volume"))) == len(mesh.points_m)
    with pytest.raises(InputError, match='it has "physical_7_surface", "physical_7_volume"'):
        mesh.select(Named("physical_7"))


def test_a_cell_of_several_groups_is_in_every_group(tmp_path):
    entity = "1 0 0 0 1 1 1 {} 1 1\n"
    assert entity.format("1 1") in MSH_FILES["4.1"]
    both = MSH_FILES["4.1"].replace(entity.format("1 1"), entity.format("2 1 2"))
    (tmp_path / "two.msh").write_text(both)
    mesh = TetMesh.read(tmp_path / "two.msh")
    np.testing.assert_array_equal(Named("core").resolve_cells(mesh), [0])
    np.testing.assert_array_equal(Named("skin").resolve_cells(mesh), [0, 1])
    np.testing.assert_array_equal(mesh.select(Named("skin")), np.arange(5))


def test_a_file_without_tetrahedra_is_refused_with_its_content(tmp_path):
    write_file(tmp_path / "shell.vtu", CORNERS, [("triangle", [[0, 1, 2]])])
    with pytest.raises(InputError, match=r"found 1 triangle, but no tetrahedra; .*; a closed"):
        TetMesh.read(tmp_path / "shell.vtu")


MIDDLES = [CORNERS[[a, b]].mean(axis=0) for a, b in EDGES]


def write_quadratic(path: Path, off: float = 0.0, cell: Any = range(10)) -> Path:
    """One quadratic tetrahedron, the last of its mid nodes off the middle."""
    points = np.vstack([CORNERS, MIDDLES])
    points[9] += [off, 0, 0]
    file_format = "gmsh" if path.suffix == ".msh" else None
    meshio.write(path, meshio.Mesh(points, [("tetra10", [list(cell)])]), file_format)
    return path


@pytest.mark.parametrize("ending", ["vtu", "vtk", "msh", "inp"])
def test_quadratic_tetrahedra_are_taken_by_their_corners(tmp_path, ending):
    mesh = TetMesh.read(write_quadratic(tmp_path / f"a.{ending}"))
    np.testing.assert_array_equal(mesh.points_m, CORNERS)
    np.testing.assert_array_equal(mesh.tetrahedra, [[0, 1, 2, 3]])
    (note,) = mesh.notes
    assert (
        "6 of 10 nodes were dropped (the first is node 4), because no tetrahedron has them as a corner"
    ) in note


def test_linear_and_quadratic_tetrahedra_may_be_in_one_file(tmp_path):
    points = np.vstack([CORNERS, MIDDLES, [[1, 1, 1]]])
    write_file(
        tmp_path / "a.vtu", points, [("tetra10", [list(range(10))]), ("tetra", [[1, 2, 3, 10]])]
    )
    mesh = TetMesh.read(tmp_path / "a.vtu")
    np.testing.assert_array_equal(np.sort(mesh.tetrahedra), [[0, 1, 2, 3], [1, 2, 3, 4]])


def test_slightly_curved_sides_are_straightened_and_noted(tmp_path):
    mesh = TetMesh.read(write_quadratic(tmp_path / "a.vtu", off=0.03 * np.sqrt(2)))
    assert "1 mid nodes lie off the middle of their edges, by up to 0.03 of" in mesh.notes[0]


def test_strongly_curved_sides_are_refused_with_the_worst(tmp_path):
    file = write_quadratic(tmp_path / "curved.vtu", off=0.2)
    message = r"curved\.vtu: .* mid node 9 lies 0\.2 m off .* node 2 to node 3, which is 1\.41 m"
    with pytest.raises(InputError, match=message):
        TetMesh.read(file)


def test_mid_nodes_in_another_order_are_refused(tmp_path):
    file = write_quadratic(tmp_path / "a.vtu", cell=[0, 1, 2, 3, 4, 6, 5, 7, 8, 9])
    with pytest.raises(InputError, match="mid node 6 lies"):
        TetMesh.read(file)


def test_mid_nodes_that_are_not_there_are_refused(tmp_path):
    file = write_quadratic(tmp_path / "a.vtu", cell=[*range(9), 10])
    with pytest.raises(InputError, match=r"8, 10\]; expected indices from 0 to 9"):
        TetMesh.read(file)


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


def test_a_format_names_the_package_that_it_needs(tmp_path, monkeypatch):
    def read_content(path):
        raise InputError("ModuleNotFoundError: No module named 'h5py'")

    monkeypatch.setattr(mesh_files, "read_content", read_content)
    (tmp_path / "beam.xdmf").write_text("<Xdmf/>")
    with pytest.raises(InputError, match=r"\.xdmf needs the package h5py.*pip install h5py"):
        TetMesh.read(tmp_path / "beam.xdmf")


def test_refusals_of_a_files_mesh_name_the_file(tmp_path):
    write_file(tmp_path / "flat.vtu", CORNERS, [("tetra", [[0, 1, 2, 2]])])
    with pytest.raises(InputError, match=r"flat\.vtu: element 0 .*degenerate"):
        TetMesh.read(tmp_path / "flat.vtu")


def test_writing_to_an_unknown_format_is_refused(tmp_path, box):
    with pytest.raises(InputError, match="cannot be written"):
        box.write(tmp_path / "mesh.docx")
