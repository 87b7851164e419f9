"""Benchmark of simulators: files, format of the predictions, scores and invalid input."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import contents, run_command

from collocation_sysid.common.written_files import list_files
from collocation_sysid.errors import InputError
from collocation_sysid.extras.benchmark import BODIES, Score, score_benchmark, write_benchmark
from collocation_sysid.extras.benchmark import bodies as benchmark_bodies
from collocation_sysid.fem.meshes.mesh import TetMesh

RUBBER = "isoprene_rubber"
FOAM = "simulated_foam_cylinder"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A benchmark folder with one test of loads and one motion, without predictions."""
    folder = tmp_path_factory.mktemp("benchmark") / "bodies"
    return write_benchmark([BODIES[RUBBER], BODIES[FOAM]], folder)


@pytest.fixture
def folder(written: Path, tmp_path: Path) -> Path:
    """A copy of the benchmark folder with predictions that equal our simulation."""
    copy = Path(shutil.copytree(written, tmp_path / "bodies"))
    for body, recording in ((RUBBER, "biaxial"), (FOAM, "swing")):
        shutil.copyfile(
            copy / body / f"{recording}_simulated.csv", copy / body / f"{recording}_prediction.csv"
        )
    return copy


def table(file: Path) -> tuple[list[str], np.ndarray]:
    header, *rows = csv.reader(file.read_text().splitlines())
    return header, np.array([[float(cell or "nan") for cell in row] for row in rows])


def write_table(file: Path, header: list[str], values: np.ndarray) -> None:
    with file.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(header)
        writer.writerows(values.tolist())


def by_source(scores: list[Score], body: str) -> dict[str, Score]:
    return {each.source: each for each in scores if each.body == body}


def test_a_prediction_equal_to_our_simulation_gets_its_score(folder: Path):
    scores = score_benchmark(folder)
    for body in (RUBBER, FOAM):
        own = by_source(scores, body)
        assert own["prediction"] == replace(own["collocation_sysid"], source="prediction")
        assert own["prediction"].rms < 0.2 * own["undeformed body"].rms


def test_the_score_of_a_recording_with_noise_is_its_noise(folder: Path):
    own = by_source(score_benchmark(folder), FOAM)["prediction"]
    # 0.5 mm of noise along each axis; constants and time steps add little.
    assert own.rms == pytest.approx(0.0005 * np.sqrt(3), rel=0.05)
    assert own.sigmas == pytest.approx(1.0, rel=0.05)
    assert own.unit == "m"
    assert not own.is_held_out


