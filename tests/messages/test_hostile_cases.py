"""The script that damages input: its counts, and that every case ends with a message."""

from __future__ import annotations

import io
import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("resource", reason="limits of POSIX")

import hostile
from hostile import CommandEnd

TRACEBACK = "Traceback (most recent call last):\n  ...\nKeyError: 3\n"


@pytest.mark.parametrize(
    ("ended", "is_clean", "outcome"),
    [
        (CommandEnd(2, "", "error: a.csv: no number\n"), True, "refused"),
        (CommandEnd(2, "", "error: a.csv: no number\n"), False, "unclear"),
        (CommandEnd(2, "", "a library's line\nerror: a.csv: no number\n"), True, "unclear"),
        (CommandEnd(2, "", "error: \x1b[31m\n"), True, "unclear"),
        (CommandEnd(0, "valid\n", ""), True, "accepted"),
        (CommandEnd(1, "found 2\n", ""), True, "accepted"),
        (CommandEnd(0, "\x1b[31m\n", ""), True, "unclear"),
        (CommandEnd(1, "", TRACEBACK), True, "traceback"),
        (CommandEnd(-signal.SIGSEGV, "", ""), True, "crash"),
        (CommandEnd(-signal.SIGXCPU, "", ""), True, "hang"),
        (CommandEnd(None, "", ""), True, "hang"),
    ],
)
def test_an_end_has_the_outcome_that_a_user_sees(ended: CommandEnd, is_clean: bool, outcome: str):
    assert ended.outcome(is_clean) == outcome


@pytest.mark.long
def test_commands_end_in_a_fork_as_in_a_shell(tmp_path: Path):
    def crash() -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def fail() -> None:
        raise KeyError(3)

    def spin() -> None:
        while True:
            pass

    version = hostile.run(["--version"], tmp_path, 30)
    assert (version.code, version.err) == (0, "")
    refused = hostile.run(["check", "none.toml"], tmp_path, 30)
    assert refused.err.startswith("error: none.toml")
    ends = [version, refused]
    ends += [hostile.run(["--version"], tmp_path, 1, before) for before in (fail, crash, spin)]
    expected = ["accepted", "refused", "traceback", "crash", "hang"]
    assert [each.outcome() for each in ends] == expected


def test_damage_is_drawn_from_the_seed():
    content = bytes(range(256))
    found = [hostile.damaged(np.random.default_rng(3), content, (b"word",)) for _ in range(2)]
    assert found[0] == found[1]
    others = {hostile.damaged(np.random.default_rng(k), content, (b"word",)) for k in range(50)}
    assert len(others) > 40


def test_changes_keep_the_format():
    rng = np.random.default_rng(0)
    table = b"t_s,tip_x_m\n0.0,1.0\n0.1,1.5\n0.2,2.0\n"
    tables = {hostile.changed_table(rng, table) for _ in range(40)}
    assert len(tables) > 20
    content = b'{"a": [1, {"b": 2}], "c": {"d": "x"}}'
    texts = {hostile.changed_json(rng, content) for _ in range(40)}
    assert len(texts) > 10
    assert all(json.loads(text) is not None for text in texts)
    file = io.BytesIO()
    np.savez(file, depth_m=np.ones((2, 3, 4)), t_s=np.arange(2.0))
    shapes = set()
    for _ in range(40):
        with np.load(io.BytesIO(hostile.changed_arrays(rng, file.getvalue()))) as archive:
            shapes.add(str({name: (a.shape, a.dtype.kind) for name, a in archive.items()}))
    assert len(shapes) > 10
    settings = {hostile.changed_toml(rng, b"# one\n[a]\nb = 1.5\nc = [1, 2]\n") for _ in range(40)}
    assert len(settings) > 20


@pytest.mark.long
@pytest.mark.parametrize("kind", list(hostile.KINDS))
def test_no_case_ends_without_a_message(kind: str, tmp_path: Path):
    table = hostile.table(
        2, seed=0, only=[kind], limit_s=60.0, failure_folder=tmp_path, quick="changed" in kind
    )
    cells = [cell.strip() for cell in table.splitlines()[-1].strip("|").split("|")]
    failures = dict(zip(hostile.OUTCOMES, cells[2:], strict=False))
    assert {name: failures[name] for name in ("traceback", "unclear", "hang", "crash")} == {
        name: "0" for name in ("traceback", "unclear", "hang", "crash")
    }
