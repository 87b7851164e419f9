"""Do the tests notice? One small mistake in the package at a time, against the tests that run it.

    nice -n 19 python scripts/mutants.py [--count 100] [--seed 1] [--under fem program/sweep.py]

A mutant is one comparison, sign, operation, constant, `not` or `and` changed. The tests that it has
to survive are those which ran its function, the quickest first, for which the suite runs once
under a tracer (``--ran`` keeps what that found). All is done in a copy of the tree under
``build/mutants``, with kernels compiled there; remove that folder to begin anew with other code.
What was tried is kept a line each, so that the command goes on where it was stopped, and a larger
``--budget`` tries survivors again. They are listed at the end.

A survivor is either a mistake that no test would notice, or a change that makes none.
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

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "collocation_sysid"
OUT = ROOT / "build" / "mutants"
# Tests of the copy are quick ones, and not of the repository itself.
LEFT_OUT = ("test_architecture.py", "test_docs.py", "test_shipped_problems.py")


# What can be changed ------------------------------------------------------------------------------

COMPARED = {
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
OPERATED = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
}
JOINED = {ast.And: ast.Or, ast.Or: ast.And}


@dataclass(frozen=True)
class Mutant:
    """One change: where it starts and ends (lines from 1, columns in bytes), and what it is.

    ``function`` is the first line of the function around it, 0 at the top of a module or a class.
    """

    path: str
    line: int
    column: int
    end_line: int
    end_column: int
    before: str
    after: str
    function: int

    def applied(self, source: str) -> str:
        """The file with the change in it."""
        lines = source.encode().splitlines(keepends=True)
        head = b"".join(
            [*lines[: self.line - 1], lines[self.line - 1][: self.column]]
        )
        tail = b"".join(
            [
                lines[self.end_line - 1][self.end_column :],
                *lines[self.end_line :],
            ]
        )
        return (head + self.after.encode() + tail).decode()

    def __str__(self) -> str:
        return f"{self.path}:{self.line}:{self.column}  {self.before}  →  {self.after}"


def changed(node: ast.expr) -> ast.expr | None:
    """Return the faulty expression that replaces `node`; None if this kind is not changed."""
    match node:
        case ast.Compare(left, [operator, *more], right) if (
            type(operator) in COMPARED
        ):
            return ast.Compare(left, [COMPARED[type(operator)](), *more], right)
        case ast.BinOp(left, operator, right) if type(operator) in OPERATED:
            return ast.BinOp(left, OPERATED[type(operator)](), right)
        case ast.BoolOp(operator, values):
            return ast.BoolOp(JOINED[type(operator)](), values)
        case ast.UnaryOp(ast.Not() | ast.USub(), operand):
            return operand
        case ast.Constant(int() | float() as value) if type(value) is not bool:
            return ast.Constant(value + 1)
        case ast.Constant(True | False as value):
            return ast.Constant(not value)
    return None


def evaluated(
    node: ast.AST, function: int = 0
) -> Iterator[tuple[ast.expr, int]]:
    """Expressions that are run, with their function: no annotations, no texts of errors."""
    skipped: tuple[ast.AST, ...] = ()
    match node:
        case ast.FunctionDef():
            # Where its code begins, as the interpreter sees it.
            function = min(
                [node.lineno, *(each.lineno for each in node.decorator_list)]
            )
            arguments = node.args
            every = [
                *arguments.posonlyargs,
                *arguments.args,
                *arguments.kwonlyargs,
            ]
            skipped = (*node.decorator_list, *filter(None, [node.returns]))
            skipped += tuple(
                each.annotation for each in every if each.annotation
            )
        case ast.AnnAssign():
            skipped = (node.annotation,)
        case ast.JoinedStr() | ast.Raise() | ast.Import() | ast.ImportFrom():
            return
    if isinstance(node, ast.expr):
        yield node, function
    for child in ast.iter_child_nodes(node):
        if child not in skipped:
            yield from evaluated(child, function)


def mutants_of(path: Path, root: Path) -> list[Mutant]:
    """Every mutant of a file."""
    source = path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    made = []
    for node, function in evaluated(tree):
        other = changed(node)
        if (
            other is None
            or node.end_lineno is None
            or node.end_col_offset is None
        ):
            continue
        after = ast.unparse(other)
        if isinstance(node, ast.UnaryOp):
            after = f"({after})"
        ends = (
            node.lineno,
            node.col_offset,
            node.end_lineno,
            node.end_col_offset,
        )
        made.append(
            Mutant(
                str(path.relative_to(root)),
                *ends,
                ast.unparse(node),
                after,
                function,
            )
        )
    return made


# Which tests run what -----------------------------------------------------------------------------


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Record the functions of the package that a passing test runs and its duration (pytest hook)."""
    seen: set[tuple[str, int]] = set()

    def trace(frame, event: str, argument: object) -> None:
        code = frame.f_code
        if PACKAGE in code.co_filename:
            seen.add((code.co_filename, code.co_firstlineno))

    threading.settrace(trace)
    sys.settrace(trace)
    start = time.perf_counter()
    failed = item.session.testsfailed
    yield
    sys.settrace(None)
    threading.settrace(None)  # type: ignore[arg-type]
    if item.session.testsfailed > failed:
        return
    functions: dict[str, list[int]] = {}
    for file, line in seen:
        inside = Path(file).resolve()
        if inside.is_relative_to(Path.cwd()):
            functions.setdefault(
                str(inside.relative_to(Path.cwd())), []
            ).append(line)
    row = {
        "test": item.nodeid,
        "s": time.perf_counter() - start,
        "ran": functions,
    }
    with Path(os.environ["MUTANTS_RAN"]).open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


