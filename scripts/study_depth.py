"""How often intervals from one depth image hold the truth, and how well it tells E, by twins.

A bar of 120 x 30 x 20 mm hangs from one end. An image of it has noise of 0.15 mm that is alike over
three pixels. Where the camera is said to be, bias and scale of its depth are off by what is drawn
from their priors, and estimated; of E there is no guess. Before, images from other distances and
with other noise; and, with --starts, cameras that are said to be 20 mm and 10 degrees off.

    python scripts/study_depth.py [--twins 40] [--first 0] [--starts 8]
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.program.skin import Skin
from collocation_sysid.statistics.uncertainty import covariance

TRUTH = {"young_pa": 1.5e5, "poisson": 0.45, "gamma_r_s": 1e-3, "gamma_m_1_s": 0.1}
MATRIX, SHAPE = [[300.0, 0, 80], [0, 300.0, 60], [0, 0, 1]], (120, 160)
MIDDLE_M, WAY, NOISE_M = np.array([0.06, 0.015, -0.01]), np.array([0, -0.9, 0.44]), 1.5e-4
# Noise is along the rays; along the normals of what is seen it is so much of that.
ALONG_NORMALS = 0.65
TURN_RAD, SHIFT_M, BIAS_M, SCALE = 0.09, 0.02, 0.005, 0.005
UNKNOWN = cs.Nuisance.none(
    depth_turn_rad=TURN_RAD, depth_shift_m=SHIFT_M, depth_bias_m=BIAS_M, depth_scale=SCALE
)


def camera(distance_m: float) -> cs.DepthCamera:
    """One that looks at the middle of the bar from so far."""
    pose = np.eye(4)
    ahead = -WAY / np.linalg.norm(WAY)
    right = np.cross(ahead, [0, 0, 1]) / np.linalg.norm(np.cross(ahead, [0, 0, 1]))
    eye_m = MIDDLE_M - distance_m * ahead
    pose[:3] = np.column_stack([right, np.cross(ahead, right), ahead, eye_m])
    return cs.DepthCamera(MATRIX, pose=pose)


def bar(depth: cs.Depth) -> cs.Experiment:
    """The bar at rest, with what a camera sees of it."""
    body = cs.Body(BODY, density_kg_m3=1070.0, element="tet10")
    held = cs.Grasp(np.flatnonzero(body.nodes_m[:, 0] < 1e-9), cs.PoseSequence.fixed())
    return cs.Experiment(body, [0.0], [held], kind="static", depths=[depth], nuisance=UNKNOWN)


BODY = cs.box_mesh((0.12, 0.03, 0.02), (4, 1, 1))


def image_m(seen_by: cs.DepthCamera) -> np.ndarray:
    """Without noise."""
    depth = cs.Depth("none", [0.0], [np.zeros((1, 3))], 1e-3)
    experiment = bar(depth)
    x, skin = cs.simulate(experiment, TRUTH).positions_m[0], Skin.of(experiment.body, depth)
    rotations, translations = seen_by.motion([0.0])
    triangles = (skin.triangles(x[skin.nodes]) - translations[0]) @ rotations[0]
    return cs.depth_image(seen_by, SHAPE, triangles)


def off(camera: cs.DepthCamera, turn_rad: np.ndarray, shift_m: np.ndarray) -> cs.DepthCamera:
    """It, said to be turned about the middle of the bar and shifted."""
    pose, turn = camera.pose.copy(), Rotation.from_rotvec(turn_rad).as_matrix()
    pose[:3, :3] = turn @ pose[:3, :3]
    pose[:3, 3] = turn @ (pose[:3, 3] - MIDDLE_M) + MIDDLE_M + shift_m
    return cs.DepthCamera(MATRIX, pose=pose)


def fitted(
    rng: np.random.Generator,
    distance_m: float = 0.33,
    noise_m: float = NOISE_M,
    pose: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """E over the truth, the ends of its interval over that, and the RMS of the points [mm].

    What the camera is off by is drawn from its priors, but for a turn and a shift given.
    """
    seen_by = camera(distance_m)
    noise = gaussian_filter(rng.normal(size=SHAPE), 1.2)
    image = image_m(seen_by) * (1 + SCALE * rng.normal()) + BIAS_M * rng.normal()
    image += noise_m * noise / noise.std()
    turn_rad, shift_m = pose or (TURN_RAD * rng.normal(size=3), SHIFT_M * rng.normal(size=3))
    said = off(seen_by, turn_rad, shift_m)
    sigma_m = ALONG_NORMALS * noise_m
    depth = cs.Depth.of_images("front", image, said, sigma_m, spacing_m=0.004)
    unknown = {**TRUTH, "young_pa": cs.Unknown()}
    solution = cs.solve(cs.Problem([bar(depth)], cs.Parameters.of(unknown)))
    bars = covariance(solution.collocation, solution.z).estimates["young_pa"]
    low, high = bars.statistical95 or (0.0, np.inf)
    (part,) = solution.collocation.parts(solution.z)
    (reading,) = part.segment.depths
    rms_mm = 1e3 * np.sqrt(np.nanmean(reading.apart_m(part.looked[-1], part.phi) ** 2))
    return np.append(np.array([bars.value, low, high]) / TRUTH["young_pa"], rms_mm)


def holds(seed: int) -> bool:
    """Whether the interval of a twin holds the truth."""
    _, low, high, _ = fitted(np.random.default_rng(seed))
    return low < 1.0 < high


def started(seed: int) -> np.ndarray:
    """The same from a camera that is said to be 20 mm and 10 degrees off, whichever way."""
    rng = np.random.default_rng(seed)
    ways = rng.normal(size=(2, 3))
    axis, way = ways / np.linalg.norm(ways, axis=1)[:, None]
    return fitted(rng, pose=(np.radians(10) * axis, 0.02 * way))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--twins", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--starts", type=int, default=0)
    options = parser.parse_args()
    for k in range(options.starts):
        value, low, high, rms_mm = started(k)
        print(f"start {k}: E {value:.3f}, {low:.3f} to {high:.3f}, RMS {rms_mm:.3f} mm", flush=True)
    for distance_m, noise_m in ((0.25, NOISE_M), (0.33, NOISE_M), (0.6, NOISE_M), (0.33, 1e-3)):
        nothing = np.zeros(3), np.zeros(3)
        value, low, high, _ = fitted(np.random.default_rng(0), distance_m, noise_m, nothing)
        print(
            f"{distance_m} m, {1e3 * noise_m:.2g} mm: E {value:.3f}, {low:.3f} to {high:.3f}",
            flush=True,
        )
    found = []
    for k in range(options.first, options.first + options.twins):
        found.append(fitted(np.random.default_rng(k)))
        value, low, high, rms_mm = np.array(found).T
        count = int(np.sum((low < 1) & (high > 1)))
        width = np.median(np.log(high / low)) / (2 * 1.96)
        print(
            f"{count} of {len(found)}, scatter {np.std(np.log(value)):.4f}, interval's deviation "
            f"{width:.4f}, last {value[-1]:.3f} with RMS {rms_mm[-1]:.3f} mm",
            flush=True,
        )


if __name__ == "__main__":
    main()
