"""Malformed keys, numbers, meshes and recordings get one short, printable message."""

from __future__ import annotations

import os
import signal
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import (
    Outcome,
    replace_cell,
    replace_line,
    replace_text,
    run_command,
    settings,
)

from collocation_sysid.common.display import plain_text
from collocation_sysid.errors import InputError
from collocation_sysid.fem.meshes.mesh import TetMesh
from collocation_sysid.recording.marker_files import read_markers
from collocation_sysid.recording.sources import c3d

MARKERS, POSES = "swing_markers.csv", "swing_motion.csv"
RED = "\x1b[31m"


def refused(*words: object) -> str:
    outcome = run_command(*words)
    assert outcome.code == 2, outcome
    assert len(outcome.err.strip().splitlines()) == 1
    assert len(outcome.err) < 700
    assert_harmless(outcome)
    return outcome.err


def assert_harmless(outcome: Outcome) -> None:
    said = outcome.out + outcome.err
    assert not [mark for mark in said if not (mark.isprintable() or mark == "\n")]


@contextmanager
def bounded(seconds: int) -> Iterator[None]:
    """End what would take minutes."""

    def end(*_: object, **__: object) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


# Keys ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("table", ["", "[object]\n", "[transcription]\n"])
@pytest.mark.parametrize("key", ["<b>", "<table>", ""])
def test_a_key_in_angle_brackets_is_as_unknown_as_any_other(tiny: Path, table: str, key: str):
    with (tiny / "problem.toml").open() as file:
        text = file.read()
    added = f'"{key}" = 1\n'
    text = text.replace(table, table + added, 1) if table in text else text + table + added
    (tiny / "problem.toml").write_text(text)
    assert f"{key}: unknown key" in refused("check", "problem.toml")


def test_a_key_without_end_is_refused_unparsed(tiny: Path, monkeypatch: pytest.MonkeyPatch):
    key = 50_000 * "a." + "b = 1\n"
    monkeypatch.setattr(tomllib, "loads", lambda _: pytest.fail("this takes minutes"))
    for part in (key, key.replace("a.", "'a' . "), key.replace("a.", '"a".'), f"[{key[:-5]}]\n"):
        (tiny / "problem.toml").write_text(f"title = 'x'\n{part}")
        assert "too deeply" in refused("check", "problem.toml")


def test_long_words_and_lists_are_no_endless_keys(tiny: Path):
    for title in (1_000_000 * "a", 400 * "1.5, ", 90 * "a."):
        replace_text('title = "A tiny foam bar"', f'title = "{title}"')(tiny)
        assert run_command("check", "problem.toml", "--json").code in (0, 1)
        replace_text(f'title = "{title}"', 'title = "A tiny foam bar"')(tiny)


@pytest.mark.skipif(os.name != "posix", reason="alarms of POSIX")
@pytest.mark.parametrize(
    "value",
    [
        pytest.param("1.0", marks=pytest.mark.long),
        pytest.param("{}", marks=pytest.mark.long),
        "{ tied_to = 'mu_pa' }",
    ],
)
def test_the_first_of_endless_unknown_parameters_is_named(tiny: Path, value: str):
    many = "".join(f"mu_pb{k} = {value}\n" for k in range(20_000))
    replace_text("[parameters]\n", f"[parameters]\n{many}")(tiny)
    with bounded(60):
        assert "parameters.mu_pb0" in refused("check", "problem.toml")


# Numbers ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", ["١", "１", "٣.٥"])
@pytest.mark.parametrize("file", [MARKERS, POSES])
def test_only_digits_of_ascii_are_digits(tiny: Path, file: str, number: str):
    replace_cell(file, 3, 1, number)(tiny)
    assert f"'{number}'; expected a number" in refused("check", "problem.toml")


@pytest.mark.parametrize("mark", "\ufeff\u200b\u2060\xad\u2028\u200e")
def test_an_invisible_character_in_a_number_is_made_visible(tiny: Path, mark: str):
    replace_cell(MARKERS, 3, 1, f"0.0{mark}1")(tiny)
    assert "'0.0\ufffd1'; expected a number" in refused("check", "problem.toml")


def test_foreign_digits_are_no_places_in_a_list_and_no_counts(tiny: Path):
    words = settings("experiment.٠.start=undeformed")
    assert "expected its number, from 0" in refused("check", "problem.toml", *words)
    assert "whole numbers" in refused("compare-models", "problem.toml", "--prony", "0,١")


@pytest.mark.parametrize("value", ["nan", "{ a = nan }", "{ guess = nan }"])
def test_a_number_that_is_none_is_quoted(tiny: Path, value: str):
    words = settings(f"parameters.mu_pa={value}")
    assert "found nan; expected a finite number" in refused("check", "problem.toml", *words)


# What is quoted -----------------------------------------------------------------------------------


NULS = 10_000 * "\0"


