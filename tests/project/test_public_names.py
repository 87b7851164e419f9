"""Public names of the package: visible to type checkers, imported when used."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import collocation_sysid as cs

FILE = Path(cs.__file__)


def run_python(code: str) -> str:
    """Output of a program in a new process."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_every_public_name_is_imported_for_type_checkers_and_has_a_value():
    tree = ast.parse(FILE.read_text())
    blocks = [each for each in tree.body if isinstance(each, ast.If)]
    imports = [each for each in blocks[0].body if isinstance(each, ast.ImportFrom)]
    names = [alias.name for each in imports for alias in each.names]
    assert sorted(names) == sorted(cs.__all__)
    assert all(getattr(cs, name) is not None for name in names)
    assert set(cs.__all__) <= set(dir(cs))


def test_the_package_has_no_stub_files():
    """Type checkers would read it in place of the module."""
    assert not list(FILE.parent.rglob("*.pyi"))


def test_a_misspelt_name_is_no_attribute():
    with pytest.raises(AttributeError, match="'collocation_sysid' has no attribute 'Bdoy'"):
        cs.Bdoy  # noqa: B018


def test_the_package_is_imported_without_the_modules_of_its_names():
    code = "import sys, collocation_sysid; print(sys.modules.keys() & {'casadi', 'numpy', 'scipy'})"
    assert run_python(code) == "set()"


def test_solving_does_not_import_scipys_statistics():
    """They would double the time that SciPy takes to import."""
    code = "import sys, collocation_sysid.pipeline; print('scipy.stats' in sys.modules)"
    assert run_python(code) == "False"


def test_pictures_do_not_import_scipys_signal_processing():
    """It takes half a second to import, a twentieth of a short solve."""
    code = "import sys, collocation_sysid.result.pictures; print('scipy.signal' in sys.modules)"
    assert run_python(code) == "False"


@pytest.mark.long
def test_pyright_knows_public_names_and_reports_misspelt_names(tmp_path):
    if find_spec("pyright") is None:
        pytest.skip("pyright is not installed")
    program = tmp_path / "program.py"
    program.write_text(
        "import collocation_sysid as cs\n"
        "number: int = cs.Body\n"
        "number = cs.testing.check_material\n"
        "number = cs.__version__\n"
        "cs.Bdoy\n"
    )
    (tmp_path / "pyrightconfig.json").write_text(
        json.dumps({"extraPaths": [str(FILE.parents[1])], "reportUnusedExpression": False})
    )
    command = [sys.executable, "-m", "pyright", "--outputjson", "--project", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    reports = json.loads(done.stdout)["generalDiagnostics"]
    lines = {each["range"]["start"]["line"]: each["message"] for each in reports}
    assert [*lines] == [1, 2, 3, 4]
    assert '"type[Body]" is not assignable to type "int"' in lines[1]
    assert "material: str | Energy | Material" in lines[2]
    assert '"Bdoy" is not a known attribute' in lines[4]
