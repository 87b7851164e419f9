"""Rules of CONTRIBUTING.md for docstrings and names."""

from __future__ import annotations

import ast
import re
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

import collocation_sysid

PACKAGE = Path(collocation_sysid.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
TESTS = Path(__file__).parents[1]

# A summary that begins with one of these words has no subject of its own.
WITHOUT_SUBJECT = re.compile(
    r"^(What|How|Where|Which|Those|That|The same|Of|They|Them|It|Its|One that|One's|All that|There|"
    r"Who|Whose|By|From|Nothing|As|Beside|Then|So|Here)\b"
)
# "G at a point" may be the gap g or the matrix G: a lint rule that capitalises summaries hides it.
CAPITAL_SYMBOL = re.compile(r"^([B-HJ-ZΑ-Ω])(?:[ ,.]|\()")

Documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def identifier(path: Path, node: ast.AST) -> str:
    return f"{path.relative_to(PACKAGE)}:{getattr(node, 'lineno', 1)}"


@cache
def trees() -> list[tuple[Path, ast.Module]]:
    return [(path, ast.parse(path.read_text())) for path in FILES]


@cache
def trees_of_tests() -> list[tuple[Path, ast.Module]]:
    return [
        (path, ast.parse(path.read_text()))
        for path in sorted(TESTS.rglob("*.py"))
    ]


@cache
def summaries() -> list[tuple[str, str]]:
    """Place and first docstring line of everything that the package documents."""
    return [
        (identifier(path, node), docstring.split("\n")[0])
        for path, tree in trees()
        for node in ast.walk(tree)
        if isinstance(node, Documented)
        and (docstring := ast.get_docstring(node))
    ]


def packed_names(function: ast.FunctionDef | ast.AsyncFunctionDef) -> set[str]:
    """Names to which a function assigns a tuple that it writes out."""
    return {
        target.id
        for node in ast.walk(function)
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple)
        for target in node.targets
        if isinstance(target, ast.Name)
    }


def test_class_and_module_names_occur_once():
    """A reader who searches for a name finds one definition."""
    modules = Counter(path.stem for path in FILES if path.stem != "__init__")
    classes = Counter(
        node.name
        for _, tree in trees()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    )
    assert [
        name for name, count in (modules + classes).items() if count > 1
    ] == []


@pytest.mark.parametrize("pattern", [WITHOUT_SUBJECT, CAPITAL_SYMBOL])
def test_every_docstring_begins_with_a_subject(pattern):
    assert [
        f"{place} {text}" for place, text in summaries() if pattern.match(text)
    ] == []


def test_a_module_assigns_each_of_its_names_once():
    repeated = []
    for path, tree in trees():
        names: Counter[str] = Counter()
        for node in tree.body:
            if isinstance(node, ast.Assign | ast.AnnAssign):
                targets = (
                    node.targets
                    if isinstance(node, ast.Assign)
                    else [node.target]
                )
                stored = (
                    each for target in targets for each in ast.walk(target)
                )
                names.update(
                    each.id for each in stored if isinstance(each, ast.Name)
                )
        repeated += [
            f"{identifier(path, tree)} {name}"
            for name, n in names.items()
            if n > 1
        ]
    assert repeated == []


def test_no_function_packs_arguments_into_a_tuple():
    packs = []
    for path, tree in trees():
        for function in ast.walk(tree):
            if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                packed = packed_names(function)
                packs += [
                    f"{identifier(path, node)} *{node.value.id}"
                    for node in ast.walk(function)
                    if isinstance(node, ast.Starred)
                    and isinstance(node.value, ast.Name)
                    and node.value.id in packed
                ]
    assert packs == []


def test_no_test_module_imports_another_one():
    """What several tests share is in tests/kit."""
    names = {path.stem for path in TESTS.glob("*/test_*.py")}
    imported = [
        f"{path.name}: {module}"
        for path, tree in trees_of_tests()
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom | ast.Import)
        for module in (
            [node.module]
            if isinstance(node, ast.ImportFrom)
            else [alias.name for alias in node.names]
        )
        if module in names
    ]
    assert imported == []


def test_no_test_replaces_a_private_function():
    """What tests replace is public, so that its docstring states what it may be replaced by."""
    replaced = [
        f"{path.name}:{node.lineno}"
        for path, tree in trees_of_tests()
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and node.func.attr in ("setattr", "object")
        and len(node.args) > 1
        and isinstance(node.args[1], ast.Constant)
        and str(node.args[1].value).startswith("_")
        and not str(node.args[1].value).startswith("__")
    ]
    assert replaced == []


def test_the_docstring_of_a_package_names_its_modules():
    unnamed = []
    for path, tree in trees():
        if path.name == "__init__.py" and path.parent != PACKAGE:
            docstring = ast.get_docstring(tree) or ""
            unnamed += [
                f"{path.parent.relative_to(PACKAGE)}/{module.name}"
                for module in path.parent.glob("*.py")
                if module.stem != "__init__"
                and not re.search(rf"\b{module.stem}\b", docstring)
            ]
    assert unnamed == []
