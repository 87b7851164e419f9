"""Readers of marker and pose tables in plain columns."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from collocation_sysid.errors import InputError
from collocation_sysid.recording import (
    PoseSequence,
    read_markers,
    read_poses,
    sample_interval_s,
    write_markers_csv,
    write_poses_csv,
)
from collocation_sysid.recording.time_tables import read_custom_sensor

POSES = """t_s,x_m,y_m,z_m,qx,qy,qz,qw
0.0,0,0,1,0,0,0,1
0.1,0.5,0,1,0,0,1,0
"""

MARKERS = """t_s,tip_x,tip_y,tip_z,base_x,base_y,base_z
0.0,1,2,3,4,5,6
0.1,1.5,,3,NaN,nan,NAN
0.2,2,2,3,,,
"""


@pytest.fixture
def file(tmp_path):
    def write(text):
        path = tmp_path / "data.csv"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def refusal(read, path, **options):
    with pytest.raises(InputError) as caught:
        read(path, **options)
    message = str(caught.value)
    assert message.startswith(str(path))
    return message


# Poses


def test_pose_columns_are_distinguished_by_name(file):
    poses = read_poses(file(POSES))
    np.testing.assert_allclose(poses.positions_m, [[0, 0, 1], [0.5, 0, 1]])
    np.testing.assert_allclose(np.abs(poses.quaternions_xyzw), [[0, 0, 0, 1], [0, 0, 1, 0]])
    scalar_first = "t_s,qw,qx,qy,qz,x_m,y_m,z_m\n0,1,0,0,0,0,0,1\n0.1,0,0,0,1,0.5,0,1\n"
    same = read_poses(file(scalar_first))
    np.testing.assert_allclose(same.quaternions_xyzw, poses.quaternions_xyzw)
    np.testing.assert_allclose(same.positions_m, poses.positions_m)


def test_spreadsheet_habits_are_tolerated(file):
    text = "\ufeff" + POSES.replace(",", " , ").replace("\n", "\r\n") + "\r\n,,,,,,,\r\n"
    assert len(read_poses(file(text)).t_s) == 2


@pytest.mark.parametrize(
    "header",
    [
        "t_s,x_m,y_m,z_m,qx,qy,qz",
        "t_s,x_m,y_m,z_m,qx,qy,qz,qw,grip",
        "t_s,x_m,y_m,z_m,qx,qy,qz,qz",
        "clock,x_m,y_m,z_m,qx,qy,qz,qw",
    ],
)
def test_wrong_pose_columns_list_found_and_expected(file, header):
    row = ",".join(["0"] * (header.count(",") + 1))
    message = refusal(read_poses, file(f"{header}\n{row}\n"))
    assert "line 1" in message
    assert header.replace(",", ", ") in message
    assert "expected t_s, x_m, y_m, z_m, qx, qy, qz, qw" in message


@pytest.mark.parametrize(
    ("found", "replacement", "words"),
    [
        ("0.1,0.5", "0.1,left", ["line 3", "column x_m", "'left'"]),
        ("0.1,0.5", "0.1,", ["line 3", "column x_m", "''"]),
        ("0.1,0.5", "0.1,inf", ["line 3", "'inf'"]),
        ("0.1,0.5", "0.0,0.5", ["line 3", "time must increase"]),
        ("0,0,1,0\n", "0,0,1,1\n", ["line 3", "norm 1.41421"]),
        ("0.1,0.5", "0.5", ["line 3", "7 cells", "expected 8"]),
    ],
)
def test_a_bad_pose_is_named_by_its_line(file, found, replacement, words):
    assert found in POSES
    message = refusal(read_poses, file(POSES.replace(found, replacement)))
    assert all(word in message for word in words), message


# Markers


def test_missing_coordinates_become_nan(file):
    table = read_markers(file(MARKERS))
    assert table.names == ("tip", "base")
    np.testing.assert_array_equal(table.t_s, [0.0, 0.1, 0.2])
    nan = [np.nan] * 3
    np.testing.assert_array_equal(
        table.positions_m, [[[1, 2, 3], [4, 5, 6]], [[1.5, np.nan, 3], nan], [[2, 2, 3], nan]]
    )


@pytest.mark.parametrize(
    "header", ["t_s,tip_x (mm),tip_y (mm),tip_z (mm)", "time [s],tip_x[mm],tip_y[mm],tip_z[mm]"]
)
def test_markers_may_have_their_unit_in_brackets(file, header):
    table = read_markers(file(f"{header}\n0.0,1,2,3\n0.1,2,2,3\n"))
    assert table.names == ("tip",)
    np.testing.assert_allclose(table.positions_m[0, 0], [1e-3, 2e-3, 3e-3])
    with pytest.raises(InputError, match="length_unit is 'm'"):
        read_markers(file(f"{header}\n0.0,1,2,3\n0.1,2,2,3\n"), length_unit="m")


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("t_s,tip_x (in.),tip_y (in.),tip_z (in.)", "the unit in.; expected one of m, cm, mm, in"),
        ("t (mm),tip_x,tip_y,tip_z", "column t (mm) has the unit mm; expected one of s, sec, ms"),
        ("time,tip_x,tip_y,tip_z", "column time names no unit; expected one of s"),
        ("t_s,tip_x (mm),tip_y (m),tip_z (m)", "have different units"),
        ("t_s,tip_x (mm),tip_y,tip_z", "have different units"),
    ],
)
def test_units_of_markers_that_are_not_known_are_refused(file, header, words):
    assert words in refusal(read_markers, file(f"{header}\n0.0,1,2,3\n0.1,2,2,3\n"))


@pytest.mark.parametrize("name", ["t_ms", "t (ms)", "Time [ms]", "Zeit in ms"])
def test_times_have_any_unit(file, name):
    rows = "0,1,2,3\n100,2,2,3\n"
    wide = read_markers(file(f"{name},tip_x,tip_y,tip_z\n{rows}"))
    np.testing.assert_allclose(wide.t_s, [0, 0.1])
    long = read_markers(file(f"marker,{name},x_m,y_m,z_m\ntip,0,1,2,3\ntip,100,2,2,3\n"))
    np.testing.assert_allclose(long.t_s, [0, 0.1])
    t_s, values, names = read_custom_sensor(file(f"{name},gap\n0,1\n100,2\n"))
    np.testing.assert_allclose(t_s, [0, 0.1])
    assert names == ["gap"]
    assert values[:, 0].tolist() == [1, 2]


def test_units_of_poses_that_are_not_known_are_refused_with_those_that_are(file):
    text = POSES.replace("x_m,y_m,z_m", "x (ell),y (ell),z (ell)")
    message = refusal(read_poses, file(text))
    assert "column x (ell) has the unit ell; expected one of m, cm, mm" in message


def test_markers_asked_for_come_in_the_order_asked(file):
    table = read_markers(file(MARKERS), names=["base", "tip"])
    assert table.names == ("base", "tip")
    np.testing.assert_array_equal(table.positions_m[0], [[4, 5, 6], [1, 2, 3]])


def test_lengths_are_converted_to_metres(file):
    table = read_markers(file(MARKERS), length_unit="mm")
    np.testing.assert_allclose(table.positions_m[0, 0], [0.001, 0.002, 0.003])


def test_an_unknown_length_unit_is_refused(file):
    with pytest.raises(InputError, match="'feet'; expected one of m, cm, mm"):
        read_markers(file(MARKERS), length_unit="feet")


def test_an_unknown_marker_is_answered_with_a_suggestion(file):
    message = refusal(read_markers, file(MARKERS), names=["tpi"])
    assert "no marker 'tpi'; the file has tip, base; did you mean 'tip'?" in message


def test_a_marker_may_be_asked_for_once(file):
    assert "more than once" in refusal(read_markers, file(MARKERS), names=["tip", "tip"])


def test_columns_of_markers_not_asked_for_may_hold_anything(file):
    text = MARKERS.replace("4,5,6", "?,?,?")
    assert read_markers(file(text), names=["tip"]).names == ("tip",)


@pytest.mark.parametrize(
    ("found", "replacement", "words"),
    [
        ("1.5,", "1.5e,", ["line 3", "column tip_x", "'1.5e'"]),
        ("0.2,", "0.05,", ["line 4", "t_s = 0.05 follows 0.1"]),
        ("0.2,", ",", ["line 4", "column t_s"]),
        ("2,2,3", "2,2,3,3", ["line 4", "8 cells", "expected 7"]),
        ("base_z", "base_w", ["line 1", "unknown base_w", "missing base_z"]),
        ("base_x", "tip_x", ["line 1", "missing base_x", "repeated tip_x"]),
        ("t_s", "clock", ["line 1", "unknown clock", "missing t_s"]),
    ],
)
def test_a_bad_marker_file_is_named_by_its_line(file, found, replacement, words):
    assert found in MARKERS
    message = refusal(read_markers, file(MARKERS.replace(found, replacement)))
    assert all(word in message for word in words), message


def test_blank_lines_are_counted(file):
    message = refusal(read_markers, file(MARKERS.replace("0.1,1.5", "\n\n0.1,x")))
    assert "line 5" in message


@pytest.mark.parametrize("read", [read_poses, read_markers])
@pytest.mark.parametrize("text", ["", "\n\n", "t_s,x_m,y_m,z_m,qx,qy,qz,qw\n", "t_s\n0\n"])
def test_files_without_data_are_refused(file, read, text):
    refusal(read, file(text))


@pytest.mark.parametrize("read", [read_poses, read_markers])
def test_files_that_cannot_be_read_are_refused(tmp_path, read):
    assert "No such file" in refusal(read, tmp_path / "absent.csv")
    refusal(read, tmp_path)
    binary = tmp_path / "binary.csv"
    binary.write_bytes(b"\xff\xfe\x00t_s")
    assert "not a CSV text file" in refusal(read, binary)


# Writing


def test_poses_survive_writing_and_reading(tmp_path):
    rng = np.random.default_rng(0)
    t = np.arange(20) / 30.0
    poses = PoseSequence(t, rng.normal(size=(20, 3)), Rotation.random(20, rng=rng).as_quat())
    write_poses_csv(tmp_path / "poses.csv", poses)
    again = read_poses(tmp_path / "poses.csv")
    np.testing.assert_allclose(again.t_s, poses.t_s, rtol=1e-11)
    np.testing.assert_allclose(again.positions_m, poses.positions_m, rtol=1e-11)
    np.testing.assert_allclose(again.quaternions_xyzw, poses.quaternions_xyzw, atol=1e-11)


def test_markers_survive_writing_and_reading(tmp_path):
    rng = np.random.default_rng(0)
    positions = rng.normal(size=(7, 3, 3))
    positions[2, 1] = np.nan
    names = ["a", "b, with comma", "c"]
    write_markers_csv(tmp_path / "markers.csv", np.arange(7) / 30.0, names, positions)
    again = read_markers(tmp_path / "markers.csv")
    assert again.names == tuple(names)
    np.testing.assert_allclose(again.positions_m, positions, rtol=1e-11)
    assert ",,,," in (tmp_path / "markers.csv").read_text().splitlines()[3]


def test_writing_replaces_a_file_and_leaves_no_other_file(tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text("old")
    write_poses_csv(path, PoseSequence.fixed())
    assert path.read_text().startswith("t_s,")
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "poses.csv"
    path.write_text("old")

    def fail(*_, **__):
        raise OSError("disk full")

    monkeypatch.setattr("collocation_sysid.common.files.os.replace", fail)
    with pytest.raises(InputError, match=r"poses\.csv: this cannot be written: disk full"):
        write_poses_csv(path, PoseSequence.fixed())
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


# Sample interval


def test_even_times_give_their_interval():
    assert sample_interval_s(5.0 + 0.01 * np.arange(100), "poses") == pytest.approx(0.01)


@pytest.mark.parametrize(("rate", "decimals"), [(30, 3), (60, 3), (240, 3), (100, 2), (1000, 3)])
def test_rounding_of_printed_times_is_forgiven(rate, decimals):
    times = np.round(np.arange(500) / rate, decimals)
    assert sample_interval_s(times, "markers") == pytest.approx(1 / rate, rel=1e-2)


@pytest.mark.parametrize("lost", [1, 7, 48])
@pytest.mark.parametrize(("rate", "decimals"), [(1, 0), (30, 3), (100, 2), (240, 3), (100, 12)])
def test_a_lost_frame_is_named_by_its_row(lost, rate, decimals):
    times = np.delete(np.round(np.arange(50) / rate, decimals), lost)
    with pytest.raises(InputError, match=rf"row {lost + 1}: markers: the time jumps"):
        sample_interval_s(times, "markers")


def test_jitter_beyond_one_percent_is_refused():
    times = 0.01 * np.arange(20.0)
    times[9] += 0.0002
    with pytest.raises(InputError, match="evenly spaced"):
        sample_interval_s(times, "poses")
    times[9] -= 0.00015
    sample_interval_s(times, "poses")


def test_one_sample_has_no_interval():
    with pytest.raises(InputError, match="at least two"):
        sample_interval_s([0.0], "poses")
