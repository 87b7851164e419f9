"""Topics of robot logs in place of files."""

from __future__ import annotations

import io
import json
import os
import socket
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from kit.frames import swing
from kit.logs import KINDS, START_S, URDF, Messages, bag, dataset, json_mcap, recorded
from kit.problem_files import run_command, write_problem
from kit.robot_log import POSES, robot_problem
from PIL import Image
from scipy.spatial.transform import Rotation

from collocation_sysid.cli import common
from collocation_sysid.common.display import PlainConsole
from collocation_sysid.errors import InputError
from collocation_sysid.extras.live.frames import FrameReader
from collocation_sysid.problem import Problem
from collocation_sysid.recording import read_markers, read_poses, read_wrench
from collocation_sysid.recording.sources.depth_files import read_depth
from collocation_sysid.recording.sources.logs import stored_files
from collocation_sysid.recording.sources.topics import list_topics
from collocation_sysid.recording.time_tables import read_custom_sensor, read_pressure

T_S = np.arange(40) / 50.0
STILL = (0.0, 0.0, 0.0, 1.0)


def about_z(angle: float) -> np.ndarray:
    return Rotation.from_rotvec([0, 0, angle]).as_quat()


def test_a_missing_log_is_not_called_damaged(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no such file or folder"):
        list_topics(tmp_path / "none.bag")


@pytest.mark.parametrize("kind", KINDS)
def test_a_problem_read_from_a_log_is_the_one_of_its_files(tmp_path: Path, kind: str) -> None:
    file = write_problem(tmp_path, {"swing": 12})
    poses = read_poses(tmp_path / "swing_motion.csv")
    table = read_markers(tmp_path / "swing_markers.csv")
    lost = table.positions_m.copy()
    lost[3, 1] = np.nan
    table = replace(table, positions_m=lost)
    log = bag(tmp_path / "trial", recorded(poses, table, kind), kind)
    text = file.read_text().replace("swing_motion.csv", f"{log.relative_to(tmp_path)}#/gripper")
    text = text.replace("swing_markers.csv", f"{log.relative_to(tmp_path)}#/markers")
    before = Problem.read(file).experiments[0]
    file.write_text(text)
    experiment = Problem.read(file).experiments[0]
    np.testing.assert_allclose(experiment.t_s, before.t_s, atol=1e-9)
    moved, moved_before = (e.grasps[0].poses for e in (experiment, before))
    np.testing.assert_allclose(moved.positions_m, moved_before.positions_m, atol=1e-12)
    measured, as_files = (e.markers.positions_m for e in (experiment, before))
    missing = np.isnan(measured)
    assert missing.sum() == 3
    assert missing[3, 1].all()
    np.testing.assert_allclose(measured[~missing], as_files[~missing], atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_a_frame_is_followed_through_a_tree_of_frames_at_rates_of_their_own(
    tmp_path: Path, kind: str
) -> None:
    of = Messages(kind)

    def messages():
        yield of.tree(
            0.0, of.transform(0.0, "flange", "tool", (0, 0, 0.1), STILL), topic="/tf_static"
        )
        for t in np.arange(0, 0.8001, 0.1):  # a base that slides steadily
            yield of.tree(t, of.transform(t, "world", "base", (t, 0, 0), STILL))
        for t in T_S:
            yield of.tree(t, of.transform(t, "base", "flange", (0, 0, 1), about_z(2 * t)))

    log = bag(tmp_path / "trial", sorted(messages(), key=lambda m: m[0]), kind)
    poses = read_poses(f"{log}#/tf#world>tool")
    np.testing.assert_allclose(poses.t_s, T_S, atol=1e-6)
    np.testing.assert_allclose(poses.positions_m, [(t, 0, 1.1) for t in T_S], atol=1e-6)
    np.testing.assert_allclose(poses.quaternions_xyzw, [about_z(2 * t) for t in T_S], atol=1e-6)
    back = read_poses(f"{log}#/tf#tool>world")
    turned = Rotation.from_quat(back.quaternions_xyzw).apply(poses.positions_m.copy())
    np.testing.assert_allclose(turned, -back.positions_m, atol=1e-9)


def test_wrenches_pressures_and_joints_are_read_as_tables(tmp_path: Path) -> None:
    of = Messages()
    messages = [
        each
        for t in T_S
        for each in (
            of.wrench(t, (1, 2, t, 0.1, 0.2, 0.3)),
            of.pressure(t, 1e3 + t),
            of.joints(t, {"turn": t, "slide": 0.1}),
        )
    ]
    log = bag(tmp_path / "trial", messages)
    t_s, wrench, _ = read_wrench(f"{log}#/wrench")
    np.testing.assert_allclose(t_s, T_S, atol=1e-9)
    np.testing.assert_allclose(wrench[5], [1, 2, T_S[5], 0.1, 0.2, 0.3])
    np.testing.assert_allclose(read_pressure(f"{log}#/chamber")[1], 1e3 + T_S)
    _, values, names = read_custom_sensor(f"{log}#/joint_states")
    assert names == ["turn", "slide"]
    np.testing.assert_allclose(values[:, 0], T_S)


def test_joints_make_poses_of_a_link_by_the_robots_description(tmp_path: Path) -> None:
    of = Messages()
    log = bag(tmp_path / "trial", [of.joints(t, {"turn": t, "slide": 0.1 + t / 10}) for t in T_S])
    (tmp_path / "arm.urdf").write_text(URDF)
    poses = read_poses(f"{log}#/joint_states#arm.urdf#base>tool")
    reach = 0.3 + T_S / 10
    expected = np.column_stack([reach * np.cos(T_S), reach * np.sin(T_S), np.full(len(T_S), 0.5)])
    np.testing.assert_allclose(poses.positions_m, expected, atol=1e-9)
    np.testing.assert_allclose(poses.quaternions_xyzw, [about_z(t) for t in T_S], atol=1e-9)


def test_an_episode_of_a_dataset_makes_poses_once_the_unit_of_joints_is_stated(
    tmp_path: Path,
) -> None:
    count = 20
    degrees = {"turn": [*np.linspace(0, 60, count)], "slide": [0.0] * count}
    folder = dataset(tmp_path / "pick", degrees)
    (tmp_path / "arm.urdf").write_text(URDF.replace('type="prismatic"', 'type="revolute"'))
    address = f"{folder}#observation.state#1#arm.urdf#base>upper"
    with pytest.raises(InputError, match="unit of the joint positions; expected #rad or #deg"):
        read_poses(address)
    poses = read_poses(f"{address}#deg")
    turned = Rotation.from_quat(poses.quaternions_xyzw).as_rotvec(degrees=True)[:, 2]
    np.testing.assert_allclose(turned, np.array(degrees["turn"]) + 0.01, atol=1e-5)
    alone = dataset(tmp_path / "one", degrees, episodes=1)
    with pytest.raises(InputError, match="unit of the joint positions; expected #rad or #deg"):
        read_poses(f"{alone}#observation.state#arm.urdf#base>upper")
    with pytest.raises(
        InputError, match="has 2 episodes; expected the index of one of them after the topic"
    ):
        read_custom_sensor(f"{folder}#observation.state")


def test_json_messages_of_an_mcap_file_are_read_as_those_of_ros(tmp_path: Path) -> None:
    def message(t: float) -> dict:
        stamp = {"sec": int(START_S), "nsec": round(t * 1e9)}
        pose = {
            "position": {"x": t, "y": 0.0, "z": 0.0},
            "orientation": dict(zip("xyzw", STILL, strict=True)),
        }
        return {"timestamp": stamp, "frame_id": "world", "pose": pose}

    messages = [(t, message(t)) for t in T_S]
    log = json_mcap(tmp_path / "run.mcap", {"/tool": ("foxglove.PoseInFrame", messages)})
    np.testing.assert_allclose(read_poses(f"{log}#/tool").positions_m[:, 0], T_S, atol=1e-9)


def test_the_topics_of_a_log_are_listed_with_their_use(tmp_path: Path) -> None:
    of = Messages()
    place = {"left": (0, 0, 0), "right": (1, 0, 0)}
    messages = [
        each
        for t in T_S
        for each in (
            of.wrench(t, np.ones(6)),
            of.markers(t, place),
            of.tree(t, of.transform(t, "base", "tool", (0, 0, t), STILL)),
        )
    ]
    log = bag(tmp_path / "trial", messages)
    topics = {each["name"]: each for each in json.loads(run_command("log", log, "--json").out)}
    assert topics["/markers"]["serves"] == "marker tracks: left, right"
    assert topics["/tf"]["write"] == ["trial#/tf#base>tool"]
    assert topics["/wrench"]["rate_hz"] == pytest.approx(50, rel=1e-3)
    assert topics["/wrench"]["messages"] == len(T_S)
    assert "trial#/tf#base>tool" in run_command("log", log).out


def test_topics_offer_the_chains_of_frames_that_can_be_read(tmp_path: Path) -> None:
    of = Messages()
    fixed = (
        of.transform(0.0, "world", "base", (1, 0, 0), STILL),
        of.transform(0.0, "world", "table", (0, 1, 0), STILL),
        of.transform(0.0, "flange", "tool0", (0, 0, 1), STILL),
    )
    moving = [of.tree(t, of.transform(t, "base", "flange", (0, t, 0), STILL)) for t in T_S]
    log = bag(tmp_path / "trial", [of.tree(0.0, *fixed, topic="/tf_static"), *moving])
    topics = {each.name: each for each in list_topics(log)}
    addresses = topics["/tf"].write
    assert addresses == ("trial#/tf#world>tool0", "trial#/tf#world>flange")
    for address in addresses:  # each can be read as it is written
        np.testing.assert_allclose(read_poses(tmp_path / address).positions_m[:, 1], T_S, atol=1e-6)
    assert topics["/tf_static"].write == ()
    assert topics["/tf_static"].serves == "static frames, part of the chains of /tf"


def test_topics_offer_chains_from_the_frame_of_the_markers(tmp_path: Path) -> None:
    robot_problem(tmp_path)
    log = tmp_path / "trial"
    addresses = {each.name: each for each in list_topics(log)}["/tf"].write
    assert addresses == (
        "trial#/tf#base_link>gripper",
        "trial#/tf#base_link>sensor",
        "trial#/tf#base_link>tool0",
        "trial#/tf#mocap>gripper",
        "trial#/tf#mocap>sensor",
        "trial#/tf#mocap>tool0",
    )
    assert POSES in addresses
    for address in addresses:  # each can be read as it is written
        assert len(read_poses(tmp_path / address).t_s) == 13


def test_addresses_of_topics_are_lines_that_can_be_copied(tmp_path: Path, monkeypatch) -> None:
    of = Messages()
    tool = "a_tool_with_a_name_as_long_as_those_of_robots_are"
    log = bag(
        tmp_path / "trial",
        [of.tree(t, of.transform(t, "world_of_the_robot", tool, (0, 0, t), STILL)) for t in T_S],
    )
    address = f"trial#/tf#world_of_the_robot>{tool}"
    out = run_command("log", log).out
    assert f"  {address}" in out.splitlines()
    row = next(line for line in out.splitlines() if line.startswith("/tf"))
    assert "TFMessage" in row
    assert row.endswith("poses of one frame relative to another")
    file = io.StringIO()
    console = PlainConsole(file=file, width=40, force_terminal=True, color_system=None)
    monkeypatch.setattr(common, "PlainConsole", lambda: console)
    run_command("log", log)
    assert f"  {address}" in file.getvalue().splitlines()


def test_the_frame_of_the_markers_is_listed_and_begins_chains(tmp_path: Path) -> None:
    camera = {"frame_id": "/camera", "stamp": {"sec": 0, "nanosec": 0}}

    def array(t: float) -> tuple[float, dict[str, Any]]:
        place = {"x": t, "y": 0.0, "z": 0.0}
        marker = {"header": camera, "ns": "bar", "id": 3}
        return t, {"markers": [{**marker, "pose": {"position": place}}]}

    def transforms(t: float) -> tuple[float, dict[str, Any]]:
        turn = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
        pairs = [("base", "camera", 1.0), ("base", "tool0", t)]
        return t, {
            "transforms": [
                {
                    "header": {"frame_id": parent},
                    "child_frame_id": child,
                    "transform": {"translation": {"x": x, "y": 0.0, "z": 0.0}, "rotation": turn},
                }
                for parent, child, x in pairs
            ]
        }

    times_s = (0.0, 1.0, 2.0)
    log = json_mcap(
        tmp_path / "run.mcap",
        {
            "/tags": ("visualization_msgs/MarkerArray", [array(t) for t in times_s]),
            "/tf": ("tf2_msgs/TFMessage", [transforms(t) for t in times_s]),
        },
    )
    topics = {each.name: each for each in list_topics(log)}
    assert topics["/tags"].frame == "camera"
    assert topics["/tf"].frame == ""
    assert "run.mcap#/tf#camera>tool0" in topics["/tf"].write
    lines = run_command("log", log).out.splitlines()
    assert "frame" in lines[0].split()
    assert any("/tags" in line and " camera " in line for line in lines)


def test_markers_of_several_namespaces_are_named_with_the_namespace(tmp_path: Path) -> None:
    def array(t: float, spaces: tuple[str, ...]) -> tuple[float, dict[str, Any]]:
        places = [(space, k) for space in spaces for k in range(2)]
        markers = [
            {"ns": space, "id": k, "pose": {"position": {"x": len(space), "y": k, "z": t}}}
            for space, k in places
        ]
        return t, {"markers": markers}

    name = "visualization_msgs/MarkerArray"
    several = [array(t, ("body", "robot")) for t in (0.0, 1.0, 2.0)]
    one = [array(t, ("body",)) for t in (0.0, 1.0, 2.0)]
    log = json_mcap(tmp_path / "run.mcap", {"/several": (name, several), "/one": (name, one)})
    topics = {each.name: each.serves for each in list_topics(log)}
    assert topics == {
        "/several": "marker tracks: body/0, body/1; robot/0, robot/1",
        "/one": "marker tracks: 0, 1",
    }
    table = read_markers(f"{log}#/several")
    assert table.names == ("body/0", "body/1", "robot/0", "robot/1")
    np.testing.assert_allclose(table.positions_m[1], [[4, 0, 1], [4, 1, 1], [5, 0, 1], [5, 1, 1]])
    assert read_markers(f"{log}#/one").names == ("0", "1")


def point(t: float, place: tuple[float, ...], frame: str = "world") -> tuple[float, dict[str, Any]]:
    """A PointStamped as JSON."""
    stamp = {"sec": int(START_S + t), "nanosec": round((t % 1) * 1e9)}
    return t, {
        "header": {"stamp": stamp, "frame_id": frame},
        "point": dict(zip("xyz", place, strict=True)),
    }


def points_log(folder: Path, base_times: tuple[float, ...], base_frame: str = "world") -> Path:
    """A log with two topics of points, of which one has its own times and frame."""
    kind = "geometry_msgs/PointStamped"
    tip = [point(t, (t, 0, 1)) for t in (0.0, 0.25, 0.5, 0.75)]
    base = [point(t, (0, 2 * t, 0), base_frame) for t in base_times]
    return json_mcap(
        folder / "run.mcap", {"/mocap/tip/point": (kind, tip), "/mocap/base/point": (kind, base)}
    )


def test_points_of_several_topics_are_one_set_of_markers(tmp_path: Path) -> None:
    log = points_log(tmp_path, (0.0, 0.25, 0.75))
    address = f"{log}#/mocap/tip/point,/mocap/base/point"
    table = read_markers(address)
    assert table.names == ("tip", "base")
    np.testing.assert_allclose(table.t_s, [0.0, 0.25, 0.5, 0.75])
    np.testing.assert_allclose(table.positions_m[:, 0], [[t, 0, 1] for t in table.t_s])
    base = table.positions_m[:, 1]
    np.testing.assert_allclose(base[[0, 1, 3], 1], [0, 0.5, 1.5])
    # The median interval is 0.375 s: 0.5 s is no gap.
    np.testing.assert_allclose(base[2], [0, 1.0, 0])
    together = "run.mcap#/mocap/tip/point,/mocap/base/point"
    for topic in list_topics(log):
        assert topic.write[-1] == together
    assert run_command("log", log).out.count(together) == 1


def test_a_point_is_missing_where_its_topic_has_a_gap_or_has_ended(tmp_path: Path) -> None:
    log = points_log(tmp_path, (0.0, 0.01, 0.02, 0.6))
    table = read_markers(f"{log}#/mocap/tip/point,/mocap/base/point")
    is_missing = np.isnan(table.positions_m[:, 1, 0])
    assert is_missing.tolist() == [False, True, True, True]


@pytest.mark.parametrize(
    ("base_frame", "topics", "message"),
    [
        (
            "camera",
            "/mocap/tip/point,/mocap/base/point",
            "different frame_id (/mocap/tip/point: world; /mocap/base/point: camera)",
        ),
        ("world", "/mocap/tip/point,/mocap/bse/point", "there is no topic"),
    ],
)
def test_points_that_are_not_one_set_of_markers_are_refused(
    tmp_path: Path, base_frame: str, topics: str, message: str
) -> None:
    log = points_log(tmp_path, (0.0, 0.25), base_frame)
    with pytest.raises(InputError) as raised:
        read_markers(f"{log}#{topics}")
    assert message in str(raised.value)


RAYS = {
    "matrix": [[100, 0, 3], [0, 101, 2], [0, 0, 1]],
    "distortion": [0.1, -0.02, 1e-3, 2e-3, 0.003],
    "projection": [[90, 0, 3, 0], [0, 91, 2, 0], [0, 0, 1, 0]],
}


@pytest.mark.parametrize("kind", KINDS)
def test_depth_images_of_a_topic_come_with_their_camera_and_times(
    tmp_path: Path, kind: str
) -> None:
    of = Messages(kind)
    counts = np.arange(400, 435, dtype="<u2").reshape(5, 7)
    Image.fromarray(counts.astype(np.uint16)).save(tmp_path / "counts.png")
    squeezed = (tmp_path / "counts.png").read_bytes()
    raw, rectified = "/camera/depth/image_raw", "/camera/depth/image_rect_raw"
    messages = [of.camera(0.0, **RAYS, shape=(5, 7))]
    for t in (0.1, 0.2):
        metres = (counts * np.float32(1e-3) + np.float32(t)).astype("<f4")
        messages += [
            of.image(t, "16UC1", counts, raw),
            of.image(t, "32FC1", metres, rectified),
            of.packed(t, "16UC1; compressedDepth png", bytes(12) + squeezed, f"{raw}/packed"),
        ]
    log = bag(tmp_path / "trial", messages, kind)
    seen = read_depth(Path(f"{log}#{raw}"), None, 1.0)
    assert seen.t_s is not None
    np.testing.assert_allclose(seen.t_s, (0.1, 0.2), atol=1e-9)
    np.testing.assert_allclose(seen.images_m, [counts * 1e-3] * 2)
    np.testing.assert_array_equal(seen.matrix, RAYS["matrix"])
    np.testing.assert_array_equal(seen.distortion, RAYS["distortion"])
    straight = read_depth(Path(f"{log}#{rectified}"), None, 1.0)
    np.testing.assert_allclose(straight.images_m[1], counts * 1e-3 + 0.2, rtol=1e-6)
    np.testing.assert_array_equal(straight.matrix, np.array(RAYS["projection"])[:, :3])
    assert straight.distortion is not None
    assert not len(straight.distortion)
    packed = read_depth(Path(f"{log}#{raw}/packed"), 2e-3, 1.0)
    np.testing.assert_allclose(packed.images_m[0], counts * 2e-3)
    np.testing.assert_array_equal(packed.matrix, RAYS["matrix"])
    topics = {each.name: each for each in list_topics(log)}
    assert topics[raw].serves == "depth images, 7 x 5: [[experiment.depth]]"
    assert topics[raw].write == (f"{log.name}#{raw}",)
    assert topics["/camera/camera_info"].serves == (
        "calibration of a camera; its matrix is used for depth images in the same namespace"
    )


def test_clouds_of_a_topic_are_read_with_their_normals(tmp_path: Path) -> None:
    of, points = Messages(), np.arange(12.0).reshape(4, 3)
    columns = dict(zip("xyz", points.T, strict=True))
    turned = {f"normal_{axis}": np.full(4, float(axis == "z")) for axis in "xyz"}
    messages = [
        of.cloud(0.0, columns, "/plain"),
        of.cloud(0.0, columns | turned, "/turned"),
        of.pressure(0.0, 1.0),
    ]
    log = bag(tmp_path / "trial", messages)
    (plain,) = read_depth(Path(f"{log}#/plain"), None, 1e-3).clouds_m
    np.testing.assert_allclose(plain, 1e-3 * points)
    (normal,) = read_depth(Path(f"{log}#/turned"), None, 1.0).clouds_m
    np.testing.assert_allclose(normal, np.hstack([points, np.tile([0.0, 0, 1], (4, 1))]))
    with pytest.raises(
        InputError, match=r"/chamber has other messages; expected depth images \(16UC1"
    ):
        read_depth(Path(f"{log}#/chamber"), None, 1.0)
    with pytest.raises(
        InputError, match="contains clouds of points; expected a topic with numbers"
    ):
        read_poses(Path(f"{log}#/plain"))


def test_a_problem_states_depth_by_the_topic_of_a_log(tmp_path: Path) -> None:
    file = write_problem(tmp_path, {"swing": 12})
    of, flat = Messages(), np.full((120, 160), 400, dtype="<u2")
    square = [[100, 0, 80], [0, 100, 60], [0, 0, 1]]
    bent = [0.1, -0.02, 1e-3, 2e-3, 0.003]
    messages = [of.camera(0.0, square, bent)]
    messages += [of.image(t, "16UC1", flat, "/camera/depth") for t in (0.0, 0.02, 0.04, 9.0)]
    bag(tmp_path / "trial", messages)
    stated = '[[experiment.depth]]\nfile = "trial#/camera/depth"\nsigma_m = 0.001\n'
    file.write_text(f"{file.read_text()}\n{stated}")
    (depth,) = Problem.read(file).experiments[0].depths
    np.testing.assert_allclose(depth.t_s, (0.0, 0.02, 0.04), atol=1e-9)
    np.testing.assert_array_equal(depth.camera.matrix, square)
    np.testing.assert_array_equal(depth.camera.distortion, bent)
    np.testing.assert_allclose(depth.points_m[0][:, 2], 0.4)
    camera = "camera = { matrix = [[50, 0, 80], [0, 50, 60], [0, 0, 1]] }\n"
    bag(tmp_path / "halved", [of.camera(0.0, square, shape=(60, 80)), *messages[1:]])
    file.write_text(f"{file.read_text()}{camera}".replace("trial#", "halved#"))
    (depth,) = Problem.read(file).experiments[0].depths
    assert depth.camera.matrix[0, 0] == 50


PIXELS = np.full((4, 6), 400, dtype="<u2")


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/camera/depth/image_raw", False),
        ("/camera/direct/depth", False),
        ("/camera/depth/corrected", False),
        ("/camera/depth/image_rect_raw", True),
        ("/camera/depth/image_rectified", True),
        ("/camera/rect/depth", True),
    ],
)
def test_images_of_a_rectified_topic_are_rectified(
    tmp_path: Path, topic: str, rectified: bool
) -> None:
    of = Messages()
    camera = of.camera(0.0, **RAYS, shape=PIXELS.shape)
    log = bag(tmp_path / "trial", [camera, of.image(0.0, "16UC1", PIXELS, topic)])
    read = read_depth(Path(f"{log}#{topic}"), None, 1.0)
    assert read.matrix is not None
    assert read.matrix[0, 0] == (90 if rectified else 100)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (
            {"shape": (2, 3)},
            r"of 3 x 2 pixels, .* the images have 6 x 4 pixels; .* state camera.matrix",
        ),
        ({"shape": (4, 6), "binned": 2}, r"with binning \[2, 2\] .* state camera.matrix"),
        ({"shape": (4, 6), "corner": 8}, r"the offset \[8, 8\] .* state camera.matrix"),
        ({"shape": (4, 6), "distortion": np.ones(8)}, "8 coefficients; .* state camera.distortion"),
    ],
)
def test_a_camera_of_other_images_is_refused_where_its_numbers_are_not_stated(
    tmp_path: Path, camera: dict, message: str
) -> None:
    of = Messages()
    image = of.image(0.0, "16UC1", PIXELS, "/camera/depth")
    log = bag(tmp_path / "trial", [of.camera(0.0, **RAYS | camera), image])
    with pytest.raises(InputError, match=f"trial#/camera/camera_info: .*{message}"):
        read_depth(Path(f"{log}#/camera/depth"), None, 1.0)
    stated = read_depth(Path(f"{log}#/camera/depth"), None, 1.0, {"matrix", "distortion"})
    assert stated.matrix is stated.distortion is None
    np.testing.assert_allclose(stated.images_m[0], 0.4)


