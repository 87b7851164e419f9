"""Size of the project: package, keys, tests, scripts, documentation, and the path of a solve.

    python scripts count_code [CHECKOUT ...]

One column for each checkout. The last rows count the files and functions of the package that
`collocation-sysid solve problems/foam_cylinder/recording.toml` executes.
"""

from __future__ import annotations

import ast
import io
import json
import os
import subprocess
import sys
import tempfile
import tokenize
from collections import Counter
from pathlib import Path

from script_arguments import make_parser

ROOT = Path(__file__).parents[2]
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
# Tokens without content: brackets, separators and layout.
EMPTY = (tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.COMMENT)
# Executes a command line, and prints the numbers of files and functions of the package.
EXECUTED = """
import inspect, sys, threading
found = set()
def note(frame, event, _):
    code = frame.f_code  # of a function, not of a module, a class or an expression
    is_function = code.co_flags & inspect.CO_OPTIMIZED and "<" not in code.co_name
    if event == "call" and is_function and "collocation_sysid/" in code.co_filename:
        found.add((code.co_filename, code.co_firstlineno))
threading.setprofile(note)
sys.setprofile(note)
from collocation_sysid.cli import main
try:
    main()
except SystemExit:
    pass
sys.setprofile(None)
print(len({file for file, _ in found}), len(found))
"""


def is_data_class(node: ast.ClassDef) -> bool:
    """Return whether a decorator makes the class a data class, or it is a tuple with names."""
    words = [ast.unparse(each) for each in (*node.decorator_list, *node.bases)]
    makers = ("dataclass", "validated", "declaration", "NamedTuple")
    return any(word.split("(")[0].split(".")[-1] in makers for word in words)


def is_number(node: ast.stmt) -> bool:
    """Return whether a statement of a module assigns a number, or a tuple of numbers."""
    value = getattr(node, "value", None)
    if not isinstance(node, ast.Assign | ast.AnnAssign) or value is None:
        return False
    try:
        number = ast.literal_eval(value)
    except (ValueError, TypeError):
        return False
    entries = number if isinstance(number, tuple) else (number,)
    return all(isinstance(each, int | float) and not isinstance(each, bool) for each in entries)


def count_tokens(text: str, docstrings: set[int]) -> int:
    """Return the number of tokens without brackets, separators and docstrings, which begin in the
    lines `docstrings`.
    """
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return sum(
        token.type not in EMPTY
        and token.string not in "()[]{},:"
        and not (token.type == tokenize.STRING and token.start[0] in docstrings)
        for token in tokens
    )


def count_package(folder: Path) -> dict[str, int]:
    """Return the counts of a package by what is counted."""
    counts = Counter[str]()
    calls = Counter[str]()
    data_classes: list[str] = []
    for file in sorted(folder.rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        tree = ast.parse(text)
        lines: set[int] = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.Call):
                calls[ast.unparse(node.func).split(".")[-1]] += 1
            if not isinstance(node, (*FUNCTIONS, ast.ClassDef, ast.Module)):
                continue
            counts["functions"] += isinstance(node, FUNCTIONS)
            counts["classes"] += isinstance(node, ast.ClassDef)
            if isinstance(node, ast.ClassDef) and is_data_class(node):
                data_classes.append(node.name)
            if node.body and ast.get_docstring(node, clean=False) is not None:
                string = node.body[0]
                lines.add(string.lineno)
                counts["lines of docstrings"] += (string.end_lineno or 0) - string.lineno + 1
        counts["files"] += 1
        counts["lines"] += text.count("\n")
        counts["tokens"] += count_tokens(text, lines)
        counts["numbers of modules"] += sum(map(is_number, tree.body))
    counts["data classes"] = len(data_classes)
    counts["data classes constructed once"] = sum(calls[name] == 1 for name in data_classes)
    return dict(sorted(counts.items()))


def count_keys(node: object) -> Counter[str]:
    """Return the numbers of keys and of tables in a JSON schema."""
    counts = Counter[str]()
    if isinstance(node, dict):
        properties = node.get("properties")
        if isinstance(properties, dict) and properties:
            counts += Counter({"keys of the schema": len(properties), "tables of the schema": 1})
        node = list(node.values())
    if isinstance(node, list):
        for each in node:
            counts += count_keys(each)
    return counts


def count_executed(checkout: Path) -> dict[str, int]:
    """Return how many files and functions of the package a solve executes."""
    with tempfile.TemporaryDirectory() as folder:
        problem = checkout / "problems/foam_cylinder/recording.toml"
        command = ["solve", str(problem), "--out", str(Path(folder) / "run"), "--quiet"]
        done = subprocess.run(
            [sys.executable, "-c", EXECUTED, *command],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(checkout)},
            capture_output=True,
            text=True,
            check=True,
        )
    files, functions = map(int, done.stdout.split()[-2:])
    return {"files that solve executes": files, "functions that solve executes": functions}


def count(checkout: Path) -> dict[str, int]:
    """Return the counts of a checkout by what is counted."""
    schema = json.loads((checkout / "problems/schema.json").read_text(encoding="utf-8"))
    pages = [*checkout.glob("docs/**/*.md")]
    lines = {
        name: sum(file.read_text(encoding="utf-8").count("\n") for file in folder.rglob("*.py"))
        for name in ("tests", "scripts")
        if (folder := checkout / name)
    }
    return {
        **count_package(checkout / "collocation_sysid"),
        **count_keys(schema),
        **{f"lines of {name}": number for name, number in lines.items()},
        "words of documentation": sum(len(page.read_text("utf-8").split()) for page in pages),
        **count_executed(checkout),
    }


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("checkouts", nargs="*", type=Path, default=[ROOT])
    checkouts = [each.resolve() for each in parser.parse_args().checkouts]
    columns = [count(checkout) for checkout in checkouts]
    print("| | " + " | ".join(each.name for each in checkouts) + " |")
    print("|---|" + "---|" * len(checkouts))
    for name in columns[0]:
        print(f"| {name} | " + " | ".join(f"{each[name]:,}" for each in columns) + " |")


if __name__ == "__main__":
    main()
