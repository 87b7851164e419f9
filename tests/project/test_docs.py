"""Every code block of the README and of the documentation runs or is valid."""

from __future__ import annotations

import ast
import importlib
import re
import shlex
import shutil
import tomllib
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from kit.problem_files import EXPERIMENT, PROBLEM, run_command
from pydantic import ValidationError

import collocation_sysid as cs
from collocation_sysid.problem.schema import SHAPES, ProblemFile
from collocation_sysid.recording import experiment as experiments

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("**/*.md"))]
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def blocks(page: Path, language: str) -> list[str]:
    return [code for name, code in FENCE.findall(page.read_text()) if name == language]


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


# It makes a recording in another simulator, and identifies the body that was simulated.
WHOLE_RUN = ROOT / "docs" / "howto" / "from_simulator.md"


def pages_with(language: str) -> list:
    return [
        pytest.param(page, id=name_of(page), marks=[pytest.mark.long] * (page == WHOLE_RUN))
        for page in PAGES
        if blocks(page, language)
    ]


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The shipped problems in a folder of their own, which is the working directory, and the air that
    a reader of the pages has.
    """
    monkeypatch.setattr(experiments, "USUAL_KG_M3", experiments.AIR_KG_M3)
    shutil.copytree(ROOT / "problems", tmp_path / "problems")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.long
@pytest.mark.parametrize("page", pages_with("python"))
def test_python_blocks_of_a_page_run_one_after_the_other(page: Path, checkout: Path):
    names: dict[str, object] = {"__name__": "docs"}
    if "import mujoco\n" in page.read_text():
        pytest.importorskip("mujoco")
    # Half of the recording that pages read shows as well that they run.
    markers = checkout / "problems" / "foam_cylinder" / "swing_markers.csv"
    lines = markers.read_text().splitlines(keepends=True)
    markers.write_text("".join(lines[: len(lines) // 2]))
    for code in blocks(page, "python"):
        exec(compile(code, name_of(page), "exec", dont_inherit=True), names)


# What keeps a command of the pages short here.
SHORT = {
    "compare-methods": ["--dry-run"],
    "compare-models": ["--dry-run"],
    "solve": ["--method", "reduced-space"],
    "plan": ["--no-film"],
}


@pytest.mark.long
@pytest.mark.parametrize("page", pages_with("console"))
def test_commands_of_a_page_run(page: Path, checkout: Path):
    for block in blocks(page, "console"):
        for line in re.findall(r"^\$ collocation-sysid (.*)$", block, re.MULTILINE):
            words = shlex.split(line)
            outcome = run_command(*words, *SHORT.get(words[0], []))
            assert outcome.code == 0, f"{line}: {outcome.err}"
            said = re.findall(r"^written to .*$", block, re.MULTILINE)
            assert said == [each for each in said if each in outcome.out], outcome.out


def in_a_problem(code: str) -> dict[str, Any]:
    """A problem that is valid but for the tables of a block, which take the place of its own."""
    whole, block = tomllib.loads(PROBLEM + EXPERIMENT), tomllib.loads(code)
    experiment = block.pop("experiment", {})
    if isinstance(experiment, dict):
        experiment = [whole["experiment"][0] | experiment]
    if not {*SHAPES} & set(block.get("object", ["mesh"])):
        block["object"] |= whole["object"]
    return whole | block | {"experiment": experiment}


@pytest.mark.parametrize("page", pages_with("toml"))
def test_toml_blocks_are_valid_in_a_problem_file(page: Path):
    for code in blocks(page, "toml"):
        ProblemFile.model_validate(in_a_problem(code))


@pytest.mark.parametrize(
    ("table", "key"),
    [("object", "mes"), ("experiment.nuisance", "gravit"), ("solver.penalty", "ro")],
)
def test_a_misspelt_key_of_a_block_is_found(table: str, key: str):
    with pytest.raises(ValidationError, match=rf"\b{key}\b"):
        ProblemFile.model_validate(in_a_problem(f"[{table}]\n{key} = 1"))


def test_links_between_pages_lead_somewhere():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", page.read_text()):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{name_of(page)}: {target}"


def test_every_page_stands_in_the_list_of_pages():
    index = (ROOT / "docs" / "index.md").read_text()
    index += (ROOT / "docs" / "studies.md").read_text()
    folders = ("howto", "studies")
    pages = [each for name in folders for each in sorted((ROOT / "docs" / name).glob("*.md"))]
    listed = [f"\n{each.parent.name}/{each.stem}\n" in index for each in pages]
    assert all(listed), pages[listed.index(False)]


def test_links_to_a_section_lead_to_its_heading():
    broken = []
    for page in PAGES:
        for target, section in re.findall(r"\]\(([\w/.]*)#([\w-]+)\)", page.read_text()):
            file = (page.parent / target) if target else page
            if file.suffix == ".md":
                heads = re.findall(r"(?m)^#+ (.+)$", file.read_text())
                known = {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}
                broken += [f"{name_of(page)}: {target}#{section}"] * (section not in known)
    assert broken == []


def test_the_problem_file_of_the_first_steps_is_complete():
    page = ROOT / "docs" / "howto" / "getting_started.md"
    blocks = re.findall(r"```toml\n(.*?)```", page.read_text(), re.DOTALL)
    file = ROOT / "problems" / "foam_cylinder" / "recording.toml"
    stated = tomllib.loads(file.read_text())
    del stated["title"]
    (shown,) = [block for block in map(tomllib.loads, blocks) if "swing_markers.csv" in str(block)]
    assert {key: each for key, each in shown.items() if key != "title"} == stated


def test_words_of_the_glossary_are_in_order_and_on_their_pages():
    glossary = ROOT / "docs" / "glossary.md"
    rows = re.findall(
        r"^\| (.+?) \| .+ \| \[.+?\]\((.+?)\) \|$", glossary.read_text(), re.MULTILINE
    )
    words = [word for word, _ in rows]
    assert words == sorted(words, key=lambda word: word.lower().replace("γ", "gamma"))

    def alike(text: str) -> str:
        return re.sub(r"[\s–-]+", " ", text.lower())

    for word, target in rows:
        page = alike((glossary.parent / target).read_text())
        assert any(name in page for name in alike(word).split(", ")), f"{word}: not on {target}"
    for page in (ROOT / "README.md", ROOT / "docs" / "index.md"):
        assert "glossary.md" in page.read_text()


def test_the_core_page_names_classes_that_there_are():
    page = (ROOT / "docs" / "core.md").read_text()
    paths = re.findall(r"^\| `collocation_sysid\.([\w.]+)\.(\w+)` \|", page, re.MULTILINE)
    assert len(paths) > 11
    for module, name in paths:
        assert isinstance(
            getattr(importlib.import_module(f"collocation_sysid.{module}"), name), type
        )
    figure = page.partition("```text\n")[2].partition("```")[0]
    boxes = set(re.findall(r"^ ([A-Z]\w+)", figure, re.MULTILINE))
    assert boxes - {name for _, name in paths} == {"PointPositions", "ReactionResultant"}


def test_the_front_page_shows_the_answer_that_the_readme_shows():
    (shown,) = blocks(ROOT / "docs" / "index.md", "console")
    lines = (ROOT / "README.md").read_text().splitlines()
    assert [line for line in shown.splitlines() if line not in lines] == []


def test_every_claim_beside_other_tools_has_a_test_or_a_script_that_is_there():
    page = (ROOT / "docs" / "compared.md").read_text()
    shown = re.findall(r"`((?:tests|scripts)/[\w/]+\.py)(?:::(\w+))?`", page)
    assert len(shown) > 20
    for file, test in shown:
        assert f"def {test}(" in (ROOT / file).read_text() or not test
    header = "| property of this tool | evidence |"
    table = page.partition(header)[2].partition("\n## ")[0]
    claims = [line for line in table.splitlines() if line.startswith("| ")]
    assert len(claims) > 12
    assert [line for line in claims if "`" not in line] == []


# Pages made when the documentation is built


@pytest.fixture
def reference(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    return pytest.importorskip("reference")


def keys_of(schema: dict[str, Any]) -> set[str]:
    tables = [schema, *schema["$defs"].values()]
    return {key for table in tables for key in table.get("properties", {})}


def test_the_reference_of_the_problem_file_has_every_key(reference):
    page = reference.problem_file()
    for key in keys_of(ProblemFile.model_json_schema()):
        assert f"| `{key}` |" in page
    assert "## `[[experiment]]`" in page
    assert "## `[solver.reduced-space]`" in page


def test_the_page_on_motion_capture_has_the_table_of_nuisance_parameters(reference):
    page = (ROOT / "docs" / "howto" / "motion_capture.md").read_text()
    assert reference.nuisances() in page


def test_the_reference_lists_exactly_the_public_names():
    page = (ROOT / "docs" / "api.md").read_text()
    listed = re.findall(r"^   ([\w.]+)$", page, re.MULTILINE)
    listed += re.findall(r"^\.\. py:data:: collocation_sysid\.([\w.]+)$", page, re.MULTILINE)
    live = [f"live.{name}" for name in cs.live.__all__]
    checks = [f"testing.{name}" for name in cs.testing.__all__]
    datasets = [f"datasets.{name}" for name in cs.datasets.__all__]
    modules = {"live", "datasets", "testing"}
    public = set(cs.__all__) - modules
    assert sorted(listed) == sorted([*public, *live, *datasets, *checks])


def test_the_reference_of_the_command_line_has_every_command_and_option(reference):
    page = reference.command_line()
    for command in ("solve", "check", "compare-methods", "compare-models", "report", "new"):
        assert f"\n## {command}\n" in page
    for option in ("--start", "--allow-code", "--time-limit", "--starts"):
        assert f"`{option}`" in page
    assert "collocation-sysid solve problem.toml --method interior-point" in page


# Scripts


SCRIPTS = [each for folder in ("scripts", "docs") for each in sorted((ROOT / folder).rglob("*.py"))]


def test_scripts_import_existing_names():
    for script in SCRIPTS:
        for node in ast.walk(ast.parse(script.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ImportFrom):
                continue
            if (node.module or "").startswith("collocation_sysid"):
                module = importlib.import_module(str(node.module))
                for name in node.names:
                    there = hasattr(module, name.name) or find_spec(f"{node.module}.{name.name}")
                    assert there, f"{script}:{node.lineno}: {node.module} has no {name.name}"
