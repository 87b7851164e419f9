"""Import order of the packages, the interface of the core, and independence of the tests."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from itertools import pairwise
from pathlib import Path

import collocation_sysid

PACKAGE = Path(collocation_sysid.__file__).parent
TESTS = Path(__file__).parents[1]
# As in CONTRIBUTING.md.
LAYERS = (
    {"errors"},
    {"common"},
    {"kinds"},  # the records; modules of rooms stand anywhere
    {"fem"},
    {"recording"},
    {"model"},
    {"program"},
    {"methods"},
    {"statistics"},
    {"problem"},
    {"datasets"},
    {"features", "judge"},
    {"runs"},
    {"result"},
    {"pipeline", "installation_check"},
    {"extras"},
    {"cli", "testing"},
    {"__main__"},
)


def modules() -> dict[str, Path]:
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


@cache
def tree_of(name: str) -> ast.Module:
    return ast.parse(MODULES[name].read_text())


def is_record(name: str) -> bool:
    """Whether a module is a record of `kinds`, which imports where a stage asks for it."""
    return name == "kinds.kind" or (name.startswith("kinds.") and name.count(".") == 1)


def is_in_room(name: str) -> bool:
    return name.startswith("kinds.") and name.count(".") > 1


@cache
def imports(name: str) -> set[str]:
    """Modules of the package that one imports, also those inside functions and for types alone, but
    of records only those at once.
    """
    path = MODULES[name]
    folder = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    found = set()
    for statement in tree_of(name).body if is_record(name) else ast.walk(tree_of(name)):
        if not isinstance(statement, ast.ImportFrom) or statement.level == 0:
            continue
        base = folder[: len(folder) - statement.level + 1]
        target = ".".join([*base, *(statement.module or "").split(".")]).strip(".")
        for alias in statement.names:
            inner = f"{target}.{alias.name}".strip(".")
            found.add(inner if inner in MODULES else target)
    return found - {name}


def layer(name: str) -> int:
    top = name.split(".")[0]
    return next(k for k, names in enumerate(LAYERS) if top in names)


def test_modules_import_nothing_from_above():
    for name in (name for name in MODULES if name):
        for other in imports(name):
            assert other, f"{name} imports the package itself"
            if is_in_room(name):
                continue
            assert layer(other) <= layer(name), f"{name} imports {other}"


# Modules that still import a room by its name.
BY_NAME = {
    "": ("image_tracks", "outlines", "rod"),  # public names
    "extras.export.mujoco": ("rod",),
    "extras.export.mujoco_cable": ("rod",),
    "extras.export.target": ("rod",),
    "extras.export.usd": ("rod",),
    "extras.live.estimator": ("image_tracks",),
    "extras.live.frames": ("image_tracks",),
    "extras.tracking.video": ("outlines",),
    "kinds.outlines": ("image_tracks",),
    "pipeline": ("specimen",),
    "problem.loading": ("rod",),
    "problem.measurement_section": ("rod",),
    "problem.schema": ("rod",),
    "result.run_record": ("contact", "image_tracks", "outlines"),
    "runs.facts": ("image_tracks",),
    "runs.verdict": ("specimen",),
}


def test_stages_ask_the_registry_and_import_no_room():
    for name in MODULES:
        rooms = {other.split(".")[1] for other in imports(name) if other.startswith("kinds.")}
        own = {name.split(".")[1]} if name.startswith("kinds.") else set()
        stated = BY_NAME.get(".".join(name.split(".")[:2]) if is_in_room(name) else name, ())
        assert rooms - {"kind", "registry"} - own <= {*stated}, name


def test_no_imports_go_in_circles():
    graph = {name: {other for other in imports(name) if other} for name in MODULES}
    assert len([*TopologicalSorter(graph).static_order()]) >= len(MODULES)


# Packages with the mathematics of an identification, and those that use it; see docs/core.md.
CORE = ("fem", "recording", "model", "program", "methods", "statistics")
OUTER = (
    "features",
    "judge",
    "runs",
    "result",
    "extras",
    "cli",
    "testing",
    "pipeline",
    "installation_check",
)


def test_the_core_is_loaded_without_the_packages_that_use_it():
    """Also without imports at run time, which no statement of a module shows."""
    core = [name for name in MODULES if name.split(".")[0] in CORE]
    code = (
        "import importlib, sys\n"
        f"for name in {core}: importlib.import_module('collocation_sysid.' + name)\n"
        "ours = [name for name in sys.modules if name.startswith('collocation_sysid.')]\n"
        "print(*{name.split('.')[1] for name in ours})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert set(CORE) <= loaded
    assert not loaded & {*OUTER, "problem"}


def test_a_problem_is_solved_without_judge_and_checks(tmp_path):
    """No import of a search reaches what seeks likely mistakes, nor that of commands the judge."""
    code = (
        "import sys\n"
        "class Blocker:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.startswith('collocation_sysid.judge'): raise ImportError(name)\n"
        "sys.meta_path.insert(0, Blocker())\n"
        "import collocation_sysid as cs\n"
        "pull = cs.Specimen('uniaxial', [0.1, 0.2, 0.3], [1e4, 2e4, 3e4], 100.0).experiment()\n"
        "fixed = {'kappa_pa': 1e9, 'gamma_r_s': 0.0, 'gamma_m_1_s': 0.0}\n"
        "print(cs.solve(cs.Problem([pull], {'mu_pa': cs.Unknown()} | fixed)).status.converged)\n"
        "print('collocation_sysid.runs.check' in sys.modules)\n"
        "import collocation_sysid.cli.problem_commands\n"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.stdout.split() == ["True", "False"], done.stderr


def test_a_stored_result_is_read_with_all_messages():
    """In a process that has solved nothing, such as that of a report of contact."""
    code = (
        "import collocation_sysid.runs.result_content\n"
        "from collocation_sysid.statistics.concerns import TOPICS\n"
        "read = {key: {*topic.messages} for key, topic in TOPICS.items()}\n"
        "import collocation_sysid.cli.problem_commands, collocation_sysid.features.registry\n"
        "print(read == {key: {*topic.messages} for key, topic in TOPICS.items()})\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"


# The methods that need sparse exact matrices, and what checks or measures their programs.
LIFTING = (
    "program.lifted",
    "methods.interior_point",
    "methods.starts.initial_point",
    "methods.complementarity",
    "methods.comparison",
    "problem.problem",
    "runs.check",
    "runs.cost",
    "runs.derivatives",
    "testing",
)


def test_only_methods_with_sparse_matrices_import_lifted_variables():
    importing = {
        name for name in MODULES if any(each.startswith("program.lifted") for each in imports(name))
    }
    assert {"methods.interior_point", "methods.comparison.merit"} <= importing
    assert [n for n in importing if not n.startswith(LIFTING)] == []
    reached = set()
    pending = {"methods.reduced_space", "program.simulation"}
    while pending:
        name = pending.pop()
        reached.add(name)
        pending |= imports(name) - reached
    assert "program.collocation" in reached
    assert [n for n in reached if n.startswith("program.lifted")] == []


def test_no_module_imports_the_package_by_its_name():
    """Imports are relative, so that the other tests of this file see them."""
    for name in MODULES:
        for statement in ast.walk(tree_of(name)):
            if isinstance(statement, ast.Import):
                assert not any(
                    each.name.startswith("collocation_sysid") for each in statement.names
                )
            if isinstance(statement, ast.ImportFrom) and not statement.level:
                assert not (statement.module or "").startswith("collocation_sysid"), name


def imported_names(name: str, packages: tuple[str, ...]) -> dict[str, str]:
    """Names that a module imports from the modules of some packages, with these modules."""
    path = MODULES[name]
    parts = name.split(".")
    folder = parts if path.name == "__init__.py" else parts[:-1]
    found = {}
    for statement in ast.walk(tree_of(name)):
        if not isinstance(statement, ast.ImportFrom) or statement.level == 0:
            continue
        base = folder[: len(folder) - statement.level + 1]
        target = [*base, *(statement.module or "").split(".")]
        if target[0] in packages:
            found |= dict.fromkeys((each.name for each in statement.names), ".".join(target))
    return found


def test_extras_import_from_the_program_only_the_names_on_the_page_of_the_core():
    page = (PACKAGE.parent / "docs" / "core.md").read_text()
    (paragraph,) = (part for part in page.split("\n- ") if "xtras import only these names" in part)
    listed = set(re.findall(r"`(\w+)`", paragraph.split(":", 1)[1]))
    extras = [name for name in MODULES if name.startswith("extras.")]
    imported = {
        name for extra in extras for name in imported_names(extra, ("model", "program", "methods"))
    }
    assert imported == listed


def test_the_contribution_guide_names_the_layers():
    guide = (PACKAGE.parent / "CONTRIBUTING.md").read_text()
    drawn = next(line for line in guide.splitlines() if line.strip().startswith("kinds →"))
    order = [name.strip() for part in drawn.split("→") for name in part.split(",")]
    assert all(layer(a) <= layer(b) for a, b in pairwise(order))


def test_no_test_module_imports_another_one():
    """What several tests share is in tests/kit."""
    names = {path.stem for path in TESTS.glob("*/test_*.py")}
    imported = [
        f"{path.name}: {module}"
        for path in sorted(TESTS.rglob("*.py"))
        for module in re.findall(r"(?m)^\s*(?:from|import) ([\w.]+)", path.read_text())
        if module in names
    ]
    assert imported == []
