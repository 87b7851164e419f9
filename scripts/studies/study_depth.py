"""Accuracy of E from one depth image, and coverage of its intervals, for twins.

A bar of 120 x 30 x 20 mm hangs from one end. An image of it has noise of 0.15 mm, which is
correlated over three pixels. The stated pose of the camera, and bias and scale of its depth, have
errors that are drawn from their priors; they are estimated. E has no guess. Before the twins,
images from other distances and with other noise are identified and, with --starts, images whose
stated camera pose is wrong by 20 mm and 10 degrees.

With --hanging, the twins are images of a soft, clamped bar of 25 kPa that sags by 96 mm. Each image
has 320 x 240 pixels and white noise of 0.4 mm; the true pose of the camera differs from image to
image, and the stated pose is wrong by 2.7 degrees and 8 mm. Each twin is solved without a guess and
from the truth; the loss, the combined interval and the verdict are printed.

    python scripts study_depth [--twins 40] [--first 0] [--starts 8]
    python scripts study_depth --hanging 30 [--first 0]
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from functools import cache

import numpy as np
from depth_twins import upright_pose
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.program.depth.comparison import camera_residuals
from collocation_sysid.program.depth.visible_surface import VisibleSurface
from collocation_sysid.runs.several_starts import SAME_LOSS, robust_loss
from collocation_sysid.statistics.curved_intervals import uncertainty_at

TRUTH = {"young_pa": 1.5e5, "poisson": 0.45, "gamma_r_s": 1e-3, "gamma_m_1_s": 0.1}
# Camera matrix and image shape (rows, columns) [px].
MATRIX = [[300.0, 0, 80], [0, 300.0, 60], [0, 0, 1]]
SHAPE_PX = (120, 160)
# Point of the bar at which the camera looks [m], and direction from there to the camera.
CENTRE_M = np.array([0.06, 0.015, -0.01])
VIEW_DIRECTION = np.array([0, -0.9, 0.44])
# Standard deviation of the noise along the rays [m], and that along the surface normals over it.
NOISE_M = 1.5e-4
NORMAL_NOISE_SHARE = 0.65
# Standard deviations of the stated pose, of the bias and of the scale of the camera; also their
# priors.
TURN_RAD = 0.09
SHIFT_M = 0.02
BIAS_M = 0.005
SCALE_SHARE = 0.005
NUISANCE = cs.Nuisance.none(
    depth_turn_rad=TURN_RAD, depth_shift_m=SHIFT_M, depth_bias_m=BIAS_M, depth_scale=SCALE_SHARE
)


def camera(distance_m: float) -> cs.DepthCamera:
    """Return a camera that looks at the middle of the bar from a distance [m]."""
    optical_axis = -VIEW_DIRECTION / np.linalg.norm(VIEW_DIRECTION)
    pose = upright_pose(CENTRE_M - distance_m * optical_axis, optical_axis)
    return cs.DepthCamera(MATRIX, pose=pose)


def bar(depth: cs.Depth) -> cs.Experiment:
    """Return the experiment of the bar at rest with a depth camera."""
    body = cs.Body(BODY, density_kg_m3=1070.0, element="tet10")
    clamp = cs.Grasp(np.flatnonzero(body.nodes_m[:, 0] < 1e-9), cs.PoseSequence.fixed())
    return cs.Experiment(body, [0.0], [clamp], kind="static", depths=[depth], nuisance=NUISANCE)


BODY = cs.box_mesh((0.12, 0.03, 0.02), (4, 1, 1))


def image_m(true_camera: cs.DepthCamera) -> np.ndarray:
    """Return the depth image without noise [m]."""
    depth = cs.Depth("none", [0.0], [np.zeros((1, 3))], 1e-3)
    experiment = bar(depth)
    x = cs.simulate(experiment, TRUTH).positions_m[0]
    surface = VisibleSurface.from_body(experiment.body, depth)
    rotations, translations = true_camera.pose_at([0.0])
    triangles = (surface.subdivided_triangles(x[surface.nodes]) - translations[0]) @ rotations[0]
    return cs.depth_image(true_camera, SHAPE_PX, triangles)


def with_pose_error(
    camera: cs.DepthCamera, turn_rad: np.ndarray, shift_m: np.ndarray
) -> cs.DepthCamera:
    """Return the camera with a wrong pose: rotated about the middle of the bar, and shifted."""
    pose = camera.pose.copy()
    rotation = Rotation.from_rotvec(turn_rad).as_matrix()
    pose[:3, :3] = rotation @ pose[:3, :3]
    pose[:3, 3] = rotation @ (pose[:3, 3] - CENTRE_M) + CENTRE_M + shift_m
    return cs.DepthCamera(MATRIX, pose=pose)


def fit_image(
    rng: np.random.Generator,
    distance_m: float = 0.33,
    noise_m: float = NOISE_M,
    pose: tuple[np.ndarray, np.ndarray] | None = None,
) -> np.ndarray:
    """Return E and the ends of its interval, each divided by the true E, and the RMS of the points
    [mm].

    The errors of the camera are drawn from its priors; `pose` states rotation and shift instead.
    """
    true_camera = camera(distance_m)
    noise = gaussian_filter(rng.normal(size=SHAPE_PX), 1.2)
    image = image_m(true_camera) * (1 + SCALE_SHARE * rng.normal()) + BIAS_M * rng.normal()
    image += noise_m * noise / noise.std()
    turn_rad, shift_m = pose or (TURN_RAD * rng.normal(size=3), SHIFT_M * rng.normal(size=3))
    stated_camera = with_pose_error(true_camera, turn_rad, shift_m)
    sigma_m = NORMAL_NOISE_SHARE * noise_m
    depth = cs.Depth.of_images("front", image, stated_camera, sigma_m, spacing_m=0.004)
    unknown = {**TRUTH, "young_pa": cs.Unknown()}
    solution = cs.solve(cs.Problem([bar(depth)], cs.Parameters.from_mapping(unknown)))
    estimate = uncertainty_at(solution.collocation, solution.z).estimates["young_pa"]
    low, high = estimate.statistical95 or (0.0, np.inf)
    (part,) = solution.collocation.iterates(solution.z)
    (residual,) = camera_residuals(part.transcription)
    rms_mm = 1e3 * np.sqrt(
        np.nanmean(residual.signed_distances_m(part.observables[-1], part.phi) ** 2)
    )
    return np.append(np.array([estimate.value, low, high]) / TRUTH["young_pa"], rms_mm)


@dataclass(frozen=True)
class SoftTwin:
    """Results of one twin of the soft bar.

    Attributes
    ----------
    young_pa : float
        Estimate of E [Pa].
    low_pa, high_pa : float
        Ends of the combined interval [Pa].
    statistical_pa : (2,) tuple of float
        Ends of the statistical interval [Pa].
    loss, loss_from_truth : float
        Losses of the solves without a guess and from the true stiffness.
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
    processor_time_s: float

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
# Constants of the soft bar; their meaning is that of the constants above.
SOFT_MATRIX = [[420.0, 0, 160], [0, 420.0, 120], [0, 0, 1]]
SOFT_SHAPE_PX = (240, 320)
SOFT_CENTRE_M = np.array([0.045, 0.015, -0.04])
SOFT_VIEW_DIRECTION = np.array([0, -0.9, 0.35])
SOFT_DISTANCE_M = 0.4
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


