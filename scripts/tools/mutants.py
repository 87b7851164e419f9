"""Mutation testing: one small fault in the package at a time, and the tests that do not detect it.

    nice -n 19 python scripts mutants [--count 100] [--seed 1] [--under fem program/sweep.py]

A mutant has one changed comparison, sign, operation, constant, `not` or `and`. It is tested by the
tests that run its function, the fastest first. To find these, the suite runs once under a tracer;
``--ran`` names the file of the result. Everything is done in a copy of the tree under
``build/mutants``, with kernels compiled there; delete this folder when the code has changed. Each
result is appended to a file, so that the command continues where it was stopped; with a larger
``--budget`` survivors are tested again. The survivors are listed at the end.

A survivor is either a fault that no test detects, or a change without effect.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "collocation_sysid"
OUT = ROOT / "build" / "mutants"
# Excluded tests: slow ones, and those of the repository itself.
EXCLUDED_TESTS = ("test_architecture.py", "test_docs.py", "test_shipped_problems.py")


# Changes of expressions
# ------------------------------------------------------------------------------

COMPARISONS = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
OPERATORS = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}
CONNECTIVES = {ast.And: ast.Or, ast.Or: ast.And}


@dataclass(frozen=True)
class Mutant:
    """One change of an expression.

    Attributes
    ----------
    path : str
        File, relative to the tree.
    line, column, end_line, end_column : int
        Position of the expression: lines from 1, columns in bytes from 0.
    before, after : str
        Text of the expression before and after the change.
    function : int
        First line of the function that contains the expression; 0 outside of functions.
    """

    path: str
    line: int
    column: int
    end_line: int
    end_column: int
    before: str
    after: str
    function: int

    def applied_to(self, source: str) -> str:
        """Return the source of the file with the change."""
        lines = source.encode().splitlines(keepends=True)
        head = b"".join([*lines[: self.line - 1], lines[self.line - 1][: self.column]])
        tail = b"".join([lines[self.end_line - 1][self.end_column :], *lines[self.end_line :]])
        return (head + self.after.encode() + tail).decode()

    def __str__(self) -> str:
        return f"{self.path}:{self.line}:{self.column}  {self.before}  →  {self.after}"


def mutated_expression(node: ast.expr) -> ast.expr | None:
    """Return the faulty expression that replaces `node`; None if this kind is not changed."""
    match node:
        case ast.Compare(left, [operator, *more], right) if type(operator) in COMPARISONS:
            return ast.Compare(left, [COMPARISONS[type(operator)](), *more], right)
        case ast.BinOp(left, operator, right) if type(operator) in OPERATORS:
            return ast.BinOp(left, OPERATORS[type(operator)](), right)
        case ast.BoolOp(operator, values):
            return ast.BoolOp(CONNECTIVES[type(operator)](), values)
        case ast.UnaryOp(ast.Not() | ast.USub(), operand):
            return operand
        case ast.Constant(int() | float() as value) if type(value) is not bool:
            return ast.Constant(value + 1)
        case ast.Constant(True | False as value):
            return ast.Constant(not value)
    return None


def evaluated_expressions(node: ast.AST, function: int = 0) -> Iterator[tuple[ast.expr, int]]:
    """Yield the expressions below a node that are evaluated, with the first line of their function.

    Annotations, decorators and messages of errors are skipped.
    """
    skipped: tuple[ast.AST, ...] = ()
    match node:
        case ast.FunctionDef():
            # First line of the code object, which includes decorators.
            function = min([node.lineno, *(each.lineno for each in node.decorator_list)])
            arguments = node.args
            all_arguments = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
            skipped = (*node.decorator_list, *filter(None, [node.returns]))
            skipped += tuple(each.annotation for each in all_arguments if each.annotation)
        case ast.AnnAssign():
            skipped = (node.annotation,)
        case ast.JoinedStr() | ast.Raise() | ast.Import() | ast.ImportFrom():
            return
    if isinstance(node, ast.expr):
        yield node, function
    for child in ast.iter_child_nodes(node):
        if child not in skipped:
            yield from evaluated_expressions(child, function)


def mutants_of_file(path: Path, root: Path) -> list[Mutant]:
    """Return all mutants of a file, with paths relative to `root`."""
    source = path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    mutants = []
    for node, function in evaluated_expressions(tree):
        other = mutated_expression(node)
        if other is None or node.end_lineno is None or node.end_col_offset is None:
            continue
        after = ast.unparse(other)
        if isinstance(node, ast.UnaryOp):
            after = f"({after})"
        mutants.append(
            Mutant(
                str(path.relative_to(root)),
                line=node.lineno,
                column=node.col_offset,
                end_line=node.end_lineno,
                end_column=node.end_col_offset,
                before=ast.unparse(node),
                after=after,
                function=function,
            )
        )
    return mutants


# Functions that each test runs
# -----------------------------------------------------------------------------


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Record the functions of the package that a passing test runs and its duration (pytest hook)."""
    functions_run: set[tuple[str, int]] = set()

    def trace(frame, event: str, argument: object) -> None:
        code = frame.f_code
        if PACKAGE in code.co_filename:
            functions_run.add((code.co_filename, code.co_firstlineno))

    threading.settrace(trace)
    sys.settrace(trace)
    start = time.perf_counter()
    failures_before = item.session.testsfailed
    yield
    sys.settrace(None)
    threading.settrace(None)  # type: ignore[arg-type]
    if item.session.testsfailed > failures_before:
        return
    functions: dict[str, list[int]] = {}
    for file, line in functions_run:
        module_file = Path(file).resolve()
        if module_file.is_relative_to(Path.cwd()):
            functions.setdefault(str(module_file.relative_to(Path.cwd())), []).append(line)
    row = {"test": item.nodeid, "s": time.perf_counter() - start, "ran": functions}
    with Path(os.environ["MUTANTS_RAN"]).open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


