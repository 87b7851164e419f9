"""Marker files of every format with the same two markers, and damaged files."""

from __future__ import annotations

import os
import re
import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from collocation_sysid.errors import InputError
from collocation_sysid.recording import align_to_template, read_markers

ROOT = Path(__file__).parents[2]
# A folder with the C3D files of scripts/data/get_srl_beam.py, and what they become in the world's frame.
MEASURED = Path(os.environ.get("SRL_BEAM_DATA", ROOT / "problems" / "srl_beam"))

# Metres, frame by frame; "Tip 1" is lost in the second frame, and base in the third.
NAN = [np.nan] * 3
TRACKS_M = np.array(
    [
        [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]],
        [NAN, [0.41, 0.5, 0.6]],
        [[0.12, 0.2, 0.3], NAN],
        [[0.13, 0.2, 0.3], [0.43, 0.5, 0.6]],
    ]
)

TRC = """\
PathFileType\t4\t(X/Y/Z)\tswing.trc
DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames
100.00\t100.00\t4\t2\tmm\t100.00\t1\t4
Frame#\tTime\tTip 1\t\t\tbase\t\t
\t\tX1\tY1\tZ1\tX2\tY2\tZ2

1\t0.000\t100\t200\t300\t400\t500\t600
2\t0.010\t\t\t\t410\t500\t600
3\t0.020\t120\t200\t300\t0.0\t0.0\t0.0
4\t0.030\t130\t200\t300\t430\t500\t600
"""
QUALISYS = """\
NO_OF_FRAMES\t4
NO_OF_CAMERAS\t8
NO_OF_MARKERS\t2
FREQUENCY\t100
NO_OF_ANALOG\t0
ANALOG_FREQUENCY\t0
DESCRIPTION\t--
TIME_STAMP\t2022-06-03, 10:47:36.627\t94247.45402301
DATA_INCLUDED\t3D
MARKER_NAMES\tTip 1\tbase
TRAJECTORY_TYPES\tMeasured\tMeasured
100\t200\t300\t400\t500\t600
0.000\t0.000\t0.000\t410\t500\t600
120\t200\t300\t\t\t
130\t200\t300\t430\t500\t600
"""
MOTIVE = """\
Format Version,1.23,Take Name,swing,Capture Frame Rate,100.000000,Export Frame Rate,100.000000,\
Total Frames in Take,4,Total Exported Frames,4,Rotation Type,Quaternion,Length Units,Millimeters,\
Coordinate Space,Global

,Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,\
Rigid Body Marker,Rigid Body Marker,Rigid Body Marker,Rigid Body Marker,\
Marker,Marker,Marker,Marker,Marker,Marker,Marker,Marker,Marker
,Name,arm,arm,arm,arm,arm,arm,arm,arm,base,base,base,base,\
Tip 1,Tip 1,Tip 1,base,base,base,Unlabeled 7,Unlabeled 7,Unlabeled 7
,ID,A,A,A,A,A,A,A,A,B,B,B,B,C,C,C,D,D,D,E,E,E
,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Mean Marker Error,\
Position,Position,Position,Marker Quality,\
Position,Position,Position,Position,Position,Position,Position,Position,Position
Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,Y,Z,,X,Y,Z,X,Y,Z,X,Y,Z
0,0.000000,0,0,0,1,5,5,5,0.1,9,9,9,1,100,200,300,400,500,600,,,
1,0.010000,0,0,0,1,5,5,5,0.1,9,9,9,1,,,,410,500,600,1,2,3
2,0.020000,0,0,0,1,5,5,5,0.1,9,9,9,1,120,200,300,,,,,,
3,0.030000,0,0,0,1,5,5,5,0.1,9,9,9,1,130,200,300,430,500,600,,,
"""
WIDE = """\
t_s,Tip 1_x,Tip 1_y,Tip 1_z,base_x,base_y,base_z
0.00,0.1,0.2,0.3,0.4,0.5,0.6
0.01,,,,0.41,0.5,0.6
0.02,0.12,0.2,0.3,nan,nan,nan
0.03,0.13,0.2,0.3,0.43,0.5,0.6
"""
LONG = """\
t_s,marker,x_mm,y_mm,z_mm
0.00,Tip 1,100,200,300
0.00,base,400,500,600
0.01,base,410,500,600
0.02,Tip 1,120,200,300
0.02,base,,,
0.03,Tip 1,130,200,300
0.03,base,430,500,600
"""
TEXTS = {"trc": TRC, "qualisys": QUALISYS, "motive": MOTIVE, "wide": WIDE, "long": LONG}
UNIT_GIVEN = {"qualisys": {"length_unit": "mm"}}


@pytest.fixture
def file(tmp_path):
    def write(text, name="take.dat"):  # the name must not matter
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


def refusal(path, **options):
    with pytest.raises(InputError) as caught:
        read_markers(path, **options)
    message = str(caught.value)
    assert message.startswith(str(path)), message
    return message


def replaced(text, old, new):
    assert text.count(old) == 1, f"{old!r} is there {text.count(old)} times"
    return text.replace(old, new)