def bad_messages(of: Messages) -> dict[str, tuple]:
    """By what is bad of each."""
    image, cloud = (
        of.image(0.0, "16UC1", PIXELS, ""),
        of.cloud(0.0, {"x": [1], "y": [1], "z": [1]}, ""),
    )
    unknown = [replace(each, datatype=11) for each in cloud[3].fields]
    beyond = [replace(each, offset=14) for each in cloud[3].fields]
    return {
        "short": (*image[:3], replace(image[3], data=image[3].data[:-3])),
        "rvl": of.packed(0.0, "16UC1; compressedDepth rvl", bytes(40), ""),
        "flat": of.cloud(0.0, {"u": [1], "v": [1]}, ""),
        "unknown": (*cloud[:3], replace(cloud[3], fields=unknown)),
        "beyond": (*cloud[:3], replace(cloud[3], fields=beyond)),
    }


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ("short", "message has 61 bytes; expected 4 rows of 6 times 2"),
        ("rvl", "'16UC1; compressedDepth rvl' that is not a PNG .*: use the topic of uncompressed"),
        ("flat", "has the columns u, v, rgb; expected x, y and z among them"),
        (
            "unknown",
            "has the fields x of type 11, .*; expected each name once, of the types 1 to 8",
        ),
        (
            "beyond",
            "in points of 16 bytes; expected each name once, of the types 1 to 8 .*within these",
        ),
    ],
)
def test_messages_that_are_not_as_expected_are_refused_with_their_log_and_topic(
    tmp_path: Path, bad: str, message: str
) -> None:
    t, _, name, content = bad_messages(Messages())[bad]
    log = bag(tmp_path / "trial", [(t, "/bad", name, content)])
    with pytest.raises(InputError, match=f"trial#/bad: .*{message}"):
        _ = read_depth(Path(f"{log}#/bad"), None, 1.0).images_m[0]


