"""Grasps: prescribed nodes, poses, offsets and validation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from collocation_sysid.errors import InputError
from collocation_sysid.recording import (
    Grasp,
    Obstacle,
    Plane,
    PoseSequence,
    Wrench,
    prescribed_nodes,
)

POINTS = np.array([[0.1, 0.0, 0.0], [0.0, 0.2, 0.3]])


def turning_poses(interpolation: Any = "smooth", m=5, dt=0.1):
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
    poses = PoseSequence(t, positions, turns.as_quat(), "linear")
    asked = np.linspace(0.0, 0.3, 37)
    rotations, translations = poses.at(asked)
    np.testing.assert_allclose(rotations, Slerp(t, turns)(asked).as_matrix(), atol=1e-13)
    for axis in range(3):
        np.testing.assert_allclose(
            translations[:, axis], np.interp(asked, t, positions[:, axis]), atol=1e-14
        )


def waving(t_s):
    """An analytic motion that neither starts nor ends at rest."""
    rates = np.array([9.0, 7.0, 11.0])
    positions_m = 0.05 * np.sin(np.outer(t_s, rates) + np.array([0.3, 1.5, 1.0]))
    phases = np.array([0.2, 1.6, 0.5])
    turns = Rotation.from_rotvec(0.7 * np.sin(np.outer(t_s, rates[::-1]) + phases))
    return positions_m, turns


def carried(poses, t_s):
    return poses.moved_positions(POINTS, t_s)


def truly_carried(t_s):
    positions_m, turns = waving(t_s)
    return np.stack([turns.apply(point) + positions_m for point in POINTS], axis=1)


def acceleration(motion, t_s, step_s=1e-3):
    """By central differences, as an integrator sees it."""
    return (motion(t_s + step_s) - 2 * motion(t_s) + motion(t_s - step_s)) / step_s**2


def recorded(rate_hz, interpolation: Any = "smooth"):
    t_s = np.arange(rate_hz + 1) / rate_hz
    positions_m, turns = waving(t_s)
    return PoseSequence(t_s, positions_m, turns.as_quat(), interpolation)


def test_smooth_converges_with_the_fourth_order_in_position_and_the_second_in_acceleration():
    asked = np.linspace(0.005, 0.995, 1501)  # up to the ends

    def errors(rate_hz):
        def motion(t_s):
            return carried(recorded(rate_hz), t_s)

        off = acceleration(motion, asked) - acceleration(truly_carried, asked)
        return np.abs(motion(asked) - truly_carried(asked)).max(), np.sqrt(np.mean(off**2))

    coarse, fine = np.array(errors(50)), np.array(errors(100))
    orders = np.log2(coarse / fine)
    assert orders[0] > 3.8
    assert 1.7 < orders[1] < 3.0


def test_poses_at_50_hz_give_accelerations_that_linear_interpolation_does_not():
    asked = np.linspace(0.005, 0.995, 1501)
    true = acceleration(truly_carried, asked)

    def off(interpolation):
        poses = recorded(50, interpolation)
        found = acceleration(lambda t_s: carried(poses, t_s), asked, 1e-3)
        return np.sqrt(np.mean((found - true) ** 2) / np.mean(true**2))

    assert off("smooth") < 0.005
    assert off("smooth") < 0.1 * off("linear")


def test_smooth_is_the_same_motion_in_any_frame():
    poses, asked = recorded(20), np.linspace(0.0, 1.0, 57)
    camera, body = Rotation.random(2, rng=3)
    turned = PoseSequence(
        poses.t_s,
        camera.apply(poses.positions_m.copy()),
        (camera * Rotation.from_quat(poses.quaternions_xyzw) * body).as_quat(),
    )
    rotations, positions_m = poses.at(asked)
    found, moved_m = turned.at(asked)
    np.testing.assert_allclose(
        found, (camera * Rotation.from_matrix(rotations) * body).as_matrix(), atol=1e-13
    )
    np.testing.assert_allclose(moved_m, camera.apply(positions_m), atol=1e-14)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_few_poses_are_interpolated_by_a_lower_order(count):
    poses = turning_poses("smooth", m=count)
    asked = np.linspace(0.0, poses.t_s[-1], 11)
    rotations, positions_m = poses.at(asked)
    angle = np.pi / 2 * (asked / poses.t_s[-1] if count > 1 else 0.0 * asked)
    np.testing.assert_allclose(positions_m[:, 0], asked, atol=1e-14)
    found = Rotation.from_matrix(rotations).as_rotvec()[:, 2]
    np.testing.assert_allclose(found, angle, atol=1e-12 if count < 3 else 1e-2)


def test_smooth_does_not_overshoot_a_jump():
    t_s = 0.1 * np.arange(12)
    later = t_s > 0.55
    turns = Rotation.from_rotvec(np.outer(later, [0, 0, 1.0]))
    poses = PoseSequence(t_s, np.outer(later, [0.2, 0, 0]), turns.as_quat())
    np.testing.assert_allclose(poses.jumps_s, [0.5])
    asked = np.linspace(0.0, 1.1, 331)
    rotations, positions_m = poses.at(asked)
    angles = Rotation.from_matrix(rotations).as_rotvec()[:, 2]
    still = (asked <= 0.5) | (asked >= 0.6)
    np.testing.assert_allclose(positions_m[still, 0], 0.2 * (asked[still] > 0.55), atol=1e-15)
    np.testing.assert_allclose(angles[still], 1.0 * (asked[still] > 0.55), atol=1e-14)
    assert 0 <= positions_m[:, 0].min() <= positions_m[:, 0].max() <= 0.2
    np.testing.assert_allclose(positions_m[asked == 0.55, 0], 0.1)


@pytest.mark.parametrize("rate_hz", [10, 20, 50, 200])
def test_a_motion_that_samples_resolve_has_no_jumps(rate_hz):
    assert recorded(rate_hz).jumps_s.size == 0
    t_s = np.arange(rate_hz + 1) / rate_hz
    started = np.outer(np.maximum(t_s - 0.5, 0.0), [1.0, 0, 0])  # at full speed from rest
    upright = np.tile([0.0, 0.0, 0.0, 1.0], (len(t_s), 1))
    assert PoseSequence(t_s, started, upright).jumps_s.size == 0


def test_matrices_in_place_of_positions_and_quaternions_name_the_constructor():
    matrices: Any = np.eye(4)[None]
    with pytest.raises(TypeError, match=r"PoseSequence: missing .*PoseSequence\.from_matrices"):
        PoseSequence([0.0], matrices)  # pyright: ignore[reportCallIssue]


def test_after_moves_by_the_matrix_first():
    gripper = recorded(20)
    of_body = np.eye(4)
    of_body[:3, :3] = Rotation.from_rotvec([0.3, -0.5, 1.1]).as_matrix()
    of_body[:3, 3] = 0.1, -0.2, 0.05
    body = gripper.after(of_body)
    in_gripper = POINTS @ of_body[:3, :3].T + of_body[:3, 3]
    np.testing.assert_allclose(
        body.moved_positions(POINTS, gripper.t_s),
        gripper.moved_positions(in_gripper, gripper.t_s),
        atol=1e-14,
    )
    np.testing.assert_allclose(body.first_motion, of_body, atol=1e-14)
    np.testing.assert_allclose(body.after(of_body).first_motion, of_body @ of_body, atol=1e-14)
    quaternion = Rotation.from_matrix(of_body[:3, :3]).as_quat()
    by_pose = gripper.after(PoseSequence([0.0], [of_body[:3, 3]], [quaternion]))
    np.testing.assert_allclose(by_pose.positions_m, body.positions_m, atol=1e-15)
    np.testing.assert_allclose(by_pose.quaternions_xyzw, body.quaternions_xyzw, atol=1e-15)
    held = replace(gripper, interpolation="hold").after(np.eye(4))
    assert held.interpolation == "hold"
    np.testing.assert_allclose(held.positions_m, gripper.positions_m)


def test_a_matrix_that_is_no_rigid_motion_is_refused():
    with pytest.raises(InputError, match="is a reflection"):
        recorded(20).after(np.diag([1.0, 1.0, -1.0, 1.0]))
    with pytest.raises(InputError, match=r"^the quaternion has the norm 2; expected 1"):
        PoseSequence([0.0], [[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0, 2.0]])


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
    carried = poses.moved_positions(POINTS, [0.0, 0.4])
    assert carried.shape == (2, 2, 3)
    np.testing.assert_allclose(carried[0], POINTS)
    np.testing.assert_allclose(carried[1], [[0.4, 0.1, 0.0], [0.2, 0.0, 0.3]], atol=1e-14)


def test_fixed_leaves_points_alone_at_any_time():
    poses = PoseSequence.fixed()
    np.testing.assert_array_equal(
        poses.moved_positions(POINTS, [-1.0, 0.0, 9.0]), np.stack([POINTS] * 3)
    )


def test_a_single_pose_holds_for_all_time():
    poses = PoseSequence(
        np.array([2.0]), np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, 1.0, 0.0]])
    )
    expected = POINTS * [-1, -1, 1] + [0, 0, 1]
    np.testing.assert_allclose(poses.moved_positions(POINTS, [0.0, 5.0])[1], expected, atol=1e-15)


@pytest.mark.parametrize(("interpolation", "off"), [("linear", 1e-12), ("smooth", 1e-3)])
def test_half_a_sample_beyond_the_ends_continues_the_motion(interpolation, off):
    poses = turning_poses(interpolation)
    rotations, translations = poses.at([-0.05, 0.45])
    np.testing.assert_allclose(translations[:, 0], [-0.05, 0.45])
    angles = Rotation.from_matrix(rotations).as_rotvec()[:, 2]
    np.testing.assert_allclose(angles, [-np.pi / 16, np.pi / 2 + np.pi / 16], atol=off)


@pytest.mark.parametrize("time", [-0.06, 0.46, np.nan])
@pytest.mark.parametrize("interpolation", ["smooth", "linear", "hold"])
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
    with pytest.raises(InputError, match="'cubic'; expected 'smooth', 'linear' or 'hold'"):
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
    np.testing.assert_array_equal(prescribed_nodes(grasps), [1, 4, 8])
    assert prescribed_nodes([]).shape == (0,)


def test_a_node_in_two_grasps_is_refused_by_name():
    poses = PoseSequence.fixed()
    grasps = [Grasp(np.array(nodes), poses) for nodes in ([9], [3, 1, 7], [7, 3])]
    with pytest.raises(InputError, match="node 3 is held by the grasps 2 and 3"):
        prescribed_nodes(grasps)


def test_forces_of_an_obstacle_are_rotated_from_its_axes_to_the_world():
    poses = turning_poses()
    wall = Obstacle(poses=poses, shape=Plane((1.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    assert wall.find_measured_forces() is None
    forces_n = np.tile([2.0, 0.0, 1.0], (5, 1))
    rotations, _ = poses.at(poses.t_s)
    turned_n = np.stack([r @ forces_n[0] for r in rotations])
    cases = {"world": forces_n, "grasp": turned_n}
    for frame, expected_n in cases.items():
        sensor = Wrench(poses.t_s, forces_n, 0.1, frame=frame)
        measured = replace(wall, wrench=sensor).find_measured_forces()
        assert measured is not None
        np.testing.assert_allclose(measured.rotate_to_world_n(), expected_n, atol=1e-14)
        np.testing.assert_array_equal(measured.forces_n, forces_n)
        assert measured.sigma_n == 0.1
