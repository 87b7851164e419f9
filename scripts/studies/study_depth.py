"""Depth images without an initial guess: E of a soft bar from one image, for twins.

A soft, clamped bar of 120 x 30 x 20 mm and 25 kPa sags by 96 mm. Each image has 320 x 240 pixels and
white noise of 0.4 mm; the true pose of the camera differs from image to image, and the stated pose
is wrong by 2.7 degrees and 8 mm. Each twin is solved without a guess and from the truth; the loss,
the intervals and the verdict are printed.

    python scripts study_depth [--twins 30]
"""

from __future__ import annotations

from functools import cache

import numpy as np
from depth_twins import upright_pose
from scipy.spatial.transform import Rotation
from script_arguments import make_parser

import collocation_sysid as cs
from collocation_sysid.program.depth.visible_surface import VisibleSurface
from collocation_sysid.runs.several_starts import SAME_LOSS, robust_loss

SOFT_TRUTH = {"young_pa": 2.5e4, "poisson": 0.45, "gamma_r_s": 1e-3, "gamma_m_1_s": 0.1}
# Camera matrix and image shape (rows, columns) [px].
SOFT_MATRIX = [[420.0, 0, 160], [0, 420.0, 120], [0, 0, 1]]
SOFT_SHAPE_PX = (240, 320)
# Point of the bar at which the camera looks [m], direction from there to the camera, and distance.
SOFT_CENTRE_M = np.array([0.045, 0.015, -0.04])
SOFT_VIEW_DIRECTION = np.array([0, -0.9, 0.35])
SOFT_DISTANCE_M = 0.4
# Standard deviation of the noise along the rays [m].
SOFT_NOISE_M = 4e-4
# Errors of the stated pose: rotation and shift, in random directions.
SOFT_TURN_RAD = np.radians(2.7)
SOFT_SHIFT_M = 0.008
# Standard deviations of the true pose of the camera between images.
TRUE_TURN_RAD = np.radians(1.0)
TRUE_SHIFT_M = 0.003
# Number of parts of each edge of a face for the rendered images; with 4 parts, chords in place of
# arcs would make E 1.5 % too large.
SOFT_DIVISIONS = 12


@cache
def soft_body() -> cs.Body:
    """Return the soft bar, which has a finer mesh; cached."""
    mesh = cs.box_mesh((0.12, 0.03, 0.02), (6, 2, 1))
    return cs.Body(mesh, density_kg_m3=1070.0, element="tet10")


def soft_experiment(depth: cs.Depth) -> cs.Experiment:
    """Return the experiment of the soft bar with the default nuisance parameters."""
    body = soft_body()
    clamp = cs.Grasp(np.flatnonzero(body.nodes_m[:, 0] < 1e-9), cs.PoseSequence.fixed())
    return cs.Experiment(body, [0.0], [clamp], kind="static", depths=[depth])


def soft_camera(turn_rad: np.ndarray, shift_m: np.ndarray) -> cs.DepthCamera:
    """Return the camera of the soft bar, rotated about a point of the bar and shifted [rad, m]."""
    optical_axis = -SOFT_VIEW_DIRECTION / np.linalg.norm(SOFT_VIEW_DIRECTION)
    pose = upright_pose(SOFT_CENTRE_M - SOFT_DISTANCE_M * optical_axis, optical_axis)
    rotation = Rotation.from_rotvec(turn_rad).as_matrix()
    pose[:3, :3] = rotation @ pose[:3, :3]
    pose[:3, 3] = rotation @ (pose[:3, 3] - SOFT_CENTRE_M) + SOFT_CENTRE_M + shift_m
    return cs.DepthCamera(SOFT_MATRIX, pose=pose)


@cache
def soft_shape_m() -> np.ndarray:
    """Return the positions (n, 3) of the nodes of the hanging soft bar [m]; cached."""
    no_points = cs.Depth("none", [0.0], [np.zeros((1, 3))], 1e-3)
    return cs.simulate(soft_experiment(no_points), SOFT_TRUTH).positions_m[0]


def soft_image_m(true_camera: cs.DepthCamera) -> np.ndarray:
    """Return the image of the soft bar without noise [m]; NaN where the bar is not visible."""
    no_points = cs.Depth("none", [0.0], [np.zeros((1, 3))], 1e-3)
    surface = VisibleSurface.from_body(soft_body(), no_points)
    rotations, translations = true_camera.pose_at([0.0])
    triangles_m = surface.subdivided_triangles(soft_shape_m()[surface.nodes], SOFT_DIVISIONS)
    return cs.depth_image(
        true_camera, SOFT_SHAPE_PX, (triangles_m - translations[0]) @ rotations[0]
    )


def soft_problem(seed: int, guess_pa: float | None = None) -> cs.Problem:
    """Return the problem of one noisy image of the soft bar.

    The true pose of the camera differs between seeds, so that the rounding of edges to pixels
    differs between images; so does the error of the stated pose. Without `guess_pa`, E has no
    guess.
    """
    rng = np.random.default_rng(seed)
    noise_m = SOFT_NOISE_M * rng.normal(size=SOFT_SHAPE_PX)
    rotation_axis, direction = rng.normal(size=(2, 3))
    turn_rad = TRUE_TURN_RAD * rng.normal(size=3)
    shift_m = TRUE_SHIFT_M * rng.normal(size=3)
    image_m = soft_image_m(soft_camera(turn_rad, shift_m)) + noise_m
    camera = soft_camera(
        turn_rad + SOFT_TURN_RAD * rotation_axis / np.linalg.norm(rotation_axis),
        shift_m + SOFT_SHIFT_M * direction / np.linalg.norm(direction),
    )
    depth = cs.Depth.of_images("front", image_m, camera, SOFT_NOISE_M, spacing_m=0.004)
    unknown = cs.Unknown() if guess_pa is None else cs.Unknown(guess_pa)
    parameters = cs.Parameters.from_mapping({**SOFT_TRUTH, "young_pa": unknown})
    return cs.Problem([soft_experiment(depth)], parameters)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--twins", type=int, default=30)
    truth_pa = SOFT_TRUTH["young_pa"]
    found = []
    for seed in range(parser.parse_args().twins):
        answer = cs.run(soft_problem(seed), seek_causes=False)
        loss = robust_loss(answer.solution)
        loss_from_truth = robust_loss(cs.solve(soft_problem(seed, truth_pa)))
        estimate = answer.estimates["young_pa"]
        intervals = [
            each or (0.0, np.inf) for each in (estimate.combined95, estimate.statistical95)
        ]
        contained = [low < truth_pa < high for low, high in intervals]
        found.append((estimate.value / truth_pa, *contained, loss < loss_from_truth + SAME_LOSS))
        ends = [f"{low / truth_pa:.3f} to {high / truth_pa:.3f}" for low, high in intervals]
        print(
            f"seed {seed}: E over the truth {estimate.value / truth_pa:.3f}, combined {ends[0]}, "
            f"statistical {ends[1]}, loss {loss:.1f} ({loss_from_truth:.1f} from the truth), "
            f"{answer.trust.verdict}",
            flush=True,
        )
    ratios, combined, statistical, better = np.array(found).T
    print(
        f"{combined.sum():.0f} of {len(found)} combined and {statistical.sum():.0f} statistical "
        f"intervals contain the truth; {better.sum():.0f} ended in the better optimum; E over the "
        f"truth {ratios.mean():.3f} with a standard deviation of {ratios.std():.3f}"
    )


if __name__ == "__main__":
    main()
