"""Tables of image tracks in a problem file: simulated, solved, and refused with one message."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import AT_TRUTH, TRUTH, pictures_drawn, replace_text, run_command, settings

import collocation_sysid as cs
from collocation_sysid.problem.key_descriptions import find_keys

CALIBRATION = """%YAML:1.0
---
image_width: 1280
image_height: 720
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [900., 0., 640., 0., 900., 360., 0., 0., 1.]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [-0.1, 0.02, 0., 0., 0.]
"""
TRACKS = """
[[experiment.image_tracks]]
name = "front"
file = "swing_reading_front.csv"
sigma_px = 0.3
size_px = [1280, 720]
places_m = { low = [0.02, 0, 0], mid = [0.03, 0, 0.03], side = [0.05, 0.0, 0.03], far = [0.01, 0.0, 0.06] }

[experiment.image_tracks.camera]
file = "front.yaml"
pose = [[1, 0, 0, 0.03], [0, 0, 1, -0.3], [0, -1, 0, 0.045], [0, 0, 0, 1]]
"""


@pytest.fixture
def filmed(tiny: Path) -> Path:
    """The tiny bar with a camera and without markers; the file of the tracks is not simulated."""
    file = tiny / "problem.toml"
    file.write_text(file.read_text().partition("\n[experiment.markers]")[0] + TRACKS)
    (tiny / "front.yaml").write_text(CALIBRATION)
    return tiny


def tracks_of(folder: Path, **options: bool) -> cs.ImageTracks:
    problem = cs.Problem.read(folder / "problem.toml", **options)
    (tracks,) = problem.experiments[0].readings
    assert isinstance(tracks, cs.ImageTracks)
    return tracks


def test_the_table_states_camera_places_and_priors(filmed: Path) -> None:
    tracks = tracks_of(filmed, simulation=True)
    assert tracks.names == ("low", "mid", "side", "far")
    np.testing.assert_array_equal(tracks.known_places_m[1], [0.03, 0.0, 0.03])
    np.testing.assert_array_equal(tracks.camera.distortion, [-0.1, 0.02, 0.0, 0.0, 0.0])
    assert tracks.camera.size_px == (1280, 720)
    assert (tracks.sigma_px, tracks.pose_sigma.turn_deg, tracks.has_known_pose) == (0.3, 1.0, True)


def test_keys_of_the_table_replace_those_of_the_calibration(filmed: Path) -> None:
    replace_text('file = "front.yaml"', 'file = "front.yaml"\ndistortion = [0.5]')(filmed)
    camera = tracks_of(filmed, simulation=True).camera
    np.testing.assert_array_equal(camera.distortion, [0.5])
    assert camera.require_matrix()[0, 0] == 900.0


def test_every_key_is_described() -> None:
    (key,) = find_keys("image_tracks.least_likelihood")
    assert "Confidence of the tracker" in key.description
    assert find_keys("image_tracks.camera.pose")


def written(folder: Path, text: str) -> None:
    (folder / "swing_reading_front.csv").write_text(text)


WIDE = "t_s,low_u,low_v,mid_u,mid_v,mid_likelihood\n" + "".join(
    f"{0.025 * k},{600 + k},{300 + k},{650 + k},{350 + k},{0.5 if k == 2 else 0.9}\n"
    for k in range(8)
)
FRAMES = WIDE.replace("t_s", "frame", 1)
EXCHANGED = WIDE.replace("_u", "_x").replace("_v", "_u").replace("_x", "_v").replace("600", "1000")


def test_unlikely_pixels_are_missing(filmed: Path) -> None:
    replace_text(", side = [0.05, 0.0, 0.03], far = [0.01, 0.0, 0.06]", "")(filmed)
    written(filmed, WIDE)
    tracks = tracks_of(filmed)
    assert np.flatnonzero(~tracks.is_seen[:, 1]).tolist() == [2]
    assert tracks.is_seen[:, 0].all()


@pytest.mark.parametrize(
    ("stated", "column", "used"),
    [("", ",0.15", 0.15), ("sigma_px = 0.3\n", ",0.15", 0.3), ("", "", 1.0)],
)
def test_the_error_of_the_table_is_used_unless_stated(filmed: Path, stated, column, used) -> None:
    replace_text(", side = [0.05, 0.0, 0.03], far = [0.01, 0.0, 0.06]", "")(filmed)
    replace_text("sigma_px = 0.3\n", stated)(filmed)
    head, *rows = WIDE.splitlines()
    ends = [",sigma_px" if column else "", *[column] * len(rows)]
    written(filmed, "".join(f"{row}{end}\n" for row, end in zip([head, *rows], ends, strict=True)))
    assert tracks_of(filmed).sigma_px == used


@pytest.mark.parametrize(
    ("old", "new", "text", "message"),
    [
        (
            "size_px = [1280, 720]",
            "size_px = [640, 360]",
            WIDE,
            r"size_px: found images of 640 x 36"
            r"0 .* multiply the first two rows of the matrix by 0.5",
        ),
        ("", "", WIDE.replace("600", "2600"), r"file: .* of the pixels are outside of the images"),
        ("", "", EXCHANGED, r"file: .* u and v fit if they are exchanged"),
        (
            "size_px = [1280, 720]",
            "",
            WIDE.replace("600", "2600"),
            r"file: .* state size_px, the size of the video",
        ),
        ("", "", FRAMES, r"frame_rate_hz: missing, but swing_reading_front.csv has no times"),
        ("size_px = [1280, 720]", "frame_rate_hz = 30", WIDE, r"frame_rate_hz: found a frame rate"),
        ("low = [0.02", "lower = [0.02", WIDE, r"places_m: found 'lower', which is not in swing"),
        ('file = "front.yaml"\n', "", WIDE, r"camera.matrix: missing; expected the matrix"),
        ('file = "front.yaml"', 'file = "back.yaml"', WIDE, r"camera.file: .*back.yaml"),
        (
            "pose = [[1, 0, 0, 0.03], [0, 0, 1, -0.3], [0, -1, 0, 0.045], [0, 0, 0, 1]]",
            'pose = "file"',
            WIDE,
            r'camera.pose: found "file", but front.yaml states no pose',
        ),
        ("sigma_px = 0.3", "sigma_px = -1.0", WIDE, r"image_tracks.0.sigma_px: found -1"),
        ("sigma_px = 0.3", "sigma = 0.3", WIDE, r"image_tracks.0.sigma: unknown key"),
        (
            'file = "front.yaml"',
            'file = "front.yaml"\npose_sigma = { turn_deg = 1.0 }',
            WIDE,
            r"camera.pose_sigma: unknown key; it belongs to image_tracks, above the table camera",
        ),
    ],
)
def test_faulty_tables_are_refused(
    filmed: Path, old: str, new: str, text: str, message: str
) -> None:
    if "low = [0.02" not in old:
        replace_text(", side = [0.05, 0.0, 0.03], far = [0.01, 0.0, 0.06]", "")(filmed)
    if old:
        replace_text(old, new)(filmed)
    written(filmed, text)
    with pytest.raises(cs.InputError, match=message):
        cs.Problem.read(filmed / "problem.toml")


def test_points_without_places_cannot_be_simulated(filmed: Path) -> None:
    replace_text('name = "front"', 'name = "front"\npoints = ["low", "other"]')(filmed)
    with pytest.raises(cs.InputError, match=r"places_m: found no place of other"):
        cs.Problem.read(filmed / "problem.toml", simulation=True)


@pytest.mark.long
def test_tracks_are_simulated_and_identified_from(filmed: Path) -> None:
    truth = settings(*AT_TRUTH, "transcription.substeps=1")
    options = ("problem.toml", "--quiet")
    done = run_command("simulate", *options, *truth, "--integrator", "midpoint", "--out", ".")
    assert done.code == 0, done.err
    assert (filmed / "swing_reading_front.csv").read_text().startswith("t_s,low_u,low_v,mid_u")
    done = run_command("check", "problem.toml")
    assert done.code == 0, done.err
    assert "4 points in images of 'front'" in done.out + done.err
    fixed = settings("transcription.substeps=1")
    done = run_command("solve", *options, *fixed, "--out", "found", "--method", "reduced-space")
    assert done.code == 0, done.err
    result = json.loads((filmed / "found" / "result.json").read_text())
    assert result["parameters"]["mu_pa"]["optimum"] == pytest.approx(TRUTH["mu_pa"], rel=0.1)
    fitted = result["fit"]["experiments"]["swing"]
    assert fitted["reading_rms"]["front"] < 0.3
    assert fitted["reading_unit"] == {"front": "px"}
    with pictures_drawn():
        assert run_command("plot", "found").code == 0
    assert [*(filmed / "found").rglob("image_swing_front.png")]
