"""Time of the search with one depth image of 18,900 points, compared with that with ten markers.

A bar of 875 nodes hangs from one end. Its Young's modulus has no guess, and the pose, bias and
scale of the camera are estimated. Both are solved in turn, in separate processes on one thread, so
that other work on the machine slows both. The output has the smallest processor times of `solve`,
without imports and the reading of data, and their ratio.

    python scripts benchmark_depth [--rounds 3]
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np

import collocation_sysid as cs

TRUTH = {"young_pa": 1.5e5, "poisson": 0.45, "gamma_r_s": 1e-3, "gamma_m_1_s": 0.1}
# Edges of the bar [m], and numbers of cells along them.
SIZE_M = (0.12, 0.03, 0.02)
CELLS = (24, 4, 6)
# Image shape (rows, columns) and focal length [px]; with these about 18,900 points are on the bar.
SHAPE_PX = (480, 640)
FOCAL_PX = 750.0
# Noise of the image and of the markers [m].
NOISE_M = 1e-4
MARKER_COUNT = 10
# Smallest distance of two points that are used [m]: about that of the pixels, so that few are
# omitted.
SPACING_M = 4e-4
KINDS = ("markers", "depth")


def main() -> None:
    """Measure and print, or solve once with --solve."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--solve", choices=KINDS)
    arguments = parser.parse_args()
    if arguments.solve:
        print(json.dumps(solve_once(arguments.solve)))
        return
    runs = {kind: [] for kind in KINDS}
    for _ in range(arguments.rounds):
        for kind, results in runs.items():
            results.append(solve_in_own_process(kind))
    best_s = {kind: min(each["spent_s"] for each in results) for kind, results in runs.items()}
    print(
        f"markers {best_s['markers']:.2f} s, {runs['depth'][0]['points']} points "
        f"{best_s['depth']:.2f} s, the latter over the former "
        f"{best_s['depth'] / best_s['markers']:.2f}"
    )


def solve_in_own_process(kind: str) -> dict:
    """Return the result of `solve_once` in a separate process on one thread."""
    environment = os.environ | {"COLLOCATION_SYSID_THREADS": "1", "OMP_NUM_THREADS": "1"}
    process = subprocess.run(
        [sys.executable, __file__, "--solve", kind],
        env=environment,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    return json.loads(process.stdout)


def solve_once(kind: str) -> dict:
    """Return the processor time of a solve [s], the estimate and the number of points."""
    experiment = make_experiment(kind)
    unknown = {**TRUTH, "young_pa": cs.Unknown()}
    problem = cs.Problem([experiment], cs.Parameters.from_mapping(unknown))
    solve = cs.solve  # the access imports the modules that it needs
    began_s = time.process_time()
    solution = solve(problem)
    processor_s = time.process_time() - began_s
    points = sum(len(p) for d in experiment.depths for p in d.points_m)
    young_pa = solution.parameters["young_pa"]
    return {"spent_s": processor_s, "young_pa": young_pa, "points": points}


def make_experiment(kind: str) -> cs.Experiment:
    """Return the hanging bar with its markers, or with one image of a camera."""
    body = cs.Body(cs.box_mesh(SIZE_M, CELLS), density_kg_m3=1070.0)
    clamp = cs.Grasp(np.flatnonzero(body.nodes_m[:, 0] < 1e-9), cs.PoseSequence.fixed())
    rng = np.random.default_rng(0)
    places_m = body.nodes_m[np.linspace(0, len(body.nodes_m) - 1, MARKER_COUNT + 1).astype(int)[1:]]
    markers = cs.Markers(np.zeros(1), np.zeros((1, MARKER_COUNT, 3)), NOISE_M, places_m=places_m)
    experiment = cs.Experiment(
        body, [0.0], [clamp], markers, kind="static", nuisance=cs.Nuisance.none()
    )
    motion = cs.simulate(experiment, TRUTH)
    if kind == "markers":
        positions_m = motion.markers_m + NOISE_M * rng.normal(size=motion.markers_m.shape)
        return replace(experiment, markers=replace(markers, positions_m=positions_m))
    x = motion.positions_m[0]
    corners_m = x[body.mesh.surface]
    camera = camera_at(x.mean(axis=0))
    rotations, translations = camera.pose_at([0.0])
    image_m = cs.depth_image(camera, SHAPE_PX, (corners_m - translations[0]) @ rotations[0])
    image_m += NOISE_M * rng.normal(size=SHAPE_PX)
    unknown = cs.Nuisance.none(
        depth_turn_rad=0.09, depth_shift_m=0.02, depth_bias_m=0.005, depth_scale=0.005
    )
    depth = cs.Depth.of_images("front", image_m, camera, NOISE_M, spacing_m=SPACING_M)
    return cs.Experiment(body, [0.0], [clamp], kind="static", depths=[depth], nuisance=unknown)


def camera_at(centre_m: np.ndarray) -> cs.DepthCamera:
    """Return a camera that looks at a point (3,) [m] from the side and from above."""
    optical_axis = np.array([0.0, 0.9, -0.44])
    optical_axis /= np.linalg.norm(optical_axis)
    right = np.cross(optical_axis, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.column_stack(
        [right, np.cross(optical_axis, right), optical_axis, centre_m - 0.33 * optical_axis]
    )
    height, width = SHAPE_PX
    matrix = [[FOCAL_PX, 0, width / 2], [0, FOCAL_PX, height / 2], [0, 0, 1]]
    return cs.DepthCamera(matrix, pose=pose)


if __name__ == "__main__":
    main()
