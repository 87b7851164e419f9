"""Accuracy of E from one depth image, and coverage of its intervals, for twins.

A bar of 120 x 30 x 20 mm hangs from one end. An image of it has noise of 0.15 mm that is alike over
three pixels. Where the camera is said to be, bias and scale of its depth are off by what is drawn
from their priors, and estimated; of E there is no guess. Before, images from other distances and
with other noise; and, with --starts, cameras that are said to be 20 mm and 10 degrees off.

With --hanging, a soft bar of 25 kPa that sags by 96 mm, clamped, from one image of 320 x 240 pixels
with white noise of 0.4 mm by a camera that is somewhere else in each image, and 2.7 degrees and 8 mm
from where it is said to be: each twin is solved without a guess and from the truth, and the loss,
the combined interval and the verdict are printed.

    python scripts/study_depth.py [--twins 40] [--first 0] [--starts 8]
    python scripts/study_depth.py --hanging 30 [--first 0]
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.program.depth.depth_comparison import camera_residuals
from collocation_sysid.program.depth.visible_surface import VisibleSurface
from collocation_sysid.runs.several_starts import SAME_LOSS, robust_loss
from collocation_sysid.statistics.uncertainty import uncertainty_at

TRUTH = {
    "young_pa": 1.5e5,
    "poisson": 0.45,
    "gamma_r_s": 1e-3,
    "gamma_m_1_s": 0.1,
}
MATRIX = [[300.0, 0, 80], [0, 300.0, 60], [0, 0, 1]]
SHAPE = (120, 160)
MIDDLE_M = np.array([0.06, 0.015, -0.01])
WAY = np.array([0, -0.9, 0.44])
NOISE_M = 1.5e-4
# Noise is along the rays; along the normals of what is seen it is so much of that.
ALONG_NORMALS = 0.65
TURN_RAD = 0.09
SHIFT_M = 0.02
BIAS_M = 0.005
SCALE = 0.005
UNKNOWN = cs.Nuisance.none(
    depth_turn_rad=TURN_RAD,
    depth_shift_m=SHIFT_M,
    depth_bias_m=BIAS_M,
    depth_scale=SCALE,
)


def camera(distance_m: float) -> cs.DepthCamera:
    """Return a camera that looks at the middle of the bar from a distance [m]."""
    pose = np.eye(4)
    ahead = -WAY / np.linalg.norm(WAY)
    right = np.cross(ahead, [0, 0, 1]) / np.linalg.norm(
        np.cross(ahead, [0, 0, 1])
    )
    eye_m = MIDDLE_M - distance_m * ahead
    pose[:3] = np.column_stack([right, np.cross(ahead, right), ahead, eye_m])
    return cs.DepthCamera(MATRIX, pose=pose)


def bar(depth: cs.Depth) -> cs.Experiment:
    """The bar at rest, with what a camera sees of it."""
    body = cs.Body(BODY, density_kg_m3=1070.0, element="tet10")
    held = cs.Grasp(
        np.flatnonzero(body.nodes_m[:, 0] < 1e-9), cs.PoseSequence.fixed()
    )
    return cs.Experiment(
        body, [0.0], [held], kind="static", depths=[depth], nuisance=UNKNOWN
    )


BODY = cs.box_mesh((0.12, 0.03, 0.02), (4, 1, 1))


def image_m(seen_by: cs.DepthCamera) -> np.ndarray:
    """Return the depth image without noise [m]."""
    depth = cs.Depth("none", [0.0], [np.zeros((1, 3))], 1e-3)
    experiment = bar(depth)
    x = cs.simulate(experiment, TRUTH).positions_m[0]
    skin = VisibleSurface.from_body(experiment.body, depth)
    rotations, translations = seen_by.pose_at([0.0])
    triangles = (
        skin.subdivided_triangles(x[skin.nodes]) - translations[0]
    ) @ rotations[0]
    return cs.depth_image(seen_by, SHAPE, triangles)


def off(
    camera: cs.DepthCamera, turn_rad: np.ndarray, shift_m: np.ndarray
) -> cs.DepthCamera:
    """Return the camera with a wrong pose: rotated about the middle of the bar, and shifted."""
    pose = camera.pose.copy()
    turn = Rotation.from_rotvec(turn_rad).as_matrix()
    pose[:3, :3] = turn @ pose[:3, :3]
    pose[:3, 3] = turn @ (pose[:3, 3] - MIDDLE_M) + MIDDLE_M + shift_m
    return cs.DepthCamera(MATRIX, pose=pose)


def fitted(
    rng: np.random.Generator,
    distance_m: float = 0.33,
    noise_m: float = NOISE_M,
    pose: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Return E and the ends of its interval, each divided by the true E, and the RMS of the points [mm].

    The errors of the camera are drawn from its priors; `pose` states rotation and shift instead.
    """
    seen_by = camera(distance_m)
    noise = gaussian_filter(rng.normal(size=SHAPE), 1.2)
    image = (
        image_m(seen_by) * (1 + SCALE * rng.normal()) + BIAS_M * rng.normal()
    )
    image += noise_m * noise / noise.std()
    turn_rad, shift_m = pose or (
        TURN_RAD * rng.normal(size=3),
        SHIFT_M * rng.normal(size=3),
    )
    said = off(seen_by, turn_rad, shift_m)
    sigma_m = ALONG_NORMALS * noise_m
    depth = cs.Depth.of_images("front", image, said, sigma_m, spacing_m=0.004)
    unknown = {**TRUTH, "young_pa": cs.Unknown()}
    solution = cs.solve(
        cs.Problem([bar(depth)], cs.Parameters.from_mapping(unknown))
    )
    bars = uncertainty_at(solution.collocation, solution.z).estimates[
        "young_pa"
    ]
    low, high = bars.statistical95 or (0.0, np.inf)
    (part,) = solution.collocation.iterates(solution.z)
    (reading,) = camera_residuals(part.segment)
    rms_mm = 1e3 * np.sqrt(
        np.nanmean(
            reading.signed_distances_m(part.observables[-1], part.phi) ** 2
        )
    )
    return np.append(
        np.array([bars.value, low, high]) / TRUTH["young_pa"], rms_mm
    )