# All text formats ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TEXTS)
def test_a_format_is_recognised_by_its_content(file, name):
    table = read_markers(file(TEXTS[name]), **UNIT_GIVEN.get(name, {}))
    assert table.names == ("Tip 1", "base")
    np.testing.assert_allclose(table.t_s, [0.0, 0.01, 0.02, 0.03])
    np.testing.assert_allclose(table.positions_m, TRACKS_M, rtol=1e-12)


@pytest.mark.parametrize("name", TEXTS)
def test_windows_line_ends_and_a_byte_order_mark_are_tolerated(file, name):
    text = "\ufeff" + TEXTS[name].replace("\n", "\r\n")
    table = read_markers(file(text), **UNIT_GIVEN.get(name, {}))
    np.testing.assert_allclose(table.positions_m, TRACKS_M, rtol=1e-12)


@pytest.mark.parametrize("name", TEXTS)
def test_markers_are_chosen_ordered_and_renamed(file, name):
    path, options = file(TEXTS[name]), UNIT_GIVEN.get(name, {})
    table = read_markers(
        path, names=["foot", "tip"], labels={"base": "foot", "Tip 1": "tip"}, **options
    )
    assert table.names == ("foot", "tip")
    np.testing.assert_allclose(table.positions_m, TRACKS_M[:, ::-1], rtol=1e-12)
    assert read_markers(path, labels={"Tip 1": "tip"}, **options).names == ("tip", "base")
    assert "no label 'Tip1'" in refusal(path, labels={"Tip1": "tip"}, **options)
    assert "did you mean 'Tip 1'?" in refusal(path, labels={"Tip1": "tip"}, **options)
    assert "did you mean 'base'?" in refusal(path, names=["bas"], **options)
    assert "two markers are named 'base'" in refusal(path, labels={"Tip 1": "base"}, **options)


@pytest.mark.parametrize(
    ("name", "lost"),
    [
        ("trc", ("1 blank", "1 zeros")),
        ("qualisys", ("1 zeros", "1 blank")),
        ("motive", ("1 blank", "1 blank")),
        ("wide", ("1 blank", "1 blank")),
        ("long", ("1 blank", "1 blank")),
    ],
)
def test_missing_samples_are_counted(file, name, lost):
    table = read_markers(file(TEXTS[name]), **UNIT_GIVEN.get(name, {}))
    notes = tuple(note for note in table.notes if "unlabelled" not in note)
    if lost[0] == lost[1]:
        assert notes == (f"Tip 1 and base: each 1 of 4 samples missing ({lost[0]})",)
    else:
        assert notes == (
            f"Tip 1: 1 of 4 samples missing ({lost[0]}); base: 1 of 4 samples missing ({lost[1]})",
        )


def test_markers_that_miss_as_many_samples_share_a_note(file):
    names = ("a", "b", "c", "d", "e", "f")
    head = ",".join(f"{name}_{axis}" for name in names for axis in "xyz")
    rows = [f"{t},{','.join(['1,2,3'] * 6)}" for t in range(3)]
    lost = f"3,{',' * 14},4,5,6"
    table = read_markers(file("\n".join([f"t_s,{head}", *rows, lost, ""])))
    assert table.notes == ("a, b, c, d and e: each 1 of 4 samples missing (1 blank)",)


def test_the_origin_is_a_place_in_a_plain_file(file):
    table = read_markers(file("t_s,a_x,a_y,a_z\n0,0,0,0\n1,0,0,0\n"))
    np.testing.assert_array_equal(table.positions_m, np.zeros((2, 1, 3)))
    assert table.notes == ()


# Coordinates y and z of the first marker.
PAIRS = {"trc": "200\t300", "qualisys": "200\t300", "wide": "0.2,0.3", "vicon": "2,3"}


@pytest.mark.parametrize("axis", [1, 2])
@pytest.mark.parametrize("name", [*TEXTS, "vicon", "c3d"])
def test_a_marker_without_one_coordinate_keeps_the_others(file, tmp_path, name, axis):
    if name == "c3d":
        tracks_mm = 1000 * TRACKS_M
        tracks_mm[:, 0, axis] = np.nan
        path = write_c3d(tmp_path / "take.c3d", tracks_mm)
    else:
        pair = PAIRS.get(name, "200,300")
        number = re.split("[\t,]", pair)[axis - 1]
        text = VICON if name == "vicon" else TEXTS[name]
        path = file(text.replace(pair, pair.replace(number, "")))
    table = read_markers(path, **UNIT_GIVEN.get(name, {}))
    is_missing = np.isnan(table.positions_m[:, 0]).all(axis=0)
    assert is_missing.tolist() == [k == axis for k in range(3)]
    assert "without all three coordinates" in table.notes[-1]


@pytest.mark.parametrize("name", ["trc", "motive"])
def test_zeros_of_a_marker_without_one_coordinate_are_missing(file, name):
    pair = PAIRS.get(name, "200,300")
    text = TEXTS[name].replace(pair, pair.replace("300", ""))
    lost = {"trc": ("130\t200\t", "0\t0\t"), "motive": ("130,200,", "0,0,")}[name]
    table = read_markers(file(replaced(text, *lost)))
    assert np.isnan(table.positions_m[3, 0]).all()
    assert "1 blank, 1 zeros), 2 of 4 samples without all three" in table.notes[-1]


UNLABELLED = ("*0", "*12", "S:*3", "Unlabeled 7", "unlabelled_2", "Unlabeled", "")


