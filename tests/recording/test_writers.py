"""Writers of markers, poses and wrenches, read back."""

from __future__ import annotations

import os
import shutil
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import meshio
import numpy as np
import pytest

from collocation_sysid.common.files import write_text_file
from collocation_sysid.common.written_files import LIST_FILE, list_files
from collocation_sysid.errors import InputError
from collocation_sysid.fem.body import Body
from collocation_sysid.fem.elements import element_named
from collocation_sysid.fem.meshes.structured import box_mesh
from collocation_sysid.result.element_fields import ElementFields
from collocation_sysid.result.run_writers import replaced_folder, write_frames, write_pvd, write_vtu

MESH = box_mesh((0.1, 0.2, 0.3), (1, 2, 1))
TET4 = element_named("tet4")


def frames_of(listing: Path) -> list[tuple[float, Path]]:
    sets = ElementTree.parse(listing).getroot().iter("DataSet")
    return [(float(s.attrib["timestep"]), listing.parent / s.attrib["file"]) for s in sets]


# VTU


def test_meshio_reads_the_same_numbers(tmp_path, rng):
    n = len(MESH.points_m)
    data = {
        "velocity_m_s": rng.normal(size=(n, 3)),
        "energy_j": rng.normal(size=n).astype(np.float32),
        "number": np.arange(n),
        "held": np.arange(n) % 2 == 0,
        'a "quoted" <name> & more': np.ones(n),
    }
    write_vtu(tmp_path / "a.vtu", MESH.points_m, MESH.tetrahedra, "tetra", data)
    read = meshio.read(tmp_path / "a.vtu")
    np.testing.assert_array_equal(read.points, MESH.points_m)
    np.testing.assert_array_equal(read.cells_dict["tetra"], MESH.tetrahedra)
    assert list(read.point_data) == list(data)
    for name, values in data.items():
        np.testing.assert_array_equal(read.point_data[name], values)


def test_quadratic_tetrahedra_keep_their_type(tmp_path, rng):
    points, cells = rng.normal(size=(10, 3)), np.arange(10)[None]
    write_vtu(tmp_path / "a.vtu", points, cells, "tetra10")
    np.testing.assert_array_equal(meshio.read(tmp_path / "a.vtu").cells_dict["tetra10"], cells)


def test_cell_data_belong_to_the_elements(tmp_path, rng):
    data = {"stress_pa": rng.normal(size=len(MESH.tetrahedra)).astype(np.float32)}
    data["flow"] = rng.normal(size=(len(MESH.tetrahedra), 3))
    write_vtu(tmp_path / "a.vtu", MESH.points_m, MESH.tetrahedra, "tetra", cell_data=data)
    read = meshio.read(tmp_path / "a.vtu")
    for name, values in data.items():
        np.testing.assert_array_equal(read.cell_data[name][0], values)


@pytest.mark.parametrize("where", ["point", "cell"])
def test_data_of_another_length_are_refused(tmp_path, where):
    data = {f"{where}_data": {"speed": [1, 2]}}
    with pytest.raises(InputError, match=f"{where} data 'speed' has shape"):
        write_vtu(tmp_path / "a.vtu", MESH.points_m, MESH.tetrahedra, "tetra", **data)
    assert not (tmp_path / "a.vtu").exists()


def test_unknown_cells_are_refused(tmp_path):
    with pytest.raises(InputError, match="tetra, tetra10"):
        write_vtu(tmp_path / "a.vtu", MESH.points_m, MESH.tetrahedra, "hexahedron")


# Frames


def test_frames_hold_positions_displacements_and_velocities(tmp_path):
    t_s = 0.1 * np.arange(5)
    velocity = np.array([1.0, -2.0, 0.5])
    positions = MESH.points_m + t_s[:, None, None] * velocity
    series = {"temperature": np.outer(t_s, np.ones(len(MESH.points_m)))}
    listing = write_frames(tmp_path, t_s, positions, MESH.tetrahedra, TET4, MESH.points_m, series)
    frames = frames_of(listing)
    np.testing.assert_allclose([time for time, _ in frames], t_s)
    assert frames[3][1] == tmp_path / "frames" / "frame_0003.vtu"
    read = meshio.read(frames[3][1])
    np.testing.assert_array_equal(read.points, positions[3])
    displacement = read.point_data["displacement_m"]
    np.testing.assert_array_equal(displacement, positions[3] - MESH.points_m)
    np.testing.assert_allclose(read.point_data["velocity_m_s"] - velocity, 0, atol=1e-12)
    np.testing.assert_allclose(read.point_data["temperature"], 0.3)


