"""Files of trackers, and tables of image tracks in a problem file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from kit.logs import json_mcap

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.kinds.image_tracks.files import read_tracks
from collocation_sysid.recording import read_markers
from collocation_sysid.recording.sources.calibration_files import read_calibration
from collocation_sysid.recording.sources.topics import list_topics

RNG = np.random.default_rng(7)
PIXELS = np.round(RNG.uniform(10, 600, (5, 2, 2)), 3)
SCORES = np.array([[0.9, 1.0], [0.2, 0.8], [0.7, 0.9], [1.0, 0.1], [0.95, 0.99]])
NAMES = ("tip", "hook")
T_S = np.array([0.0, 0.033, 0.067, 0.1, 0.133])


def write(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


def wide() -> str:
    lines = ["t_s,tip_u,tip_v,tip_likelihood,hook_u,hook_v,hook_likelihood"]
    for t, pixels, scores in zip(T_S, PIXELS, SCORES, strict=True):
        cells = [f"{u},{v},{s}" for (u, v), s in zip(pixels, scores, strict=True)]
        lines.append(",".join([str(t), *cells]))
    return "\n".join(lines) + "\n"


def long() -> str:
    lines = ["frame,point,u,v,likelihood"]
    for k in range(5):
        for name, (u, v), s in zip(NAMES, PIXELS[k], SCORES[k], strict=True):
            lines.append(f"{k},{name},{u},{v},{s}")
    return "\n".join([lines[0], *reversed(lines[1:])]) + "\n"


def deeplabcut() -> pd.DataFrame:
    columns = pd.MultiIndex.from_product(
        [["net"], NAMES, ["x", "y", "likelihood"]], names=["scorer", "bodyparts", "coords"]
    )
    values = np.concatenate([PIXELS, SCORES[..., None]], axis=2).reshape(5, -1)
    return pd.DataFrame(values, columns=columns)


def require_same(read: Any, has_times: bool = False) -> None:
    assert read.names == NAMES
    np.testing.assert_allclose(read.pixels, PIXELS, atol=1e-9)
    assert read.likelihood is not None
    np.testing.assert_allclose(read.likelihood, SCORES, atol=1e-9)
    assert (read.t_s is not None) == has_times
    confident = read.confident(0.6)
    assert np.isnan(confident[1, 0]).all()
    assert np.isfinite(confident[1, 1]).all()


def test_wide_and_long_tables_are_read(tmp_path: Path) -> None:
    read = read_tracks(write(tmp_path, "wide.csv", wide()))
    require_same(read, has_times=True)
    assert read.t_s is not None
    np.testing.assert_allclose(read.t_s, T_S)
    read = read_tracks(write(tmp_path, "long.csv", long()))
    order = [read.names.index(name) for name in NAMES]
    np.testing.assert_allclose(read.pixels[:, order], PIXELS)
    np.testing.assert_allclose(read.frames, np.arange(5))


def test_tables_of_deeplabcut_are_read(tmp_path: Path) -> None:
    deeplabcut().to_csv(tmp_path / "dlc.csv")
    require_same(read_tracks(tmp_path / "dlc.csv"))


def test_hdf5_files_of_deeplabcut_are_read_without_executing_their_contents(tmp_path: Path) -> None:
    pytest.importorskip("tables")
    pytest.importorskip("h5py")
    deeplabcut().to_hdf(tmp_path / "dlc.h5", key="df_with_missing", format="table", mode="w")
    require_same(read_tracks(tmp_path / "dlc.h5"))


def test_animals_of_deeplabcut_are_part_of_the_names(tmp_path: Path) -> None:
    text = (
        "scorer,net,net,net,net,net,net\nindividuals,a,a,a,b,b,b\n"
        "bodyparts,tip,tip,tip,tip,tip,tip\ncoords,x,y,likelihood,x,y,likelihood\n"
        "0,1,2,0.9,3,4,0.8\n1,1,2,0.9,,,\n"
    )
    read = read_tracks(write(tmp_path, "dlc.csv", text))
    assert read.names == ("a_tip", "b_tip")
    np.testing.assert_allclose(read.pixels[0], [[1, 2], [3, 4]])
    assert np.isnan(read.confident(0.6)[1, 1]).all()


def test_analysis_files_of_sleap_are_read(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "analysis.h5", "w") as file:
        file["tracks"] = PIXELS.transpose(2, 1, 0)[None]
        file["node_names"] = np.array(NAMES, dtype="S")
        file["track_names"] = np.array(["bar"], dtype="S")
        file["point_scores"] = SCORES.T[None]
    require_same(read_tracks(tmp_path / "analysis.h5"))


def sleap_table(animals: tuple[str, ...]) -> str:
    """Return the analysis table of SLEAP, in which each animal has its own row in an image."""
    lines = ["track,frame_idx,instance.score," + ",".join(f"{n}.x,{n}.y,{n}.score" for n in NAMES)]
    for k in range(5):
        for animal in reversed(animals):
            cells = zip(PIXELS[k], SCORES[k], strict=True)
            points = ",".join(f"{u},{v},{s}" for (u, v), s in cells)
            lines.append(f"{animal},{k + 3},0.9,{points}")
    return "\n".join(lines) + "\n"


def test_tables_of_sleap_and_of_x_and_y_are_read(tmp_path: Path) -> None:
    alone = read_tracks(write(tmp_path, "a.csv", sleap_table(("",))))
    require_same(alone)
    assert alone.frames.tolist() == [3, 4, 5, 6, 7]
    several = read_tracks(write(tmp_path, "b.csv", sleap_table(("ant", "bee"))))
    assert several.names == ("bee_tip", "bee_hook", "ant_tip", "ant_hook")
    np.testing.assert_allclose(several.pixels, np.concatenate([PIXELS, PIXELS], axis=1))
    other = wide().replace("_u", "_x").replace("_v", "_y").replace("likelihood", "confidence")
    require_same(read_tracks(write(tmp_path, "c.csv", other)), has_times=True)
    other = long().replace("frame,point,u,v,likelihood", "frame,point_id,x,y,score")
    read = read_tracks(write(tmp_path, "d.csv", other))
    assert read.names == ("hook", "tip")
    np.testing.assert_allclose(read.pixels[:, ::-1], PIXELS)
    assert read.likelihood is not None
    np.testing.assert_allclose(read.likelihood[:, ::-1], SCORES)


@pytest.mark.parametrize("name", ["wide", "sleap", "deeplabcut"])
def test_pixels_in_a_table_of_markers_are_called_image_tracks(name: str, tmp_path: Path) -> None:
    if name == "deeplabcut":
        deeplabcut().to_csv(tmp_path / "a.csv")
    else:
        write(tmp_path, "a.csv", wide() if name == "wide" else sleap_table(("",)))
    with pytest.raises(InputError, match=r"pixels of a video belong to \[\[experiment.image_tr"):
        read_markers(tmp_path / "a.csv")


def test_positions_in_space_are_no_pixels(tmp_path: Path) -> None:
    with pytest.raises(cs.InputError, match="NAME_u and NAME_v"):
        read_tracks(write(tmp_path, "e.csv", "t_s,tip_x,tip_y,tip_z\n0,1,2,3\n0.1,1,2,3\n"))
    twice = sleap_table(("ant", "bee")).replace("bee", "ant")
    with pytest.raises(cs.InputError, match="'ant' appears twice in this image"):
        read_tracks(write(tmp_path, "f.csv", twice))


XML = """<?xml version="1.0"?>
<opencv_storage>
<!-- a calibration -->
<image_width>640</image_width><image_height>480</image_height>
<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
<data>900. 0. 320. 0. 905. 240. 0. 0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix"><rows>1</rows><cols>5</cols><dt>d</dt>
<data>-0.1 2.0e-02 0. 0. 0.</data></distortion_coefficients>
</opencv_storage>
"""


def test_calibrations_of_opencv_are_read_from_xml_and_from_archives(tmp_path: Path) -> None:
    matrix, distortion = [[900, 0, 320], [0, 905, 240], [0, 0, 1]], [-0.1, 0.02, 0, 0, 0]
    np.savez(tmp_path / "b.npz", mtx=matrix, dist=[distortion], rvecs=np.zeros((4, 3, 1)))
    for file in (write(tmp_path, "a.xml", XML), tmp_path / "b.npz"):
        found = read_calibration(file)
        assert found.matrix.tolist() == matrix
        assert found.distortion.tolist() == distortion
        assert found.size_px == ((640, 480) if file.suffix == ".xml" else None)
    np.savez(tmp_path / "c.npz", tracks=np.zeros(3))
    with pytest.raises(cs.InputError, match=r"c\.npz: found the keys tracks; expected the matrix"):
        read_calibration(tmp_path / "c.npz")


@pytest.mark.parametrize(
    "text", [XML[:300], '<!DOCTYPE a [<!ENTITY b "c">]>' + XML, "<html></html>"]
)
def test_other_xml_files_are_no_calibrations(text: str, tmp_path: Path) -> None:
    with pytest.raises(cs.InputError, match=r"a\.xml: found neither YAML, JSON, XML"):
        read_calibration(write(tmp_path, "a.xml", text))


@pytest.mark.parametrize("version", [1.0, 1.3])
def test_labels_of_sleap_are_read(version: float, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    nodes = [{"name": "unused"}, *({"name": name} for name in reversed(NAMES))]
    count = len(NAMES)
    order = [{"id": count - k} for k in range(count)]
    shift = 0.5 if version < 1.1 else 0.0
    point = [("x", "f8"), ("y", "f8"), ("visible", "?"), ("complete", "?"), ("score", "f8")]
    points = [
        (*(xy + shift), True, False, score)
        for row, scores in zip(PIXELS, SCORES, strict=True)
        for xy, score in zip(row, scores, strict=True)
    ]
    kinds = ["instance_id", "instance_type", "frame_id", "track", "point_id_start", "point_id_end"]
    instances = [(k, 1, k, -1, count * k, count * (k + 1)) for k in range(len(PIXELS))]
    # What a person placed in the last image precedes what is predicted there.
    last = len(PIXELS) - 1
    wrong = [(0.0, 0.0, True, False, 0.5)] * count
    instances.append((last + 1, 1, last, -1, count * (last + 1), count * (last + 2)))
    instances[last] = (last, 0, last, -1, 0, count)
    heads = ["frame_id", "video", "frame_idx", "instance_id_start", "instance_id_end"]
    frames = [(k, 0, k, k, k + 1 + (k == last)) for k in range(len(PIXELS))]
    with h5py.File(tmp_path / "bar.slp", "w") as file:
        file.create_group("metadata").attrs["format_id"] = version
        stated = {"nodes": nodes, "skeletons": [{"nodes": order}]}
        file["metadata"].attrs["json"] = np.bytes_(json.dumps(stated))
        file["pred_points"] = np.array([*points, *wrong], dtype=point)
        file["points"] = np.array([each[:4] for each in points[-count:]], dtype=point[:4])
        types = [(name, "u1" if name == "instance_type" else "i8") for name in kinds]
        file["instances"] = np.array(instances, dtype=types)
        file["frames"] = np.array(frames, dtype=[(name, "i8") for name in heads])
    read = read_tracks(tmp_path / "bar.slp")
    assert read.names == NAMES
    np.testing.assert_allclose(read.pixels, PIXELS)
    assert read.likelihood is not None
    np.testing.assert_allclose(read.likelihood, [*SCORES[:-1], np.ones(count)])


@pytest.mark.parametrize("name", ["t_ms", "Time (ms)", "Zeit in ms"])
def test_times_of_tables_have_any_unit(name: str, tmp_path: Path) -> None:
    rows = [line.split(",", 1) for line in wide().splitlines()[1:]]
    later = [f"{1e3 * float(t):g},{rest}" for t, rest in rows]
    header = wide().splitlines()[0].replace("t_s", name)
    read = read_tracks(write(tmp_path, "wide.csv", "\n".join([header, *later])))
    require_same(read, has_times=True)
    assert read.t_s is not None
    np.testing.assert_allclose(read.t_s, T_S)
    table = f"{name},point,u,v\n0,t,1,2\n100,t,3,4\n"
    long_t_s = read_tracks(write(tmp_path, "l.csv", table)).t_s
    assert long_t_s is not None
    np.testing.assert_allclose(long_t_s, [0, 0.1])
    assert read_tracks(write(tmp_path, "f.csv", "frame,t_u,t_v\n0,1,2\n1,3,4\n")).t_s is None


def test_archives_of_cotracker_and_tapir_are_read(tmp_path: Path) -> None:
    names = np.array(NAMES)
    np.savez(
        tmp_path / "co.npz", pred_tracks=PIXELS[None], pred_visibility=SCORES[None], names=names
    )
    require_same(read_tracks(tmp_path / "co.npz"))
    np.savez(
        tmp_path / "tapir.npz",
        tracks=PIXELS.transpose(1, 0, 2),
        visibles=SCORES.T,
        names=names,
        fps=30.0,
    )
    read = read_tracks(tmp_path / "tapir.npz")
    require_same(read, has_times=True)
    assert read.t_s is not None
    np.testing.assert_allclose(read.t_s, np.arange(5) / 30)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t_s,a,b\n0,1,2\n", r"tracks.csv: line 1: found the columns t_s, a, b; expected a table"),
        ("t_s,tip_u\n0,1\n", "there is no column 'tip_v'"),
        ("t_s,tip_u,tip_v\n0,x,2\n", "line 2"),
        ("frame,point,u,v\n0,tip,1,2\n0,tip,3,4\n", "line 3: tip appears twice in this image"),
        ("scorer,n,n\ncoords,x,y\n0,1,2\n", "expected those of DeepLabCut"),
        ("scorer,n\nbodyparts,a,a\ncoords,x\n0,1,2\n", "header rows have different lengths"),
    ],
)
def test_faulty_tables_are_refused(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(cs.InputError, match=message):
        read_tracks(write(tmp_path, "tracks.csv", text))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"a": np.zeros(3)}, "found the arrays a; expected pred_tracks or tracks"),
        ({"pred_tracks": np.zeros((5, 2))}, r"pred_tracks has the shape \(5, 2\)"),
        (
            {"pred_tracks": PIXELS, "pred_visibility": np.ones((2, 5))},
            r"pred_visibility has the shape \(2, 5\)",
        ),
        ({"pred_tracks": PIXELS, "names": np.array(["a"])}, "names has 1 names for 2 points"),
        ({"pred_tracks": np.array([None])}, "cannot be read"),
    ],
)
def test_faulty_archives_are_refused(arrays: dict, message: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "tracks.npz", **arrays)
    with pytest.raises(cs.InputError, match=rf"tracks.npz: .*{message}"):
        read_tracks(tmp_path / "tracks.npz")


SHAPE = (5, 2, 2)
BAD_ARRAYS: dict[str, tuple[dict[str, Any], str]] = {
    "complex": ({"pred_tracks": np.ones(SHAPE, complex)}, "pred_tracks must hold numbers"),
    "texts": ({"pred_tracks": np.full(SHAPE, "x")}, "pred_tracks must hold numbers"),
    "no images": ({"pred_tracks": np.zeros((0, 2, 2))}, "expected \\(T, N, 2\\)"),
    "rate of zero": ({"fps": 0.0}, "fps is \\[0.0\\]; expected one number above 0"),
    "rates": ({"fps": [30.0, 60.0]}, "expected one number above 0"),
    "a time": ({"t_s": 1.0}, "t_s .*shape"),
    "times without a number": ({"t_s": [0, 1, np.nan, 3, 4]}, "t_s"),
    "one name twice": ({"names": ["a", "a"]}, "2 points are called 'a'; expected one"),
    "visible texts": (
        {"pred_visibility": np.full((5, 2), "x")},
        "pred_visibility must hold numbers",
    ),
}


@pytest.mark.parametrize(("change", "message"), BAD_ARRAYS.values(), ids=BAD_ARRAYS)
def test_arrays_that_are_no_tracks_are_refused(change: dict, message: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "co.npz", **{"pred_tracks": PIXELS, **change})
    with pytest.raises(cs.InputError, match=message):
        read_tracks(tmp_path / "co.npz")


def test_damaged_hdf5_files_are_refused(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    file = tmp_path / "analysis.h5"
    with h5py.File(file, "w") as content:
        content["tracks"] = PIXELS.transpose(2, 1, 0)[None]
        content["node_names"] = np.arange(3.0)[:, None]
    with pytest.raises(cs.InputError, match=r"tracks has the shape"):
        read_tracks(file)
    file.write_bytes(file.read_bytes()[:900])
    with pytest.raises(cs.InputError, match="this HDF5 file cannot be read"):
        read_tracks(file)
    with h5py.File(file, "w") as content:
        shape = (1, 2, 2, 10**9)
        content.create_dataset("tracks", shape, "f4", chunks=(1, 2, 2, 1000), compression="gzip")
        content["node_names"] = np.array(NAMES, dtype="S")
    with pytest.raises(cs.InputError, match="expected an array with data"):
        read_tracks(file)


@pytest.mark.parametrize("tag", ["!!int x", "!!bool x", "!!timestamp x", "1" + 400 * "0"])
def test_calibrations_with_wrong_values_are_refused(tag: str, tmp_path: Path) -> None:
    text = f"K: [{tag}, 0, 1, 0, 1, 1, 0, 0, 1]\n"
    with pytest.raises(cs.InputError, match="expected"):
        read_calibration(write(tmp_path, "c.yaml", text))


# Topics of logs -----------------------------------------------------------------------------------


def point_of_own_message(name: str, u: float, v: float, score: float) -> dict[str, Any]:
    return {"name": name, "u": u, "v": v, "likelihood": score}


def april_tag(name: str, u: float, v: float, score: float) -> dict[str, Any]:
    return {"id": NAMES.index(name), "centre": {"x": u, "y": v}, "decision_margin": 60.0}


def detection(name: str, u: float, v: float, score: float) -> dict[str, Any]:
    centre = {"position": {"x": u, "y": v}, "theta": 0.0}
    return {
        "id": name,
        "bbox": {"center": centre, "size_x": 9.0},
        "results": [{"hypothesis": {"class_id": "dot", "score": score}}],
    }


@pytest.mark.parametrize("item", [point_of_own_message, april_tag, detection])
def test_topics_of_logs_are_tracks(tmp_path: Path, item: Any) -> None:
    messages: list[tuple[float, dict]] = []
    for t, pixels, scores in zip(T_S, PIXELS, SCORES, strict=True):
        seen = zip(NAMES, pixels.tolist(), scores.tolist(), strict=True)
        # A tracker omits what it does not find.
        items = [item(name, u, v, s) for name, (u, v), s in seen if name != "hook" or t > 0]
        messages.append(
            (float(t), {"points" if item is point_of_own_message else "detections": items})
        )
    log = json_mcap(tmp_path / "run.mcap", {"/camera/points": ("points", messages)})
    names = ("0", "1") if item is april_tag else NAMES
    (topic,) = list_topics(log)
    assert topic.serves == f"image tracks: {', '.join(sorted(names))}"
    found = read_tracks(f"{log}#/camera/points")
    assert found.names == names
    assert found.t_s is not None
    np.testing.assert_allclose(found.t_s, T_S, atol=1e-9)
    np.testing.assert_allclose(found.pixels[:, 0], PIXELS[:, 0])
    np.testing.assert_allclose(found.pixels[1:, 1], PIXELS[1:, 1])
    assert np.isnan(found.pixels[0, 1]).all()
    if item is april_tag:
        assert found.likelihood is None
    else:
        assert found.likelihood is not None
        np.testing.assert_allclose(found.likelihood[:, 0], SCORES[:, 0])


@pytest.mark.parametrize("capital", [False, True])
def test_calibrations_are_read_from_topics(tmp_path: Path, capital: bool) -> None:
    matrix = [900.0, 0, 640, 0, 905, 360, 0, 0, 1]
    numbers = {"k": matrix, "d": [-0.1, 0.02, 0, 0, 0], "p": [0.0] * 12}
    content = {name.upper() if capital else name: each for name, each in numbers.items()}
    content |= {"width": 1280, "height": 720, "distortion_model": "plumb_bob"}
    topics = {
        "/camera/camera_info": ("CameraInfo", [(0.0, content)]),
        "/x": ("n", [(0.0, {"data": 1.0})]),
    }
    log = json_mcap(tmp_path / "run.mcap", topics)
    found = read_calibration(f"{log}#/camera/camera_info")
    np.testing.assert_allclose(found.matrix.ravel(), matrix)
    np.testing.assert_allclose(found.distortion[:2], [-0.1, 0.02])
    assert (found.size_px, found.model) == ((1280, 720), "pinhole")
    with pytest.raises(cs.InputError, match=r"/x has no camera model"):
        read_calibration(f"{log}#/x")


@pytest.mark.parametrize(
    ("header", "missing"),
    [
        ("t_s,tip_u,tip_v,tip_likelihood,hook_u,hook_v,hook_likelyhood", "hook_likelihood"),
        ("t_s,tip_u,tip_v,tip_likelihood,hock_u,hook_v,hook_likelihood", "hock_v"),
        ("t_s,tip_u,tip_v,tip_likelihood,u,hook_v,hook_likelihood", "hook_u"),
    ],
)
def test_a_misspelt_column_of_a_point_is_not_ignored(header, missing, tmp_path: Path) -> None:
    file = tmp_path / "front.csv"
    file.write_text(f"{header}\n0.0,1,2,0.9,3,4,0.1\n0.1,1,2,0.9,3,4,0.1\n")
    with pytest.raises(InputError, match=f"there is no column '{missing}'; expected one"):
        read_tracks(file)
