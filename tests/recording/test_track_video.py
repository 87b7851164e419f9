"""The script that tracks points in a video, with synthetic images whose motion is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import track_video

from collocation_sysid.features.image_tracks.files import read_tracks

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
    options = ["--out", str(out), "--rate-hz", "30", "--mask", str(tmp_path / "mask.png")]
    track_video.main([str(folder), *options, "--most", "15"])
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
    track_video.main([str(folder), "--out", str(out), "--rate-hz", "30", "--points", points])
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
    tracks = track_video.tag_centres([(0.0, image)], "DICT_4X4_50")
    x, y, w = view @ [159.5, 119.5, 1.0]
    assert tracks.names == ["tag_7"]
    np.testing.assert_allclose(tracks.pixels[0, 0], [x / w, y / w], atol=0.7)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--points", "tip=1"], "expected NAME=U,V"),
        (["--tags", "DICT_WRONG"], "expected a dictionary of OpenCV"),
    ],
)
def test_wrong_options_end_with_a_remedy(
    options: list[str], message: str, folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "front.csv"
    with pytest.raises(SystemExit, match=message):
        track_video.main([str(folder), "--out", str(out), "--rate-hz", "30", *options])
    assert not out.exists()
