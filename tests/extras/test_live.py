"""Live estimates: information and solution of the batch, and incomplete frames."""

from __future__ import annotations

import gc
import io
import json
import socket
import sys
import threading
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from kit.frames import (
    NO_TIME,
    NOISE_M,
    assert_same_information,
    frames_of,
    normal_equations,
    streamed,
    swing,
)
from kit.problem_files import Outcome, run_command
from kit.problems import GUESS, IDEAL, TRUTH
from kit.sensors import accelerometer, instrumented, strain_gauge
from matplotlib.image import imread
from scipy.spatial.transform import Rotation

import collocation_sysid as cs
from collocation_sysid.errors import InputError
from collocation_sysid.extras.live import (
    Frame,
    FrameReader,
    LiveEstimator,
    LiveOptions,
    LiveUpdate,
    estimator,
)
from collocation_sysid.extras.live.frame_buffer import FrameBuffer
from collocation_sysid.extras.live.sources import paced_frames, receive_datagrams, update_as_json
from collocation_sysid.extras.live.time_budget import TimeBudget
from collocation_sysid.extras.live.window_pass import WindowPass
from collocation_sysid.methods.horizon import Horizon
from collocation_sysid.methods.reduced_space import ReducedSpace
from collocation_sysid.problem.gripper_transforms import gripper_transforms
from collocation_sysid.program import streaming_model, streaming_sweep
from collocation_sysid.recording import Markers, Nuisance, PoseSequence, read_poses
from collocation_sysid.statistics.curved_intervals import uncertainty_at

TWENTY = 20 * "9"


def residuals(track: WindowPass, p: np.ndarray) -> list[np.ndarray]:
    """Of all readings, to first order at p."""
    return [said.evaluate_at(track.model.transformed(p)) for said in track.list_residuals()]


def with_time_every(count: int, live: LiveEstimator, frames: list[Frame]) -> LiveUpdate:
    """Take frames, and at every so manieth all the passes that are wanted."""
    for number, frame in enumerate(frames, start=1):
        live.budget_s = 1e-9 if number % count else np.inf
        update = live.process_frame(frame)
    return update


OF_THE_USER = Nuisance.none(
    own=[
        cs.Deviation("growth", "1", 0.02, reading=lambda y, k, t_s, data: (1 + k * t_s) * y),
        cs.Deviation("clock_drift", "1", 0.05, clock=lambda drift, t_s, data: drift * t_s),
    ]
)


@pytest.mark.parametrize(
    ("nuisance", "air_density_kg_m3"),
    [(IDEAL, 0.0), (IDEAL, 10.0), (Nuisance(), 0.0), (OF_THE_USER, 0.0)],
    ids=["ideal", "in dense air", "as in a laboratory", "a user's own"],
)
def test_single_frames_give_the_answer_of_the_batch(nuisance, air_density_kg_m3, monkeypatch):
    monkeypatch.setattr(streaming_sweep, "LARGEST_CORRECTION", 1e-12)
    problem, count = (swing(nuisance=nuisance, air_density_kg_m3=air_density_kg_m3), 30)
    live = streamed(problem, count)
    collocation = problem.collocation()
    horizon, p = (
        Horizon(collocation, [count], prior=streaming_model.WEAK_PRIOR_DEVIATION),
        collocation.guess_p,
    )
    reached, failure = horizon.simulate(p)
    assert failure is None
    point = horizon.evaluate(
        p, [each.x + each.step for each in horizon.evaluate(p, reached).trajectories]
    )
    flat = live.model.transformed(p)
    rows = np.column_stack([point.fit.jacobian, point.fit.residual - point.fit.jacobian @ flat])
    batch = rows.T @ rows
    ours = normal_equations(live.first_pass.sweep.information.triangle)
    scale = np.sqrt(np.outer(np.diag(batch), np.diag(batch)))
    np.testing.assert_allclose(ours / scale, batch / scale, atol=1e-8)
    priors = len(collocation.prior_residuals(p)[0]) + collocation.nq
    measured = sum(len(each.slope) for each in point.trajectories)
    assert live.first_pass.sweep.information.row_count == measured + priors


def unknown(problem: cs.Problem) -> cs.Problem:
    """The same without guesses, and without places of the markers."""
    (seen,) = problem.experiments
    known = seen.markers
    markers = Markers(known.t_s, known.positions_m, known.sigma_m, known.names)
    free = {name: cs.Unknown() for name in ("young_pa", "poisson", "gamma_r_s", "gamma_m_1_s")}
    return cs.Problem([replace(seen, markers=markers)], free, substeps=1)


@pytest.mark.long
@pytest.mark.parametrize(
    "problem",
    # Of this noise no marker ends so near an edge that rounding decides on which side.
    [swing, lambda: unknown(swing(28, Nuisance(), seed=4))],
    ids=["with guesses", "without guesses and places"],
)
def test_when_frames_end_the_estimate_settles_where_the_batch_ends(problem):
    problem = problem()
    live = streamed(problem)
    update, batch = live.finish(), cs.run(problem, seek_causes=False)
    assert update is not None
    for name, estimate in update.estimates.items():
        known = batch.estimates[name]
        assert abs(estimate.value - known.value) < 1e-4 * known.statistical_std_error
        assert estimate.statistical_std_error == pytest.approx(
            known.statistical_std_error, rel=1e-4
        )
    assert update.trust.verdict == batch.trust.verdict
    assert update.marker_rms_m == pytest.approx(batch.solution.rms_m)
    assert update.relinearised > 0