def vicon(labels, first=1):
    """The text of a Vicon CSV with markers at (1, 2, 3) mm in two frames."""
    names = ",,".join(f",{label}" for label in labels)
    rows = [f"{first + k},0" + ",1,2,3" * len(labels) for k in range(2)]
    axes, units = ",X,Y,Z" * len(labels), ",mm,mm,mm" * len(labels)
    return "\n".join(
        ["Trajectories", "100", f",{names},,", f"Frame,Sub Frame{axes}", f",{units}", *rows, ""]
    )


@pytest.mark.parametrize("label", UNLABELLED)
@pytest.mark.parametrize("name", ["vicon", "c3d", "trc"])
def test_unlabelled_points_are_left_out_with_a_note(file, tmp_path, name, label):
    if name == "vicon":
        path = file(vicon(["tip", label, "base"]))
    elif name == "c3d":
        path = write_c3d(tmp_path / "take.c3d", labels=("tip", label))
    else:
        path = file(TRC.replace("base", label or "*"))
    table = read_markers(path)
    assert label not in table.names
    assert any("left out" in note and "1, such as" in note for note in table.notes)
    if label:
        assert read_markers(path, names=[label]).names == (label,)
        assert "second" in read_markers(path, labels={label: "second"}).names


def test_many_points_without_a_label_are_no_markers_of_one_name(file):
    table = read_markers(file(vicon(["", "tip", "*", ""])))
    assert table.names == ("tip",)
    assert table.notes == (
        "unlabelled markers are left out, unless names or labels state them: 3, such as ''",
    )


@pytest.mark.parametrize("label", ["*tip", "label_7", "relabelled", "S:"])
def test_names_of_labelled_markers_may_be_similar(file, label):
    assert read_markers(file(vicon(["tip", label]))).names == ("tip", label)


# First frames -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("first", "first_s"), [(0, 0.0), (1, 0.0), (101, 1.0), (40001, 400.0)])
@pytest.mark.parametrize("name", ["vicon", "c3d", "qualisys"])
def test_frames_count_from_one_at_zero_seconds(file, tmp_path, name, first, first_s):
    if name == "vicon":
        path = file(vicon(["tip"], first))
    elif name == "c3d":
        path = write_c3d(tmp_path / "take.c3d")
        content = bytearray(path.read_bytes())
        content[6:10] = struct.pack("<2H", first, first + 3)
        path.write_bytes(content)
    else:
        lines = QUALISYS.splitlines()
        frames = [f"{first + k}\t{row}" for k, row in enumerate(lines[11:])]
        title = "Frame\t" + "\t".join(f"{n} {a}" for n in ("Tip 1", "base") for a in "XYZ")
        path = file("\n".join([*lines[:11], title, *frames]) + "\n")
    t_s = read_markers(path, **UNIT_GIVEN.get(name, {})).t_s
    np.testing.assert_allclose(t_s, first_s + np.arange(len(t_s)) / 100)


def test_frame_numbers_have_times_by_a_stated_rate(file):
    path = file(replaced(vicon(["tip"], 101), "\n100\n", '\n"",x\n'))
    assert "neither line 2 nor a column of times" in refusal(path)
    np.testing.assert_allclose(read_markers(path, rate_hz=50.0).t_s, [2.0, 2.02])
    assert "rate_hz is 50, but line 2 says 100" in refusal(file(vicon(["tip"])), rate_hz=50.0)


# Units and rates ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "key"), [("trc", "Units"), ("motive", "Length Units"), ("long", "columns' names")]
)
def test_a_unit_that_contradicts_the_file_is_refused(file, name, key):
    path = file(TEXTS[name])
    message = refusal(path, length_unit="m")
    assert all(word in message for word in ("length_unit is 'm'", key, "'mm'"))
    np.testing.assert_allclose(read_markers(path, length_unit="mm").positions_m, TRACKS_M)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("trc", "2\tmm", "2\t"),
        ("qualisys", "DATA_INCLUDED", "DATA_INCLUDED"),
        ("motive", ",Length Units,Millimeters", ""),
        ("long", "x_mm,y_mm,z_mm", "x,y,z"),
    ],
)
def test_a_unit_is_asked_for_and_never_guessed(file, name, old, new):
    path = file(replaced(TEXTS[name], old, new))
    message = refusal(path)
    assert "no unit of length" in message
    assert "expected length_unit, one of m, cm, mm, in" in message
    np.testing.assert_allclose(read_markers(path, length_unit="mm").positions_m, TRACKS_M)


@pytest.mark.parametrize("missing", "xy")
def test_a_plain_wide_file_of_a_plane_has_no_column_across_it(missing, file):
    axes = [axis for axis in "xyz" if axis != missing]
    names = ",".join(f"{marker}_{axis}" for marker in "ab" for axis in axes)
    table = read_markers(file(f"t_s,{names}\n0,1,2,3,4\n1,5,6,7,8\n"))
    measured = table.positions_m[..., ["xyz".index(axis) for axis in axes]]
    assert measured.reshape(2, 4).tolist() == [[1, 2, 3, 4], [5, 6, 7, 8]]
    assert np.isnan(table.positions_m[..., "xyz".index(missing)]).all()


