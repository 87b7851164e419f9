"""Videos of a simulated bar of silicone foam that hangs from a gripper, rendered by MuJoCo.

The motion is simulated with a finer mesh and shorter time steps than the problem that identifies it.
MuJoCo renders the textured surface in front of a wall, with shading, noise of the sensor and the
compression of MP4. Pose, calibration and clock of the camera differ from what the problem states.
Needs MuJoCo with EGL (MUJOCO_GL=egl) and OpenCV.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.common.array_types import Array
from collocation_sysid.extras.tracking import corners_of, follow, images_of, read_image, write_table

TRUTH = {"young_pa": 4.5e4, "poisson": 0.35, "gamma_r_s": 3e-3, "gamma_m_1_s": 0.0}
SIZE_M = np.array([0.02, 0.03, 0.12])
DENSITY_KG_M3 = 400.0
TOP_M = SIZE_M[2] - 1e-4
# Divisions of the mesh that is simulated, and of the mesh of the problem.
FINE, COARSE = (2, 3, 12), (1, 1, 8)
# Times that are simulated, beyond those of the video [s].
STEP_S = 1 / 240
BEGIN_S, END_S = -0.05, 1.6
# Matrix of the true camera, and size of its images.
FOCAL_PX, IMAGE_PX = 1100.0, (1280, 720)
CENTRE_PX = (np.array(IMAGE_PX) - 1) / 2
# Where the cameras are, and at what they look [m].
EYES_M = {"front": (0.09, -0.25, 0.09), "side": (0.27, -0.08, 0.09)}
MIDDLE_M = SIZE_M * [0.5, 0.5, 0.45]
# Standard deviations of the errors of the description, as the problem states them.
TURN_RAD, SHIFT_M, FOCAL, CENTRE_SIGMA_PX, CLOCK_S = np.deg2rad(1.0), 5e-3, 5e-3, 2.0, 5e-3
# Edge of the squares by which the surface is drawn [m].
SQUARE_M = 2.5e-3
# Standard deviation of the noise of the grey values.
NOISE_GREY = 2.0
# Size of the surroundings by which trackers recognise a point [pixels]: masks leave out points whose
# surroundings contain an edge of the bar, because faces beside an edge change differently.
SURROUNDINGS_PX = 31


def hand_positions(t_s: Array) -> Array:
    """Return the displacement (T, 3) of the gripper: to and fro, then at rest [m]."""
    shift_m = np.zeros((len(t_s), 3))
    share = np.clip((t_s - 0.1) / 0.9, 0, 1)
    shift_m[:, 0] = 0.008 * np.sin(3 * np.pi * share) * np.sin(np.pi * share) ** 2
    shift_m[:, 1] = 0.004 * np.sin(2 * np.pi * share) * np.sin(np.pi * share)
    return shift_m


def poses(t_s: Array) -> cs.PoseSequence:
    """Return the poses of the gripper at times (T,) [s]."""
    return cs.PoseSequence(t_s, hand_positions(t_s), np.tile([0, 0, 0, 1.0], (len(t_s), 1)))


def mesh(divisions: tuple[int, int, int]) -> cs.TetMesh:
    """Return a mesh of the bar."""
    return cs.box_mesh(tuple(SIZE_M.tolist()), divisions)


def surface() -> tuple[Array, Array, Array]:
    """Return points (V, 3) [m], triangles (F, 3) and texture coordinates (V, 2) of the faces of the
    bar, which are unrolled side by side in the texture.
    """
    points, triangles, places = [], [], []
    count = left = 0.0
    for axis in range(3):
        first, second = (k for k in range(3) if k != axis)
        for end in (0.0, SIZE_M[axis]):
            steps = [
                np.linspace(0, SIZE_M[k], round(SIZE_M[k] / SQUARE_M) + 1) for k in (first, second)
            ]
            a, b = np.meshgrid(*steps, indexing="ij")
            face = np.zeros((a.size, 3))
            face[:, axis], face[:, first], face[:, second] = end, a.ravel(), b.ravel()
            k = np.arange(a.size).reshape(a.shape) + int(count)
            corners = [k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]]
            outwards = (end > 0) == (axis != 1)
            for order in ((0, 1, 2), (0, 2, 3)):
                chosen = [corners[j].ravel() for j in (order if outwards else order[::-1])]
                triangles.append(np.column_stack(chosen))
            points.append(face)
            places.append(np.column_stack([left + face[:, first], face[:, second]]))
            count += a.size
            left += SIZE_M[first] + SQUARE_M
    extent = np.array([left, SIZE_M.max()])
    return np.vstack(points), np.vstack(triangles), np.vstack(places) / extent


def motion(points_m: Array) -> CubicSpline:
    """Return the positions (V, 3) of points of the undeformed bar as a function of time [s]."""
    t_s = STEP_S * np.arange(round((END_S - BEGIN_S) / STEP_S) + 1.0) + BEGIN_S
    fine = mesh(FINE)
    body = cs.Body(fine, density_kg_m3=DENSITY_KG_M3, element="tet10")
    held = cs.Grasp(np.flatnonzero(body.nodes_m[:, 2] > TOP_M), poses(t_s))
    markers = cs.Markers(t_s, np.zeros((len(t_s), len(points_m), 3)), 1e-3, places_m=points_m)
    experiment = cs.Experiment(body, t_s, [held], markers, air_density_kg_m3="none")
    return CubicSpline(t_s, cs.simulate(experiment, TRUTH, "midpoint", substeps=1).markers_m)


def looking(eye_m: Array) -> Array:
    """Return the pose (4, 4) of an upright camera that looks at the middle of the bar."""
    ahead = (MIDDLE_M - eye_m) / np.linalg.norm(MIDDLE_M - eye_m)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.column_stack([right, np.cross(ahead, right), ahead, eye_m])
    return pose


@dataclass(frozen=True)
class Described:
    """What a problem states about a camera, and how late its images are by the robot's clock [s]."""

    matrix: Array
    pose: Array
    late_s: float

    @classmethod
    def drawn(cls, pose: Array, rng: np.random.Generator) -> Described:
        """Return a description of a true pose and of the true calibration, with errors drawn from
        their standard deviations.
        """
        stated = pose.copy()
        stated[:3, :3] = (
            pose[:3, :3] @ Rotation.from_rotvec(TURN_RAD * rng.normal(size=3)).as_matrix()
        )
        stated[:3, 3] += SHIFT_M * rng.normal(size=3)
        focal_px = FOCAL_PX * (1 + FOCAL * rng.normal())
        centre_px = CENTRE_PX + CENTRE_SIGMA_PX * rng.normal(size=2)
        matrix = np.array([[focal_px, 0, centre_px[0]], [0, focal_px, centre_px[1]], [0, 0, 1]])
        return cls(matrix, stated, CLOCK_S * rng.normal())