@dataclass(frozen=True)
class Ran:
    """A test, how long it took, and which functions of which files it ran."""

    test: str
    s: float
    ran: dict[str, list[int]]

    def reaches(self, mutant: Mutant) -> bool:
        """Whether it ran the mutant's function, or anything in its file if that has none."""
        functions = self.ran.get(mutant.path, ())
        return (
            mutant.function in functions if mutant.function else bool(functions)
        )


def importers(path: str, tree: Path) -> set[str]:
    """Files of the package that import a file by its name."""
    wanted = re.compile(
        rf"^\s*from .*\b{Path(path).stem} import |import .*\b{Path(path).stem}\b",
        re.M,
    )
    files = (tree / PACKAGE).rglob("*.py")
    return {
        str(each.relative_to(tree))
        for each in files
        if wanted.search(each.read_text("utf-8"))
    }


def tests_against(
    mutant: Mutant, table: list[Ran], tree: Path, budget_s: float
) -> list[Ran]:
    """The quickest tests that reach it, as many as the budget holds and at least one.

    Of what runs on import only, or once for all tests, they are those of the files that import it.
    """
    able = [each for each in table if each.reaches(mutant)]
    if not able:
        files = importers(mutant.path, tree)
        able = [each for each in table if files & each.ran.keys()]
    chosen: list[Ran] = []
    for each in sorted(able, key=lambda each: each.s):
        if chosen and sum(one.s for one in chosen) + each.s > budget_s:
            break
        chosen.append(each)
    return sorted(
        chosen, key=lambda each: each.test
    )  # a module's fixtures are made once


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
        "PYTHONPATH": os.pathsep.join([str(tree), str(tree / "scripts")]),
        "COLLOCATION_SYSID_CACHE": str(cache),
        "COLLOCATION_SYSID_THREADS": "1",
        "OMP_NUM_THREADS": "1",
        "MUTANTS_RAN": str(OUT / "ran.jsonl"),
    }
    quiet = [
        "-q",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:xdist",
        "--no-header",
        "--tb=no",
    ]
    command = [sys.executable, "-m", "pytest", *quiet, *arguments]
    with (OUT / "pytest.log").open("w") as log:
        process = subprocess.Popen(
            command,
            cwd=tree,
            env=environment,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
        try:
            return process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, 9)
            process.wait()
            return None


