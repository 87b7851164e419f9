"""Lenses of cameras, compared with OpenCV, and calibration files of other programs."""

from __future__ import annotations

import json
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import collocation_sysid as cs
from collocation_sysid.recording.sources.calibration_files import read_calibration

MATRIX = [[812.3, 0.0, 641.7], [0.0, 809.1, 357.2], [0.0, 0.0, 1.0]]
BROWN = [-0.28, 0.11, 8e-4, -6e-4, -0.031, 0.05, -0.02, 0.007]
FISHEYE = [0.04, -0.011, 0.006, -0.002]
LENSES = [("pinhole", BROWN[:k]) for k in (0, 4, 5, 8)] + [("fisheye", FISHEYE)]


def camera_of(model: str, distortion: list[float]) -> cs.Camera:
    return cs.Camera(matrix=MATRIX, distortion=distortion, model=model)


def points(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    away = rng.uniform(0.3, 2.0, 200)
    return np.column_stack([away[:, None] * rng.uniform(-0.6, 0.6, (200, 2)), away])


@pytest.mark.parametrize(("model", "distortion"), LENSES)
def test_pixels_are_those_of_opencv(model: str, distortion: list[float]) -> None:
    cv2 = pytest.importorskip("cv2")
    here = points()
    project = cv2.fisheye.projectPoints if model == "fisheye" else cv2.projectPoints
    still = np.zeros((3, 1))
    if model == "fisheye":
        theirs, _ = project(here[:, None], still, still, np.array(MATRIX), np.array(distortion))
    else:
        theirs, _ = project(here, still, still, np.array(MATRIX), np.array(distortion))
    ours = camera_of(model, distortion).distorted_pixels(here)
    np.testing.assert_allclose(ours, theirs.reshape(-1, 2), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("model", "distortion"), LENSES)
def test_expressions_of_pixels_agree_with_numbers_and_their_derivatives_with_differences(
    model: str, distortion: list[float]
) -> None:
    camera = camera_of(model, distortion)
    inputs = ca.SX.sym("inputs", 6)
    pixel = camera.pixel_expression(inputs[:3], inputs[3], inputs[4:])
    value = ca.Function("pixel", [inputs], [pixel, ca.jacobian(pixel, inputs)])
    for point in [*points(1)[:5], np.array([0.0, 0.0, 0.7])]:
        at = np.append(point, [0.01, 2.0, -3.0])
        exact = camera.distorted_pixels(point[None])[0]
        centre = np.array(MATRIX)[:2, 2]
        expected = 1.01 * (exact - centre) + centre + [2.0, -3.0]
        found, slopes = (each.full() for each in value(at))
        np.testing.assert_allclose(found[:, 0], expected, atol=1e-9)
        for k, step in enumerate(1e-6 * np.eye(6)):
            differences = (value(at + step)[0] - value(at - step)[0]).full()[:, 0] / 2e-6
            np.testing.assert_allclose(slopes[:, k], differences, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize(("model", "distortion"), LENSES)
def test_rays_of_pixels_are_projected_back(model: str, distortion: list[float]) -> None:
    camera = camera_of(model, distortion)
    pixels = np.array([[641.7, 357.2], [100.0, 60.0], [1200.0, 700.0], [640.0, 20.0]])
    np.testing.assert_allclose(
        camera.distorted_pixels(camera.points_at_unit_depth(pixels)), pixels, atol=1e-3
    )


def test_a_depth_camera_is_a_camera() -> None:
    assert cs.DepthCamera is cs.Camera


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"distortion": [0.1] * 6},
            "6 numbers; expected none, one, two, four, five or eight .* k1",
        ),
        (
            {"distortion": [0.1] * 3},
            "3 numbers; expected none, one, two, four, five or eight .* k1",
        ),
        ({"distortion": [0.1] * 5, "model": "fisheye"}, "5 numbers; expected four .* k1, k2, k3"),
        ({"model": "omni"}, "'omni'"),
        ({"size_px": (0, 480)}, "size_px"),
    ],
)
def test_impossible_cameras_are_refused(arguments: dict, message: str) -> None:
    with pytest.raises(cs.InputError, match=message):
        cs.Camera(matrix=MATRIX, **arguments)


OPENCV_YAML = f"""%YAML:1.0
---
calibration_time: "Thu 26 Nov 2026"
image_width: 1280
image_height: 720
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: {np.ravel(MATRIX).tolist()}
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: {BROWN[:5]}
avg_reprojection_error: 0.31
"""
ROS_YAML = f"""image_width: 1280
image_height: 720
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: {np.ravel(MATRIX).tolist()}
distortion_model: {{model}}
distortion_coefficients:
  rows: 1
  cols: {{count}}
  data: {{coefficients}}
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""
KALIBR = f"""cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: {FISHEYE}
  distortion_model: equidistant
  intrinsics: [812.3, 809.1, 641.7, 357.2]
  resolution: [1280, 720]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1, 0, 0, -0.1]
  - [0, 1, 0, 0]
  - [0, 0, 1, 0]
  - [0, 0, 0, 1]
  camera_model: pinhole
  distortion_coeffs: {BROWN[:4]}
  distortion_model: radtan
  intrinsics: [812.3, 809.1, 641.7, 357.2]
  resolution: [1280, 720]
