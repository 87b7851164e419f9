"""Requirements of a release: one version, types, and lowest versions of dependencies."""

from __future__ import annotations

import os
import re
import runpy
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import collocation_sysid as cs

ROOT = Path(__file__).parents[2]
CHANGELOG = (ROOT / "CHANGELOG.md").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_version_stands_in_one_place():
    assert cs.__version__ == PROJECT["version"]
    assert "version:" not in (ROOT / "CITATION.cff").read_text().replace("cff-version:", "")
    for file in (ROOT / "collocation_sysid").rglob("*.py"):
        assert f'"{PROJECT["version"]}"' not in file.read_text()


def test_the_changelog_has_the_version():
    dated = re.findall(r"^## \[([\d.]+)\] - \d{4}-\d\d-\d\d$", CHANGELOG, re.MULTILINE)
    assert dated[0] == PROJECT["version"]


@pytest.mark.long
def test_the_wheel_explains_every_page_of_the_documentation(tmp_path: Path, monkeypatch):
    hatchling = pytest.importorskip("hatchling.build")
    monkeypatch.chdir(ROOT)  # the project that is built
    wheel = tmp_path / hatchling.build_wheel(str(tmp_path))
    installed = tmp_path / "installed"
    zipfile.ZipFile(wheel).extractall(installed)
    folders = ("", "howto", "studies")
    pages = [each for name in folders for each in (ROOT / "docs" / name).glob("*.md")]
    program = "from collocation_sysid.cli import main; main()"

    def explain(*topic: str) -> str:
        return subprocess.run(
            [sys.executable, "-c", program, "explain", *topic],
            env=os.environ | {"PYTHONPATH": str(installed)},
            cwd=tmp_path,
            capture_output=True,
            check=True,
            text=True,
            encoding="utf-8",
        ).stdout

    listed = [line.split()[0] for line in explain().splitlines()[1:]]
    assert sorted(listed) == sorted({page.stem for page in pages} - {"index", "api"})
    assert explain("trust").startswith("# Trust in an answer\n")


def test_the_package_is_typed():
    assert (ROOT / "collocation_sysid" / "py.typed").is_file()


def test_every_dependency_states_the_lowest_version():
    script = runpy.run_path(str(ROOT / "scripts" / "tools" / "lowest_dependencies.py"))
    lowest, pins = script["lowest_pins"], script["project_pins"]()
    assert len(lowest(PROJECT["dependencies"])) == len(PROJECT["dependencies"])
    assert all(re.fullmatch(r"[\w-]+==[\d.]+", pin) for pin in pins)
    assert len({pin.partition("==")[0] for pin in pins}) == len(set(pins))  # none has two
    assert {"casadi", "mcap", "mujoco", "distributed"} <= {pin.partition("==")[0] for pin in pins}
    with pytest.raises(ValueError, match="no lowest version"):
        lowest(["numpy"])


def test_all_extras_for_users_are_in_all():
    extras = PROJECT["optional-dependencies"]
    (everything,) = extras["all"]
    listed = re.fullmatch(r"collocation-sysid\[(.*)\]", everything)
    assert listed is not None
    # `large` has a licence of its own; the others are for developers.
    left_out = {"all", "large", "notebook", "test", "docs", "dev"}
    assert {*listed[1].split(",")} == {*extras} - left_out


def test_hosted_checks_run_targets_that_are_there():
    targets = re.findall(r"^([a-z-]+):.*##", (ROOT / "Makefile").read_text(), re.MULTILINE)
    workflow = (ROOT / ".github" / "workflows" / "ci.yml").read_text()
    called = re.findall(r"run: make ([a-z-]+)", workflow)
    assert {"check", "test", "docs", "dist"} <= set(called) <= set(targets)
    stated = [c for c in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", c)]
    matrix = re.search(r"python: \[(.*)\]", workflow)
    assert matrix is not None
    assert [each.rpartition(" ")[2] for each in stated] == re.findall(r"[\d.]+", matrix[1])


def test_no_package_host_is_named():
    for name in ("pyproject.toml", "Makefile", ".github/workflows/ci.yml", "SECURITY.md"):
        text = (ROOT / name).read_text()
        assert "index-url" not in text
        assert "://" not in text


def test_the_conda_recipe_has_the_same_dependencies():
    """Under the names that conda has for them."""
    recipe = (ROOT / "scripts" / "tools" / "conda" / "meta.yaml").read_text()
    listed = re.findall(r"^    - ([\w-]+) >=([\d.]+)$", recipe.partition("  run:")[2], re.MULTILINE)
    renamed = {"matplotlib": "matplotlib-base"}
    wanted = [re.fullmatch(r"([\w-]+)>=([\d.]+)", each) for each in PROJECT["dependencies"]]
    python = ("python", PROJECT["requires-python"].removeprefix(">="))
    assert listed == [python, *((renamed.get(m[1], m[1]), m[2]) for m in wanted if m)]


def test_every_dependency_states_its_licence():
    page = (ROOT / "docs" / "licences.md").read_text()
    extras = PROJECT["optional-dependencies"]
    told = [
        "surface",
        "c3d",
        "tracks",
        "video",
        "logs",
        "cluster",
        "film",
        "usd",
        "mujoco",
        "large",
    ]
    for requirement in [
        *PROJECT["dependencies"],
        *(each for extra in told for each in extras[extra]),
    ]:
        assert re.match(r"[\w-]+", requirement)[0] in page, requirement


def test_all_foreign_data_state_a_licence():
    page = (ROOT / "docs" / "licences.md").read_text()
    scripts = [file.stem.removeprefix("get_") for file in (ROOT / "scripts").rglob("get_*.py")]
    assert len(scripts) >= 4
    assert [name for name in scripts if f"`problems/{name}`" not in page] == []