def try_mutant(
    mutant: Mutant, tree: Path, table: list[Ran], budget_s: float
) -> str:
    """Return "killed", "timeout", "survived", or "no test" if none runs it."""
    against = tests_against(mutant, table, tree, budget_s)
    if not against:
        return "no test"
    file = tree / mutant.path
    source = file.read_text(encoding="utf-8")
    # What emits code has no part in the key by which compiled code is kept.
    kernels = "fem/kernels" in mutant.path
    cache = OUT / "spoiled" if kernels else OUT / "kernels"
    shutil.rmtree(OUT / "spoiled", ignore_errors=True)
    chosen = OUT / "chosen.txt"
    chosen.write_text(
        "\n".join(each.test for each in against), encoding="utf-8"
    )
    limit_s = 60 + (20 if kernels else 5) * sum(each.s for each in against)
    try:
        _put(file, mutant.applied(source))
        code = run_pytest(tree, cache, "-x", f"@{chosen}", timeout_s=limit_s)
    finally:
        _put(file, source)
    return {0: "survived", None: "timeout"}.get(code, "killed")


def _put(file: Path, source: str) -> None:
    """Write a module, and nothing compiled of it: a change within a second would not be seen."""
    file.write_text(source, encoding="utf-8")
    for compiled in (file.parent / "__pycache__").glob(f"{file.stem}.*.pyc"):
        compiled.unlink()


# The run ------------------------------------------------------------------------------------------


def record_what_tests_run(tree: Path, ran: Path, tests: list[str]) -> None:
    """Run the suite once under the tracer, unless that was done."""
    if ran.exists():
        return
    part = OUT / "ran.jsonl"
    part.unlink(missing_ok=True)
    left_out = [f"--ignore-glob=tests/*/{name}" for name in LEFT_OUT]
    run_pytest(tree, OUT / "kernels", "-p", "mutants", *left_out, *tests)
    part.rename(ran)


def read_rows(path: Path) -> list[dict]:
    return [
        json.loads(line)
        for line in path.read_text(encoding="utf-8").splitlines()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "--count", type=int, default=100, help="how many mutants (default: 100)"
    )
    parser.add_argument(
        "--seed", type=int, default=1, help="which of them (default: 1)"
    )
    parser.add_argument(
        "--under",
        nargs="*",
        default=[""],
        help="folders or files of the package",
    )
    parser.add_argument(
        "--tests", nargs="*", default=[], help="test files, of all"
    )
    parser.add_argument(
        "--budget", type=float, default=20.0, help="seconds of tests a mutant"
    )
    parser.add_argument(
        "--ran", type=Path, default=OUT / "tests.jsonl", help="what tests run"
    )
    asked = parser.parse_args()
    OUT.mkdir(parents=True, exist_ok=True)
    tree = OUT / "tree"
    if not tree.exists():
        copy_tree(tree)
    record_what_tests_run(tree, asked.ran, asked.tests)
    table = [Ran(**row) for row in read_rows(asked.ran)]
    every = [
        mutant
        for path in sorted((tree / PACKAGE).rglob("*.py"))
        if any(
            str(path.relative_to(tree / PACKAGE)).startswith(under)
            for under in asked.under
        )
        for mutant in mutants_of(path, tree)
    ]
    chosen = random.Random(asked.seed).sample(
        every, min(asked.count, len(every))
    )
    results = OUT / f"seed_{asked.seed}.jsonl"
    results.touch()
    done = {
        str(Mutant(**row["mutant"])): row["end"]
        for row in read_rows(results)
        if row["end"] != "survived" or row["budget"] >= asked.budget
    }
    for number, mutant in enumerate(chosen, 1):
        if str(mutant) not in done:
            done[str(mutant)] = end = try_mutant(
                mutant, tree, table, asked.budget
            )
            with results.open("a", encoding="utf-8") as file:
                file.write(
                    json.dumps(
                        {
                            "mutant": asdict(mutant),
                            "end": end,
                            "budget": asked.budget,
                        }
                    )
                    + "\n"
                )
        print(
            f"{number}/{len(chosen)} {done[str(mutant)]:9} {mutant}", flush=True
        )
    ends = [done[str(mutant)] for mutant in chosen]
    print(", ".join(f"{ends.count(end)} {end}" for end in sorted(set(ends))))
    for mutant in chosen:
        if done[str(mutant)] in ("survived", "no test"):
            lines = (
                (tree / mutant.path).read_text(encoding="utf-8").splitlines()
            )
            print(
                f"{done[str(mutant)]:9} {mutant}\n{'':10}{lines[mutant.line - 1].strip()}"
            )


if __name__ == "__main__":
    main()
