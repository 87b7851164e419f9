"""Frames that were lost or recorded at uneven times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import AT_TRUTH, TRUTH, write_problem
from scipy.interpolate import CubicSpline

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.problem import Problem
from collocation_sysid.program.simulation import simulate
from collocation_sysid.recording import (
    MarkerTable,
    PoseSequence,
    align,
    read_markers,
    write_markers_csv,
)
from collocation_sysid.recording.alignment import assign_frames

RATE_HZ = 30.0
COUNT = 77
# Standard deviation of the jitter [s]: some 4 % of the interval, that of a camera with ROS.
JITTER_S = 1.3e-3


def even_s() -> np.ndarray:
    return 0.031 + np.arange(COUNT) / RATE_HZ


def jittered_s(seed: int = 2) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=COUNT)
    return even_s() + JITTER_S * noise


def aligned(t_s: np.ndarray, **options):
    positions = np.stack([np.stack([t_s, 0 * t_s, 0 * t_s], axis=1)], axis=1)
    table = MarkerTable(t_s, ("tip",), positions_m=positions)
    poses = [PoseSequence.fixed()]
    return align(poses, table, **options)


@pytest.mark.parametrize("lost", [[41], [7, 8, 9, 40], [*range(20, 40)]])
def test_lost_frames_are_missing_samples(lost: list[int]) -> None:
    recording = aligned(np.delete(even_s(), lost))
    np.testing.assert_allclose(recording.t_s, even_s(), atol=1e-9)
    missing = np.isnan(recording.table.positions_m[:, 0, 0])
    np.testing.assert_array_equal(np.flatnonzero(missing), lost)
    assert recording.table.offsets_s is None
    (note,) = recording.notes
    assert f"{len(lost)} of {COUNT} frames" in note
    assert "RMS" not in note


def test_jittered_frames_keep_their_times_and_positions() -> None:
    t_s = jittered_s()
    kept = np.delete(np.arange(COUNT), 41)
    recording = aligned(t_s[kept])
    table = recording.table
    assert table.offsets_s is not None
    np.testing.assert_allclose(np.diff(recording.t_s, n=2), 0, atol=1e-12)
    times = recording.t_s + table.offsets_s
    np.testing.assert_allclose(times[kept], t_s[kept], atol=1e-12)
    np.testing.assert_array_equal(table.positions_m[kept, 0, 0], t_s[kept])
    assert np.isnan(table.positions_m[41]).all()
    (note,) = recording.notes
    assert "1 of 77 frames was lost" in note
    assert "1.3 ms RMS" in note


def test_rounded_times_with_lost_frames_are_not_jitter() -> None:
    recording = aligned(np.delete(np.round(even_s(), 3), [5, 60]))
    assert recording.table.offsets_s is None
    np.testing.assert_allclose(recording.t_s, even_s(), atol=5e-4)


def test_every_counts_lost_frames() -> None:
    recording = aligned(np.delete(even_s(), 3), every=2)
    np.testing.assert_allclose(recording.t_s, even_s()[::2], atol=1e-9)
    assert np.isfinite(recording.table.positions_m).all()


def test_poses_with_the_stamps_of_jittered_frames_are_interpolated() -> None:
    t_s = jittered_s()
    positions = np.stack([t_s, t_s**2, 0 * t_s], axis=1)
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (COUNT, 1))
    poses = PoseSequence(t_s, positions, quaternions_xyzw=rotations)
    table = MarkerTable(t_s, ("tip",), positions_m=positions[:, None])
    recording = align([poses], table)
    _, shifts_m = recording.poses[0].at(recording.t_s)
    np.testing.assert_allclose(shifts_m[:, 0], recording.t_s, atol=1e-6)
    assert len(recording.t_s) == COUNT


def test_frames_without_a_common_rate_are_refused_with_a_usable_rate() -> None:
    t_s = np.sort(np.random.default_rng(0).uniform(0, 2.5, COUNT))
    assert assign_frames(t_s) is None
    with pytest.raises(InputError, match=r"no common rate.*resample_hz = \d"):
        aligned(t_s)


def test_mostly_lost_frames_are_refused() -> None:
    t_s = np.r_[even_s()[:20], even_s()[-20:]]
    with pytest.raises(InputError, match="at most 30% of them lost"):
        aligned(t_s)


# Estimates ----------------------------------------------------------------------------------------


def jittered_problem(folder: Path) -> tuple[Path, np.ndarray]:
    """The tiny problem with frames up to a quarter of an interval off and one lost, and the tracks
    that were measured, of all frames.

    The positions between samples are those of a cubic spline of the exact ones.
    """
    file = write_problem(folder, {"swing": 16})
    table = read_markers(folder / "swing_markers.csv")
    step_s = table.t_s[1] - table.t_s[0]
    rng = np.random.default_rng(5)
    offsets_s = 0.25 * step_s * rng.uniform(-1, 1, len(table.t_s))
    offsets_s[[0, -1]] = 0.0
    at_s = table.t_s + offsets_s
    tracks_m = CubicSpline(table.t_s, table.positions_m)(at_s)
    kept = np.delete(np.arange(len(at_s)), 9)
    write_markers_csv(
        folder / "swing_markers.csv", at_s[kept], names=table.names, positions_m=tracks_m[kept]
    )
    return file, tracks_m


def test_the_model_is_evaluated_at_the_times_of_the_frames(tmp_path: Path) -> None:
    file, tracks_m = jittered_problem(tmp_path)
    problem = Problem.read(file, [*AT_TRUTH, "transcription.substeps=1"])
    (experiment,) = problem.experiments
    trajectory = simulate(experiment, TRUTH, "midpoint", substeps=1)
    (transcription,) = problem.collocation().transcriptions
    predicted_m = transcription.markers.predict_samples(trajectory.sampled, np.zeros(0))
    present = experiment.markers.is_present
    miss_m = np.abs(predicted_m - tracks_m)[present]
    ignored_m = np.abs(trajectory.markers_m - tracks_m)[present]
    assert miss_m.max() < 0.1 * ignored_m.max()
    at_samples_m = experiment.markers.positions_at_samples_m
    interpolated_m = np.abs(trajectory.markers_m - at_samples_m)[present]
    assert interpolated_m.max() < 0.5 * ignored_m.max()


def test_jitter_and_lost_frames_hardly_change_an_estimate(tmp_path: Path) -> None:
    file, _ = jittered_problem(tmp_path)
    problem = Problem.read(file, ["transcription.substeps=1"])
    values = cs.solve(problem, "reduced-space").parameters
    for name in ("mu_pa", "gamma_r_s"):
        assert values[name] == pytest.approx(TRUTH[name], rel=0.05)
