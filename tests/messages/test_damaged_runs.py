"""Damaged or foreign result folders get one message and exit code 2 from every command."""

from __future__ import annotations

import base64
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from kit.problem_files import run_command, settings, write_problem

from collocation_sysid.errors import InputError
from collocation_sysid.result.frame_fields import frame_files
from collocation_sysid.runs.warm_start import WarmStart

Damage = Callable[[Path], object]
links = pytest.mark.skipif(os.name != "posix", reason="links need rights here")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished")
    write_problem(folder, {"swing": 6})
    method = settings("solver.method=reduced-space")
    done = run_command(
        "solve", folder / "problem.toml", *method, "--out", folder / "run", "--quiet"
    )
    assert done.code == 0, done.err
    return folder / "run"


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    shutil.copytree(finished, tmp_path / "run")
    return tmp_path / "run"


def whole(content: str | bytes, file: str = "result.json") -> Damage:
    data = content.encode() if isinstance(content, str) else content
    return lambda run: (run / file).write_bytes(data)


def cut(file: str) -> Damage:
    return lambda run: (run / file).write_bytes((run / file).read_bytes()[:500])


def entry(value: Any, *keys: str) -> Damage:
    def damage(run: Path) -> None:
        result = json.loads((run / "result.json").read_text())
        place = result
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value
        (run / "result.json").write_text(json.dumps(result))

    return damage