@pytest.mark.parametrize(
    "edit",
    [
        replace_text("[object]", f"[object]\n{NULS} = 1"),
        replace_text('"A tiny foam bar"', f'"{NULS}"'),
        replace_line(MARKERS, 3, lambda _: NULS),
        replace_cell(MARKERS, 3, 1, 10_000 * "x"),
        replace_line(MARKERS, 1, lambda head: head.replace("low_x", 10_000 * "x" + "_x")),
    ],
    ids=["key", "text", "row", "cell", "name"],
)
def test_a_message_quotes_no_more_than_helps(tiny: Path, edit):
    edit(tiny)
    refused("check", "problem.toml")


@pytest.mark.parametrize(
    "override", [NULS, f"title.a={NULS}", f"experiment.{NULS}.x=1", f"{NULS}=[", f"mu_pa=[{NULS}"]
)
def test_a_message_about_an_override_quotes_no_more_than_helps(tiny: Path, override: str):
    refused("check", "problem.toml", *settings(override))


@pytest.mark.parametrize(
    "edit",
    [
        replace_text("[object]", r'[object]' "\n" r'"\u001b[31mred" = 1'),
        replace_text('mesh = "body.vtu"', r'mesh = "\u001b[31mred"'),
        replace_text("low = [", r'"\u001b[31mred" = ['),
        replace_line(MARKERS, 1, lambda head: head.replace("low_", f"{RED}low_")),
        replace_cell(MARKERS, 3, 1, f"{RED}1"),
        replace_line(POSES, 1, lambda head: head.replace("x_m", f"{RED}x_m")),
    ],
    ids=["key", "file", "marker", "column", "cell", "pose"],
)  # fmt: skip
def test_escapes_of_a_terminal_are_shown_and_not_sent(tiny: Path, edit):
    edit(tiny)
    assert "[31m" in refused("check", "problem.toml")


def test_a_message_is_one_line_for_any_quotation(tiny: Path):
    replace_text("[object]", '[object]\n"a\\nerror: forged" = 1')(tiny)
    assert "object.a␊error: forged: unknown key" in refused("check", "problem.toml")


def test_names_in_tables_are_shown_unchanged(tiny: Path):
    for file in ("problem.toml", MARKERS):
        text = (tiny / file).read_text()
        name = r'"\u001b[2J[/b]:smile:"' if file == "problem.toml" else "\x1b[2J[/b]:smile:"
        text = text.replace("side = [", f"{name} = [").replace("side_", f"{name}_")
        (tiny / file).write_text(text)
    method = settings("solver.method=reduced-space")
    outcome = run_command("solve", "problem.toml", "-v", "--details", *method, "--out", "run")
    assert outcome.code == 0, outcome
    assert_harmless(outcome)
    assert "␛[2J[/b]:smile:" in outcome.out


def test_a_table_in_a_notebook_sends_none_either():
    assert plain_text(f"{RED}red") == "␛[31mred"


# Meshes and recordings ----------------------------------------------------------------------------


VERTICES = "0 0 0\n1 0 0\n0 1 0\n0 0 1\n"
PLY = f"""ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
{VERTICES}"""
OBJ = "".join(f"v {row}\n" for row in VERTICES.splitlines())


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.ply", f"{PLY}0\n"),
        ("a.obj", f"{OBJ}f 1 2\n"),
        ("a.obj", f"{OBJ}f 1 2 {20 * '9'}\n"),
        ("a.obj", "f 1 2 3\n"),
    ],
)
def test_a_damaged_surface_is_refused(tmp_path: Path, name: str, content: str):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=f"{name}: the file cannot be read as a mesh"):
        TetMesh.from_surface(tmp_path / name, 0.02)


def test_a_c3d_that_crashes_its_reader_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file = whole_c3d(tmp_path)
    content = bytearray(file.read_bytes())
    for at, value in ((756, 42), (868, 111), (1002, 229)):
        content[at] = value
    file.write_bytes(content)
    with suppress(InputError):  # a later ezc3d may read it; this process must go on
        read_markers(file)
    whole_c3d(tmp_path)
    monkeypatch.setattr(c3d, "WORKER", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    with pytest.raises(InputError, match=r"C3D file is damaged.*killed by SIGSEGV"):
        read_markers(file)


def whole_c3d(folder: Path) -> Path:
    ezc3d = pytest.importorskip("ezc3d")
    recording = ezc3d.c3d()
    recording["parameters"]["POINT"]["RATE"]["value"] = [100]
    recording["parameters"]["POINT"]["LABELS"]["value"] = ("a", "b")
    recording["parameters"]["POINT"]["UNITS"]["value"] = ["m"]
    recording["data"]["points"] = np.random.default_rng(0).normal(size=(4, 2, 6))
    recording.write(str(folder / "take.c3d"))
    return folder / "take.c3d"