def test_long_trajectories_are_thinned_evenly(tmp_path):
    t_s = 0.01 * np.arange(401)
    still = np.repeat(MESH.points_m[None], 401, axis=0)
    listing = write_frames(tmp_path, t_s, still, MESH.tetrahedra, TET4, MESH.points_m)
    np.testing.assert_allclose([time for time, _ in frames_of(listing)], t_s[::3])
    assert len(list((tmp_path / "frames").iterdir())) == 134


def test_frames_contain_strain_and_stress(tmp_path):
    body = Body(MESH, density_kg_m3=30.0)
    fields = ElementFields.from_body(body, np.array([200.0, 300.0, 0.0, 0.0]))
    stretch = np.linspace(1.0, 1.2, 3)[:, None, None]
    listing = write_frames(
        tmp_path, [0, 1, 2], stretch * MESH.points_m, body.cells, TET4, MESH.points_m, fields=fields
    )
    read = [meshio.read(file).cell_data for _, file in frames_of(listing)]
    assert set(read[0]) == {"det_f", "energy_density_j_m3", "von_mises_pa"}
    volumes = [cells["det_f"][0].mean() for cells in read]
    np.testing.assert_allclose(volumes, [1.0, 1.1**3, 1.2**3])
    assert read[0]["energy_density_j_m3"][0].max() < 1e-12 < read[2]["energy_density_j_m3"][0].min()


def test_frames_follow_the_element(tmp_path):
    positions = np.random.default_rng(0).normal(size=(3, 10, 3))
    cells = np.arange(10)[None]
    write_frames(tmp_path, [0, 1, 2], positions, cells, element_named("tet10"), positions[0])
    assert "tetra10" in meshio.read(tmp_path / "frames" / "frame_0000.vtu").cells_dict


def test_the_animation_can_be_moved_with_its_frames(tmp_path):
    (tmp_path / "deep").mkdir()
    write_pvd(tmp_path / "all.pvd", [(0.5, tmp_path / "deep" / "a&b.vtu")])
    assert 'file="deep/a&amp;b.vtu"' in (tmp_path / "all.pvd").read_text()


# Run folder


def earlier_run(path: Path) -> Path:
    path.mkdir()
    (path / "result.json").write_text("old")
    (path / "old.png").write_text("old")
    list_files(path)
    return path


def listing(folder: Path) -> list[str]:
    files = (file for file in folder.rglob("*") if file.name != LIST_FILE)
    return sorted(str(file.relative_to(folder)) for file in files)


def test_a_run_appears_whole_at_the_end(tmp_path):
    target = tmp_path / "runs" / "swing"
    with replaced_folder(target) as folder:
        (folder / "result.json").write_text("new")
        assert folder.parent == target.parent
        assert not target.exists()
    assert listing(tmp_path) == ["runs", "runs/swing", "runs/swing/result.json"]


def test_the_folder_has_ordinary_permissions(tmp_path):
    (tmp_path / "ordinary").mkdir()
    with replaced_folder(tmp_path / "run"):
        pass
    assert (tmp_path / "run").stat().st_mode == (tmp_path / "ordinary").stat().st_mode


def test_an_earlier_run_is_replaced_whole(tmp_path):
    target = earlier_run(tmp_path / "run")
    with replaced_folder(target) as folder:
        (folder / "result.json").write_text("new")
        assert (target / "result.json").read_text() == "old"
    assert listing(tmp_path) == ["run", "run/result.json"]
    assert (target / "result.json").read_text() == "new"


def test_an_empty_folder_is_used(tmp_path):
    (tmp_path / "run").mkdir()
    with replaced_folder(tmp_path / "run") as folder:
        (folder / "result.json").write_text("new")
    assert listing(tmp_path) == ["run", "run/result.json"]


@pytest.mark.parametrize("failure", [RuntimeError, KeyboardInterrupt])
def test_a_failure_changes_nothing(tmp_path, failure):
    target = earlier_run(tmp_path / "run")
    before = listing(tmp_path)

    def write_half():
        with replaced_folder(target) as folder:
            (folder / "half.txt").write_text("half")
            raise failure

    with pytest.raises(failure):
        write_half()
    assert listing(tmp_path) == before
    assert (target / "result.json").read_text() == "old"