@dataclass(frozen=True)
class SoftTwin:
    """The answer to an image of the soft bar.

    Attributes
    ----------
    young_pa : float
    low_pa, high_pa : float
        Ends of the combined interval.
    statistical_pa : (2,) tuple of float
        Ends of the statistical interval.
    loss, loss_from_truth : float
        Without a guess, and from the true stiffness.
    verdict : str
    cost_s : float
        Processor time of the run without a guess.
    """

    young_pa: float
    low_pa: float
    high_pa: float
    statistical_pa: tuple[float, float]
    loss: float
    loss_from_truth: float
    verdict: str
    cost_s: float

    @property
    def contains_truth(self) -> bool:
        """Whether the combined interval contains the true stiffness."""
        return self.low_pa < SOFT_TRUTH["young_pa"] < self.high_pa

    @property
    def statistical_contains_truth(self) -> bool:
        """Whether the statistical interval contains the true stiffness."""
        low_pa, high_pa = self.statistical_pa
        return low_pa < SOFT_TRUTH["young_pa"] < high_pa

    @property
    def is_better_optimum(self) -> bool:
        """Whether the start from the truth does not lead to a noticeably lower loss."""
        return self.loss < self.loss_from_truth + SAME_LOSS


SOFT_TRUTH = {**TRUTH, "young_pa": 2.5e4}
SOFT_MATRIX = [[420.0, 0, 160], [0, 420.0, 120], [0, 0, 1]]
SOFT_SHAPE = (240, 320)
SOFT_MIDDLE_M = np.array([0.045, 0.015, -0.04])
SOFT_WAY = np.array([0, -0.9, 0.35])
SOFT_DISTANCE_M = 0.4
SOFT_NOISE_M = 4e-4
SOFT_TURN_RAD = np.radians(2.7)
SOFT_SHIFT_M = 0.008
# Standard deviations of the true pose of the camera, from image to image.
TRUE_TURN_RAD = np.radians(1.0)
TRUE_SHIFT_M = 0.003
# Parts of each side of a face that images are made of: with 4, chords in place of arcs make E 1.5 %
# too large.
SOFT_DIVISIONS = 12


