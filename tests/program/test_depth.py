"""Depth images and point clouds: reading, identification and uncertainty."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest
from kit.depth import (
    BIAS_M,
    MATRIX,
    NOISE_M,
    NOTHING,
    POSE,
    PROBLEM,
    SHAPE,
    TRUTH,
    bar,
    camera_residuals,
    fitted,
    hanging,
    hanging_m,
    image_m,
    moved,
    noisy,
)
from PIL import Image

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.model.nuisance_map import NuisanceMap
from collocation_sysid.program.depth.camera_model import DepthCameraModel
from collocation_sysid.program.depth.surface_correspondences import SurfaceCorrespondences
from collocation_sysid.recording.depth_camera import points_from_image
from collocation_sysid.recording.sources.depth_files import read_depth
from collocation_sysid.statistics.pose_noise import uncertainty_at


@pytest.mark.long
def test_stiffness_is_found_with_the_camera_20_mm_and_10_degrees_off(rng):
    axis, way = np.array([0.1, 0.8, -0.6]), np.array([0.5, 0.6, 0.6])
    pose = moved(np.radians(10) * axis / np.linalg.norm(axis), 0.02 * way / np.linalg.norm(way))
    solution = fitted(noisy(rng), pose)
    assert abs(solution.parameters["young_pa"] / TRUTH["young_pa"] - 1) < 0.05
    (part,) = solution.collocation.iterates(solution.z)
    (reading,) = camera_residuals(part.transcription)
    apart = reading.signed_distances_m(part.observables[-1], part.phi)
    assert np.sqrt(np.nanmean(apart**2)) < 2e-4
    bars = uncertainty_at(solution.collocation, solution.z).estimates["young_pa"]
    low, high = bars.statistical95
    assert low < TRUTH["young_pa"] < high < 1.2 * low


@pytest.mark.parametrize(
    ("axis", "way"),
    [((0.61, -0.71, 0.36), (-0.54, 0.48, -0.7)), ((0.83, 0.31, 0.46), (-0.09, 0.53, -0.84))],
)
def test_a_camera_sees_the_faces_turned_to_its_estimated_place(axis, way, rng):
    """Not to where it is said to be: 20 mm and 10 degrees off, it would not see the bar's top."""
    camera = cs.DepthCamera(
        MATRIX, pose=moved(np.radians(10) * np.array(axis), 0.02 * np.array(way))
    )
    depth = cs.Depth.of_images("front", noisy(rng), camera, NOISE_M, spacing_m=0.004)
    experiment = hanging((depth,))
    nuisance = NuisanceMap.from_experiment(experiment)
    view, nothing = (
        DepthCameraModel.from_experiment(experiment, 0, nuisance),
        np.zeros(nuisance.size),
    )
    sighting = SurfaceCorrespondences.from_alignment(view, bar(), hanging_m()[None], nothing)
    assert sighting.gate_m == depth.gate_m
    assert sighting.is_compared.sum() > 0.95 * len(depth.points_m[0])


@pytest.mark.long
def test_pixels_beside_the_body_are_omitted_and_counted(rng):
    image = noisy(rng)
    image[:20] = 0.34  # a wall above the bar, nearer than it
    solution = fitted(image, POSE)
    (sighting,) = solution.collocation.transcriptions[0].association.correspondences
    assert sighting.excluded_counts["far"] > 20
    assert abs(solution.parameters["young_pa"] / TRUTH["young_pa"] - 1) < 0.05


def test_a_point_whose_normal_is_turned_from_that_of_the_surface_is_left_out():
    camera = cs.DepthCamera(MATRIX, pose=POSE)
    depth = cs.Depth.of_images("front", image_m(), camera, NOISE_M, spacing_m=0.004)

    def sighting(depth: cs.Depth) -> SurfaceCorrespondences:
        experiment = hanging((depth,))
        nuisance = NuisanceMap.from_experiment(experiment)
        view = DepthCameraModel.from_experiment(experiment, 0, nuisance)
        return SurfaceCorrespondences.from_shapes(
            view, bar(), hanging_m()[None], np.zeros(nuisance.size), depth.gate_m
        )

    plain = sighting(depth)
    used, normals = plain.is_compared[0], plain.normals[0] @ POSE[:3, :3]
    cloud = np.hstack([plain.points[0], normals])[used]
    cloud[:20, 3:] *= -1  # of another body, as close
    turned = sighting(replace(depth, clouds=[cloud]))
    assert turned.excluded_counts["turned away"] == 20
    assert turned.is_compared.sum() == len(cloud) - 20 > 100


