"""Nuisance parameters: unknowns of a single recording, which are estimated with a prior.

`KINDS` declares each kind: limits, tables and texts follow from it. `Nuisance` has a field for
each kind, and [experiment.nuisance] of the problem file a key.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from ..common.field_descriptions import FieldOfRow, sentence, with_fields
from ..common.validated_classes import validate_as, validated
from ..common.validated_types import Finite
from ..errors import InputError, listed
from .deviation import Deviation, RecordingQuantities

DEGREE = float(np.pi / 180)
# Reach of parameters on which predictions depend linearly, which need no trust region [σ].
UNLIMITED_REACH = 1e3
# Mesh edges that a marker's place may move in a step of the solver: it stays near its element.
EDGES_A_STEP = 2.0
# Samples that the time of a load may move in a step of the solver: the motion is smooth over these.
SAMPLES_A_STEP = 2.0
# Shift of a depth camera in a step of the solver [m]: correspondences stay about the same.
CAMERA_SHIFT_A_STEP_M = 0.02
FILM_A_RULER = "film a ruler where the body moves"
CALIBRATE_A_POSE = "film a calibration board whose pose in the frame of the gripper is known"
# Reach of errors of ordinary cameras [σ]: larger steps save a quarter of the iterations.
IMAGE_REACH = 3.0
# Scope of parameters that recordings share, as a pattern and in words for messages.
SCOPE = r"shared( \S+)?"
SCOPE_TEXT = '"shared", or "shared" followed by the name of a group of recordings'


def cayley_rotation(rotation_vector: ca.SX) -> ca.SX:
    """Return the rotation matrix (3, 3) with the Cayley parameters `rotation_vector` / 2, a
    rational function.

    Its angle is that of the rotation vector (3,) [rad] up to third order.
    """
    half = ca.skew(rotation_vector / 2)
    return ca.SX.eye(3) + 2 / (1 + ca.sumsqr(rotation_vector) / 4) * (half + half @ half)


def _rotate_position(y: ca.SX, values: ca.SX, t_s: ca.SX, data: RecordingQuantities) -> ca.SX:
    """Rotate a predicted position (3,) by a rotation vector about the pivot of `data`."""
    pivot = ca.DM(data.pivot_m)
    return cayley_rotation(values) @ (y - pivot) + pivot


def _shift_position(y: ca.SX, values: ca.SX, t_s: ca.SX, data: RecordingQuantities) -> ca.SX:
    return y + values


def _distort_position(y: ca.SX, values: ca.SX, t_s: ca.SX, data: RecordingQuantities) -> ca.SX:
    """Add radial distortion of first order [1/m²] about the pivot of `data`."""
    away = y - ca.DM(data.pivot_m)
    return y + values * ca.sumsqr(away) * away


def _has_markers(experiment: Any) -> bool:
    """Return whether the experiment has a marker, also one without samples."""
    return bool(experiment.markers.names)


def _has_tilt(experiment: Any, index: int) -> bool:
    """Return whether the obstacle at this index of the grasps has a direction that may be tilted."""
    return experiment.grasps[index].shape.has_tilt


def _has_camera_matrix(experiment: Any, index: int) -> bool:
    """Return whether a depth camera has images with a camera matrix, not clouds of points alone."""
    return experiment.depths[index].camera.matrix is not None


def _has_images(experiment: Any, index: int) -> bool:
    """Return whether a depth camera has images, not clouds of points alone."""
    return bool(len(experiment.depths[index].images_m))


def _has_depth_cameras(experiment: Any) -> bool:
    return bool(experiment.depths)


def _has_depth_outlines(experiment: Any) -> bool:
    return any(len(depth.images_m) for depth in experiment.depths)


def _camera_sharing_key(experiment: Any) -> dict[str, object]:
    """Return what must agree where cameras are shared: body and stated poses."""
    places = [tuple(d.camera.pose.ravel()) for d in experiment.depths]
    return {"body": id(experiment.body), "pose of its depth cameras": places}


def _has_image_cameras(experiment: Any) -> bool:
    return any(each.counts_pixels for each in experiment.readings)


def _is_filmed_motion(experiment: Any) -> bool:
    return _is_motion(experiment) and _has_image_cameras(experiment)


def _is_motion(experiment: Any) -> bool:
    return not experiment.is_static


def _has_observable_hand_eye(experiment: Any) -> bool:
    """True with markers, a grasp that is not an obstacle, and a start in equilibrium."""
    return (
        bool(experiment.body_grasps)
        and _has_markers(experiment)
        and experiment.is_balanced_at_start
    )


def _moves_at_start(experiment: Any) -> bool:
    return experiment.start == "moving"


def _has_turned_clamps(experiment: Any) -> bool:
    """Return whether several rigid grasps hold all axes, or another prior than the default is stated:
    by default the turn of a single one is `GRASP_TURN`.
    """
    grasps = [grasp for grasp in experiment.body_grasps if grasp.poses.deformation is None]
    several = sum(len(grasp.axes) == 3 for grasp in grasps) > 1
    return several or experiment.nuisance.sigma(CLAMP_TURN) != CLAMP_TURN.sigma


def _largest_place_step_m(experiment: Any) -> float:
    return EDGES_A_STEP * float(experiment.body.mesh.quality().edge_mean_m)


def _hand_eye_sharing_key(experiment: Any) -> dict[str, object]:
    """Return what must agree where the hand–eye transform is shared: body, grasped nodes."""
    nodes = {int(node) for grasp in experiment.body_grasps for node in grasp.nodes}
    return {"body": id(experiment.body), "set of nodes in its grasps": nodes}


PLACE = Deviation(
    "marker_offset_m",
    "m",
    sigma=1e-3,
    key="marker_offsets",
    of="place",
    axes="x y z",
    changes=(),
    reach=UNLIMITED_REACH,
    step=_largest_place_step_m,
    largest=0.03,
    label="place of {which}, {axis}",
    description="errors of the positions in reference_m without a reference_sigma_m; they rotate "
    "with the body",
    same=lambda e: {
        "body": id(e.body),
        "value of places (on_surface in Python)": e.markers.on_surface,
    },
)
OFFSET = Deviation(
    "camera_offset_m",
    "m",
    sigma=None,
    key="camera_offsets",
    of="marker",
    axes="x y z",
    reach=UNLIMITED_REACH,
    by="length",
    label="camera offset of {which}, {axis}",
    sentence="camera offset of markers: up to {size}",
    description="a constant offset of each marker in the cameras' frame",
    reading=_shift_position,
)
CALIBRATION_SCALE = Deviation(
    "calibration_scale",
    "1",
    sigma=None,
    key="calibration_scale",
    considered=2e-3,
    remedy=FILM_A_RULER,
    label="scale of the cameras",
    sentence="scale error of the cameras: {signed}",
    description="scale error of all lengths that the cameras measure: the factor minus one",
    applies=_has_markers,
    reading=lambda y, values, t_s, data: y + values * (y - ca.DM(data.pivot_m)),
)
CALIBRATION_DISTORTION = Deviation(
    "calibration_distortion_1_m2",
    "1/m²",
    sigma=None,
    key="calibration_distortion",
    considered=0.02,
    remedy=FILM_A_RULER,
    applies=_has_markers,
    label="distortion of the cameras",
    sentence="distortion of the cameras: {signed}",
    description="coefficient k of a radial distortion by the cameras: distances r from the "
    "middle of the body are multiplied by 1 + k r²",
    reading=_distort_position,
)
TIME = Deviation(
    "time_shift_s",
    "s",
    sigma=5e-3,
    key="time_shift",
    changes=("clock",),
    applies=_is_motion,
    label="time shift",
    sentence="markers measured {size} {way} than stated{limit}",
    description="how much later than stated the markers were measured, by the clock of the grasps",
    same=lambda e: {"time between samples": round(e.timestep_s, 12)},
    clock=lambda values, t_s, data: values,
)
CLOCK_RATE = Deviation(
    "clock_rate",
    "1",
    sigma=None,
    key="clock_rate",
    considered=1e-4,
    remedy="trigger robot and cameras by one clock",
    changes=("clock",),
    applies=lambda experiment: _is_motion(experiment) and _has_markers(experiment),
    label="rate of the markers' clock",
    sentence="the markers' clock is slow by {signed}",
    description="how much slower the clock of the markers runs than the clock of the grasps",
    clock=lambda values, t_s, data: values * (t_s - data.recorded_s[0]),
)
POSE_TURN = Deviation(
    "pose_turn_rad",
    "rad",
    sigma=None,
    key="pose",
    axes="x y z",
    changes=("reading", "gravity"),
    by="length",
    label="turn of the pose, {axis}",
    sentence="rotation of the poses: {size}",
    description="a constant rotation of grasps and body in the cameras' frame, which rotates "
    "gravity in the body's frame",
    reading=_rotate_position,
)
POSE_SHIFT = Deviation(
    "pose_shift_m",
    "m",
    sigma=None,
    key="pose",
    axes="x y z",
    reach=UNLIMITED_REACH,
    by="length",
    label="shift of the pose, {axis}",
    sentence="translation of the poses: {size}",
    description="a constant translation of grasps and body in the cameras' frame",
    reading=_shift_position,
)
TILT = Deviation(
    "gravity_rad",
    "rad",
    sigma=DEGREE,
    key="gravity",
    axes="first second",
    changes=("gravity",),
    applies=lambda experiment: bool(np.any(experiment.gravity_m_s2)),
    by="length",
    label="tilt of gravity, {axis}",
    sentence="tilt of gravity: {size}",
    largest=3 * DEGREE,
    description="a tilt of the direction of gravity",
    same=lambda e: {"gravity": tuple(e.gravity_m_s2)},
)
GRASP_TURN = Deviation(
    "hand_eye_rad",
    "rad",
    sigma=0.5 * DEGREE,
    key="hand_eye",
    axes="x y z",
    changes=("grasps",),
    applies=_has_observable_hand_eye,
    by="length",
    label="turn in the grasp, {axis}",
    sentence="rotation of the body in the gripper: {size}",
    largest=5 * DEGREE,
    description="a constant rotation of the body in its grasps",
    same=_hand_eye_sharing_key,
)
GRASP_SHIFT = Deviation(
    "hand_eye_m",
    "m",
    sigma=1e-3,
    key="hand_eye",
    axes="x y z",
    changes=("grasps",),
    applies=_has_observable_hand_eye,
    by="length",
    label="shift in the grasp, {axis}",
    sentence="translation of the body in the gripper: {size}",
    largest=5e-3,
    description="a constant translation of the body in its grasps; rotation and "
    "translation are estimated if the start is an equilibrium and there are "
    "markers",
    same=_hand_eye_sharing_key,
)
CLAMP_TURN = Deviation(
    "clamp_turn_rad",
    "rad",
    sigma=0.02,
    key="clamp_turn",
    of="grasp",
    axes="x y z",
    changes=("grasps",),
    applies=_has_turned_clamps,
    by="worst",
    label="turn of grasp {which}, {axis}",
    sentence="rotation of a grasp: up to {size}",
    description="a constant rotation of each of several grasps about the middle of its nodes, as of "
    "clamps whose directions were not measured",
    same=_hand_eye_sharing_key,
)
STRAIN_ZERO = Deviation(
    "strain_zero",
    "1",
    sigma=None,
    key="strain_zero",
    changes=("grasps",),
    applies=lambda experiment: experiment.specimen is not None,
    label="zero of the strain",
    sentence="offset of the strain: {size}",
    description="a constant offset of the strains of a specimen",
)
ZERO = Deviation(
    "displacement_zero_m",
    "m",
    sigma=1e-4,
    key="displacement_zero",
    of="grasp",
    axes="x y z",
    changes=("grasps",),
    by="worst",
    label="zero of grasp {which}, {axis}",
    sentence="zero error of a displacement: up to {size}",
    description="a constant offset of each prescribed displacement along each of its axes",
)
OBSTACLE_OFFSET = Deviation(
    "obstacle_offset_m",
    "m",
    sigma=1e-4,
    key="obstacle",
    of="obstacle",
    changes=("grasps",),
    by="worst",
    applies=lambda experiment: bool(experiment.obstacles),
    label="place of {which}",
    sentence="position error of an obstacle: up to {size}",
    description="a constant offset of each obstacle along its normal, or along the axis of "
    "its displacement; it changes the time at which the obstacle touches the "
    "body",
)
OBSTACLE_TILT = Deviation(
    "obstacle_tilt_rad",
    "rad",
    sigma=None,
    key="obstacle",
    of="obstacle",
    axes="first second",
    changes=("grasps",),
    by="length",
    considered=0.2 * DEGREE,
    applies=lambda experiment: any(each.shape.has_tilt for each in experiment.obstacles),
    applies_to=_has_tilt,
    label="tilt of {which}, {axis}",
    sentence="tilt of an obstacle: {size}",
    description="a constant tilt of each obstacle that is a plane or a box, about the "
    "point of the plane or the middle of the box",
)
OBSTACLE_TIME = Deviation(
    "obstacle_time_s",
    "s",
    sigma=None,
    key="obstacle",
    of="obstacle",
    changes=("grasps",),
    by="worst",
    considered=1e-3,
    applies=lambda experiment: any(len(each.poses.t_s) > 1 for each in experiment.obstacles),
    applies_to=lambda experiment, index: len(experiment.grasps[index].poses.t_s) > 1,
    label="delay of {which}",
    sentence="delay of an obstacle: up to {size}",
    description="delay of each obstacle's motion, to first order",
)
TENSION_FACTOR = Deviation(
    "tension_factor",
    "1",
    sigma=None,
    key="tension_factor",
    of="tendon",
    changes=("drives",),
    label="{which}, more than stated",
    sentence="{which} by {signed}",
    description="scale error of the tension of each tendon: the factor minus one",
)
TENSION_OFFSET = Deviation(
    "tension_lost_n",
    "N",
    sigma=None,
    key="tension_lost",
    of="tendon",
    changes=("drives",),
    label="{which}, lost",
    sentence="{which} {signed}",
    description="tension of each tendon that is lost by friction",
)
PRESSURE_FACTOR = Deviation(
    "pressure_factor",
    "1",
    sigma=None,
    key="pressure_factor",
    of="pressure",
    changes=("drives",),
    label="{which}, more than stated",
    sentence="{which} by {signed}",
    description="scale error of each pressure: the factor minus one",
)
PRESSURE_OFFSET = Deviation(
    "pressure_lost_pa",
    "Pa",
    sigma=None,
    key="pressure_lost",
    of="pressure",
    changes=("drives",),
    label="{which}, lost",
    sentence="{which} {signed}",
    description="amount by which each pressure is lower than stated",
)
PRESSURE_LAG = Deviation(
    "pressure_lag",
    "1",
    sigma=None,
    key="pressure_lag",
    of="pressure",
    changes=("drives",),
    applies=lambda experiment: any(each.lag_s for each in experiment.pressures),
    label="{which}, log of lag over stated lag",
    sentence="{which}: log of lag over stated lag {signed}",
    description="logarithm of the ratio of the true lag of each pressure to the stated lag_s",
)
JOINING = Deviation(
    "joining_s",
    "s",
    sigma=1e-2,
    key="joining",
    of="load",
    changes=("loads",),
    step=lambda experiment: SAMPLES_A_STEP * experiment.timestep_s,
    label="{which}",
    sentence="{which} {number}{error}{unit} {way} than {stated}",
    description="delay of the time at which each point mass or force begins or ends, if "
    "this time is within the recording",
)
START_ACCELERATION = Deviation(
    "start_acceleration_m_s2",
    "m/s²",
    sigma=20.0,
    key="start_acceleration",
    axes="x1 y1 z1 x2 y2 z2",
    changes=("loads",),
    by="length",
    applies=_moves_at_start,
    label="acceleration that held the body at the start, {axis}",
    sentence="acceleration that held the body at the start: {size}",
    description="the displacement at the first time of a body that starts moving: that by two fields of "
    "forces, which alone would give its far end this acceleration",
)
START_VELOCITY = Deviation(
    "start_velocity_m_s",
    "m/s",
    sigma=2.0,
    key="start_velocity",
    axes="x1 y1 z1 x2 y2 z2",
    changes=("loads",),
    by="length",
    applies=_moves_at_start,
    label="velocity of the far end at the start, {axis}",
    sentence="velocity of the far end at the start: {size}",
    description="the velocity of the far end at the first time of a body that starts moving, in the same "
    "two fields",
)
TEMPERATURE = Deviation(
    "stiffness_per_kelvin",
    "1/K",
    key="stiffness_per_kelvin",
    considered=5e-3,
    remedy="record at one temperature, or estimate it from recordings at several",
    applies=lambda e: e.temperature_difference_k is not None and not e.body.has_memory,
    label="change of the stiffness per kelvin",
    sentence="change of the stiffness per kelvin: {signed}",
    description="relative change of the stiffness per kelvin of temperature_difference_k, in a body "
    "without memory",
    stiffness=lambda experiment, t_s: experiment.temperature_difference_at(t_s),
)
TARE = Deviation(
    "tare",
    "σ",
    sigma=10.0,
    key="tare",
    of="sensor",
    changes=("sensor",),
    reach=UNLIMITED_REACH,
    by="worst",
    label="tare{which} of {axis}",
    sentence="tare: up to {size}",
    description="a constant offset of each component of a force sensor, in multiples of its sigma",
)
SENSOR_TIME = Deviation(
    "sensor_time_s",
    "s",
    sigma=5e-3,
    key="sensor_time",
    of="sensor",
    changes=("sensor",),
    applies=lambda experiment: _is_motion(experiment) or experiment.body.has_memory,
    low=-3.0,
    high=3.0,
    by="worst",
    label="time shift of the sensor{which}",
    sentence="delay of the sensor: {size}",
    description="delay of the force sensors, limited to three standard deviations of its prior",
)
SENSOR_LAG = Deviation(
    "sensor_lag_s",
    "s",
    sigma=None,
    key="sensor_lag",
    of="sensor",
    changes=("sensor",),
    applies=_is_motion,
    low=0.0,
    high=3.0,
    by="worst",
    label="lag of the sensor{which}",
    sentence="time constant of the sensor: {size}",
    description="time constant of a first-order low-pass in the sensor, limited to values "
    "between zero and three standard deviations of its prior",
)
TOOL_MASS = Deviation(
    "tool_kg",
    "kg",
    sigma=None,
    key="tool",
    of="sensor",
    changes=("sensor",),
    low=0.0,
    by="worst",
    label="mass of the tool{which}",
    sentence="mass of the tool: {size}",
    description="mass of the tool between a sensor and the body",
)
TOOL_CENTRE = Deviation(
    "tool_m",
    "m",
    sigma=None,
    key="tool",
    of="sensor",
    axes="x y z",
    changes=("sensor",),
    applies=lambda experiment: bool(experiment.nuisance.tool_kg),
    by="worst",
    reference=0.05,
    label="centre of the tool{which}, {axis}",
    sentence="offset of the tool's centre: up to {size}",
    description="centre of the tool relative to the point of the sensor; in the frame of "
    "the world, relative to the centre of the grasped nodes",
)
DEPTH_TURN = Deviation(
    "depth_turn_rad",
    "rad",
    sigma=5 * DEGREE,
    key="depth_pose",
    of="camera",
    axes="x y z",
    changes=("depth",),
    applies=_has_depth_cameras,
    low=-4.0,
    high=4.0,
    by="length",
    label="turn of {which}, {axis}",
    sentence="rotation of a depth camera: {size}",
    description="rotation of each depth camera about the middle of the body, stated along "
    "the axes of the camera",
    same=_camera_sharing_key,
)
DEPTH_SHIFT = Deviation(
    "depth_shift_m",
    "m",
    sigma=0.02,
    key="depth_pose",
    of="camera",
    axes="x y z",
    changes=("depth",),
    applies=_has_depth_cameras,
    low=-4.0,
    high=4.0,
    reach=UNLIMITED_REACH,
    step=lambda experiment: CAMERA_SHIFT_A_STEP_M,
    by="length",
    label="shift of {which}, {axis}",
    sentence="translation of a depth camera: {size}",
    description="translation of each depth camera; if neither prior is stated, the search "
    "begins by aligning the first image with the body",
    same=_camera_sharing_key,
)
DEPTH_BIAS = Deviation(
    "depth_bias_m",
    "m",
    sigma=5e-3,
    key="depth_bias",
    of="camera",
    changes=("depth",),
    applies=_has_depth_cameras,
    applies_to=_has_camera_matrix,
    low=-4.0,
    high=4.0,
    reach=UNLIMITED_REACH,
    step=lambda experiment: CAMERA_SHIFT_A_STEP_M,
    by="worst",
    label="bias of {which}",
    sentence="offset of the depth: {size}",
    description="offset that is added to each depth of an image",
)
DEPTH_SCALE = Deviation(
    "depth_scale",
    "1",
    sigma=5e-3,
    key="depth_scale",
    of="camera",
    changes=("depth",),
    applies=_has_depth_cameras,
    applies_to=_has_camera_matrix,
    low=-4.0,
    high=4.0,
    reach=4.0,
    by="worst",
    label="scale of {which}",
    sentence="scale error of the depth: {size}",
    description="scale error of each depth of an image: the factor minus one",
)
DEPTH_TIME = Deviation(
    "depth_time_s",
    "s",
    sigma=5e-3,
    key="depth_time",
    of="camera",
    changes=("depth",),
    applies=lambda experiment: _is_motion(experiment) and _has_depth_cameras(experiment),
    low=-3.0,
    high=3.0,
    by="worst",
    label="time shift of {which}",
    sentence="delay of a depth camera: {size}",
    description="delay of a depth camera, limited to three standard deviations of its prior",
)
DEPTH_EDGE = Deviation(
    "depth_edge_px",
    "px",
    sigma=2.0,
    key="depth_edge",
    of="camera",
    changes=("depth",),
    applies=_has_depth_outlines,
    applies_to=_has_images,
    low=-4.0,
    high=4.0,
    reach=UNLIMITED_REACH,
    by="worst",
    label="edge of {which}",
    sentence="silhouettes end {size} inside the body's outline",
    description="distance by which silhouettes in the images of each depth camera end inside the "
    "outline of the body, in pixels",
)

# Errors of ordinary cameras. A camera states its own prior deviations (`CameraImages`); these rows
# count for those that it does not state. Rows that are "tested" only have no place in the budget by
# default, because a camera that states zero is exact.
_image_error = partial(Deviation, sigma=None, of="images", changes=(), reach=IMAGE_REACH)
IMAGE_TURN = _image_error(
    "image_turn_rad",
    "rad",
    key="image_pose",
    axes="x y z",
    applies=_has_image_cameras,
    by="length",
    label="turn, {axis}, of {which}",
    sentence="rotation of a camera of images: {size}",
    remedy=CALIBRATE_A_POSE,
    description="rotation of each ordinary camera about its axes",
)
IMAGE_SHIFT = _image_error(
    "image_shift_m",
    "m",
    key="image_pose",
    axes="x y z",
    applies=_has_image_cameras,
    by="length",
    label="shift, {axis}, of {which}",
    sentence="translation of a camera of images: {size}",
    remedy=CALIBRATE_A_POSE,
    description="translation of each ordinary camera along its axes",
)
IMAGE_FOCAL = _image_error(
    "image_focal",
    "1",
    key="image_focal",
    applies=_has_image_cameras,
    considered=1e-2,
    remedy="calibrate the camera with the focus and zoom of the recording",
    by="worst",
    label="error of the focal length of {which}",
    sentence="error of a focal length: {signed}",
    description="relative error of both focal lengths of each ordinary camera",
)
IMAGE_CENTRE = _image_error(
    "image_centre_px",
    "px",
    key="image_centre",
    axes="u v",
    applies=_has_image_cameras,
    considered=2.0,
    remedy="calibrate the camera with images of the same size and crop as the video",
    by="length",
    label="error of the principal point, {axis}, of {which}",
    sentence="error of a principal point: {size}",
    description="error of the principal point of each ordinary camera",
)
IMAGE_TIME = _image_error(
    "image_time_s",
    "s",
    key="image_time",
    applies=_is_filmed_motion,
    considered=5e-3,
    remedy="state clock_sigma_s, so that the delay is estimated, or trigger both by one signal",
    by="worst",
    label="delay of {which}",
    sentence="delay of images: {signed}",
    description="delay of the images of each ordinary camera by the clock of the grasps",
)
IMAGE_CLOCK_RATE = _image_error(
    "image_clock_rate",
    "1",
    key="image_clock_rate",
    applies=_is_filmed_motion,
    considered=1e-4,
    remedy="use the times of the images in the video, or film a clock",
    by="worst",
    label="error of the frame rate of {which}",
    sentence="error of a frame rate: {signed}",
    description="relative error of the time between the images of each ordinary camera",
)
IMAGE_LINE_DELAY = _image_error(
    "image_line_delay_s",
    "s",
    key="image_line_delay",
    applies=_is_filmed_motion,
    considered=1e-5,
    remedy="state line_delay_s: the exposure of one row after the other by a rolling shutter takes 10 "
    "to 30 microseconds per row of a phone",
    by="worst",
    label="error of the line delay of {which}",
    sentence="error of a line delay: {signed}",
    description="error of the time from one row of an image to the next, of each ordinary camera",
)
IMAGE_DRIFT = _image_error(
    "image_drift_px",
    "px",
    key="image_drift",
    applies=_is_filmed_motion,
    reach=UNLIMITED_REACH,
    considered=0.2,
    remedy="compare each image with the first one in the tracker, or use tags, which do not drift",
    by="worst",
    label="drift of {which}",
    sentence="drift of a track: up to {size}",
    description="drift of each track: standard deviation of a random walk after one second",
)

# Of one session: the next one grips the body anew.
GRIP = (GRASP_TURN, GRASP_SHIFT)
# In the order of φ; neighbours of one component stand together.
KINDS = tuple(row for row in [*vars().values()] if isinstance(row, Deviation))
# What a `Gauge` does not know of itself: it has the deviations, in place of `Nuisance`.
GAUGE = Deviation("reading", "", sigma=None, of="gauge", changes=())
# Relative errors of the stress of a specimen, which a step of the solver changes as it does moduli.
# Several tests of a specimen share its stiffness.
SPECIMEN_FACTORS = {
    name: Deviation(
        name, "", sigma=None, of="gauge", changes=(), reach=UNLIMITED_REACH, step=lambda _: 1.0
    )
    for name in ("area_error", "specimen_stiffness")
}
SPECIMEN_STIFFNESS = SPECIMEN_FACTORS["specimen_stiffness"]
# No area is ten times too large: towards zero, constants have no effect on the stress.
SMALLEST_FACTOR = 0.1
# Coordinates of places on the surface that sensors refer to, and other unknowns of single points.
SURFACE_PLACE = Deviation(
    "surface_place", "", sigma=None, of="gauge", changes=(), reach=3.0, step=_largest_place_step_m
)


def nuisances_called(word: str) -> list[Deviation]:
    """Return the kinds of nuisance parameters with a name, key, label, or beginning of their
    sentence in the terminal; empty for none.
    """
    plain = word.replace("_", " ")

    def matches(form: str) -> object:
        """Whether the word has a form, in which {which} and the like stand for any text."""
        literals = [re.escape(each) for each in re.split(r"\{\w+\}", form.replace("_", " "))]
        return re.search(r"\w", "".join(literals)) and re.fullmatch(".*".join(literals), plain)

    return [
        row
        for row in KINDS
        if any(map(matches, (row.name, row.key, row.label, row.sentence.split(":")[0])))
    ]


def _field_of(row: Deviation) -> FieldOfRow:
    """Return the field of `Nuisance` for a row."""
    return FieldOfRow("float | None", row.sigma, "float or None", sentence(row.description))


@validated
@dataclass(frozen=True, kw_only=True)
@with_fields({row.name: _field_of(row) for row in KINDS})
class Nuisance:
    """Standard deviations of an experiment's nuisance parameters; None: not estimated.

    Every one has a normal prior around zero with its deviation. The defaults are those of a careful
    laboratory; `none` is for ideal data. There is a field for each row of `KINDS`.

    Attributes
    ----------
    scope : mapping of name to str
        "shared", or "shared" and a word, for parameters with the same value in all recordings that
        have the word, by field; other parameters have a value of each recording.
    own : sequence of Deviation
        Custom parameters, which change the predicted positions or the times of markers.
    """

    scope: Mapping[str, str] = field(default_factory=dict, hash=False)
    own: Sequence[Deviation] = field(default=(), hash=False)

    if TYPE_CHECKING:

        def __init__(
            self,
            *,
            scope: Mapping[str, str] = ...,
            own: Sequence[Deviation] = (),
            **deviations: float | None,
        ) -> None: ...
        def __getattr__(self, name: str) -> float | None: ...

    def __post_init__(self) -> None:
        for row in self.own:
            _check_custom_kind(row)
            if [each.name for each in self.kinds].count(row.name) > 1:
                raise InputError(
                    f"two nuisance parameters are named {row.name!r}; expected a name that no "
                    "other kind has, custom or built-in"
                )
        for row in self.kinds:
            value = self.sigma(row)
            if value is not None:
                value = validate_as(Finite, value, f"the standard deviation of {row.name!r}")
            if value is not None and not value > 0:
                raise InputError(
                    f"the standard deviation of the nuisance parameter {row.name!r} is {value:g}; "
                    "expected a value above 0"
                )
        names = [*(row.name for row in self.kinds), SPECIMEN_STIFFNESS.name]
        for name, word in self.scope.items():
            if name not in names:
                raise InputError(
                    f"scope contains {name!r}, which is not a nuisance parameter; expected one of "
                    f"{listed(names)}"
                )
            if not re.fullmatch(SCOPE, word):
                raise InputError(f"the scope of {name} is {word!r}; expected {SCOPE_TEXT}")

    @property
    def kinds(self) -> tuple[Deviation, ...]:
        """All kinds of nuisance parameters that may be estimated: `KINDS`, then custom ones."""
        return (*KINDS, *self.own)

    def sigma(self, row: Deviation) -> float | None:
        """Return the standard deviation of a kind's prior, in its unit; None where it is not
        estimated.

        For a custom kind it is that of `row`, otherwise the field of this object.
        """
        return row.sigma if row in self.own else getattr(self, row.name)

    @classmethod
    @validated
    def none(
        cls,
        *,
        scope: Mapping[str, str] | None = None,
        own: Sequence[Deviation] = (),
        **deviations: float | None,
    ) -> Nuisance:
        """Return a `Nuisance` that estimates only the fields given by name, with their standard
        deviations; all others are None and thus exact.

        `scope` and `own` are those of `Nuisance`; by default they are empty.
        """
        nothing = {row.name: None for row in KINDS}
        return Nuisance(**(nothing | deviations), scope=scope or {}, own=own)


def _check_custom_kind(row: Deviation) -> None:
    if row.of not in ("recording", "marker"):
        raise InputError(
            f"the nuisance parameter {row.name!r} has of = {row.of!r}; expected 'recording' or "
            "'marker'"
        )
    if row.sigma is None:
        raise InputError(
            f"the nuisance parameter {row.name!r} has no sigma; expected the standard deviation "
            "of its prior"
        )
    functions = ("reading", "clock", "stiffness")
    stated = [name for name in functions if getattr(row, name) is not None]
    if len(stated) != 1:
        raise InputError(
            f"the nuisance parameter {row.name!r} has {' and '.join(stated) or 'no effect'}; "
            f"expected exactly one of the functions {listed(functions)}"
        )
