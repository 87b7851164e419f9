"""The tiny problem of `problem_files` as a robot's log: poses through /tf, cameras tilted."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from collocation_sysid.recording import read_markers, read_poses

from .logs import Message, Messages, bag
from .problem_files import write_problem

# Frame of the cameras in that of the robot's base: tilted by 4 degrees about x, then turned.
CAMERAS_M = np.array([0.4, -0.3, 0.05])
CAMERAS = Rotation.from_euler("xz", [4.0, 60.0], degrees=True)
# Frames of the gripper and of the sensor in that of the flange.
GRIPPER_M = np.array([0.0, 0.0, 0.12])
SENSOR_M = np.array([0.0, 0.01, 0.02])
SENSOR = Rotation.from_euler("zx", [45.0, 180.0], degrees=True)
STILL = (0.0, 0.0, 0.0, 1.0)
POSES = "trial#/tf#mocap>gripper"


def robot_problem(
    folder: Path,
    markers_frame: str = "mocap",
    base: str = "base_link",
    wrenches: np.ndarray | None = None,
    sensor: str = "sensor",
) -> Path:
    """Write the tiny problem with poses and markers from a log, and return its path.

    Wrenches (N, 6) at the times of the markers, in the sensor's axes and about its origin, are
    written to the topic /wrench; its messages name the frame `sensor`.
    """
    file = write_problem(folder, {"swing": 12})
    bag(
        folder / "trial",
        _messages(folder, markers_frame, base=base, wrenches=wrenches, sensor=sensor),
    )
    text = file.read_text()
    text = text.replace("swing_motion.csv", POSES)
    file.write_text(text.replace("swing_markers.csv", "trial#/markers"))
    return file


def _messages(
    folder: Path, markers_frame: str, base: str, wrenches: np.ndarray | None, sensor: str
) -> Iterator[Message]:
    of = Messages()
    yield of.tree(
        0.0,
        of.transform(0.0, base, "mocap", CAMERAS_M, CAMERAS.as_quat()),
        of.transform(0.0, "tool0", "gripper", GRIPPER_M, STILL),
        of.transform(0.0, "tool0", "sensor", SENSOR_M, SENSOR.as_quat()),
        topic="/tf_static",
    )
    poses = read_poses(folder / "swing_motion.csv")
    table = read_markers(folder / "swing_markers.csv")
    for k, t in enumerate(poses.t_s):
        rotation = CAMERAS * Rotation.from_quat(poses.quaternions_xyzw[k])
        position = CAMERAS_M + CAMERAS.apply(poses.positions_m[k].copy())
        position = position - rotation.apply(GRIPPER_M)
        yield of.tree(t, of.transform(t, base, "tool0", position, rotation.as_quat()))
    for k, t in enumerate(table.t_s):
        places = dict(zip(table.names, table.positions_m[k], strict=True))
        at, topic, kind, message = of.markers(t, places)
        message.header.frame_id = markers_frame
        yield at, topic, kind, message
        if wrenches is not None:
            at, topic, kind, message = of.wrench(t, wrenches[k])
            message.header.frame_id = sensor
            yield at, topic, kind, message
