"""Size of the package: files, functions, classes, tokens, docstrings, and numbers of modules.

    python scripts count_code [FOLDER ...]

One column for each folder with a package, such as those of two checkouts.
"""

from __future__ import annotations

import ast
import io
import tokenize
from collections import Counter
from pathlib import Path

from script_arguments import make_parser

PACKAGE = Path(__file__).parents[2] / "collocation_sysid"
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
# Tokens without content: brackets, separators and layout.
EMPTY = (tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.COMMENT)


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


def count(folder: Path) -> dict[str, int]:
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


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("folders", nargs="*", type=Path, default=[PACKAGE])
    folders = parser.parse_args().folders
    columns = [count(folder) for folder in folders]
    print("| | " + " | ".join(map(str, folders)) + " |")
    print("|---|" + "---|" * len(folders))
    for name in columns[0]:
        print(f"| {name} | " + " | ".join(f"{each[name]:,}" for each in columns) + " |")


if __name__ == "__main__":
    main()