@dataclass(frozen=True)
class TestRecord:
    """Duration of a test [s], and first lines of the functions that it ran, by file."""

    test: str
    s: float
    ran: dict[str, list[int]]

    def reaches(self, mutant: Mutant) -> bool:
        """Whether the test ran the function of the mutant, or its file if it is outside of
        functions.
        """
        functions = self.ran.get(mutant.path, ())
        return mutant.function in functions if mutant.function else bool(functions)


def importers(path: str, tree: Path) -> set[str]:
    """Return the files of the package that import a module by its name."""
    import_pattern = re.compile(
        rf"^\s*from .*\b{Path(path).stem} import |import .*\b{Path(path).stem}\b", re.M
    )
    files = (tree / PACKAGE).rglob("*.py")
    return {
        str(each.relative_to(tree))
        for each in files
        if import_pattern.search(each.read_text("utf-8"))
    }


def tests_against(
    mutant: Mutant, table: list[TestRecord], tree: Path, budget_s: float
) -> list[TestRecord]:
    """Return the fastest tests that run a mutant, within the time budget [s], at least one.

    If no test was recorded, because the code runs only on import or once for all tests, these are
    tests that run files which import the module. Empty if there are none.
    """
    candidates = [each for each in table if each.reaches(mutant)]
    if not candidates:
        files = importers(mutant.path, tree)
        candidates = [each for each in table if files & each.ran.keys()]
    chosen: list[TestRecord] = []
    for each in sorted(candidates, key=lambda each: each.s):
        if chosen and sum(one.s for one in chosen) + each.s > budget_s:
            break
        chosen.append(each)
    return sorted(chosen, key=lambda each: each.test)  # fixtures of a module are then made once


# In a copy of the tree ----------------------------------------------------------------------------


def copy_tree(to: Path) -> None:
    """Copy all files that git does not ignore from the working tree to a folder."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    for name in listed.stdout.splitlines():
        source = ROOT / name
        if source.is_file():
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, to / name)


def run_pytest(
    tree: Path, cache: Path, *arguments: str, timeout_s: float | None = None
) -> int | None:
    """Run pytest in a tree and return its exit code; None if it exceeds the time limit."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(tree), *map(str, sorted((tree / "scripts").iterdir()))]),
        "COLLOCATION_SYSID_CACHE": str(cache),
        "COLLOCATION_SYSID_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "MUTANTS_RAN": str(OUT / "ran.jsonl"),
    }
    options = ["-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--no-header", "--tb=no"]
    command = [sys.executable, "-m", "pytest", *options, *arguments]
    with (OUT / "pytest.log").open("w") as log:
        process = subprocess.Popen(
            command, cwd=tree, env=environment, stdout=log, stderr=log, start_new_session=True
        )
        try:
            return process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, 9)
            process.wait()
            return None


