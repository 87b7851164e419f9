"""Samples in which a tracker has lost its point."""

from __future__ import annotations

import numpy as np
import pytest

from collocation_sysid.recording.lost_points import followed_samples, held_tracks, jumps

SIGMA_PX = 0.3
POINTS = 6


def tracks_of(motion: np.ndarray) -> np.ndarray:
    """Noisy tracks (S, 6, 2) whose points move by a motion (S,) as those of a swung bar."""
    along = np.linspace(0.2, 1.0, POINTS)
    places = np.column_stack([20 * along, 300 * along])
    swung = np.stack([motion[:, None] * along**2, 0.2 * motion[:, None] * along], axis=2)
    noise = SIGMA_PX * np.random.default_rng(4).normal(size=(len(motion), POINTS, 2))
    return places + swung + noise


def swaying(count: int = 80) -> np.ndarray:
    return tracks_of(40 * np.sin(0.2 * np.arange(count)))


def test_tracks_of_a_swung_body_are_followed_throughout() -> None:
    assert followed_samples(swaying(), SIGMA_PX).all()


def test_the_sudden_stop_of_a_body_is_no_jump() -> None:
    motion = np.minimum(8.0 * np.arange(60), 240.0)
    struck = np.where(np.arange(60) > 40, 480 - 8.0 * np.arange(60), 8.0 * np.arange(60))
    for each in (motion, struck):
        assert followed_samples(tracks_of(each), SIGMA_PX).all()


def test_a_track_that_jumps_to_another_point_is_lost_from_then_on() -> None:
    tracks = swaying()
    tracks[50:, 1] = tracks[50:, 4]
    ((track, at, _),) = jumps(tracks, SIGMA_PX)
    assert (track, at) == (1, 50)
    followed = followed_samples(tracks, SIGMA_PX)
    assert not followed[50:, 1].any()
    assert followed.sum() == followed.size - 30


def test_a_track_that_jumps_near_its_beginning_is_followed_after_the_jump() -> None:
    tracks = swaying()
    tracks[:4, 1] += [60.0, 0.0]
    followed = followed_samples(tracks, SIGMA_PX)
    assert np.flatnonzero(~followed[:, 1]).tolist() == [0, 1, 2, 3]


def test_two_tracks_that_are_exchanged_for_some_time_are_found_again() -> None:
    tracks = swaying()
    tracks[30:50, [1, 4]] = tracks[30:50, [4, 1]]
    followed = followed_samples(tracks, SIGMA_PX)
    for m in (1, 4):
        assert np.flatnonzero(~followed[:, m]).tolist() == [*range(30, 50)]
    assert followed[:, [0, 2, 3, 5]].all()


@pytest.mark.parametrize("value", [0.0, -1.0, None])
def test_gaps_that_were_filled_are_lost(value: float | None) -> None:
    tracks = swaying()
    tracks[30:50, 2] = tracks[29, 2] if value is None else value
    followed = followed_samples(tracks, SIGMA_PX)
    assert not followed[30:50, 2].any()
    assert followed[:29].all()
    assert followed[50:].all()
    ((track, _),) = held_tracks(tracks, SIGMA_PX)
    assert track == 2


def test_outliers_of_single_samples_are_left_to_the_loss() -> None:
    tracks = swaying()
    rng = np.random.default_rng(5)
    wild = rng.random(tracks.shape[:2]) < 0.1
    tracks[wild] += 30 * rng.normal(size=(wild.sum(), 2))
    assert followed_samples(tracks, SIGMA_PX).mean() > 0.99


def test_images_that_repeat_the_one_before_are_lost() -> None:
    tracks = swaying()
    tracks[[20, 45]] = tracks[[19, 44]]
    followed = followed_samples(tracks, SIGMA_PX)
    assert np.flatnonzero(~followed.all(axis=1)).tolist() == [20, 45]


def test_tracks_in_whole_pixels_are_followed_throughout() -> None:
    assert followed_samples(swaying().round(), SIGMA_PX).all()
    slow = tracks_of(np.linspace(0.0, 3.0, 60)).round()
    assert followed_samples(slow, SIGMA_PX).all()