def test_somebody_elses_folder_is_left_alone(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("precious")
    before = listing(tmp_path)
    with (
        pytest.raises(InputError, match=r"thesis.*not an earlier run"),
        replaced_folder(tmp_path / "thesis"),
    ):
        pytest.fail("the work was started")
    assert listing(tmp_path) == before


@pytest.mark.parametrize("foreign", ["notes.txt", "frames/notes.txt", "films/swing.gif"])
def test_an_earlier_run_with_a_foreign_file_is_left_alone(tmp_path, foreign):
    target = earlier_run(tmp_path / "run")
    (target / foreign).parent.mkdir(exist_ok=True)
    (target / foreign).write_text("precious")
    before = listing(tmp_path)
    with (
        pytest.raises(InputError, match=rf"run: {foreign} .* not written"),
        replaced_folder(target),
    ):
        pytest.fail("the work was started")
    assert listing(tmp_path) == before


def test_a_result_file_alone_does_not_make_a_run(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "result.json").write_text("{}")
    (tmp_path / "thesis" / "chapter.tex").write_text("precious")
    with pytest.raises(InputError, match=r"chapter\.tex"), replaced_folder(tmp_path / "thesis"):
        pytest.fail("the work was started")


def test_an_edited_file_keeps_an_earlier_run_from_being_replaced(tmp_path):
    target = earlier_run(tmp_path / "run")
    (target / "old.png").write_text("edited")
    with pytest.raises(InputError, match=r"old\.png .* changed since"), replaced_folder(target):
        pytest.fail("the work was started")


def test_files_added_to_a_run_are_replaced_with_the_run(tmp_path):
    target = earlier_run(tmp_path / "run")
    write_text_file(target / "report.html", "a page")
    write_text_file(target / "old.png", "drawn again")
    with replaced_folder(target / "export-json", marker_file="identified.json") as folder:
        (folder / "identified.json").write_text("{}")
    (target / ".DS_Store").write_text("of a file manager")
    with replaced_folder(target) as folder:
        (folder / "result.json").write_text("new")
    assert listing(target) == ["result.json"]


@pytest.mark.skipif(os.name != "posix", reason="links of POSIX")
def test_nothing_is_written_through_a_link(tmp_path):
    earlier_run(tmp_path / "precious")
    (tmp_path / "run").symlink_to("precious")
    (tmp_path / "later").symlink_to("missing")
    before = listing(tmp_path)
    for name, where in (("run", "precious"), ("later", "missing")):
        with (
            pytest.raises(InputError, match=f"{name}: this is a link to {where}"),
            replaced_folder(tmp_path / name),
        ):
            pytest.fail("the work was started")
    assert listing(tmp_path) == before


@pytest.mark.skipif(os.name != "posix", reason="links of POSIX")
def test_an_earlier_run_with_a_link_is_not_replaced(tmp_path):
    target = earlier_run(tmp_path / "run")
    (target / "old.png").rename(tmp_path / "old.png")
    (target / "old.png").symlink_to(tmp_path / "old.png")
    with (
        pytest.raises(InputError, match=r"old\.png in this folder is a link"),
        replaced_folder(target),
    ):
        pytest.fail("the work was started")


def test_a_moved_or_copied_run_may_be_replaced(tmp_path):
    earlier_run(tmp_path / "run").rename(tmp_path / "moved")
    shutil.copytree(tmp_path / "moved", tmp_path / "copied")
    for name in ("moved", "copied"):
        with replaced_folder(tmp_path / name) as folder:
            (folder / "result.json").write_text("new")


def test_a_file_is_left_alone(tmp_path):
    (tmp_path / "run").write_text("precious")
    with pytest.raises(InputError, match="is a file"), replaced_folder(tmp_path / "run"):
        pytest.fail("the work was started")
    assert (tmp_path / "run").read_text() == "precious"


def test_a_finished_run_is_not_lost_when_its_place_is_taken_meanwhile(tmp_path):
    target = tmp_path / "run"

    def write_too_late():
        with replaced_folder(target) as folder:
            (folder / "result.json").write_text("new")
            target.mkdir()
            (target / "chapter.tex").write_text("precious")

    with pytest.raises(InputError, match="it is kept in") as caught:
        write_too_late()
    (kept,) = tmp_path.glob("run-*")
    assert str(kept) in str(caught.value)
    assert listing(kept) == ["result.json"]
    assert listing(target) == ["chapter.tex"]
