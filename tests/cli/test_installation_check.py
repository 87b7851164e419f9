"""Report of `doctor` about complete and incomplete installations."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from kit.problem_files import run_command
from packaging.requirements import Requirement

from collocation_sysid import installation_check
from collocation_sysid.fem.kernels import jit
from collocation_sysid.installation_check import (
    Dependency,
    SelfTest,
    available_solvers,
    check_installation,
    kernel_state,
    optional_packages,
    required_packages,
    thread_state,
)


@pytest.fixture(scope="module")
def report() -> installation_check.InstallationReport:
    return check_installation()


def test_this_installation_works(report):
    assert report.is_working
    assert report.version == metadata.version("collocation-sysid")
    assert report.self_test.is_passed
    assert report.kernels.count > 0  # those of the self test at least
    assert Path(report.location, "py.typed").is_file()


def test_required_packages_are_those_of_the_metadata(report):
    versions = {each.name: each.installed for each in report.dependencies}
    assert versions["casadi"] == metadata.version("casadi")
    assert {"numpy", "scipy", "typer", "pydantic"} <= set(versions)
    assert "pytest" not in versions  # of an extra
    assert list(versions) == sorted(versions)


@pytest.mark.long
def test_the_command_prints_the_report_and_json(report):
    shown = run_command("doctor")
    assert (shown.code, shown.err) == (0, "")
    for words in ("casadi", "mumps", "kernel cache", "Self test passed", "pip install"):
        assert words in shown.out
    data = json.loads(run_command("doctor", "--json").out)
    assert data["is_working"] is True
    assert data["dependencies"][0]["name"] == report.dependencies[0].name
    assert data["kernels"]["folder"] == str(jit.cache_folder())


@pytest.mark.parametrize(
    ("requirement", "installed", "is_suitable"),
    [
        ("numpy>=2", "2.1.0", True),
        ("numpy>=2", "1.26.4", False),
        ("numpy>=2", None, False),
        ("numpy", "0.1", True),
        ("numpy>=2", "3.0rc1", True),
    ],
)
def test_a_version_is_compared_with_the_requirement(
    monkeypatch, requirement, installed, is_suitable
):
    def version(name: str) -> str:
        if installed is None:
            raise metadata.PackageNotFoundError(name)
        return installed

    monkeypatch.setattr(installation_check.metadata, "version", version)
    found = installation_check._dependency(Requirement(requirement))
    assert (found.name, found.installed, found.is_suitable) == ("numpy", installed, is_suitable)


def test_a_missing_package_is_named_with_its_remedy(monkeypatch):
    version = metadata.version

    def without_scipy(name: str) -> str:
        if name == "scipy":
            raise metadata.PackageNotFoundError(name)
        return version(name)

    monkeypatch.setattr(metadata, "version", without_scipy)
    (scipy,) = [each for each in required_packages() if each.name == "scipy"]
    assert scipy == Dependency("scipy", None, scipy.required, False)
    outcome = run_command("doctor")
    assert outcome.code == 2
    assert f'pip install "scipy{scipy.required}"' in outcome.out
    assert "Self test FAILED in 0.0 s: not attempted: scipy missing" in outcome.out
    assert "The installation does not work. Install scipy." in outcome.out


def test_an_extra_is_complete_or_names_missing_packages(monkeypatch):
    monkeypatch.setattr(
        metadata,
        "requires",
        lambda _: [
            "numpy>=2",
            "absent-package>=1; extra == 'film'",
            "numpy>=99; extra == 'film'",
            "numpy>=2; extra == 'logs'",
            "never>=1; sys_platform == 'none' and extra == 'logs'",
        ],
    )
    extras = {each.name: each for each in optional_packages()}
    assert extras["film"].missing == ("absent-package", "numpy")
    assert extras["film"].install == 'pip install "collocation-sysid[film]"'
    assert extras["logs"].missing == ()
    assert "test" not in extras


def test_solvers_are_those_that_solve_a_problem():
    solvers = available_solvers()
    assert "ipopt" in solvers.nonlinear
    assert "mumps" in solvers.ipopt_linear
    assert "no-such-solver" not in solvers.ipopt_linear


def test_a_solver_that_crashes_does_not_end_the_check(monkeypatch):
    crashing = installation_check.SOLVER_PROGRAM.replace(
        "    try:\n", '    if name == "bad":\n        import os; os.abort()\n    try:\n'
    )
    monkeypatch.setattr(installation_check, "SOLVER_PROGRAM", crashing)
    found = [*installation_check._working_linear_solvers(["absent", "bad", "mumps"])]
    assert found == ["mumps"]


def test_a_self_test_that_fails_is_a_finding(monkeypatch):
    def fail() -> None:
        raise RuntimeError("no processor")

    monkeypatch.setattr(installation_check, "identify_small_body", fail)
    outcome = run_command("doctor", "--json")
    assert outcome.code == 2
    data = json.loads(outcome.out)
    assert data["self_test"]["message"] == "RuntimeError: no processor"
    assert data["is_working"] is False


def test_a_wrong_answer_fails_the_self_test(monkeypatch):
    monkeypatch.setattr(installation_check, "SELF_TEST_TOLERANCE", -1.0)
    message, is_passed = installation_check.identify_small_body()
    assert not is_passed
    assert "relative error" in message
    assert not SelfTest(is_passed, message, 0.1).is_passed


def test_a_cache_that_cannot_be_used_gives_the_reason(monkeypatch, tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    monkeypatch.setenv("COLLOCATION_SYSID_CACHE", str(file / "kernels"))
    kernels = kernel_state()
    assert not kernels.is_writable
    assert "cannot be written" in kernels.fault
    assert kernels.count == 0
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    monkeypatch.setenv("COLLOCATION_SYSID_CACHE", str(shared))
    assert kernel_state().fault == f"{shared} can be written by others"


def test_an_empty_cache_is_made(monkeypatch, tmp_path):
    monkeypatch.setenv("COLLOCATION_SYSID_CACHE", str(tmp_path / "new" / "kernels"))
    kernels = kernel_state()
    assert (kernels.fault, kernels.count, kernels.size_mb) == (None, 0, 0.0)
    jit.store_object("key", b"\0" * 2000)
    kernels = kernel_state()
    assert kernels.count == 1
    assert kernels.size_mb == pytest.approx(0.002, rel=0.1)


@pytest.mark.parametrize(
    ("value", "count", "source"),
    [
        ("3", 3, "COLLOCATION_SYSID_THREADS"),
        ("many", 1, "COLLOCATION_SYSID_THREADS: found 'many'; expected a whole number"),
        ("1.5", 1, "COLLOCATION_SYSID_THREADS: found '1.5'; expected a whole number"),
    ],
)
def test_the_report_states_the_source_of_the_number_of_threads(monkeypatch, value, count, source):
    monkeypatch.setenv("COLLOCATION_SYSID_THREADS", value)
    threads = thread_state()
    assert threads.count == count
    assert threads.source.endswith(source)


@pytest.mark.long
@pytest.mark.parametrize("module", ["casadi", "llvmlite", "packaging", "matplotlib"])
def test_a_library_that_cannot_be_imported_is_a_finding(module):
    program = f"import sys; sys.modules[{module!r}] = None\n"
    program += "from collocation_sysid.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", program, "doctor"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert "Traceback" not in done.stderr
    works = module in ("matplotlib", "llvmlite")  # for pictures, and for speed
    assert done.returncode == (0 if works else 2), done.stdout
    assert ("does not work" in done.stdout) is not works