def array(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    def damage(run: Path) -> None:
        with np.load(run / "trajectory.npz") as stored:
            arrays = dict(stored)
        arrays[name] = change(arrays[name])
        np.savez(run / "trajectory.npz", **arrays)

    return damage


def gone(file: str) -> Damage:
    return lambda run: (run / file).unlink()


def refused(*words: object) -> str:
    outcome = run_command(*words)
    assert outcome.code == 2, f"{outcome.code}: {outcome.out}{outcome.err}"
    assert len(outcome.err.strip().splitlines()) == 1
    assert outcome.err.startswith("error: ")
    return outcome.err


def of_result(id: str, damage: Damage):
    return pytest.param(damage, id=id)


RESULTS = [
    of_result("gone", gone("result.json")),
    of_result("empty", whole("")),
    of_result("cut", cut("result.json")),
    of_result("noise", whole(bytes(range(256)))),
    of_result("a list", whole("[1, 2]")),
    of_result("another's", whole('{"schema": 7, "answer": 42}')),
    of_result("deep", whole("[" * 100_000)),
    of_result("digits", whole('{"fit": ' + "9" * 5000 + "}")),
]
ENTRIES = [
    of_result("no parameters", entry(None, "parameters")),
    of_result("fit of another kind", entry([1], "fit")),
    of_result("text for a number", entry("x", "parameters", "mu_pa", "value")),
    of_result("table for a number", entry({}, "rollout", "experiments", "swing")),
]
ARRAYS = [
    of_result("gone", gone("trajectory.npz")),
    of_result("cut", cut("trajectory.npz")),
    of_result("noise", whole(b"PK\x03\x04 and then nothing", "trajectory.npz")),
    of_result("not an archive", whole(os.urandom(300), "trajectory.npz")),
    of_result("fewer nodes", array("undeformed_m", lambda x: x[:5])),
    of_result("flat", array("positions_m", np.ravel)),
    of_result("texts", array("measured_m", lambda x: x.astype(str))),
    of_result("huge", array("markers_m", lambda x: x + 1e300)),
    of_result("foreign nodes", array("surface", lambda x: x + 1000)),
    of_result("foreign parts", array("surface_parts", lambda x: x + 7)),
    of_result("standing time", array("t_s", np.zeros_like)),
    of_result("no samples", array("is_prescribed", lambda x: x[:0])),
]


@pytest.mark.parametrize("damage", RESULTS)
def test_every_reader_refuses_a_damaged_result(run: Path, tmp_path: Path, damage: Damage):
    damage(run)
    refused("report", run)
    refused("plot", run)
    refused("animate", run, "--to", tmp_path / "film.gif")
    refused("refine", run)
    assert not (tmp_path / "page.html").exists()


@pytest.mark.parametrize("damage", ENTRIES)
def test_the_page_refuses_entries_of_another_kind(run: Path, damage: Damage):
    damage(run)
    assert "damaged" in refused("report", run)
    assert not (run / "report.html").exists()


@pytest.mark.parametrize("damage", ARRAYS)
def test_every_reader_of_arrays_refuses_damaged_ones(run: Path, tmp_path: Path, damage: Damage):
    damage(run)
    refused("plot", run)
    refused("animate", run, "--to", tmp_path / "film.gif")


@pytest.mark.parametrize(
    "damage", [whole("{"), entry(None, "derived"), entry(1e400, "parameters", "mu_pa", "value")]
)
def test_a_damaged_run_is_no_start(run: Path, damage: Damage):
    damage(run)
    with pytest.raises(InputError, match="damaged"):
        WarmStart.read(run)
    assert "damaged" in refused("solve", run / "problem.toml", "--start", run)


@pytest.mark.parametrize("name", ["lambda_pa", "gamma_r_s"])
def test_a_run_without_one_of_its_parameters_is_not_exported(run: Path, tmp_path: Path, name: str):
    result = json.loads((run / "result.json").read_text())
    del result["parameters"][name]
    whole(json.dumps(result))(run)
    assert "damaged" in refused("export", run, "--to", "json", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_film_lies_in_the_run_folder_whatever_the_experiment_is_called(run: Path):
    text = (run / "result.json").read_text()
    whole(text.replace('"swing"', '"../swing"'))(run)
    outcome = run_command("animate", run, "--fps", "2", "-q")
    assert outcome.code == 0, outcome
    assert not list(run.parent.glob("*.gif"))
    assert (run / ".._swing.gif").is_file()


@pytest.mark.parametrize("command", ["report", "plot", "animate", "refine"])
def test_a_file_is_no_run_folder(command: str, tmp_path: Path):
    (tmp_path / "run").write_text("no folder")
    assert "run" in refused(command, tmp_path / "run")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes by name here")
def test_a_pipe_in_a_run_folder_is_not_waited_for(run: Path):
    os.mkfifo(run / "mesh.png")
    assert run_command("report", run).code == 0
    (run / "result.json").unlink()
    os.mkfifo(run / "result.json")
    assert "is a pipe; expected a regular file" in refused("report", run)


@pytest.mark.parametrize("content", ["<", "<a/>", '<a><DataSet timestep="x" file="b"/></a>'])
def test_damaged_frames_are_refused(run: Path, content: str):
    (run / "trajectory.pvd").write_text(content)
    with pytest.raises(InputError, match=r"trajectory.pvd or one of its frames is damaged"):
        frame_files(run, "swing")


@pytest.mark.parametrize("command", ["report", "plot", "animate", "refine"])
def test_a_run_of_another_version_is_refused(run: Path, command: str):
    entry(1, "schema")(run)
    assert "result.json has schema 1; expected 6, which this version writes" in refused(
        command, run
    )


# Links --------------------------------------------------------------------------------------------

SECRET = "a text of another folder"


@pytest.fixture
def elsewhere(tmp_path: Path) -> Path:
    (tmp_path / "secret").write_text(SECRET)
    return tmp_path / "secret"


@links
@pytest.mark.parametrize("name", ["x.png", "problem.toml"])
def test_the_page_of_a_run_shows_nothing_behind_links(run: Path, elsewhere: Path, name: str):
    (run / name).unlink(missing_ok=True)
    (run / name).symlink_to(elsewhere)
    assert run_command("report", run).code == 0
    page = (run / "report.html").read_text()
    assert SECRET not in page
    assert base64.b64encode(SECRET.encode()).decode() not in page


@links
@pytest.mark.parametrize(
    ("name", "command"), [("result.json", "report"), ("trajectory.npz", "plot")]
)
def test_a_result_that_is_a_link_to_elsewhere_is_refused(
    run: Path, tmp_path: Path, name: str, command: str
):
    (run / name).rename(tmp_path / name)
    (run / name).symlink_to(tmp_path / name)
    assert "is a link to a file outside of the folder" in refused(command, run)


@links
def test_links_within_the_folder_are_followed(run: Path):
    (run / "result.json").rename(run / "found.json")
    (run / "result.json").symlink_to("found.json")
    (run / "own.png").write_bytes(SECRET.encode())
    (run / "x.png").symlink_to("own.png")
    assert run_command("report", run).code == 0
    assert base64.b64encode(SECRET.encode()).decode() in (run / "report.html").read_text()


@links
def test_a_page_is_not_written_through_a_link(run: Path, elsewhere: Path):
    (run / "report.html").symlink_to(elsewhere)
    assert run_command("report", run).code == 0
    assert elsewhere.read_text() == SECRET
    assert not (run / "report.html").is_symlink()


@links
def test_frames_outside_the_folder_are_refused(run: Path, elsewhere: Path):
    frames = (run / "trajectory.pvd").read_text()
    (run / "trajectory.pvd").write_text(frames.replace("frames/frame_0000.vtu", "../secret"))
    with pytest.raises(InputError, match="outside the run folder"):
        frame_files(run, "swing")