@pytest.mark.long
def test_live_estimates_converge_to_the_batch_of_the_used_samples():
    problem = replace(swing(), substeps=1)
    live = LiveEstimator(problem, NO_TIME)
    (seen,) = problem.experiments
    tracks = seen.markers.positions_m.copy()
    for number, frame in enumerate(frames_of(problem, live)):
        if number % 4:
            tracks[number, 2] = np.nan
            nowhere = np.where(np.isnan(tracks[number]), 10.0, tracks[number])
            frame = replace(frame, tracks_m=nowhere)
        live.process_frame(frame)
    settled = live.finish()
    whole = replace(problem, experiments=[cs.with_markers(seen, tracks)])
    batch = cs.run(whole, seek_causes=False)
    assert any("8 % of the marker samples are outliers" in why for why in settled.trust.reasons)
    for name, estimate in settled.estimates.items():
        assert estimate.value == pytest.approx(batch.parameters[name], rel=1e-6)


@pytest.mark.parametrize("hidden", ["the start", "the grid"])
def test_without_all_it_settles_within_some_passes(hidden, monkeypatch):
    problem, options = (swing(), replace(NO_TIME, window_s=0.2 if hidden == "the start" else 3.0))
    live = LiveEstimator(problem, options)
    for frame in frames_of(problem, live):
        late_s = 2e-3 if hidden == "the grid" and frame.t_s > 0.1 else 0.0
        live.process_frame(replace(frame, t_s=frame.t_s + late_s))
    settled = live.finish()
    assert settled.estimates["mu_pa"].value == pytest.approx(TRUTH["mu_pa"], rel=0.2)
    assert live.rows is None
    live.p = live.p + 0.5
    monkeypatch.setattr(estimator, "FINAL_PASSES", 1)
    monkeypatch.setattr(estimator, "REPEAT_DISTANCE", 0.0)
    assert 0 < live.finish().relinearised <= len(live.log) + streaming_sweep.ROWS_PER_CHUNK


def test_a_pass_with_divided_loads_continues_to_first_order_with_a_note(monkeypatch):
    monkeypatch.setattr(streaming_sweep, "LARGEST_CORRECTION", 1e-12)
    problem = swing(nuisance=Nuisance())
    live = streamed(problem)
    half, errors = len(live.log) // 2, []
    for size in (1e-3, 5e-4):
        p = live.first_pass.sweep.p + size
        whole, turned = (
            WindowPass(live.model, at, live.prior, 99) for at in (p, live.first_pass.sweep.p)
        )
        for number, row in enumerate(live.log):
            if number == half:
                turned.relinearise_at(p)
            turned.repeat_rows([row])
            whole.repeat_rows([row])
        assert len(turned.linearisation_points_from(0)) == 2
        assert turned.last_relinearised_row == half
        ends = (each.blocks[-1].stored_rows[-1].x for each in (turned, whole))
        errors.append(np.abs(np.subtract(*ends)).max())
        assert_same_information(turned.sweep.information, whole.sweep.information, atol=1e-2)
    assert 0 < errors[1] < 0.3 * errors[0] < 1e-5  # of second order


@pytest.mark.parametrize("scheme", ["midpoint", "bdf2"])
def test_two_rows_passed_again_a_frame_follow_the_batch(scheme):
    problem = replace(swing(), scheme=scheme)
    live = LiveEstimator(problem, LiveOptions(rows=2))
    for frame in frames_of(problem, live):
        update = live.process_frame(frame)
    solution = cs.solve(problem, ReducedSpace())
    batch = uncertainty_at(solution.collocation, solution.z).estimates
    for name, estimate in update.estimates.items():
        assert abs(estimate.value - batch[name].value) < 0.5 * batch[name].statistical_std_error


def test_rows_are_begun_that_end_in_time():
    budget = TimeBudget.from_times(one_s=2.0, many_s=9.0, many=8)
    assert [budget.affordable_steps(left_s) for left_s in (0.0, 1.9, 2.1, 4.1)] == [0, 0, 1, 3]
    budget.record_steps(3, 8.0)
    assert budget.affordable_steps(4.1) == 1
    for _ in range(9):
        budget.start_frame()
    assert budget.affordable_steps(4.1) == 3
    assert TimeBudget().affordable_steps(1e-3) == 1


def test_rows_leave_time_for_the_rest_of_the_study():
    budget = TimeBudget.from_times(one_s=2.0, many_s=9.0, many=8)
    budget.record_remainder(1.0)
    budget.record_remainder(0.2)
    assert [budget.affordable_steps(left_s) for left_s in (0.9, 2.9, 3.1, 5.1)] == [0, 0, 1, 3]
    for _ in range(60):
        budget.record_remainder(0.0)
    assert budget.affordable_steps(2.5) == 1


