"""Benchmark against other tools: when the answer counts as reached, and what the table shows."""

from __future__ import annotations

import numpy as np
import pytest
from benchmark_peers import Progress, Track, reached_entry, table
from peer_case import (
    GUESS,
    HEIGHT_M,
    SAMPLE_S,
    TRUTH,
    cylinder,
    grasped_nodes,
    grasped_positions,
    hand_motion,
)


def track_of(*factors: float) -> Track:
    """A search whose entries, one per second, are multiples of the truth."""
    values = [{name: f * x for name, x in TRUTH.items()} for f in factors]
    times_s = [1.0 + k for k in range(len(factors))]
    counts = [10 * (k + 1) for k in range(len(factors))]
    return Track(times_s, values, counts, 9.0, 90)


@pytest.mark.parametrize(
    ("factors", "entry"),
    [((2.0, 1.005, 1.5, 1.002, 1.0), 3), ((1.0, 1.009), 0), ((1.0, 1.011), None), ((), None)],
)
def test_an_answer_is_reached_when_the_search_stays_within_one_percent(factors, entry):
    """The second entry of the first search is within 1 %, but the third one is not."""
    assert reached_entry(track_of(*factors), TRUTH) == entry


def test_one_parameter_away_is_enough_to_miss_the_answer():
    track = track_of(1.0)
    track.values[0]["poisson"] *= 1.02
    assert reached_entry(track, TRUTH) is None


def test_the_table_shows_reached_and_missing_answers():
    tracks = {"reduced-space": track_of(1.5, 1.001), "mujoco-sysid": track_of(1.5, 1.2)}
    lines = table(tracks, TRUTH).splitlines()
    cells = [[cell.strip() for cell in line.split("|")] for line in lines[2:]]
    assert cells[0][2:7] == ["2", "1", "20", "9", "90"]
    assert cells[1][2:8] == ["not reached", "–", "–", "9", "90", "+20.00 %"]


def test_only_better_fits_are_entries():
    progress = Progress()
    progress.record(TRUTH, loss=2.0)
    progress.record(GUESS, loss=3.0)
    assert progress.values == [TRUTH]
    progress.record(GUESS, loss=1.0)
    assert progress.values == [TRUTH, GUESS]
    assert progress.counts == [1, 3]


def test_held_nodes_follow_the_hand_and_rates_are_those_of_the_motion():
    mesh = cylinder()
    held_m = grasped_positions(mesh, np.array([0.0, 0.3]))
    rest_m = mesh.points_m[grasped_nodes(mesh)]
    np.testing.assert_allclose(held_m[0], rest_m, atol=1e-15)
    np.testing.assert_allclose(rest_m[:, 2], HEIGHT_M)
    along_m, angle = hand_motion(0.3).coordinates
    centre = np.argmin(np.hypot(*rest_m.T[:2]))
    np.testing.assert_allclose(held_m[1, centre], [along_m, 0.0, HEIGHT_M], atol=1e-12)
    outermost = np.argmax(rest_m[:, 0])
    reach_m = rest_m[outermost, 0]
    lowered_m = HEIGHT_M - reach_m * np.sin(angle)
    assert held_m[1, outermost, 2] == pytest.approx(lowered_m)
    for time_s in (0.1, 0.3):
        ahead = hand_motion(time_s + 1e-6).coordinates
        behind = hand_motion(time_s - 1e-6).coordinates
        rates = (ahead - behind) / 2e-6
        np.testing.assert_allclose(hand_motion(time_s).rates, rates, rtol=1e-6)
    assert SAMPLE_S > 0
