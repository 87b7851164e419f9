"""Studies and benchmarks run to their end, with as few twins, repetitions or steps as they accept.

The numbers are not compared: the scripts state them for the documentation. Scripts that need
downloaded data, and those that take longer than a minute, are left out.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"
FILES = [file for file in sorted(SCRIPTS.glob("*/*.py")) if file.parent.name != "notebooks"]
# Command lines without the ending of the script's name.
COMMANDS = (
    "study_contact --parts poked --twins 2",
    "study_interruptions --solves 4",
    "study_starts --methods --starts 1 --factor 2",
    "study_starts --starts 1 --bodies cylinder",
    "benchmark_jacobian --repeats 1",
    "benchmark_shipped foam_cylinder",
)


@pytest.mark.long
@pytest.mark.parametrize("command", COMMANDS)
def test_a_study_or_benchmark_runs_to_its_end(command: str, tmp_path: Path):
    name, *arguments = command.split()
    finished = subprocess.run(
        [sys.executable, str(SCRIPTS), name, *arguments],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.strip()


def test_every_script_prints_a_help_text():
    """Without it, `--help` would run a script that writes files."""
    without_help = [
        file.name
        for file in FILES
        if "__main__" in (text := file.read_text(encoding="utf-8"))
        and "parse_args(" not in text
        and "require_no_arguments" not in text
        and "fetched_files" not in text
    ]
    assert not without_help


def test_the_index_lists_every_script():
    index = (SCRIPTS / "README.md").read_text(encoding="utf-8")
    assert [file.stem for file in FILES if f"| `{file.stem}` |" not in index] == []
    assert [file.name for file in SCRIPTS.glob("*.py")] == ["__main__.py"]  # others are in folders


def test_scripts_are_run_by_name_and_import_each_other(tmp_path: Path):
    command = [sys.executable, str(SCRIPTS), "study_starts", "--help"]
    finished = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (finished.returncode, "--methods" in finished.stdout) == (0, True), finished.stderr
    command[2] = "study_of_nothing"
    finished = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert finished.returncode == 1
    assert "unknown script: study_of_nothing" in finished.stderr
