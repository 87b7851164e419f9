"""Experiments: declared recordings, derived quantities and validation."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from kit.problems import prescribed_positions
from scipy.spatial.transform import Rotation

from collocation_sysid.errors import InputError
from collocation_sysid.recording import (
    Experiment,
    Force,
    Grasp,
    Markers,
    MarkerTable,
    Placement,
    PointMass,
    PoseSequence,
    align,
)
from collocation_sysid.recording.sample_times import unrounded_s

NODES = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 0.0]]) * 0.1
TIMES = 0.01 * np.arange(6.0)


def lifted(nodes, speed_m_s=1.0):
    """A grasp that moves up at constant speed, turning about z at 1 rad/s."""
    poses = PoseSequence(
        TIMES,
        np.outer(TIMES, [0, 0, speed_m_s]),
        Rotation.from_rotvec(np.outer(TIMES, [0, 0, 1])).as_quat(),
    )
    return Grasp(np.array(nodes), poses)


def markers(t_s=TIMES, node_count=5, present=True):
    placement = Placement(np.array([[3]]), np.ones((1, 1)), np.zeros(1), node_count)
    positions = np.full((len(t_s), 1, 3), 0.1 if present else np.nan)
    return Markers(t_s, positions, 1e-3, ["tip"], placement=placement)


def experiment(**changes) -> Experiment:
    body: Any = SimpleNamespace(
        nodes_m=NODES,
        nodes=SimpleNamespace(points_m=NODES),
        frames=np.zeros((0, 4), dtype=int),
        is_solid=True,
    )
    body.parts = [SimpleNamespace(name="", density_kg_m3=1000.0)]
    body.with_frames = lambda *_, **__: body
    fields: dict[str, Any] = {
        "name": "swing",
        "body": body,
        "t_s": TIMES,
        "grasps": (lifted([2, 0, 1]),),
        "markers": markers(),
        "gravity_m_s2": np.array([0, 0, -9.81]),
    }
    return Experiment(**{**fields, **changes})


# Experiment


def test_sizes_follow_from_times_and_grasps():
    swing = experiment()
    assert swing.timestep_s == pytest.approx(0.01)
    assert swing.duration_s == pytest.approx(0.05)
    np.testing.assert_array_equal(swing.prescribed_dofs, np.arange(9))
    np.testing.assert_array_equal(swing.free_dofs, np.arange(9, 15))


def test_held_positions_follow_the_order_of_held_dofs():
    swing = experiment(grasps=(lifted([4, 1, 2]), lifted([0, 3], speed_m_s=-2.0)))
    held = prescribed_positions(swing, [0.0, 0.02]).reshape(2, 5, 3)
    np.testing.assert_allclose(held[0], NODES)
    np.testing.assert_allclose(held[1, :, 2] - NODES[:, 2], [-0.04, 0.02, 0.02, -0.04, 0.02])
    np.testing.assert_allclose(held[1, 1, :2], [0.1 * np.cos(0.02), 0.1 * np.sin(0.02)])


def test_rigid_positions_carry_the_whole_body_with_the_first_grasp():
    swing = experiment(grasps=(lifted([0, 1, 2]), lifted([3], speed_m_s=-2.0)))
    np.testing.assert_allclose(
        swing.rigid_positions(TIMES), swing.grasps[0].poses.moved_positions(NODES, TIMES)
    )


def test_without_a_grasp_the_body_stays_undeformed_and_all_nodes_are_free():
    free = experiment(grasps=(), start="undeformed")
    np.testing.assert_array_equal(free.rigid_positions([0.0, 0.1]), [NODES, NODES])
    assert prescribed_positions(free, [0.0, 0.1]).shape == (2, 0)
    np.testing.assert_array_equal(free.free_dofs, np.arange(15))


def test_a_given_start_is_at_rest_unless_velocities_are_given():
    given = experiment(start="given", start_positions_m=NODES)
    np.testing.assert_array_equal(given.start_velocities_m_s, np.zeros((5, 3)))
    moving = experiment(start="given", start_positions_m=NODES, start_velocities_m_s=NODES)
    np.testing.assert_array_equal(moving.start_velocities_m_s, NODES)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"t_s": TIMES[:2], "markers": markers(TIMES[:2])}, "at least 3"),
        ({"t_s": TIMES**2}, "evenly spaced"),
        ({"markers": markers(TIMES[:4])}, "sample times of the markers differ"),
        ({"markers": markers(TIMES + 0.003)}, "sample times of the markers differ"),
        ({"markers": markers(present=False)}, "there is no marker sample"),
        ({"markers": markers(node_count=9)}, "body of 9 nodes"),
        ({"t_s": TIMES + 1, "markers": markers(TIMES + 1)}, "poses run from"),
        ({"grasps": (lifted([0, 1, 7]),)}, "node 7; expected node indices from 0 to 4"),
        ({"grasps": (lifted([0, 1, 2]), lifted([2, 3]))}, "node 2 is held by the grasps 1 and 2"),
        ({"gravity_m_s2": np.zeros(2)}, r"gravity_m_s2 has the shape \(2,\)"),
        ({"start": "at rest"}, "expected 'equilibrium', 'moving', 'undeformed' or 'given'"),
        ({"start_rule": "other"}, "expected 'standard' or 'paper'"),
        ({"start": "given"}, "needs start_positions_m"),
        ({"start_positions_m": NODES}, "but start is 'equilibrium'"),
        ({"start": "given", "start_positions_m": NODES[1:]}, "start_positions_m has the shape"),
        ({"start_velocity_m_s": [0, 0, 1]}, "start_velocity_m_s is given, but start is 'equilibr"),
        ({"start_spin_rad_s": [0, 0, 1]}, "expected start = 'undeformed', or no start_spin_rad_s"),
        ({"start": "undeformed", "start_velocity_m_s": [1.0]}, "start_velocity_m_s has the shape"),
        (
            {"forces": (Force([5], [0, 0, 1]),)},
            "force acts on node 5; expected node indices from 0 to 4",
        ),
        (
            {"masses": (PointMass([7], 0.1),)},
            "mass is attached to node 7; expected node indices from 0 to 4",
        ),
    ],
)
def test_inconsistent_experiments_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        experiment(**changes)


def test_messages_name_the_experiment():
    with pytest.raises(InputError, match=r"^experiment 'swing': "):
        experiment(start="given")


@pytest.mark.parametrize("grasps", [(), (lifted([0, 3]),), (lifted([0, 1, 4]),)])
def test_equilibrium_needs_a_grasp_that_leaves_no_rigid_motion(grasps):
    with pytest.raises(InputError, match="rest state is not unique"):
        experiment(grasps=grasps)
    experiment(grasps=grasps, start="undeformed")


def test_two_grasps_can_fix_the_body_together():
    experiment(grasps=(lifted([0, 1]), lifted([3])))


# Alignment


def moving_table(t_s):
    x = np.column_stack([t_s, 2 * t_s, np.ones_like(t_s)])
    return MarkerTable(t_s, ("a", "b"), np.stack([x, x + 1], axis=1))


def moving_poses(t_s, interpolation: Any = "linear"):
    return PoseSequence(
        t_s,
        np.column_stack([t_s, t_s, t_s]),
        Rotation.from_rotvec(np.outer(t_s, [0, 0, 1])).as_quat(),
        interpolation,
    )


def aligned(poses, table, *args, **options):
    """The grid, the poses and the markers of one grasp."""
    found = align([poses], table, *args, **options)
    return found.t_s, found.poses[0], found.table


def test_equal_clocks_pass_unchanged():
    t = 1.0 + 0.01 * np.arange(20)
    grid, poses, table = aligned(moving_poses(t), moving_table(t))
    np.testing.assert_allclose(grid, t, rtol=1e-14)
    np.testing.assert_array_equal(table.t_s, grid)
    np.testing.assert_array_equal(poses.t_s, grid)
    np.testing.assert_array_equal(table.positions_m, moving_table(t).positions_m)
    np.testing.assert_array_equal(poses.positions_m, moving_poses(t).positions_m)
    assert align([moving_poses(t)], moving_table(t)).notes == ()


@pytest.mark.parametrize(
    ("later_s", "remedy"),
    [
        (1.7e9, "clocks differ by 1700000000 s: subtract this from the times"),
        (-40.0, "clocks differ by 40 s: add this to the times of the poses"),
    ],
)
def test_clocks_without_a_common_time_are_named_with_their_difference(later_s, remedy):
    t = 0.01 * np.arange(20)
    with pytest.raises(InputError, match=remedy):
        align([moving_poses(t + later_s)], moving_table(t))


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "ms"), (1e6, "us")])
def test_times_in_another_unit_are_named_by_their_duration(factor, unit):
    t = 0.01 * np.arange(20)
    remedy = (
        f"times of the markers last about .* as if they were in {unit}: call their column t_{unit}"
    )
    with pytest.raises(InputError, match=remedy):
        align([moving_poses(t)], moving_table(factor * t))
    with pytest.raises(InputError, match="times of the poses last about"):
        align([moving_poses(factor * (t + 1.0))], moving_table(t))


def test_faster_poses_keep_their_samples_in_between():
    t = 0.02 * np.arange(10)
    found = align([moving_poses(0.005 * np.arange(-8, 80), "hold")], moving_table(t))
    (poses,) = found.poses
    assert found.notes == ()
    assert len(poses.t_s) == 9 * 4 + 1
    assert poses.interpolation == "hold"
    np.testing.assert_allclose(poses.at(found.t_s)[1][:, 0], found.t_s, atol=1e-12)


def test_poses_printed_with_other_decimals_match_and_move_onto_the_grid():
    t = np.arange(30) / 30
    grid, poses, _ = aligned(moving_poses(np.round(t, 3), "hold"), moving_table(np.round(t, 4)))
    np.testing.assert_array_equal(poses.t_s, grid)
    np.testing.assert_allclose(poses.at(grid)[1][:, 0], np.round(t, 3))


def test_a_window_cuts_both():
    t = 0.01 * np.arange(100)
    grid, poses, table = aligned(moving_poses(t), moving_table(t), window_s=(0.2, 0.3))
    np.testing.assert_allclose(grid, t[20:31])
    np.testing.assert_allclose(poses.t_s, t[20:31])
    np.testing.assert_allclose(table.positions_m[:, 0, 0], t[20:31])


def test_an_empty_window_is_refused_with_the_range():
    t = 0.01 * np.arange(100)
    with pytest.raises(InputError, match=r"window_s = \[2, 3\].*from 0 s to 0\.99 s"):
        aligned(moving_poses(t), moving_table(t), window_s=(2.0, 3.0))


def test_a_window_can_cut_away_uneven_times():
    t = 0.01 * np.arange(50)
    t[40:] += 0.3
    with pytest.raises(InputError, match=r"row 41.*resample_hz"):
        aligned(moving_poses(t), moving_table(t))
    assert len(aligned(moving_poses(t), moving_table(t), window_s=(0.0, 0.35))[0]) == 36


@pytest.mark.parametrize("rate", [125, 50, 99])
def test_poses_of_another_rate_are_interpolated_to_the_markers_times(rate):
    t = 0.01 * np.arange(101)
    poses, table = (moving_poses(np.arange(rate + 1) / rate, "smooth"), moving_table(t))
    found = align([poses], table)
    np.testing.assert_array_equal(found.t_s, t)
    np.testing.assert_array_equal(found.table.positions_m, table.positions_m)
    rotations, positions_m = found.poses[0].at(t)
    np.testing.assert_allclose(positions_m, np.column_stack([t, t, t]), atol=1e-12)
    np.testing.assert_allclose(Rotation.from_matrix(rotations).as_rotvec()[:, 2], t, atol=1e-9)
    (note,) = found.notes
    assert note == (
        f"the poses, recorded at {rate} Hz, were interpolated (smooth) at the markers' times, "
        "100 Hz from 0 s to 1 s"
    )


def test_shifted_poses_are_not_taken_for_matching():
    t = 0.01 * np.arange(100)
    found = align([moving_poses(t - 0.003)], moving_table(t))
    np.testing.assert_allclose(found.poses[0].at(found.t_s)[1][:, 0], found.t_s, atol=1e-12)
    cut, interpolated = found.notes
    assert "0.01 s at the end, 1 of 100 samples" in cut
    assert "start" not in cut
    assert "interpolated (linear)" in interpolated


def test_printed_times_of_poses_are_evened_before_interpolation():
    printed = np.round(np.arange(61) / 30, 3)
    t = 0.01 * np.arange(200)
    true = np.arange(61) / 30
    poses = PoseSequence(printed, np.outer(true, [1, 1, 1]), moving_poses(true).quaternions_xyzw)
    found = align([poses], moving_table(t))
    np.testing.assert_allclose(found.poses[0].at(t)[1][:, 0], t, atol=1e-9)
    np.testing.assert_array_equal(unrounded_s(t**2), t**2)


def test_poses_and_markers_are_cut_to_the_shared_time():
    t = 0.01 * np.arange(100)
    table = moving_table(t)
    found = align([moving_poses(t[20:60])], table)
    np.testing.assert_allclose(found.t_s, t[20:60])
    np.testing.assert_array_equal(found.table.positions_m, table.positions_m[20:60])
    assert found.notes == (
        "the markers were cut to the time of the poses by 0.2 s at the start and 0.4 s at the "
        "end, 60 of 100 samples: poses run from 0.2 s to 0.59 s, markers ran from 0 s to 0.99 s; "
        "start now refers to the state at 0.2 s",
    )
    resampled = align([moving_poses(t[20:60])], table, resample_hz=50)
    np.testing.assert_allclose(resampled.t_s, np.arange(0.2, 0.581, 0.02))


def test_several_grasps_are_cut_to_the_shared_time():
    t = 0.01 * np.arange(100)
    found = align(
        [moving_poses(t[:70]), PoseSequence.fixed(), moving_poses(t[30:] + 0.004)], moving_table(t)
    )
    np.testing.assert_allclose(found.t_s, t[31:70])
    cut, interpolated = found.notes
    assert "poses run from 0 s to 0.69 s and from 0.304 s to 0.994 s" in cut
    assert interpolated.startswith("the poses of grasp 3, recorded at 100 Hz, were interpolated")


def test_a_grasp_that_has_let_go_needs_no_poses_any_more():
    t = 0.01 * np.arange(100)
    sequence = moving_poses(0.005 * np.arange(104))  # 0.515 s
    found = align([sequence], moving_table(t), grasp_intervals_s=[(-np.inf, 0.513)])
    assert found.notes == ()
    assert len(found.t_s) == 100
    assert found.poses[0].at([0.513])[1][0, 0] == pytest.approx(0.513)
    still_held = align([sequence], moving_table(t), grasp_intervals_s=[(-np.inf, 0.6)])
    assert still_held.t_s[-1] == pytest.approx(0.51)


@pytest.mark.parametrize(("first_s", "shared"), [(5.0, 0), (0.98, 2), (-0.98, 2)])
def test_poses_and_markers_that_share_too_little_are_refused(first_s, shared):
    t = 0.01 * np.arange(100)
    message = rf"poses run from {first_s:g} s to .* s, markers from 0 s to 0\.99 s.*share {shared} "
    with pytest.raises(InputError, match=message):
        align([moving_poses(first_s + t)], moving_table(t))


@pytest.mark.parametrize(("early_s", "count"), [(0.5, 1), (2.0, 1), (0.3, 1), (0.05, 0)])
def test_poses_that_begin_long_before_the_markers_are_noted(early_s, count):
    t = 0.02 * np.arange(51)
    poses = moving_poses(0.02 * np.arange(round(-early_s / 0.02), 51))
    notes = [note for note in align([poses], moving_table(t)).notes if "begin" in note]
    assert len(notes) == count
    for note in notes:
        assert note.startswith(f"the samples begin {-poses.t_s[0]:.6g} s after the poses")


def test_jumps_of_poses_are_reported():
    t = 0.02 * np.arange(51)
    jumping = moving_poses(t, "smooth")
    jumping = replace(jumping, positions_m=jumping.positions_m + np.outer(t > 0.5, [0, 0, 1.0]))
    (note,) = align([jumping], moving_table(t)).notes
    assert (
        note == "the poses jump after t = 0.5 s; between the two poses of a jump the motion is "
        "interpolated linearly, not smoothly"
    )
    assert align([replace(jumping, interpolation="linear")], moving_table(t)).notes == ()
    assert align([jumping], moving_table(t), window_s=(0.6, 1.0)).notes == ()


def test_resampling_interpolates_both():
    grid, poses, table = aligned(
        moving_poses(np.arange(126) / 125), moving_table(np.arange(101) / 100), resample_hz=60
    )
    np.testing.assert_allclose(grid, np.arange(61) / 60)
    np.testing.assert_allclose(table.positions_m[:, 0, :2], np.column_stack([grid, 2 * grid]))
    turns = Rotation.from_matrix(poses.at(grid)[0]).as_rotvec()[:, 2]
    np.testing.assert_allclose(turns, grid, atol=1e-12)


def test_resampling_bridges_neither_missing_samples_nor_lost_frames():
    t = np.arange(11) / 10
    table = moving_table(t)
    positions = table.positions_m.copy()
    positions[4, 0] = np.nan
    gappy = MarkerTable(np.delete(t, 8), table.names, np.delete(positions, 8, axis=0))
    grid, _, resampled = aligned(PoseSequence.fixed(), gappy, resample_hz=20)
    present = np.isfinite(resampled.positions_m[:, :, 0])
    lost = {0.75, 0.8, 0.85}
    np.testing.assert_array_equal(present[:, 1], [round(g, 3) not in lost for g in grid])
    np.testing.assert_array_equal(
        present[:, 0], [round(g, 3) not in lost | {0.35, 0.4, 0.45} for g in grid]
    )


def test_resampling_tolerates_an_uneven_clock():
    t = 0.01 * np.arange(100) + 0.002 * np.sin(np.arange(100))
    grid, _, table = aligned(PoseSequence.fixed(), moving_table(t), resample_hz=50)
    np.testing.assert_allclose(table.positions_m[:, 0, 0], grid, atol=1e-12)


@pytest.mark.parametrize("rate", [0.0, -5.0, np.nan, 0.1])
def test_a_useless_rate_is_refused(rate):
    t = 0.01 * np.arange(100)
    with pytest.raises(InputError, match="resample_hz"):
        aligned(moving_poses(t), moving_table(t), resample_hz=rate)


def test_a_single_pose_goes_with_any_time():
    t = 5.0 + 0.01 * np.arange(10)
    single = PoseSequence.fixed()
    for window_s, rate in ((None, None), ((5.02, 5.06), None), (None, 50.0)):
        assert aligned(single, moving_table(t), window_s, rate)[1] is single
