"""The JSON schema of the problem file for editors."""

from __future__ import annotations

import json
import sys
import tomllib
from email.message import Message
from importlib import metadata
from pathlib import Path

import jsonschema
import pytest
from kit.problem_files import run_command

from collocation_sysid.problem.editor_schema import (
    SCHEMA_FILE,
    schema_text,
    schema_url,
    with_schema_reference,
)
from collocation_sysid.problem.loading import read_problem_file
from collocation_sysid.problem.new import TEMPLATES, create_problem
from collocation_sysid.problem.schema import ProblemFile

ROOT = Path(__file__).parents[2]
SHIPPED = [
    each
    for each in (ROOT / "problems").glob("*/*.toml")
    if each.name not in ("limits.toml", "task.toml")
]


def first_line(file: Path) -> str:
    return file.read_text(encoding="utf-8").splitlines()[0]


def validate(file: Path, schema: str) -> None:
    validator = jsonschema.Draft202012Validator
    validator.check_schema(json.loads(schema))
    validator(json.loads(schema)).validate(tomllib.loads(file.read_text(encoding="utf-8")))


@pytest.mark.parametrize("kind", ["compression", "swing", "tension", "video"])
def test_a_template_follows_the_schema_that_it_names(kind, tmp_path):
    assert first_line(TEMPLATES / kind / "problem.toml") == f"#:schema {SCHEMA_FILE}"
    file, *others = create_problem(tmp_path / "mine", kind)
    assert first_line(file) == f"#:schema {SCHEMA_FILE}"
    assert others[-1] == file.parent / SCHEMA_FILE
    assert others[-1].read_text(encoding="utf-8") == schema_text()
    validate(file, others[-1].read_text(encoding="utf-8"))
    problem, _ = read_problem_file(file)
    assert problem.title == "mine"


@pytest.mark.parametrize("file", SHIPPED, ids=lambda file: f"{file.parent.name}-{file.stem}")
def test_a_shipped_problem_follows_the_schema_that_it_names(file):
    directive, _, path = first_line(file).partition(" ")
    assert directive == "#:schema"
    schema = file.parent / path
    assert schema.resolve() == ROOT / "problems" / SCHEMA_FILE
    validate(file, schema.read_text(encoding="utf-8"))
    ProblemFile.model_validate(tomllib.loads(file.read_text(encoding="utf-8")))


def test_a_misspelt_key_does_not_follow_the_schema(tmp_path):
    file, *_ = create_problem(tmp_path / "mine", "swing")
    file.write_text(file.read_text().replace("mass_kg = 0.1", "mas_kg = 0.1"))
    with pytest.raises(jsonschema.ValidationError, match="mas_kg"):
        validate(file, schema_text())


def tables(schema: str) -> dict[str, set[str]]:
    """The keys of each table; other details differ between versions of pydantic."""
    content = json.loads(schema)
    known = {name: set(table.get("properties", {})) for name, table in content["$defs"].items()}
    return known | {"": set(content["properties"])}


def test_the_schema_of_the_shipped_problems_is_that_of_the_command():
    shipped = (ROOT / "problems" / SCHEMA_FILE).read_text(encoding="utf-8")
    outcome = run_command("schema")
    assert outcome.out == schema_text()
    assert json.loads(outcome.out)["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    remedy = "write it again: collocation-sysid schema > problems/schema.json"
    assert tables(shipped) == tables(outcome.out), remedy


def test_a_published_schema_takes_the_place_of_the_file(tmp_path, monkeypatch):
    stated = Message()
    stated["Project-URL"] = "Documentation, https://example.org/docs/"
    monkeypatch.setattr(metadata, "metadata", lambda _: stated)
    assert schema_url() == "https://example.org/docs/schema.json"
    (file,) = create_problem(tmp_path / "mine")
    assert first_line(file) == "#:schema https://example.org/docs/schema.json"
    assert [*file.parent.iterdir()] == [file]


def test_a_project_without_an_address_publishes_no_schema(monkeypatch):
    monkeypatch.setattr(metadata, "metadata", lambda _: Message())
    assert schema_url() is None


def test_the_reference_is_the_first_line_once():
    once = with_schema_reference('title = ""\n', "schema.json")
    assert once == '#:schema schema.json\ntitle = ""\n'
    again = with_schema_reference(once, "https://example.org/schema.json")
    assert again == '#:schema https://example.org/schema.json\ntitle = ""\n'


def test_another_schema_is_left_alone(tmp_path):
    own = tmp_path / "mine" / SCHEMA_FILE
    own.parent.mkdir()
    own.write_text("mine")
    outcome = run_command("new", tmp_path / "mine")
    assert outcome.code == 2
    assert f"{own}: this file exists already" in outcome.err
    assert [*own.parent.iterdir()] == [own]


def test_the_documentation_publishes_the_schema(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    monkeypatch.delitem(sys.modules, "reference", raising=False)
    from reference import PUBLISHED, write_pages

    write_pages(tmp_path)
    assert (tmp_path / PUBLISHED / SCHEMA_FILE).read_text(encoding="utf-8") == schema_text()
    configuration = (ROOT / "docs" / "conf.py").read_text()
    assert 'html_extra_path = [f"generated/{PUBLISHED}",' in configuration


def test_the_start_of_an_experiment_is_described_for_editors():
    keys = json.loads(schema_text())["$defs"]["ExperimentSection"]["properties"]
    assert "at rest under its loads" in keys["start"]["description"]