@cache
def soft_body() -> cs.Body:
    """The bar of 25 kPa, with a finer mesh."""
    mesh = cs.box_mesh((0.12, 0.03, 0.02), (6, 2, 1))
    return cs.Body(mesh, density_kg_m3=1070.0, element="tet10")


def soft_experiment(depth: cs.Depth) -> cs.Experiment:
    """The bar clamped at one end, with the default nuisance parameters."""
    body = soft_body()
    held = cs.Grasp(
        np.flatnonzero(body.nodes_m[:, 0] < 1e-9), cs.PoseSequence.fixed()
    )
    return cs.Experiment(body, [0.0], [held], kind="static", depths=[depth])


def soft_camera(turn_rad: np.ndarray, shift_m: np.ndarray) -> cs.DepthCamera:
    """Return the camera of the soft bar, stated wrong by a turn about the bar and a shift."""
    pose = np.eye(4)
    ahead = -SOFT_WAY / np.linalg.norm(SOFT_WAY)
    right = np.cross(ahead, [0, 0, 1]) / np.linalg.norm(
        np.cross(ahead, [0, 0, 1])
    )
    eye_m = SOFT_MIDDLE_M - SOFT_DISTANCE_M * ahead
    pose[:3] = np.column_stack([right, np.cross(ahead, right), ahead, eye_m])
    turn = Rotation.from_rotvec(turn_rad).as_matrix()
    pose[:3, :3] = turn @ pose[:3, :3]
    pose[:3, 3] = turn @ (pose[:3, 3] - SOFT_MIDDLE_M) + SOFT_MIDDLE_M + shift_m
    return cs.DepthCamera(SOFT_MATRIX, pose=pose)


@cache
def soft_shape_m() -> np.ndarray:
    """Positions (n, 3) of the nodes of the hanging soft bar [m]."""
    nothing = cs.Depth("none", [0.0], [np.zeros((1, 3))], 1e-3)
    return cs.simulate(soft_experiment(nothing), SOFT_TRUTH).positions_m[0]


def soft_image_m(seen_by: cs.DepthCamera) -> np.ndarray:
    """Return the image of the soft bar without noise, NaN beside it."""
    nothing = cs.Depth("none", [0.0], [np.zeros((1, 3))], 1e-3)
    surface = VisibleSurface.from_body(soft_body(), nothing)
    rotations, translations = seen_by.pose_at([0.0])
    triangles_m = surface.subdivided_triangles(
        soft_shape_m()[surface.nodes], SOFT_DIVISIONS
    )
    return cs.depth_image(
        seen_by, SOFT_SHAPE, (triangles_m - translations[0]) @ rotations[0]
    )


def soft_problem(seed: int, guess_pa: float | None = None) -> cs.Problem:
    """One image of the soft bar with noise, by a camera that is off in random directions.

    Where the camera is differs from seed to seed, so that pixels round the edge of the body
    differently in each image; so does where it is said to be.
    """
    rng = np.random.default_rng(seed)
    noise_m = SOFT_NOISE_M * rng.normal(size=SOFT_SHAPE)
    axis, way = rng.normal(size=(2, 3))
    turn_rad = TRUE_TURN_RAD * rng.normal(size=3)
    shift_m = TRUE_SHIFT_M * rng.normal(size=3)
    image_m = soft_image_m(soft_camera(turn_rad, shift_m)) + noise_m
    camera = soft_camera(
        turn_rad + SOFT_TURN_RAD * axis / np.linalg.norm(axis),
        shift_m + SOFT_SHIFT_M * way / np.linalg.norm(way),
    )
    depth = cs.Depth.of_images(
        "front", image_m, camera, SOFT_NOISE_M, spacing_m=0.004
    )
    unknown = cs.Unknown() if guess_pa is None else cs.Unknown(guess_pa)
    parameters = cs.Parameters.from_mapping({**SOFT_TRUTH, "young_pa": unknown})
    return cs.Problem([soft_experiment(depth)], parameters)