@pytest.mark.long
def test_a_stream_looks_through_nothing_old_for_garbage(tiny, monkeypatch):
    frozen, take = [], LiveEstimator.process_frame

    def counted(live: LiveEstimator, frame: Frame) -> LiveUpdate:
        frozen.append(gc.get_freeze_count())
        return take(live, frame)

    monkeypatch.setattr(LiveEstimator, "process_frame", counted)
    assert run_command("replay", "problem.toml", "--rate", 0, "--json").code == 0
    assert min(frozen) > 10_000
    assert gc.get_freeze_count() == 0


def test_information_that_leaves_the_window_stays_as_a_prior(monkeypatch):
    monkeypatch.setattr(streaming_sweep, "LARGEST_CORRECTION", 1e-12)
    problem = swing(nuisance=Nuisance())
    live = streamed(problem)
    track, log, whole = (live.first_pass, list(live.log), live.first_pass.sweep.information)
    track.relinearise_at(track.sweep.p)
    left = track.drop_oldest_block()
    assert 0 < left < len(log)
    assert len(track.linearisation_points_from(0)) == 2
    assert track.last_relinearised_row == len(log) - left
    assert track.sweep.information is whole
    again = WindowPass(live.model, track.sweep.p, track.prior, live._block_rows, track)
    for row in log[left:]:
        again.repeat_rows([row])
    assert_same_information(again.sweep.information, whole, atol=1e-8)


def test_a_pass_from_within_the_window_moves_its_first_state_along_its_slopes(monkeypatch):
    monkeypatch.setattr(streaming_sweep, "LARGEST_CORRECTION", 1e-12)
    problem = swing(nuisance=Nuisance())
    live = streamed(problem)
    way = np.full(len(live.p), 1.0)
    errors = []
    for size in (1e-3, 5e-4):
        p = live.first_pass.sweep.p + size * way
        whole = WindowPass(live.model, p, live.prior, live._block_rows)
        state = live.first_pass.blocks[1]
        part = streaming_sweep.StreamingSweep(
            live.model, p, live.prior, state.start, state.linearisation_point
        )
        for number, row in enumerate(live.log):
            whole.add_rows([row.poses])
            if number >= live._block_rows:
                (kept,) = part.advance([row.poses])
        errors.append(np.abs(kept.x - whole.blocks[-1].stored_rows[-1].x).max())
    assert errors[1] < 0.3 * errors[0] < 1e-5  # of second order


def test_residuals_follow_damping_by_mass_that_is_wrong_by_three():
    problem = swing()
    live = streamed(problem)
    far = live.model.collocation.guess_p.copy()
    places = [item.name for item in live.model.collocation.parameters.free]
    far[places.index("gamma_m_1_s")] -= np.log(3.0)
    there = WindowPass(live.model, far, live.prior, live._block_rows)
    for row in live.log:
        there.repeat_rows([row])
    at_guess = residuals(live.first_pass, live.first_pass.sweep.p)
    change = np.subtract(residuals(there, far), at_guess)
    off = np.subtract(residuals(there, live.first_pass.sweep.p), at_guess)
    # By its logarithm they would miss 45 %.
    assert np.linalg.norm(off) < 0.03 * np.linalg.norm(change)


def test_rows_solved_together_have_a_second_order_error_that_is_reported(monkeypatch):
    monkeypatch.setattr(streaming_sweep, "LARGEST_CORRECTION", 1e-12)
    problem = swing(nuisance=Nuisance())
    live = streamed(problem)
    way, errors = np.full(len(live.p), 1.0), []
    for size in (1e-3, 5e-4):
        p = live.first_pass.sweep.p + size * way
        whole, together = (
            WindowPass(live.model, p, live.prior, live._block_rows, live.first_pass) for _ in "ab"
        )
        for row in live.log:
            whole.repeat_rows([row])
        assert not whole.sweep.needs_another_pass()
        monkeypatch.setattr(streaming_sweep, "CHUNK_CORRECTION_FACTOR", 1e12)
        calls = 0
        while together.rows < len(live.log):
            together.repeat_rows(live.log[together.rows :])
            calls += 1
        assert calls < len(live.log) / 4
        assert together.sweep.needs_another_pass()
        ends = (t.blocks[-1].stored_rows[-1].x for t in (together, whole))
        errors.append(np.abs(np.subtract(*ends)).max())
        assert together.sweep.information.row_count == whole.sweep.information.row_count
        assert_same_information(together.sweep.information, whole.sweep.information, atol=1e-3)
    assert 0 < errors[1] < 0.3 * errors[0] < 1e-6  # of second order


@pytest.mark.parametrize(("scheme", "near"), [("midpoint", 1e-4), ("bdf2", 3e-4)])
def test_a_row_far_from_its_guess_is_solved_alone(scheme, near):
    problem = replace(swing(), scheme=scheme)
    live = streamed(problem)
    far = live.first_pass.sweep.p + np.array([0.7, -0.7, 0.7, -0.7])
    again, whole = (
        WindowPass(live.model, far, live.prior, live._block_rows, t)
        for t in (live.first_pass, None)
    )
    while again.rows < len(live.log):
        again.repeat_rows(live.log[again.rows :])
        assert np.isfinite(again.sweep.copy_state().last_rows.increments).all()
    for row in live.log:
        whole.repeat_rows([row])
    assert (
        np.abs(again.blocks[-1].stored_rows[-1].x - whole.blocks[-1].stored_rows[-1].x).max()
        < near * live.model.body_size_m
    )


