"""The folders show the architecture: each uses those before it, and nothing goes in circles."""

from __future__ import annotations

import ast
from collections import Counter
from functools import cache
from graphlib import TopologicalSorter
from itertools import chain, pairwise
from pathlib import Path

import pytest

import collocation_sysid

PACKAGE = Path(collocation_sysid.__file__).parent
# As in CONTRIBUTING.md.
LAYERS = (
    {"array_files", "array_types", "cluster", "console", "declarations", "display", "errors"}
    | {"files", "isolated_process", "machine", "pages", "schema_tables", "serialisation"}
    | {"signal_handling", "step_counting", "validated_types", "written_files"},
    {"fem"},
    {"recording"},
    {"model"},
    {"program"},
    {"methods"},
    {"statistics"},
    {"problem"},
    {"datasets"},
    {"runs"},
    {"result"},
    {"pipeline", "installation_check"},
    {"live"},
    {"plan"},
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


@cache
def imports(name: str) -> set[str]:
    """Modules of the package that one imports, also those inside functions and for types alone."""
    path = MODULES[name]
    folder = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    found = set()
    for statement in ast.walk(tree_of(name)):
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


@pytest.mark.parametrize("name", [name for name in MODULES if name])
def test_a_module_imports_nothing_from_above(name):
    for other in imports(name):
        assert other, f"{name} imports the package itself"
        assert layer(other) <= layer(name), f"{name} imports {other}"


def test_no_imports_go_in_circles():
    graph = {name: {other for other in imports(name) if other} for name in MODULES}
    assert len([*TopologicalSorter(graph).static_order()]) >= len(MODULES)


def test_the_contribution_guide_names_the_layers():
    guide = (PACKAGE.parent / "CONTRIBUTING.md").read_text()
    drawn = next(line for line in guide.splitlines() if line.strip().startswith("fem →"))
    order = [name.strip() for part in drawn.split("→") for name in part.split(",")]
    assert all(layer(a) <= layer(b) for a, b in pairwise(order))


# Names that two classes of different rooms still have.
TWICE = (
    "Branch Columns Design Grid Model Motion Picture Replay Scatter Section Slopes View _Emitter"
)


def test_a_class_name_occurs_once():
    nodes = chain.from_iterable(ast.walk(tree_of(name)) for name in MODULES)
    names = Counter(node.name for node in nodes if isinstance(node, ast.ClassDef))
    twice = {name for name, count in names.items() if count > 1}
    assert twice <= set(TWICE.split())