def soft_twin(seed: int) -> SoftTwin:
    """Solve a twin of the soft bar without a guess and from the truth."""
    began_s = time.process_time()
    found = cs.run(soft_problem(seed), seek_causes=False)
    cost_s = time.process_time() - began_s
    known = cs.solve(soft_problem(seed, SOFT_TRUTH["young_pa"]))
    estimate = found.estimates["young_pa"]
    low_pa, high_pa = estimate.combined95 or (0.0, np.inf)
    return SoftTwin(
        young_pa=estimate.value,
        low_pa=low_pa,
        high_pa=high_pa,
        statistical_pa=estimate.statistical95 or (0.0, np.inf),
        loss=robust_loss(found.solution),
        loss_from_truth=robust_loss(known),
        verdict=" ".join([found.trust.verdict, *found.trust.reasons]),
        cost_s=cost_s,
    )


def study_soft_bar(seeds: range) -> None:
    """Print the answers to twins of the soft bar, and how often they are right."""
    twins = []
    for seed in seeds:
        twin = soft_twin(seed)
        twins.append(twin)
        low, high = twin.statistical_pa
        print(
            f"seed {seed}: E {1e-3 * twin.young_pa:.1f} kPa, combined {1e-3 * twin.low_pa:.1f} to "
            f"{1e-3 * twin.high_pa:.1f}, statistical {1e-3 * low:.1f} to {1e-3 * high:.1f}, loss "
            f"{twin.loss:.1f} ({twin.loss_from_truth:.1f} from the truth), {twin.cost_s:.0f} s, "
            f"{twin.verdict}",
            flush=True,
        )
    values = (
        np.array([twin.young_pa for twin in twins]) / SOFT_TRUTH["young_pa"]
    )
    print(
        f"{sum(twin.contains_truth for twin in twins)} of {len(twins)} combined and "
        f"{sum(twin.statistical_contains_truth for twin in twins)} statistical intervals contain "
        f"the truth; {sum(twin.is_better_optimum for twin in twins)} ended in the better optimum; "
        f"E over the truth {np.mean(values):.3f} with a scatter of {np.std(values):.3f}"
    )


def holds(seed: int) -> bool:
    """Whether the interval of a twin holds the truth."""
    _, low, high, _ = fitted(np.random.default_rng(seed))
    return low < 1.0 < high


def started(seed: int) -> np.ndarray:
    """Return the result of `fitted` for a camera pose that is wrong by 20 mm and 10° at random."""
    rng = np.random.default_rng(seed)
    ways = rng.normal(size=(2, 3))
    axis, way = ways / np.linalg.norm(ways, axis=1)[:, None]
    return fitted(rng, pose=(np.radians(10) * axis, 0.02 * way))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--twins", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--starts", type=int, default=0)
    parser.add_argument("--hanging", type=int, default=0)
    options = parser.parse_args()
    if options.hanging:
        study_soft_bar(range(options.first, options.first + options.hanging))
        return
    for k in range(options.starts):
        value, low, high, rms_mm = started(k)
        print(
            f"start {k}: E {value:.3f}, {low:.3f} to {high:.3f}, RMS {rms_mm:.3f} mm",
            flush=True,
        )
    for distance_m, noise_m in (
        (0.25, NOISE_M),
        (0.33, NOISE_M),
        (0.6, NOISE_M),
        (0.33, 1e-3),
    ):
        nothing = np.zeros(3), np.zeros(3)
        value, low, high, _ = fitted(
            np.random.default_rng(0), distance_m, noise_m, nothing
        )
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
