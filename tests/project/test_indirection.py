"""A name leads to its value directly: few properties, which only compute what is cheap or stored.

A property is counted with all decorators that contain the word, also cached ones. What is computed
anew at every use, or found by a search, is a method with a verb; what only forwards the attribute
of another object is written where it is used. The limit is the share that has been reached; lower
it with each property that is removed.
"""

from __future__ import annotations

import ast
from pathlib import Path

import collocation_sysid

PACKAGE = Path(collocation_sysid.__file__).parent
# Largest share of properties among the functions of the package.
LARGEST_SHARE = 0.12


def has_property_decorator(
    function: ast.FunctionDef | ast.AsyncFunctionDef,
) -> bool:
    return any(
        "property" in ast.unparse(each) for each in function.decorator_list
    )


def test_few_functions_are_properties():
    functions = [
        node
        for path in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    ]
    count = sum(map(has_property_decorator, functions))
    assert count <= LARGEST_SHARE * len(functions), (
        f"{count} of {len(functions)} functions are properties"
    )