def test_a_camera_without_lens_model_is_refused(tmp_path: Path) -> None:
    camera = {"K": np.eye(3).ravel().tolist(), "P": [0.0] * 12, "height": 1, "width": 2}
    image = {"encoding": "16UC1", "height": 1, "width": 2, "step": 4, "data": "kAGQAQ=="}
    topics = {
        "/camera_info": ("foxglove.CameraCalibration", [(0.0, camera)]),
        "/depth": ("foxglove.RawImage", [(0.0, image)]),
    }
    log = json_mcap(tmp_path / "trial.mcap", topics)
    read = read_depth(Path(f"{log}#/depth"), None, 1.0)
    np.testing.assert_allclose(read.images_m[0], [[0.4, 0.4]])
    assert read.matrix is None
    told = {each.name: each.serves for each in list_topics(log)}
    assert "camera" not in told["/camera_info"]


def test_the_first_of_several_messages_of_one_time_counts(tmp_path: Path) -> None:
    of = Messages()
    images = [of.image(0.0, "16UC1", each * PIXELS, "/depth") for each in np.array([1, 2], "<u2")]
    log = bag(tmp_path / "trial", images)
    (image,) = read_depth(Path(f"{log}#/depth"), None, 1.0).images_m
    np.testing.assert_allclose(image, 0.4)
    times = (0.0, 0.0, 1.0)
    moves = [of.transform(t, "base", "tool", (k, 0, 0), STILL) for k, t in enumerate(times)]
    log = bag(tmp_path / "moved", [of.tree(t, m) for t, m in zip(times, moves, strict=True)])
    np.testing.assert_allclose(read_poses(Path(f"{log}#/tf")).positions_m[:, 0], (0, 2))