def test_a_stiffness_that_is_wrong_by_ten_is_found():
    problem = swing()
    far = GUESS.with_guess({"lambda_pa": 4000.0, "mu_pa": 3000.0})
    live = LiveEstimator(cs.Problem(problem.experiments, far), NO_TIME)
    update = with_time_every(6, live, frames_of(problem, live))
    assert update.estimates["mu_pa"].value == pytest.approx(TRUTH["mu_pa"], rel=0.1)


def test_parameters_without_a_guess_are_sought():
    problem = swing()
    free = {name: cs.Unknown() for name in ("young_pa", "poisson", "gamma_r_s", "gamma_m_1_s")}
    live = LiveEstimator(cs.Problem(problem.experiments, free), NO_TIME)
    assert live.search is not None
    update = with_time_every(6, live, frames_of(problem, live))
    assert live.search is None
    assert update.estimates["young_pa"].value == pytest.approx(780.0, rel=0.2)


# What frames may lack -------------------------------------------------------------------------


def test_doubled_late_unordered_and_dropped_frames_are_reported_and_change_little():
    problem = swing()
    whole, live = (LiveEstimator(problem, NO_TIME), LiveEstimator(problem, NO_TIME))
    frames = frames_of(problem, live)
    for frame in frames:
        expected = whole.process_frame(frame)
    order = [*range(12), 11, 13, 12, *range(14, 20), *range(22, 37), 5]
    notes = [note for k in order for note in live.process_frame(frames[k]).notes]
    assert live.counts["doubled"] == 1 + 1  # one twice, and one long ago that was there
    assert live.counts["unordered"] == 1
    assert live.counts["dropped"] == 1 + 2  # one of them came late
    assert any("is interpolated there" in note for note in notes)
    assert any("late" in note for note in notes)
    assert live.first_pass.rows == whole.first_pass.rows
    for name, estimate in live._estimates_at(live.first_pass.sweep.information, live.p).items():
        error = expected.estimates[name].statistical_std_error
        if error is not None:
            assert abs(estimate.value - expected.estimates[name].value) < 2 * error


def test_a_frame_that_is_too_late_is_left_out():
    problem = swing()
    live = LiveEstimator(problem, NO_TIME)
    frames = frames_of(problem, live)
    for frame in frames[:10] + frames[11:30]:
        live.process_frame(frame)
    rows = live.first_pass.sweep.information.row_count
    update = live.process_frame(frames[10])
    assert "too late" in update.notes[0]
    assert live.counts["late"] == 1
    assert live.first_pass.sweep.information.row_count == rows


def test_missing_markers_carry_no_information():
    problem = swing()
    live = LiveEstimator(problem, NO_TIME)
    stated = live.model.prior_information(live.p).row_count
    for seen, frame in enumerate(frames_of(problem, live)):
        tracks = frame.tracks_m.copy()
        if seen % 3:
            tracks[: 1 + seen % 2] = np.nan
        before = live.first_pass.sweep.information.row_count if live.first_pass else stated
        live.process_frame(replace(frame, tracks_m=tracks))
        found = live.first_pass.sweep.information.row_count - before
        assert found == np.isfinite(tracks).sum()


def test_a_grasp_that_is_lost_for_a_moment_is_bridged_and_for_long_it_is_reported():
    problem = swing()
    live = LiveEstimator(problem, NO_TIME)
    frames = frames_of(problem, live)
    blind = [replace(frame, pose=None) for frame in frames]
    for frame in [*frames[:10], *blind[10:13], frames[13]]:
        update = live.process_frame(frame)
    assert live.first_pass.rows == 14
    assert live.first_pass.condense_measurements().row_count == 14 * frames[0].tracks_m.size
    for frame in blind[14:30]:
        update = live.process_frame(frame)
    assert update.trust.verdict == "doubtful"
    assert "pose of the grasp has been missing" in update.trust.reasons[0]
    known = live.first_pass.condense_measurements().triangle
    update = live.process_frame(frames[30])
    assert "restarted after a gap" in update.notes[0]
    assert live.first_pass.rows == 1
    np.testing.assert_array_equal(live.first_pass.prior.triangle, known)
    assert update.trust.verdict != "good"


def test_frames_whose_clock_was_set_back_begin_anew():
    problem = swing()
    live = LiveEstimator(problem, NO_TIME)
    frames = frames_of(problem, live)
    for frame in frames[:20]:
        live.process_frame(replace(frame, t_s=frame.t_s + 100.0))
    notes = [note for frame in frames[:20] for note in live.process_frame(frame).notes]
    assert sum("too late" in note for note in notes) == 10
    assert live.counts["begun anew"] == 1
    assert live.first_pass.rows == 10


def test_markers_without_poses_are_not_kept():
    problem = swing()
    live = LiveEstimator(problem, NO_TIME)
    frames = frames_of(problem, live)
    for k in range(40):
        update = live.process_frame(replace(frames[0], t_s=-1.0 + 0.01 * k, pose=None))
        assert update.trust.verdict == "doubtful"
        assert not live.intake._waiting
    live.process_frame(frames[0])
    for k in range(1, 40):
        live.process_frame(replace(frames[0], t_s=0.01 * k, pose=None))
    assert len(live.intake._waiting) <= 10


