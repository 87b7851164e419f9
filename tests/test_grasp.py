from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from collocation_sysid.errors import InputError
from collocation_sysid.experiment import Grasp, PoseSequence, held_nodes

POINTS = np.array([[0.1, 0.0, 0.0], [0.0, 0.2, 0.3]])


def turning_poses(interpolation: Any = "linear", m=5, dt=0.1):
    """A quarter turn about z in all, while moving along x at 1 m/s."""
    t = dt * np.arange(float(m))
    quaternions = Rotation.from_rotvec(np.outer(np.linspace(0, np.pi / 2, m), [0, 0, 1])).as_quat()
    positions = np.column_stack([t, np.zeros(m), np.zeros(m)])
    return PoseSequence(t, positions, quaternions, interpolation)


def test_samples_are_returned_exactly():
    poses = turning_poses()
    rotations, translations = poses.at(poses.t_s)
    np.testing.assert_allclose(
        rotations, Rotation.from_quat(poses.quaternions_xyzw).as_matrix(), atol=1e-14
    )
    np.testing.assert_allclose(translations, poses.positions_m, atol=1e-15)


def test_linear_is_slerp_in_rotation_and_linear_in_position():
    rng = np.random.default_rng(1)
    t = np.array([0.0, 0.1, 0.25, 0.3])
    turns = Rotation.random(4, rng=rng)
    positions = rng.normal(size=(4, 3))
    poses = PoseSequence(t, positions, turns.as_quat())
    asked = np.linspace(0.0, 0.3, 37)
    rotations, translations = poses.at(asked)
    np.testing.assert_allclose(rotations, Slerp(t, turns)(asked).as_matrix(), atol=1e-13)
    for axis in range(3):
        np.testing.assert_allclose(
            translations[:, axis], np.interp(asked, t, positions[:, axis]), atol=1e-14
        )


def test_hold_keeps_the_latest_sample():
    poses = turning_poses("hold")
    _, translations = poses.at([0.0, 0.05, 0.0999, 0.1, 0.31])
    np.testing.assert_allclose(translations[:, 0], [0.0, 0.0, 0.0, 0.1, 0.3])


def test_hold_is_not_fooled_by_rounding_of_the_time():
    poses = turning_poses("hold", m=31)
    below = np.nextafter(poses.t_s, -1.0)
    np.testing.assert_array_equal(poses.at(below)[1], poses.positions_m)


def test_carry_rotates_then_moves_undeformed_points():
    poses = turning_poses()
    carried = poses.carry(POINTS, [0.0, 0.4])
    assert carried.shape == (2, 2, 3)
    np.testing.assert_allclose(carried[0], POINTS)
    np.testing.assert_allclose(carried[1], [[0.4, 0.1, 0.0], [0.2, 0.0, 0.3]], atol=1e-14)


def test_fixed_leaves_points_alone_at_any_time():
    poses = PoseSequence.fixed()
    np.testing.assert_array_equal(poses.carry(POINTS, [-1.0, 0.0, 9.0]), np.stack([POINTS] * 3))


def test_a_single_pose_holds_for_all_time():
    poses = PoseSequence(
        np.array([2.0]), np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, 1.0, 0.0]])
    )
    expected = POINTS * [-1, -1, 1] + [0, 0, 1]
    np.testing.assert_allclose(poses.carry(POINTS, [0.0, 5.0])[1], expected, atol=1e-15)


def test_half_a_sample_beyond_the_ends_continues_the_motion():
    poses = turning_poses()
    rotations, translations = poses.at([-0.05, 0.45])
    np.testing.assert_allclose(translations[:, 0], [-0.05, 0.45])
    angles = Rotation.from_matrix(rotations).as_rotvec()[:, 2]
    np.testing.assert_allclose(angles, [-np.pi / 16, np.pi / 2 + np.pi / 16])


@pytest.mark.parametrize("time", [-0.06, 0.46, np.nan])
@pytest.mark.parametrize("interpolation", ["linear", "hold"])
def test_times_outside_the_sequence_are_refused(time, interpolation):
    with pytest.raises(InputError, match=r"poses run from 0 s to 0\.4 s"):
        turning_poses(interpolation).at([0.2, time])