@pytest.mark.parametrize("columns", ["a_x,a_y,b_x,b_y", "a_x,a_z,b_x,b_y,b_z"])
def test_columns_that_may_be_pixels_or_are_missing_of_one_marker_are_refused(columns, file):
    count = columns.count(",") + 1
    row = ",".join(["0"] * (count + 1))
    assert "missing" in refusal(file(f"t_s,{columns}\n{row}\n"))


def test_a_plain_wide_file_is_in_metres_unless_a_unit_is_stated(file):
    table = read_markers(file(WIDE), length_unit="mm")
    np.testing.assert_allclose(table.positions_m, TRACKS_M / 1000)


@pytest.mark.parametrize("separator", [" ", ":", ".", "_"])
@pytest.mark.parametrize("time", ["Time (Seconds)", "time (sec)", "t_s"])
def test_a_plain_wide_file_has_the_headers_of_exports(file, separator, time):
    header, rows = WIDE.split("\n", 1)
    names = [name.rsplit("_", 1) for name in header.split(",")[1:]]
    headers = [f"{marker}{separator}{axis.upper()} (mm)" for marker, axis in names]
    numbered = "\n".join(f"{k},{row}" for k, row in enumerate(rows.splitlines()))
    table = read_markers(file(f"Frame,{time},{','.join(headers)}\n{numbered}\n"))
    expected = read_markers(file(WIDE))
    assert table.names == expected.names
    np.testing.assert_allclose(table.positions_m, expected.positions_m / 1000)
    np.testing.assert_allclose(table.t_s, expected.t_s)


@pytest.mark.parametrize("unit", ["Meters", "METRES", "m"])
def test_units_are_spelled_in_many_ways(file, unit):
    table = read_markers(file(replaced(MOTIVE, "Millimeters", unit)))
    np.testing.assert_allclose(table.positions_m, TRACKS_M * 1000)


def test_a_rate_is_required_where_times_are_missing(file):
    path = file(replaced(QUALISYS, "FREQUENCY\t100\nNO_OF_A", "NO_OF_A"))
    message = refusal(path, length_unit="mm")
    assert "neither FREQUENCY nor a column of times" in message
    assert "expected rate_hz" in message
    table = read_markers(path, length_unit="mm", rate_hz=50.0)
    np.testing.assert_allclose(table.t_s, [0.0, 0.02, 0.04, 0.06])


def test_a_rate_that_contradicts_the_file_is_refused(file):
    message = refusal(file(QUALISYS), length_unit="mm", rate_hz=120.0)
    assert all(word in message for word in ("rate_hz is 120", "FREQUENCY says 100"))
    message = refusal(file(WIDE), rate_hz=120.0)
    assert all(word in message for word in ("rate_hz is 120", "0.01 s apart, 100 Hz"))
    assert len(read_markers(file(WIDE), rate_hz=100.0).t_s) == 4
    message = refusal(file(TRC.replace("100.00", "50.00")))
    assert all(word in message for word in ("DataRate is 50 Hz", "100 Hz"))
    message = refusal(file(replaced(MOTIVE, "Export Frame Rate,100", "Export Frame Rate,50")))
    assert "Export Frame Rate is 50 Hz" in message


@pytest.mark.parametrize(
    ("rate", "decimals", "lost"), [(240, 3, ()), (30, 2, ()), (100, 2, (5, 6))]
)
def test_printed_times_may_be_coarse_and_frames_lost(file, rate, decimals, lost):
    kept = [k for k in range(40) if k not in lost]
    rows = "".join(f"{k + 1}\t{k / rate:.{decimals}f}\t1\t2\t3\n" for k in kept)
    text = (
        "PathFileType\t4\t(X/Y/Z)\ta.trc\nDataRate\tNumFrames\tNumMarkers\tUnits\n"
        f"{rate}\t{len(kept)}\t1\tm\nFrame#\tTime\ta\n\t\tX1\tY1\tZ1\n{rows}"
    )
    assert len(read_markers(file(text)).t_s) == len(kept)


# TRC ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("mm\t100.00", "furlong\t100.00", ["line 3", "'furlong'", "one of m, cm, mm, in"]),
        ("DataRate\tCameraRate", "Rate\tCameraRate", ["line 2", "lacks DataRate", "found Rate"]),
        ("4\t2\tmm", "5\t2\tmm", ["line 3", "NumFrames is 5", "4 frames"]),
        ("4\t2\tmm", "4\t3\tmm", ["line 4", "NumMarkers is 3", "2 marker names"]),
        ("4\t2\tmm", "four\t2\tmm", ["line 3", "NumFrames is 'four'", "number above 0"]),
        ("Frame#\tTime", "Number\tTime", ["line 4", "found Number, Time", "expected Frame#"]),
        ("base\t\t", "Tip 1\t\t", ["two markers are labelled 'Tip 1'"]),
        ("130\t200", "13O\t200", ["line 10", "column Tip 1 X", "'13O'", "a blank cell"]),
        ("130\t200", "200", ["line 10", "7 cells", "expected 8"]),
        ("4\t0.030", "4\t0.020", ["line 10", "0.02 follows 0.02", "time must increase"]),
        ("4\t0.030", "4\t", ["line 10", "column Time holds ''"]),
    ],
)
def test_a_bad_trc_is_named_by_its_line(file, old, new, words):
    message = refusal(file(replaced(TRC, old, new)))
    assert all(word in message for word in words), message


