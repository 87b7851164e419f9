"""Live estimation of a stream that begins with a long rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from kit.frames import NO_TIME, NOISE_M, frames_of, swing
from kit.problems import GUESS, TRUTH

import collocation_sysid as cs
from collocation_sysid.extras.live import Frame, LiveEstimator, LiveOptions
from collocation_sysid.extras.live.initial_rest import (
    LONG_REST_FRAMES,
    REPLAYED_FRAMES,
    InitialRest,
)
from collocation_sysid.program import streaming_sweep

INTERVAL_S = 0.01
# Longer than the window of three seconds.
REST_FRAMES = 400


def rest_and_motion(problem: cs.Problem, live: LiveEstimator, count: int) -> list[Frame]:
    """So many frames at rest with noise, and then those of the recording."""
    motion = frames_of(problem, live)
    equilibrium_m = cs.simulate(
        problem.experiments[0], TRUTH, integrator="midpoint", substeps=1
    ).markers_m[0]
    noise = np.random.default_rng(5)
    rest = [
        replace(
            motion[0],
            t_s=INTERVAL_S * k,
            tracks_m=equilibrium_m + noise.normal(scale=NOISE_M, size=equilibrium_m.shape),
        )
        for k in range(count)
    ]
    return rest + [replace(frame, t_s=frame.t_s + INTERVAL_S * count) for frame in motion]


def test_after_a_long_rest_the_estimate_is_that_of_a_stream_without_it(monkeypatch):
    monkeypatch.setattr(streaming_sweep, "LARGEST_CORRECTION", 1e-12)
    problem = swing()
    live, fresh = (LiveEstimator(problem, NO_TIME) for _ in range(2))
    frames = rest_and_motion(problem, live, 40)
    notes = [note for frame in frames for note in live.process_frame(frame).notes]
    (said,) = [note for note in notes if "after a long rest" in note]
    # The first frame of the motion is still at rest, and the second one hardly moves.
    (start,) = [
        k
        for k, frame in enumerate(frames)
        if frame.t_s == pytest.approx(frames[-1].t_s - INTERVAL_S * (len(live.log) - 1))
    ]
    assert 40 - REPLAYED_FRAMES <= start <= 42
    for frame in frames[start:]:
        fresh.process_frame(frame)
    np.testing.assert_allclose(live.p, fresh.p, rtol=1e-6)
    assert "left out" in said


@pytest.mark.long
def test_a_guess_that_is_wrong_by_a_hundred_is_corrected_after_a_long_rest():
    problem = swing(100)
    far = GUESS.with_guess({"lambda_pa": 2e4, "mu_pa": 3e4})
    live = LiveEstimator(cs.Problem(problem.experiments, far), LiveOptions(rows=8))
    for frame in rest_and_motion(problem, live, REST_FRAMES):
        update = live.process_frame(frame)
    assert update.estimates["mu_pa"].value == pytest.approx(TRUTH["mu_pa"], rel=0.03)
    assert update.estimates["gamma_r_s"].value == pytest.approx(TRUTH["gamma_r_s"], rel=0.05)


def still(t_s: float, shift_m: float = 0.0, marker_m: float = 0.0) -> Frame:
    """A frame with one grasp and one marker at these distances."""
    pose = np.array([[shift_m, 0.0, 0.0]]), np.array([[0.0, 0.0, 0.0, 1.0]])
    return Frame(t_s, pose, np.array([[0.0, 0.0, marker_m]]))


def detector() -> InitialRest:
    return InitialRest(body_size_m=0.1, sigma_m=np.array([1e-3]))


def test_the_last_frames_before_the_motion_are_returned_once():
    rest = detector()
    count = LONG_REST_FRAMES + 5
    for k in range(count):
        assert not rest.frames_before_motion(still(0.01 * k))
    found = rest.frames_before_motion(still(0.01 * count, shift_m=0.01))
    assert [frame.t_s for frame in found] == pytest.approx(
        [0.01 * k for k in range(count - REPLAYED_FRAMES, count)]
    )
    assert not rest.frames_before_motion(still(0.01 * count, shift_m=0.02))


def test_a_short_rest_is_kept():
    rest = detector()
    for k in range(LONG_REST_FRAMES - 1):
        rest.frames_before_motion(still(0.01 * k))
    assert not rest.frames_before_motion(still(1.0, shift_m=0.01))


def test_noise_of_the_poses_is_not_a_motion():
    rest = detector()
    noise = np.random.default_rng(2)
    for k in range(300):
        shift_m = 2e-4 * noise.standard_normal()
        assert not rest.frames_before_motion(still(0.01 * k, shift_m=shift_m))
    assert not rest.is_over
    assert rest.frames_before_motion(still(3.0, shift_m=0.01))


def test_a_body_that_swings_in_a_resting_grasp_is_not_at_rest():
    rest = detector()
    for k in range(100):
        rest.frames_before_motion(still(0.01 * k, marker_m=0.02 * np.sin(0.3 * k)))
    assert not rest.frames_before_motion(still(1.0, shift_m=0.01))