@pytest.mark.long
def test_an_interior_point_method_finds_the_same(rng):
    image = noisy(rng)
    reduced = fitted(image, POSE)
    unknown = {**TRUTH, "young_pa": cs.Unknown(1.05 * reduced.parameters["young_pa"])}
    seen = reduced.collocation.experiments
    other = cs.solve(cs.Problem(seen, cs.Parameters.from_mapping(unknown), method="interior-point"))
    assert other.status.converged
    assert abs(other.parameters["young_pa"] / reduced.parameters["young_pa"] - 1) < 5e-3


def test_pixels_at_edges_and_without_depth_are_left_out():
    image = np.full((8, 10), 0.5)
    image[:, 5:] = 0.6
    image[3, 2] = 0.0
    points = points_from_image(image, cs.DepthCamera([[100, 0, 5], [0, 100, 4], [0, 0, 1]]))
    # Rows 1 to 6, columns 1 to 8, without both beside the jump, nor the hole and its neighbours.
    assert len(points) == 6 * 6 - 5
    assert set(points[:, 2]) == {0.5, 0.6}


def test_a_lens_bends_the_rays_as_its_distortion_says():
    camera = cs.DepthCamera(MATRIX, distortion=[0.1, -0.02, 1e-3, 2e-3])
    x, y, _ = camera.points_at_unit_depth(np.array([[20.0, 100.0]]))[0]
    r2 = x * x + y * y
    radial = 1 + 0.1 * r2 - 0.02 * r2 * r2
    u = x * radial + 2 * 1e-3 * x * y + 2e-3 * (r2 + 2 * x * x)
    v = y * radial + 1e-3 * (r2 + 2 * y * y) + 2 * 2e-3 * x * y
    np.testing.assert_allclose([300 * u + 80, 300 * v + 60], [20, 100], atol=1e-6)


def written(folder: Path) -> dict[str, Path]:
    """One cloud of three points with normals, and an image, in all formats."""
    points, normals = np.arange(9.0).reshape(3, 3), np.tile([0.0, 0, 1], (3, 1))
    files = {kind: folder / f"cloud.{kind}" for kind in ("npy", "xyz", "ply", "pcd", "npz", "png")}
    np.save(files["npy"], np.hstack([points, normals]))
    np.savetxt(files["xyz"], points)
    columns = {f"n{axis}": normals[:, k] for k, axis in enumerate("xyz")}
    meshio.write(files["ply"], meshio.Mesh(points, [("triangle", [[0, 1, 2]])], columns))
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS 3\nDATA binary\n"
    files["pcd"].write_bytes(head.encode() + points.astype("<f4").tobytes())
    np.savez(files["npz"], depth_counts=np.full((4, 5), 500), count_m=1e-3)
    Image.fromarray(np.full((4, 5), 500, dtype=np.uint16)).save(files["png"])
    return files


def test_clouds_and_images_are_read_from_every_format(tmp_path):
    for kind, file in written(tmp_path).items():
        read = read_depth(file, None, 1.0)
        if kind in ("npz", "png"):
            np.testing.assert_allclose(read.images_m, np.full((1, 4, 5), 0.5))
        else:
            (cloud,) = read.clouds_m
            assert cloud.shape == (3, 6 if kind in ("npy", "ply") else 3)
            np.testing.assert_allclose(cloud[:, :3].ravel(), np.arange(9))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("flat.npy", "expected 3 columns x, y, z"),
        ("colour.png", "16 bits"),
        ("packed.pcd", "ascii or binary"),
        ("image.tif", "expected one of"),
        ("two.npz", "expected exactly one of depth_m"),
        ("image.exr", "OpenEXR"),
    ],
)
def test_files_that_cannot_be_read_are_refused_with_a_remedy(tmp_path, monkeypatch, name, said):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)  # as where it is missing
    file = tmp_path / name
    if name == "flat.npy":
        np.save(file, np.zeros((3, 2)))
    elif name == "colour.png":
        Image.new("RGB", (4, 4)).save(file)
    elif name == "two.npz":
        np.savez(file, other=np.zeros(3))
    else:
        file.write_text("FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 1\nDATA binary_compressed\n")
    with pytest.raises(InputError, match=said):
        read_depth(file, None, 1.0)


def test_an_exr_image_is_read(tmp_path):
    library = pytest.importorskip("OpenEXR")
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}
    with library.File(header, {"Z": image_m().astype(np.float32)}) as image:
        image.write(str(tmp_path / "image.exr"))
    read = read_depth(tmp_path / "image.exr", None, 1.0)
    np.testing.assert_allclose(read.images_m[0], image_m(), rtol=1e-6)


