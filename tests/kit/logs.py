"""Robot logs of a motion, as written by the tools of ROS 2, MCAP and LeRobot."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2
from rosbags.rosbag2.enums import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from collocation_sysid.recording import MarkerTable, PoseSequence

HZ = 30.0  # of a dataset
START_S = 1_700_000_000.0
ROS2, ROS1 = (get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC))
MOCAP = {
    "Marker": "int8 id_type\nint32 marker_index\nstring marker_name\n"
    "geometry_msgs/Point translation\n",
    "Markers": "std_msgs/Header header\nuint32 frame_number\nmocap4r2_msgs/Marker[] markers\n",
}
for store in (ROS1, ROS2):
    for name, definition in MOCAP.items():
        store.register(get_types_from_msg(definition, f"mocap4r2_msgs/msg/{name}"))
TREE = get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage")
ROS1.register(TREE)
KINDS = ("sqlite3", "mcap", "mcap file", "ros1")

Message = tuple[float, str, str, Any]  # time, topic, type, message

# A turning and a sliding joint.
URDF = """<robot name="arm">
<link name="base"/><link name="upper"/><link name="tool"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="upper"/>
<origin xyz="0 0 0.5"/><axis xyz="0 0 1"/><limit lower="-1.5" upper="1.5"/></joint>
<joint name="slide" type="prismatic"><parent link="upper"/><child link="tool"/>
<origin xyz="0.2 0 0"/><axis xyz="1 0 0"/><limit lower="0" upper="0.5"/></joint>
</robot>"""


def bag(path: Path, messages: Iterable[Message], kind: str = "sqlite3") -> Path:
    """A bag of messages of ROS 2, or of ROS 1; of an MCAP file without its folder."""
    if kind == "ros1":
        return _bag1(path.with_suffix(".bag"), messages)
    plugin = StoragePlugin.SQLITE3 if kind == "sqlite3" else StoragePlugin.MCAP
    with Writer2(path, version=9, storage_plugin=plugin) as writer:
        known: dict[str, Any] = {}
        for t, topic, name, message in messages:
            if topic not in known:
                known[topic] = writer.add_connection(topic, name, typestore=ROS2)
            writer.write(known[topic], _ns(t), ROS2.serialize_cdr(message, name))
    return next(path.glob("*.mcap")) if kind == "mcap file" else path


def _bag1(path: Path, messages: Iterable[Message]) -> Path:
    with Writer1(path) as writer:
        known: dict[str, Any] = {}
        for t, topic, name, message in messages:
            if topic not in known:
                known[topic] = writer.add_connection(topic, name, typestore=ROS1)
            writer.write(known[topic], _ns(t), ROS1.serialize_ros1(message, name))
    return path


def _ns(t_s: float) -> int:
    return int(START_S) * 10**9 + round(t_s * 1e9)


class Messages:
    """Makers of messages, of ROS 2 or ROS 1."""

    def __init__(self, kind: str = "sqlite3") -> None:
        self.one = kind == "ros1"
        self._types = (ROS1 if self.one else ROS2).types

    def made(self, name: str, *values: Any) -> Any:
        return self._types[name](*values)

    def header(self, t_s: float, frame: str) -> Any:
        stamp = self.made("builtin_interfaces/msg/Time", *divmod(_ns(t_s), 10**9))
        sequence = (0,) if self.one else ()
        return self.made("std_msgs/msg/Header", *sequence, stamp, frame)

    def vector(self, values: Iterable[float], name: str = "Vector3") -> Any:
        return self.made(f"geometry_msgs/msg/{name}", *map(float, values))

    def turned(self, xyzw: Iterable[float]) -> Any:
        return self.made("geometry_msgs/msg/Quaternion", *map(float, xyzw))

    def transform(self, t_s: float, parent: str, child: str, at: Any, xyzw: Any) -> Any:
        moved = self.made("geometry_msgs/msg/Transform", self.vector(at), self.turned(xyzw))
        name = "geometry_msgs/msg/TransformStamped"
        return self.made(name, self.header(t_s, parent), child, moved)

    def tree(self, t_s: float, *transforms: Any, topic: str = "/tf") -> Message:
        name = "tf2_msgs/msg/TFMessage"
        return t_s, topic, name, self.made(name, [*transforms])

    def pose(self, t_s: float, at: Any, xyzw: Any) -> Message:
        name = "geometry_msgs/msg/PoseStamped"
        pose = self.made("geometry_msgs/msg/Pose", self.vector(at, "Point"), self.turned(xyzw))
        return (t_s, "/gripper", name, self.made(name, self.header(t_s, "world"), pose))

    def wrench(self, t_s: float, values: Any) -> Message:
        name = "geometry_msgs/msg/WrenchStamped"
        both = self.made(
            "geometry_msgs/msg/Wrench", self.vector(values[:3]), self.vector(values[3:])
        )
        return (t_s, "/wrench", name, self.made(name, self.header(t_s, "tool"), both))

    def joints(self, t_s: float, positions: dict[str, float]) -> Message:
        name = "sensor_msgs/msg/JointState"
        values = np.array([*positions.values()], dtype=float)
        none = np.zeros(0)
        state = self.made(name, self.header(t_s, ""), [*positions], values, none, none)
        return t_s, "/joint_states", name, state

    def markers(self, t_s: float, places: dict[str, Any]) -> Message:
        name = "mocap4r2_msgs/msg/Markers"
        items = [
            self.made("mocap4r2_msgs/msg/Marker", 0, k, label, self.vector(place, "Point"))
            for k, (label, place) in enumerate(places.items())
        ]
        return (t_s, "/markers", name, self.made(name, self.header(t_s, "world"), 0, items))

    def image(self, t_s: float, encoding: str, pixels: np.ndarray, topic: str) -> Message:
        name, fill = "sensor_msgs/msg/Image", 4  # bytes at the end of each row
        rows = pixels.view("u1").reshape(len(pixels), -1)
        data = np.pad(rows, ((0, 0), (0, fill))).ravel()
        sizes = *pixels.shape, encoding, 0, rows.shape[1] + fill
        return (t_s, topic, name, self.made(name, self.header(t_s, "camera"), *sizes, data))

    def packed(self, t_s: float, form: str, data: bytes, topic: str) -> Message:
        name = "sensor_msgs/msg/CompressedImage"
        content = np.frombuffer(data, "u1")
        return (t_s, topic, name, self.made(name, self.header(t_s, "camera"), form, content))

    def camera(
        self,
        t_s: float,
        matrix: Any,
        distortion: Any = (),
        projection: Any = (0.0,) * 12,
        shape: tuple[int, int] = (120, 160),
        binned: int = 0,
        corner: int = 0,
    ) -> Message:
        name = "sensor_msgs/msg/CameraInfo"
        numbers = (np.asarray(each, dtype=float).ravel() for each in (distortion, matrix))
        whole = np.asarray(projection, dtype=float).ravel()
        area = self.made("sensor_msgs/msg/RegionOfInterest", corner, corner, 0, 0, False)
        told = ("plumb_bob", *numbers, np.eye(3).ravel(), whole, binned, binned, area)
        info = self.made(name, self.header(t_s, "camera"), *shape, *told)
        return t_s, "/camera/camera_info", name, info

    def cloud(self, t_s: float, columns: Mapping[str, Any], topic: str) -> Message:
        name, count = ("sensor_msgs/msg/PointCloud2", len(next(iter(columns.values()))))
        form = np.dtype([(each, "<f4") for each in (*columns, "rgb")])
        rows = np.zeros(count, form)
        for each, values in columns.items():
            rows[each] = values
        fields = [
            self.made("sensor_msgs/msg/PointField", each, 4 * k, 7, 1)
            for k, each in enumerate(form.names or ())
        ]
        data, size = np.frombuffer(rows.tobytes(), "u1"), form.itemsize
        told = 1, count, fields, False, size, size * count, data, True
        return (t_s, topic, name, self.made(name, self.header(t_s, "camera"), *told))

    def pressure(self, t_s: float, value_pa: float) -> Message:
        name = "sensor_msgs/msg/FluidPressure"
        return (t_s, "/chamber", name, self.made(name, self.header(t_s, ""), value_pa, 0.0))


def recorded(poses: PoseSequence, table: MarkerTable, kind: str) -> Iterator[Message]:
    """Messages of a gripper's poses and of tracks, those of missing samples left out."""
    of = Messages(kind)
    for k, t in enumerate(poses.t_s):
        yield of.pose(t, poses.positions_m[k], poses.quaternions_xyzw[k])
    for k, t in enumerate(table.t_s):
        seen = {
            name: place
            for name, place in zip(table.names, table.positions_m[k], strict=True)
            if np.isfinite(place).all()
        }
        yield of.markers(t, seen)


