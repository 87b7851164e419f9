"""Pose files: orders of quaternions, units and 4 × 4 matrices; see also `test_readers`."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from collocation_sysid.errors import InputError
from collocation_sysid.recording import PoseSequence, read_poses, write_poses_csv

NAMED = "t_s,x_m,y_m,z_m,qx,qy,qz,qw\n0.0,0,0,1,0,0,0,1\n0.1,0.5,0,1,0,0,0.6,0.8\n"
NUMBERED = NAMED.replace("qx,qy,qz,qw", "q0,q1,q2,q3")
BARE = NAMED.replace("x_m,y_m,z_m", "x,y,z")


@pytest.fixture
def file(tmp_path):
    def write(text):
        path = tmp_path / "poses.csv"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def refusal(path, **options):
    with pytest.raises(InputError) as caught:
        read_poses(path, **options)
    message = str(caught.value)
    assert message.startswith(str(path)), message
    return message


@pytest.fixture
def poses():
    rng = np.random.default_rng(0)
    quaternions = Rotation.random(5, rng=rng).as_quat()
    return PoseSequence(0.1 * np.arange(5), rng.normal(size=(5, 3)), quaternions)


def matrices_of(poses):
    matrices = np.tile(np.eye(4), (len(poses.t_s), 1, 1))
    matrices[:, :3, :3] = Rotation.from_quat(poses.quaternions_xyzw).as_matrix()
    matrices[:, :3, 3] = poses.positions_m
    return matrices


def write_matrices(path, t_s, matrices):
    if path.suffix == ".npz":
        np.savez(path, t_s=t_s, matrices=matrices)
        return path
    header = ",".join(["t_s", *(f"m{i}{j}" for i in range(4) for j in range(4))])
    rows = np.column_stack([t_s, matrices.reshape(-1, 16)])
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.15g")
    return path


def assert_same_poses(found, expected):
    np.testing.assert_allclose(found.t_s, expected.t_s)
    np.testing.assert_allclose(found.positions_m, expected.positions_m, atol=1e-11)
    turn = (
        Rotation.from_quat(found.quaternions_xyzw)
        * Rotation.from_quat(expected.quaternions_xyzw).inv()
    )
    np.testing.assert_allclose(turn.magnitude(), 0.0, atol=1e-7)


def test_columns_have_the_names_and_units_that_robots_write(file):
    exported = (
        "Controller;KR 6\n\nTime (ms);X [mm];Y (mm);Z / mm;qx;qy;qz;qw\n"
        "0;0;0;1000;0;0;0;1\n100;500;0;1000;0;0;0,6;0,8\n"
    )
    assert_same_poses(read_poses(file(exported)), read_poses(file(NAMED)))


def test_a_numbered_quaternion_needs_its_order(file):
    message = refusal(file(NUMBERED))
    assert "q0, q1, q2, q3" in message
    assert "expected quaternion = 'xyzw' or 'wxyz'" in message
    last = read_poses(file(NUMBERED), quaternion="xyzw").quaternions_xyzw[1]
    np.testing.assert_allclose(last, [0, 0, 0.6, 0.8])
    scalar_first = NUMBERED.replace("q0,q1,q2,q3", "q1,q2,q3,q4").replace(
        "0,0,0.6,0.8", "0.8,0,0,0.6"
    )
    last = read_poses(file(scalar_first.replace("0,0,0,1\n", "1,0,0,0\n")), quaternion="wxyz")
    np.testing.assert_allclose(last.quaternions_xyzw[1], [0, 0, 0.6, 0.8])


def test_a_file_without_column_names_needs_order_and_unit(file):
    text = NAMED.split("\n", 1)[1]
    assert "length_unit" in refusal(file(text))
    assert "quaternion" in refusal(file(text), length_unit="m")
    found = read_poses(file(text), quaternion="xyzw", length_unit="m")
    assert_same_poses(found, read_poses(file(NAMED)))


def test_an_order_that_contradicts_the_columns_is_refused(file):
    assert len(read_poses(file(NAMED), quaternion="xyzw").t_s) == 2
    message = refusal(file(NAMED), quaternion="wxyz")
    assert "quaternion is 'wxyz', but the columns are qx, qy, qz, qw" in message


def test_the_unit_of_positions_is_in_their_columns_or_given(file):
    expected = read_poses(file(NAMED)).positions_m
    in_mm = read_poses(file(NAMED.replace("x_m,y_m,z_m", "x_mm,y_mm,z_mm"))).positions_m
    np.testing.assert_allclose(in_mm, expected / 1000)
    assert "state no unit" in refusal(file(BARE))
    given = read_poses(file(BARE), length_unit="cm").positions_m
    np.testing.assert_allclose(given, expected / 100)
    message = refusal(file(NAMED), length_unit="mm")
    assert all(word in message for word in ("'mm'", "x_m, y_m, z_m", "expected the same unit"))


@pytest.mark.parametrize("name", ["poses.csv", "poses.npz"])
def test_matrices_give_the_same_poses_as_quaternions(tmp_path, poses, name):
    path = write_matrices(tmp_path / name, poses.t_s, matrices_of(poses))
    assert_same_poses(read_poses(path), poses)
    in_mm = read_poses(path, length_unit="mm").positions_m
    np.testing.assert_allclose(in_mm, poses.positions_m / 1000)
    write_poses_csv(tmp_path / "again.csv", poses)
    assert_same_poses(read_poses(tmp_path / "again.csv"), poses)


@pytest.mark.parametrize("name", ["poses.csv", "poses.npz"])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: 1.01 * m[:3, :3], ["is not a rotation", "0.0201"]),
        (lambda m: m[:3, :3] * [[1, 1, -1]], ["is a reflection", "determinant"]),
    ],
)
def test_a_matrix_that_is_no_rotation_is_refused(tmp_path, poses, name, change, words):
    matrices = matrices_of(poses)
    matrices[3, :3, :3] = change(matrices[3])
    message = refusal(write_matrices(tmp_path / name, poses.t_s, matrices))
    place = "line 5" if name.endswith("csv") else "index 3"
    assert all(word in message for word in (place, "t_s = 0.3", *words)), message


def test_matrices_written_column_by_column_are_noticed(tmp_path, poses):
    turned = matrices_of(poses).swapaxes(1, 2)
    message = refusal(write_matrices(tmp_path / "poses.csv", poses.t_s, turned))
    assert "column by column?" in message


@pytest.mark.parametrize(
    "arrays",
    [{"t_s": np.zeros(3)}, {"t_s": np.zeros(3), "matrices": np.zeros((2, 4, 4))}, {"a": [1.0]}],
)
def test_an_archive_must_hold_times_and_matrices(tmp_path, arrays):
    np.savez(tmp_path / "poses.npz", **arrays)
    assert "expected t_s (T,) and matrices (T, 4, 4)" in refusal(tmp_path / "poses.npz")


def test_a_damaged_archive_is_refused(tmp_path):
    path = tmp_path / "poses.npz"
    np.savez(path, t_s=np.zeros(3))
    path.write_bytes(path.read_bytes()[:60])
    refusal(path)
