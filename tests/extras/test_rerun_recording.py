"""Recordings for the Rerun viewer, read back by its library."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from kit.problem_files import contents, run_command, write_problem
from kit.rerun_files import read_back, seconds

import collocation_sysid as cs
from collocation_sysid.extras.export import rerun_recording
from collocation_sysid.extras.export.rerun_recording import vertex_colours, write_rerun

pytest.importorskip("rerun")


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rerun")
    file = write_problem(folder, {"swing": 8, "twist": 6}, validation="twist")
    words = ("--out", folder / "run", "-q", "--method", "reduced-space")
    assert run_command("solve", file, *words).code == 0
    return folder / "run"


@pytest.fixture(scope="module")
def recording(run_folder: Path) -> dict[str, dict[str, list]]:
    outcome = run_command("export", run_folder, "--to", "rerun")
    file = run_folder / "export-rerun" / "recording.rrd"
    said = "not expressed: experiment 'twist' has no frames, so that its surface has no stress"
    assert (outcome.code, outcome.out) == (0, f"{said}\n{file}\n")
    return read_back(file)


@pytest.fixture(scope="module")
def arrays(run_folder: Path) -> dict[str, np.ndarray]:
    with np.load(run_folder / "trajectory.npz") as stored:
        return dict(stored)


def test_the_surface_moves_as_the_fit(recording, arrays):
    body = recording["swing/body"]
    nodes = np.unique(arrays["surface"])
    assert seconds(body["time"]) == pytest.approx(arrays["t_s"])
    assert np.array(body["vertex_positions"]) == pytest.approx(
        arrays["positions_m"][:, nodes], abs=1e-7
    )
    (triangles,) = body["static triangle_indices"]
    assert (nodes[np.array(triangles)] == arrays["surface"]).all()


def test_colours_of_a_recording_are_those_of_the_stress(recording, run_folder, arrays):
    import meshio

    frames = sorted((run_folder / "frames").glob("*.vtu"))
    stresses = np.array([meshio.read(f).cell_data["von_mises_pa"][0] for f in frames])
    largest = recording["swing/largest_von_mises_pa"]
    on_surface = np.array([values[0] for values in largest["scalars"]])
    assert (on_surface <= stresses.max(axis=1) * (1 + 1e-6)).all()
    assert (on_surface >= stresses.min(axis=1)).all()
    assert np.ptp(on_surface) > 0
    colours = np.array(recording["swing/body"]["vertex_colors"])
    assert colours.shape == (len(arrays["t_s"]), len(np.unique(arrays["surface"])))
    assert len(np.unique(colours)) > 10
    grey = recording["twist/body"]
    assert "vertex_colors" not in grey
    assert grey["static albedo_factor"]


def test_colours_are_means_of_the_triangles_around_a_vertex():
    faces = np.array([[0, 1, 2], [1, 2, 3]])
    values = np.array([[0.0, 4.0], [np.nan, 8.0]])
    colours = vertex_colours(faces, values, (0.0, 8.0), 5)
    scale = mpl.colormaps["cividis"]
    expected = [[0.0, 0.25, 0.25, 0.5, 0.0], [0.0, 0.5, 0.5, 1.0, 0.0]]
    assert (colours == scale(np.array(expected), bytes=True)).all()


def test_markers_and_their_residuals_are_those_of_the_run(recording, arrays):
    for kind, key in (("measured", "measured_m"), ("fitted", "markers_m")):
        points = recording[f"swing/markers/{kind}"]
        assert np.array(points["positions"]) == pytest.approx(arrays[key], abs=1e-7)
    apart_mm = 1e3 * np.linalg.norm(arrays["markers_m"] - arrays["measured_m"], axis=2)
    for marker, values in zip(arrays["marker_names"], apart_mm.T, strict=True):
        curve = recording[f"swing/residuals_mm/{marker}"]
        assert [value[0] for value in curve["scalars"]] == pytest.approx(values, abs=1e-9)
        assert seconds(curve["time"]) == pytest.approx(arrays["t_s"])


def test_parameters_have_their_combined_intervals_over_the_whole_time(recording, run_folder):
    result = json.loads((run_folder / "result.json").read_text())
    item = result["parameters"]["mu_pa"]
    ends = dict(zip(("lower", "upper"), item["combined95"], strict=True))
    for curve, value in {"value": item["value"], **ends}.items():
        stored = recording[f"parameters/mu_pa/{curve}"]
        assert [each[0] for each in stored["scalars"]] == pytest.approx([value] * 2)
        assert seconds(stored["time"])[0] == 0.0
    (summary,) = recording["summary"]["static text"]
    assert "Verdict" in summary[0]


def test_one_experiment_is_written_alone(run_folder, tmp_path):
    words = ("--to", "rerun", "--experiment", "twist", "--out", tmp_path / "out", "--json")
    outcome = run_command("export", run_folder, *words)
    assert outcome.code == 0
    assert json.loads(outcome.out)["folder"] == str(tmp_path / "out")
    entities = read_back(tmp_path / "out" / "recording.rrd")
    assert "twist/body" in entities
    assert not any(path.startswith("swing") for path in entities)
    assert run_command("export", run_folder, "--to", "rerun", "--experiment", "nod").code == 2


def test_a_recording_is_written_beside_other_files(run_folder, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    file = tmp_path / "swing.rrd"
    outcome = run_command("export", run_folder, "--to", file)
    assert (outcome.code, outcome.out.splitlines()[-1]) == (0, str(file))
    names = [each.name for each in tmp_path.iterdir()]
    assert sorted(names) == [".collocation-sysid.json", "mine.txt", "swing.rrd"]
    assert "swing/body" in read_back(file)


def test_missing_markers_are_left_out(run_folder, tmp_path):
    damaged = tmp_path / "run"
    shutil.copytree(run_folder, damaged)
    with np.load(damaged / "trajectory.npz") as stored:
        arrays = dict(stored)
    arrays["measured_m"][2, 0] = np.nan
    np.savez(damaged / "trajectory.npz", allow_pickle=False, **arrays)
    write_rerun(damaged, tmp_path / "out", "swing")
    entities = read_back(tmp_path / "out" / "recording.rrd")
    points = entities["swing/markers/measured"]["positions"]
    counts = [len(each) for each in points]
    markers = arrays["measured_m"].shape[1]
    assert counts == [markers] * 2 + [markers - 1] + [markers] * (len(counts) - 3)
    curve = entities[f"swing/residuals_mm/{arrays['marker_names'][0]}"]
    assert len(curve["scalars"]) == len(counts) - 1


def test_a_recording_without_checksum_cannot_be_verified(run_folder):
    outcome = run_command("export", run_folder, "--to", "rerun", "--verify")
    assert outcome.code == 2
    assert "has no predictions to verify" in outcome.err


def test_a_missing_extra_is_named(run_folder, tmp_path, monkeypatch):
    monkeypatch.setattr(rerun_recording, "find_spec", lambda _: None)
    before = contents(tmp_path)
    with pytest.raises(cs.InputError, match=r"pip install 'collocation-sysid\[rerun\]'"):
        write_rerun(run_folder, tmp_path / "out")
    assert contents(tmp_path) == before


def test_other_files_in_the_folder_are_left_alone(run_folder, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    before = contents(tmp_path)
    outcome = run_command("export", run_folder, "--to", "rerun", "--out", tmp_path)
    assert outcome.code == 2
    assert contents(tmp_path) == before
