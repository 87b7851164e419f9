"""Files in the working folder that libraries would execute or obey have no effect."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from kit.problem_files import pictures_drawn, run_command, settings, write_problem

import collocation_sysid
from collocation_sysid import cli
from collocation_sysid.common.installation import python_command
from collocation_sysid.common.isolated_process import run_isolated
from collocation_sysid.extras.studies import run_execution
from collocation_sysid.installation_check import _working_linear_solvers

PLANTED = (
    *("numpy", "casadi", "json", "scipy", "pydantic", "meshio", "matplotlib", "ezc3d", "email"),
    *("ctypes", "mujoco", "encodings", "os", "importlib"),
)
REDUCED = settings("solver.method=reduced-space")
PACKAGE = Path(collocation_sysid.__file__).parent


def plant(folder: Path) -> None:
    """Write Python files with the names of libraries, which leave the file ``executed`` if run."""
    for name in PLANTED:
        (folder / f"{name}.py").write_text(
            f"open({str(folder / 'executed')!r}, 'a').write({name!r})\nraise ImportError('planted')\n"
        )


def run_program(*words: object, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run the command line in a process of its own, as the installed command does."""
    program = (
        "import sys; sys.argv[0] = 'collocation-sysid'; sys.path[:] = [p for p in sys.path if p]"
    )
    program += "; from collocation_sysid.cli import main; main()"
    return subprocess.run(
        [sys.executable, "-c", program, *map(str, words)],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_python_is_started_in_one_place():
    users = [
        file.relative_to(PACKAGE).as_posix()
        for file in PACKAGE.rglob("*.py")
        if "sys.executable" in file.read_text(encoding="utf-8")
    ]
    assert users == ["common/installation.py"]


@pytest.mark.long
@pytest.mark.parametrize("code", [run_execution.COMMAND[3], "import numpy, json, casadi, email"])
def test_a_further_process_executes_nothing_of_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str
):
    plant(tmp_path)
    monkeypatch.chdir(tmp_path)
    imports = code.replace("; main()", "")
    done = subprocess.run(python_command(imports), capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "")
    assert not (tmp_path / "executed").exists()


def test_isolated_processes_and_solver_checks_execute_nothing_of_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    plant(tmp_path)
    (tmp_path / "ipopt.opt").write_text("max_iter 0\n")
    monkeypatch.chdir(tmp_path)
    assert run_isolated("found = {'sum': given['x'].sum()}", x=[1.0, 2.0])["sum"] == 3.0
    assert [*_working_linear_solvers(["mumps"])] == ["mumps"]
    assert not (tmp_path / "executed").exists()


@pytest.mark.long
@pytest.mark.parametrize(
    "words",
    [
        ("check", "problem.toml"),
        ("compare-models", "problem.toml", "--materials", "neo-hookean,yeoh", "--out", "o"),
        ("compare-methods", "problem.toml", "--methods", "reduced-space", "--out", "o"),
        ("solve", "problem.toml", *REDUCED, "--no-pictures", "--out", "o"),
        ("doctor",),
    ],
    ids=lambda words: words[0],
)
def test_a_command_executes_nothing_of_the_working_folder(tmp_path: Path, words: tuple[str, ...]):
    write_problem(tmp_path, {"swing": 8})
    plant(tmp_path)
    done = run_program(*words, folder=tmp_path)
    assert "Traceback" not in done.stderr, done.stderr
    assert done.returncode in (0, 1), done.stderr
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("command", cli.command_sources())
def test_python_that_a_library_starts_does_not_search_the_working_folder(
    monkeypatch: pytest.MonkeyPatch, command: str
):
    monkeypatch.setenv("PYTHONSAFEPATH", "")
    assert run_command(command, "--help").code == 0
    assert os.environ["PYTHONSAFEPATH"] == "1"