def test_a_shift_is_the_error_and_is_no_error_without_offsets(folder: Path):
    header, measured = table(folder / FOAM / "swing_measured.csv")
    shifted = measured.copy()
    shifted[:, 1:] += np.tile([0.003, 0.0, -0.004], (len(header) - 1) // 3)
    write_table(folder / FOAM / "swing_prediction.csv", header, values=shifted)
    own = by_source(score_benchmark(folder, FOAM), FOAM)["prediction"]
    assert own.rms == pytest.approx(0.005, rel=1e-9)
    assert own.largest == pytest.approx(0.005, rel=1e-9)
    assert own.rms_without_offsets == pytest.approx(0.0, abs=1e-12)
    # The deviation of each coordinate is 0.5 mm.
    assert own.sigmas == pytest.approx(10 / np.sqrt(3), rel=1e-9)
    assert own.count == measured[:, 1:].size // 3


def test_an_error_of_loads_is_relative_to_the_largest_load(folder: Path):
    header, measured = table(folder / RUBBER / "biaxial_measured.csv")
    shifted = measured + np.array([0.0, 5e3, -5e3])
    write_table(folder / RUBBER / "biaxial_prediction.csv", header, values=shifted)
    own = by_source(score_benchmark(folder, RUBBER), RUBBER)["prediction"]
    assert own.rms == pytest.approx(5e3, rel=1e-9)
    largest = np.abs(measured[:, 1:]).max()
    assert own.deflection_share == pytest.approx(5e3 / largest, rel=1e-9)
    assert own.sigmas == pytest.approx(0.5, rel=1e-9)
    assert own.is_held_out
    assert own.unit == "Pa"
    assert own.rms_without_offsets is None


def test_samples_that_were_not_measured_are_not_scored(written: Path):
    from collocation_sysid.extras.benchmark.scores import read_recordings, score

    (recording,) = read_recordings(written, FOAM)
    signals = recording.signals
    gaps = signals.measured.values.copy()
    gaps[3:7, :3] = np.nan
    partial = replace(
        recording, signals=replace(signals, measured=signals.measured.with_values(gaps))
    )
    complete = score(recording, "prediction", predicted=signals.simulated)
    own = score(partial, "prediction", predicted=signals.simulated)
    assert own.count == complete.count - 4
    assert np.isfinite(own.rms)


@pytest.mark.parametrize("role", ["measured", "simulated", "undeformed"])
@pytest.mark.parametrize("is_shorter", [False, True])
def test_a_table_of_the_folder_with_another_shape_is_refused(
    folder: Path, role: str, is_shorter: bool
):
    file = folder / FOAM / f"swing_{role}.csv"
    header, values = table(file)
    write_table(file, header, values[:-1] if is_shorter else values[:, :-1])
    list_files(folder)
    with pytest.raises(InputError, match=r"the table swing_\w+\.csv has the shape .*; expected"):
        score_benchmark(folder)


@pytest.mark.parametrize("shape", ["columns", "points"])
def test_an_archive_is_read_like_a_table(folder: Path, shape: str):
    expected = score_benchmark(folder)
    file = folder / FOAM / "swing_prediction.csv"
    _, values = table(file)
    file.unlink()
    points = values[:, 1:]
    if shape == "points":
        points = points.reshape(len(points), -1, 3)
    np.savez(file.with_suffix(".npz"), t_s=values[:, 0], values=points)
    assert score_benchmark(folder) == expected


def test_further_rows_and_columns_are_ignored(folder: Path):
    expected = score_benchmark(folder)
    file = folder / FOAM / "swing_prediction.csv"
    header, values = table(file)
    between = values + 0.3 * (values[1, 0] - values[0, 0])
    rows = np.vstack([between, values])[:, ::-1]
    write_table(
        file, [*header[::-1], "energy_j"], values=np.column_stack([rows, np.zeros(len(rows))])
    )
    assert score_benchmark(folder) == expected


def without_column(header: list[str], values: np.ndarray):
    return header[:-1], values[:, :-1]


def with_wrong_name(header: list[str], values: np.ndarray):
    return [*header[:-1], "middle_3_Z"], values


def without_row(header: list[str], values: np.ndarray):
    return header, np.delete(values, 5, axis=0)


def with_hole(header: list[str], values: np.ndarray):
    holed = values.copy()
    holed[2, 3] = np.nan
    return header, holed


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (without_column, "the column 'middle_3_z' is missing"),
        (with_wrong_name, "the column 'middle_3_z' is missing"),
        (without_row, "there is no row with t_s = 0.05"),
        (with_hole, "line 4, column 'tip_1_z': found 'nan'; expected a finite"),
    ],
)
def test_an_invalid_table_is_refused_with_one_message(folder: Path, damage, message: str):
    file = folder / FOAM / "swing_prediction.csv"
    write_table(file, *damage(*table(file)))
    before = contents(folder)
    outcome = run_command("benchmark", folder)
    assert outcome.code == 2
    assert outcome.out == ""
    assert outcome.err.count("error:") == 1
    assert message in outcome.err
    assert str(file) in outcome.err
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "expected the columns t_s,tip_1_x"),
        (b"\xff\xfe\x00", "cannot be read"),
        (b"t_s;tip_1_x\n0;1\n", "separated by commas"),
    ],
)
def test_a_file_that_is_no_table_is_refused(folder: Path, content: bytes, message: str):
    (folder / FOAM / "swing_prediction.csv").write_bytes(content)
    with pytest.raises(InputError, match=message):
        score_benchmark(folder, FOAM)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"values": np.zeros((3, 18))}, "the array 't_s' is missing"),
        ({"t_s": np.zeros(3), "values": np.zeros((3, 4))}, "found t_s"),
        ({"t_s": np.zeros(0), "values": np.zeros((0, 18))}, "has no rows"),
        ({"t_s": np.zeros(3), "values": np.full((3, 18), np.inf)}, "not finite numbers"),
        ({"t_s": np.array(["a"] * 3), "values": np.zeros((3, 18))}, "not finite numbers"),
    ],
)
def test_an_invalid_archive_is_refused(folder: Path, arrays, message: str):
    (folder / FOAM / "swing_prediction.csv").unlink()
    np.savez(folder / FOAM / "swing_prediction.npz", **arrays)
    with pytest.raises(InputError, match=message):
        score_benchmark(folder, FOAM)


def test_a_file_that_is_no_archive_is_refused(folder: Path):
    (folder / FOAM / "swing_prediction.csv").unlink()
    (folder / FOAM / "swing_prediction.npz").write_text("t_s,values")
    with pytest.raises(InputError, match="expected an archive of numpy"):
        score_benchmark(folder, FOAM)


def test_missing_predictions_are_listed(written: Path):
    before = contents(written)
    outcome = run_command("benchmark", written)
    assert outcome.code == 2
    assert f"{RUBBER}/biaxial_prediction.csv" in outcome.err
    assert f"{FOAM}/swing_prediction.csv" in outcome.err
    assert contents(written) == before


def test_two_predictions_of_a_recording_are_refused(folder: Path):
    shutil.copyfile(folder / FOAM / "swing_prediction.csv", folder / FOAM / "swing_prediction.npz")
    with pytest.raises(InputError, match="expected one of them"):
        score_benchmark(folder)


def test_changed_measurements_are_refused(folder: Path):
    file = folder / RUBBER / "biaxial_measured.csv"
    file.write_text(file.read_text().replace("52500", "52600"))
    with pytest.raises(InputError, match="was changed after it was written"):
        score_benchmark(folder, RUBBER)


