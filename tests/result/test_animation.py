"""Films, the web page and the 3-D view of a run, made from its files."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from base64 import b64decode
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from kit.problem_files import TRUTH, run_command, settings, write_problem
from kit.results import a_result, value
from matplotlib.colors import to_hex
from PIL import Image
from scipy.spatial.transform import Rotation

from collocation_sysid.common.display import escape
from collocation_sysid.common.step_counting import listen_to_shares
from collocation_sysid.errors import InputError
from collocation_sysid.result import animation, interactive_view
from collocation_sysid.result.animation import (
    FILM_WIDTH_MM,
    FOOT_HEIGHT_MM,
    HEAD_HEIGHT_MM,
    FilmFigure,
    animate,
    film_samples,
)
from collocation_sysid.result.figure_style import GREEN
from collocation_sysid.result.interactive_view import export_page, frame_files, view_run
from collocation_sysid.result.replay import read_run, run_headline
from collocation_sysid.result.web_page import Colouring, surface_strain, write_page
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


def test_a_run_stores_what_is_needed_to_look_at_it(run):
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
    assert [each.name for each in film.drawings] == ["fitted", "simulated"]
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
    unmarked = replace(swing, measured_m=np.full_like(swing.measured_m, np.nan))
    assert FilmFigure(unmarked).cursor is None


def test_the_body_fills_a_large_part_of_the_frame(run):
    """It stood in a half of the frame beside its double."""
    _, (swing, _) = read_run(run)
    film = FilmFigure(swing)
    film.show_sample(3)
    corners = np.concatenate([path.vertices for path in film.drawings[0].body.faces.get_paths()])
    width, height = np.ptp(corners, axis=0)
    room = film.figure.axes[0].get_ylim()[1] - HEAD_HEIGHT_MM - FOOT_HEIGHT_MM
    assert max(height / room, width / FILM_WIDTH_MM) > 0.6


def test_the_film_says_how_far_the_markers_are_off(run):
    _, (swing, _) = read_run(run)
    film = FilmFigure(swing)
    film.show_sample(8)
    title = film.drawings[0].title
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


@pytest.mark.parametrize("command", [["animate"], ["view", "--html", "a.html"], ["plot"]])
def test_other_folders_are_refused(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = run_command(command[0], tmp_path, *command[1:])
    assert (outcome.code, "not a run folder" in outcome.err) == (2, True)


# The web page


def content(page: Path) -> dict:
    text = re.search(r"const DATA = (\{.*\});", page.read_text(encoding="utf-8"))
    assert text is not None
    return json.loads(text[1])


def test_the_page_needs_nothing_else_and_holds_the_motion(run, tmp_path):
    outcome = run_command("view", run, "--html", tmp_path / "page.html")
    assert outcome.out.strip() == str(tmp_path / "page.html")
    assert "http" not in (tmp_path / "page.html").read_text(encoding="utf-8")
    data, (_, (swing, _)) = content(tmp_path / "page.html"), read_run(run)
    outer = np.unique(swing.surface)
    for name, positions in (
        ("fitted", swing.positions_m),
        ("simulated", swing.rolled_out_positions_m),
    ):
        shapes = np.frombuffer(b64decode(data["shapes"][name]), "<f4").reshape(9, -1, 3)
        np.testing.assert_allclose(shapes, positions[:, outer], atol=1e-6)
    faces = np.frombuffer(b64decode(data["faces"]), "<i4").reshape(-1, 3)
    np.testing.assert_array_equal(outer[faces], swing.surface)
    strains = np.frombuffer(b64decode(data["shares"]["fitted"]), "u1").reshape(9, -1)
    assert strains.shape[1] == len(faces)
    assert strains.max() == 255
    assert strains[data["opening"]].mean() == strains.mean(axis=1).max() > 0


def test_names_are_shown_on_the_page_and_fill_no_place_of_it(run, tmp_path):
    _, (swing, _) = read_run(run)
    name = "@DATA@ @HEADLINE@ </title><script><!-- \x1b"
    quantity = Colouring.by_field("<!--<script>", surface_strain(swing, swing.positions_m))
    page = write_page(replace(swing, name=name), tmp_path / "a.html", colouring=quantity)
    text = page.read_text(encoding="utf-8")
    assert re.findall(r"<title>(.*)</title>", text) == [escape(name)]
    assert "@DATA@ @HEADLINE@" in text
    assert "\x1b" not in text
    assert "<!--" not in text
    assert text.count("<script>") == 1
    assert content(page)["quantity"] == "<!--<script>"


def test_a_page_is_coloured_by_the_field_asked_for(run, tmp_path):
    page = tmp_path / "page.html"
    assert run_command("view", run, "--html", page, "--field", "displacement_m").code == 0
    data, swing = content(page), read_run(run)[1][0]
    assert (data["quantity"], list(data["shapes"])) == ("displacement_m", ["fitted"])
    moved_m = (swing.positions_m - swing.undeformed_m)[:, swing.surface].mean(axis=2)
    far_m = np.linalg.norm(moved_m, axis=2)
    shares = np.frombuffer(b64decode(data["shares"]["fitted"]), "u1").reshape(far_m.shape)
    expected = (far_m - far_m.min()) / np.ptp(far_m)
    np.testing.assert_allclose(shares / 255, expected, atol=0.003)
    assert data["ends"] == [f"{far_m.min():.3g}", f"{far_m.max():.3g} displacement_m"]
    assert run_command("view", run, "--html", page, "--field", "von_mises_pa").code == 0
    assert content(page)["quantity"] == "von_mises_pa"
    refused = run_command("view", run, "--html", page, "--field", "stress")
    assert refused.code == 2
    assert "found 'stress'; expected one of det_f" in refused.err


def test_page_and_film_say_what_was_found(run, tmp_path):
    result, (swing, _) = read_run(run)
    assert run_headline(result).startswith("E = ")
    assert run_headline(result).endswith(f"verdict: {result.trust.verdict}")
    one = a_result(
        {"core.young_pa": value(1543.21, 123.4)}, trust=Assessment((Concern("solve/moves"),))
    )
    assert run_headline(one) == "E core = 1543.2 ± 120 Pa; verdict: check"
    run_command("view", run, "--html", tmp_path / "page.html")
    assert run_headline(result) in (tmp_path / "page.html").read_text(encoding="utf-8")
    texts = [
        text.get_text()
        for text in FilmFigure(swing, headline=run_headline(result)).figure.axes[0].texts
    ]
    assert run_headline(result) in texts


def test_turning_is_no_strain_and_stretching_is(run):
    swing = read_run(run)[1][0]
    x = swing.undeformed_m
    turned = Rotation.from_rotvec([0.3, -1.2, 0.5]).apply(x)
    strain = surface_strain(swing, np.stack([turned, x * [1.25, 1.0, 1.0]]))
    np.testing.assert_allclose(strain[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(strain[1], 0.25)


@pytest.mark.skipif(not shutil.which("node"), reason="needs node")
def test_the_page_has_no_syntax_error(run, tmp_path):
    run_command("view", run, "--html", tmp_path / "page.html")
    script = re.search(r"<script>(.*)</script>", (tmp_path / "page.html").read_text(), re.DOTALL)
    assert script is not None
    (tmp_path / "page.js").write_text(script[1], encoding="utf-8")
    subprocess.run(["node", "--check", tmp_path / "page.js"], check=True)


# The 3-D view


def test_without_pyvista_the_remedy_is_named(run, monkeypatch):
    monkeypatch.setattr("collocation_sysid.result.interactive_view.find_spec", lambda name: None)
    outcome = run_command("view", run)
    assert outcome.code == 2
    assert "pip install 'collocation-sysid[view]'" in outcome.err


def test_the_view_finds_the_frames(run):
    frames = frame_files(run, "swing")
    assert len(frames) == 9
    assert all(file.is_file() for _, file in frames)


def test_an_experiment_for_validation_has_no_frames_of_another(run, tmp_path):
    page = tmp_path / "page.html"
    with pytest.raises(InputError, match="'nod' of this run has no"):
        export_page(run, page, "nod", field="det_f")
    assert not page.exists()
    assert export_page(run, page, "nod").exists()


def test_a_field_can_colour_the_simulated_body(run, tmp_path):
    _, replays = read_run(run)
    nod = next(each for each in replays if each.name == "nod")
    values = np.ones((len(nod.t_s), len(nod.surface)))
    colouring = Colouring.by_field("ones", values, trajectory="simulated")
    file = write_page(nod, tmp_path / "page.html", colouring=colouring)
    assert "1 ones" in file.read_text(encoding="utf-8")


def test_the_view_shows_no_markers_of_an_earlier_sample():
    """With a plotter that stores its actors by name, in place of VTK's."""
    shown: dict[str, object] = {}
    window = object.__new__(interactive_view._FrameWindow)
    window.times = np.array([0.0, 1.0])
    window.meshes = ["first", "second"]
    window.field = "det_f"
    window.range = (0.0, 1.0)
    window.pv = SimpleNamespace(PolyData=lambda points: points)
    window.plotter = SimpleNamespace(
        add_mesh=lambda mesh, name, **_: shown.update({name: mesh}),
        remove_actor=lambda name, **_: shown.pop(name, None),
    )
    nodes_m = np.zeros((2, 4, 3))
    window.replay = SimpleNamespace(
        t_s=window.times,
        obstacles_m=None,
        measured_m=np.array([[[0.0, 0.0, 1.0]], [[np.nan] * 3]]),
        shapes_m=nodes_m,
        is_prescribed=np.array([[True] * 4, [False] * 4]),
    )
    window.show_nearest_frame(0.0)
    assert {*shown} == {"body", "measured", "grasped"}
    window.show_nearest_frame(1.0)
    assert shown == {"body": "second"}


@pytest.mark.slow  # starting VTK takes longer than everything else here
def test_the_view_colours_the_body_by_a_field(run, tmp_path):
    pytest.importorskip("pyvista")
    view_run(run, "det_f", screenshot=tmp_path / "view.png")
    (picture,) = frames_in(tmp_path / "view.png")
    assert picture.std() > 5
    with pytest.raises(InputError, match="expected one of det_f, energy_density_j_m3"):
        view_run(run, "colour", screenshot=tmp_path / "view.png")
