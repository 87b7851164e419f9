"""Commented lines of the templates are valid where they stand."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import collocation_sysid as cs
from collocation_sysid.problem.new import TEMPLATES

PROBLEM = "problem.toml"
KINDS = sorted(each.name for each in TEMPLATES.iterdir() if (each / PROBLEM).is_file())
KEY = re.compile(r"^(?:# )?([\w\".]+) *=")
# A comment that names what the line replaces.
INSTEAD = re.compile(r"#.*\binstead of (\w+)")
# A comment that names a commented key that the line needs.
WITH = re.compile(r"# with (\w+)")
# Keys that are right for other recordings than that of the template, with the beginning of the
# refusal.
OF_OTHER_RECORDINGS = {
    "[[object.prony]]": "prony_1.share, prony_1.tau_s are missing",
    "frame_rate_hz": "found a frame rate, but front.csv has times",
    "gravity_frame": "poses and markers are not topics of a log",
    "length_unit": "length_unit",
    "markers": "found 'base1'; expected names of the markers",
    "skip_cycles": "found 2, but the strain has 1 loading cycles",
    "validation": "every experiment has validation = true",
}


def blocks(lines: list[str]) -> Iterator[tuple[int, int]]:
    """Yield first line and end of what is uncommented at a time: a table with its keys, or a key."""
    k = 0
    while k < len(lines):
        end = k + 1
        if re.match(r"# \[+\w", lines[k]):
            while end < len(lines) and is_key(lines[end]):
                end += 1
            yield k, end
        elif is_key(lines[k]):
            yield k, end
        k = end


def is_key(line: str) -> bool:
    """Whether a line is a commented key with its value."""
    try:
        return bool(KEY.match(line) and line.startswith("# ") and tomllib.loads(line[2:]))
    except tomllib.TOMLDecodeError:
        return False


def uncommented(lines: list[str], first: int, end: int) -> str:
    """The template with some lines, and with those that they need; a key of the same table that they
    state or replace is removed.
    """
    made = [line.removeprefix("# ") for line in lines[first:end]]
    if made[0].startswith("["):
        return "\n".join([*lines[:first], *made, *lines[end:]])
    key = KEY.match(made[0])
    assert key is not None
    gone = {key[1], *INSTEAD.findall(made[0])}
    heads = [k for k, line in enumerate(lines) if line.startswith("[")]
    start = max((k for k in heads if k < first), default=0)
    stop = min((k for k in heads if k > first), default=len(lines))
    table = []
    for line in lines[start:stop]:
        other = KEY.match(line)
        name = other[1] if other else ""
        if is_key(line) and name in WITH.findall(made[0]):
            table.append(line.removeprefix("# "))
        elif line.startswith("#") or name not in gone:
            table.append(line)
    return "\n".join([*lines[:start], *table, *made, *lines[stop:]])


def cases() -> Iterator[tuple[str, int, int]]:
    for kind in KINDS:
        lines = (TEMPLATES / kind / PROBLEM).read_text(encoding="utf-8").splitlines()
        for first, end in blocks(lines):
            yield kind, first, end


@pytest.mark.parametrize(("kind", "first", "end"), [*cases()])
def test_a_commented_line_is_accepted_where_it_stands(
    tmp_path: Path, kind: str, first: int, end: int
) -> None:
    lines = (TEMPLATES / kind / PROBLEM).read_text(encoding="utf-8").splitlines()
    for each in (TEMPLATES / kind).iterdir():
        (tmp_path / each.name).symlink_to(each)
    (tmp_path / PROBLEM).unlink()
    text = uncommented(lines, first, end)
    (tmp_path / PROBLEM).write_text(text, encoding="utf-8")
    files = re.findall(r'^[^#]*"([\w./]+\.(?:csv|stl|mcap))', text, re.MULTILINE)
    named = [each for each in files if not (tmp_path / each).exists()]
    key = lines[first].removeprefix("# ").split()[0]
    accepted = [*named, OF_OTHER_RECORDINGS[key]] if key in OF_OTHER_RECORDINGS else named
    message = ""
    try:
        cs.Problem.read(tmp_path / PROBLEM)
    except cs.InputError as error:
        message = str(error)
    assert not message or any(each in message for each in accepted), lines[first]