@pytest.mark.parametrize("lines", range(1, 10))
def test_a_trc_cut_short_is_refused(file, lines):
    refusal(file("".join(TRC.splitlines(keepends=True)[:lines])))


def test_tabs_at_the_end_of_all_rows_are_no_cells(file):
    head, frames = TRC.split("\n\n")
    table = read_markers(file(f"{head}\n\t\t\n" + frames.replace("\n", "\t\n")))
    np.testing.assert_allclose(table.positions_m, TRACKS_M)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        (TRC.replace("\t", " "), "trc"),
        (TRC[: TRC.index("\n\n")] + TRC[TRC.index("\n\n") :].replace("\t", "  "), "trc"),
        (QUALISYS.replace("\t", " "), "qualisys"),
    ],
)
def test_blanks_in_place_of_tabs_are_named(file, text, name):
    assert "separated by tabs" in refusal(file(text), **UNIT_GIVEN.get(name, {}))


# Qualisys -----------------------------------------------------------------------------------------


def with_time(text=QUALISYS, titles=True):
    """The same file with Frame and Time columns."""
    lines = text.splitlines()
    frames = [f"{k + 1}\t{k / 100:.5f}\t{row}" for k, row in enumerate(lines[11:])]
    title = "Frame\tTime\t" + "\t".join(f"{n} {a}" for n in ("Tip 1", "base") for a in "XYZ")
    return "\n".join(lines[:11] + [title] * titles + frames) + "\n"


@pytest.mark.parametrize("titles", [True, False])
def test_frame_and_time_columns_are_recognised(file, titles):
    table = read_markers(file(with_time(titles=titles)), length_unit="mm")
    np.testing.assert_allclose(table.t_s, [0.0, 0.01, 0.02, 0.03])
    np.testing.assert_allclose(table.positions_m, TRACKS_M)


def test_a_frame_without_any_marker_is_a_frame(file):
    text = replaced(QUALISYS, "0.000\t0.000\t0.000\t410\t500\t600", "\t\t\t\t\t")
    table = read_markers(file(text), length_unit="mm")
    assert np.isnan(table.positions_m[1]).all()
    assert len(table.t_s) == 4


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("NO_OF_FRAMES\t4", "NO_OF_FRAMES\t400", ["line 1", "NO_OF_FRAMES is 400", "4 frames"]),
        ("NO_OF_MARKERS\t2", "NO_OF_MARKERS\t3", ["line 3", "NO_OF_MARKERS is 3", "2 marker"]),
        ("MARKER_NAMES", "MARKERS", ["lacks MARKER_NAMES"]),
        ("NO_OF_MARKERS\t2", "NO_OF_MARKERS\ttwo", ["line 3", "'two'"]),
        ("Tip 1\tbase", "base\tbase", ["two markers are labelled 'base'"]),
        ("430\t500", "43O\t500", ["line 15", "column base X", "'43O'"]),
        ("430\t500", "430\t500\t7", ["line 15", "7 cells", "expected 6"]),
        ("100\t200\t300\t400", "100\t200\t300\t400\t1", ["line 12", "7 cells", "6 coordinates"]),
        ("FREQUENCY\t100\nNO", "FREQUENCY\t-1\nNO", ["line 4", "FREQUENCY is '-1'"]),
    ],
)
def test_a_bad_qualisys_file_is_named_by_its_line(file, old, new, words):
    message = refusal(file(replaced(QUALISYS, old, new)), length_unit="mm")
    assert all(word in message for word in words), message


# Motive -------------------------------------------------------------------------------------------


def test_measured_markers_come_before_those_of_a_solved_body(file):
    solved = MOTIVE.replace("Tip 1,Tip 1,Tip 1,base,base,base", "Tip 1,Tip 1,Tip 1,foot,foot,foot")
    table = read_markers(file(solved))
    assert table.names == ("base", "Tip 1", "foot")
    np.testing.assert_allclose(table.positions_m[:, 0], 0.009)
    assert table.notes[0].startswith(
        "marker base has no measured columns; those of Type 'Rigid Body Ma"
    )


def test_markers_of_motive_in_the_frame_of_a_body_are_refused(file):
    with pytest.raises(InputError, match="Coordinate Space is 'Local'; expected Global"):
        read_markers(file(MOTIVE.replace("Space,Global", "Space,Local")))


def test_unlabelled_markers_are_taken_only_if_asked_for(file):
    table = read_markers(file(MOTIVE), labels={"Unlabeled 7": "tip"})
    assert table.names == ("Tip 1", "base", "tip")
    np.testing.assert_allclose(table.positions_m[1, 2], [0.001, 0.002, 0.003])
    assert read_markers(file(MOTIVE), names=["Unlabeled 7"]).names == ("Unlabeled 7",)