"""
ANIPOSE = f"""[cam_0]
name = "front"
size = [1280, 720]
matrix = {MATRIX}
distortions = {BROWN[:5]}
rotation = [0.1, -0.2, 0.3]
translation = [10.0, 20.0, 600.0]

[metadata]
adjusted = true
error = 0.4
"""
OPENCV_JSON = json.dumps(
    {
        "image_width": 1280,
        "image_height": 720,
        "K": {
            "type_id": "opencv-matrix",
            "rows": 3,
            "cols": 3,
            "dt": "d",
            "data": np.ravel(MATRIX).tolist(),
        },
        "D": {"type_id": "opencv-matrix", "rows": 1, "cols": 8, "dt": "d", "data": BROWN},
    }
)
COLMAP = f"""# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
1 OPENCV 1280 720 812.3 809.1 642.2 357.7 {" ".join(map(str, BROWN[:4]))}
"""
CAMODOCAL = f"""%YAML:1.0
---
model_type: PINHOLE
camera_name: front
image_width: 1280
image_height: 720
distortion_parameters:
   k1: {BROWN[0]}
   k2: {BROWN[1]}
   p1: {BROWN[2]}
   p2: {BROWN[3]}
projection_parameters:
   fx: 812.3
   fy: 809.1
   cx: 641.7
   cy: 357.2