def test_frames_at_rest_do_not_determine_damping_and_the_verdict_states_it():
    problem = swing()
    live = LiveEstimator(problem)
    first = frames_of(problem, live)[0]
    noise = np.random.default_rng(3)
    for k in range(12):
        tracks = first.tracks_m + noise.normal(scale=NOISE_M, size=first.tracks_m.shape)
        update = live.process_frame(replace(first, t_s=0.01 * k, tracks_m=tracks))
    damping = update.estimates["gamma_r_s"]
    assert damping.statistical_std_error is None
    assert damping.statistical95[1] > 100 * damping.statistical95[0]
    assert update.trust.verdict != "good"
    assert any("gamma_r_s is not known yet" in reason for reason in update.trust.reasons)


def test_a_track_that_jumps_is_left_out():
    problem = swing()
    live = LiveEstimator(problem, NO_TIME)
    frames = frames_of(problem, live)
    for frame in frames[:29]:
        live.process_frame(frame)
    live.budget_s = np.inf
    live.process_frame(frames[29])
    jumped = frames[30].tracks_m.copy()
    jumped[2] += 0.02
    update = live.process_frame(replace(frames[30], tracks_m=jumped))
    name = live.names[2]
    assert any(
        note.startswith("markers ignored in this frame") and note.endswith(f": {name}")
        for note in update.notes
    )
    assert live.counts["wild"] == 1


@pytest.mark.parametrize("number", [0, 4])
def test_outliers_far_from_body_or_last_grasp_are_omitted(number):
    problem = swing()
    live, without = (LiveEstimator(problem, NO_TIME), LiveEstimator(problem, NO_TIME))
    for k, frame in enumerate(frames_of(problem, live)[:12]):
        bad, blind = frame, frame
        if k == number:
            seen = frame.tracks_m.copy()
            seen[2] = np.nan
            blind = replace(frame, tracks_m=seen)
            bad = replace(frame, tracks_m=np.where(np.isnan(seen), 1e6, seen))
        if k == 6:
            places_m, turns = frame.pose
            nowhere = np.full_like(frame.tracks_m, np.nan)
            blind = replace(frame, pose=None, tracks_m=nowhere)
            bad = replace(frame, pose=(places_m + 1e6, turns))
        said, expected = live.process_frame(bad), without.process_frame(blind)
        ignored = any(
            note.startswith("markers ignored in this frame") and note.endswith(": m2")
            for note in said.notes
        )
        assert ignored == (k == number)
        assert any("implausibly far from the last" in note for note in said.notes) == (k == 6)
        assert said.estimates == expected.estimates


def test_frames_between_samples_are_read_there():
    problem = swing()
    live = LiveEstimator(problem, NO_TIME)
    x = problem.experiments[0].grasps[0].poses
    for t_s in np.arange(0.0, 0.2, 0.004):
        turns, shifts = x.at([t_s])
        pose = (shifts[0], Rotation.from_matrix(turns[0]).as_quat())
        update = live.update(t_s, pose, {live.names[0]: [0.0, 0.0, 0.0]})
    assert live.counts["off the grid"] > 0
    assert live.first_pass.rows == 20
    assert update.t_s == pytest.approx(0.196)


def test_rows_between_frames_take_poses_from_a_cubic():
    intake, t_s = FrameBuffer(0.01, 2, 0), 0.01 * np.arange(8)

    def place(t):
        return np.array([[1 + t - 30 * t**2 + 200 * t**3, 0.0, 0.0]])

    rows = []
    for k, t in enumerate(t_s):
        if k != 5:
            rows += intake.add_frame(
                t, (place(t), np.array([[0, 0, 0, 1.0]])), tracks_m=np.zeros((1, 3))
            ).rows
    found = np.array([row.poses[0][1][0] for row in rows])
    assert len(found) == 15
    expected = [place(0.005 * k)[0, 0] for k in range(15)]
    np.testing.assert_allclose(found[4:], expected[4:], atol=1e-12)


def test_memory_is_bounded():
    problem = swing()
    live = LiveEstimator(problem, LiveOptions(budget_s=4e-3, window_s=0.2))
    frames = frames_of(problem, live)
    period = [*frames, *frames[-2:0:-1]]
    sizes = []
    for k in range(90):
        live.process_frame(replace(period[k % len(period)], t_s=0.01 * k))
        sizes.append(
            (
                len(live.log),
                sum(len(b.stored_rows) + len(b.residuals) for b in live.first_pass.blocks),
            )
        )
    most = 3 * live._blocks * live._block_rows
    assert max(logged for logged, _ in sizes) <= most
    assert max(kept for _, kept in sizes) <= 2 * most
    assert live.first_pass.sweep.information.triangle.shape == (len(live.p) + 1,) * 2
    assert len(live.intake._waiting) <= 4
    assert len(live.first_pass.sweep.read) <= 30


# Readings of one's own -------------------------------------------------------------------------