def test_older_headers_do_not_name_rows(file):
    text = MOTIVE.replace("\n,Type,", "\n,,").replace("\n,Name,", "\n,,").replace("\n,ID,", "\n,,")
    np.testing.assert_allclose(read_markers(file(text)).positions_m, TRACKS_M)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("Millimeters", "Feet", ["line 1, Length Units", "'Feet'"]),
        ("Exported Frames,4", "Exported Frames,9", ["line 1", "Frames is 9", "4 frames"]),
        ("Capture Frame Rate,100.000000,Export Frame Rate,100", "Export Frame Rate,x", ["'x"]),
        ("Frame,Time (Seconds)", "Row,Time (Seconds)", ["Frame,Time (Seconds)"]),
        ("0.030000,", "0.010000,", ["line 11", "0.01 follows 0.02"]),
        ("130,200,300", "130,200,left", ["line 11", "column Tip 1 Position Z", "'left'"]),
        ("130,200,300", "130,200", ["line 11", "22 cells", "expected 23"]),
        ("Tip 1,Tip 1,Tip 1,base", "base,base,base,base", ["two markers are named 'base'"]),
        ("X,Y,Z,X,Y,Z,X,Y,Z", "X,Y,Z,X,Y,Z,X,Y,W", ["'Unlabeled 7'", "X, Y, W"]),
    ],
)
def test_a_bad_motive_file_is_named_by_its_line(file, old, new, words):
    message = refusal(file(replaced(MOTIVE, old, new)))
    assert all(word in message for word in words), message


def test_a_motive_file_with_bodies_only_has_no_markers(file):
    text = MOTIVE.replace("Rigid Body Marker", "Bone").replace("Marker,", "Bone,")
    assert "contains no markers" in refusal(file(text.replace(",Marker\n", ",Bone\n")))


# Long plain CSV -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("z_mm", "z_m", ["line 1", "z_m", "expected t_s, marker, and x_m"]),
        ("0.03,base", "0.02,base", ["line 8", "marker 'base'", "0.02 follows 0.02"]),
        ("0.02,base", "0.02,", ["line 6", "column marker is blank"]),
        ("430,500", "43O,500", ["line 8", "column x_mm", "'43O'"]),
        ("0.03,base", ",base", ["line 8", "column t_s"]),
        ("430,500", "430", ["line 8", "4 cells", "expected 5"]),
    ],
)
def test_a_bad_long_file_is_named_by_its_line(file, old, new, words):
    message = refusal(file(replaced(LONG, old, new)))
    assert all(word in message for word in words), message


def test_a_frame_without_the_marker_asked_for_is_a_frame(file):
    table = read_markers(file(LONG), names=["Tip 1"])
    np.testing.assert_allclose(table.positions_m, TRACKS_M[:, :1])


VICON = """Trajectories
100
,,S:tip,,,S:base,,
Frame,Sub Frame,X,Y,Z,X,Y,Z
,,mm,mm,mm,mm,mm,mm
7,0,1,2,3,4,5,6
8,0,1,2,3,,,
10,0,1,2,3,4,5,7
"""
DEVICES = """Devices
1000
,,Force Plate - Force,,
Frame,Sub Frame,Fx,Fy,Fz
,,N,N,N
1,0,0.1,0.2,0.3
1,1,0.1,0.2,0.3

"""
OUTPUTS = """Model Outputs
100
,,S:LWristAngles,,
Frame,Sub Frame,X,Y,Z
,,deg,deg,deg
1,0,1,2,3

"""


@pytest.mark.parametrize("above", ["", DEVICES, OUTPUTS, DEVICES + OUTPUTS])
def test_a_vicon_csv_has_its_markers_among_other_blocks(file, above):
    table = read_markers(file(above + VICON))
    assert table.names == ("S:tip", "S:base")
    np.testing.assert_allclose(table.t_s, [0.06, 0.07, 0.09])
    np.testing.assert_allclose(table.positions_m[2, 1], [0.004, 0.005, 0.007])
    assert np.isnan(table.positions_m[1, 1]).all()
    blocks = [name for name in ("Devices", "Model Outputs") if name in above]
    assert ("not read: " + ", ".join(blocks) in table.notes) == bool(blocks)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (DEVICES, "found the blocks Devices of Vicon Nexus, but no Trajectories"),
        (VICON.replace("mm,mm\n", "mm,deg\n"), "line 5: the units are deg, mm"),
        (VICON.replace("Sub Frame", "Sub"), "line 1: expected below Trajectories"),
        (VICON.replace("S:base", "S:tip"), "two markers are labelled 'S:tip'"),
        (VICON.replace("100", "fast"), "'fast'; expected a number above 0"),
    ],
)
def test_a_bad_vicon_csv_is_refused(file, text, words):
    with pytest.raises(InputError) as caught:
        read_markers(file(text))
    assert words in str(caught.value)


def test_an_unknown_text_file_is_answered_with_the_formats_known(file):
    message = refusal(file("frame;x;y\n1;2;3\n"))
    assert "a C3D, TRC, Qualisys TSV, Motive or Vicon CSV file" in message


# C3D ----------------------------------------------------------------------------------------------