"""
MATLAB = {
    "RadialDistortion": [BROWN[0], BROWN[1], BROWN[4]],
    "TangentialDistortion": BROWN[2:4],
    "ImageSize": [720, 1280],
    "WorldUnits": "mm",
}
OLD_MATRIX = [[812.3, 0, 0], [0, 809.1, 0], [642.7, 358.2, 1]]
OPENCV_FISHEYE = OPENCV_YAML.replace(str(BROWN[:5]), str(FISHEYE))
FILES = {
    "camodocal": (CAMODOCAL, None, "pinhole", BROWN[:4]),
    "MATLAB": (
        json.dumps(MATLAB | {"K": np.transpose(OLD_MATRIX).tolist()}),
        None,
        "pinhole",
        BROWN[:5],
    ),
    "MATLAB, older": (
        json.dumps(MATLAB | {"IntrinsicMatrix": OLD_MATRIX}),
        None,
        "pinhole",
        BROWN[:5],
    ),
    "OpenCV fisheye": (OPENCV_FISHEYE + "fisheye_model: 1\n", None, "fisheye", FISHEYE),
    "OpenCV fisheye as a word": (OPENCV_FISHEYE + "fisheye: yes\n", None, "fisheye", FISHEYE),
    "OpenCV, no fisheye": (OPENCV_YAML + "fisheye_model: 0\n", None, "pinhole", BROWN[:5]),
    "OpenCV YAML": (OPENCV_YAML, None, "pinhole", BROWN[:5]),
    "OpenCV JSON": (OPENCV_JSON, None, "pinhole", BROWN),
    "ROS": (
        ROS_YAML.format(model="plumb_bob", count=5, coefficients=BROWN[:5]),
        None,
        "pinhole",
        BROWN[:5],
    ),
    "ROS rational": (
        ROS_YAML.format(model="rational_polynomial", count=8, coefficients=BROWN),
        None,
        "pinhole",
        BROWN,
    ),
    "ROS fisheye": (
        ROS_YAML.format(model="equidistant", count=4, coefficients=FISHEYE),
        None,
        "fisheye",
        FISHEYE,
    ),
    "Kalibr": (KALIBR, "cam0", "fisheye", FISHEYE),
    "Kalibr, second": (KALIBR, "cam1", "pinhole", BROWN[:4]),
    "Anipose": (ANIPOSE, None, "pinhole", BROWN[:5]),
    "COLMAP": (COLMAP, None, "pinhole", BROWN[:4]),
}


@pytest.mark.parametrize("kind", FILES)
def test_calibration_files_are_recognised_by_their_content(kind: str, tmp_path: Path) -> None:
    text, name, model, distortion = FILES[kind]
    file = tmp_path / "calibration.dat"
    file.write_text(text)
    read = read_calibration(file, name)
    np.testing.assert_allclose(read.matrix, MATRIX, rtol=1e-12)
    np.testing.assert_allclose(read.distortion, distortion)
    assert (read.model, read.size_px) == (model, (1280, 720))
    cs.Camera(read.matrix, read.distortion, model=read.model, size_px=read.size_px)


def test_keys_of_a_calibration_that_are_not_understood_are_listed(tmp_path: Path) -> None:
    file = tmp_path / "calibration.dat"
    file.write_text(OPENCV_YAML + "wavelength: 3\nsquare_size: 20\n")
    assert read_calibration(file).unread == ("wavelength",)


def test_a_calibration_written_by_opencv_is_read(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    for name in ("camera.yaml", "camera.json"):
        storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_WRITE)
        storage.write("camera_matrix", np.array(MATRIX))
        storage.write("distortion_coefficients", np.array([BROWN[:5]]))
        storage.write("image_width", 1280)
        storage.write("image_height", 720)
        storage.release()
        read = read_calibration(tmp_path / name)
        np.testing.assert_array_equal(read.matrix, MATRIX)
        np.testing.assert_array_equal(read.distortion, BROWN[:5])
        assert read.size_px == (1280, 720)


def test_the_pose_of_an_anipose_camera_is_that_of_opencv(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    file = tmp_path / "calibration.toml"
    file.write_text(ANIPOSE)
    read = read_calibration(file)
    assert read.pose is not None
    camera = cs.Camera(read.matrix, read.distortion, read.pose)
    world = np.array([[30.0, -40.0, 50.0], [-20.0, 70.0, 10.0]])
    rotations, translations = camera.pose_at(0.0)
    ours = camera.distorted_pixels((world - translations[0]) @ rotations[0])
    theirs, _ = cv2.projectPoints(
        world,
        np.array([0.1, -0.2, 0.3]),
        np.array([10.0, 20.0, 600.0]),
        np.array(MATRIX),
        np.array(BROWN[:5]),
    )
    np.testing.assert_allclose(ours, theirs[:, 0], atol=1e-9)


def expanding(form: str) -> str:
    """YAML in which each of 40 lines states the value of the line before twice."""
    lines = [f"a{k + 1}: &a{k + 1} {form.format(f'*a{k}')}" for k in range(40)]
    return "\n".join(["a0: &a0 {x: 1}", *lines])


def test_a_calibration_may_have_aliases_and_comments(tmp_path: Path) -> None:
    file = tmp_path / "cam.dat"
    for text in (
        "K: &a [2, 0, 0, 0, 2, 0, 0, 0, 1]\nprojection: *a\n",
        "<opencv_storage><!-- a <K> --><K>2 0 0 0 2 0 0 0 1</K></opencv_storage>",
    ):
        file.write_text(text)
        assert np.array_equal(read_calibration(file).matrix, np.diag([2, 2, 1]))


@pytest.mark.parametrize(
    ("text", "name", "message"),
    [
        ("just words", None, r"cam.dat: found neither YAML, JSON, XML, TOML nor cameras.txt"),
        (
            expanding("[{0}, {0}]"),
            None,
            "aliases stand for more values than the text has characters",
        ),
        (expanding("{{<<: [{0}, {0}]}}"), None, "aliases stand for more values"),
        ("K: &a [*a]", None, "aliases stand for more values"),
        ("K: " + "[" * 100_000, None, r"cam.dat: found neither YAML"),
        ("K: a\0b", None, r"cam.dat: found neither YAML.*unacceptable character"),
        ("K: 1\x07", None, r"cam.dat: found neither YAML.*unacceptable character"),
        ("\ufffe: 1", None, r"cam.dat: found neither YAML.*unacceptable character"),
        ("<" + "<!--" * 200_000, None, r"cam.dat: found neither YAML"),
        (
            "<opencv_storage>" + "<!-- -->" * 100_000 + "<K>1 2 3</K></opencv_storage>",
            None,
            "K: found 3 numbers",
        ),
        ("a." * 300_000 + "b = 1", None, r"cam.dat: found neither YAML"),
        ("a: 1", None, r"cam.dat: found the keys a; expected the matrix of a camera"),
        ("K: [1, 2, 3]", None, r"cam.dat: K: found 3 numbers; expected the nine"),
        ("K: [1, x, 3]", None, r"cam.dat: K: found \[1, 'x', 3\]; expected numbers"),
        (
            KALIBR,
            None,
            r"cam.dat: found several cameras; expected the name of one of cam0 and cam1",
        ),
        (KALIBR, "cam7", r"cam.dat: found no camera 'cam7'"),
        (KALIBR.replace("equidistant", "fov"), "cam0", r"cam0.distortion_model: found 'fov'"),
        (OPENCV_YAML + "fisheye_model: 1\n", None, r"at most 4 that are not zero: those of a fis"),
        (OPENCV_YAML + "fisheye_model: perhaps\n", None, r"fisheye_model: found 'perhaps'; expec"),
        (OPENCV_YAML + "radial_distortion: [1, 2]\n", None, r"radial_distortion: found \[1, 2\]"),
        (OPENCV_YAML + "xi: 1.2\n", None, r"xi: found 1.2; expected only matrix, distortion"),
        (CAMODOCAL.replace("PINHOLE", "MEI"), None, r"model_type: found 'MEI'; expected one of"),
        (COLMAP.replace("OPENCV", "FOV"), None, r"cam.dat: line 3: found FOV; expected one of"),
        (
            ROS_YAML.format(model="plumb_bob", count=14, coefficients=[0.1] * 14),
            None,
            r"distortion_coefficients: found 14 coefficients; expected at most 8",
        ),
    ],
)
def test_faulty_calibrations_are_refused_with_file_and_key(
    text: str, name: str | None, message: str, tmp_path: Path
) -> None:
    file = tmp_path / "cam.dat"
    file.write_text(text)
    with pytest.raises(cs.InputError, match=message):
        read_calibration(file, name)