def json_mcap(path: Path, topics: dict[str, tuple[str, list[tuple[float, dict]]]]) -> Path:
    """An MCAP file of JSON messages: schema, and messages by time, by topic."""
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        for topic, (schema, messages) in topics.items():
            form = writer.register_schema(schema, "jsonschema", b"{}")
            channel = writer.register_channel(topic, "json", form)
            for t, message in messages:
                data = json.dumps(message).encode()
                writer.add_message(channel, _ns(t), data, _ns(t))
        writer.finish()
    return path


def dataset(folder: Path, joints: dict[str, list[float]], episodes: int = 2) -> Path:
    """A LeRobot dataset; the joints of a later episode are moved by 0.01 times its number."""
    names, count = [*joints], len(next(iter(joints.values())))
    (folder / "meta").mkdir(parents=True)
    state = {"dtype": "float32", "shape": [len(names)], "names": names}
    features = {
        "observation.state": state,
        "observation.images.top": {"dtype": "video", "shape": [2, 2, 3], "names": None},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        "episode_index": {"dtype": "int64", "shape": [1], "names": None},
    }
    told = {"codebase_version": "v3.0", "total_episodes": episodes, "fps": HZ}
    info = told | {"total_frames": episodes * count, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    values = np.array([*joints.values()]).T
    columns = {
        "observation.state": [row.tolist() for k in range(episodes) for row in values + 0.01 * k],
        "timestamp": np.tile(np.arange(count) / HZ, episodes),
        "episode_index": np.repeat(np.arange(episodes), count),
    }
    file = folder / "data" / "chunk-000" / "file-000.parquet"
    file.parent.mkdir(parents=True)
    pq.write_table(pa.table(columns), file)
    return folder