def soft_twin(seed: int) -> SoftTwin:
    """Solve a twin of the soft bar without a guess and from the truth."""
    began_s = time.process_time()
    answer = cs.run(soft_problem(seed), seek_causes=False)
    processor_time_s = time.process_time() - began_s
    from_truth = cs.solve(soft_problem(seed, SOFT_TRUTH["young_pa"]))
    estimate = answer.estimates["young_pa"]
    low_pa, high_pa = estimate.combined95 or (0.0, np.inf)
    return SoftTwin(
        young_pa=estimate.value,
        low_pa=low_pa,
        high_pa=high_pa,
        statistical_pa=estimate.statistical95 or (0.0, np.inf),
        loss=robust_loss(answer.solution),
        loss_from_truth=robust_loss(from_truth),
        verdict=" ".join([answer.trust.verdict, *answer.trust.reasons]),
        processor_time_s=processor_time_s,
    )


def study_soft_bar(seeds: range) -> None:
    """Print the results of twins of the soft bar, and the coverage of their intervals."""
    twins = []
    for seed in seeds:
        twin = soft_twin(seed)
        twins.append(twin)
        low, high = twin.statistical_pa
        print(
            f"seed {seed}: E {1e-3 * twin.young_pa:.1f} kPa, combined {1e-3 * twin.low_pa:.1f} to "
            f"{1e-3 * twin.high_pa:.1f}, statistical {1e-3 * low:.1f} to {1e-3 * high:.1f}, loss "
            f"{twin.loss:.1f} ({twin.loss_from_truth:.1f} from the truth), {twin.processor_time_s:.0f} s, "
            f"{twin.verdict}",
            flush=True,
        )
    values = np.array([twin.young_pa for twin in twins]) / SOFT_TRUTH["young_pa"]
    print(
        f"{sum(twin.contains_truth for twin in twins)} of {len(twins)} combined and "
        f"{sum(twin.statistical_contains_truth for twin in twins)} statistical intervals contain "
        f"the truth; {sum(twin.is_better_optimum for twin in twins)} ended in the better optimum; "
        f"E over the truth {np.mean(values):.3f} with a standard deviation of {np.std(values):.3f}"
    )


