"""The effect of noise of the poses on measurements, and its assessment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.problems import GUESS, TRUTH, hung_cube
from scipy.spatial.transform import Rotation

from collocation_sysid.program.collocation import Collocation
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import Grasp, Nuisance, PoseSequence
from collocation_sysid.recording.poses import Interpolation
from collocation_sysid.statistics.linearised import linearise_fit
from collocation_sysid.statistics.pose_noise import estimate_pose_noise, with_pose_noise

# So small that all is linear, and markers as exact, so that it counts.
SIGMA_M, SIGMA_RAD = 1e-7, 1e-6


def perturbed(poses: PoseSequence, shifts_m: np.ndarray, turns_rad: np.ndarray) -> PoseSequence:
    """Poses that are off by shifts and, about their own position, turns, both (m, 3)."""
    turned = Rotation.from_rotvec(turns_rad) * Rotation.from_quat(poses.quaternions_xyzw)
    return replace(
        poses, positions_m=poses.positions_m + shifts_m, quaternions_xyzw=turned.as_quat()
    )


def precise(nuisance: Nuisance, interpolation: Interpolation, scheme: str) -> Collocation:
    """A hung cube whose poses come at twice the rate of the samples."""
    cube = hung_cube(12)
    (grasp,) = cube.grasps
    t_s = np.linspace(cube.t_s[0], cube.t_s[-1], 2 * len(cube.t_s) - 1)
    matrices = np.tile(np.eye(4), (len(t_s), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = grasp.poses.at(t_s)
    poses = PoseSequence.from_matrices(t_s, matrices, interpolation)
    held = Grasp(grasp.nodes, poses, sigma_m=SIGMA_M, sigma_rad=SIGMA_RAD)
    markers = replace(cube.markers, sigma_m=np.full(len(cube.markers.names), SIGMA_M))
    cube = replace(cube, grasps=(held,), markers=markers, nuisance=nuisance)
    return Collocation([cube], GUESS.with_guess(TRUTH), scheme)


def reading(of: Collocation, poses: PoseSequence, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the markers read with other poses at the truth and φ, and the positions (N, 3n)."""
    (experiment,) = of.experiments
    (grasp,) = experiment.grasps
    moved = replace(experiment, grasps=(replace(grasp, poses=poses),))
    (transcription,) = replace(of, experiments=(moved,)).transcriptions
    motion = simulate(transcription.corrected_experiment(phi), TRUTH, of.scheme, substeps=1)
    positions = motion.positions_m.reshape(len(motion.positions_m), -1)
    return transcription.markers.predict_positions(positions, phi), positions


@pytest.mark.parametrize("scheme", ["midpoint", "bdf2"])
@pytest.mark.parametrize("interpolation", ["smooth", "linear", "hold"])
@pytest.mark.parametrize("nuisance", [Nuisance.none(), Nuisance()], ids=["ideal", "usual"])
def test_draws_are_how_readings_follow_poses(nuisance, interpolation, scheme):
    of = precise(nuisance, interpolation, scheme)
    (experiment,), (transcription,) = of.experiments, of.transcriptions
    poses = experiment.grasps[0].poses
    phi = 0.5 * np.random.default_rng(1).normal(size=transcription.nuisance.size)
    before, positions = reading(of, poses, phi)
    z = of.pack(np.concatenate([GUESS.with_guess(TRUTH).guess_q, phi]), [positions])
    fit, (noise,) = with_pose_noise(linearise_fit(of, z), of, z, seed=0)
    draws = fit.blocks[0].disturbances
    assert (noise.sigma_m, noise.sigma_rad, noise.is_estimated) == (SIGMA_M, SIGMA_RAD, False)
    assert draws is not None
    white = np.random.default_rng(0).normal(size=(2, len(poses.t_s), 3 * len(draws)))
    white = white.reshape(2, len(poses.t_s), len(draws), 3)
    for k in (0, 7):
        shifts_m, turns_rad = (SIGMA_M * white[0, :, k], SIGMA_RAD * white[1, :, k])
        after, _ = reading(of, perturbed(poses, shifts_m, turns_rad), phi)
        change = (after - before) / SIGMA_M
        assert np.abs(draws[k] - change).max() < 0.02 * np.abs(change).max()


def swung(noise_m: float, noise_rad: float, count: int, seed: int = 0) -> PoseSequence:
    """A hand that swings at up to 2 Hz in six degrees of freedom, at 100 Hz."""
    t_s = 0.01 * np.arange(count, dtype=np.float64)
    rng = np.random.default_rng(seed)
    angles = 2 * np.pi * np.outer(t_s, [1.0, 1.5, 2.0])
    turns = Rotation.from_rotvec(0.4 * np.sin(angles + 1.0)) * Rotation.from_rotvec([3.0, 0, 0.3])
    poses = PoseSequence(t_s, 0.05 * np.sin(angles), turns.as_quat())
    white = rng.normal(size=(2, count, 3))
    return perturbed(poses, noise_m * white[0], noise_rad * white[1])


def test_a_smooth_motion_is_not_rough():
    assert estimate_pose_noise(swung(0.0, 0.0, 100)) == (0.0, 0.0)
    assert estimate_pose_noise(PoseSequence.fixed()) == (0.0, 0.0)


@pytest.mark.parametrize(("noise_m", "noise_rad"), [(5e-4, 5e-3), (2e-5, 2e-4), (5e-4, 0.0)])
def test_noise_is_judged_by_how_rough_poses_are(noise_m, noise_rad):
    found = np.mean(
        [estimate_pose_noise(swung(noise_m, noise_rad, 200, seed)) for seed in range(10)], axis=0
    )
    np.testing.assert_allclose(found, (noise_m, noise_rad), rtol=0.1)


def test_one_recording_determines_the_noise():
    found = [estimate_pose_noise(swung(5e-4, 5e-3, 100, seed)) for seed in range(40)]
    assert (np.abs(np.array(found) / (5e-4, 5e-3) - 1).std(axis=0) < 0.1).all()


def test_a_jump_is_no_noise():
    poses = swung(0.0, 0.0, 200)
    jumped = replace(poses, positions_m=poses.positions_m + 0.1 * (poses.t_s > 1.0)[:, None])
    assert estimate_pose_noise(jumped) == (0.0, 0.0)


def test_noise_that_hardly_moves_a_marker_costs_nothing():
    of = precise(Nuisance.none(), "smooth", "midpoint")
    (experiment,) = of.experiments
    coarse = replace(experiment, markers=replace(experiment.markers, sigma_m=1.0))
    coarse = replace(of, experiments=(coarse,))
    _, positions = reading(of, experiment.grasps[0].poses, np.zeros(0))
    z = coarse.pack(GUESS.with_guess(TRUTH).guess_q, [positions])
    fit, noises = with_pose_noise(linearise_fit(coarse, z), coarse, z)
    assert (fit.blocks[0].disturbances, noises) == (None, ())