@cache
def felt(bias_m_s2: float = 0.3) -> cs.Problem:
    """A cube swung by its top and seen bluntly, with a chip and a foil of clocks of their own."""
    (seen,) = swing().experiments
    seen = replace(seen, markers=replace(seen.markers, sigma_m=1e-3))
    inner = np.linspace(seen.t_s[0] + 1e-3, seen.t_s[-1], 2 * len(seen.t_s))
    made = instrumented(seen, accelerometer(inner), strain_gauge(seen.t_s))
    accelerations, strains = cs.simulate(made, TRUTH, "midpoint", substeps=1).custom_sensor_values
    rng = np.random.default_rng(2)
    accelerations = accelerations + [0, 0, bias_m_s2] + 0.05 * rng.normal(size=(len(inner), 3))
    accelerations[5, 1] = accelerations[7] = np.nan
    strains = strains + 1e-4 * rng.normal(size=strains.shape)
    return cs.Problem([cs.with_readings(made, [accelerations, strains])], GUESS, substeps=1)


def test_custom_sensors_count_live_as_in_the_batch(monkeypatch):
    monkeypatch.setattr(streaming_sweep, "LARGEST_CORRECTION", 1e-12)
    problem = felt()
    live = streamed(problem)
    (seen,), count = problem.experiments, len(live.log)
    last_s = seen.t_s[len(live.log) - 2] - 1e-5
    taken = [
        np.where(g.sample_times_s[:, None] < last_s, g.measured_values, np.nan)
        for g in seen.readings
    ]
    whole = cs.Problem([cs.with_readings(seen, taken)], GUESS)
    collocation = whole.collocation()
    horizon, p = (
        Horizon(collocation, [count], prior=streaming_model.WEAK_PRIOR_DEVIATION),
        collocation.guess_p,
    )
    reached, _ = horizon.simulate(p)
    point = horizon.evaluate(p, reached)
    point = horizon.evaluate(p, [each.x + each.step for each in point.trajectories])
    flat = live.model.transformed(p)
    rows = np.column_stack([point.fit.jacobian, point.fit.residual - point.fit.jacobian @ flat])
    batch, ours = (rows.T @ rows, normal_equations(live.first_pass.sweep.information.triangle))
    scale = np.sqrt(np.outer(np.diag(batch), np.diag(batch)))
    np.testing.assert_allclose(ours / scale, batch / scale, atol=1e-8)


@pytest.mark.long
def test_constants_and_sensor_errors_are_found_from_frames():
    problem = felt()
    live = LiveEstimator(problem, replace(NO_TIME, rows=8))
    for frame in frames_of(problem, live):
        update = live.process_frame(frame)
    blind = [replace(e, readings=[]) for e in problem.experiments]
    alone = LiveEstimator(cs.Problem(blind, GUESS), replace(NO_TIME, rows=8))
    for frame in frames_of(problem, live):
        without = alone.process_frame(replace(frame, instrument_samples=()))
    for name, estimate in update.estimates.items():
        assert abs(estimate.value - TRUTH[name]) < 4 * estimate.statistical_std_error
        assert estimate.statistical_std_error < without.estimates[name].statistical_std_error
    bias = live.p[live.model.collocation.nq :] * live.model.transcription.nuisance.scales
    assert bias[0] == pytest.approx(0.3, abs=0.05)
    settled, batch = live.finish(), cs.run(problem, seek_causes=False)
    for name, estimate in settled.estimates.items():
        assert estimate.value == pytest.approx(batch.parameters[name], rel=1e-5)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ('{"foil": 0.1}', [(2, 1.0, [0.1])]),
        ('{"accelerometer": [1, null, 3]}', [(1, 1.0, [1, np.nan, 3])]),
        ('{"foil": {"t_s": 0.9, "values": [0.2]}}', [(2, 0.9, [0.2])]),
        (
            '{"foil": [{"t_s": 0.9, "values": 0.2}, {"t_s": 1, "values": 0.3}]}',
            [(2, 0.9, [0.2]), (2, 1.0, [0.3])],
        ),
        ('{"foil": null}', []),
    ],
)
def test_frames_bring_readings_with_times_of_their_own(given, expected):
    reader = FrameReader([1], ["a"], gauges=felt().experiments[0].readings)
    found = reader.read(f'{{"t_s": 1.0, "readings": {given}}}').instrument_samples
    assert [(number, t_s) for number, t_s, _ in found] == [each[:2] for each in expected]
    for (*_, values), (*_, numbers) in zip(found, expected, strict=True):
        np.testing.assert_array_equal(values, numbers)