def contains_truth(seed: int) -> bool:
    """Return whether the interval of a twin contains the truth."""
    _, low, high, _ = fit_image(np.random.default_rng(seed))
    return low < 1.0 < high


def fit_with_distant_pose(seed: int) -> np.ndarray:
    """Return the result of `fit_image` for a pose that is wrong by 20 mm and 10° in random
    directions.
    """
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(2, 3))
    rotation_axis, shift_direction = directions / np.linalg.norm(directions, axis=1)[:, None]
    return fit_image(rng, pose=(np.radians(10) * rotation_axis, 0.02 * shift_direction))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--twins", type=int, default=40)
    parser.add_argument("--first", type=int, default=0, help="seed of the first twin")
    parser.add_argument(
        "--starts", type=int, default=0, help="number of images with a distant stated pose"
    )
    parser.add_argument("--hanging", type=int, default=0, help="number of twins of the soft bar")
    options = parser.parse_args()
    if options.hanging:
        study_soft_bar(range(options.first, options.first + options.hanging))
        return
    for k in range(options.starts):
        value, low, high, rms_mm = fit_with_distant_pose(k)
        print(
            f"start {k}: E over truth {value:.3f}, interval {low:.3f} to {high:.3f}, "
            f"RMS distance {rms_mm:.3f} mm",
            flush=True,
        )
    for distance_m, noise_m in ((0.25, NOISE_M), (0.33, NOISE_M), (0.6, NOISE_M), (0.33, 1e-3)):
        exact_pose = np.zeros(3), np.zeros(3)
        value, low, high, _ = fit_image(np.random.default_rng(0), distance_m, noise_m, exact_pose)
        print(
            f"distance {distance_m} m, noise {1e3 * noise_m:.2g} mm: E over truth {value:.3f}, "
            f"interval {low:.3f} to {high:.3f}",
            flush=True,
        )
    fits = []
    for k in range(options.first, options.first + options.twins):
        fits.append(fit_image(np.random.default_rng(k)))
        value, low, high, rms_mm = np.array(fits).T
        count = int(np.sum((low < 1) & (high > 1)))
        width = np.median(np.log(high / low)) / (2 * 1.96)
        print(
            f"{count} of {len(fits)} intervals contain the truth, standard deviation of ln E "
            f"{np.std(np.log(value)):.4f}, "
            f"median of the stated ones {width:.4f}, last estimate over truth "
            f"{value[-1]:.3f} with RMS distance {rms_mm[-1]:.3f} mm",
            flush=True,
        )


if __name__ == "__main__":
    main()