@pytest.mark.long
@pytest.mark.parametrize(
    "words",
    [
        ("export", "run", "--to", "mujoco", "--verify"),
        ("animate", "run", "--to", "film.gif", "--fps", "2"),
        ("report", "run"),
        ("plot", "run"),
    ],
    ids=lambda words: words[0],
)
def test_a_command_of_a_run_executes_nothing_of_the_working_folder(
    tmp_path: Path, words: tuple[str, ...]
):
    pytest.importorskip("mujoco")
    problem = write_problem(tmp_path, {"swing": 8})
    law = '[object]\nmaterial = "st-venant-kirchhoff"\n'  # that of MuJoCo
    problem.write_text(problem.read_text().replace("[object]\n", law))
    solved = run_command(
        *("solve", tmp_path / "problem.toml", *REDUCED, "--no-pictures", "-q"),
        *("--out", tmp_path / "run"),
    )
    assert solved.code in (0, 1), solved.err
    plant(tmp_path)
    done = run_program(*words, folder=tmp_path)
    assert "Traceback" not in done.stderr, done.stderr
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "executed").exists()


@pytest.mark.long
def test_the_module_as_a_program_leaves_the_working_folder_alone(tmp_path: Path):
    write_problem(tmp_path, {"swing": 8})
    plant(tmp_path)
    for name in ("email", "json", "ctypes", "os", "importlib", "encodings"):
        (tmp_path / f"{name}.py").unlink()  # Python itself imports it before the package
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "collocation_sysid",
            "solve",
            "problem.toml",
            *REDUCED,
            "--no-pictures",
            "-q",
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "executed").exists()


@pytest.mark.long
def test_sources_without_installation_solve_and_start_studies(tmp_path: Path):
    source = tmp_path / "clone"
    shutil.copytree(PACKAGE, source / "collocation_sysid", ignore=lambda *_: ["__pycache__"])
    shutil.copy(PACKAGE.parent / "pyproject.toml", source)
    write_problem(tmp_path, {"swing": 8})
    # Distributions are looked up here, where this one is hidden.
    hidden = "import importlib.metadata as m, sys; real = m.distribution\n"
    hidden += "def distribution(name):\n"
    hidden += "    if name == 'collocation-sysid': raise m.PackageNotFoundError(name)\n"
    hidden += "    return real(name)\n"
    hidden += "m.distribution = distribution\n"
    hidden += f"sys.path.insert(0, {str(source)!r})\n"
    hidden += "from collocation_sysid.cli import main; main()\n"
    for words in (
        ("solve", *REDUCED, "--no-pictures", "--out", "run"),
        ("compare-methods", "--methods", "reduced-space", "--out", "study"),
    ):
        command, *rest = words
        done = subprocess.run(
            [sys.executable, "-P", "-c", hidden, command, "problem.toml", *rest, "-q"],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "result.json").is_file()


@pytest.mark.long
def test_ipopt_reads_no_options_of_the_working_folder(tiny: Path):
    (tiny / "ipopt.opt").write_text("max_iter 0\noutput_file written.txt\n")
    outcome = run_command("solve", "problem.toml", "--out", "run", "-q")
    assert outcome.code == 0, outcome.err
    assert not (tiny / "written.txt").exists()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("interior-point.ipopt.hsllib", "./evil.so"),
        ("interior-point.ipopt.output_file", "/tmp/x"),
        ("casadi:sqpmethod.casadi.qpsol", "evil"),
        ("casadi:sqpmethod.casadi.jit", "true"),
        ("casadi:sqpmethod.casadi.qpsol_options", "{ jit = true }"),
    ],
)
def test_options_of_solvers_that_run_code_need_permission(tiny: Path, key: str, value: str):
    words = ("check", "problem.toml", *settings(f"solver.{key}={value}"))
    outcome = run_command(*words)
    assert outcome.code == 2
    assert "--allow-code" in outcome.err
    assert outcome.err.count("\n") == 1


@pytest.mark.long
@pytest.mark.parametrize("content", [b"text.usetex: True\n", b"\xff\xfe\x00"])
def test_matplotlibrc_of_the_working_folder_has_no_effect(tiny: Path, content: bytes):
    (tiny / "matplotlibrc").write_bytes(content)
    done = run_program("solve", "problem.toml", *REDUCED, "--out", "run", "-q", folder=tiny)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    assert list((tiny / "run").glob("*.png"))


@pytest.mark.long
def test_settings_of_matplotlib_in_this_process_have_no_effect(tiny: Path):
    from matplotlib import rc_context

    with pictures_drawn(), rc_context({"text.usetex": True, "savefig.format": "svg"}):
        outcome = run_command("solve", "problem.toml", *REDUCED, "--out", "run", "-q")
        assert (outcome.code, outcome.err) == (0, "")
        words = ("animate", "run", "--to", "film.gif", "--fps", "2")
        assert run_command(*words).code == 0
