"""How often intervals from one depth image hold the truth, and how well it tells E, by twins.

A bar of 120 x 30 x 20 mm hangs from one end. An image of it has noise of 0.15 mm that is alike over
three pixels, and a bias of 2 mm; where the camera is, bias and scale are estimated. Then the same
from other distances and with other noise.

    python scripts/study_depth.py [--twins 40]
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.ndimage import gaussian_filter

import collocation_sysid as cs
from collocation_sysid.program.sighting import Skin
from collocation_sysid.statistics.uncertainty import covariance

TRUTH = {"young_pa": 1.5e5, "poisson": 0.45, "gamma_r_s": 1e-3, "gamma_m_1_s": 0.1}
MATRIX, SHAPE = [[300.0, 0, 80], [0, 300.0, 60], [0, 0, 1]], (120, 160)
MIDDLE_M, WAY, BIAS_M, NOISE_M = (
    np.array([0.06, 0.015, -0.01]),
    np.array([0, -0.9, 0.44]),
    2e-3,
    1.5e-4,
)
UNKNOWN = cs.Nuisance.none(
    depth_turn_rad=0.09, depth_shift_m=0.02, depth_bias_m=0.005, depth_scale=0.005
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


def fitted(
    seed: int, distance_m: float = 0.33, noise_m: float = NOISE_M
) -> tuple[float, float, float]:
    """E over the truth, and the ends of its interval over that."""
    seen_by, noise = camera(distance_m), np.random.default_rng(seed).normal(size=SHAPE)
    noise = gaussian_filter(noise, 1.2)
    image = image_m(seen_by) + BIAS_M + noise_m * noise / noise.std()
    depth = cs.Depth.of_images("front", image, seen_by, noise_m, spacing_m=0.004)
    unknown = {**TRUTH, "young_pa": cs.Unknown(2e5)}
    solution = cs.solve(cs.Problem([bar(depth)], cs.Parameters.of(unknown)))
    bars = covariance(solution.collocation, solution.z).estimates["young_pa"]
    low, high = bars.ci95 or (0.0, np.inf)
    return tuple(np.array([bars.value, low, high]) / TRUTH["young_pa"])


def held(seed: int) -> bool:
    """Whether the interval of a twin holds the truth."""
    _, low, high = fitted(seed)
    return low < 1.0 < high


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--twins", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    for distance_m, noise_m in ((0.25, NOISE_M), (0.33, NOISE_M), (0.6, NOISE_M), (0.33, 1e-3)):
        value, low, high = fitted(0, distance_m, noise_m)
        print(
            f"{distance_m} m, {1e3 * noise_m:.2g} mm: E {value:.3f}, {low:.3f} to {high:.3f}",
            flush=True,
        )
    found = []
    for k in range(options.twins):
        found.append(fitted(options.first + k))
        count = sum(low < 1.0 < high for _, low, high in found)
        spread = np.std([value for value, *_ in found])
        print(f"{count} of {len(found)}, scatter {spread:.4f}", flush=True)


if __name__ == "__main__":
    main()