def write_c3d(path, tracks_mm=1000 * TRACKS_M, labels=("Tip 1", "base"), unit="mm"):
    ezc3d = pytest.importorskip("ezc3d")
    frames, markers, _ = tracks_mm.shape
    c3d = ezc3d.c3d()
    c3d["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    c3d["parameters"]["POINT"]["LABELS"]["value"] = tuple(labels)
    if unit:
        c3d["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    points = np.ones((4, markers, frames))
    points[:3] = np.asarray(tracks_mm).transpose(2, 1, 0)
    c3d["data"]["points"] = points
    c3d.write(str(path))
    return path


@pytest.mark.parametrize(
    ("stated", "frames", "first_s"),
    [
        ([("POINT", "LONG_FRAMES", [70000.0])], 70000, 0.0),
        ([("TRIAL", "ACTUAL_START_FIELD", [101, 0]), ("TRIAL", "ACTUAL_END_FIELD", [4564, 1])], 70000, 1.0),
        ([("TRIAL", "ACTUAL_START_FIELD", [4465, 1]), ("TRIAL", "ACTUAL_END_FIELD", [4468, 1])], 4, 700.0),
        ([], 65535, 0.0),
    ],
)  # fmt: skip
def test_more_frames_than_a_header_can_count_are_read(tmp_path, stated, frames, first_s):
    ezc3d = pytest.importorskip("ezc3d")
    written = 70000 if frames > 4 else 4
    c3d = ezc3d.c3d()
    c3d["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    c3d["parameters"]["POINT"]["LABELS"]["value"] = ("tip",)
    c3d["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    for parameter in stated:
        c3d.add_parameter(*parameter)
    points = np.ones((4, 1, written))
    points[0, 0] += np.arange(written)
    c3d["data"]["points"] = points
    path = tmp_path / "long.c3d"
    c3d.write(str(path))
    if written == 4:
        content = bytearray(path.read_bytes())
        content[6:10] = struct.pack("<2H", 65535, 65535)
        path.write_bytes(content)
    table = read_markers(path)
    np.testing.assert_allclose(
        table.positions_m[:, 0, 0], np.arange(1, frames + 1) / 1000, rtol=1e-6
    )
    np.testing.assert_allclose(table.t_s[[0, -1]], [first_s, first_s + (frames - 1) / 100])
    assert ("frames after the first 65535, if any, were not read" in table.notes) == (not stated)
    if frames == 70000:
        path.write_bytes(path.read_bytes()[:-4096])
        assert "the header states 70000 frames, but the file contains" in refusal(path)


@pytest.mark.parametrize("scale", [0.0, -0.0])
def test_a_scale_of_zero_in_c3d_is_named(tmp_path, scale):
    ezc3d = pytest.importorskip("ezc3d")
    path = write_c3d(tmp_path / "take.c3d")
    c3d = ezc3d.c3d(str(path))
    c3d["parameters"]["POINT"]["SCALE"]["value"] = [scale]
    c3d.write(str(path))
    message = refusal(path)
    assert "POINT:SCALE: the factor of all coordinates is 0; expected another" in message


@pytest.mark.parametrize("count", [4, 65535, 70000])
def test_the_number_of_frames_in_c3d_may_be_a_float(tmp_path, count):
    tracks_mm = np.ones((count, 1, 3)) * np.arange(1, count + 1)[:, None, None]
    path = write_c3d(tmp_path / "take.c3d", tracks_mm, labels=("tip",))
    content = path.read_bytes()
    # Type, dimensions and value of the parameter, which two bytes more make a float.
    found = re.search(rb"(?s)\xfa.FRAMES(..)\x02\x00..", content)
    assert found
    assert content[1534:1536] == b"\0\0"
    (offset,) = struct.unpack("<H", found[1])
    record = struct.pack("<HBBf", offset + 2, 4, 0, count)
    path.write_bytes(
        content[: found.start(1)] + record + content[found.end() : 1534] + content[1536:]
    )
    table = read_markers(path)
    np.testing.assert_allclose(
        table.positions_m[:, 0, 0], np.arange(1, count + 1) / 1000, rtol=1e-6
    )


def without_rate(path):
    """Set both places of the rate to zero; ezc3d itself cannot write that."""
    path.write_bytes(path.read_bytes().replace(struct.pack("<f", 100.0), bytes(4)))
    return path


def test_c3d_is_read_with_its_unit_rate_and_gaps(tmp_path):
    tracks_mm = 1000 * TRACKS_M
    tracks_mm[2, 1] = 0.0
    path = write_c3d(tmp_path / "take.c3d", tracks_mm).rename(tmp_path / "take.csv")
    table = read_markers(path)
    assert table.names == ("Tip 1", "base")
    np.testing.assert_allclose(table.t_s, [0.0, 0.01, 0.02, 0.03])
    np.testing.assert_allclose(table.positions_m, TRACKS_M, rtol=1e-6)
    assert table.notes == (
        "Tip 1: 1 of 4 samples missing (1 blank); base: 1 of 4 samples missing (1 zeros)",
    )


@pytest.mark.parametrize(
    ("lists", "group"),
    [
        ({"ANGLES": ["RElbow"]}, "ANGLES"),
        ({"FORCES2": ["RElbow"]}, "FORCES2"),
        ({"TYPE_GROUPS": ["MY_OUTPUTS"], "MY_OUTPUTS": ["RElbow"]}, "MY_OUTPUTS"),
    ],
)
def test_outputs_of_a_model_in_c3d_are_no_markers(tmp_path, lists, group):
    ezc3d = pytest.importorskip("ezc3d")
    tracks_mm = 1000 * np.concatenate([TRACKS_M, 50 + TRACKS_M[:, :1]], axis=1)
    path = write_c3d(tmp_path / "take.c3d", tracks_mm, labels=("Tip 1", "base", "RElbow"))
    c3d = ezc3d.c3d(str(path))
    for name, labels in lists.items():
        c3d.add_parameter("POINT", name, labels)
    c3d.write(str(path))
    table = read_markers(path)
    assert table.names == ("Tip 1", "base")
    assert f"RElbow of POINT:{group} are outputs of a model, not markers" in table.notes[0]
    with pytest.raises(InputError, match="no marker 'RElbow'"):
        read_markers(path, names=["RElbow"])


def test_a_negative_residual_in_c3d_is_a_gap(tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    path = write_c3d(tmp_path / "take.c3d", np.full((4, 2, 3), 7.0))
    c3d = ezc3d.c3d(str(path))
    c3d["data"]["meta_points"]["residuals"][0, 1, 2] = -1.0
    c3d.write(str(path))
    present = np.isfinite(read_markers(path).positions_m[:, :, 0])
    assert np.argwhere(~present).tolist() == [[2, 1]]


def test_markers_of_a_c3d_are_chosen_and_renamed(tmp_path):
    path = write_c3d(tmp_path / "take.c3d")
    table = read_markers(path, names=["foot", "Tip 1"], labels={"base": "foot"})
    np.testing.assert_allclose(table.positions_m, TRACKS_M[:, ::-1], rtol=1e-6)
    assert "did you mean 'base'?" in refusal(path, names=["bas"])


@pytest.mark.parametrize(
    ("written", "options", "words"),
    [
        ({"unit": "furlong"}, {}, ["POINT:UNITS", "'furlong'"]),
        ({"unit": None}, {}, ["no unit of length is stated by POINT:UNITS"]),
        ({}, {"length_unit": "m"}, ["length_unit is 'm'", "POINT:UNITS says 'mm'"]),
        ({}, {"rate_hz": 60.0}, ["rate_hz is 60", "POINT:RATE says 100"]),
        ({"labels": ("base", "base")}, {}, ["two markers are labelled 'base'"]),
    ],
)
def test_a_c3d_that_lacks_or_contradicts_is_refused(tmp_path, written, options, words):
    message = refusal(write_c3d(tmp_path / "take.c3d", **written), **options)
    assert all(word in message for word in words), message


def test_a_c3d_without_unit_or_rate_is_read_with_those_given(tmp_path):
    path = without_rate(write_c3d(tmp_path / "take.c3d", TRACKS_M * 1000 + 0.5, unit=None))
    message = refusal(path, length_unit="mm")
    assert all(word in message for word in ("neither POINT:RATE", "expected rate_hz"))
    table = read_markers(path, length_unit="mm", rate_hz=50.0)
    np.testing.assert_allclose(table.positions_m, TRACKS_M + 0.0005, rtol=1e-6)
    np.testing.assert_allclose(table.t_s, [0.0, 0.02, 0.04, 0.06])


@pytest.mark.parametrize("kept", [2, 100, 511, 600, 900, -600, -300])
def test_a_c3d_cut_short_is_refused(tmp_path, kept):
    path = write_c3d(tmp_path / "take.c3d", np.random.default_rng(0).normal(size=(40, 2, 3)))
    path.write_bytes(path.read_bytes()[:kept])
    refusal(path)


def test_c3d_without_ezc3d_names_the_extra(tmp_path, monkeypatch):
    path = write_c3d(tmp_path / "take.c3d")
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    message = refusal(path)
    assert "reading C3D needs ezc3d: pip install 'collocation-sysid[c3d]'" in message


# Frames before the release, and the template in the data's README.
TEMPLATE_M = {
    "Tip1": (0.0, 0.015, 0.036),
    "Tip2": (0.0, -0.006, 0.024),
    "Tip3": (0.0, 0.036, 0.006),
    "Base1": (-0.094, -0.01, -0.001),
    "Base2": (-0.094, 0.04, 0.0275),
    "Base3": (-0.094, 0.04, 0.0),
}


@pytest.mark.skipif(
    not [*MEASURED.glob("*_world_m.csv")], reason="the measured beam is not here, or not converted"
)
@pytest.mark.parametrize(("trial", "release"), [("gravity", 71), ("load52", 44), ("load101", 51)])
def test_the_measured_beam_comes_out_in_the_worlds_frame(trial, release):
    pytest.importorskip("ezc3d")
    labels = {
        name.replace("1", " - 1").replace("2", " - 2").replace("3", " - 3"): name
        for name in TEMPLATE_M
    }
    table = read_markers(MEASURED / f"beam_{trial}_V2_a.c3d", labels=labels)
    assert table.names == tuple(TEMPLATE_M)
    np.testing.assert_allclose(np.diff(table.t_s), 0.01)
    assert table.notes == ()
    fit = align_to_template(table, TEMPLATE_M, (0.0, (release - 1) / 100))
    expected = read_markers(MEASURED / f"beam_{trial}_V2_a_world_m.csv")
    np.testing.assert_allclose(fit.apply(table).positions_m, expected.positions_m, atol=1e-4)
    assert fit.residual_m.max() < 0.003