def test_a_folder_that_is_no_benchmark_is_refused(tmp_path: Path):
    outcome = run_command("benchmark", tmp_path)
    assert outcome.code == 2
    assert "this is not a benchmark folder" in outcome.err


def test_a_folder_with_predictions_is_not_replaced(folder: Path):
    before = contents(folder)
    outcome = run_command("benchmark", folder, "--write", "--body", RUBBER)
    assert outcome.code == 2
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--write",), "--write: this option needs a folder"),
        (("--body", RUBBER), "--body: this option needs a folder"),
        (("bodies", "--write", "--body", "isoprene"), "found 'isoprene'"),
    ],
)
def test_options_that_do_not_fit_are_refused(
    arguments, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    outcome = run_command("benchmark", *arguments)
    assert outcome.code == 2
    assert message in outcome.err
    assert not any(tmp_path.iterdir())


def test_a_body_without_data_names_the_script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(benchmark_bodies, "CHECKOUT", tmp_path)
    outcome = run_command("benchmark", tmp_path / "new", "--write", "--body", "silicone_beam")
    assert outcome.code == 2
    assert "scripts get_srl_beam" in outcome.err
    assert not (tmp_path / "new").exists()


def test_the_list_states_which_bodies_are_measured():
    outcome = run_command("benchmark", "--json")
    assert outcome.code == 0
    listed = {each["body"]: each for each in json.loads(outcome.out)}
    assert set(listed) == set(BODIES)
    assert listed[RUBBER]["is_measured"]
    assert listed[RUBBER]["is_available"]
    assert not listed[FOAM]["is_measured"]


def test_the_files_describe_the_body_without_this_package(written: Path):
    folder = written / FOAM
    _, nodes = table(folder / "nodes.csv")
    _, tetrahedra = table(folder / "tetrahedra.csv")
    mesh = TetMesh.read(folder / "mesh.vtu")
    np.testing.assert_allclose(mesh.points_m, nodes, atol=1e-12)
    np.testing.assert_array_equal(mesh.tetrahedra, tetrahedra)
    _, *rows = csv.reader((folder / "swing_markers.csv").read_text().splitlines())
    for row in rows:
        place, element, weights = (
            np.array(row[1:4], dtype=float),
            int(row[4]),
            np.array(row[5:], dtype=float),
        )
        corners = nodes[tetrahedra[element].astype(int)]
        np.testing.assert_allclose(weights @ corners, place, atol=1e-9)
    content = json.loads((folder / "body.json").read_text())
    constants = {each["name"]: each for each in content["constants"]}
    low, high = constants["young_pa"]["combined95"]
    assert low < constants["young_pa"]["true_value"] < high
    _, held = table(folder / "swing_grasp_1_nodes.csv")
    assert np.abs(nodes[held[:, 0].astype(int), 2]).max() < 1e-3


def test_the_undeformed_body_follows_from_the_written_poses(written: Path):
    """Whoever reads the files applies the poses as the README states."""
    from scipy.spatial.transform import Rotation

    folder = written / FOAM
    _, poses = table(folder / "swing_grasp_1_poses.csv")
    _, undeformed = table(folder / "swing_undeformed.csv")
    rows = csv.reader((folder / "swing_markers.csv").read_text().splitlines())
    places = np.array([row[1:4] for row in [*rows][1:]], dtype=float)
    for sample in undeformed[::20]:
        pose = poses[np.abs(poses[:, 0] - sample[0]).argmin()]
        moved = Rotation.from_quat(pose[4:]).apply(places) + pose[1:4]
        np.testing.assert_allclose(moved.ravel(), sample[1:], atol=1e-9)


def test_stretches_are_those_of_the_publication(written: Path):
    _, stretches = table(written / RUBBER / "biaxial_stretches.csv")
    assert np.isnan(stretches[:, 2]).all()
    # The largest stretch of Kawabata's tables, as documented in `datasets`.
    assert stretches[:, 3].max() == pytest.approx(3.7)
    assert (written / RUBBER / "LICENSE.md").read_text().startswith("MIT")


@pytest.mark.parametrize("body", [RUBBER, FOAM])
def test_the_readme_names_every_file_of_its_folder(written: Path, body: str):
    readme = (written / body / "README.md").read_text()
    stated = {"README.md", "LICENSE.md", "body.json"}
    for file in (written / body).iterdir():
        is_baseline = file.stem.endswith(("_simulated", "_undeformed"))
        if file.name not in stated and not is_baseline:
            assert f"`{file.name}`" in readme, file.name


def test_a_prediction_in_other_units_gets_a_warning(folder: Path):
    file = folder / FOAM / "swing_prediction.csv"
    header, values = table(file)
    values[:, 1:] *= 1e3
    write_table(file, header, values=values)
    outcome = run_command("benchmark", folder)
    assert outcome.code == 0
    assert f"warning: the prediction of {FOAM}, swing, is worse" in outcome.out
    assert RUBBER not in outcome.out.split("warning:")[1]


def test_json_has_all_scores(folder: Path):
    outcome = run_command("benchmark", folder, "--json")
    assert len(json.loads(outcome.out)) == 6