@pytest.mark.parametrize(
    ("address", "message"),
    [
        (
            "trial#/wrenhc",
            "there is no topic '/wrenhc'; expected one of the topics of the log: /tf, /wrench; did you mean",
        ),
        ("trial#/tf", "has the frames base, arm, tool; expected two of them, as in trial#/tf#base"),
        (
            "trial#/tf#base>tol",
            "there is no frame 'tol'; expected one of base, arm, tool; did you mean",
        ),
        ("trial#/tf#base>tool#fast", "found 'fast' after the topic; expected two frames"),
        ("trial#/wrench", "expected t_s, x_m, y_m"),
        ("broken.mcap#/tf", "is damaged, or a file of another type"),
        ("notes#/tf", "is not a log; expected a ROS bag"),
    ],
)
def test_missing_topics_of_a_log_are_refused(tmp_path: Path, address: str, message: str) -> None:
    of = Messages()
    arm = of.transform(0.0, "base", "arm", (0, 0, 0), STILL)
    tool = of.transform(0.0, "arm", "tool", (0, 0, 0), STILL)
    bag(tmp_path / "trial", [of.tree(0.0, arm, tool), of.wrench(0.0, np.ones(6))])
    (tmp_path / "broken.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(50))
    (tmp_path / "notes").mkdir()
    with pytest.raises(InputError) as raised:
        read_poses(tmp_path / address)
    assert message in str(raised.value)
    assert str(tmp_path / address.partition("#")[0]) in str(raised.value)


def test_joints_beyond_their_limits_are_refused(tmp_path: Path) -> None:
    of = Messages()
    log = bag(tmp_path / "trial", [of.joints(t, {"turn": 30.0, "slide": 0.1}) for t in T_S])
    (tmp_path / "arm.urdf").write_text(URDF)
    with pytest.raises(InputError, match=r"turn is at 30, outside its limits -1.5 to 1.5 .*#deg"):
        read_poses(f"{log}#/joint_states#arm.urdf#base>tool")


ENTITIES = "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 10))


@pytest.mark.parametrize(
    "doctype",
    [f'<!DOCTYPE x [<!ENTITY a0 "words">{ENTITIES}]>',
     '<!DOCTYPE x [<!ENTITY a9 SYSTEM "file:///etc/passwd">]>'],
    ids=["expanding", "external"],
)  # fmt: skip
def test_entities_of_a_robots_description_are_not_expanded(tmp_path: Path, doctype: str) -> None:
    log = bag(tmp_path / "trial", [Messages().joints(t, {"turn": t}) for t in T_S])
    urdf = f'{doctype}<robot name="arm"><link name="&a9;"/><link name="base"/></robot>'
    (tmp_path / "arm.urdf").write_text(urdf)
    with pytest.raises(InputError) as refused:
        read_poses(f"{log}#/joint_states#arm.urdf#base>tool")
    assert "root:" not in str(refused.value)
    assert "wordswords" not in str(refused.value)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes by name here")
def test_a_pipe_as_a_robots_description_is_refused(tmp_path: Path) -> None:
    log = bag(tmp_path / "trial", [Messages().joints(t, {"turn": t}) for t in T_S])
    os.mkfifo(tmp_path / "arm.urdf")
    with pytest.raises(InputError, match="is a pipe; expected a regular file"):
        read_poses(f"{log}#/joint_states#arm.urdf#base>tool")


def test_a_file_whose_name_has_a_mark_is_a_file(tmp_path: Path) -> None:
    file = tmp_path / "run#1.csv"
    file.write_text("t_s,x_m,y_m,z_m,qx,qy,qz,qw\n0,0,0,0,0,0,0,1\n1,0,0,1,0,0,0,1\n")
    assert read_poses(file).positions_m[1, 2] == 1
    assert stored_files(file) == [file]


def test_unconnected_frames_are_refused(tmp_path: Path) -> None:
    of = Messages()
    trees = [
        of.tree(
            t,
            of.transform(t, "a", "b", (0, 0, t), STILL),
            of.transform(t, "c", "d", (0, 0, 0), STILL),
        )
        for t in T_S
    ]
    log = bag(tmp_path / "trial", trees)
    with pytest.raises(InputError, match="no chain of frames leads from a to d"):
        read_poses(f"{log}#/tf#a>d")
    assert [each.name for each in list_topics(log)] == ["/tf"]


def test_the_node_of_the_pages_makes_frames_that_live_reads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its subscriptions get messages as ROS would hand them over."""
    page = (Path(__file__).parents[2] / "docs" / "howto" / "live.md").read_text()
    code = page.partition("```python ros\n")[2].partition("```")[0]
    called: dict[str, Callable] = {}
    subscribe = lambda _, topic, call, __: called.update({topic: call})  # noqa: E731
    node = SimpleNamespace(create_subscription=subscribe)
    ros = SimpleNamespace(init=lambda: None, create_node=lambda _: node, spin=lambda _: None)
    kinds = SimpleNamespace(PoseStamped=None, Markers=None)
    modules = {"rclpy": ros, "geometry_msgs.msg": kinds, "mocap4r2_msgs.msg": kinds}
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    with socket.socket(type=socket.SOCK_DGRAM) as listening:
        listening.bind(("127.0.0.1", 0))
        exec(code.replace("9870", str(listening.getsockname()[1])), {})
        of = Messages()
        called["/gripper"](of.pose(0.5, (0, 0, 1), about_z(0.3))[-1])
        called["/markers"](of.markers(0.5, {"tip": (1, 2, 3)})[-1])
        (hung,) = swing().experiments
        names = ("low", "tip", *hung.markers.names[2:])
        seen = replace(hung, markers=replace(hung.markers, names=names))
        frame = FrameReader(seen, swing()).read(listening.recv(10_000))
    assert frame is not None
    assert frame.t_s == pytest.approx(START_S + 0.5)
    np.testing.assert_allclose(frame.poses[1][:3, 3], (0, 0, 1), atol=1e-12)
    np.testing.assert_allclose(frame.tracks_m[:2], [[np.nan] * 3, [1, 2, 3]])


def test_what_libraries_print_about_a_damaged_definition_is_not_shown(tmp_path: Path) -> None:
    write_problem(tmp_path, {"swing": 12})
    poses = read_poses(tmp_path / "swing_motion.csv")
    table = read_markers(tmp_path / "swing_markers.csv")
    log = bag(tmp_path / "trial", recorded(poses, table, "mcap file"), "mcap file")
    log.write_bytes(log.read_bytes().replace(b"MSG: std_msgs/Header", b"\0" * 20))
    ended = run_command("log", log)
    assert (ended.code, ended.out) == (2, "")
    assert "the log is damaged" in ended.err
    assert len(ended.err.splitlines()) == 1


@pytest.mark.parametrize(("count", "stamp_s"), [(40, 5.0), (3, 2.5), (12, 0.25)])
def test_stamps_that_do_not_advance_are_refused(tmp_path: Path, count: int, stamp_s: float) -> None:
    of = Messages()
    frozen = [(t, *of.pose(stamp_s, (0, 0, t), STILL)[1:]) for t in T_S[:count]]
    log = bag(tmp_path / "trial", frozen)
    message = f"all {count} messages of the topic /gripper have the same stamp, but"
    with pytest.raises(InputError, match=message):
        read_poses(f"{log}#/gripper")
    unset = [(t, *of.pose(-START_S, (0, 0, t), STILL)[1:]) for t in T_S[:count]]
    poses = read_poses(f"{bag(tmp_path / 'unset', unset)}#/gripper")
    np.testing.assert_allclose(poses.t_s, T_S[:count], atol=1e-9)
