"""Films of a run and the fields of its frames, made from its files."""

from __future__ import annotations

import shutil
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import meshio
import numpy as np
import pytest
from kit.problem_files import TRUTH, run_command, settings, write_problem
from kit.results import a_result, value
from matplotlib.colors import to_hex
from PIL import Image

from collocation_sysid.common.step_counting import listen_to_shares
from collocation_sysid.errors import InputError
from collocation_sysid.result import animation
from collocation_sysid.result.animation import (
    FILM_WIDTH_MM,
    FOOT_HEIGHT_MM,
    HEAD_HEIGHT_MM,
    FilmFigure,
    animate,
    film_samples,
)
from collocation_sysid.result.figure_style import GREEN
from collocation_sysid.result.frame_fields import cells_below_faces, frame_files, stress_on_faces
from collocation_sysid.result.replay import read_run, run_headline
from collocation_sysid.statistics.assessment import Assessment
from collocation_sysid.statistics.concerns import Concern

NODES = 36


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run of a fitted experiment and one for validation, solved at the truth."""
    folder = tmp_path_factory.mktemp("seen")
    file = write_problem(folder, {"swing": 8, "nod": 6}, validation="nod")
    at_truth = settings(*(f"parameters.{name}={{fixed={value}}}" for name, value in TRUTH.items()))
    reduced = settings("solver.method=reduced-space")
    outcome = run_command("solve", file, *reduced, *at_truth, "-q", "--out", folder / "run")
    assert outcome.code == 0, outcome.err
    return folder / "run"


def frames_in(file: Path) -> list[np.ndarray]:
    with Image.open(file) as film:
        frames = []
        for number in range(getattr(film, "n_frames", 1)):
            film.seek(number)
            frames.append(np.asarray(film.convert("RGB")).astype(int))
        return frames


# What is stored


def test_a_run_stores_the_frames_of_its_film(run):
    _, (swing, nod) = read_run(run)
    assert (swing.name, nod.name) == ("swing", "nod")
    assert swing.positions_m.shape == swing.rolled_out_positions_m.shape == (9, NODES, 3)
    assert swing.rolled_out_positions_m.dtype == np.float32
    np.testing.assert_allclose(swing.rolled_out_positions_m, swing.positions_m, atol=1e-6)
    assert nod.positions_m is None
    assert nod.rolled_out_positions_m.shape == (7, NODES, 3)
    assert swing.surface.max() < NODES
    assert swing.is_prescribed.sum(axis=1).tolist() == [9] * 9
    assert (np.diff(swing.natural_hz) >= 0).all()
    np.testing.assert_allclose(swing.up, [0, 0, 1])


# Films


def test_a_film_has_its_length_and_moves(run, tmp_path):
    shares = []
    with listen_to_shares(shares.append):
        file = animate(run, tmp_path / "deep" / "film.gif", fps=20, slowdown=2)
    frames = frames_in(file)
    assert len(frames) == 4  # 0.08 s, twice as long, 20 a second
    assert shares == [0.0, 0.25, 0.5, 0.75, 1.0, None]
    assert np.abs(frames[-1] - frames[0]).max() > 100
    with Image.open(file) as film:
        assert film.info["duration"] == 50


def test_a_film_is_a_gif_in_the_run_folder_by_default(run, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    outcome = run_command("animate", copy, "--experiment", "nod", "--fps", "50")
    assert outcome.out.strip() == str(copy / "nod.gif")
    assert len(frames_in(copy / "nod.gif")) == 4


def test_the_simulation_is_drawn_as_edges_over_the_fit(run):
    _, (swing, nod) = read_run(run)
    film = FilmFigure(swing)
    assert [name for name, *_ in film.drawings] == ["fitted", "simulated"]
    film.show_sample(3)
    (*_, fitted, _), (*_, simulated, title) = film.drawings
    assert len(fitted.faces.get_facecolor()) > 1
    assert len(simulated.faces.get_facecolor()) == 0
    assert simulated.faces.get_paths()
    assert to_hex(simulated.faces.get_edgecolor()[0]) == to_hex(title.get_color()) == to_hex(GREEN)
    (alone,) = FilmFigure(nod).drawings
    assert alone[0] == "simulated"
    assert alone[3].edge_colour is None


def test_a_film_has_the_errors_of_both_beside_the_body_and_a_line_at_its_time(run):
    _, (swing, _) = read_run(run)
    film = FilmFigure(swing)
    film.show_sample(4)
    _, errors = film.figure.axes
    assert [line.get_label() for line in errors.lines[:2]] == ["fitted", "simulated"]
    assert film.cursor is not None
    assert film.cursor.get_xdata()[0] == pytest.approx(swing.t_s[4] - swing.t_s[0])
    # Of a plan, the body also moves after the end of the reference.
    ended = replace(
        swing,
        measured_m=np.where(swing.t_s[:, None, None] > swing.t_s[3], np.nan, swing.measured_m),
    )
    film = FilmFigure(ended)
    film.show_sample(len(ended.t_s) - 1)
    assert film.drawings[0][-1].get_text() == "fitted"
    end_s = swing.t_s[-1] - swing.t_s[0]
    assert film.figure.axes[1].get_xlim() == pytest.approx((0, end_s))
    unmarked = replace(swing, measured_m=np.full_like(swing.measured_m, np.nan))
    assert FilmFigure(unmarked).cursor is None
    # One sample would be a dot in empty axes.
    once_m = np.where(np.arange(len(swing.t_s))[:, None, None] == 3, swing.measured_m, np.nan)
    assert FilmFigure(replace(swing, measured_m=once_m)).cursor is None


def test_the_body_fills_a_large_part_of_the_frame(run):
    """It stood in a half of the frame beside its double."""
    _, (swing, _) = read_run(run)
    film = FilmFigure(swing)
    film.show_sample(3)
    corners = np.concatenate([path.vertices for path in film.drawings[0][3].faces.get_paths()])
    width, height = np.ptp(corners, axis=0)
    room = film.figure.axes[0].get_ylim()[1] - HEAD_HEIGHT_MM - FOOT_HEIGHT_MM
    assert max(height / room, width / FILM_WIDTH_MM) > 0.6


def test_the_film_shows_the_distance_of_markers(run):
    _, (swing, _) = read_run(run)
    film = FilmFigure(swing)
    film.show_sample(8)
    title = film.drawings[0][-1]
    assert title.get_text() == "fitted: 0.00 mm"
    assert film.time_label.get_text() == "0.08 s"


def test_frames_show_the_nearest_samples():
    times = 0.01 * np.arange(11)
    assert film_samples(times, 100.0, 1.0).tolist() == list(range(11))
    assert film_samples(times, 25.0, 1.0).tolist() == [0, 4, 8]
    assert film_samples(times, 100.0, 2.0).tolist()[:5] == [0, 0, 1, 2, 2]


@pytest.mark.skipif(not find_spec("imageio_ffmpeg"), reason="needs imageio-ffmpeg")
def test_mp4_is_written_where_ffmpeg_is(run, tmp_path):
    file = animate(run, tmp_path / "film.mp4")
    assert file.read_bytes()[4:8] == b"ftyp"


@pytest.mark.parametrize("ending", [".gif", ".mp4"])
def test_an_interrupted_film_is_an_interrupt_and_leaves_no_file(run, tmp_path, monkeypatch, ending):
    if ending == ".mp4" and not (shutil.which("ffmpeg") or find_spec("imageio_ffmpeg")):
        pytest.skip("needs ffmpeg")

    def interrupt(self: FilmFigure, sample: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(FilmFigure, "show_sample", interrupt)
    with pytest.raises(KeyboardInterrupt):
        animate(run, tmp_path / f"film{ending}")
    assert not [*tmp_path.iterdir()]


def test_without_ffmpeg_the_remedy_is_named(run, tmp_path, monkeypatch):
    monkeypatch.setattr(animation.shutil, "which", lambda name: None)
    monkeypatch.setattr(animation, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'collocation-sysid\[film\]'.*\.gif"):
        animate(run, tmp_path / "film.mp4")
    assert not (tmp_path / "film.mp4").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--to", "film.avi"], "found '.avi'; expected .mp4 or .gif"),
        (["--fps", "0"], "--fps: found 0"),
        (["--slow", "-1"], "--slow: found -1"),
        (["--slow", "1e6"], "lower --fps or --slow"),
        (["--experiment", "jump"], "found 'jump'; expected one of swing, nod"),
    ],
)
def test_a_film_that_cannot_be_is_refused(run, arguments, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = run_command("animate", run, *arguments)
    assert outcome.code == 2
    assert said in outcome.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", [["animate"], ["plot"]])
def test_other_folders_are_refused(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = run_command(command[0], tmp_path, *command[1:])
    assert (outcome.code, "not a run folder" in outcome.err) == (2, True)


def test_the_film_states_the_answer(run):
    result, (swing, _) = read_run(run)
    assert run_headline(result).startswith("E = ")
    assert run_headline(result).endswith(f"verdict: {result.trust.verdict}")
    one = a_result(
        {"core.young_pa": value(1543.21, 123.4)}, trust=Assessment((Concern("solve/moves"),))
    )
    assert run_headline(one) == "E core = 1540 ± 120 Pa; verdict: check"
    cable = a_result({"bending_n_m2": value(1.0081e-3, 1.1e-5)})
    assert run_headline(cable).startswith("EI = 0.001008 ± 0.000011 N m²; verdict: ")
    texts = [
        text.get_text()
        for text in FilmFigure(swing, headline=run_headline(result)).figure.axes[0].texts
    ]
    assert run_headline(result) in texts


def test_frames_of_a_fitted_experiment_are_listed(run):
    frames = frame_files(run, "swing")
    assert len(frames) == 9
    assert all(file.is_file() for _, file in frames)


def test_an_experiment_for_validation_has_no_frames_of_another(run):
    _, replays = read_run(run)
    nod = next(each for each in replays if each.name == "nod")
    with pytest.raises(InputError, match="'nod' of this run has no"):
        stress_on_faces(run, nod)


def test_the_stress_of_the_frames_is_given_on_the_faces(run):
    swing = read_run(run)[1][0]
    stress_pa = stress_on_faces(run, swing)
    assert stress_pa.shape == (len(swing.t_s), len(swing.surface))
    frames = frame_files(run, "swing")
    assert np.allclose([time_s for time_s, _ in frames], swing.t_s)
    cells = cells_below_faces(swing.tetrahedra, swing.surface)
    for shown_pa, (_, file) in zip(stress_pa, frames, strict=True):
        expected_pa = meshio.read(file).cell_data["von_mises_pa"][0][cells]
        np.testing.assert_array_equal(shown_pa, expected_pa)
    assert len(np.unique(stress_pa, axis=0)) > 1
