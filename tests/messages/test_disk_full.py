"""A full disk leaves existing files complete, and the message names the file."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from kit.problem_files import Outcome, contents, run_command, settings, write_problem

from collocation_sysid.cli import problem_commands
from collocation_sysid.common.files import replaced_file, write_text_file
from collocation_sysid.result import run_record
from collocation_sysid.result.replay import read_run
from collocation_sysid.result.run_writers import replaced_folder
from collocation_sysid.runs.result_content import Result
from collocation_sysid.runs.solved_problem import SolvedProblem

resource = pytest.importorskip("resource", reason="limits of POSIX")


@contextmanager
def room_for(size: int) -> Iterator[None]:
    """No file may grow beyond so many bytes, which meets writers as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def run_without_room(*words: object, size: int = 300) -> Outcome:
    with room_for(size):
        return run_command(*words)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished")
    file = write_problem(folder, {"swing": 6})
    method = settings("solver.method=reduced-space")
    assert run_command("solve", file, *method, "--out", folder / "run", "-q").code == 0
    return folder / "run"


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    shutil.copytree(finished, tmp_path / "run")
    return tmp_path / "run"


def refused(folder: Path, names: str, *words: object) -> None:
    before = contents(folder)
    outcome = run_without_room(*words)
    assert outcome.code == 2, outcome
    assert outcome.err.startswith("error: ")
    assert outcome.err.count("\n") == 1, outcome.err
    assert f"{names}: this cannot be written: File too large" in outcome.err
    assert contents(folder) == before


def test_a_page_is_there_whole_or_as_before(run: Path, tmp_path: Path):
    refused(tmp_path, "report.html", "report", run)
    (tmp_path / "page.html").write_text("an earlier page")
    refused(tmp_path, "page.html", "report", run, "--to", tmp_path / "page.html")


@pytest.mark.long
def test_pictures_and_films_are_there_whole_or_not_at_all(run: Path, tmp_path: Path):
    refused(tmp_path, ".png", "plot", run)
    refused(tmp_path, "film.gif", "animate", run, "--to", tmp_path / "film.gif", "--fps", "2")


def test_an_export_is_there_whole_or_not_at_all(run: Path, tmp_path: Path):
    refused(tmp_path, "out", "export", run, "--to", "febio", "--out", tmp_path / "out")


def test_a_problem_is_begun_whole_or_not_at_all(tmp_path: Path):
    with room_for(300):
        outcome = run_command("new", tmp_path / "mine")
    assert outcome.code == 2
    assert "problem.toml: this cannot be written" in outcome.err
    assert not list(tmp_path.rglob("*.toml"))


@pytest.mark.parametrize(
    ("words", "number"), [((), 1), (("--kind", "swing"), 3), (("--dataset", "kawabata_1981"), 5)]
)
def test_a_disk_that_is_full_at_a_later_file_leaves_no_part_of_a_problem(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], number: int
):
    write, written = Path.write_bytes, []

    def write_some(file: Path, content: bytes) -> int:
        written.append(file)
        if len(written) == number:
            full_disk()
        return write(file, content)

    monkeypatch.setattr(Path, "write_bytes", write_some)
    outcome = run_command("new", tmp_path / "above" / "mine", *words)
    assert outcome.code == 2
    assert "this cannot be written: No space left on device" in outcome.err
    assert len(written) == number
    assert not [*tmp_path.iterdir()]


@pytest.mark.long
def test_a_simulation_writes_all_its_files_or_none(tiny: Path):
    command = ["simulate", "problem.toml", "--out", "data", "--frames"]
    assert run_command(*command).code == 0
    largest = max(file.stat().st_size for file in Path("data").glob("*.csv"))
    shutil.rmtree("data")
    for size, named in ((300, "swing_markers.csv"), (largest + 1, "swing")):
        outcome = run_without_room(*command, size=size)
        assert outcome.code == 2
        assert f"data/{named}: this cannot be written" in outcome.err
        assert not [each for each in Path("data").rglob("*") if each.is_file()]


def test_an_answer_that_finds_no_room_leaves_the_earlier_run(tiny: Path):
    method = settings("solver.method=reduced-space")
    command = ["solve", "problem.toml", *method, "--out", "run", "-q"]
    assert run_command(*command).code == 0
    before = contents(tiny)
    for size in (100, 3000):
        outcome = run_without_room(*command, size=size)
        assert outcome.code == 2
        assert "run: this cannot be written" in outcome.err
        assert contents(tiny) == before


def test_a_file_keeps_its_ending_while_being_written(tmp_path: Path):
    with replaced_file(tmp_path / "deep" / "a.tar.png") as draft:
        assert draft.suffix == ".png"
        draft.write_text("x")
    assert [file.name for file in (tmp_path / "deep").iterdir()] == ["a.tar.png"]


