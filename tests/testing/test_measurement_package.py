"""A kind of measurement of another package, which registers by an entry point."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from kit.problem_files import AT_TRUTH, TRUTH, replace_text, run_command, settings, write_problem

from collocation_sysid import InputError, Problem
from collocation_sysid.problem.measurement_section import registered_tables
from collocation_sysid.testing import check_sensor

PACKAGES = Path(__file__).parents[1] / "packages"
STRINGS = """
[[experiment.string_potentiometer]]
name = "string"
file = "data/swing_reading_string.csv"
sigma_m = 1e-4
point_m = [0.03, 0.02, 0.03]
eyelet_m = [0.3, 0.0, 0.1]

[[experiment.string_potentiometer]]
name = "cord"
file = "data/swing_reading_cord.csv"
sigma_m = 1e-4
point_m = [0.06, 0.06, 0.03]
eyelet_m = [0.0, 0.3, 0.0]
"""


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The package in tests/packages is installed, and not imported yet."""
    monkeypatch.syspath_prepend(PACKAGES)
    sys.modules.pop("string_potentiometer", None)
    registered_tables.cache_clear()
    yield
    sys.modules.pop("string_potentiometer", None)
    registered_tables.cache_clear()


@pytest.fixture
def strung(tiny: Path) -> Path:
    """The tiny bar with two strings and without markers."""
    file = tiny / "problem.toml"
    file.write_text(file.read_text().partition("\n[experiment.markers]")[0] + STRINGS)
    return tiny


def test_a_sensor_of_another_package_passes_the_check():
    kind = import_module("string_potentiometer").StringPotentiometer
    t_s = np.linspace(0.0, 0.2, 5)
    hook_m, eyelet_m = [[0.04, 0.02, 0.0]], [0.2, 0.02, 0.0]
    sensor = kind(
        name="string", t_s=t_s, values=None, sigma=1e-4, points_m=hook_m, eyelet_m=eyelet_m
    )
    check_sensor(sensor)


def test_a_table_of_another_package_is_validated(strung: Path):
    replace_text("sigma_m = 1e-4\npoint_m = [0.03", "sigma_m = -1.0\npoint_m = [0.03")(strung)
    with pytest.raises(InputError, match=r"string_potentiometer.0.sigma_m: found -1"):
        Problem.read(strung / "problem.toml", simulation=True)


def test_a_missing_file_of_another_package_is_named(strung: Path):
    with pytest.raises(InputError, match=r"string_potentiometer.0.file"):
        Problem.read(strung / "problem.toml")


def test_without_the_package_its_table_is_unknown(strung: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.undo()
    registered_tables.cache_clear()
    with pytest.raises(InputError, match="string_potentiometer"):
        Problem.read(strung / "problem.toml")


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("import a_library_that_is_missing", "ModuleNotFoundError: No module named"),
        ("raise RuntimeError('first\\nsecond')", r"RuntimeError: first\)"),
        ("def broken(:", "SyntaxError"),
        ("", "AttributeError"),
        ("StringPotentiometerSection = 3", "TypeError"),
        ("StringPotentiometerSection = dict", "no MeasurementSection"),
    ],
)
def test_a_broken_package_is_named_where_its_table_is_used(
    strung: Path, monkeypatch: pytest.MonkeyPatch, code: str, reason: str
):
    packages = strung / "packages"
    shutil.copytree(PACKAGES, packages)
    (packages / "string_potentiometer.py").write_text(code)
    monkeypatch.syspath_prepend(packages)
    monkeypatch.delitem(sys.modules, "string_potentiometer", raising=False)
    with pytest.raises(InputError) as caught:
        Problem.read(strung / "problem.toml", simulation=True)
    (line,) = str(caught.value).splitlines()
    assert "string_potentiometer: the table 'string_potentiometer:String" in line
    assert "of the package 'string-potentiometer' cannot be used" in line.replace("_", "-")
    assert re.search(reason, line)
    (strung / "other").mkdir()
    write_problem(strung / "other", {"swing": 8})
    Problem.read(strung / "other" / "problem.toml")  # has no such table


@pytest.mark.long
def test_measurements_of_another_package_are_simulated_and_identified_from(strung: Path):
    truth = settings(*AT_TRUTH, "transcription.substeps=1")
    options = ("problem.toml", "--quiet")
    done = run_command("simulate", *options, *truth, "--integrator", "midpoint", "--out", "data")
    assert done.code == 0, done.err
    done = run_command(
        "solve", *options, "--out", "found", "--method", "reduced-space", "--details"
    )
    assert done.code == 0, done.err
    result = json.loads((strung / "found" / "result.json").read_text())
    assert result["parameters"]["mu_pa"]["optimum"] == pytest.approx(TRUTH["mu_pa"], rel=0.1)
    fitted = result["fit"]["experiments"]["swing"]
    assert fitted["reading_rms"].keys() == {"string", "cord"}
    assert fitted["reading_unit"] == {"string": "m", "cord": "m"}
    assert abs(result["nuisance"]["swing"]["zero of string [m]"]["value"]) < 2e-3
    assert "string of 'swing'" in done.out
