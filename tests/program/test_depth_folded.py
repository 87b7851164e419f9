"""Depth images of a body that occludes parts of itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from kit.depth import MATRIX, NOISE_M, SHAPE, looking

import collocation_sysid as cs
from collocation_sysid.model.nuisance_map import NuisanceMap
from collocation_sysid.program.depth.camera_model import DepthCameraModel
from collocation_sysid.program.depth.surface_correspondences import SurfaceCorrespondences
from collocation_sysid.program.depth.visible_surface import VisibleSurface

# A strip folded to a U that lies on its side: arms so far apart, the one behind longer.
ARM_M, BEHIND_M, APART_M, THICK_M = 0.08, 0.12, 0.02, 0.008
EYE_M = np.array([0.02, -0.3, 0.1])


def folded() -> cs.Body:
    """Its front arm at y = 0 from x = 0 on, then round, and back to x < 0 at y = 20 mm."""
    flat = cs.box_mesh((ARM_M + np.pi * APART_M / 2 + BEHIND_M, THICK_M, 0.03), (26, 1, 2))
    along, across, z = flat.points_m.T
    angle = np.clip((along - ARM_M) / (APART_M / 2), 0, np.pi)
    beyond = np.maximum(along - ARM_M - np.pi * APART_M / 2, 0)
    out = THICK_M / 2 - across + APART_M / 2
    x = np.minimum(along, ARM_M) - beyond + out * np.sin(angle)
    y = APART_M / 2 - out * np.cos(angle)
    return cs.Body(cs.TetMesh(np.column_stack([x, y, z]), flat.tetrahedra), density_kg_m3=1e3)


def seen_in(shift_m: np.ndarray, settled: bool = True) -> tuple[SurfaceCorrespondences, np.ndarray]:
    """What is taken for seen of the body if it is thought to be shifted; and its triangles."""
    body, pose = folded(), looking(EYE_M, np.array([0.02, 0.01, 0.015]))
    camera = cs.DepthCamera(MATRIX, pose=pose)
    none = cs.Depth("none", [0.0], [np.zeros((1, 3))], 1e-3)
    skin = VisibleSurface.from_body(body, none)
    x = body.nodes_m[skin.nodes]
    image_m = cs.depth_image(
        camera, SHAPE, (skin.subdivided_triangles(x, 1) - EYE_M) @ pose[:3, :3]
    )
    depth = cs.Depth.of_images("front", image_m, camera, NOISE_M, gate_m=0.03, spacing_m=0.003)
    held = cs.Grasp(np.arange(4), cs.PoseSequence.fixed())
    experiment = cs.Experiment(body, [0.0], [held], kind="static", depths=[depth])
    nuisance = NuisanceMap.from_experiment(experiment)
    view = DepthCameraModel.from_experiment(experiment, 0, nuisance)
    there = SurfaceCorrespondences.from_shapes(
        view, body, (x + shift_m)[None], np.zeros(nuisance.size), 0.03, settled
    )
    own = (skin.subdivided_triangles(x + shift_m, 1) - EYE_M) @ pose[:3, :3]
    return there, own


def test_no_point_of_a_folded_body_at_its_place_counts_as_hidden():
    sighting, _ = seen_in(np.zeros(3))
    assert sighting.excluded_counts["hidden"] == 0
    used = sighting.is_compared[0]
    assert used.sum() > 400
    counts = sighting.excluded_counts
    assert counts["grazing"] + counts["crease"] == np.sum(~used)
    feet = np.einsum("ea,eai->ei", sighting.weights[0], sighting.shapes_m[0][sighting.nodes[0]])
    seen = sighting.points[0] @ sighting.camera.depth.camera.pose[:3, :3].T + EYE_M
    assert np.linalg.norm(seen - feet, axis=1)[used].max() < 1e-6


def test_points_nearest_to_hidden_parts_are_omitted_and_counted():
    sighting, triangles = seen_in(np.array([0.0, -0.7 * APART_M, 0.0]))
    used, camera = sighting.is_compared[0], sighting.camera.depth.camera
    feet = np.einsum("ea,eai->ei", sighting.weights[0], sighting.shapes_m[0][sighting.nodes[0]])
    own = (feet - EYE_M) @ camera.pose[:3, :3]
    # By the image of the whole body, drawn triangle by triangle, the nearest in each pixel.
    fine = replace(camera, matrix=np.diag([4.0, 4, 1]) @ MATRIX)
    drawn_m = cs.depth_image(fine, (4 * SHAPE[0], 4 * SHAPE[1]), triangles)
    u, v = np.round(fine.undistorted_pixels(own)).astype(int).T
    behind = own[:, 2] > drawn_m[v, u] + 0.003
    sought, _ = seen_in(np.array([0.0, -0.7 * APART_M, 0.0]), settled=False)
    assert sought.excluded_counts["hidden"] == 0
    before = sought.is_compared[0]
    counts = sighting.excluded_counts
    assert counts["hidden"] > 100
    assert counts["hidden"] + counts["crease"] == np.sum(before & ~used)
    assert np.mean(behind[before] == ~used[before]) > 0.98
    assert used.sum() > 50


def test_hidden_points_count_once_the_shape_has_settled():
    sought, _ = seen_in(np.array([0.0, -0.7 * APART_M, 0.0]), settled=False)
    nothing = np.zeros(sought.camera.nuisance.size)
    far = sought.updated(sought.shapes_m + 0.004, nothing, np.inf)
    near = sought.updated(sought.shapes_m + 0.001, nothing, np.inf)
    assert far.excluded_counts["hidden"] == 0
    assert near.excluded_counts["hidden"] > 100
    # Where nothing moves any more, it is found once.
    same = sought.updated(sought.shapes_m, nothing, np.inf)
    assert same.excluded_counts["hidden"] > 100
    assert same.updated(sought.shapes_m, nothing, np.inf) is same
