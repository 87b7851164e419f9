"""Alignment of a depth camera: steps of several starts at once."""

import numpy as np
from kit.depth import MATRIX, POSE, hanging, hanging_m, image_m, moved
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.model.nuisance_map import NuisanceMap
from collocation_sysid.program.depth import camera_alignment
from collocation_sysid.program.depth.camera_alignment import SLIDING, _alignment_steps
from collocation_sysid.program.depth.camera_model import DepthCameraModel
from collocation_sysid.program.depth.visible_surface import VisibleSurface


def test_steps_are_those_of_linear_least_squares():
    rng = np.random.default_rng(1)
    starts, points = 3, 40
    arms_m = rng.normal(size=(starts, points, 3))
    distances_m = 0.1 * rng.normal(size=(starts, points, 3))
    normals = rng.normal(size=(points, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    weights = rng.uniform(size=(starts, points))
    prior = np.array([11.0, 11.0, 1e6, 50.0, 50.0, 50.0])
    errors = 0.01 * rng.normal(size=(starts, 6))
    steps = _alignment_steps(arms_m, distances_m, normals, weights, prior, errors)
    for k in range(starts):
        rows = []
        right = []
        for arm, away, normal, weight in zip(
            arms_m[k], distances_m[k], normals, weights[k], strict=True
        ):
            by = np.hstack([np.cross(np.eye(3), arm).T, np.eye(3)])
            # A column of `by` is the motion of the point by a unit of one parameter.
            assert np.allclose(by[:, 1], np.cross([0, 1, 0], arm))
            rows += [weight * normal @ by, *(SLIDING * weight * by)]
            right += [weight * normal @ away, *(SLIDING * weight * away)]
        expected = np.linalg.lstsq(
            np.vstack([rows, np.diag(prior)]), -np.concatenate([right, prior * errors[k]])
        )[0]
        np.testing.assert_allclose(steps[k], expected, rtol=1e-9, atol=1e-12)


class _Camera:
    """Camera of a cloud without matrix, with a wide prior."""

    class depth:
        class camera:
            matrix = None

    pivot_m = np.array([0.1, 0.0, 0.0])

    def prior_weights(self, row):
        return np.full(3, 1.0)


def test_starts_do_not_influence_each_other():
    rng = np.random.default_rng(2)
    places = rng.uniform(size=(60, 3))
    normals = rng.normal(size=(60, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    moved = Rotation.from_rotvec([0.05, -0.02, 0.03]).apply(places) + 0.02
    cloud = camera_alignment.ExactCloud(moved)
    starts = [
        camera_alignment.AlignedPose(Rotation.from_rotvec(turn), np.zeros(3))
        for turn in ([0, 0, 0], [0.1, 0, 0], [0, -0.1, 0])
    ]

    def aligned(some):
        return camera_alignment.iterate_alignments(
            _Camera(),
            cloud,
            places=places,
            normals=normals,
            gates=np.geomspace(0.5, 0.02, 12),
            starts=some,
        )

    together = aligned(starts)
    for start, each in zip(starts, together, strict=True):
        (alone,) = aligned([start])
        np.testing.assert_allclose(
            each.rotation.as_rotvec(), alone.rotation.as_rotvec(), atol=1e-12
        )
        np.testing.assert_allclose(each.translation_m, alone.translation_m, atol=1e-12)
        assert abs(each.mismatch - alone.mismatch) < 1e-12
    # The cloud is the surface, moved: the alignment undoes that.
    np.testing.assert_allclose(together[0].rotation.as_rotvec(), [-0.05, 0.02, -0.03], atol=2e-3)


def test_points_of_a_gridded_cloud_are_nearly_the_nearest():
    rng = np.random.default_rng(3)
    points = rng.uniform(size=(200, 3))
    cell = 0.05
    gridded = camera_alignment.GriddedCloud(points, cell_m=cell, margin_m=0.3)
    exact = camera_alignment.ExactCloud(points)
    places = rng.uniform(-0.3, 1.3, size=(40, 10, 3))
    distances = [
        np.linalg.norm(points[cloud.nearest(places)] - places, axis=2) for cloud in (gridded, exact)
    ]
    assert np.all(distances[0] <= distances[1] + 2 * np.sqrt(3) * cell)
    # Beyond the grid as well, there is a point.
    assert exact.nearest(places + 5).shape == gridded.nearest(places + 5).shape


def test_poses_that_hardly_differ_count_once():
    def pose(turn, shift_m, mismatch):
        return camera_alignment.AlignedPose(
            Rotation.from_rotvec(turn), np.array(shift_m), mismatch=mismatch
        )

    best = pose([0.1, 0, 0], [0, 0, 0.01], 0.1)
    near = pose([0.1, 0.002, 0], [0, 0, 0.0105], 0.2)
    turned = pose([0.2, 0, 0], [0, 0, 0.01], 0.3)
    beside = pose([0.1, 0, 0], [0.005, 0, 0.01], 0.4)
    kept = camera_alignment.distinct_poses([beside, near, turned, best], size_m=0.1, same_m=0.002)
    assert kept == [best, turned, beside]


def displacement_m(rng: np.random.Generator) -> float:
    """RMS distance of the points of an image from their true places after an alignment of a camera
    whose stated pose is off by some degrees and centimetres.
    """
    pose = moved(0.09 * rng.normal(size=3), 0.02 * rng.normal(size=3))
    depth = cs.Depth.of_images("front", image_m(), cs.DepthCamera(MATRIX, pose=pose), 1e-4)
    experiment = hanging((depth,))
    nuisance = NuisanceMap.from_experiment(experiment)
    camera = DepthCameraModel.from_experiment(experiment, 0, nuisance=nuisance)
    turn, shift_m = camera_alignment.align_camera(
        camera, VisibleSurface.from_body(experiment.body, depth), x=hanging_m(), image=0
    )
    phi = camera.with_pose(np.zeros(nuisance.size), turn, shift_m=shift_m)
    points_m = depth.points_m[0]
    true_m = points_m @ POSE[:3, :3].T + POSE[:3, 3]
    way_m = camera.world_points(phi, 0) - true_m
    return float(np.sqrt(np.mean(np.sum(way_m**2, axis=1))))


def test_merging_of_starts_leaves_alignments_as_accurate(monkeypatch):
    """Poses slide along the bar, so that single alignments end elsewhere."""
    seeds = range(10)
    merged_m = [displacement_m(np.random.default_rng(k)) for k in seeds]
    monkeypatch.setattr(camera_alignment, "SAME_POSE", 0.0)
    every_m = [displacement_m(np.random.default_rng(k)) for k in seeds]
    assert np.mean(merged_m) < 1.05 * np.mean(every_m)
    assert np.max(merged_m) < 0.004