def speckles(rng: np.random.Generator) -> Array:
    """Return a texture of random speckles, as sprayed paint."""
    import cv2

    noise = rng.uniform(0, 255, (1024, 1024)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 4.0)
    return np.clip(120 + 12 * (smooth - smooth.mean()), 0, 255).astype(np.uint8)


def numbers(values: Array) -> str:
    """Return numbers as text for MuJoCo."""
    return " ".join(f"{each:.8g}" for each in np.ravel(values))


def render(shape: CubicSpline, pose: Array, t_s: Array, seed: int) -> Iterator[NDArray[np.uint8]]:
    """Yield images (rows, columns, 3) of the bar at times (S,) [s], blue first, from a pose (4, 4).

    `shape` returns the points of `surface` at a time.
    """
    os.environ.setdefault("MUJOCO_GL", "egl")
    import cv2

    mujoco: Any = import_module("mujoco")
    rng = np.random.default_rng(seed)
    points, triangles, places = surface()
    _, texture = cv2.imencode(".png", speckles(rng))
    _, wall = cv2.imencode(".png", 150 + speckles(rng) // 6)
    up = np.column_stack([pose[:3, 0], -pose[:3, 1]]).T
    fovy = 2 * np.degrees(np.arctan(IMAGE_PX[1] / 2 / FOCAL_PX))
    scene = f"""<mujoco>
      <visual>
        <global offwidth="{IMAGE_PX[0]}" offheight="{IMAGE_PX[1]}"/>
        <headlight ambient="0.55 0.55 0.55" diffuse="0.4 0.4 0.4" specular="0 0 0"/>
        <map znear="0.01" zfar="50"/>
      </visual>
      <asset>
        <texture name="bar" type="2d" file="bar.png"/>
        <texture name="wall" type="2d" file="wall.png"/>
        <material name="bar" texture="bar" specular="0" shininess="0"/>
        <material name="wall" texture="wall" specular="0" texrepeat="4 4"/>
      </asset>
      <worldbody>
        <camera name="camera" pos="{numbers(pose[:3, 3])}" xyaxes="{numbers(up)}" fovy="{fovy:.10g}"/>
        <geom type="plane" size="2 2 1" pos="0 0.5 0" xyaxes="1 0 0 0 0 1" material="wall"/>
        <body name="hand" mocap="true">
          <geom type="box" size="0.02 0.025 0.015" rgba="0.2 0.22 0.25 1"/>
        </body>
      </worldbody>
      <deformable>
        <flex name="bar" dim="2" body="world" radius="0.0005" material="bar"
          vertex="{numbers(points)}" element="{numbers(triangles)}" texcoord="{numbers(places)}"/>
      </deformable>
    </mujoco>"""
    model = mujoco.MjModel.from_xml_string(
        scene, assets={"bar.png": texture.tobytes(), "wall.png": wall.tobytes()}
    )
    data = mujoco.MjData(model)
    with mujoco.Renderer(model, IMAGE_PX[1], IMAGE_PX[0]) as renderer:
        for time in t_s:
            top = SIZE_M * [0.5, 0.5, 1] + [0, 0, 0.0155]
            data.mocap_pos[0] = top + hand_positions(np.array([time]))[0]
            mujoco.mj_forward(model, data)
            data.flexvert_xpos[:] = shape(time)
            renderer.update_scene(data, camera="camera")
            image = renderer.render()[..., ::-1].astype(float)
            image += NOISE_GREY * rng.normal(size=image.shape)
            yield np.clip(image, 0, 255).astype(np.uint8)


def mask_of(shape: CubicSpline, pose: Array, t_s: float) -> NDArray[np.uint8]:
    """Return an image that is white where the camera sees a face of the bar at a time, without the
    edges of the faces.
    """
    import cv2

    rest, now = surface()[0], shape(t_s)
    own = (now - pose[:3, 3]) @ pose[:3, :3]
    pixels = np.round(own[:, :2] / own[:, 2:] * FOCAL_PX + CENTRE_PX).astype(np.int32)
    mask = np.zeros(IMAGE_PX[::-1], dtype=np.uint8)
    for axis in range(3):
        for end in (0.0, SIZE_M[axis]):
            on_face = rest[:, axis] == end
            middle = now[on_face].mean(axis=0)
            if (pose[:3, 3] - middle) @ (middle - now.mean(axis=0)) > 0:
                face = np.zeros_like(mask)
                cv2.fillConvexPoly(face, cv2.convexHull(pixels[on_face]), 255)
                square = np.ones((SURROUNDINGS_PX, SURROUNDINGS_PX), dtype=np.uint8)
                mask |= np.asarray(cv2.erode(face, square), dtype=np.uint8)
    return mask


def film(
    folder: Path, name: str, shape: CubicSpline, t_s: Array, seed: int, most: int
) -> Described:
    """Render and track a video, NAME.mp4 and NAME.csv in a folder; write the calibration NAME.yaml,
    and return what a problem states about the camera.

    The images are those at the times (S,) [s] by the robot's clock, later by the drawn delay.
    """
    import cv2

    pose = looking(np.array(EYES_M[name]))
    described = Described.drawn(pose, np.random.default_rng(seed))
    rate_hz = 1 / float(t_s[1] - t_s[0])
    video = cv2.VideoWriter(
        str(folder / f"{name}.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), rate_hz, IMAGE_PX
    )
    for image in render(shape, pose, t_s + described.late_s, seed):
        video.write(image)
    video.release()
    cv2.imwrite(str(folder / "mask.png"), mask_of(shape, pose, float(t_s[0])))
    video_file, mask = folder / f"{name}.mp4", read_image(folder / "mask.png", is_grey=True)
    corners = corners_of(next(images_of(video_file, None))[1], mask, most)
    names = [f"p{k + 1}" for k in range(len(corners))]
    tracks = follow(images_of(video_file, None), names, corners, lost_px=2.0)
    write_table(tracks, folder / f"{name}.csv")
    rows = ", ".join(f"{each:.2f}" for each in described.matrix.ravel())
    calibration = f"""%YAML:1.0
---
image_width: {IMAGE_PX[0]}
image_height: {IMAGE_PX[1]}
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [{rows}]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [0., 0., 0., 0., 0.]
"""
    (folder / f"{name}.yaml").write_text(calibration)
    return described


def pose_text(pose: Array) -> str:
    """Return a pose (4, 4) as it is written in problem files."""
    rows = (", ".join(f"{each:.6g}" for each in row) for row in pose)
    return "[" + ", ".join(f"[{row}]" for row in rows) + "]"