def test_into_a_pipe_is_written_directly(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe")
    got: list[str] = []
    reader = threading.Thread(
        target=lambda: got.append((tmp_path / "pipe").read_text()), daemon=True
    )
    reader.start()
    write_text_file(tmp_path / "pipe", "a page")
    reader.join(10)
    assert got == ["a page"]
    assert (tmp_path / "pipe").is_fifo()


def test_the_message_names_the_folder_and_not_the_passing_one(tmp_path: Path):
    with (
        room_for(10),
        pytest.raises(ValueError, match="run: this cannot be written") as caught,
        replaced_folder(tmp_path / "run") as place,
    ):
        write_text_file(place / "table.csv", 100 * "x")
    assert ".partial" not in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.long
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no such device here")
def test_an_output_that_is_full_is_reported():
    program = [sys.executable, "-c", "from collocation_sysid.cli import main; main()", "schema"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(program, stdout=full, stderr=subprocess.PIPE, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stderr.startswith("error: standard output, or a temporary file: No space left")
    assert done.stderr.count("\n") == 1


def full_disk(*_: object, **__: object) -> None:
    raise OSError(28, "No space left on device")


def solved_on_a_full_disk(tiny: Path, monkeypatch: pytest.MonkeyPatch, *words: str) -> Outcome:
    """Solve where temporary files go to the folder "spare"."""
    (tiny / "spare").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tiny / "spare"))
    method = settings("solver.method=reduced-space")
    return run_command("solve", "problem.toml", *method, "--out", "run", *words)


def test_a_run_that_finds_no_room_is_kept_whole_elsewhere(
    tiny: Path, monkeypatch: pytest.MonkeyPatch
):
    write = run_record.write_all_frames
    monkeypatch.setattr(
        run_record,
        "write_all_frames",
        lambda solved, place: (write if "spare" in str(place) else full_disk)(solved, place),
    )
    outcome = solved_on_a_full_disk(tiny, monkeypatch, "-q")
    (kept,) = (tiny / "spare").iterdir()
    assert outcome.code == 2
    assert f"No space left on device; the run is kept in {kept}: move it" in outcome.err
    assert not (tiny / "run").exists()
    assert (kept / "trajectory.npz").is_file()
    result, _ = read_run(kept)
    assert result.status == "converged"


def test_the_result_alone_is_kept_if_there_is_room_for_no_more(
    tiny: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(run_record, "write_all_frames", full_disk)
    outcome = solved_on_a_full_disk(tiny, monkeypatch, "--json", "-q")
    (kept,) = (tiny / "spare").iterdir()
    assert outcome.code == 2
    assert f"its result.json alone is kept in {kept}: move it" in outcome.err
    assert {each.name for each in kept.iterdir()} == {"result.json", "problem.toml"}
    assert Result.read(kept).status == "converged"
    assert json.loads(outcome.out)["status"] == "converged"


def test_output_that_cannot_be_written_loses_no_run(tiny: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(problem_commands, "print_result", full_disk)
    method = settings("solver.method=reduced-space")
    outcome = run_command("solve", "problem.toml", *method, "--out", "run", "-q")
    assert outcome.code == 2
    assert "No space left on device" in outcome.err
    assert Result.read(tiny / "run").status == "converged"


@pytest.mark.parametrize(
    ("has_earlier", "other", "reason"),
    [
        (False, "run", "another run was written to this folder meanwhile"),
        (True, "run", "another run was written to this folder meanwhile"),
        (True, "notes", "notes.txt in this folder was not written by this program"),
    ],
)
def test_a_run_whose_folder_another_process_wrote_meanwhile_is_kept_elsewhere(
    tiny: Path, monkeypatch: pytest.MonkeyPatch, has_earlier: bool, other: str, reason: str
):
    solve = problem_commands.run

    def solve_meanwhile(*arguments: object, **options: object) -> SolvedProblem:
        finished = solve(*arguments, **options)
        if other == "run":
            finished.save("run", frames=False, pictures=False)
        else:
            Path("run/notes.txt").write_text("mine")
        return finished

    if has_earlier:
        method = settings("solver.method=reduced-space")
        assert run_command("solve", "problem.toml", *method, "--out", "run", "-q").code == 0
    monkeypatch.setattr(problem_commands, "run", solve_meanwhile)
    outcome = solved_on_a_full_disk(tiny, monkeypatch, "-q")
    (kept,) = (tiny / "spare").iterdir()
    assert outcome.code == 2
    assert reason in outcome.err
    assert f"; the run is kept in {kept}: move it to another place" in outcome.err
    assert (tiny / "run" / "frames").exists() is (other == "notes")
    assert read_run(kept)[0].status == "converged"


@pytest.mark.parametrize(
    "words",
    [
        ("refine", "."),
        ("track", "film.mp4", "--out", "tracks.csv"),
        ("track", "film.mp4", "--out", "../tracks.csv", "--film", "seen.mp4"),
        ("new", "body"),
    ],
)
def test_a_folder_that_is_not_writable_is_refused_before_work(monkeypatch, tmp_path, words):
    (tmp_path / "film.mp4").touch()
    monkeypatch.chdir(tmp_path)
    kept = os.access
    monkeypatch.setattr(os, "access", lambda place, mode: mode != os.W_OK and kept(place, mode))
    refused = run_command(*words)
    assert refused.code == 2
    assert refused.err.count("\n") == 1
    assert "this folder is not writable; expected one that is" in refused.err
    assert [each.name for each in tmp_path.iterdir()] == ["film.mp4"]