def try_mutant(mutant: Mutant, tree: Path, table: list[TestRecord], budget_s: float) -> str:
    """Return "killed", "timeout", "survived", or "no test" if none runs it."""
    tests = tests_against(mutant, table, tree, budget_s)
    if not tests:
        return "no test"
    file = tree / mutant.path
    source = file.read_text(encoding="utf-8")
    # The key of compiled kernels does not depend on the code generator, which may be the mutant.
    kernels = "fem/kernels" in mutant.path
    cache = OUT / "spoiled" if kernels else OUT / "kernels"
    shutil.rmtree(OUT / "spoiled", ignore_errors=True)
    chosen = OUT / "chosen.txt"
    chosen.write_text("\n".join(each.test for each in tests), encoding="utf-8")
    limit_s = 60 + (20 if kernels else 5) * sum(each.s for each in tests)
    try:
        _write_module(file, mutant.applied_to(source))
        code = run_pytest(tree, cache, "-x", f"@{chosen}", timeout_s=limit_s)
    finally:
        _write_module(file, source)
    return {0: "survived", None: "timeout"}.get(code, "killed")


def _write_module(file: Path, source: str) -> None:
    """Write a module and delete its bytecode, which Python would reuse if written in the same
    second.
    """
    file.write_text(source, encoding="utf-8")
    for compiled in (file.parent / "__pycache__").glob(f"{file.stem}.*.pyc"):
        compiled.unlink()


# The run ------------------------------------------------------------------------------------------


def record_what_tests_run(tree: Path, ran: Path, tests: list[str]) -> None:
    """Run the suite once under the tracer, unless the file of its result exists."""
    if ran.exists():
        return
    part = OUT / "ran.jsonl"
    part.unlink(missing_ok=True)
    exclusions = [f"--ignore-glob=tests/*/{name}" for name in EXCLUDED_TESTS]
    run_pytest(tree, OUT / "kernels", "-p", "mutants", *exclusions, *tests)
    part.rename(ran)


def read_rows(path: Path) -> list[dict]:
    """Return the rows of a file with one JSON object per line."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=100, help="number of mutants (default: 100)")
    parser.add_argument(
        "--seed", type=int, default=1, help="seed of their random choice (default: 1)"
    )
    parser.add_argument("--under", nargs="*", default=[""], help="folders or files of the package")
    parser.add_argument("--tests", nargs="*", default=[], help="test files; all by default")
    parser.add_argument(
        "--budget", type=float, default=20.0, help="duration of the tests of a mutant [s]"
    )
    parser.add_argument(
        "--ran",
        type=Path,
        default=OUT / "tests.jsonl",
        help="file of the functions that each test runs",
    )
    arguments = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    tree = OUT / "tree"
    if not tree.exists():
        copy_tree(tree)
    record_what_tests_run(tree, arguments.ran, arguments.tests)
    table = [TestRecord(**row) for row in read_rows(arguments.ran)]
    all_mutants = [
        mutant
        for path in sorted((tree / PACKAGE).rglob("*.py"))
        if any(
            str(path.relative_to(tree / PACKAGE)).startswith(prefix) for prefix in arguments.under
        )
        for mutant in mutants_of_file(path, tree)
    ]
    chosen = random.Random(arguments.seed).sample(
        all_mutants, min(arguments.count, len(all_mutants))
    )
    results = OUT / f"seed_{arguments.seed}.jsonl"
    results.touch()
    done = {
        str(Mutant(**row["mutant"])): row["end"]
        for row in read_rows(results)
        if row["end"] != "survived" or row["budget"] >= arguments.budget
    }
    for number, mutant in enumerate(chosen, 1):
        if str(mutant) not in done:
            done[str(mutant)] = end = try_mutant(mutant, tree, table, arguments.budget)
            with results.open("a", encoding="utf-8") as file:
                file.write(
                    json.dumps({"mutant": asdict(mutant), "end": end, "budget": arguments.budget})
                    + "\n"
                )
        print(f"{number}/{len(chosen)} {done[str(mutant)]:9} {mutant}", flush=True)
    outcomes = [done[str(mutant)] for mutant in chosen]
    print(", ".join(f"{outcomes.count(end)} {end}" for end in sorted(set(outcomes))))
    for mutant in chosen:
        if done[str(mutant)] in ("survived", "no test"):
            lines = (tree / mutant.path).read_text(encoding="utf-8").splitlines()
            print(f"{done[str(mutant)]:9} {mutant}\n{'':10}{lines[mutant.line - 1].strip()}")


if __name__ == "__main__":
    main()
