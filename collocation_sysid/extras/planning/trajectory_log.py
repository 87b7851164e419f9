"""A plan as messages of ROS 2 in an MCAP file: a trajectory for a controller, poses, tensions and
pressures.
"""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ...common.array_types import Array
from ...recording.sources.logs import require_packages
from .hand_motion import angular_motion
from .motion_plan import MotionPlan

TRAJECTORY_TOPIC, POSE_TOPIC, COMMAND_TOPIC = "/hand_trajectory", "/hand_pose", "/command_{}"
FRAME, JOINT = "world", "hand"


def require_trajectory_packages() -> None:
    """Raise an `InputError` with installation instructions if a package is missing that writes a
    trajectory.
    """
    require_packages("rosbags", "mcap")


def write_trajectory_mcap(plan: MotionPlan, path: str | Path, t_s: Array) -> None:
    """Write a file with one trajectory_msgs/MultiDOFJointTrajectory on /hand_trajectory, at time 0,
    and at each of the times (P,) since the start [s] a geometry_msgs/PoseStamped on /hand_pose and
    on /command_<name> a std_msgs/Float64 of each planned tendon [N], and a sensor_msgs/FluidPressure
    of each planned pressure [Pa].

    Poses, velocities and accelerations are those of the frame whose poses poses.csv has, in axes of
    the frame of the poses.

    Raises
    ------
    InputError
        If the package rosbags is not installed.
    """
    require_trajectory_packages()
    from rosbags.rosbag2 import Writer
    from rosbags.rosbag2.enums import StoragePlugin
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)

    def made(name: str, *values: Any) -> Any:
        return store.types[name](*values)

    def vector(values: Array, name: str = "Vector3") -> Any:
        return made(f"geometry_msgs/msg/{name}", *map(float, values))

    def header(time_s: float) -> Any:
        stamp = made("builtin_interfaces/msg/Time", *divmod(round(1e9 * time_s), 10**9))
        return made("std_msgs/msg/Header", stamp, FRAME)

    poses = plan.poses(t_s)
    rows = zip(t_s, poses.positions_m, poses.quaternions_xyzw, *frame_rates(plan, t_s), strict=True)
    stamped, points = [], []
    for time_s, place, xyzw, velocity, spin, acceleration, spin_rate in rows:
        turned = made("geometry_msgs/msg/Quaternion", *map(float, xyzw))
        pose = made("geometry_msgs/msg/Pose", vector(place, "Point"), turned)
        stamped.append(made("geometry_msgs/msg/PoseStamped", header(time_s), pose))
        points.append(
            made(
                "trajectory_msgs/msg/MultiDOFJointTrajectoryPoint",
                [made("geometry_msgs/msg/Transform", vector(place), turned)],
                [made("geometry_msgs/msg/Twist", vector(velocity), vector(spin))],
                [made("geometry_msgs/msg/Twist", vector(acceleration), vector(spin_rate))],
                made("builtin_interfaces/msg/Duration", *divmod(round(1e9 * time_s), 10**9)),
            )
        )
    kind, pose_kind = "trajectory_msgs/msg/MultiDOFJointTrajectory", "geometry_msgs/msg/PoseStamped"
    tension_kind, pressure_kind = "std_msgs/msg/Float64", "sensor_msgs/msg/FluidPressure"
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            trajectory = writer.add_connection(TRAJECTORY_TOPIC, kind, typestore=store)
            message = made(kind, header(0.0), [JOINT], points)
            writer.write(trajectory, 0, store.serialize_cdr(message, kind))
            connection = writer.add_connection(POSE_TOPIC, pose_kind, typestore=store)
            for time_s, each in zip(t_s, stamped, strict=True):
                writer.write(connection, round(1e9 * time_s), store.serialize_cdr(each, pose_kind))
            for each, values in zip(plan.program.signals, plan.commands(t_s).values(), strict=True):
                topic = COMMAND_TOPIC.format(re.sub(r"\W", "_", each.name, flags=re.ASCII))
                is_tension = each.unit == "N"
                name = tension_kind if is_tension else pressure_kind
                connection = writer.add_connection(topic, name, typestore=store)
                for time_s, value in zip(t_s, values.tolist(), strict=True):
                    content = (value,) if is_tension else (header(time_s), value, 0.0)
                    message = store.serialize_cdr(made(name, *content), name)
                    writer.write(connection, round(1e9 * time_s), message)
        (found,) = bag.glob("*.mcap")
        Path(path).write_bytes(found.read_bytes())


def frame_rates(plan: MotionPlan, t_s: Array) -> tuple[Array, Array, Array, Array]:
    """Return velocity, angular velocity, acceleration and angular acceleration, each (P, 3), of the
    frame of `MotionPlan.poses` at times since the start [s], in axes of the frame of the poses.
    """
    value, rate, growth = plan.motion.derivatives(t_s)
    spin, spin_rate = angular_motion(value[:, 3:], rate[:, 3:], curvature=growth[:, 3:])
    hand_m = value[:, :3] + plan.program.frame.position_m
    arm = plan.poses(t_s).positions_m - hand_m
    velocity = rate[:, :3] + np.cross(spin, arm)
    acceleration = growth[:, :3] + np.cross(spin_rate, arm) + np.cross(spin, np.cross(spin, arm))
    return velocity, spin, acceleration, spin_rate