def test_quaternion_signs_do_not_matter():
    poses = turning_poses()
    flipped = poses.quaternions_xyzw * np.array([1, -1, 1, -1, -1])[:, None]
    same = PoseSequence(poses.t_s, poses.positions_m, flipped)
    steps = np.sum(same.quaternions_xyzw[1:] * same.quaternions_xyzw[:-1], axis=1)
    assert (steps > 0).all()
    asked = np.linspace(0, 0.4, 21)
    np.testing.assert_allclose(same.at(asked)[0], poses.at(asked)[0], atol=1e-14)


def test_nearly_unit_quaternions_are_normalised():
    poses = turning_poses()
    slightly_off = PoseSequence(poses.t_s, poses.positions_m, 1.0005 * poses.quaternions_xyzw)
    np.testing.assert_allclose(np.linalg.norm(slightly_off.quaternions_xyzw, axis=1), 1.0)


def test_a_quaternion_off_unit_norm_is_named_with_its_norm():
    poses = turning_poses()
    quaternions = poses.quaternions_xyzw.copy()
    quaternions[2:] *= 1.2
    with pytest.raises(InputError, match=r"row 3: .*t_s = 0\.2 .*norm 1\.2"):
        PoseSequence(poses.t_s, poses.positions_m, quaternions)


def test_time_must_increase():
    poses = turning_poses()
    with pytest.raises(InputError, match=r"row 4: t_s = 0\.2 follows 0\.2"):
        PoseSequence(np.array([0.0, 0.1, 0.2, 0.2, 0.3]), poses.positions_m, poses.quaternions_xyzw)


def test_values_must_be_finite():
    poses = turning_poses()
    positions = poses.positions_m.copy()
    positions[1, 2] = np.nan
    with pytest.raises(InputError, match=r"row 2: .*not a finite number"):
        PoseSequence(poses.t_s, positions, poses.quaternions_xyzw)


@pytest.mark.parametrize(
    ("t_s", "positions", "quaternions"),
    [
        (np.zeros(2), np.zeros((3, 3)), np.zeros((2, 4))),
        (np.zeros(2), np.zeros((2, 3)), np.zeros((2, 3))),
        (np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4))),
    ],
)
def test_shapes_must_agree(t_s, positions, quaternions):
    with pytest.raises(InputError, match=r"shape|at least one"):
        PoseSequence(t_s, positions, quaternions)


def test_an_unknown_interpolation_is_refused():
    with pytest.raises(InputError, match="'cubic'"):
        turning_poses("cubic")


def test_a_pose_sequence_keeps_its_own_read_only_copy():
    t = np.array([0.0, 1.0])
    poses = PoseSequence(t, np.zeros((2, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))
    t[1] = 7.0
    assert poses.t_s[1] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        poses.positions_m[0] = 1.0


def test_grasp_nodes_are_sorted_without_repeats():
    grasp = Grasp(np.array([5, 2, 5, 3]), PoseSequence.fixed())
    np.testing.assert_array_equal(grasp.nodes, [2, 3, 5])
    assert grasp.nodes.dtype == np.int64


@pytest.mark.parametrize("nodes", [[], [-1, 2], [0.5], [True, False]])
def test_unusable_grasp_nodes_are_refused(nodes):
    with pytest.raises(InputError):
        Grasp(np.array(nodes), PoseSequence.fixed())


def test_held_nodes_is_the_sorted_union():
    poses = PoseSequence.fixed()
    grasps = [Grasp(np.array([8, 1]), poses), Grasp(np.array([4]), poses)]
    np.testing.assert_array_equal(held_nodes(grasps), [1, 4, 8])
    assert held_nodes([]).shape == (0,)


def test_a_node_in_two_grasps_is_refused_by_name():
    poses = PoseSequence.fixed()
    grasps = [Grasp(np.array(nodes), poses) for nodes in ([9], [3, 1, 7], [7, 3])]
    with pytest.raises(InputError, match="node 3 is held by the grasps 2 and 3"):
        held_nodes(grasps)
