"""Tracks of points in a video, with synthetic images whose motion is known."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import Outcome, run_command

from collocation_sysid.extras.tracking import tag_centres, video
from collocation_sysid.kinds.image_tracks.files import read_tracks
from collocation_sysid.recording import PoseSequence, write_poses_csv

cv2 = pytest.importorskip("cv2")

COUNT = 12
SIZE = (320, 240)


def texture() -> np.ndarray:
    noise = np.random.default_rng(11).uniform(0, 255, (SIZE[1], SIZE[0])).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.clip(128 + 8 * (smooth - smooth.mean()), 0, 255).astype(np.uint8)


def motion(k: int) -> np.ndarray:
    """A turn and a shift of the whole image."""
    turn = cv2.getRotationMatrix2D((160, 120), 0.4 * k, 1.0)
    turn[:, 2] += [1.3 * k, -0.7 * k]
    return turn


def images() -> list[np.ndarray]:
    first = texture()
    return [cv2.warpAffine(first, motion(k), SIZE, flags=cv2.INTER_CUBIC) for k in range(COUNT)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    frames = tmp_path / "frames"
    frames.mkdir()
    for k, image in enumerate(images()):
        cv2.imwrite(str(frames / f"frame_{k}.png"), image)
    return frames


def test_corners_are_followed_to_a_part_of_a_pixel(folder: Path, tmp_path: Path) -> None:
    mask = np.zeros((SIZE[1], SIZE[0]), dtype=np.uint8)
    mask[70:170, 90:210] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    out = tmp_path / "front.csv"
    options = ("--out", out, "--rate-hz", 30, "--mask", tmp_path / "mask.png")
    assert run_command("track", folder, *options, "--most", 15).code == 0
    read = read_tracks(out)
    assert len(read.names) == 15
    assert read.t_s is not None
    np.testing.assert_allclose(read.t_s, np.arange(COUNT) / 30, atol=1e-6)
    start = read.pixels[0]
    assert ((start >= [88, 68]) & (start <= [212, 172])).all()
    for k in range(COUNT):
        expected = start @ motion(k)[:, :2].T + motion(k)[:, 2]
        # Errors of single steps add up to a drift.
        assert np.nanmax(np.linalg.norm(read.pixels[k] - expected, axis=1)) < 0.05 + 0.05 * k
    assert read.likelihood is not None
    assert read.likelihood.min() > 0.6


def test_stated_points_keep_their_names_and_points_that_leave_the_image_are_lost(
    folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "front.csv"
    points = "tip=160,120;edge=312,120"
    ended = run_command("track", folder, "--out", out, "--rate-hz", 30, "--points", points)
    assert "Verdict: check\n1 of 2 points survive to the last of 12 images" in ended.out
    assert "1 left the image: film with more room around the motion" in ended.out
    read = read_tracks(out)
    assert read.names == ("tip", "edge")
    assert np.isfinite(read.pixels[:, 0]).all()
    assert np.isnan(read.pixels[-1, 1]).all()


def test_the_centre_of_a_tag_is_where_its_diagonals_cross(tmp_path: Path) -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    tag = cv2.aruco.generateImageMarker(dictionary, 7, 100)
    scene = np.full((240, 320), 255, dtype=np.uint8)
    scene[70:170, 110:210] = tag
    corners = np.array([[0, 0], [320, 0], [320, 240], [0, 240]], dtype=np.float32)
    tilted = np.array([[10, 20], [300, 0], [310, 230], [0, 200]], dtype=np.float32)
    view = cv2.getPerspectiveTransform(corners, tilted)
    image = cv2.warpPerspective(scene, view, (320, 240), borderValue=255)
    tracks = tag_centres([(0.0, image)], "DICT_4X4_50")
    x, y, w = view @ [159.5, 119.5, 1.0]
    assert tracks.names == ["tag_7"]
    np.testing.assert_allclose(tracks.pixels[0, 0], [x / w, y / w], atol=0.7)


BAR_SIZE = (480, 300)
RATE_HZ = 60


def film_bar(
    folder: Path,
    shift: Callable[[int], tuple[float, float]],
    count: int,
    wall: float | np.ndarray = 90.0,
    noise: float = 1.0,
) -> np.ndarray:
    """Images of a textured bar that moves in front of a wall, with noise, and a mask beside the
    folder; returns the shifts (count, 2) in pixels.
    """
    folder.mkdir()
    rng = np.random.default_rng(1)
    shape = (BAR_SIZE[1], BAR_SIZE[0])
    smooth = cv2.GaussianBlur(rng.uniform(0, 255, (180, 60)).astype(np.float32), (0, 0), 2.0)
    bar, cover = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    bar[60:240, 200:260] = np.clip(128 + 10 * (smooth - smooth.mean()), 0, 255)
    cover[60:240, 200:260] = 1
    for k in range(count):
        turn = np.array([[1, 0, shift(k)[0]], [0, 1, shift(k)[1]]], dtype=np.float32)
        here = cv2.warpAffine(bar, turn, BAR_SIZE, flags=cv2.INTER_CUBIC)
        part = cv2.warpAffine(cover, turn, BAR_SIZE)
        image = part * here + (1 - part) * wall + noise * rng.normal(size=shape)
        cv2.imwrite(str(folder / f"{k}.png"), np.clip(image, 0, 255).astype(np.uint8))
    inner = cv2.erode((255 * cover).astype(np.uint8), np.ones((31, 31), np.uint8))
    cv2.imwrite(str(folder.parent / "mask.png"), inner)
    return np.array([shift(k) for k in range(count)])


def track(folder: Path, out: Path, *options: object) -> Outcome:
    words = ("--out", out, "--rate-hz", RATE_HZ, "--mask", folder.parent / "mask.png", *options)
    return run_command("track", folder, *words)


def hand_m(t_s: np.ndarray) -> np.ndarray:
    """Motion of a gripper along x and z, from rest and back to rest."""
    share = np.clip((np.atleast_1d(t_s) - 0.5) / 0.8, 0, 1)
    x = 0.04 * np.sin(np.pi * share) ** 2 * np.sin(3.3 * np.pi * share)
    return np.column_stack([x, 0 * x, 0.01 * np.sin(np.pi * share) ** 2])


@pytest.mark.long
def test_a_moving_bar_is_tracked_and_the_poses_tell_when_the_film_began(tmp_path: Path) -> None:
    start_s, px_m = 0.3137, 900.0

    def shift(k: int) -> tuple[float, float]:
        x, _, z = px_m * hand_m(np.array([start_s + k / RATE_HZ]))[0]
        return float(x), float(-z)

    shifts = film_bar(tmp_path / "film", shift, 70)
    t_s = np.arange(0, 2, 0.01)
    poses = PoseSequence(t_s, hand_m(t_s), np.tile([0, 0, 0, 1.0], (len(t_s), 1)))
    write_poses_csv(tmp_path / "poses.csv", poses)
    out = tmp_path / "front.csv"
    for gripper in ((), ("--gripper", "230,80;225,100")):
        ended = track(tmp_path / "film", out, "--poses", tmp_path / "poses.csv", *gripper, "--json")
        assert ended.code == 0, ended.err
        said = json.loads(ended.out)
        assert (said["verdict"], said["lost"], said["remedies"]) == ("good", [], [])
        assert said["surviving"] == said["points"] > 10
        assert said["start"]["start_s"] == pytest.approx(start_s, abs=1 / RATE_HZ)
        assert abs(said["start"]["start_s"] - start_s) < 1e-3  # much better than required
    read = read_tracks(out)
    assert not any("gripper" in name for name in read.names)
    expected = read.pixels[0] + shifts[:, None]
    assert np.linalg.norm(read.pixels - expected, axis=2).max() < 0.2
    # Poses of another motion.
    t_s = np.arange(0, 2, 0.01)
    other = np.column_stack([0.02 * np.sin(40 * t_s), 0 * t_s, 0 * t_s])
    poses = PoseSequence(t_s, other, np.tile([0, 0, 0, 1.0], (len(t_s), 1)))
    write_poses_csv(tmp_path / "other.csv", poses)
    out.unlink()
    ended = track(tmp_path / "film", out, "--poses", tmp_path / "other.csv")
    assert ended.code == 2
    assert "% of the motion remains; expected --gripper U,V" in ended.err
    assert not out.exists()


def test_a_motion_that_repeats_does_not_tell_when_the_film_began(tmp_path: Path) -> None:
    film_bar(tmp_path / "film", lambda k: (8 * np.sin(0.6 * k), 0.0), 30)
    t_s = np.arange(0, 2, 0.01)
    swing = np.column_stack([0.01 * np.sin(0.6 * RATE_HZ * t_s), 0 * t_s, 0 * t_s])
    poses = PoseSequence(t_s, swing, np.tile([0, 0, 0, 1.0], (len(t_s), 1)))
    write_poses_csv(tmp_path / "poses.csv", poses)
    ended = track(tmp_path / "film", tmp_path / "o.csv", "--poses", tmp_path / "poses.csv")
    assert ended.code == 2
    assert (
        " s fits; expected --gripper U,V on the gripper, a motion that does not repeat" in ended.err
    )


def test_points_that_are_all_lost_have_a_verdict_and_remedies(tmp_path: Path) -> None:
    film_bar(tmp_path / "film", lambda k: ((0, 20, 60, 180, 20, 0)[k], 0.0), 6)
    out = tmp_path / "front.csv"
    ended = track(tmp_path / "film", out, "--most", 12)
    assert ended.code == 1
    first, second, *rest = ended.out.splitlines()
    assert first == "Verdict: doubtful"
    assert second.startswith("0 of 12 points survive to the last of 6 images (0.08333 s); 50% of")
    assert (
        "12 moved by up to 40 pixels per image: move slower, or film more images per second" in rest
    )
    assert len([line for line in rest if "0.050 s" in line]) == 8
    assert "and 4 more" in rest
    read = read_tracks(out)  # up to the image in which they are lost
    assert np.isfinite(read.pixels[:3]).all()
    assert np.isnan(read.pixels[3:]).all()


def test_points_are_lost_rather_than_mistaken_where_the_surroundings_change(tmp_path: Path) -> None:
    film_bar(tmp_path / "film", lambda k: (2.0 * k, 0.0), 6)
    for k in (3, 4, 5):
        file = tmp_path / "film" / f"{k}.png"
        blurred = cv2.GaussianBlur(cv2.imread(str(file)), (0, 0), 14)
        cv2.imwrite(str(file), blurred)
    ended = track(tmp_path / "film", tmp_path / "front.csv")
    assert ended.code == 1
    assert "film before a plain background, with a shorter exposure and more light" in ended.out


def clutter(size_px: float, contrast: float) -> np.ndarray:
    """A wall with features larger than those of the bar."""
    noise = np.random.default_rng(5).normal(size=(BAR_SIZE[1], BAR_SIZE[0]))
    wall = cv2.GaussianBlur(noise.astype(np.float32), (0, 0), size_px)
    return np.clip(128 + contrast * wall / wall.std(), 0, 255)


@pytest.mark.parametrize(
    ("step", "size_px", "contrast"), [(0.5, 8, 60), (0.55, 8, 70), (0.6, 6, 50)]
)
def test_points_do_not_follow_the_background(tmp_path: Path, step, size_px, contrast) -> None:
    wall = clutter(size_px, contrast)
    shifts = film_bar(tmp_path / "film", lambda k: (50 * (1 - np.cos(step * k)), 0.0), 16, wall)
    ended = track(tmp_path / "film", tmp_path / "front.csv", "--json")
    said = json.loads(ended.out)
    assert 2 * said["surviving"] > said["points"]
    read = read_tracks(tmp_path / "front.csv")
    errors = np.linalg.norm(read.pixels - read.pixels[0] - shifts[:, None], axis=2)
    assert np.nanmax(errors) < 1.5


@pytest.mark.parametrize("noise", [2.0, 8.0, 16.0])
def test_the_table_has_the_standard_error_of_its_pixels(tmp_path: Path, noise: float) -> None:
    shifts = film_bar(tmp_path / "film", lambda k: (2.0 * k, 0.5 * k), 6, noise=noise)
    assert track(tmp_path / "film", tmp_path / "front.csv").code == 0
    read = read_tracks(tmp_path / "front.csv")
    errors = (read.pixels - read.pixels[0] - shifts[:, None])[1:]
    assert read.sigma_px == pytest.approx(np.sqrt(np.nanmean(errors**2)), rel=0.5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--points", "tip=1"), "error: --points: found 'tip=1'; expected NAME=U,V"),
        (("--points", "a=1,2;a=3,4"), "expected different names"),
        (("--points", "tip=999,4"), "a stated point is outside the first image of 320 × 240"),
        (("--tags", "DICT_WRONG"), "expected a dictionary of OpenCV"),
        (("--tags", "imread"), "expected a dictionary of OpenCV"),
        (("--tags", "CORNER_REFINE_NONE"), "expected a dictionary of OpenCV"),
        (("--points", "tip=nan,3"), "error: --points: found 'tip=nan,3'; expected NAME=U,V"),
        (("--tags", "DICT_4X4_50"), "found no point; expected texture, --points, or --tags"),
        (("--gripper", "1,2"), "--gripper: expected --poses"),
        (("--points", "a=1,2", "--tags", "DICT_4X4_50"), "expected one of them"),
        (("--mask", "frames/frame_0.png", "--points", "a=1,2"), "expected one of them"),
        (("--mask", "missing.png"), "missing.png: this image cannot be read"),
        (("--out", "."), ".: this cannot be written"),
        (("--out", "frames/frame_0.png", "--mask", "frames/frame_0.png"), "which is read"),
        (("--mask", "black.png"), "found no point; expected texture"),
        (("--points", ";;"), "found no point; expected texture"),
        (("--points", "a\x1b=100,100"), "expected NAME=U,V"),
        (("--mask", "many.png"), "many.png: this image cannot be read"),
        (("--film", "film.avi"), "--film: found 'film.avi'; expected FILE.mp4"),
        (("--film", "poses.mp4", "--poses", "poses.mp4"), "'poses.mp4', which is read"),
        (("--mask", "small.png"), "small.png: found 8 × 9 pixels; expected those of the video"),
    ],
)
def test_wrong_options_end_with_a_remedy(
    options: tuple[str, ...], message: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder.parent)
    cv2.imwrite("small.png", np.zeros((9, 8), dtype=np.uint8))
    cv2.imwrite("black.png", np.zeros(SIZE[::-1], dtype=np.uint8))
    size = struct.pack("<IIiiHH", 54, 40, 2**30, 2**30, 1, 24)  # of 2³⁰ × 2³⁰ pixels
    Path("many.png").write_bytes(b"BM" + bytes(8) + size + bytes(24))
    ended = run_command("track", "frames", "--out", "front.csv", "--rate-hz", 30, *options)
    assert (ended.code, ended.out) == (2, "")
    assert message in ended.err
    assert len(ended.err.splitlines()) == 1
    assert not Path("front.csv").exists()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda file: None, "there is no such file; expected a video"),
        (lambda file: file.write_bytes(b""), "this has no image; expected a video"),
        (lambda file: file.write_bytes(bytes(3000)), "this has no image; expected a video"),
        (lambda file: file.mkdir(), "found 0 images; expected images, and --rate-hz"),
    ],
)
def test_a_video_that_cannot_be_read_is_refused(
    make: Callable[[Path], object], message: str, tmp_path: Path
) -> None:
    make(tmp_path / "film.mp4")
    ended = run_command("track", tmp_path / "film.mp4", "--out", tmp_path / "front.csv")
    assert (ended.code, ended.out) == (2, "")
    assert f"film.mp4: {message}" in ended.err
    assert not (tmp_path / "front.csv").exists()


@pytest.mark.parametrize("options", [(), ("--points", "tip=0,0"), ("--tags", "DICT_4X4_50")])
@pytest.mark.parametrize("size", [1, 5, 20])
def test_images_smaller_than_the_window_are_refused(size, options, tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    for k in range(3):
        image = np.random.default_rng(k).integers(0, 255, (size, size, 3), dtype=np.uint8)
        cv2.imwrite(str(tmp_path / "frames" / f"{k}.png"), image)
    out = tmp_path / "front.csv"
    ended = run_command("track", tmp_path / "frames", "--out", out, "--rate-hz", 30, *options)
    assert (ended.code, ended.out) == (2, "")
    assert f"found images of {size} × {size} pixels; expected at least 21 × 21" in ended.err
    assert not out.exists()


def test_what_libraries_print_about_a_damaged_image_is_not_shown(tmp_path: Path) -> None:
    start = b"\0\0\0\x20ftypisom\0\0\2\0isomiso2avc1mp41"  # of an MP4 without its table
    (tmp_path / "film.mp4").write_bytes(start + bytes(500))
    command = [sys.executable, "-m", "collocation_sysid", "track", str(tmp_path / "film.mp4")]
    command += ["--out", str(tmp_path / "front.csv")]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert len(ended.stderr.splitlines()) == 1


def write_video(file: Path, count: int = COUNT) -> None:
    video = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, SIZE)
    for image in images()[:count]:
        video.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    video.release()


def test_a_list_of_other_files_is_no_video(tmp_path: Path) -> None:
    write_video(tmp_path / "other.mp4")
    (tmp_path / "film.mp4").write_text("ffconcat version 1.0\nfile other.mp4\n")
    ended = run_command("track", tmp_path / "film.mp4", "--out", tmp_path / "front.csv")
    assert ended.code == 2
    assert "film.mp4: this has no image" in ended.err


@pytest.mark.parametrize(
    ("count", "first_ticks", "message"),
    [(1, None, "found one image; expected several"), (COUNT, 0, "expected --rate-hz")],
)
def test_images_without_increasing_times_are_refused(
    count: int, first_ticks: int | None, message: str, tmp_path: Path
) -> None:
    write_video(tmp_path / "film.mp4", count)
    if first_ticks is not None:
        content = bytearray((tmp_path / "film.mp4").read_bytes())
        table = content.find(b"stts")  # of the durations of images
        content[table + 12 : table + 20] = struct.pack(">II", count, first_ticks)
        (tmp_path / "film.mp4").write_bytes(content)
    ended = run_command("track", tmp_path / "film.mp4", "--out", tmp_path / "front.csv")
    assert (ended.code, ended.out) == (2, "")
    assert message in ended.err
    assert not (tmp_path / "front.csv").exists()


def test_what_libraries_print_while_they_decode_is_not_shown(tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4")
    content = np.frombuffer((tmp_path / "film.mp4").read_bytes(), dtype=np.uint8).copy()
    rng = np.random.default_rng(1)
    content[rng.integers(500, len(content) - 2000, 80)] = 0xFF
    (tmp_path / "film.mp4").write_bytes(content.tobytes())
    command = [sys.executable, "-m", "collocation_sysid", "track", str(tmp_path / "film.mp4")]
    command += ["--out", str(tmp_path / "front.csv"), "-q"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "@" not in ended.stderr
    assert "Traceback" not in ended.stderr


def test_images_of_different_sizes_are_refused(folder: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(folder / "frame_5.png"), np.zeros((20, 30), dtype=np.uint8))
    ended = run_command("track", folder, "--out", tmp_path / "front.csv", "--rate-hz", 30)
    assert ended.code == 2
    assert "image 6 has another size" in ended.err
    assert not (tmp_path / "front.csv").exists()


def test_the_times_of_a_video_and_a_film_with_the_points(folder: Path, tmp_path: Path) -> None:
    write_video(tmp_path / "film.mp4")
    words = ("--out", tmp_path / "front.csv", "--film", tmp_path / "seen.mp4")
    assert run_command("track", tmp_path / "film.mp4", *words).code == 0
    times = read_tracks(tmp_path / "front.csv").t_s
    assert times is not None
    np.testing.assert_allclose(times, np.arange(COUNT) / 25, atol=1e-6)
    seen = cv2.VideoCapture(str(tmp_path / "seen.mp4"))
    assert seen.get(cv2.CAP_PROP_FRAME_COUNT) == COUNT


def test_without_opencv_the_extra_is_named(folder: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    ended = run_command("track", folder, "--out", tmp_path / "front.csv", "--rate-hz", 30)
    assert ended.code == 2
    assert "tracking needs OpenCV: pip install 'collocation-sysid[video]'" in ended.err


def write_damaged(file: Path, damage: Callable[[bytearray], object]) -> None:
    video = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, SIZE)
    for image in images():
        video.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    video.release()
    content = bytearray(file.read_bytes())
    damage(content)
    file.write_bytes(content)


def half_of_a_picture(content: bytearray) -> None:
    middle = len(content) // 2
    content[middle : middle + 3000] = bytes(3000)


def last_third(content: bytearray) -> None:
    del content[2 * len(content) // 3 :]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (half_of_a_picture, "announced images are decoded; the decoder reports "),
        (last_third, "8 of 12 announced images are decoded"),
        (lambda content: None, None),
    ],
)
def test_a_damaged_video_is_never_good(damage, message: str | None, tmp_path: Path) -> None:
    write_damaged(tmp_path / "film.avi", damage)
    ended = run_command("track", tmp_path / "film.avi", "--out", tmp_path / "front.csv", "--json")
    answer = json.loads(ended.out)
    assert answer["verdict"] == ("good" if message is None else "check")
    damaged = [each for each in answer["remedies"] if "announced" in each]
    assert [message in each for each in damaged] == ([] if message is None else [True])


def test_an_image_that_ends_early_is_refused(folder: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "whole.jpg"), texture())
    content = (tmp_path / "whole.jpg").read_bytes()
    (folder / "frame_5.png").write_bytes(content[: len(content) // 2])
    ended = run_command("track", folder, "--out", tmp_path / "front.csv", "--rate-hz", 30)
    assert (ended.code, ended.out) == (2, "")
    assert "frame_5.png: this image cannot be read" in ended.err


def test_a_video_that_crashes_the_decoder_is_refused(tmp_path: Path, monkeypatch) -> None:
    write_damaged(tmp_path / "film.avi", lambda content: None)
    monkeypatch.setattr(video, "_DECODE", "import os; os.abort()")
    ended = run_command("track", tmp_path / "film.avi", "--out", tmp_path / "front.csv")
    assert (ended.code, ended.out) == (2, "")
    assert "film.avi: decoding this video crashes" in ended.err
    assert not (tmp_path / "front.csv").exists()