def test_tables_of_frames_have_readings_in_their_columns():
    reader = FrameReader([1], ["a"], gauges=felt().experiments[0].readings)
    names = [f"accelerometer_{k}" for k in (1, 2, 3)]
    assert reader.read(",".join(["t_s,x_m,y_m,z_m,qx,qy,qz,qw", *names, "foil"])) is None
    ((number, t_s, values),) = reader.read("1,1,2,3,0,0,0,1,0.5,,0.7,").instrument_samples
    assert (number, t_s) == (1, 1.0)
    np.testing.assert_array_equal(values, [0.5, np.nan, 0.7])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ('{"chip": 1}', "found a reading 'chip'; expected one of accelerometer, foil"),
        ('{"foil": [1, 2]}', "the reading 'foil': found 2 numbers; expected 1 numbers"),
        ('{"foil": "much"}', "the reading 'foil': found 'much'; expected 1 numbers"),
        (
            '{"foil": {"t_s": 1}}',
            "a sample of the reading 'foil' has the keys 't_s'; expected t_s and values",
        ),
        ('{"foil": {"t_s": null, "values": 1}}', "t_s is None"),
        ("[1]", r"readings are \[1\]; expected samples by name"),
    ],
)
def test_invalid_sensor_values_are_reported_with_their_line(given, said):
    reader = FrameReader([1], ["a"], gauges=felt().experiments[0].readings)
    with pytest.raises(InputError, match=f"input, line 1: {said}"):
        reader.read(f'{{"t_s": 1.0, "readings": {given}}}')


# What cannot be live --------------------------------------------------------------------------


def test_problems_that_cannot_be_live_are_refused_in_words():
    problem = swing()
    hung = problem.experiments[0]
    still = replace(hung, grasps=[replace(hung.grasps[0], poses=PoseSequence.fixed())])
    for changed, said in (
        ([still], "never move"),
        ([hung, replace(hung, name="again")], "2 experiments"),
    ):
        with pytest.raises(InputError, match=said):
            LiveEstimator(cs.Problem(changed, GUESS))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (dict(t_s=float("nan"), pose=None, markers=None), "finite"),
        (dict(t_s=0.0, pose=np.eye(3), markers=None), "4 × 4"),
        (dict(t_s=0.0, pose=([0, 0, 0], [0, 0, 0, 2]), markers=None), "norm"),
        (dict(t_s=0.0, pose=None, markers={"nobody": [0, 0, 0]}), "nobody"),
        (dict(t_s=0.0, pose=None, markers=np.zeros((1, 3))), "expected 9 × 3 numbers"),
    ],
)
def test_an_invalid_frame_is_refused_without_changing_the_state(given, said):
    live = LiveEstimator(swing(), NO_TIME)
    with pytest.raises(InputError, match=said):
        live.update(**given)
    assert live.first_pass is None
    assert not live.counts


# Text -----------------------------------------------------------------------------------------


def test_frames_are_read_from_json_and_from_tables():
    of_json = FrameReader([1], ["a", "b"])
    line = {"t_s": 1, "pose": {"position_m": [1, 2, 3], "quaternion_xyzw": [0, 0, 0, 1]}}
    frame = of_json.read(json.dumps(line | {"markers": {"b": [4, 5, 6], "a": None}}))
    of_rows = FrameReader([1], ["a", "b"])
    header = "t_s,x_m,y_m,z_m,qx,qy,qz,qw,a_x,a_y,a_z,b_x,b_y,b_z"
    assert of_rows.read(header) is None
    same = of_rows.read("1,1,2,3,0,0,0,1,,,,4,5,6")
    for each in (frame, same):
        assert each.t_s == 1.0
        np.testing.assert_array_equal(each.pose[0], [[1, 2, 3]])
        np.testing.assert_array_equal(each.tracks_m, [[np.nan] * 3, [4, 5, 6]])
    assert of_rows.read("1.1,,,,,,,,,,,4,5,6").pose is None
    assert of_json.read('{"t_s": 1.1}').pose is None


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("{nonsense", "line 2: this line is not valid JSON"),
        ('{"markers": {}}', "line 2: there is no t_s"),
        ('{"t_s": 1, "marker": {}}', "line 2: found the key 'marker'"),
        ('{"t_s": true}', "line 2: t_s is True"),
        ('{"t_s": 1, "pose": {"position_m": [0, 0, 0]}}', "no quaternion_xyzw"),
        ('{"t_s": 1, "markers": {"a": [1, 2]}}', "expected 3 numbers"),
        (f'{{"t_s": {TWENTY}}}', f"t_s is {TWENTY}; expected a finite number of seconds"),
        (f'{{"t_s": 1, "markers": {{"a": [0, {15 * TWENTY}, 0]}}}}', "numbers up to 1e.10"),
        (f'{{"t_s": 1, "markers": {{"a": [0, {20 * TWENTY}, 0]}}}}', "expected 3 numbers"),
        (f'{{"t_s": {250 * TWENTY}}}', "a number is too long"),
        (f'{{"t_s": {"[" * 100_000}', "brackets are nested too deeply"),
        (f'{{"t_s": 1, "markers": {{"a": {"[" * 300}{"]" * 300}}}}}', "expected 3 numbers"),
        ("[1, 2]", "the first line is neither a JSON object nor a header"),
    ],
)
def test_bad_lines_are_named(line, said):
    reader = FrameReader([1], ["a"], "input")
    reader.read("")
    with pytest.raises(InputError, match=said) as refused:
        reader.read(line)
    assert len(str(refused.value)) < 200


@pytest.mark.parametrize("cell", ["one", "1_000"])
def test_cells_of_a_row_that_are_no_numbers_are_named(cell):
    reader = FrameReader([1], ["a"], "input")
    reader.read("t_s,x_m,y_m,z_m,qx,qy,qz,qw,a_x,a_y,a_z")
    with pytest.raises(InputError, match=f"line 2: found '{cell}'; expected a number"):
        reader.read(f"1,1,2,3,0,0,0,1,{cell},,")