def test_a_damaged_exr_image_gives_one_message(tmp_path, capfd):
    library, file = pytest.importorskip("OpenEXR"), tmp_path / "image.exr"
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}
    with library.File(header, {"Z": image_m().astype(np.float32)}) as image:
        image.write(str(file))
    file.write_bytes(file.read_bytes()[:308])
    with pytest.raises(InputError, match="cannot be read"):
        read_depth(file, None, 1.0)
    assert capfd.readouterr() == ("", "")


def test_a_problem_file_states_depth(tmp_path):
    bar().mesh.write(tmp_path / "bar.vtu")
    np.savez(tmp_path / "front.npz", depth_m=image_m(), camera_matrix=MATRIX, camera_pose=POSE)
    more = "spacing_m = 0.005\n[experiment.nuisance]\ndepth_pose = { prior_m = 0.01 }\n"
    text = PROBLEM.replace('name = "front"\n', "") + more
    file = tmp_path / "problem.toml"
    file.write_text(text)
    (experiment,) = cs.Problem.read(file).experiments
    (depth,) = experiment.depths
    np.testing.assert_allclose(depth.camera.pose, POSE)
    assert 100 < len(depth.points_m[0]) < 400
    assert experiment.nuisance.depth_shift_m == 0.01
    assert experiment.nuisance.depth_turn_rad is None
    file.write_text(text.replace("front.npz", "back.npz"))
    with pytest.raises(InputError, match="does not exist"):
        cs.Problem.read(file)
    camera = "camera = { matrix = [[1, 0, 0], [0, 1, 0], [0, 1, 1]] }"
    file.write_text(text.replace("spacing_m = 0.005", camera))
    with pytest.raises(InputError, match="pixels"):
        cs.Problem.read(file)


@pytest.mark.long
def test_noise_that_persists_from_image_to_image_widens_the_interval():
    """By up to √((1 + 0.9) / (1 − 0.9)) = 4.4 of many images, by less of twenty."""
    rng, widths = np.random.default_rng(0), []
    for share in (0.0, 0.9):
        noise, images = noisy(rng) - image_m(), []
        for _ in range(20):
            noise = share * noise + np.sqrt(1 - share**2) * (noisy(rng) - BIAS_M - image_m())
            images.append(image_m() + noise)
        camera, t_s = cs.DepthCamera(MATRIX, pose=POSE), np.arange(20.0)
        depth = cs.Depth.of_images("front", images, camera, NOISE_M, t_s=t_s, spacing_m=0.006)
        depth = replace(depth, background="unknown")  # outlines have their own noise
        held = cs.Grasp(np.flatnonzero(bar().nodes_m[:, 0] < 1e-9), cs.PoseSequence.fixed())
        kept = hanging((NOTHING,)).nuisance
        experiment = cs.Experiment(bar(), t_s, [held], kind="static", depths=[depth], nuisance=kept)
        unknown = {**TRUTH, "young_pa": cs.Unknown(1.6e5)}
        solution = cs.solve(cs.Problem([experiment], cs.Parameters.from_mapping(unknown)))
        low, high = (
            uncertainty_at(solution.collocation, solution.z).estimates["young_pa"].statistical95
        )
        widths.append(np.log(high / low))
    # Both autocorrelations are estimated, which moves the ratio by some percent.
    assert 2 < widths[1] / widths[0] < 5.0


def test_a_dropout_is_a_cloud_without_points():
    seen = points_from_image(image_m(), cs.DepthCamera(MATRIX))
    depth = cs.Depth("front", [0.0, 1.0], [seen, seen[:0]], 1e-3)
    assert [len(points) > 0 for points in depth.points_m] == [True, False]
    with pytest.raises(InputError, match="no point"):
        replace(depth, clouds=[seen[:0], seen[:0]])


@pytest.mark.parametrize("guess_pa", [1e5, 1.5e5])
def test_a_far_camera_is_found_from_any_guess(guess_pa):
    """Few points from a camera whose stated pose is far off have several minima."""
    pose = moved(np.array([0.15, -0.09, 0.06]), np.array([0.012, 0.006, -0.009]))
    image = image_m() + NOISE_M * np.random.default_rng(2).normal(size=SHAPE)
    depth = cs.Depth.of_images(
        "front", image, cs.DepthCamera(MATRIX, pose=pose), NOISE_M, spacing_m=0.02
    )
    unknown = TRUTH | {"young_pa": cs.Unknown(guess_pa)}
    run = cs.run(cs.Problem([hanging((depth,))], unknown), seek_causes=False)
    assert run.solution.status.converged
    assert abs(run.solution.parameters["young_pa"] / TRUTH["young_pa"] - 1) < 0.01
