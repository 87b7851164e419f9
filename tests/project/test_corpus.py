"""The corpus: its contents, its judgement of answers, and three of its recordings."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import corpus
import pytest
from recordings import SHARED, recordings

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.fixture(scope="module")
def contents():
    return {each.name: each for each in recordings()}


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "verdict", "reason"),
    [
        ("solid/markers/all effects", "good", ""),
        ("solid/markers/gravity", "doubtful", "description/gravity"),
        ("contact/dragged 1", "good", ""),
    ],
)
def test_a_recording_has_its_answer_verdict_and_first_reason(contents, name, verdict, reason):
    row = corpus.solved(contents[name])
    assert (row["verdict"], row["reason"]) == (verdict, reason)
    assert not corpus.is_wrong(row)
    assert not corpus.is_failure(row)
    if verdict == "good":
        assert row["constants"]
        assert all(corpus.is_inside(found) for found in row["constants"].values())


def test_half_of_the_recordings_have_a_mistake_and_names_are_unique(contents):
    assert len(contents) == len(recordings())
    mistakes = sum(bool(each.mistake) for each in contents.values())
    assert 0.4 < mistakes / len(contents) < 0.6
    assert not SHARED.is_dir() or len(contents) >= 100
    assert 0.25 < sum(each.quick for each in contents.values()) / len(contents) < 0.35


def row(name="a", value=1.0, low=0.8, high=1.2, **more):
    found = {"value": value, "low": low, "high": high, "true": 1.1}
    plain = {"verdict": "good", "status": "converged", "reason": "", "message": "", "mistake": ""}
    rest = {"causes": [], "repeats": "", "search_s": 1.0, "judgement_s": 1.0}
    return {"name": name, "constants": {"young_pa": found}, **plain, **rest, **more}


@pytest.mark.parametrize(
    ("code", "message", "causes", "wrong"),
    [
        ("", "", [], False),
        ("residuals/persist", "the residuals are not noise", [], False),
        ("effect/surprising", "the residuals need buoyancy of +30: state it", ["grasp"], True),
        ("effect/surprising", "the residuals need a turn in the grasp: widen", ["grasp"], False),
        ("nuisance/far", "swing: time shift is 5 deviations: check grasp", ["grasp"], True),
        ("description/gravity", "likely: gravity along z", ["gravity"], False),
    ],
)
def test_a_first_reason_is_wrong_if_its_subject_is_another_cause(code, message, causes, wrong):
    stated = row(verdict="doubtful", reason=code, message=message, causes=causes, mistake="one")
    assert corpus.is_wrong(stated) is wrong


def test_what_is_worse_is_listed_and_what_is_better_is_not():
    good, outside = {"a": row()}, {"a": row(value=1.0, low=0.95, high=1.05)}
    assert corpus.judged(good, good) == []
    assert corpus.judged(outside, good) == []
    assert corpus.judged(good, outside) == ["good and outside: a", "inside: 0 in place of 1"]
    named = {"a": row(verdict="check", reason="effect/surprising", message="buoyancy")}
    assert corpus.judged(good, named) == ["wrong first reason: a"]
    assert corpus.judged(good, {"a": row(status="iteration-limit")}) == ["failure: a"]


def test_changes_are_those_of_answers_verdicts_reasons_and_times():
    before, now = row(), row(value=1.1, verdict="check", reason="noise/larger", search_s=3.0)
    said = corpus.changes({"a": before}, {"a": now})
    assert "young_pa by +0.98 standard uncertainties" in said
    assert "verdict good -> check" in said
    assert "reason none -> noise/larger" in said
    assert "processor time 2 s -> 4 s" in said


def test_a_repeat_has_the_median_of_the_others_as_its_truth():
    table = {
        name: row(name, value, repeats="r")
        for name, value in zip("abc", (1.0, 2.0, 4.0), strict=True)
    }
    for each in table.values():
        corpus.compare_repeats(each, table)
    assert [each["constants"]["young_pa"]["true"] for each in table.values()] == [3.0, 2.5, 1.5]


@pytest.mark.long
def test_an_interrupted_run_keeps_what_is_done(tmp_path):
    out, command = tmp_path / "table.jsonl", [sys.executable, str(SCRIPTS), "corpus"]
    options = ["--only", "example specimen", "--out", str(out), "--against", str(out)]
    for _ in range(2):
        ended = subprocess.run([*command, *options], capture_output=True, text=True, check=False)
        assert ended.returncode == 0, ended.stderr
    (stored,) = map(json.loads, out.read_text().splitlines())
    assert stored["name"] == "specimen/example specimen"
    assert "processor time" in ended.stdout