def test_datagrams_are_read_until_an_empty_one():
    port: list[int] = []
    ready = threading.Event()

    def opened(number: int) -> None:
        port.append(number)
        ready.set()

    found: list[str] = []
    listener = threading.Thread(target=lambda: found.extend(receive_datagrams(0, opened)))
    listener.start()
    assert ready.wait(5)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for text in ("one\ntwo", "three", ""):
            sender.sendto(text.encode(), ("127.0.0.1", port[0]))
    listener.join(5)
    assert found == ["one", "two", "three"]


def test_frames_are_paced_and_catch_up_when_late():
    now, waited = [0.0], []

    def wait(seconds: float) -> None:
        waited.append(seconds)
        now[0] += seconds

    for k, _ in enumerate(paced_frames(iter(range(5)), 10.0, lambda: now[0], wait)):
        now[0] += 0.25 if k == 1 else 0.01
    np.testing.assert_allclose(waited, [0.09, 0.03], atol=1e-12)


@pytest.mark.long
def test_the_commands_stream_frames_to_estimates(tiny, monkeypatch):
    lines = []
    problem = cs.Problem.read("problem.toml")
    live = LiveEstimator(problem, NO_TIME)
    for frame in frames_of(problem, live):
        (position,), (quaternion,) = frame.pose
        pose = {"position_m": position.tolist(), "quaternion_xyzw": quaternion.tolist()}
        markers = dict(zip(live.names, frame.tracks_m.tolist(), strict=True))
        line = json.dumps({"t_s": frame.t_s, "pose": pose, "markers": markers})
        lines.append(line.encode())
    expected = [json.loads(update_as_json(live.process_frame(f))) for f in frames_of(problem, live)]

    def streamed_bytes(*lines: bytes) -> Outcome:
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"\n".join(lines))))
        return run_command("live", "problem.toml", "--budget-ms", "1e-6")

    ended = streamed_bytes(*lines)
    *found, settled = [json.loads(line) for line in ended.out.splitlines()]
    assert [each["t_s"] for each in found] == [each["t_s"] for each in expected]
    assert found[-1]["parameters"] == expected[-1]["parameters"]
    assert "final estimate after the last frame" in settled["notes"]
    assert ended.code == 0
    bad = (b"{", lines[0].replace(b"0", b"\xff"), b"\xff\xfe", b'{"t_s":' + 10_000 * b"[")
    ended = streamed_bytes(*lines[:2], *bad, *lines[2:])
    assert ended.code == 2
    assert "standard input, line 3: this line is not valid JSON" in ended.err
    assert len(ended.err.splitlines()) == len(bad)
    assert [json.loads(line)["t_s"] for line in ended.out.splitlines()[:-1]] == [
        each["t_s"] for each in expected
    ]


@pytest.mark.long
def test_a_recording_is_replayed_and_filmed(tiny):
    ended = run_command("replay", "problem.toml", "--rate", 0, "--film", "swing.gif")
    assert ended.code == 0
    assert "mu_pa" in ended.out
    assert "frames, latency" in ended.out
    assert imread("swing.gif").size > 0
    assert run_command("replay", "problem.toml", "--film", "swing.mp4").code == 2
    ended = run_command("replay", "problem.toml", "--rate", 1000, "--json")
    assert json.loads(ended.out.splitlines()[-1])["t_s"] == pytest.approx(0.08)


def test_poses_of_frames_are_of_the_gripper_if_stated(tiny: Path):
    """As the poses of a file: both lead to the poses of the body in the recording."""
    file = tiny / "problem.toml"
    transform = "position_m = [0.01, 0.0, 0.02], quaternion_xyzw = [0, 0.6, 0, 0.8]"
    text = file.read_text()
    keys = 'poses = "swing_motion.csv"'
    file.write_text(text.replace(keys, f"{keys}, gripper_to_body = {{ {transform} }}"))
    problem = cs.Problem.read(file)
    (experiment,) = problem.experiments
    (matrix,) = gripper_transforms(problem, experiment.name, [0])
    reader = FrameReader([1], ["a"], gripper_transforms=[matrix])
    recorded = read_poses(tiny / "swing_motion.csv")
    rotations, positions_m = experiment.grasps[0].poses.at(recorded.t_s)
    for k, t_s in enumerate(recorded.t_s):
        pose = {
            "position_m": recorded.positions_m[k].tolist(),
            "quaternion_xyzw": recorded.quaternions_xyzw[k].tolist(),
        }
        frame = reader.read(json.dumps({"t_s": float(t_s), "pose": pose}))
        found_m, quaternions = frame.pose
        np.testing.assert_allclose(found_m[0], positions_m[k], atol=1e-12)
        turned = Rotation.from_quat(quaternions[0]).as_matrix()
        np.testing.assert_allclose(turned, rotations[k], atol=1e-12)


def test_a_problem_without_a_gripper_frame_has_no_transforms(tiny: Path):
    problem = cs.Problem.read(tiny / "problem.toml")
    assert gripper_transforms(problem, "swing", [0]) == [None]
    from_python = replace(problem, origin=None)
    assert gripper_transforms(from_python, "swing", [0]) == [None]
